"""Functions of singular values and eigenvalues, with derivatives of their own.

Autograd through ``torch.linalg.svd`` divides by the gaps between singular values, which gives NaN for static,
padded or unseen tracks. The functions here differentiate the spectral *function* instead. For
``F = U f(S) V^T`` with f(s) = max(s - t, 0) the adjoint of a cotangent G needs only the divided differences

    (f_i - f_j) / (s_i - s_j)    and    (f_i + f_j) / (s_i + s_j),

both in [0, 1], applied to the symmetric and skew part of ``U^T G V``. Repeated and zero singular values are harmless.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from kcs_torch.errors import ShapeError

__all__ = ["dct_basis", "log_det", "nuclear_norm", "psd_shrink", "singular_values", "spectral_norm", "svt"]


def svt(matrix: Tensor, threshold: Tensor | float) -> Tensor:
    """Return U max(S - threshold, 0) V^T: singular value thresholding, the prox of the nuclear norm.

    Computed in double precision from the eigenvectors of the smaller Gram matrix, which for tall matrices is many
    times faster than the SVD; singular values are then measured as column norms of ``matrix @ V``, so the error is that
    of rounding (about ``eps * largest singular value``) down to singular values of 1.5e-8 times the largest, below
    which it is at most the threshold itself.

    Args:
        matrix: (..., M, N).
        threshold: non-negative, a number or a tensor that broadcasts against (...); in the unit of the matrix.

    Returns:
        (..., M, N). Differentiable once, in both arguments; a second derivative raises ``RuntimeError``.

    Raises:
        ShapeError: fewer than 2 dimensions.

    Cai, Candes, Shen 2010; Ma, Goldfarb, Chen 2011 (the shrinkage of FPC).

    >>> svt(torch.diag(torch.tensor([3.0, 1.0])), 2.0).round(decimals=5).tolist()
    [[1.0, 0.0], [0.0, 0.0]]
    """
    _check_matrix(matrix, "svt")
    work = _double(matrix)
    level = torch.as_tensor(threshold, dtype=work.dtype, device=matrix.device)
    out: Tensor = _SVT.apply(work, level)
    return out.to(matrix.dtype)


def psd_shrink(matrix: Tensor, threshold: Tensor | float) -> Tensor:
    """Return V max(L - threshold, 0) V^T of a symmetric matrix: the prox of the trace over the PSD cone.

    Args:
        matrix: (..., N, N); its symmetric part is taken.
        threshold: a number or a tensor that broadcasts against (...).

    Returns:
        (..., N, N), positive semi-definite. Differentiable once, in both arguments.

    Raises:
        ShapeError: the matrices are not square.

    SfAM section 3.2 (the shrinkage of IST).

    >>> psd_shrink(torch.diag(torch.tensor([3.0, -1.0])), 1.0).round(decimals=5).tolist()
    [[2.0, 0.0], [0.0, 0.0]]
    """
    _check_matrix(matrix, "psd_shrink")
    if matrix.shape[-1] != matrix.shape[-2]:
        raise ShapeError(f"psd_shrink: expected square matrices, got {tuple(matrix.shape)}")
    work = _single(matrix)
    level = torch.as_tensor(threshold, dtype=work.dtype, device=matrix.device)
    out: Tensor = _PSDShrink.apply((work + work.mT) / 2, level)
    return out.to(matrix.dtype)


def nuclear_norm(matrix: Tensor) -> Tensor:
    """Return the sum of singular values; its gradient is U V^T over the non-zero ones, never NaN.

    Args:
        matrix: (..., M, N).

    Returns:
        (...). Differentiable once.

    >>> nuclear_norm(torch.diag(torch.tensor([3.0, 4.0]))).round(decimals=5).item()
    7.0
    """
    _check_matrix(matrix, "nuclear_norm")
    out: Tensor = _LargestSum.apply(_double(matrix), min(matrix.shape[-2:]))
    return out.to(matrix.dtype)


def spectral_norm(matrix: Tensor) -> Tensor:
    """Return the largest singular value; its gradient is u v^T, 0 for a zero matrix.

    Args:
        matrix: (..., M, N), not empty.

    Returns:
        (...). Differentiable once; where the largest value is repeated the gradient is one of many.

    >>> spectral_norm(torch.diag(torch.tensor([3.0, 4.0]))).round(decimals=5).item()
    4.0
    """
    _check_matrix(matrix, "spectral_norm")
    out: Tensor = _LargestSum.apply(_double(matrix), 1)
    return out.to(matrix.dtype)


def log_det(matrix: Tensor, eps: Tensor | float) -> Tensor:
    """Return log det(matrix + eps I) of positive semi-definite matrices, by one Cholesky factorisation.

    Args:
        matrix: (..., N, N), symmetric positive semi-definite.
        eps: positive, a number or a tensor that broadcasts against (...), in the unit of the matrix.

    Returns:
        (...).

    Raises:
        ShapeError: the matrices are not square, or matrix + eps I is not positive definite.

    >>> round(log_det(torch.zeros(2, 2), 1.0).item(), 6)
    0.0
    """
    _check_matrix(matrix, "log_det")
    if matrix.shape[-1] != matrix.shape[-2]:
        raise ShapeError(f"log_det: expected square matrices, got {tuple(matrix.shape)}")
    work = _single(matrix)
    level = torch.as_tensor(eps, dtype=work.dtype, device=matrix.device)
    eye = torch.eye(matrix.shape[-1], dtype=work.dtype, device=matrix.device)
    factor, info = torch.linalg.cholesky_ex(work + level[..., None, None] * eye)
    if bool((info != 0).any()):
        raise ShapeError("log_det: matrix + eps I is not positive definite: expected a covariance and eps > 0")
    return (2 * factor.diagonal(dim1=-2, dim2=-1).log().sum(-1)).to(matrix.dtype)


def singular_values(matrix: Tensor) -> Tensor:
    """Return the singular values in falling order, from the smaller Gram matrix; not differentiable.

    Args:
        matrix: (..., M, N).

    Returns:
        (..., min(M, N)), accurate to about 1e-8 times the largest.
    """
    with torch.no_grad():
        work = _double(matrix)
        gram = work.mT @ work if work.shape[-2] >= work.shape[-1] else work @ work.mT
        return torch.linalg.eigvalsh(gram).clamp_min(0).sqrt().flip(-1).to(matrix.dtype)


def dct_basis(
    length: int, count: int, *, dtype: torch.dtype | None = None, device: torch.device | None = None
) -> Tensor:
    """Return the first ``count`` orthonormal cosines (DCT-II) over ``length`` samples.

    Args:
        length: T.
        count: how many, at most T.
        dtype: of the result; torch's default if None.
        device: of the result.

    Returns:
        (T, count) with orthonormal columns; the first is constant.

    Raises:
        ShapeError: ``count`` is not within 1..T.

    >>> basis = dct_basis(5, 3, dtype=torch.float64)
    >>> torch.allclose(basis.mT @ basis, torch.eye(3, dtype=torch.float64))
    True
    """
    if not 1 <= count <= length:
        raise ShapeError(f"dct_basis: expected 1..{length} basis functions for {length} samples, got {count}")
    dtype = dtype or torch.get_default_dtype()
    time = torch.arange(length, dtype=dtype, device=device) + 0.5
    wave = torch.arange(count, dtype=dtype, device=device)
    basis = torch.cos(torch.pi / length * time[:, None] * wave) * (2 / length) ** 0.5
    basis[:, 0] = length**-0.5
    return basis


# ---------------------------------------------------------------------- derivatives


class _Barrier(torch.autograd.Function):
    """Passes gradients on, and raises where somebody differentiates them again.

    ``once_differentiable`` alone would cut the graph without a word where the cotangent is a constant.
    """

    @staticmethod
    def forward(ctx: Any, value: Tensor, anchor: Tensor) -> Tensor:
        return value.view_as(value)

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> tuple[None, None]:
        raise RuntimeError("second derivatives of svt, psd_shrink and the norms of singular values are not supported")


def _first_order(backward: Callable[..., tuple[Tensor | None, ...]]) -> Callable[..., tuple[Tensor | None, ...]]:
    """Decorate a backward pass that cannot be differentiated itself."""

    @functools.wraps(backward)
    def guarded(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
        with torch.no_grad():
            grads = backward(ctx, grad)
        if not torch.is_grad_enabled():
            return grads
        anchor = torch.zeros((), requires_grad=True)
        return tuple(None if g is None else _Barrier.apply(g, anchor) for g in grads)

    return guarded


class _SVT(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, matrix: Tensor, threshold: Tensor) -> Tensor:
        rotated, raw, right, tall = _rotate(matrix)
        level = threshold[..., None]
        ctx.save_for_backward(rotated, raw, right, threshold)
        ctx.tall = tall
        out = (rotated * _ratio(raw, level)[..., None, :]) @ right.mT
        return out if tall else out.mT

    @staticmethod
    @_first_order
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, Tensor | None]:
        rotated, raw, right, threshold = ctx.saved_tensors
        left, s = _left(rotated, raw)
        f = (s - threshold[..., None]).clamp_min(0)
        g = grad if ctx.tall else grad.mT
        gv = g @ right  # (..., M, n)
        p = left.mT @ gv  # (..., n, n)
        grad_matrix = grad_threshold = None
        if ctx.needs_input_grad[0]:
            ratio = _ratio(s, threshold[..., None])
            even = _divided(s, threshold[..., None])
            total = s[..., :, None] + s[..., None, :]
            odd = (f[..., :, None] + f[..., None, :]) / torch.where(total > 0, total, torch.ones_like(total))
            odd = torch.where(total > 0, odd, torch.maximum(ratio[..., :, None], ratio[..., None, :]))
            symmetric, skew = (p + p.mT) / 2, (p - p.mT) / 2
            inner = even * symmetric + odd * skew
            outside = (gv - left @ p) * ratio[..., None, :]
            grad_matrix = (left @ inner + outside) @ right.mT
            if not ctx.tall:
                grad_matrix = grad_matrix.mT
        if ctx.needs_input_grad[1]:
            active = (f > 0).to(f.dtype)
            grad_threshold = -(p.diagonal(dim1=-2, dim2=-1) * active).sum(-1)
            grad_threshold = grad_threshold.sum_to_size(threshold.shape)
        return grad_matrix, grad_threshold


class _PSDShrink(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, matrix: Tensor, threshold: Tensor) -> Tensor:
        value, vector = torch.linalg.eigh(matrix)
        f = (value - threshold[..., None]).clamp_min(0)
        ctx.save_for_backward(value, vector, f, threshold)
        return (vector * f[..., None, :]) @ vector.mT

    @staticmethod
    @_first_order
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, Tensor | None]:
        value, vector, f, threshold = ctx.saved_tensors
        p = vector.mT @ ((grad + grad.mT) / 2) @ vector
        grad_matrix = grad_threshold = None
        if ctx.needs_input_grad[0]:
            grad_matrix = vector @ (_divided(value, threshold[..., None]) * p) @ vector.mT
        if ctx.needs_input_grad[1]:
            active = (f > 0).to(f.dtype)
            grad_threshold = -(p.diagonal(dim1=-2, dim2=-1) * active).sum(-1)
            grad_threshold = grad_threshold.sum_to_size(threshold.shape)
        return grad_matrix, grad_threshold


class _LargestSum(torch.autograd.Function):
    """Sum of the largest singular values (Ky Fan norm): all of them, or the first."""

    @staticmethod
    def forward(ctx: Any, matrix: Tensor, count: int) -> Tensor:
        rotated, s, right, tall = _rotate(matrix)
        kept = slice(s.shape[-1] - count, None)
        ctx.save_for_backward(_left(rotated, s)[0][..., kept], right[..., kept])
        ctx.tall = tall
        return s[..., kept].sum(-1)

    @staticmethod
    @_first_order
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, None]:
        left, right = ctx.saved_tensors
        polar = left @ right.mT
        return grad[..., None, None] * (polar if ctx.tall else polar.mT), None


def _rotate(matrix: Tensor) -> tuple[Tensor, Tensor, Tensor, bool]:
    """Rotate the columns of a tall (or transposed wide) matrix onto its right singular vectors.

    Returns ``matrix @ V`` (M, n), its column norms (n), which are the singular values in rising order, V (n, n),
    and whether the matrix was tall.
    """
    tall = matrix.shape[-2] >= matrix.shape[-1]
    work = matrix if tall else matrix.mT
    _, right = torch.linalg.eigh(work.mT @ work)
    rotated = work @ right
    return rotated, torch.linalg.vector_norm(rotated, dim=-2), right, tall


def _left(rotated: Tensor, s: Tensor) -> tuple[Tensor, Tensor]:
    """Left singular vectors, and the singular values, both zero below sqrt(eps) times the largest value.

    There the Gram matrix no longer tells directions apart.
    """
    if s.shape[-1] == 0:
        return rotated, s
    kept = s > torch.finfo(s.dtype).eps ** 0.5 * s.amax(-1, keepdim=True)
    inverse = torch.where(kept, 1 / torch.where(kept, s, torch.ones_like(s)), torch.zeros_like(s))
    return rotated * inverse[..., None, :], torch.where(kept, s, torch.zeros_like(s))


def _divided(s: Tensor, level: Tensor) -> Tensor:
    """Divided differences (f_i - f_j) / (s_i - s_j) of f(s) = max(s - level, 0), f' on equal pairs; in [0, 1].

    It is the share of the interval between the two values that lies above the level: written so, no difference of
    nearly equal numbers is divided by another.
    """
    hi = torch.maximum(s[..., :, None], s[..., None, :])
    lo = torch.minimum(s[..., :, None], s[..., None, :])
    edge = level[..., None]
    split = (lo < edge) & (hi > edge)  # only then is the share neither 0 nor 1; the gap is positive there
    share = (hi - edge) / torch.where(split, hi - lo, torch.ones_like(hi))
    above = (lo >= edge) & ((hi > edge) | (edge <= 0))
    return torch.where(split, share, above.to(s.dtype))


def _ratio(s: Tensor, level: Tensor) -> Tensor:
    """f(s) / s for f(s) = max(s - level, 0), continued to s = 0: 1 where the level is 0, else 0."""
    positive = s > 0
    ratio = (1 - level / torch.where(positive, s, torch.ones_like(s))).clamp_min(0)
    return torch.where(positive, ratio, (level <= 0).to(s.dtype))


def _single(matrix: Tensor) -> Tensor:
    """Half precision is widened, as no LAPACK takes it; the result is cast back."""
    return matrix.float() if matrix.dtype in (torch.float16, torch.bfloat16) else matrix


def _double(matrix: Tensor) -> Tensor:
    """A Gram matrix squares the singular values: in single precision it would lose those below 3e-4 of the largest.

    MPS devices know no double precision.
    """
    return _single(matrix) if matrix.device.type == "mps" else matrix.double()


def _check_matrix(matrix: Tensor, name: str) -> None:
    if matrix.ndim < 2:
        raise ShapeError(f"{name}: expected a matrix (..., M, N), got shape {tuple(matrix.shape)}")
