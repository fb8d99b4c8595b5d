"""The Procrustean normal distribution: shapes that do not move, turn or grow, and the alignment that makes them so.

Vectors of a shape hold all x, then all y, then all z.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from kcs_torch.functional.align import nearest_rotation

__all__ = [
    "ProcrusteanNormal",
    "align_to_mean",
    "as_vectors",
    "procrustean_tangent",
    "second_moment",
    "unit_mean",
]

LEAST = 0.05
"""A frame's scale, at least, as a share of the median: a frame that shows a single point still has a place."""


@dataclass(frozen=True)
class ProcrusteanNormal:
    """A Procrustean normal distribution and the frames' places in it; vectors hold all x, then all y, then all z.

    Attributes:
        mean: M (N, 3), centred, of unit norm.
        covariance: S (3N, 3N).
        rotations: R (T, 3, 3), from the aligned frame to the camera's.
        scales: c (T,), positive.
        aligned: Y (T, N, 3), each frame's shape, or its posterior mean.
    """

    mean: Tensor
    covariance: Tensor
    rotations: Tensor
    scales: Tensor
    aligned: Tensor

    def shapes(self) -> Tensor:
        """The shapes in the camera's frame, c Y R^T, (T, N, 3)."""
        return self.scales[:, None, None] * (self.aligned @ self.rotations.mT)

    @classmethod
    def of_shapes(cls, points: Tensor, rotations: Tensor, *, spread: float = 0.0) -> ProcrusteanNormal:
        """Align shapes by generalised Procrustes analysis and take their moments.

        Args:
            points: X (T, N, 3), centred, in each frame's camera.
            rotations: (T, 3, 3), a first guess of R.
            spread: variance to add in every direction that deforms, a share of their mean.
        """
        aligned = points @ rotations
        mean = unit_mean(aligned.mean(0), aligned)
        for _ in range(20):
            turn, factor = align_to_mean(aligned, mean)
            aligned = (aligned @ turn) * factor[:, None, None]
            mean = unit_mean(aligned.mean(0), aligned)
        turn, factor = align_to_mean(aligned, mean)
        aligned = (aligned @ turn) * factor[:, None, None]
        rotations = nearest_rotation(points.mT @ aligned)
        size = (points * (aligned @ rotations.mT)).sum((1, 2)) / aligned.square().sum((1, 2))
        scales = torch.maximum(size, LEAST * size.median().clamp_min(LEAST * size.amax()))
        covariance = second_moment(aligned - mean, mean)
        covariance = covariance + spread * covariance.diagonal().mean() * procrustean_tangent(mean)
        return cls(mean, covariance, rotations, scales, aligned)


def second_moment(away: Tensor, mean: Tensor, rest: Tensor | float = 0.0) -> Tensor:
    """Return S (3N, 3N) of deviations from a mean, in the directions that deform it.

    Args:
        away: (T, N, 3).
        mean: (N, 3), centred.
        rest: the sum of the deviations' own covariances (3N, 3N).
    """
    tangent = procrustean_tangent(mean)
    vectors = as_vectors(away)
    moment = tangent @ ((vectors.mT @ vectors + rest) / len(vectors)) @ tangent
    return (moment + moment.mT) / 2


def align_to_mean(shapes: Tensor, mean: Tensor) -> tuple[Tensor, Tensor]:
    """Return the rotations Q (T, 3, 3) and factors a (T,) that align shapes with a mean: a Y Q . M = M . M.

    Args:
        shapes: Y (T, N, 3), centred.
        mean: M (N, 3), centred.

    Generalised Procrustes analysis (Gower 1975), with the scale that puts shapes on the mean's tangent space.
    """
    turn = nearest_rotation(shapes.mT @ mean)
    along = ((shapes @ turn) * mean).sum((1, 2)) / mean.square().sum()
    return turn, 1 / torch.maximum(along, LEAST * along.median().clamp_min(LEAST * along.amax()))


def procrustean_tangent(mean: Tensor) -> Tensor:
    """Return the projector (3N, 3N) onto the directions in which a shape deforms: it neither moves, turns nor grows.

    Args:
        mean: (N, 3), centred; vectors hold all x, then all y, then all z.

    >>> mean = torch.tensor([[1.0, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0]])
    >>> round(procrustean_tangent(mean).trace().item())
    5
    """
    joints = len(mean)
    eye = torch.eye(3, dtype=mean.dtype, device=mean.device)
    moves = eye[:, None].expand(3, joints, 3)
    turns = torch.linalg.cross(moves, mean.expand(3, joints, 3))
    rigid = as_vectors(torch.cat([moves / joints**0.5, turns, mean[None]]))  # (7, 3N)
    value, vector = torch.linalg.eigh(rigid @ rigid.mT)  # two or three joints, or joints on a line, have fewer
    kept = value > 1e-12 * value[-1]
    basis = (vector / torch.where(kept, value, torch.ones_like(value)).sqrt() * kept).mT @ rigid
    return torch.eye(3 * joints, dtype=mean.dtype, device=mean.device) - basis.mT @ basis


def as_vectors(points: Tensor) -> Tensor:
    """(T, N, 3) as (T, 3N): all x, all y, all z."""
    return points.mT.flatten(1)


def unit_mean(mean: Tensor, shapes: Tensor) -> Tensor:
    """A mean of unit norm; a shape in place of a mean that vanishes."""
    size = torch.linalg.vector_norm(mean)
    first = shapes[torch.linalg.vector_norm(shapes, dim=(1, 2)).argmax()]
    vague = size <= 1e-9 * torch.linalg.vector_norm(first)
    return torch.where(vague, first / torch.linalg.vector_norm(first), mean / torch.where(vague, 1, size))
