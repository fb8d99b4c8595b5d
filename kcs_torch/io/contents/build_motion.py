"""From the arrays of a file to :class:`Motion`, and from text to lines of numbers."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from kcs_torch.errors import FormatError
from kcs_torch.io.registry import MotionOptions, read_error
from kcs_torch.skeleton import Skeleton
from kcs_torch.types import Motion
from kcs_torch.types.size import METRES, short_unit

__all__ = ["build_motion", "distinct", "numbers", "read_lines"]

LIMIT = 2**28  # bytes of a text file


def build_motion(
    points: Tensor,
    options: MotionOptions,
    *,
    source: str,
    names: Sequence[str],
    edges: Any = None,
    skeleton: Skeleton | None = None,
    fps: float | None = None,
    units: str = "",
    up: str | None = None,
    likely_up: str | None = None,
    notes: Sequence[str] = (),
    confidence: Tensor | None = None,
) -> Motion:
    """Wrap what a reader found in a file, as the caller's ``options`` want it.

    Args:
        points: (T, N, 3) in the file's axes, NaN where unseen.
        options: of the caller; they go before what the file says, with a note, unless they are to fill in.
        source: the path.
        names: N joints or markers.
        edges: the file's (B, 2) bones.
        skeleton: the file's own skeleton.
        fps: the file's frames per second.
        units: the file's units.
        up: the file's axis that points up, where it says.
        likely_up: the axis that seems to, where it does not say and neither does the caller.
        notes: sentences for the user.
        confidence: (T, N), or None.

    Raises:
        ShapeError: the numbers are no motion.
        SkeletonError: the joints do not fit the skeleton that the caller wants.
    """
    remarks = list(notes)
    axis = _settled(up, options, "up", "{} points up: {} is taken to", remarks) or likely_up
    unit = short_unit(units)
    own = unit if unit in METRES or unit == "px" else None  # other words say nothing of the size
    unit = _settled(own, options, "units", "its unit is {}: its numbers are read as {}", remarks) or unit
    if axis is None:
        axis = "y"
        longest = _longest(points)
        if longest in (None, "y"):
            remarks.append(
                "y is taken to point up: give up=... (kcs-torch: --from-up) if it does not (results written as CSV "
                "have y down: -y)"
            )
        else:
            remarks.append(
                f"y is taken to point up, but the body is longest along {longest}: give up=... (kcs-torch: --from-up) "
                "if it stands"
            )
    return Motion.from_arrays(
        points,
        confidence,
        up=axis,
        skeleton=options.skeleton or skeleton,
        joint_names=names,
        edges=None if options.skeleton else edges,
        fps=options.fps if options.fps is not None else fps,
        units=unit,
        source=source,
        notes=remarks,
    )


def _settled(said: str | None, options: MotionOptions, option: str, how: str, notes: list[str]) -> str | None:
    """What holds of what a file says and what the caller does; a note tells ``how`` they contradict each other."""
    asked = getattr(options, option)
    if None in (said, asked) or said == asked:
        return said or asked
    told = f"the file says that {how}, "
    given = f"{option}={asked} (kcs-torch: --from-{option})"
    if option in options.fill_in:
        notes.append(f"{told.format(said, said)}and {given} is for a file that does not say")
        return said
    notes.append(f"{told.format(said, asked)}as {given} asks")
    return asked


def _longest(points: Tensor) -> str | None:
    """The axis along which the joints of a frame lie furthest apart, by far; None where none is."""
    seen = torch.isfinite(points).all(-1)
    some = points[seen.sum(1) > 2]
    if not len(some):
        return None
    mean = some.nanmean(1, keepdim=True)
    spread = (some - mean).square().nanmean(1).sqrt().nanmean(0)
    first, second = spread.sort(descending=True).values[:2].tolist()
    return "xyz"[int(spread.argmax())] if math.isfinite(first) and first > 1.5 * second else None


def distinct(names: Sequence[str]) -> list[str]:
    """The names, made to differ by numbers.

    >>> distinct(["hand", "hand", ""])
    ['hand', 'hand_2', 'point3']
    """
    out: list[str] = []
    taken: set[str] = set()
    for at, name in enumerate(names, 1):
        base = name or f"point{at}"
        name, number = base, 1
        while name in taken:
            number += 1
            name = f"{base}_{number}"
        taken.add(name)
        out.append(name)
    return out


def read_lines(path: Path, *, strip: bool = True) -> list[str]:
    """The lines of a text file, stripped unless told otherwise.

    Raises:
        FormatError: it cannot be read, or is larger than 256 MiB.
    """
    try:
        size = path.stat().st_size
        if size > LIMIT:
            raise FormatError(f"{path}: expected a text file of up to {LIMIT >> 20} MiB, got {size >> 20} MiB")
        lines = path.read_text(encoding="utf-8-sig", errors="replace").split("\n")
        return [line.strip() for line in lines] if strip else lines
    except OSError as error:
        raise read_error(path, error) from None


def numbers(words: Sequence[str], what: str) -> list[float]:
    """The words as numbers.

    Args:
        words: one number each.
        what: file and line, for the message.

    Raises:
        FormatError: one is no finite number.
    """
    try:
        values = [float(word) for word in words]
    except ValueError:
        values = [math.nan]
    if not all(map(math.isfinite, values)):
        wrong = next((w for w in words if not _finite(w)), "")
        raise FormatError(f"{what}: expected numbers, got {wrong[:40]!r}")
    return values


def _finite(word: str) -> bool:
    try:
        return math.isfinite(float(word))
    except ValueError:
        return False
