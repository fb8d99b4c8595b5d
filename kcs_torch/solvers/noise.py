"""What kind of noise tracks have."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from kcs_torch.errors import ShapeError
from kcs_torch.functional.shapes import check_core
from kcs_torch.functional.temporal import interpolate, window_starts
from kcs_torch.solvers.spectrum import TINY, temporal_modes, unshared, white_power
from kcs_torch.solvers.stray import body_size, each_joint, stray_from_neighbours

__all__ = ["SHORT", "Noise", "measure_noise"]

RESTLESS = (24, 48)
"""Modes that are hardly motion any more, six to eleven periods a second, but within most filters."""

SHORT = 12
"""Frames below which a clip does not tell its noise."""

STEADY, SEEN, SHOWN = 4, 0.95, 0.5
"""Joints that tell the kind of noise, at least; the share of the frames with any joint that show each; and the share of
such frames in all: others are filled, without noise."""


class Noise(NamedTuple):
    """What :func:`measure_noise` finds, standard deviations as shares of the body's size.

    Attributes:
        white: of the noise in the quickest modes.
        restless: of what joints do not share a few times slower, from six to eleven periods a second.
        share: of the deviation there that joints do not share: of exact tracks below .06, mostly.
        told: whether modes are enough to tell the share, as many as the joints' coordinates: fewer leave each joint's
            own what all may share. Of 17 joints more than two seconds are enough.
    """

    white: float
    restless: float
    share: float
    told: bool


def measure_noise(tracks: Tensor, weights: Tensor, *, window: int = 64) -> Noise | None:
    """Tell what kind of noise tracks have, without smoothing them.

    White noise is as strong in quick modes as in slower ones. That of detectors and filters is not: it falls off, but
    unlike motion it is every joint's own. Filters leave nothing at all of the quickest modes.

    Args:
        tracks: (T, N, 2), finite.
        weights: (T, N), 0 where unseen.
        window: frames taken together, two seconds say.

    Raises:
        ShapeError: they are not of these shapes.

    Returns:
        The noise of the joints that are seen in nearly all frames with any, outliers apart, its slower part 0 in clips
        of fewer than about 45 frames; or None where these joints are fewer than four, frames fewer than twelve, or more
        than half of them empty.
    """
    check_core(tracks, "measure_noise: tracks", "T", "N", 2)
    check_core(weights, "measure_noise: weights", *tracks.shape[-3:-1])
    if tracks.ndim > 3 or weights.ndim > 2:
        got = f"{tuple(tracks.shape)} and {tuple(weights.shape)}"
        raise ShapeError(f"measure_noise: expected tracks (T, N, 2) and weights (T, N) of one clip, got {got}")
    if len(tracks) < SHORT:
        return None
    values = tracks.detach().double()[None]
    seen = weights[None] > 0
    size = body_size(values, seen)
    if not bool(size > TINY):
        return None
    values = values / size
    seen = seen & ~each_joint(stray_from_neighbours, values, seen)
    shown = seen[0].any(1)  # hands are lost as a whole now and then
    steady = seen[0].double().sum(0) >= SEEN * float(shown.sum())
    if int(steady.sum()) < STEADY or float(shown.double().mean()) < SHOWN:
        return None
    values, seen = values[:, :, steady], seen[:, :, steady]
    points = interpolate(values, seen)
    frames = points.shape[1]
    length = min(window, frames)
    index = torch.tensor(window_starts(frames, length, length // 2), device=tracks.device)[:, None]
    index = index + torch.arange(length, device=tracks.device)
    modes = temporal_modes(length).to(points).mT @ (points - points.mean(1, keepdim=True))[:, index].flatten(-2)
    white = math.sqrt(float(white_power(modes)))
    part = modes[:, :, slice(*RESTLESS)]
    _, own = unshared(part)
    if not bool(own.isfinite()):
        return Noise(white, 0.0, 0.0, False)
    share = own / part.square().mean((1, 2, 3)).clamp_min(TINY)
    told = part.shape[1] * part.shape[2] >= part.shape[3]
    return Noise(white, math.sqrt(float(own)), math.sqrt(float(share)), told)
