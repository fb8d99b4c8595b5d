"""What a training step is given: :class:`Batch`, and how its depth is told."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

__all__ = ["Batch", "from_mean_depth"]


class Batch(NamedTuple):
    """Windows of tracks, with the 3D that may be used.

    Attributes:
        tracks: (B, T, N, 2) in px or mm, virtual joints included; 0 where unseen.
        weights: (B, T, N) in [0, 1]; 0 where unseen.
        points: (B, T, N, 3) in the camera frame and the unit of the tracks, depth from the mean of each frame's joints:
            the truth of labelled windows, the pseudo-labels of others; 0 where there is neither.
        labelled: (B,) 1 where ``points`` are the truth and may be used, else 0.
        pseudo: (B, T, N) weight of ``points`` as pseudo-labels in [0, 1]; 0 where they are none.
    """

    tracks: Tensor
    weights: Tensor
    points: Tensor
    labelled: Tensor
    pseudo: Tensor


def from_mean_depth(points: Tensor) -> Tensor:
    """Points (..., N, 3) with their depth from the mean of each frame's joints."""
    depth = points[..., 2:]
    return torch.cat([points[..., :2], depth - depth.mean(-2, keepdim=True)], -1)
