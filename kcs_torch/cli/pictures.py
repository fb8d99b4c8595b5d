"""Pictures that commands write: a figure's suffix chooses the format."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from kcs_torch.cli.options import check_other

__all__ = ["PICTURES", "check_picture", "is_picture", "write_picture"]

PICTURES = (".png", ".svg", ".pdf")


def is_picture(path: Path) -> bool:
    """Whether the suffix is that of a picture."""
    return path.suffix.lower() in PICTURES


def check_picture(path: Path, *, source: str) -> None:
    """Make sure that a path is that of a picture, and not that of what is drawn.

    Raises:
        OutputError: it is not.
    """
    from kcs_torch.errors import OutputError

    if not is_picture(path):
        got = f"'{path.suffix}'" if path.suffix else "none"
        raise OutputError(f"{path}: expected a picture with one of the suffixes {', '.join(PICTURES)}, got {got}")
    check_other(path, source, "tracks")


def write_picture(draw: Callable[[], Any], path: Path) -> None:
    """Draw a matplotlib figure and write it, whole or not at all.

    Raises:
        OutputError: the place cannot be written to.
    """
    from kcs_torch.io.atomic import atomic_path
    from kcs_torch.viewer.draw import any_letters

    with atomic_path(path) as temporary, any_letters():
        draw().savefig(temporary, format=path.suffix[1:].lower())
