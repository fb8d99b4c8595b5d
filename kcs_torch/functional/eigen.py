"""Eigenvectors of symmetric matrices, batched where the library's own are not."""

from __future__ import annotations

from functools import cache
from importlib.util import find_spec

import torch
from torch import Tensor

__all__ = ["eigh", "eigvalsh"]

BATCHED, MOST = 32, 128
"""Rows up to which cuSOLVER takes matrices together, and beyond which one of them keeps a GPU busy enough."""


def eigh(matrix: Tensor) -> tuple[Tensor, Tensor]:
    """Return eigenvalues (..., n) in rising order, and eigenvectors (..., n, n) in columns, as ``torch.linalg.eigh``.

    On a GPU, where that takes larger matrices one after another, many of them are taken together instead, by
    :func:`kcs_torch.functional.jacobi.jacobi`, if Triton is at hand (it comes with PyTorch on Linux).

    Args:
        matrix: (..., n, n), symmetric; both triangles may be read.

    Raises:
        LinAlgError: it holds NaN or infinity.
    """
    if not _are_many(matrix):
        value, vector = torch.linalg.eigh(matrix)
        return value, vector
    from kcs_torch.functional.jacobi import jacobi

    value, vector = jacobi(matrix.flatten(0, -3))
    if not bool(value.isfinite().all()):
        raise torch.linalg.LinAlgError("eigh: expected finite numbers, got NaN or infinite ones")
    return value.view(matrix.shape[:-1]), vector.view(matrix.shape)


def eigvalsh(matrix: Tensor) -> Tensor:
    """Return the eigenvalues alone, as :func:`eigh`."""
    return eigh(matrix)[0] if _are_many(matrix) else torch.linalg.eigvalsh(matrix)


def _are_many(matrix: Tensor) -> bool:
    """Whether matrices on a GPU are too large for its library's batches, and enough for a thread block each."""
    if not matrix.is_cuda or torch.compiler.is_compiling():
        return False
    size, count = matrix.shape[-1], matrix.shape[:-2].numel()
    return BATCHED < size <= MOST and count * BATCHED**2 >= size**2 and _has_triton()


@cache
def _has_triton() -> bool:
    return find_spec("triton") is not None
