"""Runs of signs: a bone's depth may have the wrong sign from one passage through the image plane to another."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import combinations
from typing import Any

import torch
from torch import Tensor

from kcs_torch.functional.chain import bone_vectors
from kcs_torch.methods.clips.lockstep import Search
from kcs_torch.methods.pkc.hypotheses import Hypotheses, combined, refined
from kcs_torch.methods.pkc.limbs import Limb
from kcs_torch.methods.pkc.objective import Objective
from kcs_torch.methods.pkc.run_costs import ParallelRays, RunCosts, Runs, Turnable, inside
from kcs_torch.methods.pkc.strides import strides
from kcs_torch.methods.pkc.weights import HEAVY
from kcs_torch.skeleton import Skeleton

__all__ = ["flipped", "flipped_runs", "members", "parts_of", "promising", "signs_of", "turned_over"]

TIMES = 8
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

ROWS = 32768
"""Frames of flips whose feet are looked at at a time."""

PASSAGES, ACROSS = 16, 2
"""Passages of a part that are considered, those where a change of sign bends its motion least, and how many of them a
run within the clip may be long."""

WINDOW = 2
"""Frames on either side in which nothing bends the motion less than a change of sign at the passage."""

SHARP = 3.0
"""Cost of the bends at a run's ends from which on a flip is hopeless."""

STRIDES = 3
"""Ways in which legs may stride that are refined."""

SLIGHT = 0.006
"""Root mean square depth that a flip has to change, a standing person being about 1.75 tall."""


def parts_of(skeleton: Skeleton, limbs: Sequence[Limb]) -> list[tuple[int, ...]]:
    """Bones whose signs change together: of limbs, with their twins; the trunk's long and cross bones; all."""
    twins = {b for pair in skeleton.mirror_bones for b in pair}
    outer = {b for limb in limbs for b in limb.bones}
    trunk = [b for b in range(skeleton.num_bones) if b not in outer]
    along, across = tuple(b for b in trunk if b not in twins), tuple(b for b in trunk if b in twins)
    central = tuple(b for b in range(skeleton.num_bones) if b not in twins)
    parts = [part for limb in limbs for part in (*((b,) for b in limb.bones), limb.bones)]
    parts += [along, across, along + across, central, *skeleton.mirror_bones, *((b,) for b in trunk)]
    twin = {a: b for pair in skeleton.mirror_bones for a, b in (pair, pair[::-1])}
    long = [limb.bones for limb in limbs if len(limb.bones) > 1]
    parts += [tuple(sorted({*bones, *(twin.get(b, b) for b in bones)})) for bones in long]
    parts.append(tuple(range(skeleton.num_bones)))
    return [part for part in dict.fromkeys(parts) if part]


def turned_over(
    objective: Objective, parts: Sequence[tuple[int, ...]], found: Hypotheses, steps: int
) -> Search[Any, Any, Hypotheses]:
    """Hypotheses, best first, whose best one no flip of a run makes better; ``steps`` as in a refinement.

    The flips that cost little more are among them: they are what else the motion may have been. Two that gain are tried
    together, too, which takes fewer rounds where several runs are wrong.
    """
    for _ in range(TIMES):
        best, gain = found[:1], found.energy[0] - GAIN
        tried = flipped(objective, parts, best)
        before = tried.steps
        for limits, count in ((FIRST, max(steps // 3, 1)), (THEN, steps)):
            tried = tried[promising(tried, best, limits)]
            if not len(tried.energy):
                return found
            tried = yield from refined(objective, tried, count)
            if limits is FIRST:
                tried = tried.joined(combined(tried, best, GAIN, objective.bones))
        if not bool(tried.energy[0] < gain):  # what has far to go may get there yet
            assert tried.moved is not None
            far = (_change(tried, best) > LARGE) & (tried.energy < best.energy + NEAR) & (tried.moved > MOVING)
            rivals = found.joined(replace(tried[tried.energy >= best.energy], steps=tried.steps - before))
            if not bool(far.any()):
                return rivals
            tried = yield from refined(objective, tried[far], steps)
        if not bool(tried.energy[0] < gain):
            return rivals
        found = found.joined(replace(tried[:1], steps=tried.steps - before))
    return found


def promising(
    flips: Hypotheses, best: Hypotheses, limits: tuple[tuple[float, int], tuple[float, int]] = FIRST
) -> Tensor:
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


def flipped(
    objective: Objective, parts: Sequence[tuple[int, ...]], best: Hypotheses, body: Turnable | None = None
) -> Hypotheses:
    """The best flips of one run of a solution, at most one a part, best first; they are not refined yet.

    Args:
        objective: of one clip.
        parts: bones whose signs change together.
        best: the solution.
        body: the same, if it is not seen along parallel rays.
    """
    if body is None:
        body = ParallelRays(objective, _one_sided(objective, best))
    own = body.own
    member = members(parts, own)
    runs = flipped_runs(own, member, objective.weights.acceleration)
    energy = RunCosts(objective, body, best.lengths[0])(member, runs)
    energy += objective.volume(best.depth, best.lengths)  # turning over changes no depth's size

    def depths(some: Tensor) -> Tensor:
        return body.turned(signs_of(runs.some(some), member, len(own))).depth

    if objective.standing is not None:  # contacts only add to the cost: what is hopeless without them stays so
        walks = objective.carries(member)[runs.part]
        energy[~walks] += objective.contact(best.depth)
        near = (walks & (energy < best.energy + FIRST[0][0])).nonzero().flatten()
        for some in near.split(max(1, ROWS // len(own))):  # all of them would for long blocks take much memory
            energy[some] += objective.contact(depths(some))
    order = energy.argsort()
    owner = runs.part[order].tolist()
    order = order[[k for k, part in enumerate(owner) if part not in owner[:k]]]
    found = Hypotheses(depths(order), best.lengths.expand(len(order), -1), energy[order], best.steps)
    if objective.standing is None or not objective.noisy:  # of exact images the motion tells where bones pass the plane
        return found
    return found.joined(_strides(objective, body, member, runs, best))


def _one_sided(objective: Objective, best: Hypotheses) -> Tensor:
    """Depths (T, B) of the best solution's bones, as long as their bones are in frames that lie between two signs.

    Where a sign jumps away from the image plane, descent leaves a frame in the middle, in which the bone is far too
    short and points neither way: it would hide that the motion is smooth if all that follows is turned over.
    """
    own = bone_vectors(best.depth[0, ..., None], objective.bones)[..., 0]
    square, lengths = own.square(), best.lengths[0]
    whole = lengths.square() - objective.flat
    short = (whole - square) / (2 * lengths) > (HEAVY / objective.precision(best.lengths[:1])[0]).sqrt()
    short[1:-1] &= own[:-2] * own[2:] < 0
    short[[0, -1]] = False
    return torch.where(short, torch.copysign(whole.clamp_min(0).sqrt(), own), own)


def _strides(objective: Objective, body: Turnable, member: Tensor, runs: Runs, best: Hypotheses) -> Hypotheses:
    """The best solution with other runs of its legs, by which feet stand; the best few, not refined yet."""
    bend = _bends(body.own, member.mT) / (2 * objective.weights.acceleration**2)
    turned = body.turned(strides(objective, body.own, member, runs.places, bend))
    count = len(turned.depth)
    made = Hypotheses(turned.depth, best.lengths.expand(count, -1), best.energy.expand(count))
    if not count:
        return made
    image = None if turned.image is objective.image else turned.image
    terms = objective.terms(made.depth, made.lengths, image)
    terms["foreshortening"] = turned.foreshortened(objective, best.lengths[0]).sum(1)
    energy = torch.stack(list(terms.values())).sum(0) + objective.ranking(made.depth, made.lengths)
    made = replace(made, energy=energy)
    made = made[_change(made, best) > SLIGHT]
    return made[made.energy.argsort()[:STRIDES]]


def signs_of(runs: Runs, member: Tensor, frames: int) -> Tensor:
    """Signs (K, T, B), -1 over runs of frames for the bones that are members (P, B) of their parts."""
    return 1 - 2 * inside(runs, frames).to(member)[..., None] * member[runs.part][:, None]


def members(parts: Sequence[tuple[int, ...]], depth: Tensor) -> Tensor:
    """1 for the bones of each part, (P, B), of depths (T, B)."""
    member = depth.new_zeros(len(parts), depth.shape[1])
    for row, part in zip(member, parts, strict=True):
        row[list(part)] = 1
    return member


def flipped_runs(depth: Tensor, member: Tensor, acceleration: float) -> Runs:
    """Runs of frames over which signs may be wrong.

    They are from a passage to one of the next, from the clip's start to a passage, from there to its end, or the whole
    clip. Those that would bend the motion too much, or change hardly anything, are left out.

    Args:
        depth: (T, B) depths of the bones.
        member: (P, B), 1 for the bones of each part.
        acceleration: standard deviation of a bone's second difference in depth.
    """
    bend = _bends(depth, member.mT) / (2 * acceleration**2)
    runs = _runs(bend)
    part, starts, ends = runs.part, runs.starts, runs.ends
    costs = torch.nn.functional.pad(bend, (0, 1))  # to the end of the clip nothing bends
    sharp = costs[part, starts] + costs[part, ends]
    size = torch.nn.functional.pad((depth.square() @ member.mT).cumsum(0), (0, 0, 1, 0))  # (T + 1, P)
    change = 4 * (size[ends, part] - size[starts, part]) / depth.numel()
    return runs.some((sharp < SHARP) & (change > SLIGHT**2))


def _bends(depth: Tensor, member: Tensor) -> Tensor:
    """By how much parts' squared second differences grow if signs change from a frame on, (P, T).

    Of a sum (s_0 d_0 - 2 s_1 d_1 + s_2 d_2)^2 only the products across the change matter; where signs jumped there, the
    sum shrinks.

    Args:
        depth: (T, B).
        member: (B, P), 1 for a part's bones.
    """
    out = depth.new_zeros(len(depth), member.shape[1])
    near, over = 8 * (depth[1:] * depth[:-1]) @ member, 4 * (depth[2:] * depth[:-2]) @ member
    out[2:] += near[1:] - over
    out[1:-1] += near[:-1] - over
    return out.mT


def _runs(bend: Tensor) -> Runs:
    """Runs between the frames from which on signs change most cheaply, of what it bends (P, T)."""
    parts, frames = bend.shape
    ends = torch.full((parts, 1), frames, device=bend.device)
    places = [torch.zeros_like(ends), ends]
    if frames > 2 * WINDOW:
        wide = torch.nn.functional.pad(bend[:, None], (WINDOW, WINDOW), mode="replicate")
        least = -torch.nn.functional.max_pool1d(-wide, 2 * WINDOW + 1, 1)[:, 0]
        passes = (bend <= least) & (bend < SHARP)
        passes[:, :WINDOW] = passes[:, frames - WINDOW + 1 :] = False
        value, place = torch.where(passes, bend, torch.inf).topk(min(PASSAGES, frames), largest=False)
        places.insert(1, torch.where(value < torch.inf, place, frames).sort(1).values)
    at = torch.cat(places, 1)  # (P, passages + 2)
    last = at.shape[1] - 1
    pairs = [(i, j) for i, j in combinations(range(last + 1), 2) if j <= i + ACROSS or i == 0 or j == last]
    first, second = torch.tensor(pairs, device=bend.device).T.expand(parts, 2, -1).unbind(1)  # (P, pairs) each
    start, end = at.gather(1, first), at.gather(1, second)
    # Passages that there are not lie at the end: the clip's end is the last place only.
    real = (end - start >= min(2, frames)) & ((second == last) | (end < frames))
    part = torch.arange(parts, device=bend.device)[:, None].expand_as(first)
    return Runs(at, part[real], first[real], second[real])
