"""Which joints belong to one rigid part: pairs whose distance hardly varies, and their spanning tree."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from kcs_torch.errors import ShapeError
from kcs_torch.functional.guarded import or_one, safe_root
from kcs_torch.functional.precision import wide
from kcs_torch.functional.shapes import check_batches, check_core, check_floats

__all__ = ["distance_spread", "rigid_tree"]


def distance_spread(points: Tensor, weights: Tensor | None = None) -> tuple[Tensor, Tensor]:
    """Return the mean and the standard deviation over time of the distances between all joints.

    Args:
        points: (..., T, N, 3), finite.
        weights: (..., T, N); a pair counts in a frame as much as the lesser of its joints, and not below 0. All 1
            where None.

    Returns:
        mean (..., N, N) and standard deviation (..., N, N), both 0 for pairs never seen together. Their
        derivatives are 0 where they are 0.

    Raises:
        ShapeError: they are not of these shapes, or the points not in floating point.
    """
    check_floats(points, "distance_spread: points", "T", "N", 3)
    full, dtype = wide(points), points.dtype
    distance = safe_root((full[..., :, None, :] - full[..., None, :, :]).square().sum(-1))  # (..., T, N, N)
    if weights is None:
        mean = distance.mean(-3)
        return mean.to(dtype), safe_root((distance - mean[..., None, :, :]).square().mean(-3)).to(dtype)
    check_core(weights, "distance_spread: weights", *points.shape[-3:-1])
    check_batches("distance_spread: points and weights", points, weights, cores=(3, 2))
    weights, dtype = wide(weights), torch.promote_types(dtype, weights.dtype)
    share = torch.minimum(weights[..., :, None], weights[..., None, :]).clamp_min(0)
    total = share.sum(-3)
    total = or_one(total)
    mean = (share * distance).sum(-3) / total
    spread = safe_root((share * (distance - mean[..., None, :, :]).square()).sum(-3) / total)
    return mean.to(dtype), spread.to(dtype)


def rigid_tree(cost: Tensor) -> Tensor:
    """Return the minimum spanning tree of joints under a cost of each pair (Prim 1957).

    Args:
        cost: (N, N), symmetric; how much a pair's distance varies, say.

    Returns:
        (N - 1, 2) integer (parent, child) pairs, parents first, from joint 0.

    Raises:
        ShapeError: ``cost`` is not square.

    >>> rigid_tree(torch.tensor([[0.0, 1, 9], [1, 0, 2], [9, 2, 0]])).tolist()
    [[0, 1], [1, 2]]
    """
    if cost.ndim != 2 or cost.shape[0] != cost.shape[1]:
        raise ShapeError(f"rigid_tree: expected a cost of each pair (N, N), got {tuple(cost.shape)}")
    joints, cost = len(cost), wide(cost)
    cost = torch.nan_to_num(cost, nan=torch.finfo(cost.dtype).max)
    inside = torch.zeros(joints, dtype=torch.bool, device=cost.device)
    inside[:1] = True
    pairs = []
    for _ in range(joints - 1):
        open_pairs = cost.masked_fill(~inside[:, None] | inside, math.inf)
        parent, child = divmod(int(open_pairs.argmin()), joints)
        pairs.append((parent, child))
        inside[child] = True
    return torch.tensor(pairs, dtype=torch.long, device=cost.device).reshape(-1, 2)
