"""Runs of signs before a viewpoint that goes round the body, judged by aligned bones: they tell signs best there."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from kcs_torch.functional.chain import bone_vectors
from kcs_torch.methods.clips.lockstep import Search
from kcs_torch.methods.pkc.body import LONG, ONE, POLISH, Body, agree
from kcs_torch.methods.pkc.flips import GAIN, flipped_runs, members, parts_of, signs_of
from kcs_torch.methods.pkc.hypotheses import Hypotheses, combined
from kcs_torch.methods.pkc.limbs import limbs_of
from kcs_torch.methods.pkc.run_costs import ParallelRays, RunCosts
from kcs_torch.solvers.procrustean import COARSE, FINE, align_rotations, motion_energy

__all__ = ["turned_around"]

AGREE = 0.09
"""Root mean square difference, over the depths', of what was found and what the viewpoint's turn tells, up to which
each confirms the other."""

TIMES, COUNT, EACH = 6, 8, 2
"""How often flips are tried at most, how many at a time, and how many of one part of the body."""

UNLIKELY, DEARER = 10.0, 15.0
"""By how much a flip may be dearer for the template, and in all, before it has settled."""

JUDGED = (replace(COARSE[-1], num_steps=10), replace(FINE[0], num_steps=20))
"""Stages in which flips settle: how aligned bones lie, then how they change."""

ROWS = 16384
"""Frames of flips whose aligned bones are looked at together."""


def turned_around(body: Body, found: Hypotheses, other: Tensor) -> Search[Any, Any, Hypotheses]:
    """Hypotheses whose best one no flip of a run makes better, for aligned bones and the template together.

    To the template a thigh that swings back is as usual as one that swings forth. Aligned bones of a body that is seen
    from around tell them apart: they lie on few dimensions only where signs are right.

    Args:
        body: of a clip in which :meth:`Body.turns`.
        found: hypotheses, the best one polished.
        other: depths (T, N) that the viewpoint's turn tells by itself; if they confirm the best one nothing is tried.
    """
    best = found.depth[0]
    if len(best) > LONG or agree(other, best, AGREE):
        return found
    first = now = yield from _settled(body, found.depth[:1])
    for _ in range(TIMES):
        flips = _flips(body, now)
        if not len(flips):
            break
        tried = yield from _settled(body, flips)
        both = combined(tried, now, GAIN, body.objective.bones)
        if len(both.depth):
            tried = tried.joined((yield from _settled(body, both.depth)))
        if not bool(tried.energy[0] < now.energy[0] - GAIN):
            break
        now = tried[:1]
    if now is first:
        return found
    depth, image, _ = yield from body.descended(now.depth, POLISH)
    return replace(
        found,
        depth=torch.cat([depth, found.depth[1:]]),
        lengths=torch.cat([body.lengths(depth), found.lengths[1:]]),
        image=None if image is None else image[0],
    )


def _settled(body: Body, depth: Tensor) -> Search[Any, Any, Hypotheses]:
    """Depths (K, T, N) after some steps, by what they cost for the template and aligned bones, best first."""
    objective = body.objective
    depth, _, value = yield from body.descended(depth, JUDGED)
    lengths = body.lengths(depth)
    cost = objective(depth, lengths) + objective.ranking(depth, lengths) + value / ONE
    return Hypotheses(depth, lengths, cost)[cost.argsort()]


def _flips(body: Body, now: Hypotheses) -> Tensor:
    """Depths (K, T, N) of a solution's flips that are worth trying, the cheapest first; they have not settled yet."""
    objective, bones = body.objective, body.objective.bones
    own = bone_vectors(now.depth[0, ..., None], bones)[..., 0]
    parts = parts_of(body.skeleton, limbs_of(body.skeleton, objective.posture.trunk.tolist()))
    member = members(parts, own)
    runs = flipped_runs(own, member, objective.weights.acceleration)
    cost = RunCosts(objective, ParallelRays(objective, own), now.lengths[0])(member, runs)
    cost = cost - objective(now.depth, now.lengths)
    likely = (cost < UNLIKELY).nonzero().flatten()
    size = body.image.square().mean().sqrt()
    rotations = align_rotations(body.joints(now.depth) / size, body.frames(now.depth[0])[None], bones)

    def flipped(some: Tensor) -> Tensor:
        return objective.joints(own * signs_of(runs.some(some), member, len(own)))

    def aligned(depth: Tensor) -> Tensor:
        return motion_energy(body.joints(depth) / size, rotations, bones, JUDGED[0])

    each = [aligned(flipped(some)) for some in likely.split(max(1, ROWS // len(own)))]
    cost = cost[likely] + (torch.cat(each) - aligned(now.depth)) / ONE
    order = likely[cost.argsort()[: int((cost < DEARER).sum())]]
    owner = runs.part[order].tolist()
    order = order[[k for k, part in enumerate(owner) if owner[:k].count(part) < EACH]]
    return flipped(order[:COUNT])
