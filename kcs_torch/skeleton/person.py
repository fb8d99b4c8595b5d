"""A person's skeleton from the names of its joints alone."""

from __future__ import annotations

from collections.abc import Sequence

from kcs_torch.anatomy import places_of_known
from kcs_torch.anatomy.names import FINGER_JOINTS
from kcs_torch.skeleton.core import Skeleton
from kcs_torch.skeleton.mapping import places_with_fingers

__all__ = ["has_middle", "person_by_names"]

_SPINE = ("midhip", "sacrum", "spine_low", "spine_sixth", "spine1", "spine", "spine2", "chest", "spine3", "thorax")
_COLUMN = (*_SPINE, "neck", "neck1", "upperneck", "neck2", "head", "headtop")
"""From below; each hangs on the next lower one that there is."""

_NECK = ("neck2", "upperneck", "neck1", "neck", "thorax")
_SHIN, _PALM, _FACE = ("ankle", "knee", "hip"), ("hand", "handwrist", "wrist", "elbow"), ("nose", "head", *_NECK)
_WRIST = ("handwrist", "wrist", "hand", "elbow")
_ABOVE: dict[str, tuple[str, ...]] = {
    "nose": _NECK,
    "mouth": _FACE,
    "chin": _FACE,
    "eyeinner": _FACE,
    "eye": ("eyeinner", *_FACE),
    "eyeouter": ("eye", *_FACE),
    "ear": ("eyeouter", "eye", *_FACE),
    "clavicle": ("neck", "thorax", "spine3"),
    "shoulder": ("clavicle", "neck", "thorax", "spine3"),
    "elbow": ("shoulder",),
    "radius": ("elbow", "shoulder"),
    "wrist": ("radius", "elbow", "shoulder"),
    "handwrist": ("wrist",),
    "hand": ("wrist", "radius", "elbow"),
    "fingers": _PALM,
    **dict.fromkeys(("fingerbase", "thumb", "index", "pinky"), _WRIST),
    **{
        f"{finger}_{joint}": (*(f"{finger}_{lower}" for lower in joints[:k][::-1]), *_WRIST)
        for finger, joints in FINGER_JOINTS.items()
        for k, joint in enumerate(joints)
    },
    "thumb_cmc2": ("thumb_cmc", *_WRIST),
    "hip_inner": ("midhip", "sacrum"),
    "hip": ("hip_inner", "midhip", "sacrum"),
    "knee": ("hip",),
    "ankle": ("knee", "hip"),
    "heel": _SHIN,
    "ball": _SHIN,
    **dict.fromkeys(("bigtoe", "smalltoe", "toetip"), ("ball", *_SHIN)),
}
"""What each place may hang on, the first that there is; of the same side, or of the middle."""

_ABOVE["index_pip"] = ("index_mcp", "fingerbase", *_WRIST)  # motion capture calls a knuckle the hand's
_ABOVE["thumb_mcp"] = ("thumb_cmc2", "thumb_cmc", *_WRIST)

_MIDDLES = (("pelvis", "hip", ("midhip", "sacrum")), ("neck", "shoulder", ("neck", "thorax", "spine3")))
"""What is made, between which joints, unless there is one of these."""

_HEAD = frozenset(["nose", "mouth", "chin", "eyeinner", "eye", "eyeouter", "ear"])
"""What moves against the neck when the head nods."""


def has_middle(names: Sequence[str]) -> bool:
    """Whether one of the joints lies in the middle of a person's trunk.

    >>> has_middle(["left_hip", "right_hip", "MidHip"]), has_middle(["left_hip", "right_hip", "nose"])
    (True, False)
    """
    middle = {*_SPINE, "neck"}
    return any(place is not None and place[0] == "centre" and place[1] in middle for place in places_of_known(names))


def person_by_names(names: Sequence[str], name: str = "person") -> Skeleton | None:
    """The tree of a person's joints, in any usual spelling and order; None where these are others, or too few to link.

    A head or a trunk alone, without a joint of an arm or a leg, may be any animal's. Where no joint lies between the
    hips, or between the shoulders, a virtual pelvis or neck does. A face moves against the neck: the bone that links
    them is flexible. So is that between a body's wrist and a hand's own, which two models of a detector see in nearly
    the same place.

    Args:
        names: N joint names.
        name: of the skeleton.

    >>> body = person_by_names(["LShoulder", "RShoulder", "LElbow", "LHip", "RHip"])
    >>> body.joints[5:], body.bone_names[-1]
    (('pelvis', 'neck'), 'pelvis-neck')
    """
    places = places_of_known(names)
    virtual: dict[str, list[str]] = {}
    for middle, part, there in _MIDDLES:
        ends = [n for n, place in zip(names, places, strict=True) if place in (("left", part), ("right", part))]
        if len(ends) == 2 and not any(("centre", place) in places for place in there):
            virtual[middle] = ends
    everyone = [*names, *virtual]
    if len(set(everyone)) < len(everyone):
        return None
    at: dict[tuple[str, str], str] = {}
    places = places_of_known(everyone)
    if any(place is not None and place[1] == "elbow" for place in places):
        places = places_with_fingers(everyone)
    for joint, place in zip(everyone, places, strict=True):
        if place is None or place in at:
            return None
        at[place] = joint
    bones, flexible, roots = [], [], 0
    for (side, part), joint in at.items():
        if part in _COLUMN:
            above: tuple[str, ...] = _COLUMN[: _COLUMN.index(part)][::-1]
        else:
            above = _ABOVE.get(part, ())
        upper = next((p for u in above for p in ((side, u), ("centre", u)) if p in at), None)
        if upper is None:
            roots += 1
            continue
        bones.append((at[upper], joint))
        if (part in _HEAD and upper[1] in _NECK) or part == "handwrist":
            flexible.append(bones[-1])
    if roots != 1 or len(bones) < 2 or all(side == "centre" or part in _HEAD for side, part in at):
        return None
    return Skeleton.from_names(names, bones, name=name, virtual=virtual, template="human", flexible=flexible)
