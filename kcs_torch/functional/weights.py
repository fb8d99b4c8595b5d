"""Weights of what is known: 0 where it is not."""

from __future__ import annotations

import torch
from torch import Tensor

__all__ = ["known"]


def known(values: Tensor, weights: Tensor | None) -> Tensor:
    """Values (..., D), 0 where the weights (...) are: what is not known is often NaN, and 0 times NaN is NaN."""
    if weights is None:
        return values
    return torch.where(weights[..., None] > 0, values, torch.zeros((), dtype=values.dtype, device=values.device))
