"""What users pass, checked: arrays, numbers, and the skeleton that fits them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from numbers import Real
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from kcs_torch.errors import KcsError, OptionError, ShapeError, counted
from kcs_torch.skeleton import Skeleton, get_skeleton, guess_skeleton
from kcs_torch.types.bodies import choose_skeleton, joint_order

__all__ = [
    "FARTHEST",
    "RATES",
    "Intake",
    "as_floats",
    "as_number",
    "as_weights",
    "at_one_point",
    "at_the_corner",
    "check_places",
    "check_rate",
    "take_in",
]

FARTHEST = 1e30  # of coordinates: their sums are finite in single precision, in which pages are written

STRAY = 1e12
"""Distance from the clip's middle, over its median or over 1, from which on a joint's number is that of no body."""

WITHIN = 0.9
"""Share of the joints beyond (0, 0) from which on this is the image's corner."""

RATES = 1e-6, 1e6
"""Frames a second, lowest and highest: a frame in eleven days, and a million a second."""


def as_floats(value: Any, what: str, ndim: int | None) -> Tensor:
    """An array-like as a floating tensor of ``ndim`` dimensions, or of any number if that is None.

    Tensors keep their device and single precision.

    What a masked array masks is NaN.

    Raises:
        ShapeError: it is no array of real numbers, or has another number of dimensions.
    """
    if not isinstance(value, Tensor):
        try:
            array = np.asanyarray(value)
            value = torch.as_tensor(array if np.iscomplexobj(array) else np.ma.filled(array.astype(np.float64), np.nan))
        except (TypeError, ValueError, OverflowError, RuntimeError):
            kind = f"one of {value.dtype}" if isinstance(value, np.ndarray) else type(value).__name__
            hint = "; kcs_torch.load_tracks reads files" if isinstance(value, (str, Path)) else ""
            if isinstance(value, (list, tuple)) and any(item is None for item in value):
                hint = " with None in it: a frame that shows nobody is one of NaN"
            elif isinstance(value, (list, tuple)) and any(isinstance(item, Tensor) for item in value):
                hint = " of tensors: torch.stack makes one of them"
            raise ShapeError(f"{what}: expected an array of numbers, got {kind}{hint}") from None
    if value.is_complex():
        raise ShapeError(f"{what}: expected real numbers, got {str(value.dtype).removeprefix('torch.')}")
    if ndim is not None and value.ndim != ndim:
        raise ShapeError(f"{what}: expected {ndim} dimensions, got shape {tuple(value.shape)}")
    if value.dtype in (torch.float16, torch.bfloat16):
        return value.float()  # no factorisation takes half precision
    return value if value.is_floating_point() else value.double()


def as_number(value: Any) -> float | None:
    """A real number as a float; None for anything else (True is none), and for whole numbers larger than any float."""
    try:
        return float(value) if not isinstance(value, bool) and isinstance(value, Real) else None
    except OverflowError:
        return None


def check_rate(value: Any, what: str, hint: str = "", error: type[KcsError] = OptionError) -> float:
    """Frames a second that tracks may have, as a number.

    Raises:
        KcsError: the one given: it is no number, or beyond RATES.
    """
    rate = as_number(value)
    if rate is None or not RATES[0] <= rate <= RATES[1]:
        limits = f"frames a second, {RATES[0]:g} to {RATES[1]:g}"
        raise error(f"{what}: expected a positive number, got {value!r}{hint} ({limits})")
    return rate


def at_the_corner(points: Tensor, seen: Tensor, notes: list[str], *, alone: bool = False) -> Tensor:
    """Which joints (..., N) of points (..., N, 2) lie exactly at (0, 0), or at (-1, -1), and others beyond (0, 0).

    Detectors write unseen joints so. About a middle that is 0 the others lie all around; of a person at the image's
    edge a few may lie beside it. Where there are no others, ``alone`` decides.
    """
    zero, minus = (seen & (points == place).all(-1) for place in (0, -1))
    corner = zero | minus
    if not bool(corner.any()):
        return corner
    beyond = (points[seen & ~corner] > 0).all(-1)
    if not (int(beyond.sum()) / len(beyond) >= WITHIN if len(beyond) else alone):
        return torch.zeros_like(corner)
    for count, place in ((int(zero.sum()), "(0, 0)"), (int(minus.sum()), "(-1, -1)")):
        if count:
            are = f"joint that lies exactly at {place} is" if count == 1 else f"joints that lie exactly at {place} are"
            notes.append(f"{count} {are} taken as unseen: NaN, or a confidence of 0, says so more clearly")
    return corner


def at_one_point(points: Tensor, seen: Tensor) -> Tensor:
    """Which frames (...) of points (..., N, D) show three joints or more, and all of them at exactly the same place.

    No body looks so: unseen frames are written so about a middle that is 0, or filled.
    """
    far = torch.full_like(points, math.inf)
    low, high = torch.where(seen[..., None], points, far).amin(-2), torch.where(seen[..., None], points, -far).amax(-2)
    return (low == high).all(-1) & (seen.sum(-1) > 2)


class Intake(NamedTuple):
    """Arrays of one body's motion, checked: observed joints in the skeleton's order, 0 where unseen."""

    points: Tensor  # (T, num_observed, dims)
    weights: Tensor  # (T, num_observed)
    skeleton: Skeleton
    fps: float | None
    notes: list[str]


def check_places(points: Tensor, what: str, joints: Sequence[str]) -> None:
    """Make sure that points (..., N, D) of joints are NaN or a number that can be reckoned with.

    Raises:
        ShapeError: one is infinite or too large.
    """
    infinite = torch.isinf(points).any(-1)
    if infinite.any():
        raise ShapeError(f"{what}: {_label(infinite, joints)} is infinite; write NaN where a joint is unseen")
    large = (points.abs() > FARTHEST).any(-1)
    if large.any():
        most = float(points[large].abs().nan_to_num().max())
        raise ShapeError(f"{what}: {_label(large, joints)}: expected coordinates up to {FARTHEST:g}, got {most:.3g}")


def as_weights(confidence: Tensor, seen: Tensor, threshold: float, what: str, joints: Sequence[str]) -> Tensor:
    """Weights (..., N) by confidences: 0 where joints are not ``seen``, or with less confidence than the threshold.

    Raises:
        ShapeError: the shape is another, or a confidence is out of range.
    """
    if confidence.shape != seen.shape:
        raise ShapeError(f"{what}: expected shape {tuple(seen.shape)}, got {tuple(confidence.shape)}")
    infinite = torch.isinf(confidence)
    if infinite.any():
        raise ShapeError(f"{what}: {_label(infinite, joints)} is infinite; expected 0..1")
    weights = torch.nan_to_num(confidence, nan=0.0)
    if (weights < 0).any():
        raise ShapeError(f"{what}: {_label(weights < 0, joints)} is negative; expected 0..1")
    if (weights > 1).any():
        most = float(weights.max())
        raise ShapeError(
            f"{what}: {_label(weights > 1, joints)} is {most:g} at most; expected 0..1: divide by the largest"
        )
    return torch.where(seen & (weights >= threshold), weights, torch.zeros_like(weights))


def _label(bad: Tensor, joints: Sequence[str]) -> str:
    """The first of the joints (N,) of one frame, or (T, N) of several, that are bad."""
    *frame, joint = bad.nonzero()[0].tolist()
    return f"{f'frame {frame[0]}, ' if frame else ''}joint '{joints[joint]}'"


def _other_dimensions(shape: Sequence[int], dims: int) -> str:
    """How to make points (frames, joints, dims) of an array of another number of dimensions, for the user."""
    if len(shape) == 4 and shape[-1] == dims:
        return ": give one clip at a time, or reconstruct_all a list of Tracks"
    if len(shape) == 2 and shape[-1] == dims:
        return ": of a single frame points[None]"
    if len(shape) == 2 and shape[-1] % dims == 0:
        return f": of flat rows points.reshape({shape[0]}, {shape[-1] // dims}, {dims})"
    return ""


def take_in(
    points: Any,
    confidence: Any,
    *,
    dims: int,
    skeleton: str | Path | Skeleton | None,
    joint_names: Sequence[str] | None,
    edges: Any,
    fps: float | None,
    threshold: float,
    source: str,
    notes: Sequence[str],
) -> Intake:
    """Check arrays of one body's motion in ``dims`` dimensions; arguments and errors as of ``Tracks.from_arrays``."""
    remarks = [notes] if isinstance(notes, str) else list(notes)
    xy, confidence = _shaped(points, confidence, dims, source)
    num_joints, rate = xy.shape[1], _rate(fps, source)
    least = as_number(threshold)
    if least is None or not 0 <= least <= 1:
        raise OptionError(f"{source}: threshold: expected a confidence within 0..1, got {threshold!r}")
    names = None if joint_names is None else [str(n) for n in joint_names]
    if names is not None and len(names) != num_joints:
        raise ShapeError(f"{source}: joint_names: expected {num_joints} names, got {len(names)}")
    if skeleton is None and names is not None and edges is None:
        skeleton = guess_skeleton(names, ordered=False)
    if skeleton is not None and names is not None:
        order = joint_order(names, get_skeleton(skeleton), source, remarks)
        if order is not None:  # -1 is the column of a joint that is not there
            xy = torch.nn.functional.pad(xy, (0, 0, 0, 1), value=math.nan)[:, order]
            confidence = confidence if confidence is None else torch.nn.functional.pad(confidence, (0, 1))[:, order]
    body = choose_skeleton(skeleton, names, edges, xy.shape[1], source, remarks)
    check_places(xy, f"{source}: points", body.joints)
    seen = torch.isfinite(xy).all(-1)
    if confidence is None and dims == 2:
        seen = seen & ~at_the_corner(xy, seen, remarks)
    if confidence is None:
        weights = seen.to(xy.dtype)
    else:
        weights = as_weights(confidence.to(xy), seen, threshold, f"{source}: confidence", body.joints)
    weights = _without_points(xy, weights, remarks)
    seen = weights > 0
    if not seen.any():
        raise ShapeError(
            f"{source}: no joint is seen in any frame (confidence threshold {threshold:g}): nothing to reconstruct"
        )
    _check_near(xy, seen, body, source)
    xy = torch.where(seen[..., None], xy, torch.zeros_like(xy))
    return Intake(xy, weights, body, rate, remarks)


def _without_points(points: Tensor, weights: Tensor, notes: list[str]) -> Tensor:
    """Weights (T, N) that are 0 in frames whose joints all lie at one point, where other frames show a body."""
    seen = weights > 0
    blank = at_one_point(points, seen)
    if not bool(blank.any()) or not bool((~blank & (seen.sum(1) > 2)).any()):
        return weights
    count = int(blank.sum())
    are = "is" if count == 1 else "are"
    notes.append(f"{counted(count, 'frame')} whose joints all lie at one point {are} taken as unseen")
    return weights.masked_fill(blank[:, None], 0.0)


def _shaped(points: Any, confidence: Any, dims: int, source: str) -> tuple[Tensor, Tensor | None]:
    """Points (T, N, dims) and confidences (T, N) as numbers, of at least one frame and two joints."""
    xy = as_floats(points, f"{source}: points (frames, joints, {dims})", None)
    if xy.ndim != 3:
        raise ShapeError(
            f"{source}: points (frames, joints, {dims}): expected 3 dimensions, got shape {tuple(xy.shape)}"
            f"{_other_dimensions(xy.shape, dims)}"
        )
    if confidence is not None:
        confidence = as_floats(confidence, f"{source}: confidence (frames, joints)", None)
    if xy.shape[-1] != dims:
        hint = ""
        if xy.shape[-1] == dims + 1:
            hint = f": confidences go apart, points[..., :{dims}], confidence=points[..., {dims}]"
        if xy.shape[1] == dims:
            hint = ": the last two axes are swapped, points.swapaxes(1, 2) puts them right"
        raise ShapeError(f"{source}: points: expected shape (frames, joints, {dims}), got {tuple(xy.shape)}{hint}")
    num_frames, num_joints = xy.shape[:2]
    if num_frames < 1:
        raise ShapeError(f"{source}: expected at least 1 frame, got none")
    if num_joints < 2:
        raise ShapeError(f"{source}: expected at least 2 joints, got {num_joints}")
    if confidence is not None and confidence.shape != xy.shape[:2]:
        hint = ": confidence[..., 0] puts it right" if confidence.shape == (*xy.shape[:2], 1) else ""
        raise ShapeError(
            f"{source}: confidence: expected shape {tuple(xy.shape[:2])}, got {tuple(confidence.shape)}{hint}"
        )
    return xy, confidence


def _rate(fps: Any, source: str) -> float | None:
    """Frames a second, None where not known."""
    rate = as_number(fps)
    if fps is None or (rate is not None and not rate < math.inf):  # nor NaN
        return None
    return check_rate(fps, f"{source}: fps", "; leave it out where it is not known", ShapeError)


def _check_near(points: Tensor, seen: Tensor, body: Skeleton, source: str) -> None:
    """Raise a ShapeError where a joint (T, N, D) that counts as seen lies absurdly far from all others."""
    off = (points - points[seen].median(0).values).detach().abs().amax(-1)
    usual = float(off[seen].median())
    stray = seen & (off > STRAY * max(usual, 1.0))
    if stray.any():
        where, most = _label(stray, body.joints), float(off[stray].max())
        raise ShapeError(
            f"{source}: points: {where} lies {most:.3g} off the clip's middle, half of all joints within {usual:.3g}: "
            "write NaN where a joint is unseen"
        )
