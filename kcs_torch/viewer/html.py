"""A page with a 3D player that needs nothing but a browser."""

from __future__ import annotations

import base64
import html
import json
import math
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kcs_torch.errors import OutputError
from kcs_torch.types import Reconstruction
from kcs_torch.viewer.colours import COLOURS, bone_side
from kcs_torch.viewer.summary import summarise

__all__ = ["player"]

FPS = 25.0  # played at this rate where the tracks' own is unknown
GRID_LINES = 12


def player(result: Reconstruction, *, title: str | None = None) -> str:
    """Make a self-contained HTML page that plays a motion: orbit, play and pause, frame slider, mirror image.

    It draws with y up. The left side of the body is blue, the right vermilion, what is between them grey.
    The page holds plotly.js and needs no network.

    Args:
        result: the motion, (T, N, 3).
        title: of the page; the source and the method if None.

    Returns:
        The page's text, about 5 MB.

    Raises:
        OutputError: plotly is not installed, or no joint is at a finite place.
    """
    try:
        from plotly.offline import get_plotlyjs
    except ImportError as error:
        raise OutputError(f"an HTML page needs the package plotly ({error}): pip install plotly") from None
    if title is None:
        title = f"{result.method}: {Path(result.tracks.source).name}"
    folder = Path(__file__).parent
    notes = [*result.diagnostics.notes, *result.tracks.notes]
    parts = {
        "TITLE": html.escape(title),
        "SUMMARY": html.escape(summarise(result)),
        "NOTES": "".join(f"<li>{html.escape(n)}</li>" for n in notes),
        "DATA": _script_safe(json.dumps(_scene(result), allow_nan=False)),
        "PLAYER": (folder / "player.js").read_text(encoding="utf-8"),
        "PLOTLY": get_plotlyjs(),
    }
    page = (folder / "player.html").read_text(encoding="utf-8")
    head, *tail = page.split("@@")  # text, key, text, key, ..., text: nothing of a value is looked at again
    return head + "".join(parts[k] + text for k, text in zip(tail[::2], tail[1::2], strict=True))


def _scene(result: Reconstruction) -> dict[str, Any]:
    """What the script draws. Its axes are x right, y away from the viewer, z up."""
    body = result.skeleton
    points = result.points.detach().cpu().double().numpy()
    points = np.stack([points[..., 0], points[..., 2], -points[..., 1]], -1)
    if not np.isfinite(points).all(-1).any():
        raise OutputError("an HTML page needs at least one joint at a finite place")
    middle = np.median(points[np.isfinite(points).all(-1)], axis=0)
    points = points - middle  # so that float32 does not lose small motion far from the origin
    centres = _centres(points)
    fixed = _box(points)
    follow = _box(points - centres[:, None])
    sides = [bone_side(body, b) for b in range(body.num_bones)]
    return {
        "frames": len(points),
        "joints": [html.escape(j) for j in body.joints],  # plotly reads tags in its labels
        "bones": {s: [list(b) for b, side in zip(body.bones, sides, strict=True) if side == s] for s in COLOURS},
        "sides": [body.side(j) for j in range(body.num_joints)],
        "colours": COLOURS,
        "fps": result.fps or FPS,
        "clock": result.fps is not None,
        "points": base64.b64encode(points.astype("<f4").tobytes()).decode("ascii"),
        "centres": base64.b64encode(centres.astype("<f4").tobytes()).decode("ascii"),
        "fixed": fixed,
        "follow": follow,
    }


def _centres(points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Mean of the finite joints of each frame: (T, N, 3) -> (T, 3); 0 where there is none."""
    known = np.isfinite(points).all(-1, keepdims=True)
    return np.where(known, points, 0).sum(1) / np.maximum(known.sum(1), 1)


def _box(points: NDArray[np.float64]) -> dict[str, Any]:
    """Ranges of the axes, the same in both mirror images, and the grid's spacing."""
    flat = points[np.isfinite(points).all(-1)]
    low, high = flat.min(0), flat.max(0)
    inner_low, inner_high = np.quantile(flat, [0.005, 0.995], axis=0)
    far = (high - low) > 4 * np.maximum(inner_high - inner_low, 1e-12)  # a few lost points would leave a speck of body
    low, high = np.where(far, inner_low, low), np.where(far, inner_high, high)
    depth = max(abs(low[1]), abs(high[1]))
    low[1], high[1] = -depth, depth
    size = max(float((high - low).max()), 1e-9)
    least = 0.25 * size
    grow = np.maximum(least - (high - low), 0) / 2
    grow[2] = 0
    ground = float(low[2])  # where the lowest joint comes
    low, high = low - grow - 0.05 * size, high + grow + 0.05 * size
    return {"low": low.tolist(), "high": high.tolist(), "ground": ground, "grid": _nice(size / GRID_LINES)}


def _nice(step: float) -> float:
    """The next of 1, 2, 5, 10, 20, ... (times powers of ten) above a step."""
    power = 10.0 ** math.floor(math.log10(step))
    return next(m * power for m in (1, 2, 5, 10) if m * power >= step * (1 - 1e-9))


def _script_safe(text: str) -> str:
    """JSON that cannot end its script element."""
    return text.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026")
