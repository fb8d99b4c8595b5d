"""Quotients, norms and roots that stay finite, and so do their derivatives, where there is nothing to take them of."""

from __future__ import annotations

import torch
from torch import Tensor

__all__ = ["LOST", "largest", "or_one", "safe_norm", "safe_root", "unit_size"]

LOST = 16.0
"""Distances and sizes below this, in rounding errors of the points, are none."""


def or_one(total: Tensor) -> Tensor:
    """What is divided by: a total, 1 where it is not above 0.

    >>> torch.tensor([6.0, 0.0]) / or_one(torch.tensor([3.0, 0.0]))
    tensor([2., 0.])
    """
    return torch.where(total > 0, total, torch.ones_like(total))


def unit_size(values: Tensor, dimensions: int, counts: Tensor | None = None, lost: Tensor | None = None) -> Tensor:
    """Divide by the :func:`largest` magnitude over the last so many dimensions.

    For what does not depend on scale: squares of the result neither under- nor overflow, nor do their inverses. What is
    smaller than any unit would have it, or no larger than what is ``lost`` to rounding, counts as 0, so that its
    derivative is bounded; NaN stays NaN.
    """
    top, least = largest(values, dimensions, counts), torch.finfo(values.dtype).tiny ** 0.25
    return values / torch.where(top <= (least if lost is None else lost.clamp_min(least)), torch.inf, top)


def largest(values: Tensor, dimensions: int, counts: Tensor | None = None) -> Tensor:
    """The largest magnitude over the last so many dimensions, which are kept; a constant for autograd.

    It is sought where ``counts``, which broadcasts against the values, is True; 0 where there is nothing.
    """
    over, size = tuple(range(-dimensions, 0)), values.detach().abs()
    if counts is not None:
        size = torch.where(counts, size, torch.zeros_like(size))
    return size.amax(over, keepdim=True) if size.numel() else size.sum(over, keepdim=True)


def safe_norm(vectors: Tensor) -> Tensor:
    """Euclidean norm over the last dimension, with gradient 0 where it is 0.

    Scaled by the largest component first, so that no square under- or overflows.
    """
    top = vectors.detach().abs().amax(-1, keepdim=True)
    scale = or_one(top)
    unit = vectors / scale
    square = unit.square().sum(-1)
    zero = top.squeeze(-1) == 0
    root = torch.where(zero, torch.ones_like(square), square).sqrt()
    return torch.where(zero, torch.zeros_like(square), root * scale.squeeze(-1))


def safe_root(squares: Tensor) -> Tensor:
    """Square roots, 0 with the derivative 0 where there is nothing to take one of (0 or less); NaN stays."""
    none = squares <= 0
    return torch.where(none, 0, torch.where(none, 1, squares).sqrt())
