"""The root's path in depth, from feet that stand still before a camera that stands still."""

from __future__ import annotations

import torch
from torch import Tensor

from kcs_torch.functional.temporal import blend_windows, standing, window_starts
from kcs_torch.types import Tracks

__all__ = ["root_depth"]

WINDOW, OVERLAP = 400, 80
"""Frames that are solved together, and by how many windows overlap."""

SLIP, CHANGE = 0.012, 0.008
"""Standard deviations of a standing foot's speed, and of the root's acceleration: shares of the body's radius per
frame at 30 frames a second."""

ENOUGH = 0.5
"""Share of frames in which some contact point must stand."""


def root_depth(points: Tensor, tracks: Tracks) -> tuple[Tensor | None, str]:
    """The root's depth in each frame, relative to the first.

    While a foot stands still in the image it stands still in space, so that the root's depth moves against it:
    min over v of 1/2 sum_tc c_tc log(1 + ((dz_tc + v_t)/s)^2) + 1/2 sum_t ((v_t - v_t-1)/a)^2, by iteratively
    reweighted least squares.

    Args:
        points: (T, N, 3), depth relative to the body's middle.
        tracks: they were made from, with the skeleton's contact points.

    Returns:
        (T,) in the unit of the points, and a sentence; None where there are too few contacts.
    """
    contacts = list(tracks.skeleton.contacts)
    if not contacts:
        return None, f"no root depth: skeleton '{tracks.skeleton.name}' has no contact points"
    if len(points) < 3:
        return None, "no root depth: too few frames"
    slow = 30.0 / (tracks.fps or 30.0)
    sure = standing(tracks.points[:, contacts], tracks.weights[:, contacts])
    if float((sure.amax(-1) > 0.5).double().mean()) < ENOUGH:
        return None, "no root depth: the feet hardly ever stand still in the image"
    body = points - points.mean(1, keepdim=True)
    top = body.abs().amax().clamp_min(torch.finfo(points.dtype).tiny)  # squares must not overflow
    radius = (body / top).square().sum(-1).mean().sqrt().clamp_min(1e-3) * top
    move = points[:, contacts, 2].diff(dim=0) / radius  # (T - 1, C), while the root stays
    weight = torch.minimum(sure[1:], sure[:-1])
    frames = len(move)
    size = min(WINDOW, frames)
    starts = window_starts(frames, size, min(OVERLAP, size - 1))
    cut = lambda x: torch.stack([x[s : s + size] for s in starts])  # noqa: E731
    move, weight = cut(move), cut(weight)
    difference = torch.eye(size, dtype=points.dtype, device=points.device).diff(dim=0)
    smooth = difference.mT @ difference / (CHANGE * slow**2) ** 2
    speed = torch.zeros_like(move[..., 0])
    slip = SLIP * slow
    for _ in range(10):
        pull = weight / (1 + ((move + speed[..., None]) / slip).square()) / slip**2
        normal = smooth + torch.diag_embed(pull.sum(-1) + 1e-3 / slip**2)
        speed = torch.linalg.solve(normal, -(pull * move).sum(-1))
    speed = blend_windows(speed, starts, frames)
    path = torch.cat([speed.new_zeros(1), speed.cumsum(0)]) * radius
    return path, "root depth from feet that stand still, relative to the first frame; the camera must not move"
