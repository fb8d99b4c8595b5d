"""A figure of key frames: the tracks, and the motion from the camera and from the side."""

from __future__ import annotations

import math
import textwrap
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from kcs_torch.errors import OptionError, OutputError
from kcs_torch.types import Reconstruction
from kcs_torch.types.arrays import as_doubles
from kcs_torch.types.hints import is_a
from kcs_torch.viewer.colours import COLOURS, bone_keys, joint_keys
from kcs_torch.viewer.draw import frame_alone, new_figure
from kcs_torch.viewer.layout import turned
from kcs_torch.viewer.names import printable
from kcs_torch.viewer.summary import summarise

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["sheet"]

TURN = 75.0  # degrees; of the view from the side
SIDE, WIDEST = 2.3, 2.6  # inches: the height of a picture, and the width of one, at most
ASPECT = 1.4  # width over height that a sheet comes near to
LETTERS = 12.0  # of a label that fit beside an inch of a picture
LOST = 4.0  # a box is this many times larger than 99 % of its points before the others are left out


def sheet(result: Reconstruction, *, frames: int = 8, turn: float = TURN) -> Figure:
    """Draw key frames: tracks above, 3D from the camera and from the side below.

    They are spread evenly over the frames in which anything is seen of the body; frames of wide bodies go on below. The
    left side of the body is blue, the right vermilion. All pictures of one kind have one scale.

    Args:
        result: the motion, (T, N, 3).
        frames: how many, at least 1.
        turn: degrees by which the lowest pictures look from the side.

    Returns:
        A matplotlib figure, of no window; ``figure.savefig(path)`` writes it.

    Raises:
        OptionError: ``frames`` is below 1.
        OutputError: no joint is at a finite place.
    """
    if not (is_a(frames, int) and frames >= 1):
        raise OptionError(f"frames: expected a whole number, at least 1, got {frames!r}")
    points = as_doubles(result.points)
    if not np.isfinite(points).all(-1).any():
        raise OutputError("a picture needs at least one joint at a finite place")
    tracks = as_doubles(result.tracks.points)
    seen = result.tracks.seen.cpu().numpy()
    tracks = np.where(seen[..., None], tracks, np.nan)
    shown = np.flatnonzero(seen.any(1)) if seen.any() else np.arange(len(points))
    chosen = shown[np.unique(np.linspace(0, len(shown) - 1, frames).round().astype(int))]
    points = points[chosen]
    aside = turned(points, turn)
    kinds = [
        ("tracks", tracks[chosen], None),
        ("3D, from the camera", points[..., :2], points[..., 2]),
        (f"3D, turned {turn:g}°", aside[..., :2], aside[..., 2]),
    ]
    return _draw(result, chosen, kinds)


def _draw(result: Reconstruction, chosen: NDArray[Any], kinds: list[Any]) -> Figure:
    halves = [_half_width(places) for _, places, _ in kinds]
    shapes = [float(h[0] / h[1]) for h in halves]
    width = min(max(SIDE * max(shapes), SIDE / 2), WIDEST)
    heights = [min(SIDE, width / shape) for shape in shapes]
    columns, size = _arrange(len(chosen), width + 0.08, sum(heights) + 0.25)
    bands = math.ceil(len(chosen) / columns)
    figure = new_figure(*size, 130, "constrained")
    axes = figure.subplots(bands * len(kinds), columns, squeeze=False, height_ratios=heights * bands)
    axes = axes.reshape(bands, len(kinds), columns).swapaxes(0, 1)  # by kind, band and column
    title = [f"{result.method}: {Path(result.tracks.source).name}", summarise(result)]
    title += [result.diagnostics.brief_doubt] if result.diagnostics.doubt else []
    words = [line for text in title for line in textwrap.wrap(text, int(14 * size[0]))]
    figure.suptitle(printable("\n".join(words)), fontsize=9, parse_math=False)
    for (label, places, depths), half, lines, height in zip(kinds, halves, axes, heights, strict=True):
        for spare in lines.flat[len(chosen) :]:
            spare.remove()
        for i, axis in enumerate(lines.flat[: len(chosen)]):
            _body(axis, result, places[i], None if depths is None else depths[i])
            middle = _middle(places[i])
            axis.set_xlim(middle[0] - half[0], middle[0] + half[0])
            axis.set_ylim(middle[1] + half[1], middle[1] - half[1])  # y is down
            axis.set_aspect("equal")
            frame_alone(axis)
            if label == "tracks":
                axis.set_title(_when(int(chosen[i]), result.fps), fontsize=8)
        for line in lines:
            line[0].set_ylabel(textwrap.fill(label, max(int(LETTERS * height), 9)), fontsize=9)
    return figure


def _arrange(count: int, width: float, height: float) -> tuple[int, tuple[float, float]]:
    """How many columns let pictures of this size make a sheet of good shape, and the sheet's size, in inches."""
    bands = [(math.ceil(count / number), number) for number in range(1, count + 1)]
    sizes = [(columns, (max(width * columns + 0.4, 6.4), height * number + 0.6)) for columns, number in bands]
    return min(sizes, key=lambda one: abs(math.log(one[1][0] / one[1][1] / ASPECT)))


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
