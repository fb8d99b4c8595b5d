"""Derivatives of a fixed point by the implicit function theorem: one step is recorded, however many were made."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from kcs_torch.errors import ConvergenceWarning, OptionError
from kcs_torch.functional.guarded import or_one

__all__ = ["Implicit", "fixed_point", "gmres"]


@dataclass(frozen=True)
class Implicit:
    """How to reach a fixed point, and how to differentiate it.

    Attributes:
        settle: further steps of the last kind, at most, that bring the iteration to its fixed point.
        tolerance: it is reached where a step changes the state by less than this share.
        adjoint_steps: products with the step's Jacobian in a backward pass, at most.
        adjoint_tolerance: relative residual of the adjoint equation at which they end.

    Raises:
        OptionError: a number is negative, or there are no adjoint steps.
    """

    settle: int = 300
    tolerance: float = 1e-6
    adjoint_steps: int = 50
    adjoint_tolerance: float = 1e-6

    def __post_init__(self) -> None:
        if self.settle < 0 or self.adjoint_steps < 1 or not (self.tolerance >= 0 and self.adjoint_tolerance >= 0):
            raise OptionError(
                "Implicit: expected settle, tolerance and adjoint_tolerance >= 0 and adjoint_steps >= 1, got "
                f"{self.settle}, {self.tolerance}, {self.adjoint_tolerance} and {self.adjoint_steps}"
            )


def fixed_point(
    step: Callable[[Tensor], Tensor],
    point: Tensor,
    *,
    inner: int = 1,
    num_steps: int = 50,
    tolerance: float = 1e-6,
    name: str = "fixed_point",
) -> Tensor:
    """Return ``step(point)`` with the derivatives of the fixed point x = step(x) in whatever ``step`` depends on.

    With J the Jacobian of the step at the fixed point, a cotangent g is pulled back through one step as the solution of
    v = g + J^T v, which :func:`gmres` finds from products with J^T. Memory is that of one recorded step.

    Args:
        step: a contraction near ``point``; it closes over tensors that may require gradients.
        point: (..., *), at the fixed point: what is left of the way to it is an error of the derivatives.
        inner: trailing dimensions of the state; problems of different leading index do not mix.
        num_steps: products with J^T, at most.
        tolerance: relative residual at which they end.
        name: what a warning calls the iteration.

    Returns:
        (..., *). Differentiable once; a second derivative raises ``RuntimeError``.

    Warns:
        ConvergenceWarning: in the backward pass, the adjoint equation was not solved to the tolerance.

    >>> a = torch.tensor([3.0], requires_grad=True)
    >>> x = fixed_point(lambda x: (x + a / x) / 2 + 0.1 * (a.sqrt() - x), a.detach().sqrt())  # the root of a
    >>> round(torch.autograd.grad(x.sum(), a)[0].item(), 4)  # 1 / (2 sqrt(3))
    0.2887
    """
    if not torch.is_grad_enabled():
        return step(point)
    leaf = point.detach().requires_grad_()
    value = step(leaf)

    def solve(grad: Tensor) -> Tensor:
        def left(v: Tensor) -> Tensor:
            (pulled,) = torch.autograd.grad(value, leaf, v, retain_graph=True, allow_unused=True)
            return v if pulled is None else v - pulled

        found, residual = gmres(left, grad, inner=inner, num_steps=num_steps, tolerance=tolerance)
        if bool((residual > tolerance).any()):
            message = (
                f"{name}: the derivative at the fixed point did not settle within {num_steps} products "
                f"(relative residual {float(residual.max()):.1e}); where nothing holds a direction there is none"
            )
            warnings.warn(message, ConvergenceWarning, stacklevel=2)
        return found

    out: Tensor = _Pull.apply(value, solve)
    return out


class _Pull(torch.autograd.Function):
    """The identity, whose cotangent goes through a function."""

    @staticmethod
    def forward(ctx: Any, value: Tensor, solve: Callable[[Tensor], Tensor]) -> Tensor:
        ctx.solve = solve
        ctx.save_for_backward(value)
        return value.view_as(value)

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor, None]:
        return _Pulled.apply(grad, *ctx.saved_tensors, ctx.solve), None


class _Pulled(torch.autograd.Function):
    """The cotangent, not to be differentiated again: it takes the value so that autograd notices who tries."""

    @staticmethod
    def forward(ctx: Any, grad: Tensor, value: Tensor, solve: Callable[[Tensor], Tensor]) -> Tensor:
        return solve(grad)

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> None:
        raise RuntimeError("second derivatives of a fixed point are not supported")


def gmres(
    operator: Callable[[Tensor], Tensor], rhs: Tensor, *, inner: int = 1, num_steps: int = 50, tolerance: float = 1e-6
) -> tuple[Tensor, Tensor]:
    """Solve A x = b for many systems at once by the generalised minimal residual method (Saad, Schultz 1986).

    Args:
        operator: x to A x, linear; leading indices are systems of their own.
        rhs: b (..., *).
        inner: trailing dimensions of one system's unknowns.
        num_steps: products with A, at most; there are no restarts.
        tolerance: relative residual at which all are done.

    Returns:
        x (..., *) and relative residuals (...). A singular system gets a least-squares solution, never NaN; one whose b
        is not finite gets NaN, which a scaler of gradients looks for.

    >>> A = torch.tensor([[2.0, 1.0], [0.0, 4.0]])
    >>> gmres(lambda x: A @ x, torch.tensor([4.0, 4.0]))[0].round(decimals=4).tolist()
    [1.5, 1.0]
    """
    shape = rhs.shape[rhs.ndim - inner :]
    flat = rhs.flatten(-inner) if inner > 1 else rhs
    lost = ~flat.isfinite().all(-1, keepdim=True)
    flat = torch.where(lost, torch.zeros_like(flat), flat)
    # Divided by its largest number first: the square of a far cotangent would leave the range.
    top = flat.abs().amax(-1, keepdim=True)
    flat = flat / or_one(top)
    norm = torch.linalg.vector_norm(flat, dim=-1, keepdim=True)
    eps = torch.finfo(rhs.dtype).eps
    num_steps = min(num_steps, flat.shape[-1])
    basis = flat.new_zeros(*flat.shape[:-1], num_steps + 1, flat.shape[-1])
    basis[..., 0, :] = flat / or_one(norm)
    image = flat.new_zeros(*flat.shape[:-1], num_steps + 1, num_steps)  # of the basis under A, in the basis
    target = flat.new_zeros(*flat.shape[:-1], num_steps + 1, 1)
    target[..., 0, :] = (norm > 0).to(flat.dtype)
    share, residual = flat.new_zeros(*flat.shape[:-1], 0, 1), (norm > 0).to(flat.dtype).squeeze(-1)
    for k in range(num_steps):
        known = basis[..., : k + 1, :]
        new = operator(known[..., k, :].unflatten(-1, shape)).flatten(-inner)[..., None]
        length = torch.linalg.vector_norm(new, dim=-2)
        for _ in range(2):  # once is not enough: rounding leaves some of the basis in
            part = known @ new
            new = new - known.mT @ part
            image[..., : k + 1, k] += part.squeeze(-1)
        rest = torch.linalg.vector_norm(new, dim=-2)
        more = rest > 10 * eps * length
        image[..., k + 1, k] = torch.where(more, rest, 0).squeeze(-1)
        basis[..., k + 1, :] = torch.where(more, new.squeeze(-1) / torch.where(more, rest, 1), 0)
        if (k + 1) % 5 == 0 or k + 1 == num_steps:
            small, goal = image[..., : k + 2, : k + 1], target[..., : k + 2, :]
            share = torch.linalg.pinv(small, rtol=eps * flat.shape[-1]) @ goal
            residual = torch.linalg.vector_norm((goal - small @ share).squeeze(-1), dim=-1)
            if bool((residual <= tolerance).all()):
                break
    found = (basis[..., : share.shape[-2], :].mT @ share).squeeze(-1) * norm * top
    found = torch.where(lost, torch.nan, found)
    return found.unflatten(-1, shape), residual
