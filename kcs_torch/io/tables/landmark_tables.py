"""Landmarks as people save MediaPipe's in tables: CSV with a row a frame, NPY arrays."""

from __future__ import annotations

import csv
import math
import re
from collections.abc import Hashable, Iterable, Mapping, Sequence
from functools import cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from kcs_torch.errors import FormatError, counted, listed
from kcs_torch.io.containers.jsonfile import MOST_PIXELS
from kcs_torch.io.contents.landmarks import BODIES, FACE_LEFT_OUT, VISIBILITIES, Landmarks, put_together
from kcs_torch.io.contents.people import Sighting
from kcs_torch.io.contents.shares import are_shares
from kcs_torch.io.registry import read_error
from kcs_torch.io.tables.header import Columns, Header, Layout, delimiter, first_line
from kcs_torch.io.tables.long import LongHeader, read_long
from kcs_torch.io.tables.wide import as_float, opened, read_wide
from kcs_torch.skeleton import SKELETONS, Skeleton, guess_skeleton

__all__ = ["ARRAYS", "frame_shape", "npy_shape", "read_csv", "read_npy", "some_joints", "table_kind"]

_ROWS = {21: 21, 42: 21, 75: 75} | dict.fromkeys((33, 54, 501, 511, 543, 553), 33)
"""How many landmarks a row of numbered ones may have, as of a hand or two, or of a pose with hands and a face behind
it, and how many of them are read."""
_PREFIX = re.compile(r"\A(?:pose_?landmark|pose|landmark)[._]")
_PART = re.compile(r"\A(?P<part>pose|left_?hand|right_?hand|face)(?:_?landmarks?)?[._](?P<name>.+)")
_PARTS = {"pose": 33, "lefthand": 21, "righthand": 21}
_FLAT = {66: (33, 2), 99: (33, 3), 132: (33, 4), 165: (33, 5), 42: (21, 2), 63: (21, 3), 84: (42, 2), 126: (42, 3)}
_FLAT |= {225: (75, 3), 258: (75, 4), 1662: (75, 4)}
"""Landmarks, and numbers of each, by how many numbers stand in a row."""
_COUNTS = (33, 21, 42, 75, 543)
"""Landmarks of a pose, a hand, two hands, a pose and two hands, and of these with a face."""
ARRAYS = "(frames, 33, 21, 42, 75 or 543, 2 to 5)"
"""Shapes of arrays of landmarks, for messages."""
_FEW = 0.1  # share of the landmarks that lie left of the image, or above it
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
        return "" if long is None else _long_kind(text, long)
    deep = all("z" in columns for columns in header.joints.values())
    visible = any(set(columns) & set(VISIBILITIES) for columns in header.joints.values())
    if deep and lower == ["frame", "time [s]"] and not visible:
        return "motion"  # as results are written, of whatever joints
    names = {_plain(name) for name in header.joints}
    named = len(_named() & names) >= SOME and (visible or bool(_own() & names))
    named = named or _person_with_hands(header.joints, []) is not None
    numbered = len(names) in _ROWS and all(map(_is_number, names))
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


def _long_kind(text: str, header: LongHeader) -> str:
    """As :func:`table_kind` of a table with a row a joint."""
    line = first_line(text)
    names: dict[str, dict[str, int]] = {}
    places = []
    try:
        for cells in csv.reader(text[len(line) :].splitlines()[:-1], delimiter=delimiter(line)):
            if any(cells):
                names.setdefault(header.name_of(cells), {})
                places.append([as_float(cells[header.what[axis]]) for axis in ("x", "y", "z")[: 2 + header.deep]])
    except (csv.Error, ValueError, IndexError):  # what is wrong is told when it is read
        pass
    numbers = {int(name) if _is_number(name) else -1 for name in names}
    numbered = numbers in [{*range(k, k + count)} for count in BODIES for k in (0, 1)]
    if numbered and not header.cells[header.joint].lower().startswith("landmark"):
        numbered = False
    if numbered or _person_with_hands(names, []) is not None:
        return "landmarks"
    if not header.deep:
        return "tracks"
    place = np.array(places).reshape(-1, 3)
    within = are_shares(place) and bool((place[:, :2] < 0).mean() < _FEW)
    plain = {_plain(name) for name in names}
    return "landmarks" if within and len(_named() & plain) >= SOME and _own() & plain else "motion"


def _is_number(name: str) -> bool:
    return name.isdecimal() and len(name) < 5


def _plain(name: str) -> str:
    return _PREFIX.sub("", name.lower().replace(" ", "_"))


def read_csv(path: Path, body: Skeleton | None = None) -> Landmarks:
    """Read a CSV with a row a frame, or a person, or a joint; of a person with hands as :func:`put_together`."""
    with opened(path) as (line, _):
        long = LongHeader.of(line) is not None and len(Header.of(line).joints) < 2
    out = read_long(path) if long else read_wide(path, _layout)
    if long and out.names is not None:
        _arrange(out)
    people = [one for found in out.frames.values() for one in found]
    if out.names is None and people and len(people[0].joints) == sum(_PARTS.values()):
        _take(out, {number: [(one.joints, one.track) for one in found] for number, found in out.frames.items()}, body)
    return out


def _arrange(out: Landmarks) -> None:
    """Put the joints of a long table into the order of a wide one's layout."""
    names, marks = _layout({name: {"at": k} for k, name in enumerate(out.names or ())}, out.notes)
    at = [mark.get("at", -1) for mark in marks]
    out.names = names
    out.frames = {
        number: [one._replace(joints=np.append(one.joints, [[math.nan] * 3], 0)[at]) for one in found]
        for number, found in out.frames.items()
    }


def _take(
    out: Landmarks, frames: Mapping[int, Iterable[tuple[NDArray[np.float64], Hashable]]], body: Skeleton | None
) -> None:
    """Take the rows of frames apart: a pose (33, 3), a hand (21, 3), two of these, or a pose and two hands."""
    poses: dict[int, list[Sighting]] = {}
    hands: dict[int, list[Sighting]] = {}
    for number, people in frames.items():
        poses[number], hands[number] = [], []
        for joints, track in people:
            joints = np.where((joints[:, :2] == 0).all(-1, keepdims=True), math.nan, joints)
            start = 33 * (len(joints) in (33, 75))
            whole = len(joints) == 75
            parts = [(poses, joints[:start], track)]
            for k, at in enumerate(range(start, len(joints), 21)):
                parts.append((hands, joints[at : at + 21], ("left", "right")[k] if whole else track))
            for into, part, who in parts:
                if np.isfinite(part[:, :2]).all(-1).any():
                    into[number].append(Sighting(part, who))
    put_together(out, poses, hands, body)


def _person_with_hands(joints: Mapping[str, dict[str, int]], notes: list[str]) -> list[dict[str, int]] | None:
    """Columns of a pose, a left and a right hand, by names such as ``pose_0``, ``left_hand_wrist``; None of others."""
    found: dict[str, dict[str, dict[str, int]]] = {}
    for name, columns in joints.items():
        lower = name.lower().replace(" ", "_").replace("-", "_")
        match = _PART.match(lower)
        part = match["part"].replace("_", "") if match else "pose"
        found.setdefault(part, {})[match["name"] if match else lower] = columns
    face = found.pop("face", None)
    if found.keys() <= {"pose"} and not (face and found):
        return None
    marks: list[dict[str, int]] = []
    for part, count in _PARTS.items():
        names = SKELETONS[BODIES[count]].joints[:count]
        own = found.get(part, {})
        if len(own) == count and all(map(_is_number, own)):
            marks += [own[name] for name in sorted(own, key=int)]
        elif not own or (len(own) >= SOME and own.keys() <= set(names) and own.keys() & _own()):
            marks += [own.get(name, {}) for name in names]
        else:
            return None
    if face:
        notes.append(FACE_LEFT_OUT)
    return marks


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
    if all(map(_is_number, marks)):
        marks = dict(sorted(marks.items(), key=lambda item: int(item[0])))
        count = _ROWS.get(len(marks), len(marks))
        if count < len(marks):
            read = "a hand" if count == 21 else "the pose"
            notes.append(f"of {len(marks)} numbered landmarks the first {count} are read, as {read}")
        return None, list(marks.values())[:count]
    whole = _person_with_hands(joints, notes)
    if whole is not None:
        return None, whole
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
    if len(shape) == 4 and tuple(shape[1:3]) == (2, 21):
        shape = (shape[0], 42, shape[3])
    if len(shape) == 3 and shape[1] in _COUNTS and 2 <= shape[2] <= 5:
        return shape[1], shape[2]
    return _FLAT.get(shape[1]) if len(shape) == 2 else None


def read_npy(path: Path, body: Skeleton | None = None) -> Landmarks:
    """Read an array of (frames, landmarks, 2 to 5 numbers), or of the same numbers in a row each.

    A pose stands before a left and a right hand; with a face, between the hands, or before it. A third number is z, but
    of poses that have three it is visibility where it lies within 0..1; a fourth of a pose is visibility.
    """
    out = Landmarks()
    try:
        size = path.stat().st_size
        with path.open("rb") as file:
            shape = npy_shape(file.read(65536))
        layout = None if shape is None else frame_shape(shape)
        if shape is None or layout is None:
            got = "none of numbers" if shape is None else f"shape {shape}"
            raise FormatError(f"{path}: expected an array {ARRAYS}, got {got}")
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
    if array.shape[1:] in ((258,), (1662,)):  # a pose's x, y, z and visibility, a face, and x, y, z of the hands
        hands = array[:, -126:].reshape(-1, 42, 3)
        hands = np.pad(hands, ((0, 0), (0, 0), (0, 1)), constant_values=math.nan)
        rows = np.concatenate([array[:, :132].reshape(-1, 33, 4), hands], 1)
    else:
        rows = array.reshape(len(array), count, width)
    if not (np.isnan(rows) | (np.abs(rows) <= MOST_PIXELS)).all():
        raise FormatError(f"{path}: expected coordinates, got numbers beyond {MOST_PIXELS:g}")
    if count == 543:
        rows = rows[:, _behind_a_face(rows)]
    if count == 543 or array.shape[1:] == (1662,):
        out.notes.append(FACE_LEFT_OUT)
    seen = np.full(rows.shape[:2], math.nan)
    out.seen.add("visibility")
    if count in (33, 75) and width > 3:
        seen[:, :33] = rows[:, :33, 3]
    elif count in (33, 75) and width == 3:
        third = rows[:, :33, 2]
        if (np.isnan(third) | ((third >= 0) & (third <= 1))).all():
            seen[:, :33] = third
            out.notes.append("the third number of each landmark is taken as its visibility: it is within 0..1")
    joints = np.concatenate([rows[..., :2], seen[..., None]], -1)
    _take(out, {t: [(frame, None)] for t, frame in enumerate(joints)}, body)
    return out


def _behind_a_face(rows: NDArray[np.float64]) -> list[int]:
    """Which of 543 landmarks are the pose's and the hands': the face, of 468, stands first or behind the pose.

    It is taken to stand where these lie closer together.
    """
    places = np.where((rows[..., :2] == 0).all(-1, keepdims=True), math.nan, rows[..., :2])
    first, behind = (np.abs(places[:, at : at + 468] - places[:, at + 234, None]) for at in (0, 33))
    pose, left, right = (
        (489, 468, 522) if np.nanmax([0, *first.flat]) <= np.nanmax([0, *behind.flat]) else (0, 501, 522)
    )
    return [*range(pose, pose + 33), *range(left, left + 21), *range(right, right + 21)]
