"""Limbs of known trunk: lengths and signs of depth of each chain of bones, by dynamic programming."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from kcs_torch.functional.temporal import window_starts
from kcs_torch.nn.posture import PostureEnergy, foreshortening
from kcs_torch.skeleton import Hinge, Skeleton
from kcs_torch.solvers.signs import SignPath, sign_table, smooth_signs

__all__ = ["Limb", "LimbPaths", "SignCosts", "limb_paths", "limbs_of", "waves"]

WINDOW, OVERLAP = 200, 40
"""Frames whose signs are found together, and by how many neighbouring windows overlap."""

SAMPLE = 4
"""Windows from which the lengths of a long clip's bones are chosen."""


@dataclass(frozen=True)
class Limb:
    """One or two bones beyond the trunk.

    Attributes:
        bones: their indices, from the trunk outwards.
        inner: the hinge between the two, or None.
        entry: the hinge between the bone before and the first one, or None.
        before: index of the bone before, where ``entry`` is given.
    """

    bones: tuple[int, ...]
    inner: Hinge | None
    entry: Hinge | None
    before: int


@dataclass(frozen=True)
class SignCosts:
    """Weights of the terms that choose lengths and signs; see :class:`kcs_torch.methods.pkc.objective.Objective`.

    Attributes:
        acceleration: standard deviation of a bone's second difference.
        cap: largest squared acceleration that counts, in variances.
        posture: frames that count as one for the posture.
        foreshortening: frames that count as one for the foreshortening.
        hinge: weight of a hinge in a frame.
        sine: sine of a wrong bend that costs half its weight.
        proportions: usual deviation of a length, as a share.
        over: by how much an image may exceed the length.
    """

    acceleration: float = 0.05
    cap: float = 18.0
    posture: float = 15.0
    foreshortening: float = 5.0
    hinge: float = 0.2
    sine: float = 0.05
    proportions: float = 0.08
    over: float = 0.004


def waves(limbs: Sequence[Limb]) -> list[list[Limb]]:
    """Limbs of as many bones each whose neighbours towards the trunk are in earlier waves."""
    level: dict[int, int] = {}
    out: dict[tuple[int, int], list[Limb]] = {}
    for limb in limbs:
        depth = level.get(limb.before, -1) + 1
        level |= dict.fromkeys(limb.bones, depth)
        out.setdefault((depth, len(limb.bones)), []).append(limb)
    return [out[key] for key in sorted(out)]


class LimbPaths(NamedTuple):
    """Lengths and signs of J limbs.

    Attributes:
        lengths: (J, M).
        depths: (J, T, M), signed.
        margins: (J, T, C), or None.
    """

    lengths: Tensor
    depths: Tensor
    margins: Tensor | None


def limbs_of(skeleton: Skeleton, trunk: list[int]) -> list[Limb]:
    """Chains of one or two bones that reach every joint beyond the trunk, nearer ones first; hinges join two bones."""
    bones = skeleton.bones
    arrives = {b: i for i, (_, b) in enumerate(bones)}
    order, queue = [], list(trunk)
    reached = set(trunk)
    while queue:
        joint = queue.pop(0)
        for i, (a, b) in enumerate(bones):
            if a == joint and b not in reached:
                order.append(i)
                reached.add(b)
                queue.append(b)
    done: set[int] = set()
    limbs = []
    for i in order:
        if i in done:
            continue
        a, b = bones[i]
        inner = next(
            (h for h in skeleton.hinges if (h.parent, h.joint) == (a, b) and arrives[h.child] not in done), None
        )
        entry = next((h for h in skeleton.hinges if (h.joint, h.child) == (a, b)), None)
        chain = (i,) if inner is None else (i, arrives[inner.child])
        done |= set(chain)
        limbs.append(Limb(chain, inner, entry, arrives.get(a, -1)))
    return limbs


def limb_paths(
    image: Tensor,
    limbs: Sequence[Limb],
    rotations: Tensor,
    posture: PostureEnergy,
    free: Tensor,
    costs: SignCosts,
    noise: Tensor,
    *,
    candidates: Tensor,
    transition: Tensor | None = None,
    before: Sequence[Tensor | None] | None = None,
    margins: bool = False,
) -> LimbPaths:
    """Choose limbs' lengths among candidates, and their signs of depth, given one or several paths of the trunk.

    Args:
        image: bones' images (T, B, 2), in units of the lengths.
        limbs: J limbs of M bones each.
        rotations: (C, T, 3, 3) of the trunk.
        posture: mean directions and spreads.
        free: (B,) 1 for bones that point anywhere.
        costs: weights.
        noise: (T, B) standard deviation of bones' images.
        candidates: lengths (J, K, M) to choose from.
        transition: (T - 1, C, C) cost of going from one trunk path to the other.
        before: (T, 3) direction of the bone before each limb, or None.
        margins: True also returns how much dearer the clip is if a frame takes the other trunk path.
    """
    frames = len(image)
    size = min(WINDOW, frames)
    starts = window_starts(frames, size, min(OVERLAP, size - 1))
    count, tried, _ = candidates.shape
    before = [None] * count if before is None else before

    def solve(lengths: Tensor, begin: list[int], margins: bool) -> tuple[SignPath, Tensor]:
        """Signs in W windows for J limbs of K lengths: window w of length k of limb j is problem (j K + k) W + w."""
        parts = [
            _unary(image, limb, rotations, posture, free, costs, noise, length, near)
            for limb, length, near in zip(limbs, lengths, before, strict=True)
        ]
        unary, depth = (torch.cat(part) for part in zip(*parts, strict=True))  # (J K, T, ...)
        at = torch.tensor(begin, device=image.device)[:, None] + torch.arange(size, device=image.device)  # (W, T_w)
        moves = None if transition is None else transition[at[:, :-1]].repeat(len(unary), 1, 1, 1)
        # Single precision is plenty to compare costs, and twice as fast.
        scaled = (depth[:, at].flatten(0, 1) / costs.acceleration).float()
        each = unary[:, at].flatten(0, 1).float()
        moves = None if moves is None else moves.float()
        return smooth_signs(each, scaled, cap=costs.cap, transition=moves, margins=margins), depth

    usual = torch.stack([posture.rest_lengths[list(limb.bones)] for limb in limbs]).to(image)  # (J, M)
    prior = 0.5 * ((candidates / usual[:, None]).log() / costs.proportions).square().sum(-1)  # (J, K)
    best = torch.zeros(count, dtype=torch.long, device=image.device)
    if tried > 1:
        sample = starts
        if len(starts) > SAMPLE:
            sample = [starts[round(i * (len(starts) - 1) / (SAMPLE - 1))] for i in range(SAMPLE)]
        path, _ = solve(candidates, sample, False)
        best = (path.cost.view(count, tried, -1).sum(-1) * (len(starts) / len(sample)) + prior).argmin(-1)
    limb_index = torch.arange(count, device=image.device)
    lengths = candidates[limb_index, best]  # (J, M)
    path, depth = solve(lengths[:, None], starts, margins)
    signs = torch.empty_like(depth)
    windows = path.signs.unflatten(0, (count, len(starts)))
    spread = image.new_empty(count, frames, len(rotations)) if margins else None
    for i, begin in enumerate(starts):
        first = 0 if i == 0 else (starts[i - 1] + size - begin) // 2
        signs[:, begin + first : begin + size] = windows[:, i, first:]
        if spread is not None and path.margins is not None:
            part = path.margins.unflatten(0, (count, len(starts)))[:, i, first:]
            spread[:, begin + first : begin + size] = part.amin(-1)
    return LimbPaths(lengths, signs * depth, spread)


def _unary(
    image: Tensor,
    limb: Limb,
    rotations: Tensor,
    posture: PostureEnergy,
    free: Tensor,
    costs: SignCosts,
    noise: Tensor,
    lengths: Tensor,
    before: Tensor | None,
) -> tuple[Tensor, Tensor]:
    """Costs (K, T, C, 2^M) of each frame's signs, and the depths |dz| (K, T, M)."""
    chain = list(limb.bones)
    flat = image[:, chain]
    square = lengths[:, None].square() - flat.square().sum(-1)  # (K, T, M)
    depth = square.clamp_min(0).sqrt()
    over = (-square).clamp_min(0) / (2 * lengths[:, None])
    each = (over.square() / (costs.over**2 + noise[:, chain].square())).clamp_max(20) / 2
    density = foreshortening(depth, lengths[:, None], 0.1) - 2 * posture.rest_lengths[chain].to(image).log()
    base = (each + free[chain].to(image) / costs.foreshortening * density).sum(-1)  # (K, T)
    signs = sign_table(len(chain), image)  # (S, M)
    unit = flat[None] / lengths[:, None, :, None]  # (K, T, M, 2)
    deep = depth / lengths[:, None]
    # Seen from the trunk a direction is R_xy^T (x, y) + R_z^T z: two parts that every state shares but for a sign.
    across = torch.einsum("ktmj,ctji->ktcmi", unit, rotations[..., :2, :])
    along = deep[:, :, None, :, None] * rotations[None, ..., None, 2, :].movedim(1, 2).expand(
        -1, -1, -1, len(chain), -1
    )  # (1->K, T, C, M, 3)
    mean, deviation = posture.mean[chain].to(image), posture.deviation[chain].to(image)
    a, b = (across - mean) / deviation, along / deviation
    still = (a.square() + b.square()).sum(-1)  # (K, T, C, M)
    swing = 2 * (a * b).sum(-1)
    fit = still.sum(-1)[..., None] + torch.einsum("ktcm,sm->ktcs", swing, signs)
    unary = base[:, :, None, None] + fit / (2 * costs.posture)
    full = lambda m: torch.cat(  # noqa: E731
        [unit[:, :, None, m].expand(-1, -1, len(signs), -1), (deep[..., m, None] * signs[:, m])[..., None]], -1
    )  # (K, T, S, 3)
    if limb.inner is not None:
        bend = torch.linalg.cross(full(0), full(1))
        unary = unary + _hinge_cost(bend, rotations, posture, limb.inner, costs)
    if limb.entry is not None and before is not None:
        first = full(0)
        bend = torch.linalg.cross(before[None, :, None].expand_as(first), first)
        unary = unary + _hinge_cost(bend, rotations, posture, limb.entry, costs)
    return unary, depth


def _hinge_cost(bend: Tensor, rotations: Tensor, posture: PostureEnergy, hinge: Hinge, costs: SignCosts) -> Tensor:
    """Cost (K, T, C, S) of bends u x v (K, T, S, 3) about the hinge's axis, which turns with the trunk."""
    axis = posture.rest[hinge.left] - posture.rest[hinge.right]
    lateral = rotations @ (axis / axis.norm()).to(rotations)  # (C, T, 3)
    wrong = (-hinge.sign * torch.einsum("ktsj,ctj->ktcs", bend, lateral)).clamp_min(0)
    return costs.hinge * hinge.firm / 2 * (wrong / costs.sine).square()
