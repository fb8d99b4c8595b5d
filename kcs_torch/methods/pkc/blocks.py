"""The search for a body of a whole clip: in blocks where it is long, in fewer frames where there are many a second."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

import torch
from torch import Tensor

from kcs_torch.functional.camera import viewpoint_turn
from kcs_torch.functional.chain import bone_vectors
from kcs_torch.functional.temporal import blend_windows, fill_between, window_starts
from kcs_torch.methods.clips.lockstep import Search, together
from kcs_torch.methods.pkc.body import TURNING, Body, agree
from kcs_torch.methods.pkc.fixed_view import searching
from kcs_torch.methods.pkc.hypotheses import Hypotheses, refined

__all__ = ["Near", "Turned", "search"]

Turned = Callable[[bool], Search[Any, Any, Tensor]]
"""Depths (T, N) that the viewpoint's turn tells, in the template's units; from many starts if so, else from one."""

Near = Callable[[slice, Hypotheses], bool]
"""Whether the camera seems near by hypotheses of some frames of the clip."""

BLOCK, OVERLAP = 400, 40
"""Frames of a long clip that are searched together, and by how many blocks overlap."""

ABREAST = 8
"""Blocks that are searched side by side: what searches of more would hold is for batches no gain."""

FAST = 45.0
"""Frames a second from which on the search leaves frames out."""

AGREE = 0.12
"""Root mean square difference, over the depths', of what the template and the viewpoint's turn tell, up to which each
confirms the other."""

KEPT = 4
"""Hypotheses of fewer frames that are refined on all."""


def search(
    body: Body,
    rounds: int,
    steps: int,
    turned: Turned | None = None,
    near: Near | None = None,
) -> Search[Any, Any, Hypotheses]:
    """Hypotheses of :func:`fixed_view` over all frames, best first; of a clip of several blocks only the best.

    Args:
        body: whose clip it is.
        rounds: of discrete moves.
        steps: of each refinement.
        turned: tells depths where the viewpoint turns; hypotheses that agree with these are not looked over.
        near: asked of hypotheses of the liveliest block; where the camera is near none are looked over.
    """
    blocks = _Blocks(body, rounds, steps, turned, near)
    whole = len(blocks.starts) == 1
    found = yield from (blocks.lifted(slice(None)) if whole else blocks.joined())
    if whole and blocks.stride == 1:
        return found
    some = found[:KEPT]
    pick = torch.arange(0, len(body.image), blocks.stride, device=body.image.device)
    depth = fill_between(some.depth, pick, len(body.image))
    return (yield from refined(body.objective, replace(some, depth=depth), steps))


class _Blocks:
    """The frames of a clip that are searched, and the blocks that they are divided into."""

    def __init__(self, body: Body, rounds: int, steps: int, turned: Turned | None, near: Near | None) -> None:
        self.body, self.rounds, self.steps, self.turned, self.near = body, rounds, steps, turned, near
        self.stride = max(1, round(body.rate / 30)) if body.rate >= FAST else 1
        self.image = body.image[:: self.stride]
        self.size = min(BLOCK, len(self.image))
        self.starts = window_starts(len(self.image), self.size, min(OVERLAP, self.size - 1))

    def joined(self) -> Search[Any, Any, Hypotheses]:
        """The best solution of each block, as one; the liveliest tells the lengths of the others."""
        blocks = torch.stack([self.image[s : s + self.size] for s in self.starts])
        moved = bone_vectors(blocks, self.body.objective.bones).diff(dim=1).square().sum((1, 2, 3))
        first, *order = moved.argsort(descending=True).tolist()
        part = lambda i: slice(self.starts[i], self.starts[i] + self.size)  # noqa: E731
        depths = blocks.new_empty(blocks.shape[:3])  # all that is kept of a block
        found = yield from self.lifted(part(first))
        depths[first], lengths, count = found.depth[0], found.lengths[0], found.steps
        del found
        for begin in range(0, len(order), ABREAST):
            some = order[begin : begin + ABREAST]
            made = yield from together([self.lifted(part(i), lengths) for i in some])
            for i, one in zip(some, made, strict=True):
                depths[i], count = one.depth[0], count + one.steps
        whole = blend_windows(depths, self.starts, len(self.image))
        return Hypotheses(whole[None], lengths[None], whole.new_zeros(1), count)

    def lifted(self, some: slice, lengths: Tensor | None = None) -> Search[Any, Any, Hypotheses]:
        """Hypotheses of some frames, of lengths (B,) that another block told, if it did."""
        standing = self.body.objective.standing
        return searching(
            self.body.skeleton,
            self.image[some],
            rate=self.body.rate / self.stride,
            noise=self.body.noise[:: self.stride][some],
            rounds=self.rounds,
            steps=self.steps,
            anchor=lengths,
            standing=None if standing is None else standing[:: self.stride][some],
            confirmed=partial(self._confirmed, some, lengths is None),
        )

    def _confirmed(self, some: slice, first: bool, found: Hypotheses) -> Search[Any, Any, bool]:
        """Whether hypotheses of some frames need no further search; of the ``first`` block for a near camera, too."""
        begin, end, _ = some.indices(len(self.image))
        frames = slice(begin * self.stride, end * self.stride, self.stride)
        if self.near is not None and first and self.near(frames, found):
            self.rounds = 0  # of the other blocks
            return True
        depth = found.depth[0]
        turn = float(viewpoint_turn(self.body.frames(depth, self.image[some])[:, :2]))
        if self.turned is None or self.body.is_odd(found) or turn < TURNING:
            return False
        other = (yield from self.turned(False))[:: self.stride][some]
        return agree(other, depth, AGREE)
