"""How far bones stray from the template.

Of each bone the root mean square angle, in degrees, between its direction and the template's once the trunk (of a
hand: the palm) has been turned onto the template's. About a fifth of the arc that a joint sweeps from one end of its
range to the other, the joints between it and the trunk included. Ranges of motion: American Academy of Orthopaedic
Surgeons, "Joint Motion: Method of Measuring and Recording" (1965); D. Boone and S. Azen, "Normal range of motion of
joints in male subjects", Journal of Bone and Joint Surgery 61-A (1979).
"""

from __future__ import annotations

from collections.abc import Sequence

from kcs_torch.anatomy.names import FINGER_JOINTS, part_of
from kcs_torch.anatomy.quadruped import SPREAD, quadruped_places
from kcs_torch.anatomy.template import places_of_known

__all__ = ["UNKNOWN_SPREAD", "spread_by_names"]

UNKNOWN_SPREAD = 45.0
"""Degrees, of a bone of which nothing is known."""

# Of the bone that leads to a place; a bone is known by whichever of its ends comes later here, farther from the trunk.
_PERSON: dict[str, float] = {
    "midhip": 10.0,
    "sacrum": 10.0,
    **dict.fromkeys(("spine_low", "spine_sixth", "spine1", "spine", "spine2", "chest", "spine3", "thorax"), 12.0),
    "neck": 12.0,
    "hip_inner": 12.0,
    "hip": 12.0,
    "neck1": 12.0,
    "clavicle": 12.0,
    "shoulder": 15.0,
    "upperneck": 15.0,
    "neck2": 15.0,
    "head": 20.0,
    "headtop": 20.0,
    **dict.fromkeys(("nose", "mouth", "chin", "eyeinner", "eye", "eyeouter", "ear"), 25.0),  # the face turns too
    "knee": 30.0,
    "ankle": 35.0,
    **dict.fromkeys(("heel", "ball", "bigtoe", "smalltoe", "toetip"), 35.0),
    "elbow": 50.0,
    "radius": 60.0,
    "wrist": 60.0,
    "handwrist": 60.0,
    **dict.fromkeys(("hand", "fingerbase", "index", "pinky", "thumb", "fingers"), 60.0),  # as the forearm, and more
}
_HAND: dict[str, float] = {
    "wrist": 10.0,
    "thumb_cmc": 20.0,
    "thumb_cmc2": 20.0,
    **{f"{finger}_mcp": 10.0 for finger in FINGER_JOINTS if finger != "thumb"},
    **{f"thumb_{joint}": 30.0 for joint in ("mcp", "ip", "tip")},
    **{f"{finger}_{joint}": 40.0 for joint in ("pip", "dip", "tip") for finger in FINGER_JOINTS if finger != "thumb"},
}


def spread_by_names(names: Sequence[str], bones: Sequence[tuple[int, int]]) -> tuple[float, ...]:
    """Return how far each bone strays from the template, root mean square in degrees; 45 where nothing is known.

    Args:
        names: N joint names, in any usual spelling.
        bones: B pairs of joint indices.

    >>> spread_by_names(["pelvis", "l_hip", "l_knee", "l_ankle", "club"], [(0, 1), (1, 2), (2, 3), (3, 4)])
    (12.0, 30.0, 35.0, 45.0)
    """
    animal = quadruped_places(names)
    if animal is not None:
        parts = [place for _, place, _ in animal]
        return tuple(_farther(SPREAD, [parts[i] for i in bone]) or UNKNOWN_SPREAD for bone in bones)
    places = [None if place is None else place[1] for place in places_of_known(names)]
    fingers = [part_of(n, "hand") for n in names]
    # Fingers of a whole person go where the arm goes.
    hand = dict.fromkeys(_HAND, _PERSON["hand"]) if "elbow" in places else _HAND
    out = []
    for bone in bones:
        known = _farther(_PERSON, [places[i] for i in bone]) or _farther(hand, [fingers[i] for i in bone])
        out.append(known or UNKNOWN_SPREAD)
    return tuple(out)


def _farther(table: dict[str, float], ends: Sequence[str | None]) -> float | None:
    """What the table says of the end that comes later in it; None where it does not know both."""
    order = list(table)
    if any(end not in table for end in ends):
        return None
    return table[max((end for end in ends if end is not None), key=order.index)]
