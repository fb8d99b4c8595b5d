"""Tracks as networks see them: centred, of size 1, beside their neighbours in time."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from kcs_torch.functional.temporal import interpolate
from kcs_torch.nn.layers import seen_weights

__all__ = ["NormalisedTracks", "neighbours", "normalise_tracks"]


class NormalisedTracks(NamedTuple):
    """Tracks as networks see them.

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
    mask = seen.to(tracks.dtype)
    tracks = torch.where(seen[..., None], tracks, torch.zeros_like(tracks))
    count = mask.sum(-1)[..., None, None]  # (..., T, 1, 1)
    middle = tracks.sum(-2, keepdim=True) / count.clamp_min(1)
    middle = interpolate(middle, count[..., 0] > 0)
    local = (tracks - middle) * mask[..., None]
    if scale is None:
        top = local.abs().amax((-3, -2, -1), keepdim=True)  # divided out first, so that no square overflows
        share = local / torch.where(top > 0, top, torch.ones_like(top))
        square = share.square().sum((-3, -2, -1), keepdim=True) / count.sum(-3, keepdim=True).clamp_min(1)
        root = torch.where(square > 0, square, torch.ones_like(square)).sqrt()  # no square root of 0: its slope
        scale = top * torch.where(square > 0, root, torch.zeros_like(root))
    return NormalisedTracks(local / torch.where(scale > 0, scale, torch.ones_like(scale)), mask, middle, scale)


def neighbours(frames: Tensor, steps: Sequence[int]) -> Tensor:
    """Put each frame beside those some steps away, (..., T, C) to (..., T, C len(steps)); the ends are held."""
    length, reach = frames.shape[-2], max(abs(s) for s in steps)
    if reach == 0:
        return torch.cat([frames] * len(steps), -1) if len(steps) > 1 else frames
    shape = [-1] * (frames.ndim - 2) + [reach, -1]
    held = torch.cat([frames[..., :1, :].expand(shape), frames, frames[..., -1:, :].expand(shape)], -2)
    return torch.cat([held.narrow(-2, reach + s, length) for s in steps], -1)
