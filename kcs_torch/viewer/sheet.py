"""A figure of key frames: the tracks, and the motion from the camera and from the side."""

from __future__ import annotations

import textwrap
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from kcs_torch.errors import OptionError, OutputError
from kcs_torch.types import Reconstruction
from kcs_torch.viewer.colours import COLOURS, bone_keys, joint_keys
from kcs_torch.viewer.names import printable
from kcs_torch.viewer.summary import summarise

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["sheet"]

TURN = 75.0  # degrees; of the view from the side
LOST = 4.0  # a box is this many times larger than 99 % of its points before the others are left out


def sheet(result: Reconstruction, *, frames: int = 8, turn: float = TURN) -> Figure:
    """Draw key frames, evenly spread over the clip: tracks above, 3D from the camera and from the side below.

    The left side of the body is blue, the right vermilion. All pictures of a row have one scale.

    Args:
        result: the motion, (T, N, 3).
        frames: how many, at least 1.
        turn: degrees by which the lowest row looks from the side.

    Returns:
        A matplotlib figure, of no window; ``figure.savefig(path)`` writes it.

    Raises:
        OptionError: ``frames`` is below 1.
        OutputError: matplotlib is not installed, or no joint is at a finite place.
    """
    if frames < 1:
        raise OptionError(f"frames: expected at least 1, got {frames}")
    try:
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure
    except ImportError as error:
        raise OutputError(f"a picture needs the package matplotlib ({error}): pip install matplotlib") from None
    points = result.points.detach().cpu().double().numpy()
    if not np.isfinite(points).all(-1).any():
        raise OutputError("a picture needs at least one joint at a finite place")
    tracks = result.tracks.points.detach().cpu().double().numpy()
    tracks = np.where(result.tracks.seen.cpu().numpy()[..., None], tracks, np.nan)
    chosen = np.unique(np.linspace(0, len(points) - 1, frames).round().astype(int))
    angle = np.radians(turn)
    right = np.array([np.cos(angle), 0, np.sin(angle)])  # the camera's x axis, turned about the vertical
    away = np.array([-np.sin(angle), 0, np.cos(angle)])
    rows = [
        ("tracks", tracks[chosen], None),
        ("3D, from the camera", points[chosen][..., :2], points[chosen][..., 2]),
        (f"3D, turned {turn:g}°", np.stack([points @ right, points[..., 1]], -1)[chosen], (points @ away)[chosen]),
    ]
    return _draw(result, chosen, rows, Figure, FigureCanvasAgg)


def _draw(result: Reconstruction, chosen: NDArray[Any], rows: list[Any], figure_type: Any, canvas_type: Any) -> Figure:
    halves = [_half_width(places) for _, places, _ in rows]
    height = 2.3  # of a row; a column is as wide as its poses
    width = height * float(np.clip(max(h[0] / h[1] for h in halves), 0.5, 1.6)) + 0.08
    size = (max(width * len(chosen) + 0.4, 6.4), height * len(rows) + 0.8)
    figure = figure_type(figsize=size, dpi=130, layout="constrained")
    canvas_type(figure)
    axes = figure.subplots(len(rows), len(chosen), squeeze=False)
    title = [f"{result.method}: {Path(result.tracks.source).name}", summarise(result)]
    lines = [line for text in title for line in textwrap.wrap(text, int(14 * size[0]))]
    figure.suptitle(printable("\n".join(lines)), fontsize=9, parse_math=False)
    for (label, places, depths), half, line in zip(rows, halves, axes, strict=True):
        for i, axis in enumerate(line):
            _body(axis, result, places[i], None if depths is None else depths[i])
            middle = _middle(places[i])
            axis.set_xlim(middle[0] - half[0], middle[0] + half[0])
            axis.set_ylim(middle[1] + half[1], middle[1] - half[1])  # y is down
            axis.set_aspect("equal")
            axis.set_xticks([])
            axis.set_yticks([])
            for spine in axis.spines.values():
                spine.set_color("#dddddd")
            if label == "tracks":
                axis.set_title(_when(int(chosen[i]), result.fps), fontsize=8)
        line[0].set_ylabel(label, fontsize=9)
    return figure


def _body(axis: Any, result: Reconstruction, places: NDArray[Any], depth: NDArray[Any] | None) -> None:
    """One pose: bones with both ends known, far ones first, and joints."""
    from matplotlib.collections import LineCollection

    body = result.skeleton
    known = np.isfinite(places).all(-1)
    bones = [b for b, (p, c) in enumerate(body.bones) if known[p] and known[c]]
    if depth is not None:
        bones.sort(key=lambda b: -depth[list(body.bones[b])].mean())
    segments = [places[list(body.bones[b])] for b in bones]
    keys, ends = bone_keys(body), joint_keys(body)
    colours = [COLOURS[keys[b]] for b in bones]
    axis.add_collection(LineCollection(segments, colors=colours, linewidths=1.8, capstyle="round"))
    dots = np.flatnonzero(known)
    axis.scatter(*places[dots].T, s=5, c=[COLOURS[ends[j]] for j in dots], zorder=3)


def _middle(places: NDArray[Any]) -> NDArray[Any]:
    """Middle of the box around the known joints of one frame; the origin where there is none."""
    known = places[np.isfinite(places).all(-1)]
    return (known.min(0) + known.max(0)) / 2 if len(known) else np.zeros(2)


def _half_width(places: NDArray[Any]) -> NDArray[Any]:
    """Half the size, with a margin, of a box that every chosen pose fits into."""
    known = [p[np.isfinite(p).all(-1)] for p in places]
    sizes = np.array([np.ptp(k, axis=0) for k in known if len(k)] or [[1.0, 1.0]])
    size = np.minimum(sizes.max(0), LOST * np.median(sizes, axis=0) + 1e-9)
    return 0.55 * np.maximum(size, 0.3 * size.max()) + 1e-9


def _when(frame: int, fps: float | None) -> str:
    return f"frame {frame}" + (f" ({frame / fps:.2f} s)" if fps else "")
