"""Weights of what is known: 0 where it is not."""

from __future__ import annotations

import torch
from torch import Tensor

from kcs_torch.functional.guarded import or_one

__all__ = ["known", "rms"]


def known(values: Tensor, weights: Tensor | None) -> Tensor:
    """Values (..., D), 0 where the weights (...) are: what is not known is often NaN, and 0 times NaN is NaN."""
    if weights is None:
        return values
    return torch.where(weights[..., None] > 0, values, torch.zeros((), dtype=values.dtype, device=values.device))


def rms(vectors: Tensor, weights: Tensor) -> Tensor:
    """Weighted root mean square length of (..., D) vectors, scaled first, so that no square overflows."""
    vectors = known(vectors, weights)
    top = or_one(vectors.abs().amax())
    square = (vectors / top).square().sum(-1) * weights
    return top * (square.sum() / weights.sum()).sqrt()
