"""The first line of a table: its columns, and what they hold."""

from __future__ import annotations

import csv
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from functools import cached_property

from kcs_torch.io.contents.landmarks import CONFIDENCES, VISIBILITIES
from kcs_torch.io.contents.times import time_unit

__all__ = ["WHO", "Columns", "Header", "Layout", "delimiter", "first_line", "plain_name"]

WHO = (
    *("person", "individual", "individuals", "animal", "subject", "track", "instance"),
    *("person_id", "pose", "track_id", "hand", "handedness", "id"),
)
"""What a column is called that tells people apart."""

_WHAT = "|".join(("x", "y", "z", *CONFIDENCES, *VISIBILITIES))
_NAMED = re.compile(rf"(?P<name>.+)[_. ](?P<what>{_WHAT})(?: \[(?P<unit>[^\]]*)\])?\Z", re.IGNORECASE | re.DOTALL)
_NUMBERED = re.compile(rf"(?P<what>{_WHAT})_?(?P<name>[0-9]{{1,4}})\Z", re.IGNORECASE)
_FRAME = re.compile(r"frame(?:[ _]?(?:#|no|nr|num|number|id|idx|index))?\.?", re.IGNORECASE)
_LINE = re.compile(r'(?:[^"\n]+|"[^"]*")*')

Columns = dict[str, dict[str, int]]
"""Of each joint the columns by what they hold: x, y, z, confidence, ..."""

Layout = tuple[tuple[str, ...] | None, list[dict[str, int]]]
"""The names of joints, None where they have numbers only, and the columns of each."""


@dataclass(frozen=True)
class Header:
    """The first line of a table.

    Attributes:
        cells: the columns' names.
        joints: the columns of the joints that have x and y.
        halves: columns that are missing, of joints that have x or y only.
        twice: a column that is there twice; empty where none is.
        unit: of the coordinates, where the first one tells.
    """

    cells: list[str]
    joints: Columns
    halves: list[str] = field(default_factory=list)
    twice: str = ""
    unit: str = ""

    @classmethod
    def of(cls, line: str) -> Header:
        """Take a line apart.

        >>> Header.of("frame,nose_x,nose_y,nose_visibility").joints
        {'nose': {'x': 1, 'y': 2, 'visibility': 3}}
        """
        try:
            line = line.strip("\ufeff\r\n")
            cells = [] if "\0" in line else next(csv.reader([line], delimiter=delimiter(line)), [])
        except csv.Error:
            return cls([], {})
        cells = [plain_name(cell) for cell in cells]
        joints: Columns = {}
        unit = twice = ""
        for i, cell in enumerate(cells):
            match = _NUMBERED.match(cell) or _NAMED.match(cell)
            if match:
                columns, what = joints.setdefault(match["name"], {}), match["what"].lower()
                twice = twice or (cell if what in columns else "")
                columns.setdefault(what, i)
                unit = unit or match.groupdict().get("unit") or ""
        whole = {name: columns for name, columns in joints.items() if {"x", "y"} <= set(columns)}
        halves = [
            f"{n}_{'y' if 'x' in c else 'x'}" for n, c in joints.items() if n not in whole and {"x", "y"} & set(c)
        ]
        return cls(cells, whole, halves, twice, unit)

    @cached_property
    def number(self) -> int | None:
        """The column of frame numbers; beside it, or times, a column ``index`` numbers rows."""
        frame = next((i for i, cell in enumerate(self.cells) if _FRAME.fullmatch(cell)), None)
        return self.column(("index",)) if frame is None and self.time is None else frame

    @cached_property
    def who(self) -> int | None:
        """The column that tells people apart."""
        return self.column(WHO)

    @cached_property
    def time(self) -> tuple[int, str] | None:
        """The column of times, and their unit where its name tells."""
        units = ((i, time_unit(cell)) for i, cell in enumerate(self.cells))
        return next(((i, unit) for i, unit in units if unit is not None), None)

    def column(self, names: Sequence[str]) -> int | None:
        """The column that has the first of these names that is there."""
        lower = [cell.lower() for cell in self.cells]
        return next((lower.index(name) for name in names if name in lower), None)

    def left_out(self, read: Iterable[int]) -> list[str]:
        """What the columns of joints that are not among those that are read hold besides x and y."""
        used = set(read)
        out: dict[str, None] = {}
        for i, cell in enumerate(self.cells):
            ends = [s for s in re.finditer(r"[_. ]", cell) if i not in used and cell[: s.start()] in self.joints]
            if ends:
                out[re.sub(r" \[[^\]]*\]\Z", "", cell[ends[-1].end() :])] = None
        return [what for what in out if what.lower() not in ("x", "y")]

    @cached_property
    def others(self) -> list[int]:
        """Columns that are of no joint, no frame, no time and nobody."""
        known = {self.number, self.who, self.time and self.time[0]}
        of_joints = (_NUMBERED.match(cell) or _NAMED.match(cell) for cell in self.cells)
        return [i for i, is_joint in enumerate(of_joints) if not is_joint and i not in known]


def plain_name(cell: str) -> str:
    """A name without what keeps spreadsheets from taking it for a formula."""
    return re.sub(r"\A'(?=[=+\-@\t\r])", "", cell.strip())


def first_line(text: str) -> str:
    r"""The first line of a table, which goes on where a line break stands within quotes.

    >>> first_line('frame,"nose\ntip_x"\n1,2')
    'frame,"nose\ntip_x"'
    """
    whole = _LINE.match(text)
    end = whole.end() if whole else 0
    return text[:end] if text[end : end + 1] in ("", "\n") else text.partition("\n")[0]


def delimiter(line: str) -> str:
    """What stands between the cells of a line."""
    return max(",;\t", key=line.count)
