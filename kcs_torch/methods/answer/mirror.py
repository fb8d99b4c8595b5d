"""Which of the two mirror images in depth to report: parallel rays show no difference."""

from __future__ import annotations

import torch
from torch import Tensor

from kcs_torch.nn.anatomy import HingeEnergy
from kcs_torch.skeleton import Skeleton

__all__ = ["mirror_sign"]


def mirror_sign(points: Tensor, skeleton: Skeleton, inside: Tensor | None = None) -> Tensor:
    """1, or -1 where the mirror image in depth is the one to report: nothing but the joints' hinges can tell.

    Without hinges it is the image that leans to the right or down as it goes away: any rule will do, as long as it does
    not depend on a search's start.

    Args:
        points: (..., T, N, 3), centred.
        skeleton: of the N joints.
        inside: (..., T), False in frames that pad a shorter clip, where the points are 0.

    Returns:
        (...).
    """
    flip = points.new_tensor([1.0, 1.0, -1.0])
    share = None if inside is None else inside.to(points.dtype).expand(2, *inside.shape)
    wrong = HingeEnergy(skeleton).to(points.device)(torch.stack([points, points * flip]), weights=share).sum(-1)
    lean = (points[..., 2:] * points[..., :2]).sum((-3, -2))
    lean = lean.gather(-1, lean.abs().argmax(-1, keepdim=True)).squeeze(-1)
    rounding = torch.finfo(wrong.dtype).eps  # of straight joints; energies are squared sines
    clear = (wrong[0] - wrong[1]).abs() > 1e-3 * wrong.sum(0) + rounding
    right = torch.where(clear, wrong[0] < wrong[1], lean >= 0)
    return torch.where(right, 1.0, -1.0).to(points)
