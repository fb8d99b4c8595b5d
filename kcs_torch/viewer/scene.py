"""What the player's page draws, as plain data: few enough numbers that a browser opens it, and small enough to send."""

from __future__ import annotations

import base64
import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kcs_torch.errors import OptionError, OutputError
from kcs_torch.metrics import difference
from kcs_torch.types import Reconstruction
from kcs_torch.types.arrays import as_doubles
from kcs_torch.types.intake import FARTHEST
from kcs_torch.viewer.colours import COLOURS, bone_keys, joint_keys
from kcs_torch.viewer.names import clip_rate, person_names
from kcs_torch.viewer.summary import summarise
from kcs_torch.viewer.together import beside, points_together

__all__ = ["MOST_NUMBERS", "scene_of"]

MOST_NUMBERS = 3_000_000
"""A page holds no more numbers than this, of two bytes each: about 8 MB as text. Longer clips show every n-th frame."""

LOST = 4.0  # points this many times farther from the body's middle than 99.5 % of them are drawn at that distance
WHOLE = 32767  # of 16-bit integers; -32768 stands for NaN
Array = NDArray[np.float64]


def scene_of(results: Sequence[Reconstruction], names: Sequence[str] | None = None) -> dict[str, Any]:
    """Collect what the page's script draws.

    Args:
        results: the people, one or more, in one unit.
        names: what to call them; found from their sources if None.

    Raises:
        OptionError: the frame rates differ, or the number of names does.
        OutputError: a result has no joint at a finite place.
    """
    rate = clip_rate(results, "player")
    names = person_names(results) if names is None else list(names)
    if len(names) != len(results):
        raise OptionError(f"player: expected {len(results)} names, got {len(names)}")
    total = max(len(r.points) for r in results)
    step = max(1, math.ceil(sum(map(_numbers, results)) / MOST_NUMBERS))
    shifts = beside(results)
    finite = [p[np.isfinite(p).all(-1)] for p in points_together(results)]
    for name, known in zip(names, finite, strict=True):
        if not len(known):
            raise OutputError(f"{name}: an HTML page needs at least one joint at a finite place")
        if (most := float(np.abs(known).max())) > FARTHEST:
            raise OutputError(f"{name}: an HTML page needs coordinates up to {FARTHEST:g}, got {most:.3g}: scale them")
    middle = np.median(np.concatenate(finite), axis=0)
    seen = [as_doubles(r.tracks.points)[r.tracks.seen.cpu().numpy()] for r in results]
    together = np.concatenate(seen)
    middle2d = np.median(together, axis=0) if len(together) else np.zeros(2)
    return {
        "total": total,
        "step": step,
        "fps": rate,
        "units": results[0].units,
        "middle": middle.tolist(),
        "colours": COLOURS,
        "people": [
            _person(r, n, slice(None, None, step), middle, middle2d, shift)
            for r, n, shift in zip(results, names, shifts, strict=True)
        ],
    }


def _numbers(result: Reconstruction) -> int:
    """How many 16-bit numbers a result takes."""
    frames, joints = result.points.shape[:2]
    solutions = 1 + len(result.alternatives)
    return frames * (joints * (4 * solutions + 3) + 14 * solutions)


def _person(
    result: Reconstruction, name: str, frames: slice, middle: Array, middle2d: Array, shift: Array
) -> dict[str, Any]:
    """One of the people, whose points are to be shifted and are told about the scene's middle."""
    body, tracks, middle = result.skeleton, result.tracks, middle - shift
    weights = as_doubles(tracks.weights)[frames]
    places = as_doubles(tracks.points)[frames] - middle2d
    return {
        "name": name,
        "summary": summarise(result),
        "shift": shift.tolist(),
        "frames": len(weights),
        "joints": list(body.joints),
        "sides": joint_keys(body),
        "observed": body.num_observed,
        "bones": [[*bone, key] for bone, key in zip(body.bones, bone_keys(body), strict=True)],
        "rigid": list(body.rigid),
        "solutions": [
            {"label": _label(result, other, k), **_solution(other, frames, middle, middle2d)}
            for k, other in enumerate((result, *result.alternatives))
        ],
        "tracks": _whole(np.where(weights[..., None] > 0, places, np.nan)),
        "weights": _encode((255 * np.clip(weights, 0, 1)).round().astype("u1"), "u1"),
    }


def _solution(result: Reconstruction, frames: slice, middle: Array, middle2d: Array) -> dict[str, Any]:
    """What solutions of the same tracks do not share."""
    path = result.root_depth if result.distance is None else result.distance
    return {
        **_motion(as_doubles(result.points)[frames] - middle),
        "path": None if path is None else _floats(as_doubles(path[frames])),
        "lens": None if result.distance is None else _lens(result, middle2d),
        "fit": None if result.distance is not None else _floats(_fit(result, middle, middle2d)[frames]),
        "spread": None if result.uncertainty is None else _whole(as_doubles(result.uncertainty[frames])),
    }


def _motion(points: Array) -> dict[str, Any]:
    """Joints about their middle in each frame, so that 16 bits resolve the body and not the room."""
    known = np.isfinite(points).all(-1, keepdims=True)
    centres = np.where(known, points, 0).sum(1) / np.maximum(known.sum(1), 1)
    return {"centres": _floats(centres), "points": _whole(np.where(known, points - centres[:, None], np.nan))}


def _fit(result: Reconstruction, middle: Array, middle2d: Array) -> Array:
    """(T, 3): scale and shift of each frame that take the middled points onto the middled tracks."""
    weights = as_doubles(result.tracks.weights)
    places = as_doubles(result.tracks.points) - middle2d
    scales = as_doubles(result.scales)
    drawn = scales[:, None, None] * (as_doubles(result.points) - middle)[..., :2]
    weights = np.where(np.isfinite(drawn).all(-1), weights, 0)[..., None]
    gap = np.where(weights > 0, places - drawn, 0)
    total = weights.sum(1)
    shift = (weights * gap).sum(1) / np.maximum(total, 1e-12)
    known = np.flatnonzero(total[:, 0] > 0)
    if len(known):  # frames in which nothing is seen: as in the frames beside them
        every = np.arange(len(shift))
        shift = np.stack([np.interp(every, known, column) for column in shift[known].T], 1)
    return np.concatenate([scales[:, None], shift], 1)


def _lens(result: Reconstruction, middle2d: Array) -> list[float]:
    """Focal lengths and principal point that take the points in space onto the middled tracks (least squares)."""
    space = as_doubles(result.in_space())
    known = result.tracks.seen.cpu().numpy() & np.isfinite(space).all(-1) & (space[..., 2] > 0)
    image = as_doubles(result.tracks.points)[known] - middle2d
    rays = space[known][:, :2] / space[known][:, 2:]
    lines = [np.polyfit(rays[:, a], image[:, a], 1) if len(rays) > 1 else np.zeros(2) for a in range(2)]
    return [float(lines[0][0]), float(lines[1][0]), float(lines[0][1]), float(lines[1][1])]


def _label(best: Reconstruction, other: Reconstruction, number: int) -> str:
    """What a solution is called in the list: its rank, its objective, and where it differs from the best."""
    value = f" · objective {other.objective:.1f}" if math.isfinite(other.objective) else ""
    if not number:
        return f"1 best{value}"
    return f"{number + 1} {_difference(best, other)}{value}"


def _difference(best: Reconstruction, other: Reconstruction) -> str:
    found = difference(best, other)
    if found.mirrored:
        return "nearly the mirror image" if found.beside_mirror else "mirror image"
    most = max(found.joints.values(), default=0.0)
    worst = [joint for joint, apart in found.joints.items() if apart > 0.6 * most]
    more = f" and {len(worst) - 2} more" if len(worst) > 2 else ""
    return f"other depth of {', '.join(worst[:2])}{more}" if worst else "much the same"


def _whole(values: Array) -> dict[str, Any]:
    """16-bit integers times a step; what is farther out than :data:`LOST` times nearly all others is drawn there."""
    known = np.abs(values[np.isfinite(values)])
    most = float(known.max()) if len(known) else 0.0
    if most > 0:
        most = min(most, max(LOST * float(np.quantile(known, 0.995)), 1e-30 * most))
    step = most / WHOLE or 1.0
    whole = np.clip(np.nan_to_num(values, nan=0, posinf=0, neginf=0) / step, -WHOLE, WHOLE).round()
    whole = np.where(np.isfinite(values), whole, -WHOLE - 1)
    return {**_encode(whole.astype("<i2"), "i2"), "step": step}


def _floats(values: Array) -> dict[str, Any]:
    return _encode(np.nan_to_num(values).astype("<f4"), "f4")


def _encode(values: NDArray[Any], kind: str) -> dict[str, Any]:
    return {"kind": kind, "data": base64.b64encode(np.ascontiguousarray(values).tobytes()).decode("ascii")}
