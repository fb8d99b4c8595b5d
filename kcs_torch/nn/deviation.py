"""The step that KCS and its unrolled layer share: a template's bones plus a deviation of least nuclear norm.

Pose = B0 + A in bone space, B0 the template's bones, A (T, 3, B) the deviation.
"""

from __future__ import annotations

import itertools
from typing import Literal

import torch
from torch import Tensor

from kcs_torch.functional.camera import project
from kcs_torch.functional.chain import bone_lengths, bone_vectors
from kcs_torch.functional.guarded import or_one
from kcs_torch.functional.ranks import nanmedian
from kcs_torch.functional.spectral import spectral_norm, svt
from kcs_torch.functional.temporal import interpolate

__all__ = [
    "Arrangement",
    "deviation_goal",
    "deviation_scale",
    "deviation_step",
    "frame_scales",
    "template_scale",
    "told_scales",
]

Arrangement = Literal["stacked", "frames"]
"""How deviations form one matrix: 3T x B as printed, or T x 3B (up to the order of rows and columns)."""

SPAN, QUANTILE = 60, 0.95
"""Frames of a span that tells a template's scale, and what of a bone's projections within it: scales between spans are
interpolated."""


def deviation_goal(rest: Tensor, tracks: Tensor, cameras: Tensor, weights: Tensor) -> Tensor:
    """What the tracks ask of the deviation, W - R X0 about its middle, joints last: (..., T, 2, N).

    Args:
        rest: X0 (..., 1 or T, N, 3), the template in the world frame.
        tracks: W (..., T, N, 2), in the unit of the template.
        cameras: R (..., T, 2, 3).
        weights: w (..., T, N).
    """
    return _centred(tracks.mT - cameras @ rest.mT, weights[..., None, :])


def deviation_step(
    deviation: Tensor,
    goal: Tensor,
    cameras: Tensor,
    weights: Tensor,
    threshold: Tensor,
    step: Tensor | float = 1.0,
    *,
    matrix: Tensor,
    inverse: Tensor,
    arrangement: Arrangement,
) -> Tensor:
    """One step of KCS's shape (eq. 21): A <- shrink(A - tau C^T R^T w (R D A - G), tau mu).

    Unseen joints take their current projection, and joints seen with low confidence go part of the way: the
    majorisation of the weighted data term.

    Args:
        deviation: A (..., T, 3, B), bones last: so D and C are one product for all frames, and the matrix that is
            shrunk is a view.
        goal: G (..., T, 2, N) from :func:`deviation_goal`.
        cameras: R (..., T, 2, 3).
        weights: w (..., T, N).
        threshold: mu (...).
        step: tau (...), or a number.
        matrix: C (N, B), the incidence matrix.
        inverse: D (N, B), its right inverse.
        arrangement: of the matrix whose singular values are shrunk.

    Returns:
        (..., T, 3, B).
    """
    share = weights[..., None, :]
    residual = _centred((cameras @ deviation) @ inverse.mT - goal, share) * share
    size = step[..., None, None, None] if isinstance(step, Tensor) else step
    moved = deviation - size * (cameras.mT @ (residual @ matrix))
    return svt(_fold(moved, arrangement), step * threshold).view(moved.shape)


def deviation_scale(
    goal: Tensor, cameras: Tensor, weights: Tensor, *, matrix: Tensor, arrangement: Arrangement
) -> Tensor:
    """Largest singular value (...) of what the tracks ask of the template: the unit of the shrinkage."""
    return spectral_norm(_fold(cameras.mT @ ((goal * weights[..., None, :]) @ matrix), arrangement))


def frame_scales(rest: Tensor, tracks: Tensor, cameras: Tensor, weights: Tensor, low: Tensor, high: Tensor) -> Tensor:
    """Weak-perspective scale (..., T) by least squares, within bounds (..., T).

    Args:
        rest: (..., 1 or T, N, 3).
        tracks: (..., T, N, 2), centred.
        cameras: (..., T, 2, 3).
        weights: (..., T, N).
        low: (..., T), or what broadcasts to it.
        high: (..., T).
    """
    flat = project(rest, cameras)
    match = (flat * tracks * weights[..., None]).sum((-2, -1))
    size = (flat.square() * weights[..., None]).sum((-2, -1))
    free = match / or_one(size)
    return torch.minimum(torch.maximum(free, low), high)


def told_scales(scales: Tensor, weights: Tensor) -> Tensor:
    """Scales (..., T), between those of their neighbours in frames that show fewer than two joints, and so tell none.

    Args:
        scales: (..., T).
        weights: (..., T, N), 0 where unseen.
    """
    told = (weights > 0).sum(-1, keepdim=True) > 1
    held = interpolate(scales[..., None, None], told)[..., 0, 0]
    return torch.where(told.any(-2), held, scales)


def template_scale(tracks: Tensor, weights: Tensor, rest: Tensor, bones: Tensor) -> Tensor:
    """Weak-perspective scale of each frame, from the longest projections of the bones around it.

    A bone's projection is at most scale times its length, and reaches it where the bone lies in the image plane. In
    spans of frames, each bone's high quantile of |projection| / length votes, and the median bone wins: an arm held out
    does not enlarge the body.

    Args:
        tracks: (..., T, N, 2), finite, 0 where unseen, about the body's middle.
        weights: (..., T, N).
        rest: (N, 3) template.
        bones: (B, 2) that keep their length.

    Returns:
        (..., T), positive.
    """
    frames, device = tracks.shape[-3], tracks.device
    if torch.jit.is_tracing():  # where sizes are tensors
        frames = int(frames)
    size = rest.square().sum(-1).mean().sqrt().clamp_min(1e-12)
    fallback = (tracks.square().sum(-1).mean((-2, -1)).sqrt() / size).clamp_min(1e-12)
    if len(bones) == 0:
        return fallback[..., None].expand(*fallback.shape, frames)
    length = bone_lengths(rest, bones)
    seen = (weights[..., bones[:, 0]] > 0) & (weights[..., bones[:, 1]] > 0) & (length > 0)
    ratio = bone_vectors(tracks, bones).norm(dim=-1) / or_one(length)
    ratio = torch.where(seen, ratio, torch.nan)
    count = max(1, round(frames / SPAN))
    edges = [round(i * frames / count) for i in range(count + 1)]
    spans = list(itertools.pairwise(edges))
    vote = lambda part: nanmedian(_quantile_of_known(part, QUANTILE), -1)  # noqa: E731
    overall = vote(ratio)
    overall = torch.where(torch.isfinite(overall) & (overall > 0), overall, fallback)[..., None]
    votes = torch.stack([vote(ratio[..., a:b, :]) for a, b in spans], -1)
    votes = torch.where(torch.isfinite(votes) & (votes > 0), votes, overall)
    at = torch.tensor([(a + b - 1) / 2 for a, b in spans], dtype=votes.dtype, device=device)
    time = torch.arange(frames, dtype=votes.dtype, device=device)
    right = torch.bucketize(time, at).clamp(1, max(count - 1, 1)).clamp_max(count - 1)
    left = (right - 1).clamp_min(0)
    gap = (at[right] - at[left]).clamp_min(1e-12)
    share = ((time - at[left]) / gap).clamp(0, 1)
    return votes[..., left] * (1 - share) + votes[..., right] * share


def _quantile_of_known(values: Tensor, quantile: float) -> Tensor:
    """``values.nanquantile(quantile, -2)``, for which torch.func.vmap has no rule."""
    known = ~values.isnan()
    ordered = torch.where(known, values, torch.inf).sort(-2).values
    place = quantile * (known.sum(-2, keepdim=True) - 1).clamp_min(0).to(values.dtype)
    low, high = (ordered.gather(-2, x.long()) for x in (place.floor(), place.ceil()))
    between = torch.where(low.isfinite(), low + (place - place.floor()) * (high - low), torch.nan)
    return between.squeeze(-2)


def _centred(rows: Tensor, share: Tensor) -> Tensor:
    """Rows (..., 2, N) minus their weighted mean over joints: the translation at its optimum."""
    return rows - (rows * share).sum(-1, keepdim=True) / or_one(share.sum(-1, keepdim=True))


def _fold(deviation: Tensor, arrangement: Arrangement) -> Tensor:
    """(..., T, 3, B) as (..., 3T, B) or (..., T, 3B)."""
    return deviation.flatten(-3, -2) if arrangement == "stacked" else deviation.flatten(-2)
