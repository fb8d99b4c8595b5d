"""Tensors as files hold them."""

from __future__ import annotations

from typing import Any

import torch
from numpy.typing import NDArray
from torch import Tensor

__all__ = ["plain"]


def plain(tensor: Tensor) -> NDArray[Any]:
    """A tensor of any device and dtype as an array; half precision becomes float32, which holds it exactly."""
    tensor = tensor.detach().cpu()
    return (tensor if tensor.dtype in (torch.float32, torch.float64) else tensor.float()).numpy()
