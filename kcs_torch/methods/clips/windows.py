"""Windows of one clip, solved for themselves: in which order, and how they are joined."""

from __future__ import annotations

import torch
from torch import Tensor

from kcs_torch.functional.align import nearest_rotation
from kcs_torch.functional.camera import complete_rotation
from kcs_torch.functional.temporal import blend_windows

__all__ = ["join_windows", "spread_first"]


def spread_first(count: int, lead: int) -> Tensor:
    """Numbers 0..count-1 in an order that begins with ``lead`` of them spread over all."""
    every = torch.arange(count)
    if count <= lead:
        return every
    chosen = torch.zeros(count, dtype=torch.bool)
    chosen[torch.linspace(0, count - 1, lead).round().long()] = True
    return torch.cat([every[chosen], every[~chosen]])


def join_windows(
    points: Tensor, cameras: Tensor | None, starts: list[int], frames: int
) -> tuple[Tensor, Tensor | None]:
    """Join windows that each have a mirror in depth, and a world, of their own.

    Args:
        points: (K, W, T, N, 3) in each frame's camera, of K clips.
        cameras: (K, W, T, 2, 3), or None where they are known: then the mirror is, too.
        starts: first frames of the windows.
        frames: of a clip.

    Returns:
        Points (K, frames, N, 3) and cameras (K, frames, 2, 3), in the mirror and the world of a clip's first window. A
        single window is left as it is.
    """
    if len(starts) == 1:
        return points[:, 0], None if cameras is None else cameras[:, 0]
    if cameras is None:
        return _blend(points, starts, frames), None
    flip = points.new_ones(*points.shape[:2], 1, 1, 3)
    flip[..., 0, 0, 2] = _mirror_signs(points, starts)
    turned = _join_rotations(complete_rotation(cameras * flip), starts, frames)
    return _blend(points * flip, starts, frames), turned[..., :2, :]


def _blend(parts: Tensor, starts: list[int], frames: int) -> Tensor:
    """Windows (K, W, T, ...) of K clips as one run (K, frames, ...) each."""
    return blend_windows(parts.movedim(0, 2), starts, frames).movedim(1, 0)


def _mirror_signs(parts: Tensor, starts: list[int]) -> Tensor:
    """Signs (K, W) that give a clip's windows (K, W, T, N, 3) one mirror: their depths agree where they overlap."""
    window = parts.shape[2]
    agree = [parts.new_ones(len(parts))]
    for i in range(1, len(starts)):
        shared = starts[i - 1] + window - starts[i]
        overlap = (parts[:, i - 1, window - shared :, :, 2] * parts[:, i, :shared, :, 2]).sum((-2, -1))
        agree.append(torch.where(overlap < 0, -torch.ones_like(overlap), torch.ones_like(overlap)))
    return torch.stack(agree, 1).cumprod(1)


def _join_rotations(parts: Tensor, starts: list[int], frames: int) -> Tensor:
    """Rotations (K, W, T, 3, 3), each window in a world of its own, as runs (K, frames, 3, 3) in that of the first."""
    window = parts.shape[2]
    turned = [parts[:, 0]]
    for i in range(1, len(starts)):
        shared = starts[i - 1] + window - starts[i]
        between = nearest_rotation((parts[:, i, :shared].mT @ turned[-1][:, window - shared :]).sum(1))
        turned.append(parts[:, i] @ between[:, None])
    return nearest_rotation(_blend(torch.stack(turned, 1), starts, frames))
