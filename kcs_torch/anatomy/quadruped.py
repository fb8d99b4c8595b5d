"""Where the joints of a four-legged animal are, and how far they move.

A standing animal of a large dog's build, .62 m high at the withers: rounded guesses, as bodies differ from a cat's to
a horse's. Whoever knows the species better gives a template of their own.
"""

from __future__ import annotations

from collections.abc import Sequence

from kcs_torch.anatomy.names import part_of, side_of

__all__ = ["PLACES", "SPREAD", "quadruped_places"]

Point = tuple[float, float, float]

_CENTRE: dict[str, Point] = {
    "pelvis": (0.0, 0.60, -0.30),
    "spine_low": (0.0, 0.605, -0.18),
    "spine": (0.0, 0.61, -0.06),
    "spine1": (0.0, 0.61, 0.06),
    "spine2": (0.0, 0.605, 0.14),
    "chest": (0.0, 0.60, 0.18),
    "spine3": (0.0, 0.605, 0.20),
    "thorax": (0.0, 0.61, 0.24),
    "withers": (0.0, 0.64, 0.22),
    "neck": (0.0, 0.66, 0.30),
    "upperneck": (0.0, 0.74, 0.38),
    "head": (0.0, 0.80, 0.44),
    "headtop": (0.0, 0.84, 0.46),
    "nose": (0.0, 0.68, 0.64),
    "mouth": (0.0, 0.65, 0.60),
    "chin": (0.0, 0.64, 0.58),
}
_LEFT: dict[str, Point] = {
    "clavicle": (0.05, 0.62, 0.24),  # the top of the shoulder blade: no animal that runs has a collar bone
    "shoulder": (0.09, 0.48, 0.36),
    "elbow": (0.10, 0.30, 0.26),
    "wrist": (0.095, 0.13, 0.29),
    "forepaw": (0.09, 0.01, 0.32),
    "hip": (0.08, 0.50, -0.28),
    "knee": (0.10, 0.31, -0.18),
    "hock": (0.09, 0.15, -0.37),
    "hindpaw": (0.09, 0.01, -0.34),
    "eye": (0.045, 0.76, 0.52),
    "ear": (0.05, 0.86, 0.43),
}
PLACES = _CENTRE | _LEFT
"""Metres: towards the animal's left, above the floor, forwards."""

_TAIL: tuple[Point, Point, Point] = ((0.0, 0.58, -0.36), (0.0, 0.48, -0.46), (0.0, 0.36, -0.52))
"""Base, middle and tip."""

SPREAD: dict[str, float] = {
    **dict.fromkeys(("pelvis", "spine_low", "spine", "spine1", "spine2", "spine3", "chest", "thorax", "withers"), 10.0),
    "hip": 10.0,
    "clavicle": 15.0,
    "neck": 20.0,
    "shoulder": 20.0,
    "upperneck": 25.0,
    "head": 30.0,
    **dict.fromkeys(("headtop", "nose", "mouth", "chin", "eye", "ear"), 40.0),
    "knee": 25.0,
    "hock": 30.0,
    "hindpaw": 35.0,
    "elbow": 25.0,
    "wrist": 35.0,
    "forepaw": 45.0,
    "tail": 40.0,
}
"""Degrees by which the bone that leads to a place strays from the template: about a fifth of the arc of walking and
running limbs. A bone is known by whichever of its ends comes later here, farther from the trunk."""

_FRONT, _HIND = {"shoulder", "elbow", "wrist", "forepaw"}, {"hip", "knee", "hock", "hindpaw"}
_TAIL_ORDER = ("tailbase", "tail", "tail1", "tail2", "tail3", "tail4", "tail5", "tail6", "tailmid", "tailtip")


def quadruped_places(names: Sequence[str]) -> list[tuple[str, str, Point]] | None:
    """Return (side, place, position) of each joint of an animal on four legs, None if the names tell of none.

    There is a joint of a front and of a hind limb, and one that people have not: a tail, a paw, a hock. All names are
    known. A ``shoulder`` above an ``upperarm`` is the shoulder blade; the joints of a tail are spread over its length.

    >>> names = ["root", "l_hip", "l_stifle", "l_hock", "l_shoulder", "l_elbow", "tail1", "tail2"]
    >>> [place for _, place, _ in quadruped_places(names)]
    ['pelvis', 'hip', 'knee', 'hock', 'shoulder', 'elbow', 'tail', 'tail']
    """
    animal = [part_of(n, "animal") for n in names]
    parts = [own or part_of(n, "human") for n, own in zip(names, animal, strict=True)]
    sides = [side_of(n) for n in names]
    if all(own is None for own in animal) or any(part is None for part in parts):
        return None
    present = {part for part in parts if part is not None}
    tail = sorted({part for part in present if part in _TAIL_ORDER}, key=_TAIL_ORDER.index)
    out: list[tuple[str, str, Point]] = []
    for side, part in zip(sides, parts, strict=True):
        if part in _TAIL_ORDER:
            share = tail.index(part) / (len(tail) - 1) if len(tail) > 1 else float(part == "tailtip")
            out.append(("centre", "tail", _along_tail(share)))
            continue
        place = _resolve(part or "", side, present)
        if place not in (_CENTRE if side == "centre" else _LEFT):
            return None
        left, up, forward = PLACES[place]
        out.append((side, place, (-left if side == "right" else left, up, forward)))
    found = {place for _, place, _ in out}
    return out if found & _FRONT and found & _HIND else None


def _along_tail(share: float) -> Point:
    """The parabola through base, middle and tip."""
    base, middle, tip = ((1 - share) * (1 - 2 * share), 4 * share * (1 - share), share * (2 * share - 1))
    x, up, forward = (base * a + middle * b + tip * c for a, b, c in zip(*_TAIL, strict=True))
    return x, up, forward


def _resolve(part: str, side: str, present: set[str]) -> str:
    """The place that a word means beside its neighbours."""
    if side == "centre":
        return {
            "midhip": "pelvis",
            "spine0": "spine_low",
            "lowerback": "spine_low",
            "upperback": "spine2",
            "lowerneck": "neck",
            "neck1": "upperneck",
            "neck2": "head",
        }.get(part, part)
    return {
        "shoulder": "clavicle" if "arm" in present else "shoulder",
        "arm": "shoulder",
        "humerus": "elbow",  # bones named by their far end
        "radius": "wrist",
        "hand": "wrist" if present & {"fingers", "forepaw"} else "forepaw",
        "fingers": "forepaw",
        "hipjoint": "hip",
        "femur": "knee",
        "tibia": "hock",
        "ankle": "hock",
        "heel": "hock",
        "foot": "hock" if present & {"toes", "toebase", "hindpaw"} else "hindpaw",
        "toebase": "hindpaw",
        "toes": "hindpaw",
    }.get(part, part)
