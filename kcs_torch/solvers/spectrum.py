"""Temporal modes of motion, and how much noise there is in them."""

from __future__ import annotations

import math
from functools import lru_cache

import torch
from torch import Tensor

from kcs_torch.functional.ranks import nanmedian

__all__ = ["TINY", "spectrum_floor", "temporal_modes", "unshared", "white_power", "window_at"]

ENOUGH = 20
"""Modes from which on noise can be told from motion."""

WINDOW = 64
"""Frames in which motion and noise are told apart, at 30 a second: two seconds, and up to 120 a second as many."""

SHARED = (0.15, 0.35)
"""The floor of a spectrum is motion where less than the first share of its power is every joint's own, and noise from
the second on."""

FILLED = 0.5
"""Share of the noise that any joint has left, at most, below which a joint is mostly filled and tells of none."""

TINY = 1e-30
"""Sizes and powers up to it are those of nothing."""


def window_at(rate: float) -> int:
    """Frames in which motion and noise are told apart, at so many a second."""
    return WINDOW * round(min(max(rate / 30, 1), 4))


def temporal_modes(length: int) -> Tensor:
    """(L, L) orthonormal columns: polynomials up to the second degree, then eigenvectors of the third difference."""
    time = torch.linspace(-1, 1, length, dtype=torch.float64)
    smooth = torch.linalg.qr(torch.stack([time**k for k in range(min(3, length))], -1)).Q
    if length <= 3:
        return smooth
    third = torch.eye(length, dtype=torch.float64).diff(n=3, dim=0)
    rough = torch.linalg.eigh(third.mT @ third).eigenvectors[:, 3:]
    return torch.linalg.qr(torch.cat([smooth, rough], -1)).Q


def spectrum_floor(power: Tensor) -> Tensor:
    """Level (K,) at which a spectrum (K, L) stops falling: power_i ~ c ((1 - r) i^-b + r), maximum likelihood."""
    length = power.shape[1]
    if length < 12:
        return torch.zeros_like(power[:, 0])
    first = max(3, length // 8)
    order = torch.arange(first, length, dtype=power.dtype, device=power.device) / first
    slope = torch.tensor([2.0, 3, 4, 5, 6, 8], dtype=power.dtype, device=power.device)[:, None, None]
    rising = torch.logspace(-8, 0, 49, dtype=power.dtype, device=power.device)
    level = torch.cat([torch.zeros_like(rising[:1]), rising])[:, None]
    shape = (1 - level) * order**-slope + level  # (6, 50, I)
    power = power[:, None, None, first:].clamp_min(TINY)
    scale = (power / shape).mean(-1)
    misfit = scale.log() * len(order) + shape.log().sum(-1)
    best = misfit.flatten(1).argmin(1, keepdim=True)
    return (scale * level[:, 0]).flatten(1).gather(1, best)[:, 0]


def white_power(modes: Tensor, share: Tensor | None = None) -> Tensor:
    """Power (K,) of the white noise in temporal modes (K, H, L, M) of K clips' H windows and M coordinates.

    The level at which the spectrum stops falling, unless joints move together there, and at least what the quicker half
    of the modes do not share. Where gaps were filled, ``share`` (K, H, M) of the noise's power is left.
    """
    square = modes.square()
    if share is not None:
        known = share >= FILLED * share.amax((1, 2), keepdim=True)
        square = torch.where(known[:, :, None], square / share.clamp_min(TINY)[:, :, None], math.nan)
    typical = nanmedian(square.movedim(2, 1).flatten(2), -1) / 0.4549  # of chi-square: blind to impacts
    floor = spectrum_floor(typical)
    alone, _ = unshared(modes[:, :, modes.shape[2] // 2 :], share)
    alone = torch.where(alone.isfinite(), alone, floor)
    own = ((alone / floor.clamp_min(TINY) - SHARED[0]) / (SHARED[1] - SHARED[0])).clamp(0, 1)
    return torch.lerp(alone, torch.maximum(alone, floor), own)


def unshared(modes: Tensor, share: Tensor | None = None) -> tuple[Tensor, Tensor]:
    """Variance (K,) of what modes do not share, and a cautious guess: noise is every joint's own, motion is not.

    The smaller eigenvalues of the coordinates' covariance, over those of as much white noise of variance 1; infinite
    where there are too few modes or coordinates to tell. The guess takes fewer of them. Arguments are those of
    :func:`white_power`; coordinates that are mostly filled, and had no noise as it seems, do not count.
    """
    modes = modes.flatten(1, 2)
    count, size = modes.shape[1:]
    number = [size] * len(modes)
    if share is not None:
        usual = share.mean(1)  # (K, M)
        known = usual >= FILLED * usual.amax(-1, keepdim=True)
        modes = modes * (known / usual.clamp_min(TINY).sqrt())[:, None]
        number = known.sum(-1).tolist()
    found = torch.linalg.eigvalsh(modes.mT @ modes)
    half: list[Tensor] = []
    less: list[Tensor] = []
    for own, told in zip(found, number, strict=True):  # the smallest are those of coordinates that do not count
        enough = count >= ENOUGH and told >= 8
        rank = min(told, count)
        for out, last in ((half, rank // 2), (less, 3 * rank // 8)):
            some = slice(told - rank + rank // 8, told - rank + last)  # virtual joints are no measurements
            white = _white_spectrum(count, told).to(modes)[some].mean() if enough else 0.0
            power = own[size - told :][some].mean().clamp_min(0)
            out.append(power / white if enough else modes.new_tensor(math.inf))
    return torch.stack(half), torch.stack(less)


@lru_cache(maxsize=64)
def _white_spectrum(count: int, size: int) -> Tensor:
    """Eigenvalues (M,) of the scatter of as many modes (n, M) of white noise."""
    with torch.inference_mode(False):
        noise = torch.randn(count, size, generator=torch.Generator().manual_seed(0), dtype=torch.float64, device="cpu")
        return torch.linalg.eigvalsh(noise.mT @ noise)
