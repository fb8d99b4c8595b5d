"""Film motion: random cameras, noise and hidden joints, for all windows of a batch at once."""

from __future__ import annotations

import torch
from torch import Tensor

from kcs_torch.functional import orbit
from kcs_torch.skeleton import Skeleton

__all__ = ["RUN", "film", "hidden", "random_cameras"]

RUN = 10
"""Frames for which a joint stays hidden, where it is so for more than one."""


def random_cameras(shape: tuple[int, ...], pitch: tuple[float, float], generator: torch.Generator) -> Tensor:
    """World-to-camera rotations (*shape, 3, 3), from any side alike and looking down by ``pitch`` degrees."""
    yaw, down = torch.rand(2, *shape, generator=generator)
    tilt = torch.deg2rad(pitch[0] + (pitch[1] - pitch[0]) * down)
    c, s, o, i = tilt.cos(), tilt.sin(), torch.zeros_like(tilt), torch.ones_like(tilt)
    rows = ((i, o, o), (o, c, -s), (o, s, c))
    return torch.stack([torch.stack(row, -1) for row in rows], -2) @ orbit(360 * yaw)


def hidden(shape: tuple[int, ...], share: float, generator: torch.Generator) -> Tensor:
    """Tell which joints are hidden, (..., T, N): half of them for a frame, half for :data:`RUN` frames.

    Every joint of every frame is hidden with probability ``share``, in runs from before the first frame too.
    """
    kind = 1 - (1 - share) ** 0.5  # hidden by either of two causes
    once = torch.rand(shape, generator=generator) < kind
    begin = 1 - (1 - kind) ** (1 / RUN)
    *batch, frames, joints = shape
    begins = torch.rand(*batch, frames + RUN - 1, joints, generator=generator) < begin
    return once | begins.unfold(-2, RUN, 1).any(-1)


def film(
    points: Tensor,
    cameras: Tensor,
    skeleton: Skeleton,
    *,
    noise: float,
    occlusion: float,
    generator: torch.Generator,
    known: Tensor | None = None,
) -> tuple[Tensor, Tensor]:
    """Project motion by parallel rays, with noise and hidden joints.

    Args:
        points: (..., T, N, 3) of the world.
        cameras: (..., 3, 3).
        skeleton: of the N joints; its virtual ones are made from what is seen of the others, as of any tracks.
        noise: standard deviation, in the unit of the points.
        occlusion: expected share of hidden joints.
        generator: for noise and hidden joints.
        known: (..., T, N) False where there is no point to see.

    Returns:
        tracks (..., T, N, 2), 0 where unseen, and weights (..., T, N), 1 where seen.
    """
    image = (points[..., : skeleton.num_observed, :] @ cameras[..., None, :2, :].mT).clone()
    if noise:
        image = image + noise * torch.randn(image.shape, generator=generator, dtype=image.dtype)
    weights = torch.ones_like(image[..., 0])
    if known is not None:
        weights = known[..., : skeleton.num_observed].expand(weights.shape).to(weights)
    if occlusion:
        weights = weights.masked_fill(hidden(tuple(weights.shape), occlusion, generator), 0.0)
    image, weights = skeleton.complete(image, weights)
    return torch.where(weights[..., None] > 0, image, torch.zeros_like(image)), weights
