"""Rows of a table of text that nobody vouches for."""

from __future__ import annotations

import csv
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path

from kcs_torch.errors import FormatError
from kcs_torch.io.registry import read_error
from kcs_torch.io.tables.header import delimiter

__all__ = ["bounded_rows"]

LINES, LINE = 2**23, 2**23  # of a table of text, and letters of one


@contextmanager
def bounded_rows(path: Path) -> Iterator[Iterator[tuple[int, list[str]]]]:
    """Open a table of text: its rows that are not blank, and the number of the line at which each ends.

    Raises:
        FormatError: it cannot be read; a line is longer, or there are more, than any table of tracks has.
    """
    try:
        with path.open(newline="", encoding="utf-8-sig", errors="replace") as file:
            between = delimiter(file.readline(LINE))
            file.seek(0)
            rows = csv.reader(_bounded(file, path), delimiter=between)
            yield ((rows.line_num, row) for row in rows if any(row))
    except OSError as error:
        raise read_error(path, error) from None


def _bounded(file: Iterable[str], path: Path) -> Iterator[str]:
    for number, line in enumerate(file, 1):
        if len(line) > LINE or number > LINES:
            raise FormatError(f"{path}: line {number}: expected up to {LINES} lines of {LINE} letters: split the file")
        yield line
