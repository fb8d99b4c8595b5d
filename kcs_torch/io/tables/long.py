"""Long tables of text, with a row a frame and joint: ``frame, joint, x, y, confidence``."""

from __future__ import annotations

import re
from array import array
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from kcs_torch.errors import FormatError
from kcs_torch.io.containers.jsonfile import MOST_JOINTS, as_frame_number, as_text
from kcs_torch.io.contents.landmarks import CONFIDENCES, VISIBILITIES, Landmarks
from kcs_torch.io.folders import frame_numbers
from kcs_torch.io.tables.header import Header, plain_name
from kcs_torch.io.tables.wide import Row, as_person, as_value, opened, place_rows
from kcs_torch.types.intake import FARTHEST

__all__ = ["MOST", "LongHeader", "read_long"]

MOST = 5e7  # coordinates of all frames, those between the file's included
_PARTS = (
    *("joint", "joint_name", "keypoint", "bodypart", "body_part", "part", "node", "marker"),
    *("landmark", "landmark_index", "landmark_id", "name"),
)
_SLEAP = ["track", "frame_idx", "instance.score"]
_UNIT = re.compile(r" \[(?P<unit>[^\]]*)\]\Z")


@dataclass(frozen=True)
class LongHeader:
    """The first line of a long table.

    Attributes:
        cells: the columns' names.
        joint: the column of joints' names.
        what: the columns of coordinates and confidences by what they hold: x, y, z, confidence, ...
        number: the column of frame numbers.
        time: the column of times, and their unit where its name tells.
        who: the column that tells people apart.
        kind: the column of the parts, pose, face or a hand, whose landmarks are numbered.
        twice: a column that is there twice; empty where none is.
        unit: of the coordinates, where that of x tells.
    """

    cells: list[str]
    joint: int
    what: dict[str, int]
    number: int | None
    time: tuple[int, str] | None
    who: int | None
    kind: int | None
    twice: str
    unit: str

    @classmethod
    def of(cls, line: str) -> LongHeader | None:
        """Take a line apart; None where it is of no long table.

        >>> LongHeader.of("frame,joint,x,y,likelihood").what, LongHeader.of("frame,nose_x,nose_y")
        ({'x': 2, 'y': 3, 'likelihood': 4}, None)
        """
        header = Header.of(line)
        lower = [_UNIT.sub("", cell).lower() for cell in header.cells]
        joint = header.column(_PARTS)
        placed = header.number is not None or header.time is not None
        if joint is None or not placed or not {"x", "y"} <= set(lower) or lower[:3] == _SLEAP:
            return None
        held = ("x", "y", "z", *CONFIDENCES, *VISIBILITIES)
        unit = _UNIT.search(header.cells[lower.index("x")])
        return cls(
            header.cells,
            joint,
            {name: lower.index(name) for name in held if name in lower},
            header.number,
            header.time,
            header.who,
            header.column(("type",)) if lower[joint].startswith("landmark") else None,
            next((name for name in (*held, lower[joint]) if lower.count(name) > 1), ""),
            unit["unit"] if unit else "",
        )

    def name_of(self, cells: Sequence[str]) -> str:
        """The joint's name in a row, with the part's before it where a column tells; empty where there is none."""
        name = plain_name(cells[self.joint])
        return name if self.kind is None or not name else f"{plain_name(cells[self.kind])}_{name}"

    @property
    def deep(self) -> bool:
        """Whether there is a column z."""
        return "z" in self.what


def read_long(path: Path, *, depth: bool = False) -> Landmarks:
    """Read a table with a row a frame and joint, in any order; joints in the order in which they first appear.

    Joints without a row are unseen in that frame. Frames are placed by a column of numbers, else by one of times.

    Args:
        path: the table.
        depth: whether to read z of each joint rather than its confidence or visibility.

    Raises:
        FormatError: it cannot be read, or is no such table; the message names row and column.
    """
    with opened(path) as (line, cells_of):
        header = LongHeader.of(line)
        if header is None:
            raise FormatError(f"{path}: expected columns such as frame, joint, x, y, got '{as_text(line.strip())}'")
        if header.twice:
            raise FormatError(f"{path}: expected every column once, got '{header.twice}' again")
        table = _Table(path, header, depth)
        table.take(cells_of)
    return table.landmarks()


class _Table:
    """The rows of a long table, as numbers: of the frame, the time, x, y and a third."""

    def __init__(self, path: Path, header: LongHeader, depth: bool) -> None:
        self.path, self.header = path, header
        seen = [name for name in (*CONFIDENCES, *VISIBILITIES) if name in header.what]
        self.third = "z" if depth else next(iter(seen), "")
        held = [header.number, header.time and header.time[0], header.what["x"], header.what["y"]]
        self.columns = [*held, header.what.get(self.third)]
        self.left = [name for name in seen if name != self.third]
        self.lines, self.numbers = array("q"), array("d")
        self.joints, self.people = array("q"), array("q")
        self.names: dict[str, int] = {}
        self.called: dict[str, int] = {}

    def where(self, i: int) -> str:
        return f"{self.path}: row {self.lines[i]}"

    def take(self, rows: Iterable[list[str]]) -> None:
        """Take the rows in; numbers go straight into one array."""
        header, width, names, called = self.header, len(self.header.cells), self.names, self.called
        for i, cells in enumerate(rows, 2):
            if not any(cells):
                continue
            if len(cells) != width:
                raise FormatError(
                    f"{self.path}: row {i}: expected {width} values as in the first row, got {len(cells)}"
                )
            name = header.name_of(cells)
            if not name:
                column = header.cells[header.joint]
                raise FormatError(f"{self.path}: row {i}: '{column}': expected a joint's name, got an empty cell")
            texts = ["" if c is None else cells[c] for c in self.columns]
            try:
                values = [float(text or "nan") for text in texts]
            except ValueError:
                values = [self._value(i, k, text) for k, text in enumerate(texts)]
            self.numbers.extend(values)
            self.lines.append(i)
            self.joints.append(names.setdefault(name, len(names)))
            self.people.append(0 if header.who is None else called.setdefault(cells[header.who], len(called)))
        if len(names) > MOST_JOINTS:
            column = header.cells[header.joint]
            raise FormatError(f"{self.path}: '{column}': expected {MOST_JOINTS} joints at most, got {len(names)}")

    def _value(self, line: int, k: int, text: str) -> float:
        column = self.columns[k]
        name = "" if column is None else self.header.cells[column]
        return as_value(text, f"{self.path}: row {line}", name)

    def landmarks(self) -> Landmarks:
        """The joints of each person in each frame."""
        header = self.header
        out = Landmarks(names=tuple(self.names), unit=header.unit, seen={self.third} - {"", "z"})
        if self.left:
            out.notes.append(f"columns of joints that are left out: {', '.join(self.left)}")
        values = np.frombuffer(self.numbers).reshape(-1, 5)
        if not len(values):
            return out
        with np.errstate(invalid="ignore"):
            far = np.argwhere(np.abs(values) > FARTHEST)
        for i, k in far[:1].tolist():
            self._value(self.lines[i], k, f"{values[i, k]}")
        places, frame = np.unique(self._places(values), return_inverse=True)
        who, joint = np.frombuffer(self.people, np.int64), np.frombuffer(self.joints, np.int64)
        ids = [as_person(cell) for cell in self.called]
        people = list(dict.fromkeys(ids))
        at = {one: k for k, one in enumerate(people)}
        who = np.array([at[one] for one in ids] or [0])[who]  # one of all, where no column tells
        numbered = len(self.names) == len(people) == len(np.unique(joint * len(people) + who))
        if header.who is None or len(people) == len(values) or numbered:  # numbers of rows or of joints, not of people
            who, people = np.zeros_like(who), [0]
        elif len(people) > 1:
            out.who = header.cells[header.who]
        _, first, group = np.unique(frame * len(people) + who, return_index=True, return_inverse=True)
        self._check_size(places, len(first))
        flat = group * len(self.names) + joint
        self._check_once(flat, values)
        joints = np.full((len(first) * len(self.names), 3), np.nan)
        joints[flat] = values[:, 2:]
        rows = []
        for i, found in zip(first.tolist(), joints.reshape(len(first), -1, 3), strict=True):
            number = None if header.number is None else int(values[i, 0])
            rows.append(Row(self.where(i), number, float(values[i, 1]), people[who[i]], found))
        place_rows(rows, header.time[1] if header.time else "", out)
        return out

    def _places(self, values: NDArray[np.float64]) -> NDArray[np.float64]:
        """The frame's number in each row, or the time where there is none."""
        number = self.header.number is not None
        column = values[:, 0 if number else 1]
        wrong = column != np.rint(column) if number else np.isnan(column)
        if wrong.any():
            i = int(wrong.argmax())
            at = self.columns[0 if number else 1]
            name = "" if at is None else self.header.cells[at]
            got = "an empty cell" if np.isnan(column[i]) else f"{column[i]:g}"
            kind = "whole number" if number else "time"
            raise FormatError(f"{self.where(i)}: '{name}': expected a {kind}, got {got}")
        return column

    def _check_size(self, places: NDArray[np.float64], groups: int) -> None:
        count = len(places)
        if self.header.number is not None:
            frames, _ = frame_numbers([as_frame_number(place) for place in places.tolist()], [])
            count = frames[-1] + 1
        count, joints = max(count, groups), len(self.names)
        if count * joints * 3 > MOST:
            raise FormatError(f"{self.path}: {count} frames of {joints} joints are more than fits: split the file")

    def _check_once(self, flat: NDArray[np.int64], values: NDArray[np.float64]) -> None:
        """Refuse a joint that has two rows of one frame, and one person."""
        order = np.argsort(flat, kind="stable")
        again = order[1:][flat[order][1:] == flat[order][:-1]]
        if not len(again):
            return
        i = int(again.min())
        joint = as_text(list(self.names)[self.joints[i]])
        at = f"frame {values[i, 0]:.0f}" if self.header.number is not None else f"time {values[i, 1]:g}"
        column = "" if self.header.who is None else f" of one '{self.header.cells[self.header.who]}'"
        hint = "" if column else ", or a column 'person'"
        apart = " (people without an id cannot be told apart here)" if column else ""
        raise FormatError(
            f"{self.where(i)}: expected every joint once in a frame{column}{hint}, got '{joint}' in {at} again{apart}"
        )
