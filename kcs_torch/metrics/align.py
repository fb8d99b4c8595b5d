"""The alignments after which motion is compared."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from kcs_torch.errors import ShapeError
from kcs_torch.functional import ALIGNMENTS, superpose
from kcs_torch.functional.align import check_alignment

__all__ = ["ALIGNMENTS", "align", "check_finite", "check_tensors", "first_of"]


def align(pred: Tensor, truth: Tensor, how: str, *, weights: Tensor | None = None, root: int | None = None) -> Tensor:
    """Move a prediction onto the truth in the way named, by least squares; never mirrored.

    Args:
        pred: (..., T, N, 3).
        truth: (..., T, N, 3), of the same shape.
        how: a name in :data:`ALIGNMENTS`.
        weights: (..., T, N), 0 where a joint of the truth is unknown; all 1 if None.
        root: index of the root joint for ``root`` and ``scale``; the middle of all joints if None.

    Returns:
        (..., T, N, 3), where the truth is.

    Raises:
        ShapeError: the shapes differ, or a number is not finite.
        OptionError: there is no such alignment, or no such root.

    >>> truth = torch.randn(5, 17, 3, generator=torch.Generator().manual_seed(0))
    >>> torch.allclose(align(3 * truth + 1, truth, "similarity"), truth, atol=1e-4)
    True
    """
    check_alignment(how, root)
    check_tensors(pred=pred, truth=truth, weights=weights)
    _check_points(pred, truth)
    check_finite(pred=pred, truth=truth)
    if weights is not None and weights.shape != truth.shape[:-1]:
        raise ShapeError(f"weights: expected shape {tuple(truth.shape[:-1])}, got {tuple(weights.shape)}")
    wide = torch.promote_types(torch.promote_types(pred.dtype, truth.dtype), torch.float32)
    with torch.autocast(pred.device.type, enabled=False):  # rotations need more than three digits
        return superpose(pred.to(wide), truth.to(wide), how, None if weights is None else weights.to(wide), root=root)


def _check_points(pred: Tensor, truth: Tensor) -> None:
    """Raise a ShapeError unless both are (..., T, N, 3), alike."""
    if pred.shape == truth.shape and pred.ndim >= 3 and pred.shape[-1] == 3:
        return
    message = (
        f"expected pred and truth of the same shape (..., T, N, 3), got {tuple(pred.shape)} and {tuple(truth.shape)}"
    )
    if pred.ndim == truth.ndim == 2:
        message += ": of single poses pred[None] and truth[None]"
    elif pred.shape == truth.shape and pred.ndim >= 3 and pred.shape[-2] == 3:
        message += ": their last two axes are swapped, .mT puts them right"
    elif pred.ndim >= 2 and pred.ndim == truth.ndim and pred.shape[-2] != truth.shape[-2]:
        message += ": take the joints that both have, in one order; skeleton.complete(points) appends virtual ones"
    raise ShapeError(message)


def check_finite(**given: Tensor) -> None:
    """Raise a ShapeError unless all points (..., T, N, 3) that are given, by their names, are finite."""
    for name, points in given.items():
        if not bool(torch.isfinite(points).all()):
            value, where = first_of(points, (~torch.isfinite(points)).any(-1))
            told = f"expected finite points, got {value} at {where}"
            raise ShapeError(f"{name}: {told}: where a joint is unknown, write 0, and 0 into its weight")


def first_of(values: Tensor, odd: Tensor) -> tuple[Any, str]:
    """The first of values (..., T, N, *) that is odd (..., T, N), and where it is, for the user."""
    *batch, frame, joint = odd.nonzero()[0].tolist()
    where = f"frame {frame}, joint {joint}" + (f" of clip {', '.join(map(str, batch))}" if batch else "")
    return values[(*batch, frame, joint)].tolist(), where


def check_tensors(**given: Any) -> None:
    """Raise a ShapeError unless all that is given, by its names, are tensors or None."""
    for name, value in given.items():
        if value is not None and not isinstance(value, Tensor):
            raise ShapeError(f"{name}: expected a tensor, got {type(value).__name__}: use torch.as_tensor({name})")
