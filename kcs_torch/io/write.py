"""Write results to files; the suffix chooses the format."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from kcs_torch.errors import OutputError
from kcs_torch.io.atomic import atomic_path
from kcs_torch.io.load import WRITERS

if TYPE_CHECKING:
    from kcs_torch.types import Reconstruction

__all__ = ["save"]


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
    path = Path(path)
    suffix = path.suffix.lower()
    if suffix not in WRITERS:
        has = f"'{suffix}'" if suffix else "none"
        raise OutputError(f"{path}: expected a file with one of the suffixes {', '.join(WRITERS)}, got {has}")
    with atomic_path(path) as temporary:
        WRITERS[suffix].write(result, temporary)
    return path
