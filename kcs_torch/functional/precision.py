"""How many digits are computed with."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from functools import wraps
from typing import Any, ParamSpec, TypeVar

import torch
from torch import Tensor

__all__ = ["alike", "double", "full_precision", "narrow", "wide", "widened"]

Parameters = ParamSpec("Parameters")
Result = TypeVar("Result")


def full_precision(tensor: Tensor) -> AbstractContextManager[Any]:
    """Suspend autocast on the tensor's device, if it has any: pixels and factorisations need more than three digits."""
    kind = tensor.device.type
    on = torch.amp.is_autocast_available(kind) and torch.is_autocast_enabled(kind)
    return torch.autocast(kind, enabled=False) if on else nullcontext()


def alike(first: Tensor, second: Tensor) -> tuple[Tensor, Tensor]:
    """Two tensors in the wider of their dtypes."""
    if first.dtype == second.dtype:
        return first, second
    dtype = torch.promote_types(first.dtype, second.dtype)
    return first.to(dtype), second.to(dtype)


def wide(tensor: Tensor) -> Tensor:
    """At least in single precision: squares of millimetres or pixels leave the range of half precision."""
    return tensor.to(torch.promote_types(tensor.dtype, torch.float32))


def double(matrix: Tensor) -> Tensor:
    """In double precision: single precision would lose singular values below 3e-4 of the largest, squared by Gram's.

    MPS devices know no double precision.
    """
    return wide(matrix) if matrix.device.type == "mps" else matrix.double()


def narrow(value: Tensor, like: Tensor) -> Tensor:
    """A value in the dtype of ``like``; beyond its range it is the largest number, with the gradient it has."""
    if value.dtype == like.dtype:
        return value
    top = torch.finfo(like.dtype).max
    # In this order: beside a value that is far larger, its largest number would be lost to rounding. Infinity less
    # itself is NaN.
    return ((value - value.detach()).nan_to_num() + value.detach().clamp(-top, top)).to(like.dtype)


def widened(function: Callable[Parameters, Result]) -> Callable[Parameters, Result]:
    """Decorate a function that factorises matrices, which LAPACK does not do in half precision.

    Where its first tensor is in half precision, or autocast is on, it computes at least in single precision without
    autocast, and its results come back in the dtype of that tensor.
    """

    @wraps(function)
    def run(*args: Parameters.args, **kwargs: Parameters.kwargs) -> Result:
        first = next((x for x in (*args, *kwargs.values()) if isinstance(x, Tensor)), None)
        if first is None or not first.is_floating_point():
            return function(*args, **kwargs)
        kind = torch.promote_types(first.dtype, torch.float32)
        suspended = full_precision(first)
        if kind == first.dtype and isinstance(suspended, nullcontext):
            return function(*args, **kwargs)
        given: Any = [_cast(x, kind) for x in args]
        named: Any = {name: _cast(x, kind) for name, x in kwargs.items()}
        with suspended:
            out: Any = function(*given, **named)
        return tuple(_cast(x, first.dtype) for x in out) if isinstance(out, tuple) else _cast(out, first.dtype)  # type: ignore[return-value]

    return run


def _cast(value: Any, dtype: torch.dtype) -> Any:
    return value.to(dtype) if isinstance(value, Tensor) and value.is_floating_point() else value
