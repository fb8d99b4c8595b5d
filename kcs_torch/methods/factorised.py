"""What the classical methods share: cameras from a factorisation, then a shape from the tracks and the cameras."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from kcs_torch.functional.camera import complete_rotation, factorize, rows_to_cameras
from kcs_torch.functional.weights import of_largest
from kcs_torch.methods.answer.mirror import mirror_sign
from kcs_torch.methods.base import Estimate, Method
from kcs_torch.methods.clips.batches import in_batches
from kcs_torch.methods.clips.cameras import most_shapes, still_cameras
from kcs_torch.methods.clips.unseen import place_unseen
from kcs_torch.solvers.completion import complete_tracks
from kcs_torch.solvers.ist import metric_upgrade
from kcs_torch.solvers.iterate import Solution
from kcs_torch.solvers.nullspace import null_space_upgrade
from kcs_torch.types import Tracks

__all__ = ["Factorised", "camera_rows", "fit_basis_shapes", "trajectory_design", "upgraded_rows"]

EMPTY = 1e-6
"""Singular values of the tracks below this share of the largest are rounding."""

FILLED = 0.1
"""Weight of what completion put in place of an unseen joint, a share of the largest: so no system is singular."""

SETTLED = 1e-3
"""Share of the shape that the last step may change it by."""


@dataclass(frozen=True)
class Factorised(Method):
    """Cameras by :meth:`find_cameras`, then shapes by :meth:`find_shape`; bones are not looked at.

    Unseen joints are completed first (low rank); they count little in the shape. Clips of one length, in which the same
    joints are seen, go together.
    """

    keeps_lengths: ClassVar[bool] = False
    differentiates: ClassVar[bool] = False
    knows_bones: ClassVar[bool] = False
    together: ClassVar[bool] = False
    """Whether :meth:`find_shape` takes several clips (..., T, N, 2); else it is called for each."""

    @abstractmethod
    def find_cameras(self, tracks: Tensor) -> Tensor:
        """Camera rows (..., T, 2, 3) of complete, centred tracks (..., T, N, 2)."""

    @abstractmethod
    def find_shape(self, tracks: Tensor, weights: Tensor, cameras: Tensor) -> Solution[Tensor]:
        """Points (T, N, 3) in the world frame, of complete, centred tracks (T, N, 2) and weights (T, N) above 0.

        Of several clips (..., T, N, 2), ``change`` is how much the last step changed each one's shape, a share of it.
        """

    def solve(self, tracks: Tracks, cameras: Tensor | None) -> Estimate:
        """Complete the tracks, find cameras unless they are known, and the shape."""
        return self._solve([tracks], cameras)[0]

    def solve_all(self, tracks: Sequence[Tracks]) -> list[Estimate]:
        """Solve clips of one length together."""

        def kind(one: Tracks) -> tuple[int, ...]:
            return one.num_frames, *one.seen.any(0).nonzero().flatten().tolist()

        return in_batches(tracks, lambda clips: self._solve(clips, None), kind)

    def _solve(self, clips: Sequence[Tracks], cameras: Tensor | None) -> list[Estimate]:
        """Clips of one skeleton, one length and the same joints seen; known cameras (T, 2, 3) are a single clip's."""
        body, given = clips[0].skeleton, clips[0].points
        known = clips[0].seen.any(0)
        # Normal matrices square a design whose columns differ by orders of magnitude.
        precise = given.dtype if given.device.type == "mps" else torch.float64
        points, weights = (torch.stack([getattr(one, what) for one in clips]) for what in ("points", "weights"))
        seen = (weights > 0)[..., known]
        filled = complete_tracks(points[:, :, known].to(precise), seen)
        filled = filled - filled.mean(-2, keepdim=True)
        weights = torch.where(seen, of_largest(weights)[..., known].to(filled), FILLED)
        weights = torch.where(seen.any(-1, keepdim=True), weights, torch.ones_like(weights))
        rows = self.find_cameras(filled) if cameras is None else cameras.to(filled)[None]
        if self.together:
            every = self.find_shape(filled, weights, rows)
            local, steps = every.value, [every.iterations] * len(clips)
            settled = [True] * len(clips) if every.change is None else (every.change <= SETTLED).tolist()
        else:
            each = [self.find_shape(*one) for one in zip(filled, weights, rows, strict=True)]
            local = torch.stack([one.value for one in each])
            settled, steps = [one.converged for one in each], [one.iterations for one in each]
        points = local.new_zeros(*points.shape[:-1], 3)
        points[:, :, known] = local @ complete_rotation(rows).mT
        if cameras is None:  # known cameras know their mirror
            sign = torch.nn.functional.pad(mirror_sign(points, body)[:, None], (2, 0), value=1.0)[:, None, None]
            points, rows = points * sign, rows * sign
        points, shown = points.to(given), rows.to(given) if cameras is None else cameras[None]
        one = torch.ones_like(points[0, :, 0, 0])
        return [
            Estimate(place_unseen(x, known, body), r, one, *end)
            for x, r, *end in zip(points, shown, settled, steps, strict=True)
        ]


def camera_rows(tracks: Tensor, rank: int, *, evenness: float = 1.0, num_steps: int = 150) -> Tensor:
    """Find cameras: rank-3K factorisation, least trace in the null space, then least squares on orthonormality.

    Args:
        tracks: (..., T, N, 2), complete and centred.
        rank: K, at most; clips with fewer than 3K frames or 3K + 1 joints get less.
        evenness: 1 for orthographic cameras, 0 for weak perspective.
        num_steps: of the least squares, at most.

    Returns:
        (..., T, 2, 3) orthonormal rows; the identity for clips too short or with too few joints to tell (2T < 3 or
        N < 4).
    """

    def upgrade(motion: Tensor) -> Tensor:
        start = null_space_upgrade(motion)
        return metric_upgrade(motion, start, evenness=evenness, num_steps=num_steps, tolerance=1e-6, together=1)[0]

    return upgraded_rows(tracks, rank, upgrade, unit=3)


def upgraded_rows(tracks: Tensor, rank: int, upgrade: Callable[[Tensor], Tensor], unit: int = 1) -> Tensor:
    """Factorise tracks (..., T, N, 2), upgrade their motion (B, T, 2, R), and return camera rows (..., T, 2, 3).

    There are 3K columns, K the ``rank`` or what clips of so many frames and joints get of it. Those that are rounding
    would take part like any other: R is the number of those that are more, 3 or more of them and a multiple of
    ``unit``.
    """
    frames, joints = tracks.shape[-3:-1]
    batch = tracks.shape[:-3]
    if most_shapes(tracks) < 1:
        return still_cameras(tracks)
    rank = max(1, min(rank, frames // 3, (joints - 1) // 3))
    motion, _ = factorize(tracks.reshape(-1, frames, joints, 2), 3 * rank)
    size = torch.linalg.vector_norm(motion, dim=(1, 2))
    told = (size > EMPTY * size[:, :1]).sum(-1)
    columns = ((told + unit - 1) // unit * unit).clamp_min(3)
    rows = motion.new_empty(*motion.shape[:-1], 3)
    for count in columns.unique().tolist():
        part = motion[columns == count][..., :count]
        rows[columns == count] = rows_to_cameras(part @ upgrade(part)[:, None])[0]
    return rows.view(*batch, frames, 2, 3)


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
