"""Limbs of known trunk: lengths and signs of depth of each chain of bones, by dynamic programming."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from kcs_torch.functional.temporal import window_starts
from kcs_torch.nn.lengths import foreshortening
from kcs_torch.nn.posture import PostureEnergy
from kcs_torch.skeleton import Hinge, Skeleton
from kcs_torch.solvers.signs import sign_costs, smooth_signs

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
        rotations: (C, T, 3, 3) of the trunk, or (J, C, T, 3, 3) of the trunk that each limb belongs to.
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

    each_trunk = rotations if rotations.ndim == 5 else rotations.expand(count, *rotations.shape)

    def problems(lengths: Tensor, begin: list[int]) -> tuple[Tensor, Tensor, Tensor | None, Tensor]:
        """W windows of J limbs of K lengths: window w of length k of limb j is problem (j K + k) W + w."""
        parts = [
            _unary(image, limb, turned, posture, free, costs, noise, length, near)
            for limb, turned, length, near in zip(limbs, each_trunk, lengths, before, strict=True)
        ]
        unary, depth = (torch.cat(part, -1) for part in zip(*parts, strict=True))  # (T, ..., J K)
        at = torch.tensor(begin, device=image.device) + torch.arange(size, device=image.device)[:, None]  # (T_w, W)

        def cut(values: Tensor) -> Tensor:
            """(T, ..., J K) as (J K W, T_w, ...), in memory with the problems last."""
            return values[at].movedim(1, -1).flatten(-2).movedim(-1, 0)

        moves = None if transition is None else transition.float()[at[:-1].mT].repeat(unary.shape[-1], 1, 1, 1)
        # Single precision is plenty to compare costs, and twice as fast.
        return cut(unary.float()), cut((depth / costs.acceleration).float()), moves, depth

    usual = torch.stack([posture.rest_lengths[list(limb.bones)] for limb in limbs]).to(image)  # (J, M)
    prior = 0.5 * ((candidates / usual[:, None]).log() / costs.proportions).square().sum(-1)  # (J, K)
    best = torch.zeros(count, dtype=torch.long, device=image.device)
    if tried > 1:
        sample = starts
        if len(starts) > SAMPLE:
            sample = [starts[round(i * (len(starts) - 1) / (SAMPLE - 1))] for i in range(SAMPLE)]
        unary, deep, moves, _ = problems(candidates, sample)
        cost = sign_costs(unary, deep, cap=costs.cap, transition=moves).view(count, tried, -1).sum(-1)
        best = (cost * (len(starts) / len(sample)) + prior).argmin(-1)
    limb_index = torch.arange(count, device=image.device)
    lengths = candidates[limb_index, best]  # (J, M)
    unary, deep, moves, depth = problems(lengths[:, None], starts)
    path = smooth_signs(unary, deep, cap=costs.cap, transition=moves, margins=margins)
    depth = depth.movedim(-1, 0)  # (J, T, M)
    signs = torch.empty_like(depth)
    windows = path.signs.unflatten(0, (count, len(starts)))
    spread = image.new_empty(count, frames, each_trunk.shape[1]) if margins else None
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
    """Costs (T, C, 2^M, K) of each frame's signs, and the depths |dz| (T, M, K)."""
    chain = list(limb.bones)
    flat, size = image[:, chain], lengths.mT  # (T, M, 2), (M, K)
    square = size.square() - flat.square().sum(-1)[..., None]  # (T, M, K)
    depth = square.clamp_min(0).sqrt()
    over = (-square).clamp_min_(0) / (2 * size)
    each = (over.square_() / (costs.over**2 + noise[:, chain].square())[..., None]).clamp_max_(20) / 2
    density = foreshortening(depth, size, 0.1) - 2 * posture.rest_lengths[chain].to(image).log()[:, None]
    base = (each + (free[chain].to(image) / costs.foreshortening)[:, None] * density).sum(1)  # (T, K)
    over_size = 1 / size
    deep = depth * over_size
    # Seen from the trunk a direction is a/L + s b z/L, with the image's part a = R_xy^T (x, y) and b = R_z. Its squared
    # distance from the mean, in deviations, takes sums over the three coordinates that no length changes.
    turned = rotations.movedim(1, 0)  # (T, C, 3, 3)
    across = flat[:, None] @ turned[..., :2, :]  # (T, C, M, 3)
    along = turned[..., 2:, :]  # (T, C, 1, 3)
    mean, weight = posture.mean[chain].to(image), posture.deviation[chain].to(image).square().reciprocal()
    pull = across * weight
    still = (pull * across).sum(-1) @ over_size.square() - 2 * ((pull * mean).sum(-1) @ over_size)
    still = still + (mean.square() * weight).sum() + (along.square() * weight).sum(-1) @ deep.square()  # (T, C, K)
    swing = (pull * along).sum(-1)[..., None] * over_size - (mean * along * weight).sum(-1)[..., None]
    fit = _signed((2 * swing * deep[:, None]).unbind(2))
    unary = base[:, None, None] + (still[:, :, None] + fit) / (2 * costs.posture)
    if limb.inner is not None:
        lateral = _lateral(turned, posture, limb.inner)
        inner = over_size[0] * over_size[1]
        level, tip, root = _triple_parts(flat[:, None, 0], flat[:, None, 1], lateral)
        sines = _signed((tip * (deep[:, 0] * over_size[1])[:, None], root * (deep[:, 1] * over_size[0])[:, None]))
        unary = unary + _hinge_cost(sines + (level * inner)[:, :, None], limb.inner, costs)
    if limb.entry is not None and before is not None:
        lateral = _lateral(turned, posture, limb.entry)
        level, tip, root = _triple_parts(before[:, None, :2], flat[:, None, 0], lateral)
        level = (level + before[:, None, 2:] * tip) * over_size[0]
        none = [torch.zeros_like(level)] * (len(chain) - 1)
        sines = _signed((root * deep[:, None, 0], *none)) + level[:, :, None]
        unary = unary + _hinge_cost(sines, limb.entry, costs)
    return unary, depth


def _signed(parts: Sequence[Tensor]) -> Tensor:
    """Sums of s_1 p_1 + .. + s_M p_M over all signs, (T, C, 2^M, K), in the order of sign_table."""
    total = torch.stack([parts[0], -parts[0]], 2)
    for part in parts[1:]:
        total = (total[:, :, :, None] + torch.stack([part, -part], 2)[:, :, None]).flatten(2, 3)
    return total


def _lateral(turned: Tensor, posture: PostureEnergy, hinge: Hinge) -> Tensor:
    """The hinge's axis (T, C, 3), which turns with the trunk."""
    axis = posture.rest[hinge.left] - posture.rest[hinge.right]
    return turned @ (axis / axis.norm()).to(turned)


def _triple_parts(first: Tensor, second: Tensor, axis: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """k, p, q of (u x v) . a = k + u_z p + v_z q, (..., 1) each, of images u, v (..., 2) and axes a (..., 3)."""
    (ux, uy), (vx, vy), (ax, ay, az) = (v.split(1, -1) for v in (first, second, axis))
    return az * (ux * vy - uy * vx), vx * ay - vy * ax, uy * ax - ux * ay


def _hinge_cost(sines: Tensor, hinge: Hinge, costs: SignCosts) -> Tensor:
    """Cost of the sines of a hinge's bends, elementwise."""
    wrong = (-hinge.sign * sines).clamp_min(0)
    return costs.hinge * hinge.firm / 2 * (wrong / costs.sine).square()
