"""From what trackers of animals write to :class:`Tracks`: frames by number, and one set of tracks an animal."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from kcs_torch.errors import FormatError, counted, listed
from kcs_torch.io.containers.jsonfile import MOST_PIXELS
from kcs_torch.io.contents.build_tracks import OVERSHOOT, build_tracks, nothing_seen
from kcs_torch.io.contents.shares import are_shares, in_pixels
from kcs_torch.io.folders import frame_numbers
from kcs_torch.io.registry import Options, brief
from kcs_torch.types import Tracks

__all__ = ["LIMIT", "Animal", "build_animals", "frames_of", "refuse_3d"]

LIMIT = 2**28  # numbers of all animals in all frames
_FRAGMENT = 0.1  # share of the frames, below which an animal that is seen is a piece of somebody's track
_SUFFIX = re.compile(r"\.[A-Za-z][A-Za-z0-9]*\Z")
_NUMBER = re.compile(r"([0-9]+)\Z")


class Animal(NamedTuple):
    """One animal as a file has it.

    Attributes:
        name: what the file calls it; empty where there is only one.
        joints: names.
        points: (T, N, 2), NaN where unseen.
        confidence: (T, N), or None.
    """

    name: str
    joints: Sequence[str]
    points: NDArray[np.float64]
    confidence: NDArray[np.float64] | None


def frames_of(rows: Sequence[tuple[str | float, ...]], path: Path, notes: list[str]) -> tuple[list[int], list[int]]:
    """Find the order of a table's rows, and the frame of each, from what they are called.

    Args:
        rows: a frame number, the path of an image (``img0007.png`` is frame 7), or its folders and name.
        path: for messages.
        notes: sentences for the user; added to.

    Returns:
        The indices of the rows in the order of their frames, and these, counted from 0.

    Raises:
        FormatError: the rows are images of several videos.
    """
    numbers: list[int | None] = []
    videos: dict[str, None] = {}
    for row in rows:
        if len(row) == 1 and (value := _whole(row[0])) is not None:
            numbers.append(value)
            continue
        *folders, name = re.split(r"[/\\]", "/".join(map(str, row)))
        videos["/".join(folders)] = None
        found = _NUMBER.search(_SUFFIX.sub("", name))
        numbers.append(int(found[1][-18:]) if found else None)
    if len(videos) > 1:
        shown = listed(map(brief, videos), 4)
        raise FormatError(f"{path}: expected the frames of one video, got rows of {len(videos)} ({shown}): split it")
    if videos:
        notes.append("rows are placed by the numbers in the images' names")
    order = list(range(len(rows)))
    if None not in numbers:
        order.sort(key=lambda i: numbers[i] or 0)
    ordered = [numbers[i] for i in order]
    frames, _ = frame_numbers(ordered, notes, names="rows", one="the file's frame", whole="row")
    return order, frames


def _whole(value: str | float) -> int | None:
    """A frame number, however it is written."""
    try:
        number = float(value)
    except ValueError:
        return None
    return int(number) if number.is_integer() and 0 <= number < 1e15 else None


def build_animals(
    animals: Sequence[Animal],
    options: Options,
    path: Path,
    notes: Sequence[str],
    *,
    edges: Any = None,
    size: Any = None,
) -> list[Tracks]:
    """Wrap the animals of a file; those that say nothing are left out, which the notes tell.

    Raises:
        FormatError: a coordinate is no pixel, or no animal has two joints.
        ShapeError: nothing is seen, or the numbers are no tracks.
        SkeletonError: the joints do not fit the skeleton that the caller wants.
    """
    shared = list(notes)
    animals = _without_padding(animals, shared)
    whole = [a for a in animals if len(a.joints) >= 2]
    if not whole:
        raise FormatError(f"{path}: expected an animal with at least 2 joints, got none")
    if len(whole) < len(animals):
        alone = ", ".join(brief(a.name) for a in animals if len(a.joints) < 2)
        shared.append(f"left out, as one joint alone is no body: {alone}")
    for animal in whole:
        _check(animal, path)
    if are_shares(np.concatenate([a.points.ravel() for a in whole])):
        whole = [a._replace(points=in_pixels(a.points, options.size_of(size), shared)) for a in whole]
    seen = [a for a in whole if _seen(a, options.least).any()]
    if not seen:
        faint = [a.confidence[_seen(a, 0.0)] for a in whole if a.confidence is not None]
        raise nothing_seen(str(path), options.least, max((float(c.max()) for c in faint if len(c)), default=0.0))
    if len(seen) < len(whole):
        missing = [a.name for a in whole if not any(a is s for s in seen)]
        shown = listed(map(brief, missing), 5)
        shared.append(
            f"{len(missing)} of {len(whole)} animals never reach the confidence threshold ({shown}): left out"
        )
    shares = [float(_seen(a, options.least).any(1).mean()) for a in seen]
    if len(seen) > 2 and float(np.median(shares)) < _FRAGMENT:
        shared.append(f"most of the {len(seen)} animals are seen in few frames: pieces of tracks, which are not joined")
    people = []
    for animal in seen:
        own = [f"the file calls this animal '{brief(animal.name)}'"] if animal.name else []
        confidence = None if animal.confidence is None else _within_one(animal.confidence, own)
        tracks = build_tracks(
            animal.points,
            confidence,
            options,
            source=str(path),
            names=animal.joints,
            edges=edges,
            notes=[*shared, *own],
            size=size,
        )
        people.append(tracks)
    return people


def _without_padding(animals: Sequence[Animal], notes: list[str]) -> list[Animal]:
    """Joints of negative confidence as unseen ones: with -1 trackers fill places for animals and joints not there."""
    lost = [None if a.confidence is None else np.less(a.confidence, 0) for a in animals]
    count = sum(int(where.sum()) for where in lost if where is not None)
    if not count:
        return list(animals)
    notes.append(f"{counted(count, 'joint')} of negative confidence: taken as unseen")
    return [
        a if where is None or a.confidence is None else a._replace(confidence=np.where(where, 0.0, a.confidence))
        for a, where in zip(animals, lost, strict=True)
    ]


def _seen(animal: Animal, threshold: float) -> NDArray[np.bool_]:
    """(T, N) where :class:`Tracks` will count a joint as seen."""
    seen: NDArray[np.bool_] = np.logical_and(*np.moveaxis(np.isfinite(animal.points), -1, 0))
    if animal.confidence is not None:
        with np.errstate(invalid="ignore"):
            seen &= animal.confidence >= max(threshold, 1e-12)
    return seen


def _check(animal: Animal, path: Path) -> None:
    """Refuse coordinates that are no pixels."""
    with np.errstate(invalid="ignore"):
        far = np.argwhere(np.abs(animal.points) > MOST_PIXELS)
    if len(far):
        t, n, axis = far[0].tolist()
        whose = f" of '{brief(animal.name)}'" if animal.name else ""
        joint, value = brief(animal.joints[n]), animal.points[t, n, axis]
        raise FormatError(f"{path}: frame {t}, joint '{joint}'{whose}: expected pixels, got {value:.3g}")


def _within_one(confidence: NDArray[np.float64], notes: list[str]) -> NDArray[np.float64]:
    """Confidences a little above 1 are 1."""
    largest = float(np.nanmax(confidence, initial=0))
    if 1 < largest <= OVERSHOOT:
        notes.append(f"confidences above 1 (up to {largest:.3g}) are taken as 1")
        return confidence.clip(max=1)
    return confidence


def refuse_3d(path: Path) -> FormatError:
    """The error for 3D motion where tracks are wanted."""
    return FormatError(f"{path}: expected 2D tracks, got 3D motion (x, y, z): kcs_torch.load_motion reads it")
