"""Results, and 3D motion, to look at: pages, pictures, films and recordings, of one person or of several."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch

from kcs_torch.io.registry import Saving, Writer
from kcs_torch.types import Diagnostics, Motion, Reconstruction

__all__ = ["WRITERS", "as_result"]

Results = Reconstruction | Sequence[Reconstruction]


def write_html(results: Results, path: Path) -> None:
    """Write the page of :func:`kcs_torch.viewer.player`."""
    from kcs_torch.viewer import player

    path.write_text(player(results), encoding="utf-8", errors="replace")


def write_png(result: Reconstruction, path: Path) -> None:
    """Write the figure of :func:`kcs_torch.viewer.sheet`."""
    from kcs_torch.viewer import sheet
    from kcs_torch.viewer.draw import any_letters

    with any_letters():
        sheet(result).savefig(path, format="png")


def write_gif(results: Results, path: Path) -> None:
    """Write the film of :func:`kcs_torch.viewer.animation` as a GIF."""
    from kcs_torch.viewer.animation import save_gif

    save_gif(results, path)


def write_mp4(results: Results, path: Path) -> None:
    """Write the film of :func:`kcs_torch.viewer.animation` as an MP4."""
    from kcs_torch.viewer.animation import save_mp4

    save_mp4(results, path)


def write_rrd(results: Results, path: Path) -> None:
    """Write the recording of :func:`kcs_torch.viewer.recording.save_recording`."""
    from kcs_torch.viewer.recording import save_recording

    save_recording(results, path)


def _mp4_ready() -> None:
    from kcs_torch.viewer.animation import find_ffmpeg

    find_ffmpeg()


def _rrd_ready() -> None:
    from kcs_torch.viewer.recording import need_rerun

    need_rerun()


def as_result(motion: Motion) -> Reconstruction:
    """Motion as a camera sees it that stands a little to the side and above: what pages and films show."""
    whole = replace(motion, points=motion.filled(), weights=torch.ones_like(motion.weights))
    points = whole.in_camera(yaw=20.0, pitch=8.0)
    frames = len(points)
    mean = motion.lengths
    variation = motion.variation
    return Reconstruction(
        points,
        torch.eye(3).to(points)[:2].expand(frames, 2, 3),
        torch.ones_like(points[:, 0, 0]),
        mean.nan_to_num(0.0),
        motion.tracks(yaw=20.0, pitch=8.0),
        "3D motion",
        Diagnostics(
            viewpoint_turn=math.nan,
            unseen_share=float((~motion.seen).double().mean()),
            bone_variation=variation.median,
            reprojection_rms=math.nan,
            converged=True,
            iterations=0,
            notes=(*motion.notes, "3D motion of a file, filmed from the side: no method made it"),
            largest_bone_variation=variation.largest,
            loosest_bone=variation.bone,
        ),
        units=motion.units or "units",
    )


def _shown(write: Callable[[Any, Path], None]) -> Callable[[Motion, Path, Saving], None]:
    """The same for motion."""
    return lambda motion, path, _: write(as_result(motion), path)


WRITERS = (
    Writer(
        ".html",
        "a page with a 3D player, the tracks beside it, lengths and uncertainty over time; works offline",
        write_html,
        _shown(write_html),
        write_people=write_html,
    ),
    Writer(
        ".png",
        "a sheet of key frames: the tracks, the motion from the camera and from the side",
        write_png,
        _shown(write_png),
    ),
    Writer(
        ".gif",
        "a film of at most 200 frames: the tracks and the turning motion",
        write_gif,
        _shown(write_gif),
        write_people=write_gif,
    ),
    Writer(
        ".mp4",
        "a film of at most 900 frames: the tracks and the turning motion",
        write_mp4,
        _shown(write_mp4),
        write_people=write_mp4,
        ready=_mp4_ready,
    ),
    Writer(
        ".rrd",
        "a recording for the rerun viewer",
        write_rrd,
        _shown(write_rrd),
        write_people=write_rrd,
        ready=_rrd_ready,
    ),
)
