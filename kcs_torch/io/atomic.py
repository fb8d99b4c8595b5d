"""Files that appear whole or not at all."""

from __future__ import annotations

import contextlib
import csv
import os
import secrets
import stat
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from kcs_torch.errors import KcsError, OutputError

__all__ = ["atomic_path", "write_table"]

WRITABLE = stat.S_IWUSR | stat.S_IWGRP | stat.S_IWOTH

ATTEMPTS = 100
"""How often a file is created in a folder that others, which write to it at the same time, make and remove."""


@contextlib.contextmanager
def atomic_path(path: str | Path) -> Iterator[Path]:
    """Give a temporary path beside ``path``, which takes its place when the block ends well.

    Missing parent folders are created. Whatever goes wrong, the temporary file and the folders made for it are
    removed again, and what was at ``path`` before stays as it was. A link is followed: its target is replaced. An
    OutputError of the block that names the temporary path names ``path`` instead.

    Raises:
        OutputError: ``path`` is a folder, a device or a read-only file, or cannot be written to.

    >>> import tempfile
    >>> folder = Path(tempfile.mkdtemp())
    >>> with atomic_path(folder / "new" / "a.txt") as temporary:
    ...     _ = temporary.write_text("whole")
    >>> (folder / "new" / "a.txt").read_text(), len(list((folder / "new").iterdir()))
    ('whole', 1)
    """
    target = _target(path)
    made: list[Path] = []
    # Short, so that it fits wherever the target's own name fits; the suffix tells some libraries the format.
    temporary = target.parent / f".{secrets.token_hex(4)}{target.suffix}"
    done = False
    try:
        _create(temporary, made)
        yield temporary
        os.replace(temporary, target)
        done = True
    except OSError as error:
        raise OutputError(f"{path}: cannot be written: {error.strerror or error}") from None
    except OutputError as error:  # who wrote knows the temporary name only
        raise OutputError(str(error).replace(str(temporary), str(path))) from None
    finally:
        if not done:
            with contextlib.suppress(OSError):
                temporary.unlink(missing_ok=True)
            with contextlib.suppress(OSError):
                for folder in reversed(made):
                    folder.rmdir()


def write_table(path: str | Path, rows: Iterable[Mapping[str, Any]], columns: Sequence[str] | None = None) -> None:
    """Write rows to a CSV file under a header, whole or not at all.

    Args:
        path: of the file.
        rows: from columns to values; what a row lacks is left empty.
        columns: in their order; by default all that rows have, as they come first.

    Raises:
        OutputError: as :func:`atomic_path`.

    >>> import tempfile
    >>> path = Path(tempfile.mkdtemp()) / "a.csv"
    >>> write_table(path, [{"case": "walk"}, {"case": "run", "mm": 3}])
    >>> path.read_text().split()
    ['case,mm', 'walk,', 'run,3']
    """
    rows = list(rows)
    names = list(dict.fromkeys(name for row in rows for name in row)) if columns is None else columns
    with atomic_path(path) as temporary, temporary.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, names)
        writer.writeheader()
        writer.writerows(rows)


def _target(path: str | Path) -> Path:
    """The file that a path means, links followed."""
    try:
        target = Path(os.path.realpath(path))
        if target.is_dir():
            raise OutputError(f"{path}: expected the name of a file, got a folder: add a file name")
        if target.exists() and not target.is_file():
            raise OutputError(f"{path}: expected the name of a file, got a device or pipe, which is not replaced")
        if target.exists() and not target.stat().st_mode & WRITABLE:  # a rename would not ask
            raise OutputError(f"{path}: is there and read-only: give another name, or make it writable first")
    except KcsError:
        raise
    except (OSError, ValueError) as error:  # ValueError: a null character in the path
        raise OutputError(f"{str(path)!r}: cannot be written: {getattr(error, 'strerror', None) or error}") from None
    return target


def _create(file: Path, made: list[Path]) -> None:
    """Create an empty file, and again its folders where another process that made them removes them meanwhile."""
    for attempt in range(1, ATTEMPTS + 1):
        try:
            _make_folders(file.parent, made)
            file.open("xb").close()  # with the permissions that the user's umask gives, unlike the tempfile module's
            return
        except FileNotFoundError:
            if attempt == ATTEMPTS:
                raise


def _make_folders(folder: Path, made: list[Path]) -> None:
    """Create a folder and its parents; each one created is added to ``made`` at once."""
    missing = []
    while not folder.exists():
        missing.append(folder)
        folder = folder.parent
    for new in reversed(missing):
        with contextlib.suppress(FileExistsError):  # another process was faster
            new.mkdir()
            made.append(new)
