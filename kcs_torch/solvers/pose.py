"""Cameras from a known pose: weak-perspective resection of every frame at once."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from kcs_torch.functional.align import centre
from kcs_torch.functional.rotation import rotation_matrix
from kcs_torch.functional.temporal import best_path

__all__ = ["CameraFit", "fit_cameras", "steady_cameras"]


@dataclass(frozen=True)
class CameraFit:
    """Weak-perspective cameras of every frame, for each of C starts.

    Attributes:
        rotations: (C, T, 3, 3), world to camera.
        scales: (C, T).
        cost: (C, T), mean robust loss over joints, in 0..1.
    """

    rotations: Tensor
    scales: Tensor
    cost: Tensor


def fit_cameras(
    tracks: Tensor,
    points: Tensor,
    weights: Tensor,
    low: Tensor,
    high: Tensor,
    *,
    num_yaws: int = 8,
    robust: float | None = 0.4,
    num_steps: int = 8,
    start: Tensor | None = None,
) -> CameraFit:
    """Fit min_P sum_n w_n rho(|y_n - P x_n - t|) with P = s R_2x3 per frame, from several headings at once.

    The two rows of P are orthogonal and equally long (KCS eq. 22-25). Levenberg-Marquardt over the rotation with the
    scale at its optimum within its bounds; iteratively reweighted, so that limbs that are away from the template do not
    tilt the body.

    Args:
        tracks: y (T, N, 2).
        points: x (T, N, 3).
        weights: w (T, N).
        low: (T,) least scale.
        high: (T,) greatest scale; inf where it is free.
        num_yaws: headings tried, evenly about the vertical axis.
        robust: residuals of this share of the body's size count half; None is least squares.
        num_steps: Levenberg-Marquardt steps of each reweighting.
        start: (T, 3, 3) a further start.

    Returns:
        The fit of each start. Frames without a seen joint have cost 0.
    """
    starts = _headings(num_yaws, tracks)[:, None].expand(-1, len(tracks), 3, 3)
    if start is not None:
        starts = torch.cat([start[None], starts])
    runs = zip(starts.split(RUN, 1), *(x.split(RUN) for x in (tracks, points, weights, low, high)), strict=True)
    fits = [_fit(*run, robust=robust, num_steps=num_steps) for run in runs]
    return CameraFit(*(torch.cat(parts, 1) for parts in zip(*fits, strict=True)))


def steady_cameras(fit: CameraFit, continuity: float = 1.0) -> tuple[Tensor, Tensor]:
    """Choose one start's camera in each frame: of low cost, and without jumps in time.

    Args:
        fit: from :func:`fit_cameras`.
        continuity: weight of the turn between frames (radians squared); 0 takes each frame's best.

    Returns:
        rotations (T, 3, 3) and scales (T,).
    """
    cost = fit.cost.mT  # (T, C)
    if continuity > 0:
        trace = torch.einsum("atij,btij->tab", fit.rotations[:, :-1], fit.rotations[:, 1:])
        turn = torch.arccos(((trace - 1) / 2).clamp(-1, 1)).square()
        choice = best_path(cost, continuity * turn)
    else:
        choice = cost.argmin(-1)
    frame = torch.arange(len(cost), device=choice.device)
    return fit.rotations[choice, frame], fit.scales[choice, frame]


RUN = 2000
"""Frames that are fitted together: each is a problem of its own, and more would only take memory."""


def _fit(
    rotations: Tensor,
    tracks: Tensor,
    points: Tensor,
    weights: Tensor,
    low: Tensor,
    high: Tensor,
    *,
    robust: float | None,
    num_steps: int,
) -> tuple[Tensor, Tensor, Tensor]:
    """Rotations (C, T, 3, 3), scales (C, T) and cost (C, T) from starts (C, T, 3, 3)."""
    share = weights.expand(len(rotations), *weights.shape)
    size = (points - points.mean(-2, keepdim=True)).square().sum(-1).mean(-1).sqrt()
    seen = (centre(tracks, weights)[0].square().sum(-1) * weights).sum(-1) / weights.sum(-1).clamp_min(1e-12)
    # In the image the body is as large as the scale tells or, where the scale is free, as the tracks are: a sphere's
    # shadow has 2/3 of its mean square.
    extent = torch.where(high.isinf(), (1.5 * seen).sqrt(), 0.5 * (low + high) * size)
    reach = torch.where(extent > 0, extent, torch.ones_like(extent)) * (robust or 1.0)
    for _ in range(1 if robust is None else 4):
        rotations, scales, residual = _refine(rotations, tracks, points, share, low, high, num_steps)
        square = (residual / reach[:, None]).square()
        if robust is not None:
            share = weights / (1 + square).square()
    loss = square if robust is None else square / (1 + square)
    total = weights.sum(-1)
    return rotations, scales, (loss * weights).sum(-1) / torch.where(total > 0, total, torch.ones_like(total))


def _refine(
    rotations: Tensor, tracks: Tensor, points: Tensor, weights: Tensor, low: Tensor, high: Tensor, num_steps: int
) -> tuple[Tensor, Tensor, Tensor]:
    """Weighted least-squares rotations (C, T, 3, 3), scales (C, T) and residual lengths (C, T, N)."""
    total = weights.sum(-1, keepdim=True)
    unit = (weights / torch.where(total > 0, total, torch.ones_like(total)))[..., None]
    y, x = tracks - (tracks * unit).sum(-2, keepdim=True), points - (points * unit).sum(-2, keepdim=True)
    moment = y.mT @ (x * unit)  # (C, T, 2, 3)
    gram = x.mT @ (x * unit)  # (C, T, 3, 3)
    power = (y.square() * unit).sum((-2, -1))
    eye = torch.eye(3, dtype=tracks.dtype, device=tracks.device)
    tiny = torch.finfo(tracks.dtype).tiny

    def evaluate(r: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Cost and best scale (C, T); the body's spread G = R gram R^T and M = R moment^T, in the camera's axes."""
        g, m = r @ gram @ r.mT, r @ moment.mT  # (C, T, 3, 3) and (C, T, 3, 2)
        match, size = m[..., 0, 0] + m[..., 1, 1], g[..., 0, 0] + g[..., 1, 1]
        s = torch.minimum(torch.maximum(match / size.clamp_min(tiny), low), high)
        return power - 2 * s * match + s * s * size, s, g, m

    cost, scales, g, m = evaluate(rotations)
    damping = torch.full_like(cost, 1e-3)
    for _ in range(num_steps):
        # A turn w takes the rows r0, r1 to r0 + w_y r2 - w_z r1 and r1 + w_z r0 - w_x r2: the normal matrix and the
        # gradient are sums of entries of G and of the misfit R (moment - scale rows gram)^T = M - scale G.
        square = scales.square()
        flat = square * (g[..., 0, 0] + g[..., 1, 1])
        deep, zero = square * g[..., 2, 2], torch.zeros_like(square)
        zx, zy = -square * g[..., 0, 2], -square * g[..., 1, 2]
        normal = torch.stack([deep, zero, zx, zero, deep, zy, zx, zy, flat], -1).unflatten(-1, (3, 3))
        misfit = m - scales[..., None, None] * g[..., :2]
        target = torch.stack([-misfit[..., 2, 1], misfit[..., 2, 0], misfit[..., 0, 1] - misfit[..., 1, 0]], -1)
        # Where the scale is free it follows the turn: take its share out of the normal matrix (variable projection).
        # A frontal body that nods shrinks as one that recedes does: without this the two would creep along together.
        free = ((scales > low) & (scales < high)) / flat.clamp_min(tiny).sqrt()
        cross = torch.stack([zy, -zx, zero], -1) * free[..., None]
        normal = normal - cross[..., :, None] * cross[..., None, :]
        ridge = (damping + 1e-9) * normal.diagonal(dim1=-2, dim2=-1).amax(-1) + tiny
        move = torch.linalg.solve(normal + ridge[..., None, None] * eye, scales[..., None] * target)
        trial = rotation_matrix(move) @ rotations
        new, *others = evaluate(trial)
        better = new < cost
        pick = better[..., None, None]
        rotations, g, m = (
            torch.where(pick, n, o) for n, o in zip((trial, *others[1:]), (rotations, g, m), strict=True)
        )
        scales, cost = torch.where(better, others[0], scales), torch.where(better, new, cost)
        damping = torch.where(better, damping * 0.3, damping * 5)
    residual = torch.linalg.vector_norm(y - scales[..., None, None] * (x @ rotations[..., :2, :].mT), dim=-1)
    return rotations, scales, residual


def _headings(count: int, like: Tensor) -> Tensor:
    """(count, 3, 3) rotations about the vertical (y) axis."""
    angle = torch.arange(count, dtype=like.dtype, device=like.device) * (2 * math.pi / count)
    axis = torch.tensor([0.0, 1.0, 0.0], dtype=like.dtype, device=like.device)
    return rotation_matrix(angle[:, None] * axis)
