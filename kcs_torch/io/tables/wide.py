"""Tables of text with a row a frame and columns for each joint: ``nose_x, nose_y, nose_confidence, ...``."""

from __future__ import annotations

import csv
import math
import re
from collections import Counter
from collections.abc import Callable, Hashable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from kcs_torch.errors import FormatError
from kcs_torch.io.containers.jsonfile import as_frame_number, as_text
from kcs_torch.io.contents.frames import as_track_id
from kcs_torch.io.contents.landmarks import CONFIDENCES, VISIBILITIES, Landmarks
from kcs_torch.io.contents.people import Sighting
from kcs_torch.io.contents.times import frames_of_times, rate_of_times
from kcs_torch.io.registry import brief, read_error
from kcs_torch.io.tables.header import Columns, Header, Layout, delimiter, first_line
from kcs_torch.types.intake import FARTHEST

__all__ = ["Row", "as_float", "as_person", "as_value", "no_numbers", "opened", "place_rows", "read_wide"]

_LIMIT = 2**30  # bytes of a file
_HEAD = 2**20  # characters of the first line, at most
_MISSING = ("", "na", "n/a", "#n/a", "<na>", "null", "none")
_NAMELESS = re.compile(r"(?:Unnamed: [0-9]+)?\Z")


class Row(NamedTuple):
    """One person in one frame, as a table has it.

    Attributes:
        where: file and row, for messages.
        number: of the frame; None where the table has none.
        time: of the frame; NaN where the table has none.
        who: it is; None where a column that tells is empty.
        joints: (N, 3).
    """

    where: str
    number: int | None
    time: float
    who: Hashable
    joints: NDArray[np.float64]


def as_float(cell: str) -> float:
    """The number in a cell, NaN if it is missing: R writes NA, SQL NULL. A ValueError if it is none.

    >>> as_float("0"), as_float(" N/A ")
    (0.0, nan)
    """
    return math.nan if cell.strip().lower() in _MISSING else float(cell)


def no_numbers(columns: Iterable[str], cells: Iterable[str]) -> str:
    """Which of these columns' cells is the first that holds no number, for messages.

    >>> print(no_numbers(["'x'", "'y'"], ["0", "1,5"]))
    expected numbers, got '1,5' (write decimals with a point) for 'y'
    """
    for column, cell in zip(columns, cells, strict=True):
        try:
            as_float(cell)
        except ValueError:
            return f"expected numbers, {_not_a_number(cell)} for {column}"
    return "expected numbers"


def _not_a_number(cell: str) -> str:
    """What a cell says that should hold a number, for messages, with a hint where decimals have a comma."""
    hint = " (write decimals with a point)" if re.fullmatch(r"-?[0-9]+,[0-9]+", cell.strip()) else ""
    return f"got '{as_text(cell)}'{hint}"


@contextmanager
def opened(path: Path) -> Iterator[tuple[str, Iterator[list[str]]]]:
    """Open a table: its first line, and the cells of each row that follows.

    Raises:
        FormatError: it is too large, or cannot be read.
    """
    try:
        if path.stat().st_size > _LIMIT:
            raise FormatError(f"{path}: expected 1 GiB of CSV at most: split the file")
        with path.open(newline="", encoding="utf-8-sig", errors="replace") as file:
            line = first_line(file.read(_HEAD))
            file.seek(0)
            for _ in range(line.count("\n") + 1):
                file.readline(_HEAD)
            yield line, csv.reader(file, delimiter=delimiter(line))
    except OSError as error:
        raise read_error(path, error) from None
    except csv.Error as error:
        raise FormatError(f"{path}: expected a CSV table, got text that does not parse: {error}") from None


def read_wide(
    path: Path,
    arrange: Callable[[Columns, list[str]], Layout] | None = None,
    *,
    depth: bool = False,
) -> Landmarks:
    """Read a table with a row a frame, or a row a person where a column says who it is.

    Frames are placed by a column of numbers, else by one of times; the rate follows from times.

    Args:
        path: the table.
        arrange: gives the joints' names and columns in their order, and adds to the notes; as in the table if None.
        depth: whether to read z of each joint rather than its confidence or visibility.

    Raises:
        FormatError: it cannot be read, or is no such table; the message names row and column.
    """
    out = Landmarks()
    rows: list[Row] = []
    with opened(path) as (line, cells_of):
        header = Header.of(line)
        if not header.joints:
            raise FormatError(f"{path}: expected columns such as nose_x, nose_y, got '{as_text(line.strip())}'")
        if header.twice:
            raise FormatError(f"{path}: expected every column once, got '{as_text(header.twice)}' again")
        joints = header.joints
        out.names, marks = arrange(joints, out.notes) if arrange else (tuple(joints), list(joints.values()))
        columns = _triples(marks, out, depth)
        blank = (math.nan, math.nan, 1.0 if out.seen & set(CONFIDENCES) else math.nan)  # where there is no column
        if header.halves:
            one = len(header.halves) == 1
            said = "a column is missing, so its joint is" if one else "columns are missing, so their joints are"
            out.notes.append(f"{said} left out: {brief(', '.join(header.halves))}")
        if left := header.left_out(i for triple in columns for i in triple):
            out.notes.append(f"columns of joints that are left out: {brief(', '.join(left))}")
        others = {i: header.cells[i] for i in header.others if not _NAMELESS.match(header.cells[i])}
        placed = (header.number, header.time, header.who) != (None, None, None)
        last = 0
        for i, cells in enumerate(cells_of, 2):
            if any(cells) or (not placed and len(cells) == len(header.cells)):  # a blank row is a frame without anybody
                rows.append(_row(cells, header, columns, blank, f"{path}: row {i}"))
            if any(cells):
                last = len(rows)
                for k in header.others:  # one without a name most often counts rows, as pandas writes it
                    if k not in others and cells[k].strip() not in ("", str(len(rows) - 1), str(len(rows))):
                        others[k] = "one without a name (call it 'frame' if it numbers the frames)"
        if others:
            out.notes.append(f"other columns are left out: {brief(', '.join(others.values()))}")
        del rows[last:]
    out.unit = header.unit
    out.who = "" if header.who is None else header.cells[header.who]
    place_rows(rows, header.time[1] if header.time else "", out)
    return out


def place_rows(rows: Sequence[Row], unit: str, out: Landmarks) -> None:
    """Put the people of a table into their frames, and find the rate.

    Args:
        rows: each person in each frame.
        unit: of times, where the table tells.
        out: gets frames, times and rate, and what was assumed.

    Raises:
        FormatError: a person is in a frame twice.
    """
    numbers = _numbers(rows, out.notes)
    if len(rows) > 1 and len({row.who for row in rows}) == len(set(numbers)) == len(rows):  # of rows, not of people
        rows = [row._replace(who=0) for row in rows]
    for row, number in zip(rows, numbers, strict=True):
        people = out.frames.setdefault(number, [])
        if row.who is not None and any(s.track == row.who for s in people):
            again = f"frame {number}" if row.number is not None else f"time {row.time:g}"
            whom = f" of person {row.who}" if row.who else ""  # or it is a file of one
            hint = "" if whom else ", or a column 'person'"
            raise FormatError(f"{row.where}: expected every frame{whom} once{hint}, got {again} again")
        people.append(Sighting(row.joints, row.who))
        out.times.setdefault(number, row.time)
    out.fps = rate_of_times(out.times, unit, out.notes)


def _triples(marks: Sequence[dict[str, int]], out: Landmarks, depth: bool) -> list[tuple[int, int, int]]:
    """The columns of x, y and a third number of each joint; -1 where there is none."""
    third: Sequence[str] = ("z",)
    if not depth:
        third = next((kind for kind in (CONFIDENCES, VISIBILITIES) if any(set(kind) & set(m) for m in marks)), ())
    keys = [next((key for key in third if key in mark), "") for mark in marks]
    out.seen |= set(keys) - {"", "z"}
    return [(m.get("x", -1), m.get("y", -1), m.get(key, -1)) for m, key in zip(marks, keys, strict=True)]


def _row(
    cells: Sequence[str],
    header: Header,
    columns: Sequence[tuple[int, int, int]],
    blank: tuple[float, float, float],
    where: str,
) -> Row:
    if len(cells) != len(header.cells):
        raise FormatError(f"{where}: expected {len(header.cells)} values as in the first row, got {len(cells)}")
    value = lambda i: as_value(cells[i], where, header.cells[i])  # noqa: E731
    number, time = None, math.nan
    if header.number is not None:
        number = as_frame_number(value(header.number))
        if number is None:
            name, got = header.cells[header.number], as_text(cells[header.number])
            raise FormatError(f"{where}: '{name}': expected a whole number, got {got}")
    if header.time is not None:
        time = value(header.time[0])
    who = 0 if header.who is None else as_person(cells[header.who])  # one row a frame is one body
    joints = [[value(c) if c >= 0 else none for c, none in zip(three, blank, strict=True)] for three in columns]
    return Row(where, number, time, who, np.array(joints))


def as_person(cell: str) -> Hashable:
    """Who a cell says that somebody is; None where it says nothing."""
    return None if cell.strip().lower() in (*_MISSING, "nan") else as_track_id(cell)


def as_value(cell: str, where: str, name: str) -> float:
    """The number in a cell, NaN if it is missing; an error with file, row and column if it is none, or too large."""
    try:
        value = as_float(cell)
    except ValueError:
        raise FormatError(f"{where}: '{name}': expected a number, {_not_a_number(cell)}") from None
    if not (math.isnan(value) or abs(value) <= FARTHEST):
        raise FormatError(f"{where}: '{name}': expected a coordinate or a visibility, got {value:.3g}")
    return value


def _numbers(rows: Sequence[Row], notes: list[str]) -> list[int]:
    """The frame of each row: as it says, else by its time, else in their order."""
    if rows and rows[0].number is not None:
        return [row.number or 0 for row in rows]
    if any(math.isnan(row.time) for row in rows):
        return _counted(rows, notes)
    frame = frames_of_times((row.time for row in rows), notes)
    return [frame[row.time] for row in rows]


def _counted(rows: Sequence[Row], notes: list[str]) -> list[int]:
    """The frame of each row by the order of the rows: of those of each person, where there are several."""
    so_far = Counter[Hashable]()
    if not 1 < len({row.who for row in rows}) < len(rows):
        return list(range(len(rows)))
    notes.append("nothing numbers the frames: each person's rows are counted from 0 (call a column 'frame' that does)")
    frames = []
    for row in rows:
        frames.append(so_far[row.who])
        so_far[row.who] += 1
    return frames
