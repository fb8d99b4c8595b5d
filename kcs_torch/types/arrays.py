"""Tensors as NumPy arrays, from any device."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

__all__ = ["as_array", "as_doubles"]


def as_array(tensor: Tensor) -> NDArray[Any]:
    """A tensor in its own precision; half precision becomes float32, which holds it exactly."""
    tensor = tensor.detach().cpu()
    return (tensor if tensor.dtype in (torch.float32, torch.float64) else tensor.float()).numpy()


def as_doubles(tensor: Tensor) -> NDArray[np.float64]:
    """A tensor in double precision, made on the CPU: not every device has it."""
    return tensor.detach().cpu().double().numpy()
