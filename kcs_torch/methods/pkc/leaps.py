"""Leaps: what looks much like its own mirror image may change to it from one frame to the next."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from kcs_torch.functional.ranks import median
from kcs_torch.solvers.procrustean import Pose

__all__ = ["leaps_of", "without_leaps"]

FARTHER, SUDDEN = 3.0, 5.0
"""A leap is a step in depth that is so many times what it is with the sign of all joints changed, and so many times the
clip's median step."""

LEAST = 0.1
"""Root mean square step of a leap, a share of that of all depths."""


def leaps_of(depth: Tensor) -> Tensor:
    """Frames (H, T) from which on all depths (H, T, N), about their middle, change sign; never the first.

    >>> depth = torch.tensor([[1.0, 2.0, -3.0]]).expand(1, 9, 3).clone()
    >>> depth[:, 5:] *= -1
    >>> leaps_of(depth).nonzero().tolist()
    [[0, 5]]
    """
    out = torch.zeros(depth.shape[:2], dtype=torch.bool, device=depth.device)
    if depth.shape[1] > 2:
        after, before = depth[:, 1:], depth[:, :-1]
        step, turned = (after - before).square().mean(-1), (after + before).square().mean(-1)
        usual = torch.maximum(SUDDEN**2 * median(step, 1), LEAST**2 * depth.square().mean((1, 2)))
        out[:, 1:] = (step > FARTHER**2 * turned) & (step > usual[:, None])
    return out


def without_leaps(pose: Pose) -> Pose | None:
    """Solutions whose frames behind a leap are turned back, as mirror images; None where there is no leap.

    A body that is nearly flat is nearly as well aligned by the rotation of its mirror image, which a mirroring at its
    own plane makes of that before. Aligned bones know nothing of the camera's leap, nor do lengths.
    """
    leaps = leaps_of(pose.points[..., 2])
    if not bool(leaps.any()):
        return None
    sign = (1 - 2 * leaps.to(pose.points)).cumprod(1)  # (H, T)
    aligned = pose.points @ pose.rotations
    aligned = aligned - aligned.mean(-2, keepdim=True)
    normal = torch.linalg.eigh((aligned.mT @ aligned).sum(1))[1][..., :1]  # (H, 3, 1)
    flat = torch.eye(3).to(normal) - 2 * normal @ normal.mT
    flip = pose.points.new_tensor([1.0, 1.0, -1.0])
    turned = (flip[:, None] * pose.rotations) @ flat[:, None]
    back = sign[..., None, None] < 0
    points = torch.where(back, pose.points * flip, pose.points)
    return replace(pose, points=points, rotations=torch.where(back, turned, pose.rotations))
