"""A body's bones, taken apart into what its two sides share and what sets them apart."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from kcs_torch.nn.posture import PostureEnergy

__all__ = ["Sides"]


class Sides:
    """Takes a body's bones apart as :attr:`PostureEnergy.halves` does, at the cost of a sum and a difference.

    Bones are brought into the order left twins, right twins, others. What each is divided by holds the rest: a root of
    two for twins, and the sign with which the right one's first coordinate counts.

    Args:
        posture: of the body.
    """

    def __init__(self, posture: PostureEnergy) -> None:
        body, device = posture.skeleton, posture.halves.device
        pairs = body.mirror_bones if len(posture.halves) > 1 else ()
        left, right = ([pair[i] for pair in pairs] for i in (0, 1))
        other = [b for b in range(body.num_bones) if b not in {*left, *right}]
        self.twins, self.others = len(pairs), len(other)
        self.order = torch.tensor([*left, *right, *other], device=device)
        self.back = self.order.argsort()
        share = torch.ones(3, body.num_bones, dtype=posture.halves.dtype, device=device)
        share[:, : 2 * self.twins] = math.sqrt(2)
        share[0, self.twins : 2 * self.twins] *= -1
        self.share = share

    def apart(self, seen: Tensor) -> Tensor:
        """(H, 3B, T), bones in this order, as (S H, K, T), first what both sides share."""
        if not self.twins:
            return seen
        count, _, frames = seen.shape
        left, right, other = self._split(seen.view(count, 3, -1, frames))
        out = seen.new_empty(2, count, 3 * self.twins + 2 * self.others, frames)
        for both, rest, sign, first in zip(*self._parts(out), (1, -1), (1, 0), strict=True):
            torch.add(left, right, alpha=sign, out=both)
            own = other[:, first : first + 1 + first]
            rest[:, : own.shape[1]] = own
            rest[:, own.shape[1] :] = 0
        return out.flatten(0, 1)

    def joined(self, halves: Tensor, count: int) -> Tensor:
        """The way back."""
        if not self.twins:
            return halves
        out = halves.new_empty(count, 3, len(self.order), halves.shape[-1])
        left, right, other = self._split(out)
        (shared, apart), rest = self._parts(halves.view(2, count, *halves.shape[1:]))
        torch.add(shared, apart, out=left)
        torch.sub(shared, apart, out=right)
        other[:, 1:], other[:, 0] = rest[0], rest[1][:, 0]
        return out.flatten(1, 2)

    def _split(self, seen: Tensor) -> tuple[Tensor, ...]:
        """Left twins, right twins and others of (H, 3, B, T)."""
        return seen.split([self.twins, self.twins, self.others], 2)

    def _parts(self, halves: Tensor) -> tuple[list[Tensor], list[Tensor]]:
        """Both halves' rows of twins (H, 3, P, T), and of others (H, 2, B - 2P, T)."""
        twins, others = halves.split([3 * self.twins, 2 * self.others], 2)
        return list(twins.unflatten(2, (3, -1))), list(others.unflatten(2, (2, -1)))
