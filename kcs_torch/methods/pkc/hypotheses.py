"""Solutions of one clip that may yet be right, and their refinement."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from kcs_torch.functional.chain import bone_vectors
from kcs_torch.functional.guarded import or_one
from kcs_torch.methods.clips.lockstep import Search
from kcs_torch.methods.pkc.objective import Objective
from kcs_torch.methods.pkc.refinement import Task

__all__ = ["Hypotheses", "combined", "distinct", "refined"]

APART = 0.25
"""Cosine of the sizes of two changes below which they have nothing to do with each other."""


@dataclass(frozen=True)
class Hypotheses:
    """Solutions of one clip, best first.

    Attributes:
        depth: (H, T, N), centred per frame, in units of the template.
        lengths: (H, B).
        energy: (H,) of the objective.
        steps: L-BFGS steps made for them.
        moved: (H,) root mean square change of the depths in the last ten steps; None before any.
        image: (T, N, 2) of the best one as polishing has it, where joints may leave what noisy tracks show; or None.
    """

    depth: Tensor
    lengths: Tensor
    energy: Tensor
    steps: int = 0
    moved: Tensor | None = None
    image: Tensor | None = None

    def __getitem__(self, index: slice | Tensor) -> Hypotheses:
        moved = None if self.moved is None else self.moved[index]
        return Hypotheses(self.depth[index], self.lengths[index], self.energy[index], self.steps, moved)

    def joined(self, other: Hypotheses) -> Hypotheses:
        """Both together, best first."""
        parts = zip(*((h.depth, h.lengths, h.energy) for h in (self, other)), strict=True)
        depth, lengths, energy = (torch.cat(part) for part in parts)
        moved = None if self.moved is None or other.moved is None else torch.cat([self.moved, other.moved])
        return Hypotheses(depth, lengths, energy, self.steps + other.steps, moved)[energy.argsort()]


def distinct(found: Hypotheses, count: int, apart: float) -> Hypotheses:
    """The best hypotheses whose depths differ by ``apart`` from each other (root mean square), at most ``count``."""
    keep: list[int] = []
    for k in range(len(found.energy)):
        if len(keep) == count:
            break
        far = [float((found.depth[k] - found.depth[j]).square().mean().sqrt()) for j in keep]
        if bool(torch.isfinite(found.energy[k])) and all(d > apart for d in far):
            keep.append(k)
    return found[torch.tensor(keep or [0], device=found.energy.device)]


def combined(found: Hypotheses, best: Hypotheses, gain: float, bones: Tensor) -> Hypotheses:
    """The best one with two changes at once: the one that gains most, and the next that has nothing to do with it.

    Args:
        found: it with a change each, best first.
        best: one hypothesis.
        gain: in energy, of each change at least.
        bones: (B, 2).

    Returns:
        One hypothesis, its energy if both gain as much together; or none, if there are no two such changes.
    """
    cheaper = found[found.energy < best.energy - gain]
    change = bone_vectors((cheaper.depth - best.depth)[..., None], bones).flatten(1).abs()
    other = (torch.cosine_similarity(change, change[:1]) < APART).nonzero()[:1, 0]
    (first, second), sizes = (cheaper[pick] for pick in (slice(len(other)), other)), or_one(best.lengths)
    return Hypotheses(
        first.depth + second.depth - best.depth,
        first.lengths * second.lengths / sizes,
        first.energy + second.energy - best.energy,
    )


def refined(objective: Objective, found: Hypotheses, steps: int, loose: float = 1.0) -> Search[Any, Any, Hypotheses]:
    """Hypotheses refined on the objective, best first."""
    (new,) = yield [Task(objective, found.depth, found.lengths, steps, loose)]
    return Hypotheses(new.depth, new.lengths, new.energy, found.steps + new.steps, new.moved)
