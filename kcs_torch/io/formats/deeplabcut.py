"""DeepLabCut CSV and HDF5, labels and predictions, one animal or several; Lightning Pose writes the same CSV.

Columns are named by scorer, individuals (where there are several), bodyparts and coords: x, y, likelihood.
"""

from __future__ import annotations

import csv
import re
from array import array
from collections.abc import Iterator, Sequence
from operator import itemgetter
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from kcs_torch.errors import FormatError
from kcs_torch.io.containers.hdf5_pandas import Table, has_column, pandas_group, read_pandas
from kcs_torch.io.contents.animals import LIMIT, Animal, build_animals, frames_of, refuse_3d
from kcs_torch.io.contents.build_motion import build_motion
from kcs_torch.io.registry import MotionOptions, MotionReader, Options, Probe, Reader, brief
from kcs_torch.io.tables.bounded import bounded_rows
from kcs_torch.io.tables.wide import as_float, no_numbers
from kcs_torch.types import Motion, Tracks

__all__ = ["MOTION_READERS", "READERS"]

_LEVELS = (("scorer", "bodyparts", "coords"), ("scorer", "individuals", "bodyparts", "coords"))
_BOM = b"\xef\xbb\xbf"
_HEAD = 2**22  # bytes that the header has at most


def recognises(probe: Probe) -> bool:
    """Tell the CSV by the first cells of its header, the HDF5 by a pandas table whose columns are body parts."""
    if probe.hdf5 is not None:
        return pandas_group(probe.hdf5) is not None
    lines = _first_lines(probe)
    return (
        len(lines) > 2
        and lines[0][:6] == b"scorer"
        and lines[0][6:7] in (b",", b";", b"\t")
        and lines[1].startswith((b"individuals", b"bodyparts"))
    )


def recognises_motion(probe: Probe) -> bool:
    """Tell 3D motion by a coordinate z."""
    if not recognises(probe):
        return False
    if probe.hdf5 is not None:
        return has_column(probe.path, "z")
    return any(line.startswith(b"coords") and b"z" in re.split(rb"[,;\t\r]", line) for line in _first_lines(probe)[2:4])


def _first_lines(probe: Probe) -> list[bytes]:
    head = probe.head.removeprefix(_BOM)
    if head[:8].replace(b'"', b"").startswith(b"scorer"):  # a line repeats the network's long name for each column
        with probe.path.open("rb") as file:
            head = file.read(_HEAD).removeprefix(_BOM)
    lines = head.split(b"\n", 8)[:8]  # where line ends were doubled every other one is blank
    return [line.replace(b'"', b"") for line in lines if line.strip()][:4]


def read(path: Path, options: Options) -> list[Tracks]:
    """Read every animal."""
    notes: list[str] = []
    animals = [
        Animal(name, joints, values[..., :2], values[..., 2])
        for name, joints, values in _animals(path, ("x", "y"), ("likelihood",), notes)
    ]
    return build_animals(animals, options, path, notes)


def read_motion(path: Path, options: MotionOptions) -> Motion:
    """Read the 3D motion of the animal that is seen most."""
    notes: list[str] = []
    animals = _animals(path, ("x", "y", "z"), (), notes)
    name, joints, points = max(animals, key=lambda animal: int(np.isfinite(animal[2]).sum()))
    if len(animals) > 1:
        notes.append(f"{len(animals)} animals: this is '{brief(name)}', the most seen one")
    return build_motion(torch.from_numpy(points), options, source=str(path), names=joints, notes=notes)


def _animals(
    path: Path, needed: Sequence[str], more: Sequence[str], notes: list[str]
) -> list[tuple[str, list[str], NDArray[np.float64]]]:
    """Name, joints and coordinates (T, N, C) of each animal; what ``more`` names is 1 where it is not there."""
    coords = (*needed, *more)
    table = read_pandas(path) if Probe(path).head.startswith(b"\x89HDF") else _read_csv(path, coords, notes)
    if not table.rows:
        raise FormatError(f"{path}: expected at least one row of numbers, got a header only")
    columns = _by_animal(table, needed, more, path, notes)
    order, frames = frames_of(table.rows, path, notes)
    length = frames[-1] + 1
    if length * sum(map(len, columns.values())) * len(coords) > LIMIT:
        raise FormatError(f"{path}: {length} frames of {len(columns)} animals are more than fits: split the file")
    animals = []
    for name, parts in columns.items():
        filled = np.full((length, len(parts), len(coords)), np.nan)
        for joint, where in enumerate(parts.values()):
            for i, coord in enumerate(coords):
                filled[frames, joint, i] = table.values[order, where[coord]] if coord in where else 1.0
        animals.append((name, list(parts), filled))
    return animals


def _by_animal(
    table: Table, needed: Sequence[str], more: Sequence[str], path: Path, notes: list[str]
) -> dict[str, dict[str, dict[str, int]]]:
    """The column of each coordinate of each joint of each animal."""
    coords = (*needed, *more)
    scorers = list(dict.fromkeys(c[0] for c in table.columns if c[-1] in coords))
    animals: dict[str, dict[str, dict[str, int]]] = {}
    others: dict[str, None] = {}
    for i, (scorer, *names, part, coord) in enumerate(table.columns):
        if coord == "z" and coord not in coords:
            raise refuse_3d(path)
        if coord not in coords:
            others[coord] = None
        elif scorer == scorers[0]:
            where = animals.setdefault(names[0] if names else "", {}).setdefault(part, {})
            if coord in where:
                raise FormatError(f"{path}: expected one column '{coord}' of '{brief(part)}', got two")
            where[coord] = i
    for name, parts in animals.items():
        for part, where in parts.items():
            if any(coord not in where for coord in needed):
                whose = f"'{brief(part)}'" + (f" of '{brief(name)}'" if name else "")
                hint = "" if len(needed) == 2 else "; load_tracks() reads 2D tracks"
                raise FormatError(
                    f"{path}: expected columns {', '.join(needed)} of {whose}, got {', '.join(where)}{hint}"
                )
    if not animals:
        raise FormatError(f"{path}: expected columns {', '.join(coords)}, got {brief(', '.join(others)) or 'none'}")
    if len(scorers) > 1:
        notes.append(f"{len(scorers)} scorers' columns: those of '{brief(scorers[0])}' are read")
    if any(others):
        notes.append(f"columns left out: {brief(', '.join(filter(None, others)))}")
    return animals


def _read_csv(path: Path, coords: Sequence[str], notes: list[str]) -> Table:
    """Read the columns of coordinates of a CSV file; numbers go straight into one array."""
    numbers, short = array("d"), 0
    rows: list[tuple[str, ...]] = []
    try:
        with bounded_rows(path) as lines:
            header = _header(lines, path)
            width, first = len(header[0]), _first_column(header)
            columns = list(zip(*header, strict=True))
            take = [i for i in range(first, width) if columns[i][-1] in (*coords, "z")]
            if not take:
                raise FormatError(f"{path}: expected columns {', '.join(coords)}, got none of them")
            cells = itemgetter(*take) if len(take) > 1 else lambda line: (line[take[0]],)
            for number, line in lines:
                if len(line) > width or len(line) <= first:
                    raise FormatError(f"{path}: line {number}: expected {width} cells, got {len(line)}")
                short += len(line) < width
                line += [""] * (width - len(line))
                values = cells(line)
                if not rows and not any(values) and not any(c.isdigit() for c in "".join(line[:first])):
                    continue  # pandas may write the name of the index in a line of its own
                try:
                    numbers.extend([as_float(v) for v in values])
                except ValueError:
                    wrong = no_numbers([_said(columns[i]) for i in take], values)
                    raise FormatError(f"{path}: line {number}: {wrong}") from None
                rows.append(tuple(line[:first]))
    except (csv.Error, ValueError) as error:
        if isinstance(error, FormatError):
            raise
        raise FormatError(f"{path}: expected DeepLabCut's CSV, got damaged text: {error}") from None
    if short:
        lines_end = "1 line ends" if short == 1 else f"{short} lines end"
        notes.append(f"{lines_end} before the last column: what is missing is unseen")
    left = [c for i, c in enumerate(columns) if i >= first and i not in set(take)]
    if left:
        notes.append(f"columns left out: {brief(', '.join(dict.fromkeys(c[-1] or c[0] for c in left)))}")
    return Table([columns[i] for i in take], np.frombuffer(numbers).reshape(-1, len(take)), rows)


def _said(column: tuple[str, ...]) -> str:
    """A column's name in words, for messages."""
    _, *whose, part, coord = column
    return f"{coord} of '{brief(part)}'" + (f" of '{brief(whose[0])}'" if whose else "")


def _header(lines: Iterator[tuple[int, list[str]]], path: Path) -> list[list[str]]:
    """The three or four lines of names."""
    header: list[list[str]] = []
    for _, line in lines:
        header.append(line)
        if line[:1] == ["coords"] or len(header) == 4:
            break
    names = tuple(line[0] if line else "" for line in header)
    if names not in _LEVELS:
        raise FormatError(
            f"{path}: expected lines scorer, (individuals,) bodyparts, coords, got {brief(', '.join(names))}"
        )
    if len({len(line) for line in header}) > 1:
        raise FormatError(f"{path}: expected as many cells in each line of the header, got {[len(h) for h in header]}")
    return header


def _first_column(header: list[list[str]]) -> int:
    """How many columns name the row: one, or three with the image's folders and name apart, which have no header."""
    first = 1
    while first < min(3, len(header[0])) and not any(line[first] for line in header):
        first += 1
    return first


READERS = (
    Reader(
        "deeplabcut",
        "DeepLabCut CSV and HDF5, one animal or several; Lightning Pose CSV",
        recognises,
        read,
    ),
)
MOTION_READERS = (
    MotionReader("deeplabcut", "DeepLabCut 3D CSV and HDF5; y up unless told", recognises_motion, read_motion),
)
