"""Results to look at: .html, a 3D player, and .png, a sheet of key frames."""

from __future__ import annotations

import warnings
from pathlib import Path

from kcs_torch.io.registry import Writer
from kcs_torch.types import Reconstruction

__all__ = ["WRITERS"]


def write_html(result: Reconstruction, path: Path) -> None:
    """Write the page of :func:`kcs_torch.viewer.player`."""
    from kcs_torch.viewer import player

    path.write_text(player(result), encoding="utf-8", errors="replace")


def write_png(result: Reconstruction, path: Path) -> None:
    """Write the figure of :func:`kcs_torch.viewer.sheet`."""
    from kcs_torch.viewer import sheet

    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="Glyph")  # a file's name may hold letters that the font has not
        sheet(result).savefig(path, format="png")


WRITERS = (
    Writer(".html", "a page with a 3D player: orbit, play, left and right in colours; works offline", write_html),
    Writer(".png", "a sheet of key frames: the tracks, the motion from the camera and from the side", write_png),
)
