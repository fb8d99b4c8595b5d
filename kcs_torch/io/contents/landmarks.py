"""MediaPipe's landmarks, whatever file they come from: poses, hands, and persons of both."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from kcs_torch.errors import FormatError, counted
from kcs_torch.io.contents.people import Sighting
from kcs_torch.io.contents.shares import ASK, SIZE_HINT, are_shares
from kcs_torch.io.registry import Options
from kcs_torch.skeleton import SKELETONS, Skeleton
from kcs_torch.types.size import METRES, short_unit

__all__ = [
    "BODIES",
    "CONFIDENCES",
    "FACE_LEFT_OUT",
    "SIDES",
    "VISIBILITIES",
    "VISIBLE",
    "Landmarks",
    "by_visibility",
    "put_together",
    "settle",
]

BODIES = {33: "mediapipe33", 21: "hand21"}
SIDES = ("left", "right")
_GUESSES = ("pinky", "index", "thumb")
"""What a pose guesses of each hand."""
CONFIDENCES = ("confidence", "conf", "score", "likelihood", "probability", "prob", "c")
"""What a detector's own confidence in a joint is called."""
VISIBILITIES = ("visibility", "v", "presence")
"""What MediaPipe's guess at whether a joint is hidden is called."""
_HIDDEN = 0.3
"""Weight of a joint of visibility 0 within the image, beside 1 of one that is seen for certain. Against other
detections of the same video, joints of visibility below 0.5 are off by 2.5 times as much as the others, not by more:
a guess that is worth something."""
VISIBLE = (
    f"visibility v tells what is hidden, not how well it is placed: it counts as confidence {_HIDDEN:g} + "
    f"{1 - _HIDDEN:g} v"
)
"""What to say of confidences that are made of visibilities."""
FACE_LEFT_OUT = "the face is left out"
"""What to say of the landmarks of a face."""


@dataclass
class Landmarks:
    """What a file holds: people by the number of the frame, and what it says of the video."""

    frames: dict[int, list[Sighting]] = field(default_factory=dict)
    times: dict[int, float] = field(default_factory=dict)  # of frames; NaN where unknown
    names: tuple[str, ...] | None = None  # None: the usual 33 or 21
    seen: set[str] = field(default_factory=set)  # what the joints' third number is called
    size: tuple[int, int] | None = None  # of the image
    fps: float | None = None
    unit: str = ""  # of the coordinates, where the file tells
    who: str = ""  # the column of a table that tells people apart
    notes: list[str] = field(default_factory=list)

    @property
    def units(self) -> str:
        """Of tracks: the file's unit of length, pixels where it tells none."""
        unit = short_unit(self.unit)
        return unit if unit in METRES else "px"


def put_together(
    out: Landmarks,
    poses: dict[int, list[Sighting]],
    hands: dict[int, list[Sighting]],
    body: Skeleton | None = None,
) -> None:
    """Give each frame its people: poses where there are any, with the hands of one person; hands otherwise.

    One person's hands are told by their sides, at most one of each in a frame. A hand has no visibilities.

    Args:
        out: gets frames and, of a person with hands, names.
        poses: (33, 3) of each frame.
        hands: (21, 3) of each frame, by whatever is known of their side.
        body: the caller's skeleton: of 33 joints it takes poses alone, of 21 hands.
    """
    count = 0 if body is None else body.num_observed
    out.frames = poses
    if not any(hands.values()) or (count == 33 and any(poses.values())):
        return
    if not any(poses.values()) or count == 21:
        out.frames = hands
        return
    shown = sum(map(bool, hands.values()))
    hands = {number: people if _sided(people) else [] for number, people in hands.items()}
    odd = shown - sum(map(bool, hands.values()))
    if any(len(people) > 1 for people in poses.values()) or 2 * odd > shown:
        out.notes.append("the hands are left out: only those of one person are read, where the file tells their sides")
        return
    if odd:
        out.notes.append(f"hands of {counted(odd, 'frame')} are left out, as their sides are unknown, or the same")
    sides = [side for side in SIDES if any(hand.track == side for people in hands.values() for hand in people)]
    names = SKELETONS[BODIES[33]].joints[:33]
    wrists = [names.index(f"{side}_wrist") for side in SIDES]
    if _swapped(poses, hands, wrists):
        hands = {
            n: [hand._replace(track=SIDES[hand.track == "left"]) for hand in people] for n, people in hands.items()
        }
        sides = [side for side in SIDES if SIDES[side == "left"] in sides]
        out.notes.append("hands that are called left lie at the right wrist, so left and right hands are swapped")
    guesses = [f"{side}_{finger}" for side in sides for finger in _GUESSES]
    kept = [k for k, name in enumerate(names) if name not in guesses]
    joints = SKELETONS[BODIES[21]].joints
    out.names = (*(names[k] for k in kept), *(f"{side}_hand_{joint}" for side in sides for joint in joints))
    sure = 1.0 if out.seen & set(CONFIDENCES) else math.nan
    for number, people in poses.items():
        parts = [people[0].joints[kept] if people else np.full((len(kept), 3), math.nan)]
        for side in sides:
            hand = next((h.joints[:, :2] for h in hands[number] if h.track == side), np.full((21, 2), math.nan))
            parts.append(np.column_stack([hand, np.full(21, sure)]))
        out.frames[number] = [Sighting(np.concatenate(parts))] if people or hands[number] else []
    out.notes.append(
        f"hands are read beside the pose, whose own guesses {', '.join(guesses)} are left out "
        f"(skeleton='{BODIES[33]}', --skeleton {BODIES[33]}, reads the pose alone)"
    )


def _sided(hands: Sequence[Sighting]) -> bool:
    """Whether each of a frame's hands has a side of its own."""
    return len({hand.track for hand in hands} & {*SIDES}) == len(hands)


def _swapped(poses: dict[int, list[Sighting]], hands: dict[int, list[Sighting]], wrists: Sequence[int]) -> bool:
    """Whether hands lie at the other side's wrist of the pose, most of the time: their sides may be a mirror's."""
    away = []
    for number, people in hands.items():
        for hand in people if poses[number] else ():
            left, right = np.linalg.norm(poses[number][0].joints[wrists, :2] - hand.joints[0, :2], axis=-1)
            away.append(left - right if hand.track == "left" else right - left)
    return float(np.nanmedian([0.0, *away])) > 0 if away else False


def by_visibility(visibility: NDArray[np.float64]) -> NDArray[np.float64]:
    """Weights of joints within the image by MediaPipe's guesses, 0 to 1, at whether they are visible."""
    return _HIDDEN + (1 - _HIDDEN) * visibility


def settle(found: Landmarks, path: Path, options: Options, *, shares: bool) -> None:
    """Turn shares of the image into pixels, and visibilities into weights; confidences are weights as they are.

    A joint that is hidden is guessed less well, but is not unseen, unless it is out of the image. Where a file has
    confidences, a joint without one is unseen.

    Args:
        found: changed in place.
        path: for messages.
        options: of the caller.
        shares: whether such files hold shares of the image as a rule, so that its size has to be known.

    Raises:
        FormatError: there are no landmarks, or the image's size is needed.
    """
    people = [s.joints for frame in found.frames.values() for s in frame]
    everything = np.concatenate(people or [np.zeros((0, 3))])
    if not np.isfinite(everything[:, :2]).any():
        raise FormatError(f"{path}: expected landmarks in at least one of {len(found.frames)} frames, got none")
    pixels = found.units == "px"
    small = pixels and are_shares(everything[:, :2])
    size = options.size_of(found.size)
    if size is None and small and shares:
        raise FormatError(
            f"{path}: its coordinates are shares of the image, which needs the video's size: give {SIZE_HINT}; if they "
            "are metres, say, in a table, name its format: csv"
        )
    if size is None and pixels and (small or shares):
        found.notes.append(ASK if small else "the coordinates are pixels already")
    small = small and size is not None
    visible = not found.seen & set(CONFIDENCES)
    seen = everything[:, 2]
    known = visible and bool((seen[np.isfinite(seen)] > 0).any())  # hands have 0 everywhere
    if known:
        found.notes.append(f"{VISIBLE}, and outside the image as v")
    for joints in people:
        if visible:
            outside = small & ((joints[:, :2] < 0) | (joints[:, :2] > 1)).any(-1)
            weight = np.where(np.isnan(joints[:, 2]), 1.0, joints[:, 2].clip(0, 1)) if known else np.ones(len(joints))
            joints[:, 2] = np.where(outside, weight, by_visibility(weight))
        if small and size is not None:
            joints[:, :2] *= size
