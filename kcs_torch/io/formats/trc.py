"""TRC (Track Row Column) of motion capture: markers as a table. Read by OpenSim, Blender add-ons and Pose2Sim.

The first two header lines name the columns of the third; the fourth names the markers, three columns each. Cells are
separated by tabs, in files of some programs by commas. A marker that is unseen has empty cells. The file does not say
which axis points up.
"""

from __future__ import annotations

import itertools
import math
import re
from array import array
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path

import numpy as np
import torch

from kcs_torch.errors import FormatError, counted
from kcs_torch.io.contents.build_motion import build_motion, distinct, numbers, read_lines
from kcs_torch.io.contents.times import rate_of_times
from kcs_torch.io.folders import frame_numbers
from kcs_torch.io.registry import MotionOptions, MotionReader, Probe, Saving, Writer
from kcs_torch.types import Motion
from kcs_torch.types.arrays import as_array
from kcs_torch.types.axes import from_y_up
from kcs_torch.types.size import short_unit

__all__ = ["MOTION_READERS", "WRITERS"]

_OFF, _ROUNDED = 0.02, 0.002  # by which a rate and times are apart at most: a share, and seconds, as times are rounded
_DIGITS = 16  # from which on a number is none of a frame
_UNSEEN = ("", "nan", "NaN", "NAN", "-nan", "nan(ind)")


def recognises(probe: Probe) -> bool:
    """Tell by the first word."""
    return probe.head.removeprefix(b"\xef\xbb\xbf").startswith(b"PathFileType")


def read(path: Path, options: MotionOptions) -> Motion:
    """Read the markers."""
    lines = read_lines(path, strip=False)  # tabs mark empty cells
    split = "\t" if "\t" in lines[0] else ","
    cells_of = lambda line: [cell.strip() for cell in line.split(split)]  # noqa: E731
    rows = [cells_of(line) for line in lines[:8]]
    header = dict(zip(rows[1], rows[2], strict=False)) if len(rows) > 2 else {}
    at = next((i for i, row in enumerate(rows) if row[0].startswith("Frame#")), None)
    if at is None:
        raise FormatError(f"{path}: expected a line that begins with Frame# and names the markers, got none")
    names = rows[at][2::3]
    while names and not names[-1]:
        names.pop()
    if not names:
        raise FormatError(f"{path}: line {at + 1}: expected names of markers, got none")
    notes: list[str] = []
    frames, numbered, told_at = _rows(map(cells_of, lines[at + 1 :]), at + 2, len(names), path, notes)
    places, step = _places(numbered, path, notes)
    times = {places[i]: time for i, time in told_at.items()}
    told = header.get("NumFrames", "")
    if told.isdigit() and int(told) != len(frames):
        notes.append(f"the header tells {told} frames, the file has {len(frames)}")
    real = rate_of_times(times, "s", []) if len(times) == len(frames) else None
    told_rate = _rate(header.get("DataRate", ""), path)
    fps = told_rate / step if told_rate else real
    if fps and real and not _alike(real, fps, len(frames)):
        if told_rate and _alike(real, told_rate, len(frames)):
            fps = told_rate  # of the rows: their numbers count other frames
        else:
            notes.append(f"the header tells {fps:g} frames a second, the rows' times {real:g}: the header is believed")
    points = np.full((max(places) + 1, 3 * len(names)), np.nan)
    points[places] = np.array(frames, np.float64)
    return build_motion(
        torch.from_numpy(points).reshape(len(points), len(names), 3),
        options,
        source=str(path),
        names=distinct(names),
        fps=fps,
        units=short_unit(header.get("Units", "")),
        notes=notes,
    )


def _rows(
    rows: Iterable[list[str]], first: int, markers: int, path: Path, notes: list[str]
) -> tuple[list[array[float]], list[str], dict[int, float]]:
    """Numbers of each frame, NaN where unseen; what stands as its number; and times of those frames that have one.

    Args:
        rows: cells of the lines below the names.
        first: number of the first of them.
        markers: how many there are.
        path: of the file.
        notes: gets a sentence on rows that are too short.
    """
    frames: list[array[float]] = []
    numbered: list[str] = []
    told_at: dict[int, float] = {}
    width, short = 3 * markers, 0
    for number, row in enumerate(rows, first):
        if not any(row) or not row[0]:  # the line below the names holds X1, Y1, Z1, ...; an empty one may follow
            continue
        cells = row[2:]
        if any(cells[width:]):
            raise FormatError(f"{path}: line {number}: expected {width} numbers of {markers} markers, got {len(cells)}")
        short += len(cells) < width - 2  # of an unseen last marker there may be but one cell
        cells = cells[:width] + [""] * (width - len(cells))
        filled = iter(numbers([c for c in cells if c not in _UNSEEN], f"{path}: line {number}"))
        with suppress(ValueError, IndexError):
            told_at[len(frames)] = float(row[1])
        numbered.append(row[0])
        frames.append(array("d", [math.nan if c in _UNSEEN else next(filled) for c in cells]))
    if not frames:
        raise FormatError(f"{path}: expected a line a frame below the names of the markers, got none")
    if short:
        notes.append(
            f"{counted(short, 'row')} end{'' if short > 1 else 's'} before the last marker: the rest is unseen"
        )
    return frames, numbered, told_at


def _places(numbered: list[str], path: Path, notes: list[str]) -> tuple[list[int], int]:
    """Which frame each row is, by its number, and the step in which these count the frames.

    Rows that hold no whole numbers are taken in their order.
    """
    if not all(text.isdecimal() and len(text) < _DIGITS for text in numbered):
        return list(range(len(numbered))), 1
    numbers = [int(text) for text in numbered]
    order = sorted(range(len(numbers)), key=numbers.__getitem__)
    again = next((numbers[b] for a, b in itertools.pairwise(order) if numbers[a] == numbers[b]), None)
    if again is not None:
        raise FormatError(f"{path}: Frame#: expected every frame once, got frame {again} again")
    if order != sorted(order):
        notes.append("the rows are put in the order of their numbers, Frame#")
    ordered = [numbers[i] for i in order]
    frames, step = frame_numbers(ordered, notes, names="rows", one="the file's frame", whole="row")
    return [frame for _, frame in sorted(zip(order, frames, strict=True))], step


def _alike(real: float, told: float, frames: int) -> bool:
    """Whether the rate of so many frames by their times, which are rounded, is the one that is told."""
    return abs(1 / real - 1 / told) <= _OFF / told + _ROUNDED / frames


def _rate(text: str, path: Path) -> float | None:
    value = numbers([text], f"{path}: line 3: DataRate")[0] if text else 0.0
    return value if value > 0 else None


def write(motion: Motion, path: Path, saving: Saving) -> None:
    """Write the joints as markers; numbers have 9 significant digits."""
    points, seen = as_array(from_y_up(motion.points, saving.up)), as_array(motion.seen) > 0
    rate, count = saving.rate(motion), motion.num_frames
    names = distinct([re.sub(r"\s+", "_", joint) for joint in motion.skeleton.joints])
    saving.told_names(motion.skeleton.joints, names)
    facts = (f"{rate:.9g}", f"{rate:.9g}", count, len(names), motion.units, f"{rate:.9g}", 1, count)
    keys = [
        "DataRate",
        "CameraRate",
        "NumFrames",
        "NumMarkers",
        "Units",
        "OrigDataRate",
        "OrigDataStartFrame",
        "OrigNumFrames",
    ]
    axes = [f"{axis}{number}" for number in range(1, len(names) + 1) for axis in "XYZ"]
    with path.open("w", encoding="utf-8", errors="replace", newline="\n") as file:
        line = lambda *cells: file.write("\t".join(map(str, cells)) + "\n")  # noqa: E731
        line("PathFileType", 4, "(X/Y/Z)", re.sub(r"\s+", "_", saving.name))
        line(*keys)
        line(*facts)
        line("Frame#", "Time", *(cell for name in names for cell in (name, "", "")))
        line("", "", *axes)
        line()
        for frame, (row, there) in enumerate(zip(points.tolist(), seen.tolist(), strict=True)):
            cells = [f"{v:.9g}" if known else "" for joint, known in zip(row, there, strict=True) for v in joint]
            line(frame + 1, f"{frame / rate:.6f}", *cells)


MOTION_READERS = (MotionReader("trc", "TRC of motion capture: markers; y up unless told", recognises, read),)
WRITERS = (
    Writer(".trc", "TRC: markers in metres, y up, for OpenSim and others", None, write, unit="m", names_unit=True),
)
