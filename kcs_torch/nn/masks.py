"""Weights of joints, frames and bones: what counts nothing is taken out, and what it counts is told apart by shape."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from kcs_torch.errors import ShapeError
from kcs_torch.functional.shapes import fit_together
from kcs_torch.functional.weights import known, known_frames
from kcs_torch.nn.checks import check_tensor

__all__ = ["bone_share", "clear_padding", "known_points", "weighs_joints"]


def weighs_joints(weights: Tensor, points: Tensor, module: nn.Module) -> bool:
    """Whether weights are those of the joints (..., T, N) of points (..., T, N, D), or of the frames (..., T).

    Where there are as many frames as joints, weights may be both: then they are those of the frames if there is one for
    each frame of each clip.

    Raises:
        ShapeError: they are neither.
    """
    check_tensor(weights, "weights", module)
    frames, joints = points.shape[-3:-1]
    of_frames = weights.shape[-1:] == (frames,) and fit_together(weights.shape[:-1], points.shape[:-3])
    if weights.shape[-2:] == (frames, joints) and fit_together(weights.shape[:-2], points.shape[:-3]):
        return not (of_frames and weights.shape[:-1] == points.shape[:-3])
    if of_frames:
        return False
    raise ShapeError(
        f"{type(module).__name__}: expected weights (..., {frames}, {joints}) of joints or (..., {frames}) of frames "
        f"for points {tuple(points.shape)}, got {tuple(weights.shape)}"
    )


def known_points(points: Tensor, weights: Tensor | None, module: nn.Module) -> Tensor:
    """Points (..., T, N, D), 0 where the weights of the joints (..., T, N) or of the frames (..., T) are."""
    if weights is not None and weighs_joints(weights, points, module):
        return known(points, weights)
    return known_frames(points, weights)


def bone_share(weights: Tensor, bones: Tensor) -> Tensor:
    """Weights of the bones (..., B): each weighs as much as the lesser of its two ends (..., N), and not below 0."""
    return torch.minimum(weights[..., bones[:, 0]], weights[..., bones[:, 1]]).clamp_min(0)


def clear_padding(values: Tensor, inside: Tensor | None, trailing: int = 2) -> Tensor:
    """Values (..., T, *), of so many dimensions beyond time, with 0 in frames that are not ``inside`` (..., T)."""
    if inside is None:
        return values
    return torch.where(inside[(..., *[None] * trailing)], values, values.new_zeros(()))
