"""Tracks as networks see them: centred, of size 1, beside their neighbours in time."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from kcs_torch.functional.guarded import largest, or_one, safe_root
from kcs_torch.functional.precision import wide
from kcs_torch.functional.temporal import interpolate
from kcs_torch.functional.weights import seen_weights

__all__ = ["NormalisedTracks", "neighbours", "normalise_tracks"]


class NormalisedTracks(NamedTuple):
    """Tracks as networks see them, at least in single precision.

    Attributes:
        local: (..., T, N, 2) about the middle of each frame, divided by ``scale``; 0 where unseen.
        seen: (..., T, N) 1 where seen, else 0.
        middle: (..., T, 1, 2) mean of each frame's seen joints; frames without any take it from their neighbours.
        scale: (..., 1, 1, 1) root mean square of the seen joints about the middles; 0 where they all lie at one point.
    """

    local: Tensor
    seen: Tensor
    middle: Tensor
    scale: Tensor


def normalise_tracks(tracks: Tensor, weights: Tensor | None, scale: Tensor | None = None) -> NormalisedTracks:
    """Centre tracks (..., T, N, 2) in each frame and divide them by the size of the clip, or by a given ``scale``."""
    seen = seen_weights(tracks, weights) > 0
    tracks = wide(tracks)
    mask = seen.to(tracks.dtype)
    tracks = torch.where(seen[..., None], tracks, torch.zeros_like(tracks))
    top = or_one(largest(tracks, 3))  # divided out first, so that neither sums nor squares overflow
    tracks = tracks / top
    count = mask.sum(-1)[..., None, None]  # (..., T, 1, 1)
    middle = tracks.sum(-2, keepdim=True) / count.clamp_min(1)
    middle = interpolate(middle, count[..., 0] > 0)
    local = (tracks - middle) * mask[..., None]
    if scale is None:
        size = safe_root(local.square().sum((-3, -2, -1), keepdim=True) / count.sum(-3, keepdim=True).clamp_min(1))
        return NormalisedTracks(local / or_one(size), mask, middle * top, size * top)
    scale = wide(scale)
    return NormalisedTracks(local / or_one(scale / top), mask, middle * top, scale)


def neighbours(frames: Tensor, steps: Sequence[int]) -> Tensor:
    """Put each frame beside those some steps away, (..., T, C) to (..., T, C len(steps)); the ends are held."""
    length, reach = frames.shape[-2], max(abs(s) for s in steps)
    if reach == 0:
        return torch.cat([frames] * len(steps), -1) if len(steps) > 1 else frames
    shape = [-1] * (frames.ndim - 2) + [reach, -1]
    held = torch.cat([frames[..., :1, :].expand(shape), frames, frames[..., -1:, :].expand(shape)], -2)
    return torch.cat([held.narrow(-2, reach + s, length) for s in steps], -1)
