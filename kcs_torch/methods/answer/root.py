"""The root's path in depth, from feet that stand still before a camera that stands still."""

from __future__ import annotations

import torch
from torch import Tensor

from kcs_torch.functional import temporal
from kcs_torch.solvers.standing import root_velocity
from kcs_torch.types import Tracks

__all__ = ["ABSENT", "FOUND", "root_depth", "standing_feet"]

ABSENT = "no root depth: "
"""How the sentence begins that says why feet do not tell the root's depth."""

FOUND = "motion in depth found from feet that stand still, from the first frame on: right only for a fixed camera"
"""The sentence that says that they do."""

SLIP, CHANGE = 0.012, 0.008
"""Standard deviations of a standing foot's speed, and of the root's acceleration: shares of the body's radius per
frame at 30 frames a second."""

FASTEST = 3e5
"""Frames a second beyond which neighbouring frames are tied no closer: the equations would be singular."""

ENOUGH = 0.5
"""Share of frames in which some contact point must stand."""


def standing_feet(tracks: Tracks) -> Tensor | None:
    """How surely each contact point of the skeleton stands still (T, C); None where they hardly ever do."""
    contacts = list(tracks.skeleton.contacts)
    if not contacts:
        return None
    sure = temporal.standing(tracks.points[:, contacts], tracks.weights[:, contacts])
    return sure if float((sure.amax(-1) > 0.5).double().mean()) >= ENOUGH else None


def root_depth(points: Tensor, tracks: Tracks, standing: Tensor | None = None) -> tuple[Tensor | None, str]:
    """The root's depth in each frame, relative to the first.

    While a foot stands still in the image it stands still in space, so that the root's depth moves against it: see
    :func:`kcs_torch.solvers.standing.root_velocity`.

    Args:
        points: (..., T, N, 3) of one or several solutions, depth relative to the body's middle.
        tracks: they were made from, with the skeleton's contact points.
        standing: (T, C) how surely these stand still; None to tell it from the tracks as they are.

    Returns:
        (..., T) in the unit of the points, and a sentence; None where there are too few contacts.
    """
    contacts = list(tracks.skeleton.contacts)
    if not contacts:
        return None, f"{ABSENT}skeleton '{tracks.skeleton.name}' has no contact points"
    if points.shape[-3] < 3:
        return None, f"{ABSENT}too few frames"
    slow = 30.0 / min(tracks.rate, FASTEST)
    sure = standing_feet(tracks) if standing is None else standing
    if sure is None:
        return None, f"{ABSENT}the feet hardly ever stand still in the image"
    body = points - points.mean(-2, keepdim=True)
    top = body.abs().amax().clamp_min(torch.finfo(points.dtype).tiny)  # squares must not overflow
    radius = ((body / top).square().sum(-1).mean((-2, -1)).sqrt().clamp_min(1e-3) * top)[..., None]
    move = points[..., contacts, 2].diff(dim=-2) / radius[..., None]  # (..., T - 1, C), while the root stays
    weight = torch.minimum(sure[1:], sure[:-1])
    # In double precision: fast cameras tie neighbouring frames so closely that single precision knows nothing else.
    speed = root_velocity(move.double(), weight.double(), SLIP * slow, CHANGE * slow**2)
    path = torch.nn.functional.pad(speed.cumsum(-1), (1, 0)).to(radius) * radius
    return path, FOUND
