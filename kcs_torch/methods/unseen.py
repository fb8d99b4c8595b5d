"""Joints that no frame shows: no term of an energy moves them, so they are placed by the skeleton."""

from __future__ import annotations

import torch
from torch import Tensor

from kcs_torch.functional.align import centre, procrustes
from kcs_torch.skeleton import Skeleton

__all__ = ["place_unseen"]


def place_unseen(points: Tensor, known: Tensor, skeleton: Skeleton) -> Tensor:
    """Place joints that are never seen where the template has them, seen from their nearest seen neighbour.

    The template is turned onto each frame's seen joints, at one scale for the clip, and mirrored in depth where that
    fits the clip better. Without a template a joint takes its neighbour's place, without a neighbour the middle.

    Args:
        points: (T, N, 3).
        known: (N,), True for joints that some frame shows.
        skeleton: of the N joints.

    Returns:
        (T, N, 3); seen joints are unchanged.
    """
    if bool(known.all()) or not bool(known.any()):
        return points
    weights = known.to(points.dtype)
    local, middle = centre(points, weights)
    offsets = torch.zeros_like(points)
    if skeleton.template is not None:
        rest, _ = centre(skeleton.template_points(dtype=points.dtype, device=points.device), weights)
        fits = []
        for depth in (1.0, -1.0):
            body = (rest * torch.tensor([1.0, 1.0, depth]).to(points)).expand_as(local)
            rotation, scale = procrustes(body, local, weights)
            placed = scale.median() * body @ rotation
            fits.append((((placed - local).square().sum(-1) * weights).sum(), placed))
        offsets = min(fits, key=lambda f: float(f[0]))[1]
    placed = torch.where(known[:, None], local, torch.zeros_like(local))
    done = known.tolist()
    for _ in range(skeleton.num_joints):
        fresh = [(a, b) for p in skeleton.bones for a, b in (p, p[::-1]) if done[a] and not done[b]]
        if not fresh:
            break
        for near, joint in fresh:
            placed = placed.index_copy(-2, torch.tensor([joint], device=points.device),
                                       (placed[:, near] + offsets[:, joint] - offsets[:, near])[:, None])  # fmt: skip
            done[joint] = True
    return torch.where(known[:, None], points, placed + middle)
