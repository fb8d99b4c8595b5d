"""How many digits are computed with."""

from __future__ import annotations

from contextlib import AbstractContextManager, nullcontext
from typing import Any

import torch
from torch import Tensor

__all__ = ["full_precision", "wide"]


def full_precision(tensor: Tensor) -> AbstractContextManager[Any]:
    """Suspend autocast on the tensor's device, if it has any: pixels and factorisations need more than three digits."""
    kind = tensor.device.type
    on = torch.amp.is_autocast_available(kind) and torch.is_autocast_enabled(kind)
    return torch.autocast(kind, enabled=False) if on else nullcontext()


def wide(tensor: Tensor) -> Tensor:
    """At least in single precision: squares of millimetres or pixels leave the range of half precision."""
    return tensor.to(torch.promote_types(tensor.dtype, torch.float32))
