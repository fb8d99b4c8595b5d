"""The metric upgrade of a factorisation: which 3 columns of the motion space are a camera's rows."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from kcs_torch.errors import OptionError, ShapeError
from kcs_torch.functional.camera import orthonormality_defect
from kcs_torch.functional.guarded import or_one
from kcs_torch.functional.precision import widened
from kcs_torch.functional.shapes import broadcast_shapes
from kcs_torch.functional.spectral import psd_shrink
from kcs_torch.solvers.iterate import iterate

__all__ = ["ist", "metric_upgrade"]


@widened
def ist(motion: Tensor, *, weight: float = 1e-3, num_steps: int = 60) -> Tensor:
    """Return Q of the convex relaxation: min_F 1/2 |A(F) - b|^2 + weight tr F over F = Q Q^T >= 0, cut to rank 3.

    A(F) holds m1 F m1 - m2 F m2, 2 m1 F m2 and m1 F m1 + m2 F m2 of each frame's two motion rows, b is (0, 0, 2):
    rows of equal length at a right angle. Solved by accelerated iterative shrinkage (FISTA on the PSD cone).

    Args:
        motion: (..., T, 2, R) from :func:`kcs_torch.functional.factorize`, R >= 3.
        weight: of the trace, relative to the first gradient.
        num_steps: shrinkage steps.

    Returns:
        Q (..., R, 3), so that ``motion @ Q`` are roughly camera rows; unique up to a rotation or reflection.

    Raises:
        ShapeError: R is below 3, or there are no frames.

    Kovalenko et al. 2019, eq. 4-7; Dai, Li, He 2012; Beck, Teboulle 2009.
    """
    check_motion(motion, "ist")
    unit = motion.abs().amax((-3, -2, -1), keepdim=True)  # first, so that no product overflows
    unit = or_one(unit)
    motion = motion / unit
    a, b = motion[..., 0, :], motion[..., 1, :]
    frames = motion.shape[-3]

    def forward(f: Tensor) -> Tensor:
        af, bf = a @ f, b @ f
        aa, bb, ab = (af * a).sum(-1), (bf * b).sum(-1), (af * b).sum(-1)
        return torch.stack([aa - bb, 2 * ab, aa + bb], -1) / frames**0.5

    def adjoint(y: Tensor) -> Tensor:
        y = y / frames**0.5
        wa, wb, wab = y[..., 0] + y[..., 2], y[..., 2] - y[..., 0], y[..., 1]
        cross = (a * wab[..., None]).mT @ b
        return (a * wa[..., None]).mT @ a + (b * wb[..., None]).mT @ b + cross + cross.mT

    goal = torch.zeros(*motion.shape[:-2], 3, dtype=motion.dtype, device=motion.device)
    goal[..., 2] = 2 / frames**0.5
    first = adjoint(goal)
    probe = first  # power iteration for the step size
    for _ in range(8):
        size = torch.linalg.matrix_norm(probe, keepdim=True)
        probe = adjoint(forward(probe / or_one(size)))
    bound = torch.linalg.matrix_norm(probe, keepdim=True).clamp_min(torch.finfo(motion.dtype).tiny) * 1.1
    level = weight * torch.linalg.matrix_norm(first) / bound[..., 0, 0]

    def step(state: tuple[Tensor, Tensor], k: int) -> tuple[Tensor, Tensor]:
        f, ahead = state
        new = psd_shrink(ahead - adjoint(forward(ahead) - goal) / bound, level)
        return new, new + k / (k + 3) * (new - f)

    f = iterate(step, (torch.zeros_like(first), torch.zeros_like(first)), num_steps=num_steps).value[0]
    value, vector = torch.linalg.eigh(f)
    return vector[..., -3:] * value[..., None, -3:].clamp_min(0).sqrt() / unit[..., 0]


@widened
def metric_upgrade(
    motion: Tensor,
    start: Tensor,
    *,
    smoothness: float = 0.0,
    evenness: float = 0.0,
    num_steps: int = 150,
    tolerance: float = 1e-4,
    together: int | None = None,
    counts: Tensor | None = None,
) -> tuple[Tensor, Tensor]:
    """Refine Q by Levenberg-Marquardt on the orthonormality defect of the rows ``motion @ Q``.

    Minimises mean_t [((a.a - b.b)/2)^2 + (a.b)^2] + smoothness mean_t |second difference of the rows|^2
    + evenness mean_t ((a.a + b.b)/2 - 1)^2 over Q of mean squared row length 1. Where the viewpoint turns little many Q
    have small defects; the one whose camera moves smoothly is the right one. An orthographic camera has one scale in
    all frames: with an evenness of 1 the sum is (a.b)^2 and half of (a.a - 1)^2 + (b.b - 1)^2, as Tomasi and Kanade
    have it.

    Args:
        motion: (..., T, 2, R).
        start: Q (..., R, 3) to start from; further batch dimensions try several starts at once.
        smoothness: weight of the second differences.
        evenness: weight of the variance of the frames' scales: 0 for weak perspective, 1 for orthographic cameras.
        num_steps: steps, at most; each is kept only where it lowers the cost.
        tolerance: stop where steps lower the cost by less than this share.
        together: so many neighbours in the batch, with all their starts, go on until the last of them stops, and what
            is beside them makes no difference: 1, and every motion stops for itself; None, and all are together.
        counts: (...) frames of each motion, where shorter ones are padded with zeros at their end; without evenness.

    Returns:
        Q (..., R, 3), scaled so that rows have mean squared length 1, and the defect (...).

    Raises:
        ShapeError: R is below 3, there are no frames, or the shapes do not fit.
        OptionError: the batch is not made of so many neighbours.
    """
    check_motion(motion, "metric_upgrade")
    if start.shape[-2:] != (motion.shape[-1], 3):
        raise ShapeError(f"metric_upgrade: expected start (..., {motion.shape[-1]}, 3), got {tuple(start.shape)}")
    total = motion.shape[:-3].numel()
    whole = type(together) is int and together >= 1
    if together is not None and (not whole or total % together):
        raise OptionError(f"metric_upgrade: together: expected a divisor of the {total} motions, got {together!r}")
    count = motion.new_full((), motion.shape[-3]) if counts is None else counts.to(motion)
    batch, rank = motion.shape[:-3], motion.shape[-1]
    shape = broadcast_shapes(start.shape[:-2], batch)
    starts = math.prod(shape[: len(shape) - len(batch)])
    rows = start.expand(*shape, rank, 3).reshape(starts, -1, rank, 3).movedim(0, 1).mT.contiguous()
    state = _begin(rows, batch, _costs(motion, count, smoothness, evenness))
    found, left = state.rows, torch.arange(len(rows), device=motion.device)
    for made in range(0, num_steps, CHECK):
        state = iterate(_descend, state, num_steps=min(CHECK, num_steps - made)).value
        found = found.index_copy(0, left, state.rows)
        goes_on = (state.progress > tolerance).any(-1)
        if together is not None:
            goes_on = goes_on.view(-1, together).any(-1).repeat_interleave(together)
        if not bool(goes_on.any()):
            break
        if together is not None and not bool(goes_on.all()):  # what has settled takes no more steps
            state, left = _Upgrade(*(x[goes_on] for x in state)), left[goes_on]
    q = found.mT.movedim(1, 0).reshape(*shape, rank, 3)
    return q, orthonormality_defect(motion @ q[..., None, :, :]).sum(-1) / count


CHECK = 5
"""Steps from one look at whether motions have settled to the next."""


class _Upgrade(NamedTuple):
    """Where Levenberg-Marquardt is: S starts of each motion lie beside each other, so that one product serves all."""

    rows: Tensor  # (B, S, 3, R), Q^T
    residual: Tensor  # (B, S, M)
    cost: Tensor  # (B, S)
    damping: Tensor  # (B, S)
    progress: Tensor  # (B, S)
    gram: Tensor  # (B, R, R): mean squared row length is tr(Q^T gram Q)
    forms: Tensor  # (B, R, R, M): residuals are half of <form, Q Q^T>
    bending: Tensor  # (B, R, R) of the second differences
    stiff: Tensor  # (B, 1, 3R, 3R), the same for all three rows


def _costs(motion: Tensor, count: Tensor, smoothness: float, evenness: float) -> tuple[Tensor, ...]:
    """The last fields of :class:`_Upgrade`, of motion (..., T, 2, R) with so many frames (...)."""
    a, b = motion[..., 0, :], motion[..., 1, :]
    frames = count[..., None, None]
    gram = (a.mT @ a + b.mT @ b) / (2 * frames)
    forms = (2 * _quadratic_forms(a, b, evenness) / frames[..., None].sqrt()).movedim(-3, -1).contiguous()
    if smoothness > 0 and motion.shape[-3] > 2:
        bend = motion.diff(n=2, dim=-3)
        inside = torch.arange(2, motion.shape[-3], device=motion.device) < count[..., None]
        bend = (bend * inside[..., None, None]).flatten(-3, -2)
    else:
        bend = motion[..., :0, 0, :]
    bending = smoothness / frames * (bend.mT @ bend)
    three, size = torch.eye(3, dtype=motion.dtype, device=motion.device), 3 * motion.shape[-1]
    stiff = torch.einsum("kl,...ij->...kilj", three, bending).reshape(*bending.shape[:-2], 1, size, size)
    return gram, forms, bending, stiff


def _begin(rows: Tensor, batch: torch.Size, costs: tuple[Tensor, ...]) -> _Upgrade:
    """The state at rows (B, S, 3, R), with the costs of motions (...)."""
    gram, forms, bending, stiff = (
        x.expand(*batch, *x.shape[-d:]).reshape(-1, *x.shape[-d:]) for x, d in zip(costs, (2, 3, 2, 3), strict=True)
    )
    rows = _normalise(rows, gram)
    residual, cost = _evaluate(rows, forms, bending)
    return _Upgrade(
        rows, residual, cost, torch.full_like(cost, 1e-2), torch.ones_like(cost), gram, forms, bending, stiff
    )


def _descend(state: _Upgrade, _: int) -> _Upgrade:
    """One step, kept only where it lowers the cost."""
    rows, residual, cost, damping, progress, gram, forms, bending, stiff = state
    rank, tiny = rows.shape[-1], torch.finfo(rows.dtype).tiny
    jacobian = _times(rows, forms.flatten(-2)).unflatten(-1, (rank, -1)).flatten(-3, -2)  # (B, S, 3R, M)
    normal = jacobian @ jacobian.mT
    normal += stiff
    gradient = (jacobian @ residual[..., None]).squeeze(-1) + _times(rows, bending).flatten(-2)
    size = normal.diagonal(dim1=-2, dim2=-1).mean(-1)
    # The residuals are homogeneous, so the plain step would only shrink Q: hold its scale.
    radial = _times(rows, gram).flatten(-2)
    radial = radial / torch.linalg.vector_norm(radial, dim=-1, keepdim=True).clamp_min(tiny)
    gradient = gradient - (gradient * radial).sum(-1, keepdim=True) * radial
    normal += (1e3 * rank * size[..., None] * radial)[..., :, None] * radial[..., None, :]
    normal.diagonal(dim1=-2, dim2=-1).add_((damping * size + tiny)[..., None])
    factor, _info = torch.linalg.cholesky_ex(normal)
    move = torch.cholesky_solve(gradient[..., None], factor).squeeze(-1)
    trial = _normalise(rows - move.unflatten(-1, (3, rank)), gram)
    moved, new = _evaluate(trial, forms, bending)
    better = new < cost  # False for NaN, too: a failed factorisation only raises the damping
    return state._replace(
        rows=torch.where(better[..., None, None], trial, rows),
        residual=torch.where(better[..., None], moved, residual),
        cost=torch.where(better, new, cost),
        damping=torch.where(better, damping / 4, damping * 3).clamp(1e-9, 1e6),
        progress=progress / 2 + torch.where(better, 1 - new / cost, 0),  # halved, not zeroed, by a refused step
    )


def _times(rows: Tensor, matrix: Tensor) -> Tensor:
    """Rows (B, S, 3, R) times a matrix (B, R, K)."""
    return (rows.flatten(-3, -2) @ matrix).unflatten(-2, rows.shape[-3:-1])


def _normalise(rows: Tensor, gram: Tensor) -> Tensor:
    """Rows of mean squared length 1."""
    size = (rows * _times(rows, gram)).sum((-2, -1))
    return rows / or_one(size).sqrt()[..., None, None]


def _evaluate(rows: Tensor, forms: Tensor, bending: Tensor) -> tuple[Tensor, Tensor]:
    """Residuals (B, S, M) of the defect, and the cost (B, S)."""
    residual = (rows.mT @ rows).flatten(-2) @ forms.flatten(-3, -2) / 2
    return residual, residual.square().sum(-1) + (rows * _times(rows, bending)).sum((-2, -1))


def _quadratic_forms(a: Tensor, b: Tensor, evenness: float = 0.0) -> Tensor:
    """Symmetric forms P (..., M, R, R) with sum_m <P_m, F>^2 = sum_t ((a.Fa - b.Fb)/2)^2 + (a.Fb)^2 for symmetric F.

    With an evenness there is that times the variance of (a.Fa + b.Fb)/2, too. A clip has two or three a frame, but no
    more than R (R + 1) / 2 of them are independent: the triangle of their QR decomposition stands for all, so that the
    work of an iteration does not grow with the number of frames.

    Args:
        a: (..., T, R) first motion rows.
        b: (..., T, R) second motion rows.
        evenness: weight of the variance.
    """
    rank = a.shape[-1]
    row, column = torch.triu_indices(rank, rank, device=a.device)
    along = (a[..., row] * a[..., column] - b[..., row] * b[..., column]) / 2
    across = (a[..., row] * b[..., column] + b[..., row] * a[..., column]) / 2
    forms = torch.cat([along, across], -2)  # (..., 2T, R (R + 1) / 2)
    if evenness > 0:
        size = (a[..., row] * a[..., column] + b[..., row] * b[..., column]) / 2
        forms = torch.cat([forms, evenness**0.5 * (size - size.mean(-2, keepdim=True))], -2)
    if forms.shape[-2] > forms.shape[-1] and not forms.requires_grad:  # QR without its Q has no derivative
        forms = _triangle(forms)
    place = torch.zeros(rank, rank, dtype=torch.long, device=a.device)
    place[row, column] = place[column, row] = torch.arange(len(row), device=a.device)
    return forms[..., place]


def _triangle(matrix: Tensor) -> Tensor:
    """A triangle R (..., N, N) with R^T R = A^T A for A (..., M, N), M above N.

    GPUs take QR decompositions one after another, Cholesky factors together: theirs is that of A^T A in double
    precision, with as much on its diagonal as rounding may take away.
    """
    if not matrix.is_cuda:
        return torch.linalg.qr(matrix, mode="r").R
    wide = matrix.double()
    gram = wide.mT @ wide
    diagonal = gram.diagonal(dim1=-2, dim2=-1)
    slack = 1e-13 * diagonal.sum(-1, keepdim=True) + torch.finfo(gram.dtype).tiny
    gram = gram + torch.diag_embed(slack.expand_as(diagonal))
    return torch.linalg.cholesky(gram, upper=True).to(matrix.dtype)


def check_motion(motion: Tensor, name: str) -> None:
    """Raise a ShapeError unless ``motion`` is (..., T, 2, R) with T >= 1 and R >= 3."""
    if motion.ndim < 3 or motion.shape[-2] != 2 or motion.shape[-1] < 3 or not motion.shape[-3]:
        raise ShapeError(f"{name}: expected motion (..., T, 2, R) with T >= 1 and R >= 3, got {tuple(motion.shape)}")
