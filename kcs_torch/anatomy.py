"""What the names of joints mean: sides, mirror twins, and where a human's joints are.

Joint centres follow published proportions of the adult body, for a stature of 1.75 m:

- heights of hip, knee, ankle, eye and chin, and the size of the foot: R. Drillis and R. Contini, "Body segment
  parameters" (1966), as printed in D. Winter, "Biomechanics and Motor Control of Human Movement", figure 4.1;
- lengths between joint centres of thigh, shank, upper arm, forearm and hand: P. de Leva, "Adjustments to
  Zatsiorsky-Seluyanov's segment inertia parameters", Journal of Biomechanics 29 (1996), table 4.
"""

from __future__ import annotations

import re
from collections.abc import Sequence

from kcs_torch.errors import SkeletonError, unknown

__all__ = ["canonical_name", "mirror_name", "places_by_names", "side_of", "template_by_names"]

Point = tuple[float, float, float]

# Metres: towards the person's left, above the floor, forwards. A relaxed standing person.
_CENTRE: dict[str, Point] = {
    "midhip": (0.0, 0.928, 0.0),
    "sacrum": (0.0, 1.028, 0.0),  # where a chain of spine joints starts
    "spine_low": (0.0, 1.065, 0.0),
    "spine_sixth": (0.0, 1.090, 0.0),
    "spine1": (0.0, 1.152, 0.0),
    "spine": (0.0, 1.165, 0.0),
    "spine2": (0.0, 1.276, 0.0),
    "chest": (0.0, 1.300, 0.0),
    "spine3": (0.0, 1.340, 0.0),
    "thorax": (0.0, 1.400, 0.0),
    "neck": (0.0, 1.450, 0.0),
    "neck1": (0.0, 1.510, 0.0),
    "upperneck": (0.0, 1.530, 0.01),
    "neck2": (0.0, 1.620, 0.0),
    "head": (0.0, 1.660, 0.01),
    "headtop": (0.0, 1.730, 0.0),
    "nose": (0.0, 1.600, 0.12),
    "mouth": (0.0, 1.555, 0.105),
    "chin": (0.0, 1.522, 0.09),
}
_LEFT: dict[str, Point] = {
    "hip": (0.095, 0.928, 0.0),
    "hip_inner": (0.05, 0.975, 0.0),
    "knee": (0.095, 0.505, 0.03),
    "ankle": (0.095, 0.070, 0.0),
    "heel": (0.095, 0.020, -0.050),
    "ball": (0.095, 0.015, 0.115),
    "bigtoe": (0.085, 0.015, 0.185),
    "smalltoe": (0.140, 0.015, 0.145),
    "toetip": (0.095, 0.010, 0.190),
    "clavicle": (0.060, 1.420, 0.0),
    "shoulder": (0.185, 1.420, 0.0),
    "elbow": (0.225, 1.1405, -0.02),
    "radius": (0.2317, 0.9715, 0.0267),
    "wrist": (0.235, 0.887, 0.05),
    "hand": (0.236, 0.806, 0.075),
    "fingers": (0.236, 0.715, 0.095),
    "fingerbase": (0.236, 0.780, 0.082),
    "thumb": (0.215, 0.820, 0.115),
    "index": (0.232, 0.800, 0.100),
    "pinky": (0.238, 0.798, 0.050),
    "eye": (0.032, 1.638, 0.095),
    "eyeinner": (0.018, 1.637, 0.100),
    "eyeouter": (0.045, 1.637, 0.085),
    "ear": (0.075, 1.620, 0.0),
    "mouth": (0.025, 1.555, 0.100),
}
_FACE = ("eye", "eyeinner", "eyeouter", "ear", "mouth")

# A right hand with the palm to the viewer: towards the thumb, along the fingers, out of the palm.
_FINGERS: dict[str, tuple[Point, Point, Point, Point]] = {
    "thumb": ((0.026, 0.025, 0.008), (0.052, 0.058, 0.015), (0.070, 0.087, 0.020), (0.083, 0.113, 0.024)),
    "index": ((0.027, 0.092, 0.0), (0.031, 0.135, 0.005), (0.033, 0.160, 0.012), (0.034, 0.182, 0.020)),
    "middle": ((0.004, 0.095, 0.0), (0.005, 0.141, 0.005), (0.0055, 0.169, 0.012), (0.006, 0.192, 0.020)),
    "ring": ((-0.017, 0.089, 0.0), (-0.020, 0.131, 0.005), (-0.022, 0.157, 0.012), (-0.024, 0.180, 0.020)),
    "pinky": ((-0.036, 0.078, 0.0), (-0.042, 0.110, 0.005), (-0.045, 0.129, 0.012), (-0.048, 0.149, 0.020)),
}
_FINGER_JOINTS = dict.fromkeys(_FINGERS, ("mcp", "pip", "dip", "tip")) | {"thumb": ("cmc", "mcp", "ip", "tip")}


def _hand_points() -> dict[str, Point]:
    """Positions by part, in the order in which MediaPipe and OpenPose number them."""
    points: dict[str, Point] = {"wrist": (0.0, 0.0, 0.0)}
    for finger, places in _FINGERS.items():
        points |= {f"{finger}_{joint}": place for joint, place in zip(_FINGER_JOINTS[finger], places, strict=True)}
    points["thumb_cmc2"] = (0.031, 0.031, 0.009)  # the second axis of a thumb modelled with two
    return points


_HAND = _hand_points()


def _spellings(table: dict[str, str]) -> dict[str, str]:
    return {word: part for part, words in table.items() for word in words.split()}


# Spellings, lower case and without separators or side, of each part.
_CENTRE_NAMES = _spellings(
    {
        "pelvis": "pelvis root hips",
        "midhip": "midhip midhips hip hipcenter hipcentre hipscenter centerhip centrehip",
        "lowerback": "lowerback",
        "upperback": "upperback",
        "spine": "spine midspine spinemid torso belly",
        "spine0": "spine0 spinebase",
        "spine1": "spine1",
        "spine2": "spine2",
        "spine3": "spine3",
        "chest": "chest spinechest",
        "thorax": "thorax upperchest spineshoulder",
        "neck": "neck neckbase basenneck midshoulder shouldercenter shouldercentre neckroot",
        "neck1": "neck1",
        "neck2": "neck2",
        "lowerneck": "lowerneck neck0",
        "upperneck": "upperneck necktop",
        "head": "head headcenter headcentre",
        "headtop": "headtop topofhead tophead vertex headend",
        "nose": "nose",
        "mouth": "mouth midmouth",
        "chin": "chin jaw",
    }
)
_SIDED_NAMES = _spellings(
    {
        "hip": "hip upleg upperleg thigh",
        "hipjoint": "hipjoint",
        "femur": "femur",
        "tibia": "tibia",
        "humerus": "humerus",
        "radius": "radius",
        "knee": "knee leg lowerleg shin calf",
        "ankle": "ankle",
        "foot": "foot",
        "heel": "heel",
        "toebase": "toebase toe football ball",
        "bigtoe": "bigtoe footindex toebig",
        "smalltoe": "smalltoe littletoe toesmall",
        "toes": "toes toeend toetip footend",
        "clavicle": "clavicle collar innershoulder collarbone",
        "shoulder": "shoulder",
        "arm": "arm upperarm uparm",
        "elbow": "elbow forearm lowerarm",
        "wrist": "wrist",
        "hand": "hand palm",
        "fingers": "fingers handtip handend fingertips",
        "fingerbase": "fingerbase handindex1",
        "thumb": "thumb handthumb",
        "index": "index indexknuckle",
        "pinky": "pinky pinkyknuckle",
        "eye": "eye",
        "eyeinner": "eyeinner innereye",
        "eyeouter": "eyeouter outereye",
        "ear": "ear",
        "mouth": "mouth",
    }
)


def _hand_names() -> dict[str, str]:
    names = {"thumbcmcfe": "thumb_cmc", "thumbcmcaa": "thumb_cmc2", "thumbmcpfe": "thumb_mcp", "thumbipfe": "thumb_ip"}
    for finger, joints in _FINGER_JOINTS.items():
        for number, joint in enumerate(joints, 1):
            part = f"{finger}_{joint}"
            for word in (finger, f"{finger}finger", "little" if finger == "pinky" else finger):
                names |= {f"{word}{joint}": part, f"{word}{joint}fe": part, f"{word}{number}": part}
                names |= {f"hand{word}{joint}": part, f"hand{word}{number}": part}
    numbered = [p for p in _HAND if p != "thumb_cmc2"]
    return {"handwrist": "wrist", "palmbase": "wrist", **names, **{f"hand{i}": p for i, p in enumerate(numbered)}}


_HAND_NAMES = _hand_names()
# Parts of animals and marker sets that are written with a glued l or r: they have a twin, but no place in a template.
_GLUED_ONLY = frozenset(
    ["fhd", "bhd", "sho", "upa", "elb", "frm", "wra", "wrb", "fin", "asi", "psi", "thi", "kne", "tib", "ank", "hee"]
)
_TWIN = {"left": "right", "right": "left", "l": "r", "r": "l"}
_LEG_TWIN = {"lf": "rf", "lm": "rm", "lh": "rh", "fl": "fr", "ml": "mr", "hl": "hr"}  # left front, middle, hind
_LEG_TWIN |= {b: a for a, b in _LEG_TWIN.items()}
_WORD = re.compile(r"[A-Z]+(?=[A-Z][a-z])|[A-Z]?[a-z]+|[A-Z]+|\d+")
_NOT_A_SIDE = ("over", "ward", "wards", "most", "angle", "handed")  # "leftover", "rightmost", ...


def side_of(name: str) -> str:
    """Tell on which side a joint is: 'left', 'right' or 'centre'.

    >>> [side_of(n) for n in ("LHip", "r_wrist", "mouth_left", "hand.R", "lower_back", "rear")]
    ['left', 'right', 'left', 'right', 'centre', 'centre']
    """
    found = _side_span(name)
    return "centre" if found is None else found[0]


def mirror_name(name: str) -> str:
    """Return the name of the joint's twin in the same spelling, or the name itself where it has none.

    >>> [mirror_name(n) for n in ("LHip", "r_wrist", "mouth_left", "LeftUpLeg", "L_WRIST", "nose")]
    ['RHip', 'l_wrist', 'mouth_right', 'RightUpLeg', 'R_WRIST', 'nose']
    """
    found = _side_span(name)
    if found is None:
        return name
    _, start, stop = found
    word = name[start:stop]
    twin = (_TWIN | _LEG_TWIN)[word.lower()]
    twin = twin.upper() if word.isupper() else twin.capitalize() if word[0].isupper() else twin
    return name[:start] + twin + name[stop:]


def canonical_name(name: str) -> tuple[str, str] | None:
    """Return (side, part) of a joint of the human body or hand, or None where the name is not one.

    >>> canonical_name("LBigToe"), canonical_name("left_foot_index"), canonical_name("tail1")
    (('left', 'bigtoe'), ('left', 'bigtoe'), None)
    """
    part = _part(name, "human") or _part(name, "hand")
    return None if part is None else (side_of(name), part)


def template_by_names(kind: str, names: Sequence[str]) -> tuple[Point, ...]:
    """Place joints by their names: a relaxed person, or an open hand, that faces the viewer.

    Some words depend on their neighbours: a ``foot`` beside an ``ankle`` is the ball of the foot and the ankle
    otherwise; a ``shoulder`` above an ``arm`` is the collar bone; ``pelvis`` is the middle of the hips, but the
    sacrum below a numbered spine, as motion capture has it; ``neck`` is between the shoulders, but higher beside
    a ``thorax``.

    Args:
        kind: "human" or "hand". A hand of unknown side is a right one.
        names: N joint names, in any usual spelling.

    Returns:
        N positions (x right, y down, z away from the viewer) in metres; the person's left is at +x. The origin
        is the middle of the hips, or the wrist.

    Raises:
        SkeletonError: a name is not known as part of the body, or no name is of a limb or finger.

    >>> template_by_names("human", ["pelvis", "left_hip", "LKnee"])
    ((0.0, 0.0, 0.0), (0.095, 0.0, 0.0), (0.095, 0.423, -0.03))
    """
    if kind not in ("human", "hand"):
        raise unknown("template", kind, ["human", "hand"], SkeletonError)
    if kind == "hand":
        return _place_hand(_known_parts(kind, names))
    out = []
    for side, place in places_by_names(names):
        x, height, forward = _CENTRE[place] if side == "centre" else _LEFT[place]
        y = round(_CENTRE["midhip"][1] - height, 6)
        out.append((-x if side == "right" else x, y, -forward if forward else 0.0))
    return tuple(out)


def places_by_names(names: Sequence[str]) -> list[tuple[str, str]]:
    """Return (side, place) of each joint of a person, after its neighbours have been looked at.

    Raises:
        SkeletonError: as :func:`template_by_names`.

    >>> places_by_names(["LeftUpLeg", "LeftLeg", "LeftFoot", "Hips"])
    [('left', 'hip'), ('left', 'knee'), ('left', 'ankle'), ('centre', 'midhip')]
    """
    parts = _known_parts("human", names)
    present = {part for _, part in parts}
    if not any(side != "centre" and part not in _FACE for side, part in parts):
        raise SkeletonError("template 'human': expected a joint of an arm or a leg; a head alone may be any animal's")
    return [(side, _resolve(part, side, present)) for side, part in parts]


def _known_parts(kind: str, names: Sequence[str]) -> list[tuple[str, str]]:
    """(side, part) of every joint; all must be known."""
    parts = [(side_of(n), _part(n, kind)) for n in names]
    strange = [n for n, (_, part) in zip(names, parts, strict=True) if part is None]
    if strange:
        raise SkeletonError(
            f"template '{kind}': expected joints of a {kind}, got {', '.join(map(repr, strange))}. "
            "Rename them, or give a position for every joint."
        )
    return [(side, part or "") for side, part in parts]


def _resolve(part: str, side: str, present: set[str]) -> str:
    """The place that a word means beside its neighbours."""
    if side == "centre":
        chain = {"spine0", "spine1", "spine2", "spine3", "lowerback", "upperback"} & present
        return {
            "pelvis": "sacrum" if chain else "midhip",
            "lowerback": "spine1" if "upperback" in present else "spine_low",
            "upperback": "spine2",
            "spine0": "spine_low",
            "spine": "spine_sixth" if "spine1" in present else "spine",
            "neck": "upperneck" if "thorax" in present else "neck",
            "lowerneck": "neck1",
            "upperneck": "neck2" if "lowerneck" in present else "upperneck",
            "head": "headtop" if present & {"neck2", "lowerneck"} and "headtop" not in present else "head",
        }.get(part, part)
    return {
        "hipjoint": "hip_inner" if "hip" in present else "hip",
        "femur": "knee",  # bones named by their far end
        "tibia": "ankle",
        "humerus": "elbow",
        "foot": "ball" if present & {"ankle", "tibia"} else "ankle",
        "toebase": "ball",
        "toes": "toetip",
        "clavicle": "shoulder" if "humerus" in present else "clavicle",
        "shoulder": "clavicle" if "arm" in present else "shoulder",
        "arm": "shoulder",
        "hand": "hand" if "wrist" in present else "wrist",
    }.get(part, part)


def _place_hand(parts: Sequence[tuple[str, str]]) -> tuple[Point, ...]:
    """Hands with the palm to the viewer and the fingers up; two of them are 0.4 m apart."""
    sides = {side for side, _ in parts}
    apart = 0.2 if {"left", "right"} <= sides else 0.0
    out = []
    for side, part in parts:
        x, up, forward = _HAND[part]
        out.append((apart - x if side == "left" else x - apart, -up if up else 0.0, -forward if forward else 0.0))
    return tuple(out)


def _part(name: str, kind: str) -> str | None:
    """The part that a name means, before its neighbours are looked at."""
    name = name.rsplit(":", 1)[-1]  # "mixamorig:LeftArm"
    found = _side_span(name)
    rest = name if found is None else name[: found[1]] + " " + name[found[2] :]
    key = "".join(_WORD.findall(rest)).lower()
    keys = [key, key.removesuffix("joint")]
    if kind == "hand":
        table = {**_HAND_NAMES, "wrist": "wrist"}
    else:
        table = _CENTRE_NAMES if found is None else _SIDED_NAMES
    return next((table[k] for k in keys if k in table), None)


def _side_span(name: str) -> tuple[str, int, int] | None:
    """Side and the characters that say it, or None for a central or ambiguous name."""
    words = [(m.group(), m.start(), m.end()) for m in _WORD.finditer(name)]
    found = []
    for i, (word, start, stop) in enumerate(words):
        low = word.lower()
        if low in ("left", "right"):
            found.append((low, start, stop))
        elif low in ("l", "r"):
            digits_follow = i + 1 < len(words) and words[i + 1][0].isdigit() and words[i + 1][1] == stop
            if not digits_follow or (start > 0 and name[start - 1].islower()):  # "L5" is a vertebra, "wingL2" a wing
                found.append(("left" if low == "l" else "right", start, stop))
        elif i == 0 and len(words) > 1 and word.isupper() and low in _LEG_TWIN:
            found.append(("left" if "l" in low else "right", start, stop))
    if not found and words:
        found = _glued_side(name, words)
    return found[0] if len(found) == 1 else None


def _glued_side(name: str, words: Sequence[tuple[str, int, int]]) -> list[tuple[str, int, int]]:
    """A side written without a break: "lefthip", "hipright", "lhip", "LWRIST"."""
    first, start, stop = words[0]
    low = first.lower()
    tail = "".join(w for w, _, _ in words[1:]).lower()
    for side in ("left", "right"):
        if low.startswith(side) and low[len(side) :] not in _NOT_A_SIDE:
            return [(side, start, start + len(side))]
        if low.endswith(side) and low[: -len(side)] in _SIDED_NAMES and not tail:
            return [(side, stop - len(side), stop)]
    rest = low[1:] + tail
    known = rest in _SIDED_NAMES or rest in _GLUED_ONLY
    if low[0] in "lr" and known and rest != "ear":  # "rear" is no ear
        return [("left" if low[0] == "l" else "right", start, start + 1)]
    return []
