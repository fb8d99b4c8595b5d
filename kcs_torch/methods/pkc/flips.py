"""Runs of signs: a bone's depth may have the wrong sign from one passage through the image plane to another."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import combinations
from typing import Any

import torch
from torch import Tensor

from kcs_torch.functional.chain import bone_vectors
from kcs_torch.methods.lockstep import Search
from kcs_torch.methods.pkc.descent import Descent
from kcs_torch.methods.pkc.hypotheses import Hypotheses, refined
from kcs_torch.methods.pkc.limbs import Limb
from kcs_torch.methods.pkc.objective import Objective
from kcs_torch.skeleton import Skeleton

__all__ = ["flipped", "flipped_runs", "parts_of", "turned_over"]

TIMES = 6
"""How often flips are tried at most."""

GAIN = 0.3
"""How much cheaper a solution has to be to count as better."""

LARGE = 0.02
"""Root mean square depth from which on a flip leads to another body rather than to another arm for a while: it may
cost more at first, and takes longer to settle. A standing person is about 1.75 tall."""

NEAR, MOVING = 2.5, 1e-3
"""Large flips go on where they cost little more than the best, and the last ten steps moved depths by so much."""

FIRST, THEN = ((15.0, 6), (5.0, 4)), ((5.0, 2), (GAIN, 1))
"""How much dearer than the best large flips may be, and small ones, and how many of each are refined: at first, and
then well."""

ROWS = 4096
"""Frames of flips that are compared at a time."""

FLAT = 0.4
"""Depth, as a share of a part's length, below which it may have bounced off the image plane, or passed through it."""

PASSAGES = 4
"""Passages of a part that are considered, those nearest to the image plane."""

WINDOW = 2
"""Frames on either side to which a passage is the nearest."""

SHARP = 15.0
"""Cost of the bend at a run's ends from which on a flip is hopeless."""

SLIGHT = 0.006
"""Root mean square depth that a flip has to change, a standing person being about 1.75 tall."""


def parts_of(skeleton: Skeleton, limbs: Sequence[Limb]) -> list[tuple[int, ...]]:
    """Bones whose signs change together: of limbs each, both, and their twins; the trunk's long and cross bones."""
    twins = {b for pair in skeleton.mirror_bones for b in pair}
    outer = {b for limb in limbs for b in limb.bones}
    trunk = [b for b in range(skeleton.num_bones) if b not in outer]
    along, across = tuple(b for b in trunk if b not in twins), tuple(b for b in trunk if b in twins)
    central = tuple(b for b in range(skeleton.num_bones) if b not in twins)
    parts = [part for limb in limbs for part in (*((b,) for b in limb.bones), limb.bones)]
    parts += [along, across, along + across, central, *skeleton.mirror_bones]
    return [part for part in dict.fromkeys(parts) if part]


def turned_over(
    objective: Objective, parts: Sequence[tuple[int, ...]], found: Hypotheses, steps: int
) -> Search[Any, Any, Hypotheses]:
    """Hypotheses, best first, whose best one no flip of a run makes better; ``steps`` as in a refinement."""
    for _ in range(TIMES):
        best, gain = found[:1], found.energy[0] - GAIN
        tried = flipped(objective, parts, best)
        before = tried.steps
        for limits, count in ((FIRST, max(steps // 3, 1)), (THEN, steps)):
            tried = tried[_promising(tried, best, limits)]
            if not len(tried.energy):
                return found
            tried = yield from refined(objective, tried, count)
        if not bool(tried.energy[0] < gain):  # what has far to go may get there yet
            assert tried.moved is not None
            tried = tried[(_change(tried, best) > LARGE) & (tried.energy < best.energy + NEAR) & (tried.moved > MOVING)]
            if not len(tried.energy):
                return found
            tried = yield from refined(objective, tried, steps)
        if not bool(tried.energy[0] < gain):
            return found
        found = found.joined(replace(tried[:1], steps=tried.steps - before))
    return found


def _promising(flips: Hypotheses, best: Hypotheses, limits: tuple[tuple[float, int], tuple[float, int]]) -> Tensor:
    """Indices of the large flips, and of the small ones, that cost little more than the best; so many of each."""
    large, dearer = _change(flips, best) > LARGE, flips.energy - best.energy
    some = [
        (kind & (dearer < most)).nonzero().flatten()[:count]
        for kind, (most, count) in zip((large, ~large), limits, strict=True)
    ]
    return torch.cat(some)


def _change(flips: Hypotheses, best: Hypotheses) -> Tensor:
    """Root mean square depth (H,) by which flips differ from the best."""
    return (flips.depth - best.depth).square().mean((1, 2)).sqrt()


def flipped(objective: Objective, parts: Sequence[tuple[int, ...]], best: Hypotheses) -> Hypotheses:
    """The best flips of one run of a solution, at most one a part, best first; they are not refined yet."""
    own = bone_vectors(best.depth[0, ..., None], objective.bones)[..., 0]
    runs, which = flipped_runs(own, best.lengths[0], parts, objective.weights.acceleration)
    cost, some = Descent(objective), runs.mT.contiguous().split(max(1, ROWS // len(own)))
    energy = torch.cat([cost.at(run, best.lengths.expand(len(run), -1), steep=False)[0] for run in some])
    order = energy.argsort()
    owner = which[order].tolist()
    order = order[[k for k, part in enumerate(owner) if part not in owner[:k]]]
    depth = runs[order] @ objective.tree.to(own).mT
    depth = depth - depth.mean(-1, keepdim=True)
    return Hypotheses(depth, best.lengths.expand(len(order), -1), energy[order], best.steps)


def flipped_runs(
    depth: Tensor, lengths: Tensor, parts: Sequence[tuple[int, ...]], acceleration: float
) -> tuple[Tensor, Tensor]:
    """Bones' depths with the sign of one part changed over one run of frames, and which part it is.

    Runs are from one passage to the next, from the clip's start to a passage, from there to its end, or the whole clip.
    Those that would bend the motion too much, or change hardly anything, are left out.

    Args:
        depth: (T, B) depths of the bones.
        lengths: (B,).
        parts: indices of bones.
        acceleration: standard deviation of a bone's second difference in depth.

    Returns:
        (K, T, B) and (K,).
    """
    frames, bones = depth.shape
    member = depth.new_zeros(len(parts), bones)
    for row, part in zip(member, parts, strict=True):
        row[list(part)] = 1
    starts, ends, which = _runs(((depth.square() @ member.mT) / (lengths.square() @ member.mT)).mT.sqrt())
    time = torch.arange(frames, device=depth.device)
    sign = 1 - 2 * ((time >= starts[:, None]) & (time < ends[:, None])).to(depth)  # (K, T)
    own = member[which]
    # Second differences only change about a run's ends: (s_0 d_0 - 2 s_1 d_1 + s_2 d_2)^2 less the same without signs.
    near, far = 1 - sign[:, 1:] * sign[:, :-1], 1 - sign[:, 2:] * sign[:, :-2]
    next_to, over = own @ (depth[1:] * depth[:-1]).mT, own @ (depth[2:] * depth[:-2]).mT
    both = near[:, :-1] * next_to[:, :-1] + near[:, 1:] * next_to[:, 1:]
    bend = (4 * both - 2 * far * over).sum(1) / (2 * acceleration**2)
    change = 2 * (((1 - sign) @ depth.square()) * own).sum(1) / (frames * bones)
    keep = (bend < SHARP) & (change > SLIGHT**2)
    signs = 1 + (sign[keep] - 1)[..., None] * own[keep][:, None]
    return depth * signs, which[keep]


def _runs(near: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Starts, ends and parts (K,) of runs between the least of parts' depths over their lengths (P, T)."""
    parts, frames = near.shape
    ends = torch.full((parts, 1), frames, device=near.device)
    places = [torch.zeros_like(ends), ends]
    if frames > 2 * WINDOW:
        wide = torch.nn.functional.pad(near[:, None], (WINDOW, WINDOW), mode="replicate")
        least = -torch.nn.functional.max_pool1d(-wide, 2 * WINDOW + 1, 1)[:, 0]
        passes = (near <= least) & (near < FLAT)
        passes[:, :WINDOW] = passes[:, frames - WINDOW :] = False
        value, place = torch.where(passes, near, torch.inf).topk(min(PASSAGES, frames), largest=False)
        places.insert(1, torch.where(value < torch.inf, place, frames).sort(1).values)
    at = torch.cat(places, 1)  # (P, passages + 2)
    last = at.shape[1] - 1
    runs = [(i, j) for i, j in combinations(range(last + 1), 2) if j == i + 1 or i == 0 or j == last]
    first, second = (at[:, list(side)] for side in zip(*runs, strict=True))
    closes = torch.tensor([j == last for _, j in runs], device=near.device)
    real = (first < second) & (closes | (second < frames))  # passages that there are not lie at the end
    which = torch.arange(parts, device=near.device)[:, None].expand_as(first)
    return first[real], second[real], which[real]
