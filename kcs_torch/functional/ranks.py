"""Values by their rank, also where torch is asked for deterministic operations: on a GPU its own have no such form."""

from __future__ import annotations

import torch
from torch import Tensor

__all__ = ["kth_smallest", "median", "nanmedian"]


def median(values: Tensor, dim: int, keepdim: bool = False) -> Tensor:
    """Return the lower median, NaN where anything is NaN: ``values.median(dim, keepdim).values``.

    >>> median(torch.tensor([[3.0, 1.0, 4.0, 2.0]]), -1)
    tensor([2.])
    """
    if not _sorts(values):
        return values.median(dim, keepdim).values
    return nanmedian(torch.where(values.isnan().any(dim, keepdim=True), torch.nan, values), dim, keepdim)


def nanmedian(values: Tensor, dim: int, keepdim: bool = False) -> Tensor:
    """Return the lower median of what is not NaN, NaN where nothing is: ``values.nanmedian(dim, keepdim).values``.

    >>> nanmedian(torch.tensor([[3.0, 1.0, torch.nan, 2.0]]), -1)
    tensor([2.])
    """
    if not _sorts(values):
        return values.nanmedian(dim, keepdim).values
    last = ((~values.isnan()).sum(dim, keepdim=True) - 1).clamp_min(0)
    found = values.sort(dim).values.gather(dim, last // 2)  # NaN comes last
    return found if keepdim else found.squeeze(dim)


def kth_smallest(values: Tensor, k: int, dim: int) -> Tensor:
    """Return the k-th smallest, k from 1: ``values.kthvalue(k, dim).values``.

    >>> kth_smallest(torch.tensor([3.0, 1.0, 2.0]), 2, 0)
    tensor(2.)
    """
    return values.sort(dim).values.select(dim, k - 1) if _sorts(values) else values.kthvalue(k, dim).values


def _sorts(values: Tensor) -> bool:
    """Sorting takes two to five times as long."""
    return torch.are_deterministic_algorithms_enabled() and values.device.type != "cpu"
