"""The energy of a body without a template: :class:`PlainBody`."""

from __future__ import annotations

from copy import copy

import torch
from torch import Tensor

from kcs_torch.methods.pkc.image import bend_cost
from kcs_torch.methods.pkc.weights import HEAVY
from kcs_torch.skeleton import Skeleton

__all__ = ["ACCELERATION", "CLOSE", "PlainBody"]

ACCELERATION = 0.05
"""Standard deviation of the second difference of a bone's depth at 30 frames a second."""

CLOSE = 0.3
"""Usual deviation of a bone's depth from the method's."""


class PlainBody:
    """Bones keep their length, move smoothly and stay near the depths that a method found.

    Args:
        skeleton: of the body.
        near: (H, B, T) the method's depths of bones.
        slack: standard deviation of a length.
        slow: 30 over the frames a second.
    """

    def __init__(self, skeleton: Skeleton, near: Tensor, slack: float, slow: float) -> None:
        rigid = skeleton.rigid_mask(dtype=near.dtype, device=near.device)
        self.near, self.precision = near, rigid[:, None] / slack**2  # (B, 1)
        self.smooth = (ACCELERATION * slow**2) ** -2

    def rows(self, index: Tensor) -> PlainBody:
        """That of some hypotheses."""
        out = copy(self)
        out.near = self.near[index]
        return out

    def with_image(
        self, own: Tensor, lengths: Tensor, bones: Tensor, rays: Tensor
    ) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
        """As :meth:`kcs_torch.methods.pkc.descent.ObjectiveGradient.with_image`.

        Args:
            own: (H, B, T) depths of bones.
            lengths: (H, B).
            bones: (H, 2, B, T) their image.
            rays: make no difference here.

        Returns:
            The energy (H,), and its derivatives in depths, log lengths, image and log rays.
        """
        size, frames = lengths[..., None], own.shape[-1]
        off = (bones.square().sum(1) + own.square() - size.square()) / (2 * size)
        ratio = self.precision * off / HEAVY
        each = ratio * off
        spread = HEAVY * each.log1p().mean(-1)
        value = frames / 2 * spread.log1p().sum(-1)
        pull = HEAVY * ratio / (1 + each) / (1 + spread)[..., None]  # in off
        growth = -(pull * (off + size)).sum(-1)
        pull = pull / size
        away = (own - self.near) / CLOSE
        slope = pull * own + away / CLOSE
        value = value + away.square().sum((1, 2)) / 2 + bend_cost(own, self.smooth, slope)
        return value, slope, growth, pull[:, None] * bones, torch.zeros_like(value)
