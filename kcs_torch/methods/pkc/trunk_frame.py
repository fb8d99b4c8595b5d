"""The trunk's rotation in each frame, by two of its axes, and the way back from its derivatives."""

from __future__ import annotations

import torch
from torch import Tensor

__all__ = ["TrunkFrame"]


class TrunkFrame:
    """The right-angled directions of two axes (H, 3, T): the first, what of the second is square to it, their product.

    Args:
        first: the axis that gives the first direction.
        second: the other one.
    """

    def __init__(self, first: Tensor, second: Tensor) -> None:
        self.over = (first.square().sum(1, keepdim=True) + 1e-18).rsqrt()
        self.first, self.second = first * self.over, second
        self.along = (second * self.first).sum(1, keepdim=True)
        square = second - self.along * self.first
        self.down = (square.square().sum(1, keepdim=True) + 1e-18).rsqrt()
        self.up = square * self.down

    def directions(self) -> Tensor:
        """(H, 3, 3, T): one below the other."""
        return torch.stack([self.first, self.up, torch.linalg.cross(self.first, self.up, dim=1)], 1)

    def slopes(self, into: Tensor) -> tuple[Tensor, Tensor]:
        """Derivatives in both axes, of those in the directions, (H, 3, 3, T)."""
        a, b, c = into.unbind(1)
        a = a + torch.linalg.cross(self.up, c, dim=1)
        b = b + torch.linalg.cross(c, self.first, dim=1)
        b = (b - self.up * (self.up * b).sum(1, keepdim=True)) * self.down
        slant = (b * self.first).sum(1, keepdim=True)
        a = a - self.along * b - slant * self.second
        b = b - slant * self.first
        return (a - self.first * (self.first * a).sum(1, keepdim=True)) * self.over, b
