"""What the names of joints mean: sides, mirror twins and parts of the human body."""

from __future__ import annotations

import re
from collections.abc import Sequence

__all__ = ["FINGER_JOINTS", "mirror_name", "part_of", "side_of"]

FINGER_JOINTS = dict.fromkeys(("thumb", "index", "middle", "ring", "pinky"), ("mcp", "pip", "dip", "tip")) | {
    "thumb": ("cmc", "mcp", "ip", "tip")
}


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
        "headtop": "headtop topofhead tophead vertex headend headtopend",
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
        "handwrist": "handwrist handroot palmbase",
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
# What has its own name in the limbs of animals.
_ANIMAL_NAMES = _spellings(
    {
        "hock": "hock tarsus",
        "knee": "stifle",
        "wrist": "carpus",
        "forepaw": "forepaw frontpaw forehoof fronthoof forefoot frontfoot",
        "hindpaw": "hindpaw backpaw rearpaw hindhoof backhoof rearhoof hindfoot backfoot rearfoot",
        "paw": "paw hoof",
        "withers": "withers",
        "nose": "snout muzzle",
        "tailbase": "tailbase tailroot rootoftail tailstart tail0",
        "tailmid": "tailmid tailmiddle midtail",
        "tailtip": "tailtip tailend endoftail",
        **{tail: tail for tail in ("tail", "tail1", "tail2", "tail3", "tail4", "tail5", "tail6")},
    }
)


def _hand_names() -> dict[str, str]:
    names = {"thumbcmcfe": "thumb_cmc", "thumbcmcaa": "thumb_cmc2", "thumbmcpfe": "thumb_mcp", "thumbipfe": "thumb_ip"}
    for finger, joints in FINGER_JOINTS.items():
        for number, joint in enumerate(joints, 1):
            part = f"{finger}_{joint}"
            for word in (finger, f"{finger}finger", {"pinky": "little", "index": "forefinger"}.get(finger, finger)):
                names |= {f"{word}{joint}": part, f"{word}{joint}fe": part, f"{word}{number}": part}
                names |= {f"hand{word}{joint}": part, f"hand{word}{number}": part}
    numbered = ["wrist", *(f"{finger}_{joint}" for finger, joints in FINGER_JOINTS.items() for joint in joints)]
    roots = dict.fromkeys(("handwrist", "handroot", "palmbase"), "wrist")
    return {**roots, **names, **{f"hand{i}": p for i, p in enumerate(numbered)}}


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


def part_of(name: str, kind: str) -> str | None:
    """Return the part of a "human", a "hand" or an "animal" that a name means, before its neighbours are looked at."""
    name = name.rsplit(":", 1)[-1]  # "mixamorig:LeftArm"
    found = _side_span(name)
    rest = name if found is None else name[: found[1]] + " " + name[found[2] :]
    key = "".join(word.lstrip("0") or "0" for word in _WORD.findall(rest)).lower()  # "spine_01" is "spine1"
    keys = [key, key.removesuffix("joint")]
    if kind == "hand":
        table = {**_HAND_NAMES, "wrist": "wrist"}
    elif kind == "animal":
        table = _ANIMAL_NAMES
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
        found = _glued_side(words)
    return found[0] if len(found) == 1 else None


def _glued_side(words: Sequence[tuple[str, int, int]]) -> list[tuple[str, int, int]]:
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
