"""The root's path in depth, from feet that stand still before a camera that stands still."""

from __future__ import annotations

import torch
from torch import Tensor

from kcs_torch.functional.temporal import standing
from kcs_torch.functional.tridiagonal import solve_tridiagonal
from kcs_torch.types import Tracks

__all__ = ["root_depth"]

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
        points: (..., T, N, 3) of one or several solutions, depth relative to the body's middle.
        tracks: they were made from, with the skeleton's contact points.

    Returns:
        (..., T) in the unit of the points, and a sentence; None where there are too few contacts.
    """
    contacts = list(tracks.skeleton.contacts)
    if not contacts:
        return None, f"no root depth: skeleton '{tracks.skeleton.name}' has no contact points"
    if points.shape[-3] < 3:
        return None, "no root depth: too few frames"
    slow = 30.0 / (tracks.fps or 30.0)
    sure = standing(tracks.points[:, contacts], tracks.weights[:, contacts])
    if float((sure.amax(-1) > 0.5).double().mean()) < ENOUGH:
        return None, "no root depth: the feet hardly ever stand still in the image"
    body = points - points.mean(-2, keepdim=True)
    top = body.abs().amax().clamp_min(torch.finfo(points.dtype).tiny)  # squares must not overflow
    radius = ((body / top).square().sum(-1).mean((-2, -1)).sqrt().clamp_min(1e-3) * top)[..., None]
    move = points[..., contacts, 2].diff(dim=-2) / radius[..., None]  # (..., T - 1, C), while the root stays
    weight = torch.minimum(sure[1:], sure[:-1])
    speed = torch.zeros_like(move[..., 0])
    slip, change = SLIP * slow, CHANGE * slow**2
    tie = torch.full_like(speed[..., 1:], -1 / change**2)  # of each speed to the next
    own = torch.nn.functional.pad(-tie, (0, 1)) + torch.nn.functional.pad(-tie, (1, 0))
    for _ in range(10):
        pull = weight / (1 + ((move + speed[..., None]) / slip).square()) / slip**2
        speed = solve_tridiagonal(own + pull.sum(-1) + 1e-3 / slip**2, tie, -(pull * move).sum(-1))
    path = torch.nn.functional.pad(speed.cumsum(-1), (1, 0)) * radius
    return (
        path,
        "motion in depth found from feet that stand still, from the first frame on: right only for a fixed camera",
    )
