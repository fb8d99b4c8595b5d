"""Paths of depth that one bone of constant length can take, told by its image alone."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from kcs_torch.functional.chain import bone_vectors
from kcs_torch.solvers.signs import smooth_signs

__all__ = ["BonePaths", "bone_paths", "nearest_paths", "path_energy"]

LONGER = tuple(
    1 + m for m in (0, 1e-4, 3e-4, 6e-4, 1e-3, 2e-3, 4e-3, 8e-3, 0.015, 0.03, 0.05, 0.07, 0.1, 0.15, 0.2, 0.3, 0.4, 0.6)
)
"""Lengths that are tried, over the longest image: a bone that passes through the image plane is hardly longer."""

MOST = 6
"""K, paths to keep of a bone at most."""

JUMP = 25.0
"""Squared second difference of depth, in variances, from which on a path jumps."""

APART = 0.15
"""Root mean square difference of paths that are not the same, a share of the longest image."""

LEAST = 0.01
"""Depths below this share of a bone's length are not told apart."""


class BonePaths(NamedTuple):
    """Paths of B bones over T frames, each bone's likeliest first.

    Attributes:
        depth: (B, K, T), of either sign as a whole.
        cost: (B, K), 0 for the likeliest of a bone, infinite where it has fewer than K.
    """

    depth: Tensor
    cost: Tensor

    def at(self, frames: Tensor) -> BonePaths:
        """The same, at some frames."""
        return BonePaths(self.depth[..., frames], self.cost)


def bone_paths(tracks: Tensor, bones: Tensor) -> BonePaths:
    """Find what depths bones of constant length may have.

    These are s sqrt(L^2 - |b|^2) for several lengths L, the signs s by second-order Viterbi. With the right length
    depth passes through the image plane along a straight line; a longer bone bounces off it. Which of both it is the
    image hardly says, and whether a bone begins before or behind the plane not at all: that is for all bones together
    to decide. Costs are :func:`path_energy`.

    Args:
        tracks: (T, N, 2), complete and without noise.
        bones: (B, 2) joint pairs of constant distance.

    Returns:
        The :class:`BonePaths`.
    """
    flat = bone_vectors(tracks, bones).movedim(-2, 0)  # (B, T, 2)
    square = flat.square().sum(-1)
    longest = square.amax(-1).sqrt().clamp_min(torch.finfo(flat.dtype).tiny ** 0.25)
    between = _peak(square).sqrt().maximum(longest)
    size = torch.cat([longest[:, None] * flat.new_tensor(LONGER), between[:, None]], 1)  # (B, L)
    depth = (size.square()[..., None] - square[:, None]).clamp_min(0).sqrt()  # (B, L, T)
    deviation = _acceleration(flat).sqrt().clamp_min(1e-4 * longest)
    steps = (depth / deviation[:, None, None]).flatten(0, 1)[..., None]
    unary = steps.new_zeros(len(steps), steps.shape[1], 1, 2)
    unary[:, 0, :, 1] = 1e-3  # of a path and its mirror image either will do
    depth = depth * smooth_signs(unary, steps, cap=JUMP).signs[..., 0].view_as(depth)
    cost = path_energy(depth, flat[:, None])  # (B, L)
    inner = depth @ depth.mT / depth.shape[-1]
    norm = inner.diagonal(dim1=-2, dim2=-1)
    apart = norm[..., None] + norm[:, None] - 2 * inner.abs()
    same = apart < (APART * longest).square()[:, None, None]
    chosen, costs = [], []
    for _ in range(MOST):
        best, index = cost.min(-1)
        costs.append(best)
        chosen.append(index)
        cost = cost.masked_fill(same[torch.arange(len(cost), device=cost.device), index], torch.inf)
    rank = torch.stack(chosen, 1)
    found = depth.gather(1, rank[..., None].expand(-1, -1, depth.shape[-1]))
    return BonePaths(found, torch.stack(costs, 1) - costs[0][:, None])


def path_energy(depth: Tensor, flat: Tensor) -> Tensor:
    """Minus the logarithm of how likely depths of bones are, given their images, (...).

    A bone points anywhere, so that a long one that never shows its length is unlikely: for directions uniform on the
    sphere the image's density is |b| / (L |dz|). And it moves in depth as in the image: the logarithm of its mean
    squared acceleration, over that of an image's coordinate, has a variance of 2 / n. Both count n times: once for
    each time in which the bone changes its direction.

    Args:
        depth: (..., T).
        flat: (..., T, 2), in the same unit; broadcast against it.

    Returns:
        (...). Other units add the same to all.
    """
    frames = depth.shape[-1]
    middle = flat - flat.mean(-2, keepdim=True)
    stray = middle.square().sum(-1).mean(-1).sqrt()
    speed = flat.diff(dim=-2).square().sum((-2, -1)).div(max(frames - 1, 1)).sqrt()
    tiny = torch.finfo(depth.dtype).tiny ** 0.25
    square = depth.square()
    size = (flat.square().sum(-1) + square).mean(-1).clamp_min(tiny)
    worth = (frames * speed / (2 * stray.maximum(LEAST * size.sqrt()))).clamp(1.0, max(frames / 4, 1.0))
    energy = size.log() / 2 + (square + LEAST**2 * size[..., None]).log().mean(-1) / 2
    if frames > 2:
        least = 1e-6 * size
        ratio = (depth.diff(n=2).square().mean(-1) + least) / (_acceleration(flat) + least)
        energy = energy + ratio.log().square() / 4
    return worth * energy


def nearest_paths(paths: BonePaths, depth: Tensor) -> Tensor:
    """Of each bone the path, of either sign, that is nearest to depths (H, B, T); in their shape."""
    inner = torch.einsum("bkt,hbt->hbk", paths.depth, depth)
    off = (paths.depth.square().sum(-1) - 2 * inner.abs()).masked_fill(paths.cost.isinf(), torch.inf)
    index = off.argmin(-1, keepdim=True)  # (H, B, 1)
    bone = torch.arange(depth.shape[1], device=depth.device)
    sign = torch.where(inner.gather(-1, index) < 0, -1.0, 1.0).to(depth)
    return sign * paths.depth[bone, index[..., 0]]


def _peak(square: Tensor) -> Tensor:
    """The largest value (...) that (..., T) take, or parabolas through three in a row do between them.

    A bone's squared image is such a parabola where it passes through the image plane, which it hardly ever does at the
    very time of a frame.
    """
    most = square.amax(-1)
    if square.shape[-1] < 3:
        return most
    before, middle, after = square[..., :-2], square[..., 1:-1], square[..., 2:]
    slope, bend = (after - before) / 2, (before + after - 2 * middle).clamp_max(0)
    above = (middle >= before) & (middle >= after) & (bend < 0)
    rise = torch.where(above, slope.square() / torch.where(above, -2 * bend, 1), 0)
    return most.maximum((middle + rise).amax(-1))


def _acceleration(flat: Tensor) -> Tensor:
    """Mean squared second difference (...) of images (..., T, 2), of each coordinate."""
    if flat.shape[-2] < 3:
        return torch.zeros_like(flat[..., 0, 0])
    return flat.diff(n=2, dim=-2).square().mean((-2, -1))
