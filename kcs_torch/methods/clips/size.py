"""The apparent size of a body over time: it grows as the body comes nearer."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from kcs_torch.clean.timing import cuts_of
from kcs_torch.functional.chain import bone_vectors
from kcs_torch.functional.guarded import or_one
from kcs_torch.functional.temporal import interpolate
from kcs_torch.methods.clips.batches import Clips, in_batches, padded
from kcs_torch.skeleton import Skeleton
from kcs_torch.types import Tracks

__all__ = ["Size", "size_path", "slow_waves", "weak_perspective", "weak_perspectives"]

QUANTILE = 0.8
"""Of a bone's images, over its length: what follows the body's size."""

FLOOR = 0.02
"""Least deviation of a bone's image that is told apart, as a share."""

SECONDS = 1.5
"""Half a period of the fastest change of size; slower than steps and turns."""

STEPS = 40
"""Steps of reweighting."""

LEAST_RANGE, LEAST_GAIN = 1.08, 0.3
"""Largest over smallest size, and share of the bones' deviation that it must explain (the median over bones), for a
changing size to be believed. Before a distant camera the latter stays below 0.12 of people; it is above 0.6 where a
person walks towards a camera some metres away."""

MUCH = 1.15
"""Largest over smallest size from which on a change that is true explains at least as much, but for the errors of a
detector, which last."""

SURELY = 0.7
"""Share of that deviation from which on nothing else explains it. Fingers, which point to one side, look shorter
together as a hand turns: that explains up to 0.61."""


class Size(NamedTuple):
    """The relative size of a body in the image over time.

    Attributes:
        path: (T,), of mean 1.
        gain: share of the bones' deviation that it explains, the median over bones.
    """

    path: Tensor
    gain: float

    @property
    def range(self) -> float:
        """The largest size over the smallest."""
        return float(self.path.amax() / self.path.amin())

    @property
    def sure(self) -> bool:
        """Whether the tracks clearly ask for it."""
        return self.range >= LEAST_RANGE and self.gain >= LEAST_GAIN

    @property
    def surely(self) -> bool:
        """Whether nothing else can explain them."""
        return self.sure and self.gain >= SURELY

    @property
    def likely(self) -> bool:
        """Whether it may be so: a large change would explain much, a small one need not."""
        return self.range < MUCH or self.sure


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


def size_path(
    image: Tensor, seen: Tensor, skeleton: Skeleton, rate: float, cuts: Sequence[int] = ()
) -> tuple[Tensor, Tensor]:
    """Relative size of the body's image in each frame, and how well it tells each bone's.

    log |bone's image| = log length + log size + (what foreshortening takes away, never negative). The size's log is a
    sum of slow waves; it and the lengths are found by regression on a high quantile, with a deviation for each bone, so
    that bones that hardly tilt, the trunk's mostly, tell the size.

    Args:
        image: (T, N, 2).
        seen: (T, N) bool.
        skeleton: whose rigid bones are used; all pairs of joints where it has none.
        rate: frames a second.
        cuts: first frames of the shots but the first, where the size may step.

    Returns:
        (T,), positive, of geometric mean 1; and (P,), by how much smaller each pair's deviation is with it, as a share.
    """
    path, gain = _paths(image[None], seen[None], skeleton, _waves(image, rate, cuts)[None], (len(image),))
    return path[0], gain[0]


def weak_perspective(image: Tensor, seen: Tensor, skeleton: Skeleton, rate: float, cuts: Sequence[int] = ()) -> Size:
    """The :class:`Size` that :func:`size_path` finds, and whether the tracks clearly ask for it."""
    return _judged(*size_path(image, seen, skeleton, rate, cuts))


def weak_perspectives(tracks: Sequence[Tracks]) -> list[Size]:
    """:func:`weak_perspective` of several clips, batch by batch; their points are the images."""

    def solve(some: list[Tracks]) -> list[Size]:
        clips = Clips.of(some)
        waves = [_waves(one.points, one.rate, cuts_of(one)) for one in some]
        most = max(each.shape[1] for each in waves)
        wide = [torch.nn.functional.pad(each, (0, most - each.shape[1])) for each in waves]
        paths, gains = _paths(clips.points, clips.weights > 0, some[0].skeleton, padded(wide), clips.counts)
        return [_judged(path, gain) for path, gain in zip(clips.cut(paths), gains, strict=True)]

    return in_batches(tracks, solve)


def _waves(image: Tensor, rate: float, cuts: Sequence[int]) -> Tensor:
    """What the log of the size may be a sum of, (T, W): slow waves, and steps at the cuts of the film."""
    waves = slow_waves(len(image), rate, image)
    if not cuts:
        return waves
    time = torch.arange(len(image), device=waves.device)[:, None]
    later = (time >= torch.tensor(cuts, device=waves.device)).to(waves)
    return torch.cat([waves, later - later.mean(0)], 1)


def _judged(path: Tensor, gain: Tensor) -> Size:
    """A path (T,) that explains so much (P,) of the bones' deviations."""
    return Size(path / path.mean(), float(gain.median()))


def _paths(
    image: Tensor, seen: Tensor, skeleton: Skeleton, waves: Tensor, counts: Sequence[int]
) -> tuple[Tensor, Tensor]:
    """:func:`size_path` (K, T) and (K, P) of clips (K, T, N, 2), whose size is a sum of waves (K, T, W).

    In frames that pad a clip to T nothing is seen and waves are 0; so are waves that a clip has fewer of than others.
    """
    pairs = skeleton.bone_index(device=image.device)[list(skeleton.rigid)]
    if not len(pairs):
        pairs = torch.combinations(torch.arange(image.shape[2], device=image.device))
    length = bone_vectors(image, pairs).norm(dim=-1)  # (K, T, P)
    weight = (seen[..., pairs[:, 0]] & seen[..., pairs[:, 1]]).to(image)
    top = torch.where(weight > 0, length, 0).amax(1, keepdim=True)
    use = (weight.sum(1, keepdim=True) >= 3) & (top > 0)
    weight = weight * use
    value = (length / torch.where(use, top, 1)).clamp_min(0.05).log()
    waves = _told(waves, weight.sum(-1) > 0, counts)
    _, plain = _regress(value, weight, waves[..., :0])
    path, spread = _regress(value, weight, waves)
    mean = path.sum(1) / torch.tensor(counts, dtype=path.dtype, device=path.device)
    return (path - mean[:, None]).exp(), torch.where(use[:, 0], 1 - spread / plain, 0)


def _told(waves: Tensor, told: Tensor, counts: Sequence[int]) -> Tensor:
    """Waves (K, T, W), straight over frames of which nothing is told (K, T), and constant where a clip ends so."""
    held = interpolate(waves[..., None, :], told[..., None])[..., 0, :]
    time = torch.arange(waves.shape[1], device=waves.device)
    inside = time < torch.tensor(counts, device=waves.device)[:, None]
    return torch.where(inside[..., None], held, 0)


def _regress(value: Tensor, weight: Tensor, waves: Tensor) -> tuple[Tensor, Tensor]:
    """Paths (K, T) and deviations s (K, P) of least sum_p [sum_t pinball(value - level_p - path_t) / s_p + T log s_p].

    Args:
        value: (K, T, P).
        weight: (K, T, P), 1 or 0.
        waves: (K, T, W), of which paths are sums.
    """
    total = weight.sum(1).clamp_min(1)
    level = (weight * value).sum(1) / total
    path = torch.zeros_like(value[..., 0])
    own = (waves != 0).any(1)  # (K, W)
    ridge = 1e-6 * torch.eye(waves.shape[-1], dtype=value.dtype, device=value.device)

    def stray() -> tuple[Tensor, Tensor, Tensor]:
        """What level and path leave, how steep it costs there, (K, T, P) each, and the deviations (K, P)."""
        off = value - level[:, None] - path[..., None]
        slope = torch.where(off > 0, QUANTILE, torch.full_like(off, 1 - QUANTILE))
        return off, slope, ((weight * slope * off.abs()).sum(1) / total).clamp_min(FLOOR / 3)

    for _ in range(STEPS):
        off, slope, spread = stray()
        pull = weight * slope / off.abs().clamp_min(1e-3) / spread[:, None]
        each = pull.sum(1)
        each = or_one(each)  # of pairs that are never seen
        # the levels eliminated: each pair's waves and values less their weighted means
        level = (pull * value).sum(1) / each
        if len(ridge):
            centre = pull.mT @ waves / each[..., None]  # (K, P, W)
            normal = waves.mT @ (pull.sum(-1, keepdim=True) * waves) - centre.mT @ (each[..., None] * centre)
            goal = waves.mT @ (pull * (value - level[:, None])).sum(-1, keepdim=True)
            usual = normal.diagonal(dim1=-2, dim2=-1).sum(-1) / own.sum(-1).clamp_min(1)
            coefficient = torch.linalg.solve(normal + ridge * usual.clamp_min(1)[:, None, None], goal)
            path = (waves @ coefficient)[..., 0]
            level = level - (centre @ coefficient)[..., 0]
    return path, stray()[2]
