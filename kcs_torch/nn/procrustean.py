"""The log-determinant of aligned bones, as a loss and as a term of an objective."""

from __future__ import annotations

from pathlib import Path

import torch
from torch import Tensor

from kcs_torch.errors import OptionError
from kcs_torch.functional.align import nearest_rotation
from kcs_torch.functional.chain import bone_vectors
from kcs_torch.functional.scatter import scatter_log_det
from kcs_torch.nn.layers import SkeletonModule, full_precision
from kcs_torch.skeleton import Skeleton

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
        if not eps > 0 or order not in (0, 1) or num_steps < 0:
            raise OptionError(
                "ProcrusteanEnergy: expected eps > 0, order 0 or 1 and num_steps >= 0, "
                f"got {eps}, {order!r} and {num_steps}"
            )
        self.eps, self.order, self.num_steps = eps, order, num_steps

    def forward(self, points: Tensor, rotations: Tensor | None = None) -> Tensor:
        """Return the energy of each clip.

        Args:
            points: (..., T, N, 3), finite.
            rotations: (..., T, 3, 3) that bring poses (as rows) together, ``points @ rotations``; found if None.

        Returns:
            (...), without a unit: the bones are scaled to a mean square of 1 first. 0 for a clip that does not move.

        Raises:
            ShapeError: the shapes do not fit.
        """
        self.check(points, clip=True)
        with full_precision(points):
            wide = points.to(torch.promote_types(points.dtype, torch.float32))
            vectors = bone_vectors(wide, self.bones)
            if rotations is None:
                rotations = _align(vectors, self.num_steps)
            aligned = (vectors @ rotations).flatten(-2)
            size = aligned.square().mean((-2, -1), keepdim=True)
            aligned = aligned / torch.where(size > 0, size, torch.ones_like(size)).sqrt()
            rows = aligned.diff(dim=-2) if self.order else aligned - aligned.mean(-2, keepdim=True)
            floor = rows.new_zeros(rows.shape[:-2]) + self.eps
            least = rows.shape[-2] * rows.shape[-1] / 2 * floor.log()  # what a clip at rest is charged
            return (scatter_log_det(rows, floor) - least).to(points.dtype)


def _align(vectors: Tensor, num_steps: int) -> Tensor:
    """Rotations (..., T, 3, 3) of bones (..., T, B, 3) onto their mean, from the first frame's pose."""
    mean = vectors[..., :1, :, :]
    rotations = torch.eye(3, dtype=vectors.dtype, device=vectors.device).expand(*vectors.shape[:-2], 3, 3)
    for _ in range(num_steps):
        rotations = nearest_rotation(vectors.mT @ mean)
        mean = (vectors @ rotations).mean(-3, keepdim=True)
    return rotations
