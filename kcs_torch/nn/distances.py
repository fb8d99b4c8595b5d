"""How far a pose is from a given one: distance of joints, and of KCS matrices."""

from __future__ import annotations

from pathlib import Path

import torch
from torch import Tensor, nn

from kcs_torch.errors import OptionError, ShapeError
from kcs_torch.functional.align import check_alignment, superpose
from kcs_torch.functional.chain import pose_matrix
from kcs_torch.functional.guarded import or_one, safe_norm
from kcs_torch.functional.precision import full_precision, narrow, wide
from kcs_torch.functional.shapes import fit_together
from kcs_torch.functional.weights import known, seen_weights
from kcs_torch.nn.checks import check_clip, check_tensor, check_weights, shown
from kcs_torch.nn.layers import SkeletonModule
from kcs_torch.nn.masks import bone_share
from kcs_torch.skeleton import Skeleton

__all__ = ["JointDistance", "KCSDistance"]


class JointDistance(nn.Module):
    """sum_n w_n |x_n - y_n| / sum_n w_n of each frame, after the alignment named: the supervised loss.

    It is :func:`kcs_torch.metrics.mpjpe` frame by frame, with the derivative 0 where a joint is on its target.

    Args:
        align: a name in :data:`kcs_torch.metrics.ALIGNMENTS`; never mirrored: of a pose that only a negative scale
            would bring nearer its root is left, and no derivative.
        root: index of the root joint for ``root`` and ``scale``; the middle of all joints if None.

    Raises:
        OptionError: there is no such alignment, or the root is no index.

    >>> JointDistance()(torch.zeros(1, 2, 3), torch.tensor([[[0.0, 3, 4], [0, 0, 0]]])).tolist()
    [2.5]
    """

    def __init__(self, align: str = "none", *, root: int | None = None) -> None:
        super().__init__()
        check_alignment(align, root)
        self.align, self.root = align, root

    def extra_repr(self) -> str:
        return shown(self, "align", "root")

    def forward(self, points: Tensor, target: Tensor, weights: Tensor | None = None) -> Tensor:
        """Return the mean distance of each frame.

        Args:
            points: (..., T, N, 3).
            target: (..., T, N, 3), NaN where a joint is unknown.
            weights: (..., T, N), 0 where a joint is unknown, too. A frame without its root does not count.

        Returns:
            (..., T), in the unit of the points; 0 where nothing counts.

        Raises:
            ShapeError: the shapes do not fit.
            OptionError: there is no such root joint.
        """
        check_clip(points, self)
        check_weights(weights, points, self)
        check_tensor(target, "target", self)
        joints = points.shape[-2]
        fits = target.shape[-3:] == points.shape[-3:] and fit_together(target.shape, points.shape)
        if not fits or points.shape[-1] != 3:
            expected = f"points (..., T, N, 3) and target (..., {points.shape[-3]}, {joints}, 3)"
            raise ShapeError(f"JointDistance: expected {expected}, got {tuple(points.shape)} and {tuple(target.shape)}")
        if self.root is not None and not -joints <= self.root < joints:
            raise OptionError(f"root: expected a joint index below {joints}, got {self.root}")
        with full_precision(points):
            weights = seen_weights(target, weights)
            source, goal = wide(known(points, weights)), known(wide(target), weights)
            finer = torch.promote_types(source.dtype, goal.dtype)
            source, goal = torch.broadcast_tensors(source.to(finer), goal.to(finer))
            share = weights.to(goal).expand(goal.shape[:-1])
            distance = safe_norm(superpose(source, goal, self.align, share, root=self.root) - goal)
            if self.root is not None and self.align in ("root", "scale"):
                share = share * (share[..., self.root, None] > 0)
            return narrow((share * distance).sum(-1) / or_one(share.sum(-1)), points)


class KCSDistance(SkeletonModule):
    """1/2 sum_bc w_bc (Psi_bc - Psi'_bc)^2 of each pose, Psi = B B^T: lengths of bones and angles between them.

    It does not see how a pose is placed, turned or mirrored. Of float16 give metres, or ``scale_free``: the gradient of
    millimetres, which goes with their third power, leaves its range.

    Args:
        skeleton: a :class:`Skeleton`, a built-in name or a file.
        squared: False takes sum_bc w_bc |Psi_bc - Psi'_bc|, which outliers pull less.
        scale_free: divide each Psi by the mean squared bone length of its pose.

    >>> loss = KCSDistance("h36m17", scale_free=True)
    >>> pose = torch.randn(4, 17, 3)
    >>> bool(loss(2 * pose + 1, pose).max() < 1e-6)
    True
    """

    def __init__(self, skeleton: str | Path | Skeleton, *, squared: bool = True, scale_free: bool = False) -> None:
        super().__init__(skeleton)
        self.squared, self.scale_free = squared, scale_free

    def extra_repr(self) -> str:
        return f"{super().extra_repr()}, {shown(self, 'squared', 'scale_free')}"

    def forward(self, points: Tensor, target: Tensor, weights: Tensor | None = None) -> Tensor:
        """Return the distance of each pose.

        Args:
            points: (..., N, 3).
            target: (..., N, 3), NaN where a joint is unknown.
            weights: (..., N) of the joints: a bone weighs as much as the lesser of its two ends, a pair of bones as
                much as the lesser of them.

        Returns:
            (...), in units of length to the fourth power (to the second if not ``squared``); none if ``scale_free``.

        Raises:
            ShapeError: the shapes do not fit.
        """
        self.check(points)
        check_tensor(target, "target", self)
        if target.shape[-1:] != points.shape[-1:] or not fit_together(target.shape[:-2], points.shape[:-2]):
            message = f"KCSDistance: expected points (..., N, 3) and a target like it, got {tuple(points.shape)}"
            raise ShapeError(f"{message} and {tuple(target.shape)}")
        self.check(target)
        check_pose_weights(weights, points, self)
        with full_precision(points):
            weights = seen_weights(target, weights)
            share = bone_share(weights, self.bones)
            apart = self._matrix(points, weights, share) - self._matrix(target, weights, share)
            each = 0.5 * apart.square() if self.squared else apart.abs()
            return narrow((each * torch.minimum(share[..., :, None], share[..., None, :])).sum((-2, -1)), points)

    def _matrix(self, points: Tensor, weights: Tensor, share: Tensor) -> Tensor:
        return pose_matrix(wide(known(points, weights)), self.bones, normalise=self.scale_free, weights=share)


def check_pose_weights(weights: Tensor | None, points: Tensor, module: nn.Module) -> None:
    """Raise a ShapeError unless ``weights`` are (..., N) for poses (..., N, D), or broadcast to that."""
    if weights is None:
        return
    check_tensor(weights, "weights", module)
    if weights.shape[-1:] != points.shape[-2:-1] or not fit_together(weights.shape, points.shape[:-1]):
        expected = ", ".join(map(str, points.shape[:-1]))
        raise ShapeError(f"{type(module).__name__}: expected weights ({expected}), got {tuple(weights.shape)}")
