"""Names beside points, placed so that they cover neither each other nor what is drawn."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kcs_torch.viewer.names import printable

__all__ = ["write_labels"]

DIRECTIONS = 24
RADII = np.array([7, 11, 16, 22, 30, 40, 52, 66, 84, 106, 132, 162, 200, 250.0])  # points
FROM = 14.0  # points from which on a thin line joins name and joint
Array = NDArray[np.float64]


def write_labels(
    axis: Any, places: Array, names: Sequence[str], colours: Sequence[str], lines: Array, *, size: float = 9.0
) -> None:
    """Write a name beside each place of a matplotlib axis whose limits are set.

    Each name takes the free spot nearest to its joint, outward first, one after another: a joint with many neighbours
    chooses early.

    Args:
        axis: the axes.
        places: (N, 2) in data coordinates; NaN gets no name.
        names: N of them.
        colours: N of them.
        lines: (L, 2, 2) segments that names should not cover.
        size: of the letters, in points.
    """
    from matplotlib.patheffects import withStroke

    figure = axis.figure
    point = figure.dpi / 72  # pixels
    known = np.flatnonzero(np.isfinite(places).all(-1)).tolist()
    if not known:
        return
    pixels = axis.transData.transform(places[known])
    along = np.linspace(0, 1, 60)[:, None, None]
    drawn = axis.transData.transform(((1 - along) * lines[:, 0] + along * lines[:, 1]).reshape(-1, 2))
    frame = axis.get_window_extent()
    gaps = np.linalg.norm(pixels[:, None] - pixels, axis=-1)
    crowd = (np.exp(-gaps / (30 * point))).sum(1)
    outward = pixels - np.median(pixels, axis=0)
    taken = np.zeros((0, 4))
    texts = [_plain(names[j]) for j in known]
    for i in np.argsort(-crowd, kind="stable"):
        look: dict[str, Any] = {
            "fontsize": size,
            "color": colours[known[i]],
            "va": "center",
            "ha": "center",
            "parse_math": False,
        }
        text = axis.text(
            0, 0, texts[i], zorder=5, path_effects=[withStroke(linewidth=2.5, foreground="#ffffffd0")], **look
        )
        extent = text.get_window_extent(figure.canvas.get_renderer())
        half = np.array([extent.width, extent.height]) / 2 + 1.5 * point
        middle, cost = _candidates(pixels[i], half, outward[i], point)
        low, high = middle - half, middle + half
        cost = cost + 40 * (_overlap(low, high, taken[:, :2], taken[:, 2:]) > 0).sum(1)
        cost = cost + 6 * _inside(low, high, pixels) + 0.5 * _inside(low, high, drawn)
        out = (low < [frame.x0, frame.y0]).any(1) | (high > [frame.x1, frame.y1]).any(1)
        best = int(np.argmin(cost + 100 * out))
        taken = np.concatenate([taken, np.concatenate([low[best], high[best]])[None]])
        text.set_position(axis.transData.inverted().transform(middle[best]))
        gap = np.maximum(np.abs(middle[best] - pixels[i]) - half, 0)
        if np.hypot(*gap) > FROM * point:
            edge = np.clip(pixels[i], low[best], high[best])
            ends = axis.transData.inverted().transform(np.stack([pixels[i], edge]))
            axis.plot(*ends.T, color=colours[known[i]], linewidth=0.5, alpha=0.6, zorder=1)


def _candidates(pixel: Array, half: Array, outward: Array, point: float) -> tuple[Array, Array]:
    """Middles (C, 2) of the spots a name may take, and what each costs: distance, and not being outward."""
    angle = np.linspace(0, 2 * np.pi, DIRECTIONS, endpoint=False)
    away = np.stack([np.cos(angle), np.sin(angle)], -1)
    # As far from the joint as the box reaches in this direction.
    reach = np.minimum(half[0] / np.maximum(np.abs(away[:, 0]), 1e-9), half[1] / np.maximum(np.abs(away[:, 1]), 1e-9))
    radius = RADII[:, None] * point + reach
    middle = pixel + radius[..., None] * away
    length = max(float(np.hypot(*outward)), 1e-9)
    cost = 0.12 * RADII[:, None] + 0.8 * (1 - away @ (outward / length)) + 0.4 * np.abs(away[:, 1])
    return middle.reshape(-1, 2), np.broadcast_to(cost, radius.shape).reshape(-1)


def _overlap(low: Array, high: Array, lows: Array, highs: Array) -> Array:
    shared = np.minimum(high[:, None], highs) - np.maximum(low[:, None], lows)
    return np.maximum(shared, 0).prod(-1)


def _inside(low: Array, high: Array, points: Array) -> Array:
    """How many points lie in each of the boxes (C,)."""
    x, y = points.T  # by coordinate, as arrays of pairs take ten times as long
    return ((x >= low[:, :1]) & (x <= high[:, :1]) & (y >= low[:, 1:]) & (y <= high[:, 1:])).sum(1)


def _plain(name: str) -> str:
    """A name as one line of letters that can be drawn, not too long."""
    line = " ".join(printable(name).split())
    return line if len(line) <= 40 else line[:39] + "…"
