"""Angles that a chain of bones keeps: the outer ends of two bones that meet stay as far apart as they are."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from kcs_torch.solvers.bone_paths import BonePaths
from kcs_torch.solvers.procrustean import steadiness

__all__ = ["Corners", "agreeing_paths", "corners_of"]


class Corners(NamedTuple):
    """P pairs of bones that meet at a joint.

    Attributes:
        bones: (P, 2) their numbers, ascending.
        sense: (P,) 1 where one goes on where the other ends, -1 where both start or both end there.
        ends: (P, 2) the joints at their other ends.
    """

    bones: Tensor
    sense: Tensor
    ends: Tensor


def corners_of(bones: Tensor) -> Corners:
    """All pairs of bones (B, 2) that share one joint."""
    pairs = bones.tolist()
    met = [
        (i, j, 1 if pairs[i][0] == other[1] or pairs[i][1] == other[0] else -1, *sorted({*pairs[i]} ^ {*other}))
        for j, other in enumerate(pairs)
        for i in range(j)
        if len({*pairs[i]} & {*other}) == 1
    ]
    table = bones.new_tensor(met).reshape(-1, 5)
    return Corners(table[:, :2], table[:, 2], table[:, 3:])


def agreeing_paths(
    paths: BonePaths, flat: Tensor, corners: Corners, count: int, *, worth: float, stiffness: float, slack: float
) -> Tensor:
    """Combinations of bones' paths, each before or behind the image plane, that keep most angles; best first.

    Where two bones meet at a fixed angle, as a robot's links often do, only the right paths keep their outer ends at
    one distance, wherever the camera is. A combination costs ``worth`` times what its paths do by themselves, and what
    :func:`kcs_torch.solvers.procrustean.length_energy` says of these distances. Bones are added one after another, and
    the best combinations go on.

    Args:
        paths: of B bones over T frames.
        flat: (B, T, 2) the bones' images.
        corners: where bones meet.
        count: H, combinations at most; so many are kept on the way.
        worth: weight of the paths' costs.
        stiffness: weight of each distance.
        slack: standard deviation of a distance that is kept, in the paths' unit.

    Returns:
        Depths (H, B, T), the first bone's path of its own sign: mirror images are left out.
    """
    depth = torch.cat([paths.depth, -paths.depth], 1)  # (B, S, T)
    cost = worth * torch.cat([paths.cost, paths.cost], 1)
    (one, other), sense = corners.bones.unbind(-1), corners.sense.to(flat)[:, None]
    across = (flat[one] + sense[..., None] * flat[other]).square().sum(-1)
    along = depth[one][:, :, None] + sense[:, None, None] * depth[other][:, None]  # (P, S, S, T)
    size = (across[:, None, None] + along.square()).sqrt()
    spread = (size - size.mean(-1, keepdim=True)).square().mean(-1)
    kept = stiffness * steadiness(spread, flat.shape[1], slack)
    half, every = paths.depth.shape[1], depth.shape[1]
    states = torch.arange(half, device=flat.device)[:, None]
    energy = cost[0, :half]
    for bone in range(1, len(depth)):
        added = cost[bone].expand(len(states), -1)
        for k in (other == bone).nonzero().flatten().tolist():
            added = added + kept[k, states[:, one[k]]]
        total = (energy[:, None] + added).flatten()
        energy, index = total.topk(min(count, len(total)), largest=False)
        states = torch.cat([states[index // every], (index % every)[:, None]], 1)
    states = states[energy.isfinite()]
    return depth[torch.arange(len(depth), device=flat.device), states]
