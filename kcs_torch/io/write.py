"""Write results to files; the suffix chooses the format."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from kcs_torch.errors import OutputError
from kcs_torch.io.atomic import atomic_path
from kcs_torch.io.load import WRITERS
from kcs_torch.io.registry import Writer

if TYPE_CHECKING:
    from kcs_torch.types import Reconstruction

__all__ = ["save", "writer_for"]


def save(result: Reconstruction, path: str | Path) -> Path:
    """Write a result to a file in the format of its suffix (see ``kcs_torch.io.WRITERS``).

    Missing parent folders are created. The file appears whole or not at all; one that was there is replaced.

    Args:
        result: a :class:`Reconstruction`.
        path: where to; .npz (everything, exactly), .csv, .json, .html (a player) or .png (key frames).

    Returns:
        The path.

    Raises:
        OutputError: the suffix is unknown, or the file cannot be written; nothing is left half-written.
    """
    writer = writer_for(path)
    with atomic_path(path) as temporary:
        writer.write(result, temporary)
    return Path(path)


def writer_for(path: str | Path) -> Writer:
    """Return the writer that the suffix of a path chooses.

    Raises:
        OutputError: there is none; the message lists the suffixes.
    """
    suffix = Path(path).suffix.lower()
    if suffix not in WRITERS:
        got = f"'{suffix}'" if suffix else "none"
        raise OutputError(f"{path}: expected a file with one of the suffixes {', '.join(WRITERS)}, got {got}")
    return WRITERS[suffix]
