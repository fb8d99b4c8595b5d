"""Which joints a detector's numbers are, where the file does not name them: told by how many there are."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray

from kcs_torch.errors import SkeletonError
from kcs_torch.io.registry import Options
from kcs_torch.skeleton import SKELETONS, Skeleton, get_skeleton, guess_skeleton, map_joints

__all__ = ["BY_COUNT", "choose_layout", "likeliest", "named_layout", "names_of"]

_CLEARLY = 0.7  # bones this much shorter, by another layout's order of joints, tell that it is the right one
_ENOUGH = 2000  # people, of whom the bones are measured

BY_COUNT: dict[int, tuple[str, ...]] = {
    15: ("mpi15",),
    16: ("mpii16",),
    17: ("coco17", "h36m17", "ap10k"),
    18: ("coco18",),
    21: ("hand21",),
    25: ("body25", "body25b"),
    26: ("halpe26",),
    33: ("mediapipe33",),
    68: ("halpe26",),
    133: ("wholebody63",),
    136: ("halpe26",),
}
"""Skeletons by the number of joints, the usual one first."""

_HANDS = "left out: skeleton='wholebody63' (--skeleton wholebody63) keeps the hands"
_LEFT_OUT = {68: f"hands are {_HANDS}", 133: "the face is left out", 136: f"face and hands are {_HANDS}"}


def _hands() -> list[str]:
    fingers = ("thumb", "forefinger", "middle_finger", "ring_finger", "pinky_finger")
    joints = [f"{finger}{i}" for finger in fingers for i in range(1, 5)]
    return [f"{side}_{joint}" for side in ("left", "right") for joint in ("hand_root", *joints)]


def names_of(skeleton: str, num_joints: int) -> tuple[str, ...]:
    """Names of a file's joints, of which a built-in skeleton may take only some.

    >>> len(names_of("wholebody63", 133)), names_of("wholebody63", 133)[17], names_of("wholebody63", 133)[132]
    (133, 'left_big_toe', 'right_pinky_finger4')
    """
    body = SKELETONS[skeleton]
    own = body.joints[: body.num_observed]
    face = [f"face-{i}" for i in range(68)]
    if num_joints == 133:  # COCO-WholeBody: body and feet, face, hands
        return (*own[:23], *face, *_hands())
    if num_joints in (68, 136):  # Halpe-FullBody, without or with the face
        return (*own, *(face if num_joints == 136 else ()), *_hands())
    return own


def choose_layout(
    people: Sequence[NDArray[np.float64]], options: Options, where: str, notes: list[str]
) -> tuple[str | None, tuple[str, ...] | None]:
    """Choose the skeleton that a number of joints means, and say in ``notes`` where that was a choice.

    Args:
        people: joints (N, 3) of each, as x, y, confidence.
        options: of the caller; a skeleton of N joints goes before any guess.
        where: for messages.
        notes: sentences for the user; added to.

    Returns:
        The name of a built-in skeleton and the names of all N joints; None and None where the caller's own fits.

    Raises:
        SkeletonError: no layout of so many joints is known.
    """
    count = len(people[0])
    if options.skeleton is not None and get_skeleton(options.skeleton).num_observed == count:
        return None, None
    if count not in BY_COUNT:
        known = ", ".join(f"{n} ({' or '.join(names)})" for n, names in BY_COUNT.items())
        fits = [s.name for s in SKELETONS.values() if s.num_observed == count]
        hint = " or ".join(map(repr, fits)) if fits else "a YAML file that names them and their bones"
        raise SkeletonError(
            f"{where}: expected a known number of joints, {known}, got {count}, which the file does not name: "
            f"give skeleton={hint} (--skeleton)"
        )
    usual, *others = BY_COUNT[count]
    if options.skeleton is None and count in _LEFT_OUT:
        notes.append(_LEFT_OUT[count])
    if not others:
        return usual, names_of(usual, count)
    best, length = likeliest((usual, *others), np.stack(people[:: max(len(people) // _ENOUGH, 1)]))
    if best != usual or any(_CLEARLY * length[name] < length[best] for name in others):
        why = f"the joints' places say {best}, not {usual}" if best != usual else f"taken as {best}"
        rest = " or ".join(name for name in (usual, *others) if name != best)
        notes.append(f"{count} joints without names: {why}; if they are {rest}, give --skeleton")
    return best, names_of(best, count)


def likeliest(layouts: Sequence[str], people: NDArray[np.float64]) -> tuple[str, dict[str, float]]:
    """The layout by whose bones detections (P, N, 3) are clearly smallest, else the first; and their sizes by each."""
    length = {name: _mean_bone(SKELETONS[name], people) for name in layouts}
    best, usual = min(layouts, key=lambda name: length[name]), layouts[0]
    return best if length[best] < _CLEARLY * length[usual] else usual, length


def named_layout(names: Sequence[str], notes: list[str]) -> str | None:
    """The built-in skeleton, the largest, that has nearly all of its joints from a file with these names.

    Args:
        names: the file's joints, in any spelling.
        notes: sentences for the user; added to.

    >>> names = [n.upper() for n in SKELETONS["coco17"].joints[:17]]
    >>> named_layout(names, []), named_layout(["left_ear", "tail"], [])
    ('coco17', None)
    """
    exact = guess_skeleton(names)
    if exact is not None:
        return exact.name
    best, most = None, 11  # fewer joints are no body
    for name, body in SKELETONS.items():
        wanted = body.joints[: body.num_observed]
        if most < len(wanted) <= len(names) and None not in map_joints(names, wanted):
            best, most = name, len(wanted)
    if best is not None:
        notes.append(f"{most} of the file's {len(names)} joints are by their names those of {best}")
    return best


def _mean_bone(skeleton: Skeleton, people: NDArray[np.float64]) -> float:
    """Mean length of the bones that all detections (P, N, 3) have by a skeleton: small if it is the right one."""
    data = torch.from_numpy(np.nan_to_num(people))
    points, weights = skeleton.complete(data[..., :2], data[..., 2])
    start, end = skeleton.bone_index().unbind(-1)
    weight = torch.minimum(weights[:, start], weights[:, end])
    length = (points[:, end] - points[:, start]).norm(dim=-1)
    return float((weight * length).sum() / weight.sum().clamp(min=1e-9)) if weight.any() else math.inf
