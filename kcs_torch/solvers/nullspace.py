"""The metric upgrade by null space and trace: the convex start of the Block Matrix Method."""

from __future__ import annotations

import torch
from torch import Tensor

from kcs_torch.functional.guarded import or_one
from kcs_torch.functional.precision import widened
from kcs_torch.functional.spectral import psd_shrink
from kcs_torch.solvers.ist import check_motion
from kcs_torch.solvers.iterate import iterate

__all__ = ["null_space_upgrade"]

PULL = 0.05
"""p, the trace's weight: a share of the largest eigenvalue of the first F."""


@widened
def null_space_upgrade(motion: Tensor, *, softness: float = 1e-3, num_steps: int = 100) -> Tensor:
    """Return Q of min tr F over F = Q Q^T >= 0 in the null space of the orthonormality constraints, cut to rank 3.

    With A(F) = ((a.Fa - b.Fb)/2, a.Fb) of each frame's motion rows a, b, the paper's null space is A(F) = 0, and its
    scale one condition: here that rows have mean squared length 1. Tracks of bodies are only roughly of rank 3K, so the
    null space is soft: the objective is p tr F + |A(F)|^2 / 2e, with e a share of the largest eigenvalue of A^T A and p
    of that of the first F. Solved by alternating directions: shrinkage on the semi-definite cone, and the quadratic in
    the eigenvectors of A^T A.

    The trace depends on how the tracks are split into motion and shape: as the paper does, columns of motion are taken
    to carry the root of the singular values.

    Args:
        motion: (..., T, 2, R) from :func:`kcs_torch.functional.factorize`, R >= 3.
        softness: the share that makes e; 0 is the exact null space, which only noise-free tracks of rank 3K have.
        num_steps: of alternating directions.

    Returns:
        Q (..., R, 3), so that ``motion @ Q`` are roughly camera rows; unique up to a rotation or reflection.

    Raises:
        ShapeError: R is below 3.

    Dai, Li, He 2012; Xiao, Chai, Kanade 2004 and Akhter et al. 2009 on the null space's dimension, 2K^2 - K.

    >>> from kcs_torch.functional import factorize, orbit, orthonormality_defect
    >>> cameras = orbit(torch.linspace(0, 200, 30, dtype=torch.float64), pitch=20)[:, :2]
    >>> body = torch.randn(9, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    >>> motion, _ = factorize((body - body.mean(0)) @ cameras.mT, 3)
    >>> bool(orthonormality_defect(motion @ null_space_upgrade(motion)).max() < 1e-6)
    True
    """
    check_motion(motion, "null_space_upgrade")
    rank, frames = motion.shape[-1], motion.shape[-3]
    unit = motion.abs().amax((-3, -2, -1), keepdim=True)  # first, so that no product overflows
    motion = motion / or_one(unit)
    size = torch.linalg.vector_norm(motion, dim=(-3, -2))  # (..., R) singular values
    split = size.clamp_min(1e-6 * size.amax(-1, keepdim=True).clamp_min(torch.finfo(size.dtype).tiny)).rsqrt()
    motion = motion * split[..., None, None, :]
    a, b = motion[..., 0, :], motion[..., 1, :]

    # Symmetric matrices as vectors of their triangle, off-diagonal entries times the root of 2: an isometry.
    row, column = torch.triu_indices(rank, rank, device=motion.device)
    stretch = (1 + (row != column).to(motion)).sqrt()
    place = torch.zeros(rank, rank, dtype=torch.long, device=motion.device)
    place[row, column] = place[column, row] = torch.arange(len(row), device=motion.device)

    def matrix(vector: Tensor) -> Tensor:
        return (vector / stretch)[..., place]

    def products(x: Tensor, y: Tensor) -> Tensor:
        return (x[..., row] * y[..., column] + y[..., row] * x[..., column]) / 2 * stretch

    forms = torch.cat([(products(a, a) - products(b, b)) / 2, products(a, b)], -2) / frames**0.5
    value, basis = torch.linalg.eigh(forms.mT @ forms)
    edge = softness * value[..., -1:].clamp_min(0) + torch.finfo(value.dtype).eps * value[..., -1:].abs()
    keep = edge / torch.where(edge > 0, edge + value.clamp_min(0), torch.ones_like(edge))
    keep = torch.where(edge > 0, keep, torch.ones_like(keep))
    scale = (products(a, a) + products(b, b)).mean(-2) / 2  # <scale, F> is the rows' mean squared length

    def soften(vector: Tensor) -> Tensor:
        return (basis @ (keep * (vector[..., None, :] @ basis).squeeze(-2))[..., None]).squeeze(-1)

    along = soften(scale)
    reach = (along * scale).sum(-1, keepdim=True)
    along = along / or_one(reach)

    def near_null_space(vector: Tensor) -> Tensor:
        vector = soften(vector)
        return vector + (1 - (vector * scale).sum(-1, keepdim=True)) * along

    def step(state: tuple[Tensor, Tensor], _: int) -> tuple[Tensor, Tensor]:
        inside, dual = state
        cone = psd_shrink(matrix(inside - dual), level)[..., row, column] * stretch
        inside = near_null_space(cone + dual)
        return inside, dual + cone - inside

    first = near_null_space(torch.zeros_like(scale))
    level = PULL * torch.linalg.matrix_norm(matrix(first), 2)
    inside, dual = iterate(step, (first, torch.zeros_like(first)), num_steps=num_steps).value
    length, axes = torch.linalg.eigh(psd_shrink(matrix(inside - dual), level))
    q = axes[..., -3:] * length[..., None, -3:].clamp_min(0).sqrt()
    return q * split[..., None] / or_one(unit)[..., 0]
