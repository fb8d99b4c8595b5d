"""Landmarks as people save MediaPipe's in tables: CSV with a row a frame, NPY arrays."""

from __future__ import annotations

import csv
import math
import re
from collections.abc import Sequence
from functools import cache
from pathlib import Path

import numpy as np

from kcs_torch.errors import FormatError, counted, listed
from kcs_torch.io.containers.jsonfile import MOST_PIXELS
from kcs_torch.io.contents.landmarks import BODIES, VISIBILITIES, Landmarks
from kcs_torch.io.contents.people import Sighting
from kcs_torch.io.contents.shares import are_shares
from kcs_torch.io.registry import read_error
from kcs_torch.io.tables.header import Columns, Header, Layout, delimiter, first_line
from kcs_torch.io.tables.long import LongHeader
from kcs_torch.io.tables.wide import as_float, read_wide
from kcs_torch.skeleton import SKELETONS, Skeleton, guess_skeleton

__all__ = ["frame_shape", "npy_shape", "read_csv", "read_npy", "some_joints", "table_kind"]

_ROWS = {21: 21, 42: 21} | dict.fromkeys((33, 54, 75, 501, 511, 543, 553), 33)
"""How many landmarks a row of numbered ones may have, as of a hand or two, or of a pose with hands and a face behind
it, and how many of them are read."""
_PREFIX = re.compile(r"\A(?:pose_?landmark|pose|landmark)[._]")
SOME = 10  # names of a body from which on a table is taken for one of it
_LIMIT = 2**30  # bytes of a file


@cache
def _named() -> frozenset[str]:
    """Names of all landmarks; loading skeletons is left until they are needed."""
    return frozenset(j for b in BODIES.values() for j in SKELETONS[b].joints[: SKELETONS[b].num_observed])


@cache
def _own() -> frozenset[str]:
    """Names that no other detector's skeleton has."""
    others = (body for name, body in SKELETONS.items() if name not in BODIES.values())
    return _named().difference(*(body.joints for body in others))


def table_kind(text: str) -> str:
    """Tell what a table with columns or rows for each joint holds, by the beginning of its text.

    Returns:
        "landmarks" of MediaPipe, by their numbers, or by names or visibilities that nobody else's have; "motion", where
        every joint has z, which of joints with landmarks' names, without visibilities, is no share of the image; other
        "tracks"; empty where it is no such table.

    >>> table_kind("frame,a_x,a_y,b_x,b_y"), table_kind("a_x,a_y,a_z,b_x,b_y,b_z"), table_kind("track,frame,a_x,a_y")
    ('tracks', 'motion', '')
    >>> table_kind("frame,joint,x,y"), table_kind("frame,joint,x,y,z")
    ('tracks', 'motion')
    """
    line = first_line(text)
    header = Header.of(line)
    lower = [cell.lower() for cell in header.cells[:2]]
    if len(header.joints) < 2 or lower == ["track", "frame_idx"]:  # SLEAP's
        long = LongHeader.of(line)
        return "" if long is None else "motion" if long.deep else "tracks"
    deep = all("z" in columns for columns in header.joints.values())
    visible = any(set(columns) & set(VISIBILITIES) for columns in header.joints.values())
    if deep and lower == ["frame", "time [s]"] and not visible:
        return "motion"  # as results are written, of whatever joints
    names = {_plain(name) for name in header.joints}
    named = len(_named() & names) >= SOME and (visible or bool(_own() & names))
    numbered = len(names) in _ROWS and all(name.isdecimal() for name in names)
    if numbered or (named and not (deep and not visible and _lengths(text, header))):
        return "landmarks"
    return "motion" if deep else "tracks"


def _lengths(text: str, header: Header) -> bool:
    """Whether z of the joints, by the first row that has any, are no shares of an image, as MediaPipe's are."""
    line = first_line(text)
    try:
        for cells in csv.reader(text[len(line) :].splitlines(), delimiter=delimiter(line)):
            z = np.array([as_float(cells[columns["z"]]) for columns in header.joints.values() if cells])
            if np.isfinite(z).any():
                return not are_shares(z)
    except (csv.Error, ValueError, IndexError):  # no numbers, or a row that is cut short
        pass
    return False


def _plain(name: str) -> str:
    return _PREFIX.sub("", name.lower().replace(" ", "_"))


def read_csv(path: Path) -> Landmarks:
    """Read a CSV with a row a frame, or a row a person where a column says who it is."""
    return read_wide(path, _layout)


def some_joints(joints: Columns, body: Skeleton, notes: list[str]) -> Layout | None:
    """The layout of a table with most joints of a body in any order, others unseen; None of other tables.

    Args:
        joints: the table's columns.
        body: whose joints they may be.
        notes: what is lacking is added to them.
    """
    marks = {_plain(name): columns for name, columns in joints.items()}
    names = body.joints[: body.num_observed]
    if not SOME <= len(marks) == len(joints) or not set(marks) <= set(names):
        return None
    if lacking := ", ".join(name for name in names if name not in marks):
        notes.append(f"these joints of {body.name} have no columns x and y, so they are unseen: {lacking}")
    return names, [marks.get(name, {}) for name in names]


def _layout(joints: Columns, notes: list[str]) -> Layout:
    """The joints' names, and the columns of each; None where they are the usual ones, by number."""
    marks = {_plain(name): columns for name, columns in joints.items()}
    if all(n.isdecimal() for n in marks):
        marks = dict(sorted(marks.items(), key=lambda item: int(item[0])))
        count = _ROWS.get(len(marks), len(marks))
        if count < len(marks):
            read = "a hand" if count == 21 else "the pose"
            notes.append(f"of {len(marks)} numbered landmarks the first {count} are read, as {read}")
        return None, list(marks.values())[:count]
    body = SKELETONS[BODIES[33]]
    pose = body.joints[: body.num_observed]
    if len(marks) == len(joints) and set(pose) < set(marks):
        others = [name for name in joints if _plain(name) not in pose]
        notes.append(f"{counted(len(others), 'joint')} beside the pose left out: {listed(others, 5)}")
        return pose, [marks[name] for name in pose]
    if guess_skeleton(list(marks), ordered=False) is None:
        found = some_joints(joints, body, notes)
        if found is not None:
            return found
    return tuple(marks), list(marks.values())


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
    out.seen.add("visibility")
    if width > 3:
        seen = rows[..., 3]
    elif width == 3:
        third = rows[..., 2]
        if (np.isnan(third) | ((third >= 0) & (third <= 1))).all():
            seen = third
            out.notes.append("the third number of each landmark is taken as its visibility: it is within 0..1")
    if not (np.isnan(rows) | (np.abs(rows) <= MOST_PIXELS)).all():
        raise FormatError(f"{path}: expected coordinates, got numbers beyond {MOST_PIXELS:g}")
    joints = np.concatenate([rows[..., :2], seen[..., None]], -1)
    out.frames = {t: [Sighting(j)] if np.isfinite(j[:, :2]).any() else [] for t, j in enumerate(joints)}
    return out
