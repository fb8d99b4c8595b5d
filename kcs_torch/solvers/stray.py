"""Detections that stray from what their surroundings predict."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import reduce

import torch
from torch import Tensor

from kcs_torch.functional.ranks import nanmedian

__all__ = ["around_usual", "body_size", "each_joint", "far_off", "from_beside", "in_motion", "stray_from_neighbours"]

STRAY, FLOOR = 6.0, 0.04
"""Of outliers: usual distances from what is predicted, and the share of the body's size beside."""

AROUND = 8
"""Frames before and behind that are a joint's surroundings."""

SIDE = 3
"""Frames before, and after, that tell where a joint is just beside a frame."""

NUMBERS = 2**18
"""Joints times frames that are judged at once: this takes a hundred times the memory."""

LINES = ((-1, 1), (-2, 1), (-1, 2), (-2, 2), (-3, 3), (-2, -1), (1, 2))
"""Pairs of neighbouring frames, counted among those in which a joint is seen, whose lines predict where it is."""

QUICK = 1.5
"""How much farther off than the farthest of these lines a joint may be that moves quickly."""

COMMON, RATIO = 0.7, 1.318
"""A quantile of distances, and what it is over the median for a Gaussian in the plane."""


def each_joint(judge: Callable[[Tensor, Tensor], Tensor], values: Tensor, seen: Tensor) -> Tensor:
    """(K, T, N) what a judge that looks at each joint by itself says, of few joints at a time where clips are long."""
    few = max(1, NUMBERS // max(values.shape[0] * values.shape[1], 1))
    parts = zip(values.split(few, 2), seen.split(few, 2), strict=True)
    return torch.cat([judge(*part) for part in parts], 2)


def stray_from_neighbours(values: Tensor, seen: Tensor, time: Tensor | None = None) -> Tensor:
    """(K, T, N) outliers against the median of lines through a joint's nearest seen frames; at times (K, T)."""
    frames = values.shape[1]
    if frames < 5:
        return torch.zeros_like(seen)
    lines = _lines(values, seen, time)
    error = (values - nanmedian(lines, 0)).norm(dim=-1)
    return far_off(error, seen & error.isfinite())


def in_motion(values: Tensor, seen: Tensor, time: Tensor | None = None) -> Tensor:
    """(K, T, N) whether a joint may have moved to where it is, as far as its nearest seen frames tell.

    Lines through these lie apart where the joint speeds up, and where it is lies hardly farther from their median.

    Args:
        values: (K, T, N, 2) of all joints.
        seen: (K, T, N) where its place is known to be no outlier.
        time: (K, T) as of :func:`stray_from_neighbours`.
    """
    lines = _lines(values, seen, time)
    middle = nanmedian(lines, 0)
    apart = (lines - middle).norm(dim=-1).nan_to_num(0.0).amax(0)
    return (values - middle).norm(dim=-1) <= QUICK * apart


def _lines(values: Tensor, seen: Tensor, time: Tensor | None) -> Tensor:
    """Where lines through pairs of a joint's nearest seen frames lead, (P, K, T, N, 2), NaN where there are too few."""
    frames = values.shape[1]
    index = torch.arange(frames, device=values.device)[:, None].expand(seen.shape)
    time = index if time is None else time[..., None].expand(seen.shape)
    order = torch.where(seen, index, index + frames).argsort(1)
    before, count = seen.cumsum(1) - seen.long(), seen.sum(1, keepdim=True)  # seen frames before; at all

    def neighbour(k: int) -> tuple[Tensor, Tensor]:
        rank = before + k if k < 0 else before + seen + (k - 1)
        at = order.gather(1, rank.clamp(0, frames - 1))
        held = values.gather(1, at[..., None].expand(values.shape))
        there = (rank >= 0) & (rank < count)
        return time.gather(1, at).to(values.dtype), torch.where(there[..., None], held, torch.full_like(held, math.nan))

    near = {k: neighbour(k) for k in (-3, -2, -1, 1, 2, 3)}
    lines = []
    for a, b in LINES:
        (start, first), (stop, last) = near[a], near[b]
        gap = torch.where(stop == start, torch.ones_like(stop), stop - start)
        lines.append(first + ((time - start) / gap)[..., None] * (last - first))
    return torch.stack(lines)


def far_off(error: Tensor, seen: Tensor) -> Tensor:
    """(K, T, N), True where a seen joint's error, in body sizes, is far above what is usual for it."""
    known = torch.where(seen, error, torch.full_like(error, math.nan))
    # Of a Gaussian's distances the quantile is at the median. It is above it where a joint is still most of the time
    # and then swings: no quick stride is an outlier, no outliers are as common.
    clip = torch.maximum(nanmedian(known, 1, keepdim=True), known.nanquantile(COMMON, 1, keepdim=True) / RATIO)
    return seen & (error > STRAY * around_usual(known, clip) + FLOOR)


def around_usual(error: Tensor, clip: Tensor) -> Tensor:
    """Median error (..., T, N) about each frame, within one to four times the clip's (..., 1, N); NaN: unknown."""
    around = torch.nn.functional.pad(error.mT, (AROUND, AROUND), value=math.nan).unfold(-1, 2 * AROUND + 1, 1)
    near = nanmedian(around, -1).mT.nan_to_num(0.0)
    # Bounded, as near the ends of a clip one outlier may spoil the prediction of all that is around.
    return torch.maximum(clip, torch.minimum(near, 4 * clip)).nan_to_num(0.0)


def from_beside(values: Tensor, mirrored: bool = False) -> Tensor:
    """How far values (T, N, D) are from the nearer of their medians just before and just after, (T, N); NaN: unknown.

    Args:
        values: NaN where unseen.
        mirrored: whether values of the opposite sign are the same.
    """
    blank = torch.full_like(values[:1], math.nan).expand(SIDE, -1, -1)
    runs = nanmedian(torch.cat([blank, values, blank]).unfold(0, SIDE, 1), -1)  # (T + SIDE + 1, N, D)
    before, after = runs[: len(values)], runs[SIDE + 1 :]
    signs = (1, -1) if mirrored else (1,)
    away = [(sign * values - place).norm(dim=-1) for sign in signs for place in (before, after)]
    return reduce(torch.fmin, away)


def body_size(values: Tensor, seen: Tensor) -> Tensor:
    """(K,) median distance of the seen joints from the mean of their frame's seen joints."""
    kept = seen[..., None].to(values.dtype)
    centre = (values * kept).sum(2, keepdim=True) / kept.sum(2, keepdim=True).clamp_min(1)
    distance = (values - centre).norm(dim=-1)
    distance = torch.where(seen, distance, torch.full_like(distance, math.nan))
    return nanmedian(distance.flatten(1), 1).nan_to_num(0.0)
