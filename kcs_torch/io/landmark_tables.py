"""Landmarks as people save MediaPipe's in tables: CSV with a row a frame, NPY arrays."""

from __future__ import annotations

import csv
import math
import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from kcs_torch.errors import FormatError
from kcs_torch.io.frames import as_track_id
from kcs_torch.io.jsonfile import FARTHEST, as_frame_number, as_text
from kcs_torch.io.landmarks import BODIES, FRAME_KEYS, Landmarks
from kcs_torch.io.people import Sighting
from kcs_torch.io.registry import read_error
from kcs_torch.skeleton import SKELETONS

__all__ = ["csv_columns", "frame_shape", "npy_shape", "read_csv", "read_npy"]

_LIMIT = 2**30  # bytes of a file
_WHO = ("person", "person_id", "pose", "track_id", "hand", "handedness", "id")
_NAMED = re.compile(r"(?:pose_)?(?P<name>.+?)[_. ](?P<what>x|y|z|visibility|presence|score|confidence|v|c)\Z")
_NUMBERED = re.compile(r"(?P<what>x|y|z|visibility|v)_?(?P<name>[0-9]{1,4})\Z")
_SEEN = ("visibility", "v", "score", "confidence", "c")


def csv_columns(header: str) -> tuple[dict[str, dict[str, int]], list[str]]:
    """The columns of each landmark by what they hold, and all columns' names, of a CSV's first line.

    >>> csv_columns("frame,nose_x,nose_y,nose_visibility")[0]
    {'nose': {'x': 1, 'y': 2, 'visibility': 3}}
    """
    try:
        cells = next(csv.reader([header.lstrip("\ufeff")], delimiter=_delimiter(header)), [])
    except csv.Error:
        return {}, []
    cells = [c.strip().lower() for c in cells]
    marks: dict[str, dict[str, int]] = {}
    for i, cell in enumerate(cells):
        match = _NUMBERED.match(cell) or _NAMED.match(cell)
        if match:
            marks.setdefault(match["name"].replace(" ", "_"), {}).setdefault(match["what"], i)
    return {name: what for name, what in marks.items() if {"x", "y"} <= set(what)}, cells


def _delimiter(header: str) -> str:
    return max(",;\t", key=header.count)


def read_csv(path: Path) -> Landmarks:
    """Read a CSV with a row a frame, or a row a person where a column says who it is."""
    out = Landmarks()
    try:
        if path.stat().st_size > _LIMIT:
            raise FormatError(f"{path}: expected 1 GiB of CSV at most: split the file")
        with path.open(newline="", encoding="utf-8-sig", errors="replace") as file:
            header = file.readline(2**20)
            marks, cells = csv_columns(header.rstrip("\r\n"))
            if not marks:
                raise FormatError(f"{path}: expected columns such as nose_x, nose_y, got '{as_text(header.strip())}'")
            out.names, columns = _layout(marks, out.notes)
            rows = csv.reader(file, delimiter=_delimiter(header))
            for i, row in enumerate(rows):
                _add_row(out, row, i, cells, columns, path)
    except OSError as error:
        raise read_error(path, error) from None
    except csv.Error as error:
        raise FormatError(f"{path}: expected a CSV table, got text that does not parse: {error}") from None
    return out


def _add_row(
    out: Landmarks,
    row: Sequence[str],
    i: int,
    cells: Sequence[str],
    columns: Sequence[tuple[int, int, int]],
    path: Path,
) -> None:
    if not any(row):
        return
    where = f"{path}: row {i + 2}"
    if len(row) != len(cells):
        raise FormatError(f"{where}: expected {len(cells)} values as in the first row, got {len(row)}")
    column = next((cells.index(n) for n in FRAME_KEYS if n in cells), None)
    number = i if column is None else as_frame_number(_value(row[column], where, cells[column]))
    if number is None:
        raise FormatError(f"{where}: '{cells[column or 0]}': expected a whole number, got {as_text(row[column or 0])}")
    who = next((as_track_id(row[cells.index(n)]) for n in _WHO if n in cells), None)
    joints = np.array([[math.nan if c < 0 else _value(row[c], where, cells[c]) for c in triple] for triple in columns])
    people = out.frames.setdefault(number, [])
    if people and (who is None or any(s.track == who for s in people)):
        raise FormatError(f"{where}: expected every frame once, or a column 'person', got frame {number} again")
    people.append(Sighting(joints, who))


def _value(cell: str, where: str, name: str) -> float:
    try:
        value = float(cell) if cell.strip() else math.nan
    except ValueError:
        raise FormatError(f"{where}: '{name}': expected a number, got '{as_text(cell)}'") from None
    if not (math.isnan(value) or abs(value) <= FARTHEST):
        raise FormatError(f"{where}: '{name}': expected a coordinate or a visibility, got {value:.3g}")
    return value


def _layout(
    marks: dict[str, dict[str, int]], notes: list[str]
) -> tuple[tuple[str, ...] | None, list[tuple[int, int, int]]]:
    """The joints' names, and the columns of x, y and visibility of each; -1 where there is none."""
    names: tuple[str, ...] | None = tuple(marks)
    if all(n.isdecimal() for n in marks):
        marks = dict(sorted(marks.items(), key=lambda item: int(item[0])))
        for count in BODIES:
            if len(marks) > count and len(marks) not in BODIES:
                notes.append(f"of {len(marks)} numbered landmarks the first {count} are read, as the pose")
                marks = dict(list(marks.items())[:count])
        names = None
    else:
        for body in (SKELETONS["coco17"], *(SKELETONS[b] for b in BODIES.values())):
            joints = body.joints[: body.num_observed]
            if set(marks) == set(joints) or (body.name == "mediapipe33" and set(marks) < set(joints)):
                names = joints
                break
    keys = list(marks) if names is None else list(names)
    blank: dict[str, int] = {}
    columns = []
    for key in keys:
        what = marks.get(key, blank)
        seen = next((what[k] for k in _SEEN if k in what), -1)
        columns.append((what.get("x", -1), what.get("y", -1), seen))
    return names, columns


# ---------------------------------------------------------------------- NPY


def npy_shape(head: bytes) -> tuple[int, ...] | None:
    """The shape of the array of an .npy file by its first bytes; None where it is none, or holds no numbers."""
    from io import BytesIO

    file = BytesIO(head)
    try:
        version = np.lib.format.read_magic(file)
        read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
        shape, _, dtype = read(file)
    except Exception:  # numpy raises many kinds on damaged files
        return None
    return tuple(shape) if dtype.kind in "fiu" else None


def frame_shape(shape: Sequence[int]) -> tuple[int, int] | None:
    """How many landmarks of how many numbers each row of an array holds; None where it holds none that we know.

    >>> frame_shape((100, 33, 4)), frame_shape((100, 132)), frame_shape((5, 5))
    ((33, 4), (33, 4), None)
    """
    if len(shape) == 3 and shape[1] in BODIES and 2 <= shape[2] <= 5:
        return shape[1], shape[2]
    if len(shape) == 2 and shape[1] in (66, 99, 132, 165):
        return 33, shape[1] // 33
    if len(shape) == 2 and shape[1] in (42, 63):
        return 21, shape[1] // 21
    if len(shape) == 2 and shape[1] == 1662:  # pose, face and hands of the holistic model in a row
        return 33, 4
    return None


def read_npy(path: Path) -> Landmarks:
    """Read an array of (frames, landmarks, 2 to 5 numbers), or of the same numbers in a row each."""
    out = Landmarks()
    try:
        size = path.stat().st_size
        with path.open("rb") as file:
            shape = npy_shape(file.read(65536))
        layout = None if shape is None else frame_shape(shape)
        if shape is None or layout is None:
            got = "none of numbers" if shape is None else f"shape {shape}"
            raise FormatError(f"{path}: expected an array of shape (frames, 33 or 21, 2 to 5), got {got}")
        if size > _LIMIT or math.prod(shape) > size:
            raise FormatError(f"{path}: expected an array of 1 GiB at most, as large as its file, got shape {shape}")
        array = np.load(path, allow_pickle=False).astype(np.float64)
    except OSError as error:
        raise read_error(path, error) from None
    except FormatError:
        raise
    except Exception as error:  # numpy raises many kinds on damaged files
        raise FormatError(f"{path}: is damaged or truncated: {error}") from None
    count, width = layout
    if array.ndim == 2 and array.shape[1] != count * width:
        out.notes.append(f"of {array.shape[1]} numbers a frame the first {count * width} are read, as the pose")
    rows = array.reshape(len(array), -1)[:, : count * width].reshape(-1, count, width)
    seen = np.full(rows.shape[:2], math.nan)
    if width > 3:
        seen = rows[..., 3]
    elif width == 3:
        third = rows[..., 2]
        if (np.isnan(third) | ((third >= 0) & (third <= 1))).all():
            seen = third
            out.notes.append("the third number of each landmark is taken as its visibility: it is within 0..1")
    if not (np.isnan(rows) | (np.abs(rows) <= FARTHEST)).all():
        raise FormatError(f"{path}: expected coordinates, got numbers beyond {FARTHEST:g}")
    joints = np.concatenate([rows[..., :2], seen[..., None]], -1)
    out.frames = {t: [Sighting(j)] if np.isfinite(j[:, :2]).any() else [] for t, j in enumerate(joints)}
    return out
