"""Cameras that move simply: a path of constant angular velocity fitted to noisy rotations."""

from __future__ import annotations

import roma
import torch
from torch import Tensor

from kcs_torch.errors import ShapeError

__all__ = ["constant_path"]


def constant_path(rotations: Tensor, *, num_steps: int = 20) -> tuple[Tensor, Tensor]:
    """Fit R_t = exp(t w) R_0 to rotations: six numbers, robustly.

    Rotations that come from aligning poses also carry the body's own turning; a camera that moves evenly does
    not. Speeds around the median turn from frame to frame are tried, then iteratively reweighted Gauss-Newton
    (Cauchy weights) refines the best.

    Args:
        rotations: (T, 3, 3), T >= 2.
        num_steps: Gauss-Newton steps.

    Returns:
        The path (T, 3, 3), and its angle to each rotation (T,), in radians.

    Raises:
        ShapeError: ``rotations`` is not (T, 3, 3) with T >= 2.
    """
    frames = rotations.shape[0]
    if rotations.ndim != 3 or rotations.shape[-2:] != (3, 3) or frames < 2:
        raise ShapeError(
            f"constant_path: expected rotations (T, 3, 3) of 2 frames or more, got {tuple(rotations.shape)}"
        )
    time = torch.arange(frames, dtype=rotations.dtype, device=rotations.device) - (frames - 1) / 2
    turn = roma.rotmat_to_rotvec(rotations[1:] @ rotations[:-1].mT).median(0).values
    factors = torch.linspace(0.8, 1.2, 161, dtype=turn.dtype, device=turn.device)
    speeds = turn * factors[:, None]
    means = _mean_unturned(rotations, factors[:, None] * time, turn)
    starts = roma.special_procrustes(means)
    best = (starts * means).sum((-2, -1)).argmax()  # the mean agreement of path and rotations
    speed, start = speeds[best], starts[best]
    eye = torch.eye(6, dtype=turn.dtype, device=turn.device)
    for _ in range(num_steps):
        spin = roma.rotvec_to_rotmat(time[:, None] * speed)
        error = roma.rotmat_to_rotvec(rotations @ (spin @ start).mT)
        angle = error.norm(dim=-1)
        spread = angle.median().clamp_min(1e-9)
        weight = 1 / (1 + (angle / spread).square())
        jacobian = torch.cat([_left_jacobian(time[:, None] * speed) * time[:, None, None], spin], -1)
        normal = (jacobian.mT * weight[:, None, None] @ jacobian).sum(0)
        target = (jacobian.mT @ (error * weight[:, None])[..., None]).sum(0)[:, 0]
        move = torch.linalg.solve(normal + 1e-12 * normal.diagonal().mean() * eye, target)
        speed, start = speed + move[:3], roma.rotvec_to_rotmat(move[3:]) @ start
    path = roma.rotvec_to_rotmat(time[:, None] * speed) @ start
    return path, roma.rotmat_geodesic_distance(path, rotations)


def _mean_unturned(rotations: Tensor, times: Tensor, turn: Tensor) -> Tensor:
    """Means over t of exp(-times_st turn) R_t (S, 3, 3), for rotations R (T, 3, 3), times (S, T) and one turn (3,).

    By Rodrigues' formula exp(-a n) = cos(a) (I - n n^T) + n n^T - sin(a) [n]: sums of R under S x T cosines and sines.
    """
    size = turn.norm()
    x, y, z = axis = turn / torch.where(size > 0, size, torch.ones_like(size))
    zero = torch.zeros_like(x)
    hat = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero]).reshape(3, 3)
    along = axis[:, None] * axis
    flat = rotations.flatten(-2) / len(rotations)
    cosine, sine = ((wave(times * size) @ flat).unflatten(-1, (3, 3)) for wave in (torch.cos, torch.sin))
    return cosine + along @ (flat.sum(0).unflatten(-1, (3, 3)) - cosine) - hat @ sine


def _left_jacobian(vectors: Tensor) -> Tensor:
    """Left Jacobian of the exponential map at rotation vectors (T, 3), (T, 3, 3)."""
    angle = vectors.norm(dim=-1)[:, None, None]
    small = angle < 1e-6
    safe = torch.where(small, torch.ones_like(angle), angle)
    first = torch.where(small, 0.5 - angle.square() / 24, (1 - safe.cos()) / safe.square())
    second = torch.where(small, 1 / 6 - angle.square() / 120, (safe - safe.sin()) / safe**3)
    x, y, z = vectors.unbind(-1)
    zero = torch.zeros_like(x)
    hat = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], -1).reshape(-1, 3, 3)
    return torch.eye(3, dtype=vectors.dtype, device=vectors.device) + first * hat + second * (hat @ hat)
