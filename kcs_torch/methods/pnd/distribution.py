"""The Procrustean normal distribution: shapes that do not move, turn or grow, and the alignment that makes them so.

Vectors of a shape hold all x, then all y, then all z. Clips may be padded in time: shapes are 0 in the padding.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from kcs_torch.functional.align import nearest_rotation
from kcs_torch.functional.ranks import nanmedian

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
    """Procrustean normal distributions and the frames' places in them; vectors hold all x, then all y, then all z.

    Attributes:
        mean: M (..., N, 3), centred, of unit norm.
        covariance: S (..., 3N, 3N).
        rotations: R (..., T, 3, 3), from the aligned frame to the camera's.
        scales: c (..., T), positive; 0 in the padding.
        aligned: Y (..., T, N, 3), each frame's shape, or its posterior mean; 0 in the padding.
    """

    mean: Tensor
    covariance: Tensor
    rotations: Tensor
    scales: Tensor
    aligned: Tensor

    def shapes(self) -> Tensor:
        """The shapes in the camera's frame, c Y R^T, (..., T, N, 3)."""
        return self.scales[..., None, None] * (self.aligned @ self.rotations.mT)

    @classmethod
    def of_shapes(
        cls, points: Tensor, rotations: Tensor, *, spread: float = 0.0, inside: Tensor | None = None
    ) -> ProcrusteanNormal:
        """Align shapes by generalised Procrustes analysis and take their moments.

        Args:
            points: X (..., T, N, 3), centred, in each frame's camera; 0 in the padding.
            rotations: (..., T, 3, 3), a first guess of R.
            spread: variance to add in every direction that deforms, a share of their mean.
            inside: (..., T), False in the padding; no frame is padding where None.
        """
        inside = torch.ones_like(points[..., 0, 0], dtype=torch.bool) if inside is None else inside
        aligned = points @ rotations
        mean = unit_mean(aligned)
        for _ in range(20):
            turn, factor = align_to_mean(aligned, mean, inside)
            aligned = (aligned @ turn) * factor[..., None, None]
            mean = unit_mean(aligned)
        turn, factor = align_to_mean(aligned, mean, inside)
        aligned = (aligned @ turn) * factor[..., None, None]
        rotations = nearest_rotation(points.mT @ aligned)
        norm = torch.where(inside, aligned.square().sum((-2, -1)), 1)
        size = (points * (aligned @ rotations.mT)).sum((-2, -1)) / norm
        scales = torch.where(inside, not_small(size, inside), 0)
        covariance = second_moment(aligned, mean, inside)
        size = covariance.diagonal(dim1=-2, dim2=-1).mean(-1)
        covariance = covariance + spread * size[..., None, None] * procrustean_tangent(mean)
        return cls(mean, covariance, rotations, scales, aligned)


def second_moment(aligned: Tensor, mean: Tensor, inside: Tensor, rest: Tensor | float = 0.0) -> Tensor:
    """Return S (..., 3N, 3N) of aligned shapes about a mean, in the directions that deform it.

    Args:
        aligned: (..., T, N, 3).
        mean: (..., N, 3), centred.
        inside: (..., T), False in the padding.
        rest: the sum of the shapes' own covariances (..., 3N, 3N).
    """
    tangent = procrustean_tangent(mean)
    vectors = as_vectors(aligned - mean[..., None, :, :]) * inside[..., None]
    moment = tangent @ ((vectors.mT @ vectors + rest) / inside.sum(-1)[..., None, None]) @ tangent
    return (moment + moment.mT) / 2


def align_to_mean(shapes: Tensor, mean: Tensor, inside: Tensor | None = None) -> tuple[Tensor, Tensor]:
    """Return the rotations Q (..., T, 3, 3) and factors a (..., T) that align shapes with a mean: a Y Q . M = M . M.

    Args:
        shapes: Y (..., T, N, 3), centred.
        mean: M (..., N, 3), centred.
        inside: (..., T), False in the padding; no frame is padding where None.

    Generalised Procrustes analysis (Gower 1975), with the scale that puts shapes on the mean's tangent space.
    """
    mean = mean[..., None, :, :]
    turn = nearest_rotation(shapes.mT @ mean)
    along = ((shapes @ turn) * mean).sum((-2, -1)) / mean.square().sum((-2, -1))
    return turn, 1 / not_small(along, torch.ones_like(along, dtype=torch.bool) if inside is None else inside)


def not_small(values: Tensor, inside: Tensor) -> Tensor:
    """Values (..., T), 0 in the padding, but at least :data:`LEAST` of those of the clip."""
    middle = nanmedian(torch.where(inside, values, torch.nan), -1, keepdim=True)
    return torch.maximum(values, LEAST * torch.maximum(middle, LEAST * values.amax(-1, keepdim=True)))


def procrustean_tangent(mean: Tensor) -> Tensor:
    """Return projectors (..., 3N, 3N) onto the directions in which a shape deforms: it neither moves, turns nor grows.

    Args:
        mean: (..., N, 3), centred; vectors hold all x, then all y, then all z.

    >>> mean = torch.tensor([[1.0, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0]])
    >>> round(procrustean_tangent(mean).trace().item())
    5
    """
    joints = mean.shape[-2]
    mean = mean[..., None, :, :]
    moves = torch.eye(3, dtype=mean.dtype, device=mean.device)[:, None].expand(*mean.shape[:-3], 3, joints, 3)
    turns = torch.linalg.cross(moves, mean.expand_as(moves))
    rigid = as_vectors(torch.cat([moves / joints**0.5, turns, mean], -3))  # (..., 7, 3N)
    value, vector = torch.linalg.eigh(rigid @ rigid.mT)  # two or three joints, or joints on a line, have fewer
    kept = value > 1e-12 * value[..., -1:]
    share = kept / torch.where(kept, value, torch.ones_like(value)).sqrt()
    basis = (vector * share[..., None, :]).mT @ rigid
    return torch.eye(3 * joints, dtype=mean.dtype, device=mean.device) - basis.mT @ basis


def as_vectors(points: Tensor) -> Tensor:
    """(..., T, N, 3) as (..., T, 3N): all x, all y, all z."""
    return points.mT.flatten(-2)


def unit_mean(shapes: Tensor) -> Tensor:
    """Means (..., N, 3) of shapes (..., T, N, 3), of unit norm; a shape in place of a mean that vanishes."""
    mean = shapes.mean(-3)  # padding makes it shorter, no more
    size = torch.linalg.vector_norm(mean, dim=(-2, -1), keepdim=True)
    most, index = torch.linalg.vector_norm(shapes, dim=(-2, -1)).max(-1)
    first = torch.take_along_dim(shapes, index[..., None, None, None], -3).squeeze(-3)
    most = most[..., None, None]
    vague = size <= 1e-9 * most
    return torch.where(vague, first / most, mean / torch.where(vague, 1, size))
