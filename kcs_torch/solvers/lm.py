"""The bone-length step: a Levenberg-Marquardt prox in the space of bones."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from kcs_torch.errors import OptionError, ShapeError
from kcs_torch.functional.chain import bone_vectors, incidence, index_rows
from kcs_torch.functional.coupled import solve_coupled
from kcs_torch.functional.precision import widened
from kcs_torch.functional.shapes import broadcast_shapes, check_batches, check_core, check_floats, fit_together

__all__ = ["fit_bones"]

RAISE, EASE = 4.0, 0.5
"""What a frame's damping grows by after a step that is not taken, and what share of it stays after one that is."""


@widened
def fit_bones(
    points: Tensor,
    lengths: Tensor,
    bones: Tensor | Sequence[Sequence[int]],
    *,
    stiffness: Tensor | float = 1.5,
    num_steps: int = 3,
    damping: float = 0.0,
    start: Tensor | None = None,
) -> Tensor:
    """Return argmin_A  stiffness/2 sum_b (|b(A)| - L_b)^2 + 1/2 |A - points|^2, by Levenberg-Marquardt.

    The residuals r_b = |b| - L_b have the Jacobian rows J_b = (b/|b|) (e_child - e_parent)^T. By the matrix inversion
    lemma the step A = points - J^T y needs only

        (1/stiffness + J J^T) y = r + J (points - A),        J J^T = (C^T C) o Psi / (|b| |b|^T),

    a B x B system per frame of the KCS matrix Psi, where the textbook step solves 3N x 3N. It couples bones that meet,
    so that a tree's takes a few operations a bone (:func:`kcs_torch.functional.coupled.solve_coupled`).

    A frame's step is taken where it does not raise the objective; else the next is damped more. A single step is taken
    whatever it does: where bones are far longer than their targets it may raise the objective.

    Args:
        points: (..., N, D), what A stays near.
        lengths: (..., B) target lengths L, in the unit of the points; 0 asks for a zero-length bone.
        bones: (B, 2) integer (parent, child) pairs.
        stiffness: the paper's beta, non-negative: a number, or a tensor that broadcasts against (..., B); 0 frees a
            bone. Above 1 / (B eps) it is as good as infinite and is cut there (5e5 for 16 bones in single precision).
        num_steps: Levenberg-Marquardt steps, also those not taken; each gains about a digit where bones are within a
            few per cent of their length, less where they are far off.
        damping: non-negative, the least; shortens the steps without moving the solution.
        start: (..., N, D), A to start from; ``points`` if None.

    Returns:
        A (..., N, D). Twice differentiable in points, lengths, stiffness and start; a bone of length zero has a
        smoothed direction (see Note), so values and gradients stay finite.

    Raises:
        ShapeError: the shapes do not fit, or the points are not in floating point.
        OptionError: ``num_steps``, ``damping`` or a number for ``stiffness`` is negative.

    Note:
        |b| is sqrt(|b|^2 + e^2), e being 1e-4 times the mean target length: 5e-9 relative at the target.

    Kovalenko et al. 2019 (SfAM), eq. 14 and Algorithm 1, line 6.

    >>> X = torch.tensor([[0.0, 0, 0], [1, 0, 0]], dtype=torch.float64)
    >>> A = fit_bones(X, torch.tensor([2.0], dtype=torch.float64), torch.tensor([[0, 1]]), stiffness=1e6)
    >>> A.round(decimals=3).tolist()
    [[-0.5, 0.0, 0.0], [1.5, 0.0, 0.0]]
    """
    check_floats(points, "fit_bones: points", "N", "D")
    bones = index_rows(bones, points.shape[-2])
    if start is not None:
        check_core(start, "fit_bones: start", *points.shape[-2:])
        check_batches("fit_bones: points and start", points, start, cores=(2, 2))
        start = start.to(points.dtype)
    if lengths.shape[-1:] != bones.shape[:1]:
        raise ShapeError(
            f"fit_bones: expected points (..., N, D) and lengths (..., {len(bones)}), "
            f"got {tuple(points.shape)} and {tuple(lengths.shape)}"
        )
    if num_steps < 0 or damping < 0 or (isinstance(stiffness, float | int) and not stiffness >= 0):
        raise OptionError(
            f"fit_bones: expected num_steps, damping and stiffness >= 0, got {num_steps}, {damping} and {stiffness}"
        )
    check_batches("fit_bones: points and lengths", points, lengths, cores=(2, 1))
    limits, lengths = torch.finfo(points.dtype), lengths.to(points.dtype)
    matrix = incidence(bones, points.shape[-2], dtype=points.dtype)  # (N, B)
    overlap = matrix.mT @ matrix  # (B, B)
    beta = torch.as_tensor(stiffness, dtype=points.dtype, device=points.device)
    batch = broadcast_shapes(points.shape[:-2], lengths.shape[:-1])
    if beta.shape[-1:] not in ((), (1,), bones.shape[:1]) or not fit_together(beta.shape[:-1], batch):
        expected = f"a number or a tensor that broadcasts against {(*batch, len(bones))}"
        raise ShapeError(f"fit_bones: stiffness: expected {expected}, got {tuple(beta.shape)}")
    beta = beta.clamp_max(1 / (max(len(bones), 1) * limits.eps))  # beyond it the system loses its unit diagonal
    root = (beta + limits.tiny).sqrt()  # a derivative at 0, too
    root = root.expand(broadcast_shapes(root.shape, lengths.shape[-1:]))
    floor = 1e-4 * lengths.detach().abs().mean(-1, keepdim=True)
    tiny = limits.tiny**0.5
    anchor_bones = bone_vectors(points, bones)

    def measured(shape: Tensor) -> tuple[Tensor, Tensor]:
        """Bones (..., B, D) and their lengths (..., B)."""
        vectors = bone_vectors(shape, bones)
        return vectors, (vectors.square().sum(-1) + (floor + tiny).square()).sqrt()

    def step(shape: Tensor, vectors: Tensor, size: Tensor, level: Tensor | float) -> Tensor:
        """The step from a shape of such bones, damped by a number or by (...)."""
        unit = vectors / size[..., None]
        weighted, way, base, share = root[..., None] * unit, anchor_bones - vectors, points, None
        if isinstance(level, Tensor) or level > 0:
            share = torch.as_tensor(1 / (1 + level), dtype=points.dtype, device=points.device)[..., None, None]
            weighted, way, base = share.sqrt() * weighted, share * way, shape + share * (points - shape)
        residual = size - lengths + (unit * way).sum(-1)
        pull = solve_coupled(weighted, root * residual, bones, overlap)[..., None] * weighted
        return base - matrix @ (pull if share is None else share.sqrt() * pull)

    current = points if start is None else start
    bone = measured(current)
    if num_steps == 1:
        return step(current, *bone, damping)

    def energy(shape: Tensor, size: Tensor) -> Tensor:
        """Twice what is minimised (...), of a shape with bones of such lengths."""
        bent, moved = (root * (size - lengths)).detach(), (shape - points).detach()
        return bent.square().sum(-1) + moved.square().sum((-2, -1))

    value = energy(current, bone[1])
    level = torch.full_like(value, damping)
    rounding = limits.eps * (root * lengths).detach().square().sum(-1)
    for _ in range(num_steps):
        trial = step(current, *bone, level)
        new = measured(trial)
        found = energy(trial, new[1])
        lower = (found <= value + rounding) | ~value.isfinite()
        value, each = torch.where(lower, found, value), lower[..., None]
        current = torch.where(each[..., None], trial, current)
        bone = torch.where(each[..., None], new[0], bone[0]), torch.where(each, new[1], bone[1])
        level = torch.where(lower, damping + EASE * (level - damping), RAISE * (level + 1))
    return current
