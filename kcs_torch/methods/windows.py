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
        points: (W, T, N, 3) in each frame's camera.
        cameras: (W, T, 2, 3), or None where they are known: then the mirror is, too.
        starts: first frames of the windows.
        frames: of the clip.

    Returns:
        Points (frames, N, 3) and cameras (frames, 2, 3), in the mirror and the world of the first window. A single
        window is left as it is.
    """
    if len(starts) == 1:
        return points[0], None if cameras is None else cameras[0]
    if cameras is None:
        return blend_windows(points, starts, frames), None
    flip = points.new_ones(len(starts), 1, 1, 3)
    flip[:, 0, 0, 2] = _mirror_signs(points, starts)
    turned = _join_rotations(complete_rotation(cameras * flip), starts, frames)
    return blend_windows(points * flip, starts, frames), turned[:, :2]


def _mirror_signs(parts: Tensor, starts: list[int]) -> Tensor:
    """Signs (W,) that give all windows (W, T, N, 3) the same mirror: neighbours' depths agree where they overlap."""
    window = parts.shape[1]
    agree = [torch.ones((), dtype=parts.dtype, device=parts.device)]
    for i in range(1, len(starts)):
        shared = starts[i - 1] + window - starts[i]
        overlap = (parts[i - 1, window - shared :, :, 2] * parts[i, :shared, :, 2]).sum()
        agree.append(torch.where(overlap < 0, -torch.ones_like(overlap), torch.ones_like(overlap)))
    return torch.stack(agree).cumprod(0)


def _join_rotations(parts: Tensor, starts: list[int], frames: int) -> Tensor:
    """Rotations (W, T, 3, 3), each window in a world frame of its own, as one run (frames, 3, 3) in the first's."""
    window = parts.shape[1]
    turned = [parts[0]]
    for i in range(1, len(starts)):
        shared = starts[i - 1] + window - starts[i]
        between = nearest_rotation((parts[i, :shared].mT @ turned[-1][window - shared :]).sum(0))
        turned.append(parts[i] @ between)
    return nearest_rotation(blend_windows(torch.stack(turned), starts, frames))
