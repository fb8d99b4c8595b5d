"""Results to look at: pages, pictures, films and recordings, of one person or of several."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from pathlib import Path

from kcs_torch.io.registry import Writer
from kcs_torch.types import Reconstruction

__all__ = ["WRITERS"]

Results = Reconstruction | Sequence[Reconstruction]


def write_html(results: Results, path: Path) -> None:
    """Write the page of :func:`kcs_torch.viewer.player`."""
    from kcs_torch.viewer import player

    path.write_text(player(results), encoding="utf-8", errors="replace")


def write_png(result: Reconstruction, path: Path) -> None:
    """Write the figure of :func:`kcs_torch.viewer.sheet`."""
    from kcs_torch.viewer import sheet

    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="Glyph")  # a file's name may hold letters that the font has not
        sheet(result).savefig(path, format="png")


def write_gif(results: Results, path: Path) -> None:
    """Write the film of :func:`kcs_torch.viewer.animation` as a GIF."""
    from kcs_torch.viewer.animation import save_gif

    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="Glyph")
        save_gif(results, path)


def write_mp4(results: Results, path: Path) -> None:
    """Write the film of :func:`kcs_torch.viewer.animation` as an MP4."""
    from kcs_torch.viewer.animation import save_mp4

    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="Glyph")
        save_mp4(results, path)


def write_rrd(results: Results, path: Path) -> None:
    """Write the recording of :func:`kcs_torch.viewer.recording.save_recording`."""
    from kcs_torch.viewer.recording import save_recording

    save_recording(results, path)


WRITERS = (
    Writer(
        ".html",
        "a page with a 3D player, the tracks beside it, lengths and uncertainty over time; works offline",
        write_html,
        write_people=write_html,
    ),
    Writer(".png", "a sheet of key frames: the tracks, the motion from the camera and from the side", write_png),
    Writer(
        ".gif", "a film of at most 200 frames: the tracks and the turning motion", write_gif, write_people=write_gif
    ),
    Writer(
        ".mp4", "a film of at most 900 frames: the tracks and the turning motion", write_mp4, write_people=write_mp4
    ),
    Writer(".rrd", "a recording for the rerun viewer", write_rrd, write_people=write_rrd),
)
