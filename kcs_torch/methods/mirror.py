"""Which of the two mirror images in depth to report: parallel rays show no difference."""

from __future__ import annotations

import torch
from torch import Tensor

from kcs_torch.nn.anatomy import HingeEnergy
from kcs_torch.skeleton import Skeleton

__all__ = ["mirror_sign"]


def mirror_sign(points: Tensor, skeleton: Skeleton) -> float:
    """1, or -1 where the mirror image in depth is the one to report: nothing but the joints' hinges can tell.

    Without hinges it is the image that leans to the right or down as it goes away: any rule will do, as long as it does
    not depend on a search's start.

    Args:
        points: (T, N, 3), centred.
        skeleton: of the N joints.
    """
    flip = points.new_tensor([1.0, 1.0, -1.0])
    wrong = HingeEnergy(skeleton).to(points.device)(torch.stack([points, points * flip])).sum(-1)
    if bool((wrong[0] - wrong[1]).abs() > 1e-3 * wrong.sum()):
        return 1.0 if bool(wrong[0] < wrong[1]) else -1.0
    lean = (points[..., 2:] * points[..., :2]).sum((0, 1))
    return 1.0 if bool(lean[lean.abs().argmax()] >= 0) else -1.0
