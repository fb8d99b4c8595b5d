"""Whether a body stands on its feet, in an image whose y points down."""

from __future__ import annotations

from torch import Tensor

from kcs_torch.skeleton import Skeleton

__all__ = ["upside_down"]

CLEARLY = 0.3
"""How far feet are above the rest, over the joints' root mean square distance from their mean height."""


def upside_down(heights: Tensor, seen: Tensor, skeleton: Skeleton, share: float = 0.5) -> bool:
    """Whether the joints that touch the ground are clearly above the others in more than a share of the frames.

    Args:
        heights: (T, N) y of the joints, pointing down.
        seen: (T, N).
        skeleton: one without contacts is never upside down.
        share: of the frames that show joints of both kinds.
    """
    feet = list(skeleton.contacts)
    others = [n for n in range(skeleton.num_joints) if n not in feet]

    def mean(joints: list[int], values: Tensor) -> Tensor:
        """(T, 1), over the joints that a frame shows."""
        own = seen[:, joints]
        return values[:, joints].where(own, 0).sum(1, keepdim=True) / own.sum(1, keepdim=True).clamp_min(1)

    every = [*feet, *others]
    size = mean(every, (heights - mean(every, heights)).square())[:, 0].sqrt()
    above = mean(others, heights)[:, 0] - mean(feet, heights)[:, 0]
    shown = seen[:, feet].any(1) & seen[:, others].any(1) & (size > 0)
    return bool(shown.any()) and float((above > CLEARLY * size)[shown].double().mean()) > share
