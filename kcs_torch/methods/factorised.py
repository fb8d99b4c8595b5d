"""What the classical methods share: cameras from a factorisation, then a shape from the tracks and the cameras."""

from __future__ import annotations

import math
from abc import abstractmethod
from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from kcs_torch.functional.camera import complete_rotation, factorize, rows_to_cameras
from kcs_torch.methods.base import Estimate, Method
from kcs_torch.methods.mirror import mirror_sign
from kcs_torch.methods.unseen import place_unseen
from kcs_torch.solvers.completion import complete_tracks
from kcs_torch.solvers.ist import metric_upgrade
from kcs_torch.solvers.iterate import Solution
from kcs_torch.solvers.nullspace import null_space_upgrade
from kcs_torch.types import Tracks

__all__ = ["Factorised", "camera_rows", "fit_basis_shapes", "trajectory_design"]

EMPTY = 1e-6
"""Singular values of the tracks below this share of the largest are rounding."""

FILLED = 0.1
"""Weight of what completion put in place of an unseen joint, so that no system is singular."""


@dataclass(frozen=True)
class Factorised(Method):
    """Cameras by :meth:`find_cameras`, then shapes by :meth:`find_shape`; bones are not looked at.

    Unseen joints are completed first (low rank); they count little in the shape.
    """

    keeps_lengths: ClassVar[bool] = False
    knows_bones: ClassVar[bool] = False

    @abstractmethod
    def find_cameras(self, tracks: Tensor) -> Tensor:
        """Camera rows (T, 2, 3) of complete, centred tracks (T, N, 2)."""

    @abstractmethod
    def find_shape(self, tracks: Tensor, weights: Tensor, cameras: Tensor) -> Solution[Tensor]:
        """Points (T, N, 3) in the world frame, of complete, centred tracks (T, N, 2) and weights (T, N) above 0."""

    def solve(self, tracks: Tracks, cameras: Tensor | None) -> Estimate:
        """Complete the tracks, find cameras unless they are known, and the shape."""
        known = tracks.seen.any(0)
        # Normal matrices square a design whose columns differ by orders of magnitude.
        precise = tracks.points if tracks.points.device.type == "mps" else tracks.points.double()
        seen = tracks.seen[:, known]
        filled = complete_tracks(precise[:, known], seen)
        filled = filled - filled.mean(1, keepdim=True)
        weights = torch.where(seen, tracks.weights[:, known].to(filled), FILLED)
        weights = torch.where(seen.any(1, keepdim=True), weights, torch.ones_like(weights))
        rows = self.find_cameras(filled) if cameras is None else cameras.to(filled)
        solution = self.find_shape(filled, weights, rows)
        local = solution.value @ complete_rotation(rows).mT
        points = local.new_zeros(*tracks.points.shape[:2], 3)
        points[:, known] = local
        if cameras is None:  # known cameras know their mirror
            sign = torch.nn.functional.pad(mirror_sign(points, tracks.skeleton)[None], (2, 0), value=1.0)
            points, rows = points * sign, rows * sign
        points = place_unseen(points, known, tracks.skeleton).to(tracks.points)
        return Estimate(
            points,
            rows.to(tracks.points) if cameras is None else cameras,
            torch.ones_like(points[:, 0, 0]),
            solution.converged,
            solution.iterations,
        )


def camera_rows(tracks: Tensor, rank: int, *, evenness: float = 1.0, num_steps: int = 150) -> Tensor:
    """Find cameras: rank-3K factorisation, least trace in the null space, then least squares on orthonormality.

    Args:
        tracks: (T, N, 2), complete and centred.
        rank: K, at most; clips with fewer than 3K frames or 3K + 1 joints get less.
        evenness: 1 for orthographic cameras, 0 for weak perspective.
        num_steps: of the least squares, at most.

    Returns:
        (T, 2, 3) orthonormal rows; the identity for clips too short or with too few joints to tell (2T < 3 or N < 4).
    """
    frames, joints = tracks.shape[:2]
    if min(2 * frames, joints - 1) < 3:
        return torch.eye(3, dtype=tracks.dtype, device=tracks.device)[:2].expand(frames, 2, 3)
    rank = max(1, min(rank, frames // 3, (joints - 1) // 3))
    motion, _ = factorize(tracks, 3 * rank)
    size = torch.linalg.vector_norm(motion, dim=(0, 1))
    told = int((size > EMPTY * size[0]).sum())  # columns of rounding would take part like any other
    motion = motion[..., : max(3, 3 * math.ceil(told / 3))]
    q, _ = metric_upgrade(motion, null_space_upgrade(motion), evenness=evenness, num_steps=num_steps, tolerance=1e-6)
    return rows_to_cameras(motion @ q)[0]


def trajectory_design(cameras: Tensor, coefficients: Tensor) -> Tensor:
    """Return the matrix (2T, 3K) with ``tracks = design @ shapes``, its rows x1, y1, x2, ..., columns by shape.

    Args:
        cameras: R (T, 2, 3).
        coefficients: c (T, K): a frame's points are sum_k c_tk S_k.
    """
    return torch.einsum("tij,tk->tikj", cameras, coefficients).flatten(2).flatten(0, 1)


def fit_basis_shapes(
    tracks: Tensor, weights: Tensor, cameras: Tensor, coefficients: Tensor, *, cutoff: float
) -> Tensor:
    """Return S of min_S sum_tn w_tn |W_tn - R_t sum_k c_tk S_kn|^2, by a pseudo-inverse, each joint on its own.

    Singular values of a joint's design below ``cutoff`` times the largest are dropped: what the cameras do not show
    stays as small as it can be, and does not amplify what the basis leaves out.

    Args:
        tracks: W (T, N, 2).
        weights: w (T, N).
        cameras: R (T, 2, 3).
        coefficients: c (T, K).
        cutoff: share of the largest singular value.

    Returns:
        (K, N, 3).
    """
    design = trajectory_design(cameras, coefficients)
    stacked = tracks.mT.flatten(0, 1)  # (2T, N)
    if bool((weights == weights[:1]).all()):  # a joint's weight does not matter where it is the same in all frames
        normal, goal = (design.mT @ design)[None], (design.mT @ stacked).mT
    else:
        share = weights.repeat_interleave(2, 0)
        normal = torch.stack([(design * w[:, None]).mT @ design for w in share.unbind(1)])
        goal = (design.mT @ (share * stacked)).mT
    value, vector = torch.linalg.eigh(normal)
    kept = (value > cutoff**2 * value[..., -1:]) & (value > 0)
    inverse = torch.where(kept, 1 / torch.where(kept, value, torch.ones_like(value)), torch.zeros_like(value))
    shapes = vector @ (inverse[..., None] * (vector.mT @ goal[..., None]))  # (N, 3K, 1)
    return shapes[..., 0].unflatten(-1, (-1, 3)).transpose(0, 1)
