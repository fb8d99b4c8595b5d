"""A body whose size in the image changes: whether that is believed, and what it makes of an estimate."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from kcs_torch.methods.base import Estimate
from kcs_torch.methods.clips.lockstep import Search
from kcs_torch.methods.clips.size import Size
from kcs_torch.methods.pkc.blocks import search
from kcs_torch.methods.pkc.body import Body
from kcs_torch.methods.pkc.hypotheses import Hypotheses, refined

__all__ = ["TRIED", "resized", "with_size"]

TRIED, AT_ONCE = 1.012, 1.04
"""Largest over smallest size in the image from which on a change of size is tried, and from which on by a new search at
once."""

BETTER, HOPEFUL, FEW = 5.0, 2.5, 2
"""By how much the objective must fall for a change of size to be believed; by how much, if hypotheses are refined with
it, for a new search to be made; and how many are."""


def resized(
    found: Hypotheses, body: Body, other: Body, size: Size, rounds: int, steps: int
) -> Search[Any, Any, Hypotheses | None]:
    """Hypotheses of a body whose size in the image changes, if they explain the tracks better; else None.

    A small change is tried on what was found without it first.

    Args:
        found: best first, of the body whose size does not change.
        body: that one.
        other: the same body, its image divided by the size.
        size: over time.
        rounds: of discrete moves of a new search.
        steps: of each refinement.
    """
    even = torch.ones_like(size.path)
    # Energies compare as those of the tracks themselves, in which both images have one size.
    before = found.energy[0] + body.objective.drawn(even / body.factor)
    before = before - other.objective.drawn(size.path / other.factor)
    if size.range < AT_ONCE:
        ratio = other.factor / body.factor
        few = found[:FEW]
        start = replace(few, depth=few.depth * ratio / size.path[:, None], lengths=few.lengths * ratio)
        tried = yield from refined(other.objective, start, steps)
        if not bool(tried.energy[0] < before - HOPEFUL):
            return None
    new = yield from search(other, rounds, steps)
    return new if bool(new.energy[0] < before - BETTER) else None


def with_size(found: Estimate, size: Size) -> Estimate:
    """An estimate of tracks that were divided by the size over time."""
    note = f"weak perspective: the body's size in the image varies by a factor of {size.range:.2f}"
    others = tuple(_scaled(other, size.path, note) for other in found.alternatives)
    return replace(_scaled(found, size.path, note), alternatives=others)


def _scaled(found: Estimate, size: Tensor, note: str) -> Estimate:
    return replace(found, scales=found.scales * size, notes=(*found.notes, note))
