"""Functions of singular values and eigenvalues, with derivatives of their own.

Autograd through ``torch.linalg.svd`` divides by the gaps between singular values, which gives NaN for static,
padded or unseen tracks. The functions here differentiate the spectral *function* instead. For
``F = U f(S) V^T`` with f(s) = max(s - t, 0) the adjoint of a cotangent G needs only the divided differences

    (f_i - f_j) / (s_i - s_j)    and    (f_i + f_j) / (s_i + s_j),

which are bounded, applied to the symmetric and skew part of ``U^T G V``. Repeated and zero singular values are
harmless. The derivatives are in ``kcs_torch.functional.derivatives``; ``torch.compile``, ``torch.export`` and
``torch.func.vmap`` take them.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from kcs_torch.errors import OptionError, ShapeError
from kcs_torch.functional.derivatives import LargestSum, PSDShrink, ShrinkSingularValues, applied, why_failed
from kcs_torch.functional.eigen import eigvalsh
from kcs_torch.functional.precision import double, wide
from kcs_torch.functional.shapes import check_core, fit_together

__all__ = ["dct_basis", "log_det", "nuclear_norm", "psd_shrink", "singular_values", "spectral_norm", "svt"]


def svt(matrix: Tensor, threshold: Tensor | float, corner: Tensor | float = math.inf) -> Tensor:
    """Return U max(S - threshold, 0) V^T: singular value thresholding, the prox of the nuclear norm.

    With a corner c each singular value s is shrunk by threshold c / (c + s) instead: the reweighted nuclear norm, which
    majorises sum_i c log(1 + s_i / c), a tighter surrogate of rank that leaves what is large nearly as it is.

    Computed in double precision from the eigenvectors of the smaller Gram matrix, which for tall matrices is many
    times faster than the SVD; singular values are then measured as column norms of ``matrix @ V``, so the error is that
    of rounding (about ``eps * largest singular value``) down to singular values of 1.5e-8 times the largest, below
    which it is at most the threshold itself.

    Args:
        matrix: (..., M, N).
        threshold: non-negative, a number or a tensor that broadcasts against (...); in the unit of the matrix. What a
            tensor has below 0 counts as 0.
        corner: positive, as the threshold; 0, the size of a matrix of zeros, is taken for infinite.

    Returns:
        (..., M, N). Differentiable once, in all arguments; a second derivative raises ``RuntimeError``.

    Raises:
        ShapeError: fewer than 2 dimensions, whole numbers, NaN, or a threshold or corner that does not broadcast.
        OptionError: a number for the threshold or the corner is negative.

    Cai, Candes, Shen 2010; Ma, Goldfarb, Chen 2011 (the shrinkage of FPC); Candes, Wakin, Boyd 2008 (reweighting).

    >>> svt(torch.diag(torch.tensor([3.0, 1.0])), 2.0).round(decimals=5).tolist()
    [[1.0, 0.0], [0.0, 0.0]]
    """
    _check_matrix(matrix, "svt")
    work = double(matrix)
    level = _level(threshold, "svt: threshold", work, sign=True)
    size = _level(corner, "svt: corner", work, sign=True)
    least = torch.finfo(work.dtype).tiny ** 0.5  # of which the inverse, and its square in the derivative, are finite
    level = level.clamp(0, 1 / least)  # infinite ones leave nothing either way
    bend = torch.where(size > 0, 1 / torch.where(size > 0, size.clamp_min(least), 1), 0)
    bend = torch.where(size.isnan(), torch.nan, bend)
    out: Tensor = applied(ShrinkSingularValues, work, level, bend)[0]
    return out.to(matrix.dtype)


def psd_shrink(matrix: Tensor, threshold: Tensor | float) -> Tensor:
    """Return V max(L - threshold, 0) V^T of a symmetric matrix: the prox of the trace over the PSD cone.

    Args:
        matrix: (..., N, N); its symmetric part is taken.
        threshold: a number or a tensor that broadcasts against (...).

    Returns:
        (..., N, N), positive semi-definite. Differentiable once, in both arguments.

    Raises:
        ShapeError: the matrices are not square, or hold NaN.

    SfAM section 3.2 (the shrinkage of IST).

    >>> psd_shrink(torch.diag(torch.tensor([3.0, -1.0])), 1.0).round(decimals=5).tolist()
    [[2.0, 0.0], [0.0, 0.0]]
    """
    _check_matrix(matrix, "psd_shrink")
    if matrix.shape[-1] != matrix.shape[-2]:
        raise ShapeError(f"psd_shrink: expected square matrices, got {tuple(matrix.shape)}")
    work = wide(matrix)
    level = _level(threshold, "psd_shrink: threshold", work)
    out: Tensor = applied(PSDShrink, (work + work.mT) / 2, level)[0]
    return out.to(matrix.dtype)


def nuclear_norm(matrix: Tensor) -> Tensor:
    """Return the sum of singular values; its gradient is U V^T over the non-zero ones, never NaN.

    Args:
        matrix: (..., M, N).

    Returns:
        (...). Differentiable once.

    Raises:
        ShapeError: fewer than 2 dimensions, or NaN.

    >>> nuclear_norm(torch.diag(torch.tensor([3.0, 4.0]))).round(decimals=5).item()
    7.0
    """
    _check_matrix(matrix, "nuclear_norm")
    out: Tensor = applied(LargestSum, double(matrix), min(matrix.shape[-2:]))[0]
    return out.to(matrix.dtype)


def spectral_norm(matrix: Tensor) -> Tensor:
    """Return the largest singular value; its gradient is u v^T, 0 for a zero matrix.

    Args:
        matrix: (..., M, N), not empty.

    Returns:
        (...). Differentiable once; where the largest value is repeated the gradient is one of many.

    Raises:
        ShapeError: fewer than 2 dimensions, or NaN.

    >>> spectral_norm(torch.diag(torch.tensor([3.0, 4.0]))).round(decimals=5).item()
    4.0
    """
    _check_matrix(matrix, "spectral_norm")
    out: Tensor = applied(LargestSum, double(matrix), 1)[0]
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
    work = wide(matrix)
    level = _level(eps, "log_det: eps", work)
    eye = torch.eye(matrix.shape[-1], dtype=work.dtype, device=matrix.device)
    try:
        factor = torch.linalg.cholesky(work + level[..., None, None] * eye)
    except torch.linalg.LinAlgError:
        message = "log_det: matrix + eps I is not positive definite: expected a finite covariance and eps > 0"
        raise ShapeError(message) from None
    return (2 * factor.diagonal(dim1=-2, dim2=-1).log().sum(-1)).to(matrix.dtype)


def singular_values(matrix: Tensor) -> Tensor:
    """Return the singular values in falling order, from the smaller Gram matrix; not differentiable.

    Args:
        matrix: (..., M, N).

    Returns:
        (..., min(M, N)), accurate to about 1e-8 times the largest.

    Raises:
        ShapeError: fewer than 2 dimensions.
        NotFiniteError: the matrix holds NaN.
    """
    _check_matrix(matrix, "singular_values")
    with torch.no_grad():
        work = double(matrix)
        gram = work.mT @ work if work.shape[-2] >= work.shape[-1] else work @ work.mT
        try:
            values = eigvalsh(gram)
        except torch.linalg.LinAlgError as error:
            raise why_failed(matrix, error) from None
        return values.clamp_min(0).sqrt().flip(-1).to(matrix.dtype)


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


def _check_matrix(matrix: Tensor, name: str) -> None:
    check_core(matrix, f"{name}: matrix", "M", "N")
    if not matrix.is_floating_point():
        raise ShapeError(f"{name}: expected a matrix in floating point, got {matrix.dtype}")


def _level(value: Tensor | float, name: str, matrix: Tensor, *, sign: bool = False) -> Tensor:
    """A number or a tensor that broadcasts against (...), for matrices (..., M, N); with ``sign`` not negative."""
    if sign and not isinstance(value, Tensor) and not value >= 0:
        raise OptionError(f"{name}: expected a number that is not negative, got {value}")
    level = torch.as_tensor(value, dtype=matrix.dtype, device=matrix.device)
    if not fit_together(level.shape, matrix.shape[:-2]):
        expected = f"a number, or a tensor that broadcasts against {tuple(matrix.shape[:-2])}"
        raise ShapeError(f"{name}: expected {expected}, got {tuple(level.shape)} for matrices {tuple(matrix.shape)}")
    return level
