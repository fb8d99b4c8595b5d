"""Cameras from a known pose: weak-perspective resection of every frame at once."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from kcs_torch.functional.align import centre
from kcs_torch.functional.guarded import or_one
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


def steady_cameras(fit: CameraFit, continuity: float = 1.0, *, inside: Tensor | None = None) -> tuple[Tensor, Tensor]:
    """Choose one start's camera in each frame: of low cost, and without jumps in time.

    Args:
        fit: from :func:`fit_cameras`, or of a batch (C, ..., T).
        continuity: weight of the turn between frames (radians squared); 0 takes each frame's best.
        inside: (..., T), False in frames that pad a shorter clip, whose cost is 0.

    Returns:
        rotations (..., T, 3, 3) and scales (..., T).
    """
    cost = fit.cost.movedim(0, -1)  # (..., T, C)
    if continuity > 0:
        flat = fit.rotations.movedim(0, -3).flatten(-2)  # (..., T, C, 9)
        turn = flat[..., :-1, :, :] @ flat[..., 1:, :, :].mT  # the trace; in place, as of long clips it is large
        del flat
        turn.sub_(1).div_(2).clamp_(-1, 1).arccos_().square_().mul_(continuity)
        if inside is not None:
            turn *= (inside[..., 1:] & inside[..., :-1])[..., None, None]
        choice = best_path(cost, turn)[None]
    else:
        choice = cost.argmin(-1)[None]
    rotations = fit.rotations.gather(0, choice[..., None, None].expand(*choice.shape, 3, 3))
    return rotations[0], fit.scales.gather(0, choice)[0]


RUN = 1000
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
    size = (points - points.mean(-2, keepdim=True)).square().sum(-1).mean(-1).sqrt()
    seen = (centre(tracks, weights)[0].square().sum(-1) * weights).sum(-1) / weights.sum(-1).clamp_min(1e-12)
    # In the image the body is as large as the scale tells or, where the scale is free, as the tracks are: a sphere's
    # shadow has 2/3 of its mean square.
    extent = torch.where(high.isinf(), (1.5 * seen).sqrt(), 0.5 * (low + high) * size)
    reach = or_one(extent) * (robust or 1.0)
    share = weights.expand(len(rotations), *weights.shape)
    for _ in range(1 if robust is None else 4):
        rotations, scales, square = _refine(rotations, tracks, points, share, low, high, num_steps)
        square = square / reach[:, None].square()
        if robust is not None:
            share = weights / (1 + square).square()
    loss = square if robust is None else square / (1 + square)
    total = weights.sum(-1)
    return rotations, scales, (loss * weights).sum(-1) / or_one(total)


def _refine(
    rotations: Tensor, tracks: Tensor, points: Tensor, weights: Tensor, low: Tensor, high: Tensor, num_steps: int
) -> tuple[Tensor, Tensor, Tensor]:
    """Weighted least-squares rotations (C, T, 3, 3), scales (C, T) and squared residuals (C, T, N).

    Entries of vectors and matrices come first, so that every operation runs over all frames and starts.
    """
    total = weights.sum(-1, keepdim=True)
    unit = weights / or_one(total)
    y, x = centre(tracks)[0], centre(points)[0]
    both = torch.cat([x, y], -1)
    # All moments of all starts by one product: (T, C, N) @ (T, N, 5 + 25).
    terms = torch.cat([both, (both[..., :, None] * both[..., None, :]).flatten(-2)], -1)
    means = (unit.movedim(1, 0) @ terms).movedim((-1, 0), (0, 2)).contiguous()
    first, second = means[:5], means[5:].unflatten(0, (5, 5))
    second = second - first[:, None] * first
    gram, moment = second[:3, :3], second[3:, :3]  # (3, 3, C, T) and (2, 3, C, T)
    power, spread = second[3, 3] + second[4, 4], gram[0, 0] + gram[1, 1] + gram[2, 2]
    tiny = torch.finfo(tracks.dtype).tiny

    def evaluate(r: Tensor) -> tuple[Tensor, ...]:
        """Cost and best scale (C, T); R moment^T (3, 2, C, T) and the last column of R gram R^T (3, C, T)."""
        m, g = (r[:, None] * moment).sum(2), (r * (gram * r[2]).sum(1)).sum(1)
        match, size = m[0, 0] + m[1, 1], spread - g[2]
        s = torch.minimum(torch.maximum(match / size.clamp_min(tiny), low), high)
        return power + s * (s * size - 2 * match), s, m, g

    r = rotations.movedim((-2, -1), (0, 1)).contiguous()
    cost, scales, m, g = evaluate(r)
    damping = torch.full_like(cost, 1e-3)
    for _ in range(num_steps):
        # A turn w takes the rows r0, r1 to r0 + w_y r2 - w_z r1 and r1 + w_z r0 - w_x r2: the normal matrix
        # (a b x; b c y; x y d) and the gradient are sums of entries of G = R gram R^T and of M = R moment^T.
        square = scales.square()
        d, deep, pulls = square * (spread - g[2]), square * g[2], scales * g
        cross_x, cross_y = -square * g[0], -square * g[1]
        target = torch.stack([pulls[1] - m[2, 1], m[2, 0] - pulls[0], m[0, 1] - m[1, 0]])
        # Where the scale is free it follows the turn: take its share out of the normal matrix (variable projection).
        # A frontal body that nods shrinks as one that recedes does: without this the two would creep along together.
        free = ((scales > low) & (scales < high)) / d.clamp_min(tiny)
        a, c = deep - free * cross_y.square(), deep - free * cross_x.square()
        b = free * cross_x * cross_y
        ridge = (damping + 1e-9) * torch.maximum(torch.maximum(a, c), d) + tiny
        trial = _turn(_solve(a + ridge, b, c + ridge, cross_x, cross_y, d + ridge, scales * target), r)
        new, *others = evaluate(trial)
        better = new < cost  # False for NaN, too
        r, m, g = (torch.where(better, n, o) for n, o in zip((trial, *others[1:]), (r, m, g), strict=True))
        scales, cost = torch.where(better, others[0], scales), torch.where(better, new, cost)
        damping = torch.where(better, damping * 0.3, damping * 5)
    rotations = r.movedim((0, 1), (-2, -1)).contiguous()
    turned = scales * (r[:2] * first[:3]).sum(1) - first[3:]  # (2, C, T), the translation
    rows = y.mT - scales[..., None, None] * (rotations[..., :2, :] @ x.mT) + turned.movedim(0, -1)[..., None]
    return rotations, scales, rows.square().sum(-2)


def _solve(a: Tensor, b: Tensor, c: Tensor, x: Tensor, y: Tensor, d: Tensor, target: Tensor) -> Tensor:
    """Solutions (3, ...) of symmetric positive definite systems (a b x; b c y; x y d) with targets (3, ...)."""
    u, v = x / d, y / d
    a, b, c = a - u * x, b - u * y, c - v * y
    p, q = target[0] - u * target[2], target[1] - v * target[2]
    det = a * c - b * b
    first, second = (c * p - b * q) / det, (a * q - b * p) / det
    return torch.stack([first, second, target[2] / d - u * first - v * second])


def _turn(vectors: Tensor, rotations: Tensor) -> Tensor:
    """exp([w]) R for rotation vectors w (3, ...) and rotations (3, 3, ...), by the unit quaternion of w."""
    half = (vectors.square().sum(0).sqrt() / 2).clamp_min(torch.finfo(vectors.dtype).tiny)
    w = half.cos()
    x, y, z = axis = vectors * (half.sin() / (2 * half))
    xx, yy, zz = axis * axis
    xy, yz, zx = x * y, y * z, z * x
    wx, wy, wz = w * axis
    spin = [0.5 - yy - zz, xy - wz, zx + wy, xy + wz, 0.5 - zz - xx, yz - wx, zx - wy, yz + wx, 0.5 - xx - yy]
    matrix = torch.stack(spin).unflatten(0, (3, 3)) * 2
    return (matrix[:, :, None] * rotations).sum(1)


def _headings(count: int, like: Tensor) -> Tensor:
    """(count, 3, 3) rotations about the vertical (y) axis."""
    angle = torch.arange(count, dtype=like.dtype, device=like.device) * (2 * math.pi / count)
    axis = torch.tensor([0.0, 1.0, 0.0], dtype=like.dtype, device=like.device)
    return rotation_matrix(angle[:, None] * axis)
