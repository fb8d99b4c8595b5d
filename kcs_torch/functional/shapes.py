"""Batch dimensions of several tensors."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations
from typing import Any

from torch import Tensor

from kcs_torch.errors import ShapeError

__all__ = ["broadcast_shapes", "check_batches", "check_core", "check_floats", "fit_together"]


def broadcast_shapes(*shapes: Sequence[int]) -> tuple[int, ...]:
    """Return the shape that all broadcast to; ``torch.broadcast_shapes``, whose first call takes a third of a second.

    Raises:
        ShapeError: they do not.

    >>> broadcast_shapes((4, 1), (3,), ())
    (4, 3)
    """
    common: list[int] = []
    for shape in shapes:
        common = [1] * (len(shape) - len(common)) + common
        for k in range(1, len(shape) + 1):
            if shape[-k] != 1:
                if common[-k] != 1 and common[-k] != shape[-k]:
                    told = ", ".join(str(tuple(each)) for each in shapes)
                    raise ShapeError(f"batch dimensions: expected sizes that are equal or 1, got {told}")
                common[-k] = shape[-k]
    return tuple(common)


def fit_together(one: Sequence[int], other: Sequence[int]) -> bool:
    """Whether two shapes broadcast.

    >>> fit_together((4, 1), (3,)), fit_together((4,), (3,))
    (True, False)
    """
    return all(a == b or 1 in (a, b) for a, b in zip(one[::-1], other[::-1], strict=False))


def check_batches(what: str, *tensors: Tensor, cores: Sequence[int]) -> None:
    """Raise a ShapeError unless the dimensions of tensors before so many core ones broadcast.

    >>> import torch
    >>> check_batches("project: points and cameras", torch.zeros(5, 17, 3), torch.zeros(4, 2, 3), cores=(2, 2))
    Traceback (most recent call last):
    kcs_torch.errors.ShapeError: project: points and cameras: expected the same batch, got (5, 17, 3) and (4, 2, 3)
    """
    batches = [x.shape[: x.ndim - core] for x, core in zip(tensors, cores, strict=True)]
    if not all(fit_together(*pair) for pair in combinations(batches, 2)):
        raise ShapeError(f"{what}: expected the same batch, got {' and '.join(str(tuple(x.shape)) for x in tensors)}")


def check_floats(value: Any, what: str, *core: int | str) -> None:
    """Raise a ShapeError unless ``value`` is a tensor (..., *core) of floating-point numbers.

    >>> import torch
    >>> check_floats(torch.tensor([[0, 1]]), "centre: points", "N", "D")
    Traceback (most recent call last):
    kcs_torch.errors.ShapeError: centre: points: expected floating point, got torch.int64: use points.float()
    """
    check_core(value, what, *core)
    if not value.is_floating_point():
        name = what.rpartition(" ")[2]
        raise ShapeError(f"{what}: expected floating point, got {value.dtype}: use {name}.float()")


def check_core(value: Any, what: str, *core: int | str) -> None:
    """Raise a ShapeError unless ``value`` is a tensor (..., *core), in which letters stand for any size.

    >>> import torch
    >>> check_core(torch.zeros(5, 2, 4), "project: cameras", 2, 3)
    Traceback (most recent call last):
    kcs_torch.errors.ShapeError: project: cameras: expected shape (..., 2, 3), got (5, 2, 4)
    """
    if not isinstance(value, Tensor):
        name = what.rpartition(" ")[2]
        raise ShapeError(f"{what}: expected a tensor, got {type(value).__name__}: use torch.as_tensor({name})")
    shape, sizes = value.shape, len(core)
    if len(shape) >= sizes:
        for size, wanted in zip(shape[len(shape) - sizes :], core, strict=True):
            if size != wanted and not isinstance(wanted, str):
                break
        else:
            return
    raise ShapeError(f"{what}: expected shape (..., {', '.join(map(str, core))}), got {tuple(shape)}")
