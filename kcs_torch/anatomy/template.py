"""Where the joints of a person are.

Joint centres follow published proportions of the adult body, for a stature of 1.75 m:

- heights of hip, knee, ankle, eye and chin, and the size of the foot: R. Drillis and R. Contini, "Body segment
  parameters" (1966), as printed in D. Winter, "Biomechanics and Motor Control of Human Movement", figure 4.1;
- lengths between joint centres of thigh, shank, upper arm, forearm and hand: P. de Leva, "Adjustments to
  Zatsiorsky-Seluyanov's segment inertia parameters", Journal of Biomechanics 29 (1996), table 4.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

from kcs_torch.anatomy.names import FINGER_JOINTS, part_of, side_of
from kcs_torch.anatomy.quadruped import PLACES, quadruped_places
from kcs_torch.errors import SkeletonError, unknown

__all__ = ["KINDS", "STATURE", "places_by_names", "places_of_known", "share_of_stature", "template_by_names"]

KINDS = ("human", "hand", "quadruped")
"""Bodies whose template the names of joints tell."""

STATURE = 1.75
"""Metres, of the person of the template."""

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
    "handwrist": (0.235, 0.877, 0.053),  # a hand's own, beside the body's
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


def _hand_points() -> dict[str, Point]:
    """Positions by part, in the order in which MediaPipe and OpenPose number them."""
    points: dict[str, Point] = {"wrist": (0.0, 0.0, 0.0)}
    for finger, places in _FINGERS.items():
        points |= {f"{finger}_{joint}": place for joint, place in zip(FINGER_JOINTS[finger], places, strict=True)}
    points["thumb_cmc2"] = (0.031, 0.031, 0.009)  # the second axis of a thumb modelled with two
    return points


_HAND = _hand_points()


def _hanging_hand() -> dict[str, Point]:
    """The left hand of somebody who stands relaxed: fingers down, thumb forward, palm to the thigh."""
    wrist, palm = _LEFT["wrist"], _LEFT["hand"]
    long = math.hypot(palm[1] - wrist[1], palm[2] - wrist[2])
    down, forward = (palm[1] - wrist[1]) / long, (palm[2] - wrist[2]) / long
    points = {}
    for part, (across, along, out) in _HAND.items():
        if part != "wrist":
            height, front = along * down + across * forward, along * forward - across * down
            points[part] = (round(wrist[0] - out, 6), round(wrist[1] + height, 6), round(wrist[2] + front, 6))
    return points


_LEFT_FINGERS = _hanging_hand()
# A sided joint of these says that its fingers are those of a whole person.
_ABOVE_HANDS = frozenset(["hip", "knee", "ankle", "shoulder", "arm", "humerus", "elbow"])


def template_by_names(kind: str, names: Sequence[str]) -> tuple[Point, ...]:
    """Place joints by their names: a relaxed person, an open hand, or a standing animal, that faces the viewer.

    Some words depend on their neighbours: a ``foot`` beside an ``ankle`` is the ball of the foot and the ankle
    otherwise; a ``shoulder`` above an ``arm`` is the collar bone; ``pelvis`` is the middle of the hips, but the
    sacrum below a numbered spine, as motion capture has it; ``neck`` is between the shoulders, but higher beside
    a ``thorax``.

    Args:
        kind: one of KINDS. A hand of unknown side is a right one; an animal on four legs is of a large dog's build.
        names: N joint names, in any usual spelling.

    Returns:
        N positions (x right, y down, z away from the viewer) in metres; the body's left is at +x. The origin is the
        middle of the hips, or the wrist.

    Raises:
        SkeletonError: a name is not known as part of the body, or no name is of a limb or finger; of an animal: not of
            both its front and its hind limbs.

    >>> template_by_names("human", ["pelvis", "left_hip", "LKnee"])
    ((0.0, 0.0, 0.0), (0.095, 0.0, 0.0), (0.095, 0.423, -0.03))
    """
    if kind not in KINDS:
        raise unknown("template", kind, KINDS, SkeletonError)
    if kind == "hand":
        return _place_hand(_known_parts(kind, names))
    if kind == "quadruped":
        return _place_quadruped(names)
    out = []
    for side, place in places_by_names(names):
        x, height, forward = _CENTRE[place] if side == "centre" else (_LEFT | _LEFT_FINGERS)[place]
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


def places_of_known(names: Sequence[str]) -> list[tuple[str, str] | None]:
    """Return (side, place) of each joint as :func:`places_by_names`, None where a name is no part of a person.

    >>> places_of_known(["LKnee", "club"])
    [('left', 'knee'), None]
    """
    parts = [part_of(n, "human") for n in names]
    present = {part for part in parts if part is not None}
    sides = [side_of(n) for n in names]
    return [None if p is None else (s, _resolve(p, s, present)) for s, p in zip(sides, parts, strict=True)]


def share_of_stature(place: str) -> float:
    """How high a place of the centre or the left side lies above the floor, as a share of the stature.

    >>> round(share_of_stature("headtop"), 3), round(share_of_stature("ankle"), 3)
    (0.989, 0.04)
    """
    return (_CENTRE[place] if place in _CENTRE else _LEFT[place])[1] / STATURE


def _known_parts(kind: str, names: Sequence[str]) -> list[tuple[str, str]]:
    """(side, part) of every joint; all must be known."""
    parts = [(side_of(n), part_of(n, kind)) for n in names]
    if kind == "human" and any(side != "centre" and part in _ABOVE_HANDS for side, part in parts):
        fingers = [None if side == "centre" else part_of(n, "hand") for n, (side, _) in zip(names, parts, strict=True)]
        parts = [(side, part or finger) for (side, part), finger in zip(parts, fingers, strict=True)]
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
            "head": _head(present, bool(chain)),
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
        "handwrist": "handwrist" if "wrist" in present else "wrist",
    }.get(part, part)


def _head(present: set[str], chain: bool) -> str:
    """Where a joint named head is: in the middle of the head, but motion capture puts it where the skull turns."""
    if present & {"neck2", "lowerneck"} and "headtop" not in present:
        return "headtop"  # a bone named by its far end
    return "upperneck" if chain and "thorax" not in present else "head"


def _place_hand(parts: Sequence[tuple[str, str]]) -> tuple[Point, ...]:
    """Hands with the palm to the viewer and the fingers up; two of them are 0.4 m apart."""
    sides = {side for side, _ in parts}
    apart = 0.2 if {"left", "right"} <= sides else 0.0
    out = []
    for side, part in parts:
        x, up, forward = _HAND[part]
        out.append((apart - x if side == "left" else x - apart, -up if up else 0.0, -forward if forward else 0.0))
    return tuple(out)


def _place_quadruped(names: Sequence[str]) -> tuple[Point, ...]:
    """An animal on four legs that faces the viewer."""
    places = quadruped_places(names)
    if places is None:
        unknown = [n for n in names if part_of(n, "animal") is None and part_of(n, "human") is None]
        got = f"got {', '.join(map(repr, unknown or names))}" + (", which it does not know" if unknown else "")
        raise SkeletonError(
            "template 'quadruped': expected joints of a front and a hind limb, and a tail, paw or hock, all by known "
            f"names, {got}. Rename them, or give a position for every joint."
        )
    hips = PLACES["hip"]
    return tuple((x, round(hips[1] - up, 6), round(hips[2] - forward, 6)) for _, _, (x, up, forward) in places)
