"""The apparent size of a body over time: it grows as the body comes nearer."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from kcs_torch.functional.chain import bone_vectors
from kcs_torch.skeleton import Skeleton

__all__ = ["size_path", "slow_waves", "weak_perspective"]

QUANTILE = 0.8
"""Of a bone's images, over its length: what follows the body's size."""

FLOOR = 0.02
"""Least deviation of a bone's image that is told apart, as a share."""

SECONDS = 1.5
"""Half a period of the fastest change of size; slower than steps and turns."""


LEAST_RANGE, LEAST_GAIN = 1.08, 0.3
"""Largest over smallest size, and share of the bones' deviation that it must explain (the median over bones), for a
changing size to be believed. Before a distant camera the latter stays below 0.12 on all clips tried; it is above 0.6
where a person walks towards a camera some metres away."""


def slow_waves(frames: int, rate: float, like: Tensor, *, most: int = 12) -> Tensor:
    """Slow functions of time (T, K), each of mean 0 and mean square 1/2 or so: a line and cosines.

    Args:
        frames: T.
        rate: frames a second.
        like: gives dtype and device.
        most: K at most.
    """
    time = (torch.arange(frames, dtype=like.dtype, device=like.device) + 0.5) / max(frames, 1)
    count = max(1, min(most, 1 + math.floor(frames / (rate * SECONDS))))
    line = 2 * time - 1
    waves = [torch.cos(math.pi * k * time) for k in range(2, count + 1)]  # k = 1 is the line's work
    return torch.stack([line, *waves], -1)


def size_path(image: Tensor, seen: Tensor, skeleton: Skeleton, rate: float) -> tuple[Tensor, Tensor]:
    """Relative size of the body's image in each frame, and how well it tells each bone's.

    log |bone's image| = log length + log size + (what foreshortening takes away, never negative). The size's log is a
    sum of slow waves; it and the lengths are found by regression on a high quantile, with a deviation for each bone, so
    that bones that hardly tilt, the trunk's mostly, tell the size.

    Args:
        image: (T, N, 2).
        seen: (T, N) bool.
        skeleton: whose rigid bones are used; all pairs of joints where it has none.
        rate: frames a second.

    Returns:
        (T,), positive, of geometric mean 1; and (P,), by how much smaller each pair's deviation is with it, as a share.
    """
    frames, joints, _ = image.shape
    pairs = skeleton.bone_index(device=image.device)[list(skeleton.rigid)]
    if not len(pairs):
        pairs = torch.combinations(torch.arange(joints, device=image.device))
    length = bone_vectors(image, pairs).norm(dim=-1)  # (T, P)
    weight = (seen[:, pairs[:, 0]] & seen[:, pairs[:, 1]]).to(image)
    top = torch.where(weight > 0, length, torch.zeros_like(length)).amax(0)
    use = (weight.sum(0) >= 3) & (top > 0)
    if frames < 3 or not bool(use.any()):
        return image.new_ones(frames), image.new_zeros(len(pairs))
    length, weight, top = length[:, use], weight[:, use], top[use]
    value = (length / top).clamp_min(0.05).log()
    waves = slow_waves(frames, rate, image)
    _, plain = _regress(value, weight, waves[:, :0])
    path, spread = _regress(value, weight, waves)
    gain = image.new_zeros(len(pairs))
    gain[use] = 1 - spread / plain
    path = path - path.mean()
    return path.exp(), gain


def weak_perspective(image: Tensor, seen: Tensor, skeleton: Skeleton, rate: float) -> Tensor | None:
    """The size of :func:`size_path` (T,), of mean 1, if the tracks clearly ask for it, else None."""
    path, gain = size_path(image, seen, skeleton, rate)
    if float(path.amax() / path.amin()) < LEAST_RANGE or float(gain.median()) < LEAST_GAIN:
        return None
    return path / path.mean()


def _regress(value: Tensor, weight: Tensor, waves: Tensor, steps: int = 40) -> tuple[Tensor, Tensor]:
    """Path (T,) and deviations s (P,) of least sum_p [sum_t pinball(value - level_p - path_t) / s_p + T log s_p]."""
    total = weight.sum(0)
    level = (weight * value).sum(0) / total
    path = torch.zeros_like(value[:, 0])
    spread = torch.full_like(level, 0.2)
    ridge = 1e-6 * torch.eye(waves.shape[1], dtype=value.dtype, device=value.device)
    for _ in range(steps):
        off = value - level - path[:, None]
        slope = torch.where(off > 0, QUANTILE, 1 - QUANTILE)
        spread = ((weight * slope * off.abs()).sum(0) / total).clamp_min(FLOOR / 3)
        pull = weight * slope / off.abs().clamp_min(1e-3) / spread
        each = pull.sum(0)
        # the levels eliminated: each pair's waves and values less their weighted means
        mean = (pull * value).sum(0) / each
        if waves.shape[1]:
            centre = pull.mT @ waves / each[:, None]  # (P, K)
            normal = waves.mT @ (pull.sum(1)[:, None] * waves) - centre.mT @ (each[:, None] * centre)
            goal = waves.mT @ (pull * (value - mean)).sum(1)
            coefficient = torch.linalg.solve(normal + ridge * normal.diagonal().mean().clamp_min(1), goal)
            path = waves @ coefficient
            level = mean - centre @ coefficient
        else:
            level = mean
    off = value - level - path[:, None]
    slope = torch.where(off > 0, QUANTILE, 1 - QUANTILE)
    return path, ((weight * slope * off.abs()).sum(0) / total).clamp_min(FLOOR / 3)
