"""Weights of what is known: 0 where it is not."""

from __future__ import annotations

import torch
from torch import Tensor

from kcs_torch.functional.guarded import largest, or_one

__all__ = ["known", "known_frames", "of_largest", "rms", "seen_weights"]


def known(values: Tensor, weights: Tensor | None) -> Tensor:
    """Values (..., D), 0 where the weights (...) are: what is not known is often NaN, and 0 times NaN is NaN."""
    if weights is None:
        return values
    return torch.where(weights[..., None] > 0, values, torch.zeros((), dtype=values.dtype, device=values.device))


def of_largest(weights: Tensor) -> Tensor:
    """Weights (..., T, N) as shares of a clip's largest: steps made for weights of 1 are too short for less."""
    return weights / or_one(largest(weights, 2))


def rms(vectors: Tensor, weights: Tensor, dimensions: int | None = None) -> Tensor:
    """Weighted root mean square length of (..., D) vectors, scaled first, so that no square overflows.

    The mean is over the last so many dimensions of the weights (...), all if None.
    """
    vectors = known(vectors, weights)
    over = tuple(range(-(weights.ndim if dimensions is None else dimensions), 0))
    top = or_one(largest(vectors, len(over) + 1))
    square = ((vectors / top).square().sum(-1) * weights).sum(over)
    return top.view(square.shape) * (square / weights.sum(over)).sqrt()


def known_frames(points: Tensor, weights: Tensor | None) -> Tensor:
    """Points (..., T, N, D), 0 in frames whose weight (..., T) is 0."""
    return points if weights is None else known(points.flatten(-2), weights).unflatten(-1, points.shape[-2:])


def seen_weights(tracks: Tensor, weights: Tensor | None) -> Tensor:
    """Weights (..., T, N) of tracks (..., T, N, 2), 0 where these are not finite: NaN is unseen, as everywhere.

    Those below 0 count as 0.

    Args:
        tracks: (..., T, N, 2).
        weights: (..., T, N); 1 if None.
    """
    finite = tracks.isfinite().all(-1)
    if weights is None:
        return finite.to(tracks.dtype)
    weights = weights.clamp_min(0)
    return torch.where(finite, weights, torch.zeros((), dtype=weights.dtype, device=weights.device))
