"""Whether a body stands on its feet, in an image whose y points down."""

from __future__ import annotations

from torch import Tensor

from kcs_torch.skeleton import Skeleton

__all__ = ["lies_down", "upside_down"]

CLEARLY = 0.3
"""How far feet are above the rest, over the joints' root mean square distance from their mean height."""

FLAT = 3.0
"""How much farther to the side of the rest feet are than below it if the body lies."""


def upside_down(heights: Tensor, seen: Tensor, skeleton: Skeleton, share: float = 0.5) -> bool:
    """Whether the joints that touch the ground are clearly above the others in more than a share of the frames.

    Args:
        heights: (T, N) y of the joints, pointing down.
        seen: (T, N).
        skeleton: one without contacts is never upside down.
        share: of the frames that show joints of both kinds.
    """
    below, size, shown = _feet(heights[..., None], seen, skeleton)
    return bool(shown.any()) and _share(-below[:, 0] > CLEARLY * size, shown) > share


def lies_down(points: Tensor, seen: Tensor, skeleton: Skeleton, share: float) -> bool:
    """Whether those joints are clearly beside the others, and hardly below them, in more than a share of the frames.

    Args:
        points: (T, N, 2).
        seen: (T, N).
        skeleton: one without contacts does not lie.
        share: of the frames that show joints of both kinds.
    """
    away, size, shown = _feet(points, seen, skeleton)
    aside, below = away.abs().unbind(-1)
    return bool(shown.any()) and _share((aside > CLEARLY * size) & (aside > FLAT * below), shown) > share


def _feet(points: Tensor, seen: Tensor, skeleton: Skeleton) -> tuple[Tensor, Tensor, Tensor]:
    """Where feet are, from the others (T, D); how far joints are from their mean (T,); frames that show both (T,)."""
    feet = list(skeleton.contacts)
    others = [n for n in range(skeleton.num_joints) if n not in feet]

    def mean(joints: list[int], values: Tensor) -> Tensor:
        """(T, 1, D), over the joints that a frame shows."""
        own = seen[:, joints, None]
        return values[:, joints].where(own, 0).sum(1, keepdim=True) / own.sum(1, keepdim=True).clamp_min(1)

    every = [*feet, *others]
    size = mean(every, (points - mean(every, points)).square().sum(-1, keepdim=True))[:, 0, 0].sqrt()
    shown = seen[:, feet].any(1) & seen[:, others].any(1) & (size > 0)
    return (mean(feet, points) - mean(others, points))[:, 0], size, shown


def _share(of: Tensor, shown: Tensor) -> float:
    return float(of[shown].double().mean())
