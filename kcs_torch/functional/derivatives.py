"""Spectral functions as autograd Functions whose derivatives never divide by a gap between singular values.

Each comes as a pair: the function, whose context holds its inputs, and its adjoint, a Function of its own that cannot
be differentiated again. As the adjoint depends on the inputs, a second derivative is noticed and refused even where the
cotangent is a constant, for which ``once_differentiable`` would cut the graph without a word. Both have a rule for
``torch.func.vmap``: a further batch dimension at the front.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from kcs_torch.errors import NotFiniteError, ShapeError
from kcs_torch.functional.eigen import eigh
from kcs_torch.functional.guarded import or_one
from kcs_torch.functional.precision import full_precision

__all__ = ["LargestSum", "Once", "PSDShrink", "ShrinkSingularValues", "applied", "batch_first", "why_failed"]


def applied(function: type[torch.autograd.Function], *inputs: Any) -> Any:
    """``function.apply``, or its plain forward where nothing is recorded: a Function costs as much as ten steps.

    Autocast is suspended: its products would lose the digits that factorisations need, in types that few of them take.

    Raises:
        NotFiniteError: the first input holds NaN, so that its factorisation failed.
        ShapeError: it failed for another reason.
    """
    call: Any = function.apply if torch.is_grad_enabled() else function.forward
    try:
        with full_precision(inputs[0]):
            return call(*inputs)
    except torch.linalg.LinAlgError as error:
        raise why_failed(inputs[0], error) from None


def why_failed(matrix: Tensor, error: Exception) -> NotFiniteError | ShapeError:
    """What a matrix whose factorisation failed is refused with."""
    if bool(matrix.isfinite().all()):
        return ShapeError(f"singular values: {error}")
    return NotFiniteError(
        f"singular values: expected finite numbers, got NaN or infinite ones in a {tuple(matrix.shape)} array: "
        "give unseen joints weights of 0, and cameras, where any are given, finite numbers in every frame; where a "
        "network made them, its training diverged"
    )


def batch_first(info: Any, in_dims: tuple[int | None, ...], tensors: tuple[Tensor, ...], cores: tuple[int, ...]) -> Any:
    """Bring the dimension that vmap maps over to the front of all tensors, and batch dimensions to one number.

    Args:
        info: of the vmap rule.
        in_dims: the mapped dimension of each tensor, None where it has none.
        tensors: (..., core dimensions).
        cores: how many core dimensions each has.

    Returns:
        The tensors, each (V, 1, ..., batch, core), and the shapes (V, batch, core) they have without the padding.
    """
    first = [
        x.expand(info.batch_size, *x.shape) if d is None else x.movedim(d, 0)
        for x, d in zip(tensors, in_dims, strict=True)
    ]
    depth = max(x.ndim - 1 - core for x, core in zip(first, cores, strict=True))
    padded = [x[(slice(None), *[None] * (depth - (x.ndim - 1 - core)))] for x, core in zip(first, cores, strict=True)]
    return padded, [x.shape for x in first]


class Once(torch.autograd.Function):
    """Base of the adjoints: linear maps of a cotangent, not to be differentiated."""

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: Any) -> None:
        pass

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> None:
        raise RuntimeError("second derivatives of svt, psd_shrink and the norms of singular values are not supported")


# ---------------------------------------------------------------------- U f(S) V^T


class ShrinkSingularValues(torch.autograd.Function):
    """(matrix (..., M, N), threshold t (...), bend k (...)) to U f(S) V^T, and two intermediates.

    f(s) = max(s - t / (1 + k s), 0).
    """

    @staticmethod
    def forward(matrix: Tensor, threshold: Tensor, bend: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        rotated, raw, right = rotate(matrix)
        out = (rotated * ratio(raw, threshold[..., None], bend[..., None])[..., None, :]) @ right.mT
        return (out if tall(matrix) else out.mT), raw, right

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Tensor, ...], output: tuple[Tensor, ...]) -> None:
        ctx.mark_non_differentiable(*output[1:])
        ctx.save_for_backward(*inputs, *output[1:])

    @staticmethod
    def backward(ctx: Any, grad: Tensor, *_: Any) -> tuple[Tensor, Tensor, Tensor]:
        pulled: tuple[Tensor, Tensor, Tensor] = _ShrinkAdjoint.apply(grad, *ctx.saved_tensors)
        return pulled

    @staticmethod
    def vmap(info: Any, in_dims: tuple[int | None, ...], *tensors: Tensor) -> Any:
        padded, _ = batch_first(info, in_dims, tensors, (2, 0, 0))
        return ShrinkSingularValues.apply(*padded), (0, 0, 0)


class _ShrinkAdjoint(Once):
    @staticmethod
    def forward(
        grad: Tensor, matrix: Tensor, threshold: Tensor, bend: Tensor, raw: Tensor, right: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        upright = tall(matrix)
        left, s = left_vectors((matrix if upright else matrix.mT) @ right, raw)
        level, k = threshold[..., None], bend[..., None]
        fall = 1 / (1 + k * s)
        f = (s - level * fall).clamp_min(0)
        gv = (grad if upright else grad.mT) @ right  # (..., M, n)
        p = left.mT @ gv  # (..., n, n)
        share = ratio(s, level, k)
        total = s[..., :, None] + s[..., None, :]
        odd = (f[..., :, None] + f[..., None, :]) / or_one(total)
        odd = torch.where(total > 0, odd, torch.maximum(share[..., :, None], share[..., None, :]))
        inner = divided(s, level, k) * (p + p.mT) / 2 + odd * (p - p.mT) / 2
        out = (left @ inner + (gv - left @ p) * share[..., None, :]) @ right.mT
        pulled = p.diagonal(dim1=-2, dim2=-1) * (f > 0) * fall
        slope, turn = -pulled.sum(-1), (pulled * fall * level * s).sum(-1)
        return (
            (out if upright else out.mT).sum_to_size(matrix.shape),
            slope.sum_to_size(threshold.shape),
            turn.sum_to_size(bend.shape),
        )

    @staticmethod
    def vmap(info: Any, in_dims: tuple[int | None, ...], *tensors: Tensor) -> Any:
        padded, shapes = batch_first(info, in_dims, tensors, (2, 2, 0, 0, 1, 2))
        pulled = _ShrinkAdjoint.apply(*padded)
        return tuple(x.reshape(shape) for x, shape in zip(pulled, shapes[1:4], strict=True)), (0, 0, 0)


# ---------------------------------------------------------------------- V f(L) V^T


class PSDShrink(torch.autograd.Function):
    """(symmetric matrix (..., N, N), threshold (...)) to V max(L - threshold, 0) V^T, and two intermediates."""

    @staticmethod
    def forward(matrix: Tensor, threshold: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        value, vector = eigh(matrix)
        f = (value - threshold[..., None]).clamp_min(0)
        return (vector * f[..., None, :]) @ vector.mT, value, vector

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Tensor, Tensor], output: tuple[Tensor, Tensor, Tensor]) -> None:
        ctx.mark_non_differentiable(*output[1:])
        ctx.save_for_backward(*inputs, *output[1:])

    @staticmethod
    def backward(ctx: Any, grad: Tensor, *_: Any) -> tuple[Tensor, Tensor]:
        pulled: tuple[Tensor, Tensor] = _PSDAdjoint.apply(grad, *ctx.saved_tensors)
        return pulled

    @staticmethod
    def vmap(info: Any, in_dims: tuple[int | None, ...], matrix: Tensor, threshold: Tensor) -> Any:
        padded, _ = batch_first(info, in_dims, (matrix, threshold), (2, 0))
        return PSDShrink.apply(*padded), (0, 0, 0)


class _PSDAdjoint(Once):
    @staticmethod
    def forward(
        grad: Tensor, matrix: Tensor, threshold: Tensor, value: Tensor, vector: Tensor
    ) -> tuple[Tensor, Tensor]:
        level = threshold[..., None]
        p = vector.mT @ ((grad + grad.mT) / 2) @ vector
        out = vector @ (divided(value, level) * p) @ vector.mT
        slope = -(p.diagonal(dim1=-2, dim2=-1) * (value > level)).sum(-1)
        return out.sum_to_size(matrix.shape), slope.sum_to_size(threshold.shape)

    @staticmethod
    def vmap(info: Any, in_dims: tuple[int | None, ...], *tensors: Tensor) -> Any:
        padded, shapes = batch_first(info, in_dims, tensors, (2, 2, 0, 1, 2))
        matrix, threshold = _PSDAdjoint.apply(*padded)
        return (matrix.reshape(shapes[1]), threshold.reshape(shapes[2])), (0, 0)


# ---------------------------------------------------------------------- sums of singular values


class LargestSum(torch.autograd.Function):
    """Sum of the ``count`` largest singular values (Ky Fan norm) of (..., M, N), and two intermediates."""

    @staticmethod
    def forward(matrix: Tensor, count: int) -> tuple[Tensor, Tensor, Tensor]:
        _, s, right = rotate(matrix)
        kept = slice(s.shape[-1] - count, None)
        # Copies: slices would hold the whole in memory, and an output must not be a view of another.
        return s[..., kept].sum(-1), s[..., kept].clone(), right[..., kept].clone()

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Tensor, int], output: tuple[Tensor, Tensor, Tensor]) -> None:
        ctx.mark_non_differentiable(*output[1:])
        ctx.save_for_backward(inputs[0], *output[1:])

    @staticmethod
    def backward(ctx: Any, grad: Tensor, *_: Any) -> tuple[Tensor, None]:
        return _SumAdjoint.apply(grad, *ctx.saved_tensors), None

    @staticmethod
    def vmap(info: Any, in_dims: tuple[int | None, ...], matrix: Tensor, count: int) -> Any:
        return LargestSum.apply(matrix.movedim(in_dims[0] or 0, 0), count), (0, 0, 0)


class _SumAdjoint(Once):
    @staticmethod
    def forward(grad: Tensor, matrix: Tensor, s: Tensor, right: Tensor) -> Tensor:
        upright = tall(matrix)
        left, _ = left_vectors((matrix if upright else matrix.mT) @ right, s)
        polar = left @ right.mT
        return grad[..., None, None] * (polar if upright else polar.mT)

    @staticmethod
    def vmap(info: Any, in_dims: tuple[int | None, ...], *tensors: Tensor) -> Any:
        padded, _ = batch_first(info, in_dims, tensors, (0, 2, 1, 2))
        return _SumAdjoint.apply(*padded), 0


# ---------------------------------------------------------------------- parts


def tall(matrix: Tensor) -> bool:
    """Whether a matrix has at least as many rows as columns; a wide one is transposed."""
    return matrix.shape[-2] >= matrix.shape[-1]


def rotate(matrix: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Rotate the columns of a tall (or transposed wide) matrix onto its right singular vectors.

    Returns ``matrix @ V`` (M, n), its column norms (n), which are the singular values in rising order, and V (n, n).
    """
    work = matrix if tall(matrix) else matrix.mT
    _, right = eigh(work.mT @ work)
    rotated = work @ right
    return rotated, torch.linalg.vector_norm(rotated, dim=-2), right


def left_vectors(rotated: Tensor, s: Tensor) -> tuple[Tensor, Tensor]:
    """Left singular vectors, and the singular values, both zero below sqrt(eps) times the largest value.

    There the Gram matrix no longer tells directions apart.
    """
    if s.shape[-1] == 0:
        return rotated, s
    kept = s > torch.finfo(s.dtype).eps ** 0.5 * s.amax(-1, keepdim=True)
    inverse = torch.where(kept, 1 / torch.where(kept, s, torch.ones_like(s)), torch.zeros_like(s))
    return rotated * inverse[..., None, :], torch.where(kept, s, torch.zeros_like(s))


def divided(s: Tensor, level: Tensor, bend: Tensor | float = 0.0) -> Tensor:
    """Divided differences (f_i - f_j) / (s_i - s_j) of :func:`ratio`'s f, f' on equal pairs; in [0, 2].

    With e the value at which f leaves 0 they are the share of the interval between the two values that lies above e,
    times 1 + t k / (1 + k s_i) (1 + k s_j), where a value below e counts as e: written so, no difference of nearly
    equal numbers is divided by another.
    """
    hi = torch.maximum(s[..., :, None], s[..., None, :])
    lo = torch.minimum(s[..., :, None], s[..., None, :])
    # Levels below 0, which thresholds of symmetric matrices may have, come without bend.
    edge = (2 * level / (1 + (1 + 4 * (level * bend).clamp_min(0)).sqrt()))[..., None]
    split = (lo < edge) & (hi > edge)  # only then is the share neither 0 nor 1; the gap is positive there
    share = (hi - edge) / torch.where(split, hi - lo, torch.ones_like(hi))
    above = (lo >= edge) & ((hi > edge) | (edge <= 0))
    k = bend[..., None] if isinstance(bend, Tensor) else bend
    steep = 1 + level[..., None] * k / ((1 + k * hi) * (1 + k * torch.maximum(lo, edge)))
    return torch.where(split, share, above.to(s.dtype)) * steep


def ratio(s: Tensor, level: Tensor, bend: Tensor | float = 0.0) -> Tensor:
    """f(s) / s for f(s) = max(s - level / (1 + bend s), 0), continued to s = 0: 1 where the level is 0, else 0."""
    positive = s > 0
    share = (1 - level / torch.where(positive, s * (1 + bend * s), torch.ones_like(s))).clamp_min(0)
    return torch.where(positive, share, (level <= 0).to(s.dtype))
