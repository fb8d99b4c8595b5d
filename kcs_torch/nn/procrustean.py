"""The log-determinant of aligned bones, as a loss and as a term of an objective."""

from __future__ import annotations

import math
from pathlib import Path

import torch
from torch import Tensor

from kcs_torch.errors import OptionError, ShapeError
from kcs_torch.functional.align import nearest_rotation
from kcs_torch.functional.chain import bone_vectors
from kcs_torch.functional.guarded import or_one, safe_root, unit_size
from kcs_torch.functional.precision import full_precision, narrow, wide
from kcs_torch.functional.scatter import scatter_log_det
from kcs_torch.functional.weights import known
from kcs_torch.nn.checks import check_beside, check_weights
from kcs_torch.nn.layers import SkeletonModule
from kcs_torch.nn.masks import bone_share
from kcs_torch.skeleton import Skeleton
from kcs_torch.types.hints import is_a

__all__ = ["ProcrusteanEnergy"]


class ProcrusteanEnergy(SkeletonModule):
    """T/2 log det(Sigma + eps I) of a clip's bones, each frame turned onto the clip's mean pose.

    Low where poses, whatever way they face, move in few ways: a rank that neither the body's nor the camera's turning
    adds to. The rotations are found by generalised Procrustes alignment, and gradients run through it.

    Args:
        skeleton: a :class:`Skeleton`, a built-in name or a file.
        eps: relative to the mean square of a coordinate of the bones.
        order: 0 charges the poses, 1 their changes from frame to frame.
        num_steps: rounds of alignment.

    Raises:
        OptionError: ``eps`` is not positive, ``order`` is neither 0 nor 1, or ``num_steps`` is negative.

    >>> energy = ProcrusteanEnergy("h36m17")
    >>> energy(torch.randn(4, 30, 17, 3)).shape
    torch.Size([4])
    """

    def __init__(
        self, skeleton: str | Path | Skeleton, *, eps: float = 1e-3, order: int = 0, num_steps: int = 5
    ) -> None:
        super().__init__(skeleton)
        numbers = is_a(eps, float) and is_a(num_steps, int)
        if not numbers or not 0 < eps < math.inf or order not in (0, 1) or num_steps < 0:
            raise OptionError(
                "ProcrusteanEnergy: expected finite eps > 0, order 0 or 1 and num_steps >= 0, "
                f"got {eps!r}, {order!r} and {num_steps!r}"
            )
        self.eps, self.order, self.num_steps = eps, order, num_steps

    def forward(self, points: Tensor, rotations: Tensor | None = None, weights: Tensor | None = None) -> Tensor:
        """Return the energy of each clip.

        Args:
            points: (..., T, N, 3), finite.
            rotations: (..., T, 3, 3) that bring poses (as rows) together, ``points @ rotations``; found if None.
            weights: (..., T, N) of the joints: a bone weighs as much as the lesser of its two ends. Where it is unseen
                in some frames it is taken for its mean over time there.

        Returns:
            (...), without a unit: the bones are scaled to a mean square of 1 first. 0 for a clip that does not move.

        Raises:
            ShapeError: the shapes do not fit.
        """
        self.check(points, clip=True)
        check_weights(weights, points, self)
        check_beside(rotations, "rotations", (points.shape[-3], 3, 3), points, self)
        if points.shape[-1] != 3:
            expected = f"points (..., T, {points.shape[-2]}, 3) and rotations (..., T, 3, 3) or None"
            raise ShapeError(f"ProcrusteanEnergy: expected {expected}, got points {tuple(points.shape)}")
        with full_precision(points):
            vectors, share = bone_vectors(wide(points), self.bones), None
            if weights is not None:
                share = bone_share(weights, self.bones).to(vectors.dtype)
                vectors, share = known(vectors, share), share[..., None]
            vectors = unit_size(vectors, 3)
            if rotations is None:
                rotations = _align(vectors, self.num_steps, share)
            aligned = (vectors @ rotations.to(vectors.dtype)).flatten(-2)
            rows, seen = self._rows(aligned, share)
            floor = rows.new_zeros(rows.shape[:-2]) + self.eps
            least = rows.shape[-2] * rows.shape[-1] / 2 * floor.log()  # what a clip at rest is charged
            return narrow((scatter_log_det(rows, floor) - least) * seen, points)

    def _rows(self, aligned: Tensor, share: Tensor | None) -> tuple[Tensor, Tensor | float]:
        """Scaled deviations or changes (..., T, 3B) of aligned bones, and the share of the rows that counts."""
        if share is None:
            size = aligned.square().mean((-2, -1), keepdim=True)
            aligned = aligned / or_one(size).sqrt()
            return (aligned.diff(dim=-2) if self.order else aligned - aligned.mean(-2, keepdim=True)), 1.0
        share = share.expand(*share.shape[:-1], 3).flatten(-2)  # (..., T, 3B)
        size = (share * aligned.square()).sum((-2, -1), keepdim=True) / or_one(share.sum((-2, -1), keepdim=True))
        aligned = aligned / or_one(size).sqrt()
        if self.order:
            rows, share = aligned.diff(dim=-2), torch.minimum(share[..., 1:, :], share[..., :-1, :])
            count = share.sum(-2, keepdim=True)
        else:
            count = share.sum(-2, keepdim=True)
            rows = aligned - (share * aligned).sum(-2, keepdim=True) / or_one(count)
        frames = max(rows.shape[-2], 1)
        most = share.amax(-1) if share.shape[-1] else share.sum(-1)  # a skeleton may have no bones
        return rows * safe_root(share * frames / or_one(count)), most.sum(-1) / frames


def _align(vectors: Tensor, num_steps: int, share: Tensor | None = None) -> Tensor:
    """Rotations (..., T, 3, 3) of bones (..., T, B, 3) onto their mean, from a frame's pose.

    It is the first frame of those that show most; bones count their share (..., T, B, 1).
    """
    rotations = torch.eye(3, dtype=vectors.dtype, device=vectors.device).expand(*vectors.shape[:-2], 3, 3)
    if not vectors.shape[-3]:
        return rotations
    if share is None:
        mean, heavy, count = vectors[..., :1, :, :], vectors, None
    else:
        shown = (
            share.sum((-2, -1)).argmax(-1)[..., None, None, None].expand(*vectors.shape[:-3], 1, *vectors.shape[-2:])
        )
        mean, heavy, count = vectors.gather(-3, shown), share * vectors, or_one(share.sum(-3, keepdim=True))
    for _ in range(num_steps):
        rotations = nearest_rotation(heavy.mT @ mean)
        turned = heavy @ rotations
        mean = turned.mean(-3, keepdim=True) if count is None else turned.sum(-3, keepdim=True) / count
    return rotations
