"""What a training step is given: :class:`Batch`, and how its depth is told."""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from torch import Tensor

from kcs_torch.errors import ShapeError
from kcs_torch.skeleton import Skeleton

__all__ = ["Batch", "check_batch", "from_mean_depth"]


class Batch(NamedTuple):
    """Windows of tracks, with the 3D that may be used.

    Attributes:
        tracks: (B, T, N, 2) in px or mm, virtual joints included; 0 where unseen.
        weights: (B, T, N) in [0, 1]; 0 where unseen.
        points: (B, T, N, 3) in the camera frame and the unit of the tracks, depth from the mean of each frame's joints:
            the truth of labelled windows, the pseudo-labels of others; 0 where there is neither, and NaN is neither.
        labelled: (B,) 1 where ``points`` are the truth and may be used, else 0.
        pseudo: (B, T, N) weight of ``points`` as pseudo-labels in [0, 1]; 0 where they are none.
    """

    tracks: Tensor
    weights: Tensor
    points: Tensor
    labelled: Tensor
    pseudo: Tensor


def check_batch(batch: Any, skeleton: Skeleton | None = None) -> Batch:
    """Return a batch, with weights and labels of other types, such as bool, as numbers.

    Args:
        batch: what a loader gave.
        skeleton: whose joints it has to have, if that is known.

    Raises:
        ShapeError: it is no :class:`Batch`, or one of its tensors is not of the shape that this says.
    """
    if not isinstance(batch, Batch):
        kind = type(batch).__name__
        raise ShapeError(f"batch: expected a kcs_torch.training.Batch({', '.join(Batch._fields)}), got {kind}")
    for name, value in batch._asdict().items():
        if not isinstance(value, Tensor):
            raise ShapeError(f"batch.{name}: expected a tensor, got {type(value).__name__}")
    for name, value in (("tracks", batch.tracks), ("points", batch.points)):
        if not value.is_floating_point():
            raise ShapeError(f"batch.{name}: expected numbers in floating point, got {value.dtype}")
    shape = tuple(batch.tracks.shape)
    joints = "N" if skeleton is None else skeleton.num_joints
    if len(shape) != 4 or shape[-1] != 2 or (skeleton is not None and shape[2] != joints):
        of = "" if skeleton is None else f" for skeleton '{skeleton.name}'"
        hint = ""
        if len(shape) == 3:
            hint = ": a single clip has B = 1"
        elif len(shape) == 5:
            hint = ": batches were stacked, DataLoader(..., batch_size=None) gives them as they are"
        elif skeleton is not None and shape[2:] == (skeleton.num_observed, 2):
            virtual = ", ".join(skeleton.joints[skeleton.num_observed :])
            hint = f": without its virtual joints {virtual}, which skeleton.complete(points, weights) appends"
        raise ShapeError(f"batch.tracks: expected (B, T, {joints}, 2){of}, got {shape}{hint}")
    expected = {"weights": shape[:3], "points": (*shape[:3], 3), "labelled": shape[:1], "pseudo": shape[:3]}
    for name, size in expected.items():
        got = tuple(getattr(batch, name).shape)
        if got != size:
            raise ShapeError(f"batch.{name}: expected {size} for tracks {shape}, got {got}")
    numbers = {name: getattr(batch, name) for name in ("weights", "labelled", "pseudo")}
    others = {name: x.to(batch.tracks.dtype) for name, x in numbers.items() if not x.is_floating_point()}
    return batch._replace(**others)


def from_mean_depth(points: Tensor) -> Tensor:
    """Points (..., N, 3) with their depth from the mean of each frame's joints."""
    depth = points[..., 2:]
    return torch.cat([points[..., :2], depth - depth.mean(-2, keepdim=True)], -1)
