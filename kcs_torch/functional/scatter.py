"""The log-determinant of a clip's scatter, with its own derivative: one Cholesky factorisation for both."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from kcs_torch.errors import OptionError
from kcs_torch.functional.derivatives import Once, applied, batch_first
from kcs_torch.functional.precision import wide
from kcs_torch.functional.shapes import broadcast_shapes, check_floats

__all__ = ["inverse_scatter", "scatter_log_det"]


def scatter_log_det(values: Tensor, eps: Tensor | float) -> Tensor:
    """Return T/2 log det(X^T X / T + eps I) of the rows X: what a Gaussian of unknown covariance charges for them.

    The derivative in the values is X (X^T X / T + eps I)^-1, from the factorisation that the value needs: no SVD, and
    finite for any input as long as eps is positive; NaN where rounding leaves nothing of eps beside the squares.

    Args:
        values: (..., T, D), centred by the caller where a mean is to be free.
        eps: positive, a number or a tensor that broadcasts against (...), in squared units of the values. The result is
            NaN where a tensor's is not.

    Returns:
        (...). Differentiable once, in the values; a second derivative raises ``RuntimeError``.

    Raises:
        ShapeError: fewer than 2 dimensions, or values that are not in floating point.
        OptionError: a number for eps is not positive.

    >>> scatter_log_det(torch.zeros(4, 3), 1.0).item()
    0.0
    """
    check_floats(values, "scatter_log_det: values", "T", "D")
    if not isinstance(eps, Tensor) and not eps > 0:
        raise OptionError(f"scatter_log_det: eps: expected a positive number, got {eps}")
    work = wide(values)  # no LAPACK takes half precision
    level = torch.as_tensor(eps, dtype=work.dtype, device=values.device)
    out: Tensor = applied(_ScatterLogDet, work, level)[0]
    return out.to(values.dtype)


def inverse_scatter(values: Tensor, eps: Tensor | float) -> Tensor:
    """Return (X^T X / T + eps I)^-1 (..., D, D) of the rows X (..., T, D): the precision of :func:`scatter_log_det`."""
    level = torch.as_tensor(eps, dtype=values.dtype, device=values.device)
    return torch.cholesky_inverse(_factor(values, level))


def _factor(values: Tensor, eps: Tensor) -> Tensor:
    scatter = values.mT @ values / max(values.shape[-2], 1)
    batch = broadcast_shapes(scatter.shape[:-2], eps.shape)
    if batch != scatter.shape[:-2]:
        scatter = scatter.expand(*batch, *scatter.shape[-2:]).clone()
    scatter.diagonal(dim1=-2, dim2=-1).add_(eps[..., None])
    factor, info = torch.linalg.cholesky_ex(scatter)
    # A step so far that nothing is left of eps is answered by NaN, which a line search refuses, not by an exception.
    return torch.where((info == 0)[..., None, None], factor, torch.full_like(factor, torch.nan))


class _ScatterLogDet(torch.autograd.Function):
    """(values (..., T, D), eps (...)) to the log-determinant (...) and the Cholesky factor (..., D, D)."""

    @staticmethod
    def forward(values: Tensor, eps: Tensor) -> tuple[Tensor, Tensor]:
        factor = _factor(values, eps)
        return values.shape[-2] * factor.diagonal(dim1=-2, dim2=-1).log().sum(-1), factor

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Tensor, Tensor], output: tuple[Tensor, Tensor]) -> None:
        ctx.mark_non_differentiable(output[1])
        ctx.save_for_backward(inputs[0], output[1])

    @staticmethod
    def backward(ctx: Any, grad: Tensor, _: Any) -> tuple[Tensor, None]:
        return _ScatterAdjoint.apply(grad, *ctx.saved_tensors), None

    @staticmethod
    def vmap(info: Any, in_dims: tuple[int | None, ...], values: Tensor, eps: Tensor) -> Any:
        padded, _ = batch_first(info, in_dims, (values, eps), (2, 0))
        return _ScatterLogDet.apply(*padded), (0, 0)


class _ScatterAdjoint(Once):
    """X (X^T X / T + eps I)^-1, weighed by the cotangent; not to be differentiated."""

    @staticmethod
    def forward(grad: Tensor, values: Tensor, factor: Tensor) -> Tensor:
        return (grad[..., None, None] * (values @ torch.cholesky_inverse(factor))).sum_to_size(values.shape)

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> None:
        raise RuntimeError("second derivatives of scatter_log_det are not supported")

    @staticmethod
    def vmap(info: Any, in_dims: tuple[int | None, ...], *tensors: Tensor) -> Any:
        padded, shapes = batch_first(info, in_dims, tensors, (0, 2, 2))
        return _ScatterAdjoint.apply(*padded).reshape(shapes[1]), 0
