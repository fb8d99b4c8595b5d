"""Which way joints bend, and which of them touch the ground.

Read from the names of the joints; a name that means nothing is passed over, so that a person who holds a club has
the hinges of a person. Joints of animals are named by what they are in the animal's limb (stifle, hock, carpus).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from kcs_torch.anatomy.names import part_of, side_of
from kcs_torch.anatomy.quadruped import quadruped_places
from kcs_torch.anatomy.template import places_of_known

__all__ = ["BENDS", "Hinge", "contacts_by_names", "hinges_by_names"]

Pair = tuple[int, int]

BENDS = {"backward": 1.0, "forward": -1.0}
"""The sign of a hinge by the way it bends, of a limb that hangs down."""


@dataclass(frozen=True)
class Hinge:
    """A joint that bends one way only: sign * ((joint - parent) x (child - joint)) . (left - right) >= 0.

    With x to the right, y down and z away from the viewer, and whatever the pose. A knee bends backward (sign +1): of
    a person who faces the viewer the left is at +x and the shank tips away, to +z. An elbow bends forward (sign -1),
    and so do the fingers of a hand that hangs down with its palm to the front.

    Args:
        parent: index of the joint above.
        joint: index of the joint that bends.
        child: index of the joint below.
        left: index of the joint at the left end of the axis across the body.
        right: index of the joint at its right end.
        sign: +1.0 bends backward, -1.0 forward.
        firm: how far this can be relied on, 0 to 1; less than 1 where the limb above turns about itself.

    >>> Hinge(0, 1, 2, left=0, right=3, sign=1.0).bends
    'backward'
    """

    parent: int
    joint: int
    child: int
    left: int
    right: int
    sign: float
    firm: float = 1.0

    @property
    def bends(self) -> str:
        """'backward' or 'forward'."""
        return "backward" if self.sign > 0 else "forward"

    @property
    def bones(self) -> tuple[Pair, Pair]:
        """The two bones that it joins, as (upper, lower) joints."""
        return (self.parent, self.joint), (self.joint, self.child)


# Joint, what may be above it, what may be below it (the first that a bone joins), the axis, the way, how firm. The
# humerus turns by 180 degrees about itself, so that the line of the shoulders says little of an elbow's axis.
_LIMBS: tuple[tuple[str, tuple[str, ...], tuple[str, ...], str, str, float], ...] = (
    ("knee", ("hip", "hip_inner"), ("ankle", "hock", "heel", "hindpaw"), "hip", "backward", 1.0),
    ("elbow", ("shoulder",), ("radius", "wrist", "hand", "forepaw"), "shoulder", "forward", 0.3),
    ("ankle", ("knee",), ("ball", "bigtoe", "toetip", "smalltoe"), "hip", "forward", 1.0),
    ("hock", ("knee",), ("hindpaw",), "hip", "forward", 1.0),
)
# A knuckle or thumb also bends backward, by 30 degrees and more; the outer two joints of a finger hardly do.
_FINGER_JOINTS = (("mcp", "pip", "dip"), ("pip", "dip", "tip"))
_FINGER_FIRM = 0.5
_ANIMAL_ELBOW = 0.7
"""How firm an elbow of an animal on four legs is: its limbs swing beside its body and hardly turn about themselves."""

_GROUND = {"heel", "ball", "bigtoe", "smalltoe", "toetip", "forepaw", "hindpaw", "paw"}


def hinges_by_names(names: Sequence[str], bones: Sequence[Pair]) -> tuple[Hinge, ...]:
    """Return the hinges of the joints whose names and bones tell of one: knees, elbows, feet, fingers.

    Args:
        names: N joint names, in any usual spelling.
        bones: pairs of joint indices.

    >>> names = ["l_hip", "r_hip", "l_knee", "l_ankle"]
    >>> hinges_by_names(names, [(0, 1), (0, 2), (2, 3)])
    (Hinge(parent=0, joint=2, child=3, left=0, right=1, sign=1.0, firm=1.0),)
    """
    joined: dict[int, list[int]] = {i: [] for i in range(len(names))}
    for a, b in bones:
        joined[a].append(b)
        joined[b].append(a)
    places = _places(names)
    hands = [(side_of(n), part_of(n, "hand") or "") for n in names]
    on_four_legs = quadruped_places(names) is not None
    found = []
    for joint, place in enumerate(places):
        for what, above, below, axis, bends, firm in _LIMBS:
            if place is not None and place[1] == what and place[0] != "centre":
                ends = (("left", axis), ("right", axis))
                firm = _ANIMAL_ELBOW if on_four_legs and what == "elbow" else firm
                hinge = _hinge(places, joined[joint], joint, above, below, ends, bends, firm)
                found += [] if hinge is None else [hinge]
    for joint, (side, part) in enumerate(hands):
        finger, _, which = part.partition("_")
        for above_name, what, below_name in _FINGER_JOINTS:
            if which == what and finger != "thumb":
                # Of a hand that hangs down with its palm to the front, the right one's little finger is to the left.
                across = ("index_mcp", "pinky_mcp") if side == "left" else ("pinky_mcp", "index_mcp")
                ends = ((side, across[0]), (side, across[1]))
                above, below = (f"{finger}_{above_name}",), (f"{finger}_{below_name}",)
                hinge = _hinge(hands, joined[joint], joint, above, below, ends, "forward", _FINGER_FIRM)
                found += [] if hinge is None else [hinge]
    return tuple(found)


def contacts_by_names(names: Sequence[str]) -> tuple[int, ...]:
    """Return the joints that touch the ground: heels, toes and paws, and ankles where nothing is lower.

    >>> contacts_by_names(["l_ankle", "r_ankle", "r_heel", "tail"])
    (0, 2)
    """
    places = _places(names)
    low = {place[0] for place in places if place is not None and place[1] in _GROUND}
    return tuple(
        i
        for i, place in enumerate(places)
        if place is not None and (place[1] in _GROUND or (place[1] == "ankle" and place[0] not in low))
    )


def _hinge(
    places: Sequence[tuple[str, str] | None],
    neighbours: Sequence[int],
    joint: int,
    above: Sequence[str],
    below: Sequence[str],
    ends: tuple[tuple[str, str], tuple[str, str]],
    bends: str,
    firm: float,
) -> Hinge | None:
    """The hinge at a joint, or None where a part of it is missing."""
    here = places[joint]
    side = "centre" if here is None else here[0]
    parent = next((n for p in above for n in neighbours if places[n] == (side, p)), None)
    child = next((n for p in below for n in neighbours if places[n] == (side, p)), None)
    if parent is None or child is None or any(list(places).count(end) != 1 for end in ends):
        return None
    left, right = (list(places).index(end) for end in ends)
    return Hinge(parent, joint, child, left, right, BENDS[bends], firm)


def _places(names: Sequence[str]) -> list[tuple[str, str] | None]:
    """(side, place) of each joint, None where its name means nothing."""
    on_four_legs = quadruped_places(names)
    if on_four_legs is not None:
        return [(side, place) for side, place, _ in on_four_legs]
    animal = ((side_of(n), part_of(n, "animal")) for n in names)
    known = zip(places_of_known(names), animal, strict=True)
    return [place or (None if part is None else (side, part)) for place, (side, part) in known]
