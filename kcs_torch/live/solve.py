"""Solving the window again: what the filter is told of the body now and then."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import torch
from torch import Tensor

from kcs_torch.errors import KcsError
from kcs_torch.functional.chain import bone_lengths, bone_vectors
from kcs_torch.functional.ranks import median
from kcs_torch.live.filter import Shape, Told
from kcs_torch.live.size import longest_image
from kcs_torch.methods.pkc import PKC
from kcs_torch.nn.posture import PostureEnergy, has_trunk
from kcs_torch.skeleton import Skeleton
from kcs_torch.types import Tracks

__all__ = ["Solved", "solve_window"]

STEPS, ROUNDS = 12, 1
"""Most L-BFGS steps of a refinement, and rounds of discrete moves, of a window: the frames to come do not wait."""

TURNS = 0.9
"""Share of a window's frames in which a body without a trunk looks smaller than usual, as it turns."""


class Solved(NamedTuple):
    """What a window's frames tell: the body, and each frame's pose."""

    shape: Shape
    told: Told


def solve_window(method: PKC, skeleton: Skeleton, image: Tensor, weights: Tensor, rate: float) -> Solved | None:
    """Solve a window by the method: before a fixed viewpoint where there is a template, else by the viewpoint's turn.

    Args:
        method: whose fields are taken, with fewer steps.
        skeleton: a tree.
        image: (T, N, 2), complete.
        weights: (T, N) confidences, 0 where ``image`` is a guess.
        rate: frames a second.

    Returns:
        The solution, or None where the window tells nothing: a body without extent, or none that the method can solve.
    """
    flat = image - image.mean(1, keepdim=True)
    size = float(flat.square().sum(-1).mean().sqrt())
    if not size > 0:
        return None
    tracks = Tracks(torch.where(weights[..., None] > 0, flat / size, 0.0), weights, skeleton, fps=rate)
    posture = PostureEnergy(skeleton).double() if has_trunk(skeleton) else None
    quick = replace(
        method,
        viewpoint="moving" if posture is None else "fixed",
        alternatives=0,
        rounds=min(method.rounds, ROUNDS),
        steps=min(method.steps, STEPS),
    )
    try:
        with torch.no_grad():
            found = quick.solve(tracks, None)
    except KcsError:
        return None
    points = found.points - found.points.mean(1, keepdim=True)
    bones, rigid = skeleton.bone_index(), list(skeleton.rigid)
    length = median(bone_lengths(points, bones), 0)
    if posture is None:
        factor, rotations, trunk = 0.5, torch.eye(3).to(points).expand(len(points), 3, 3), points.new_zeros(0, 3)
    else:
        factor = 1 / float((length / posture.rest_lengths)[rigid].median().clamp_min(1e-9))
        rotations = posture.frame(points)
        part = factor * points[:, posture.trunk]
        trunk = ((part - part.mean(1, keepdim=True)) @ rotations).mean(0)
    sizes = (found.scales / found.scales[-1]).log()  # it may change in the image: that of the newest frame counts
    shape = Shape(factor / (size * float(found.scales[-1])), (length * factor).clamp_min(1e-6), trunk)
    looks = longest_image(image, weights > 0, bones[rigid], shape.lengths[rigid] / shape.factor) - sizes
    looks = looks[looks.isfinite()]
    if len(looks):
        shape = replace(shape, usual=float(torch.quantile(looks, TURNS if posture is None else 0.5)))
    if found.deviation is not None:
        shape = replace(shape, deviation=factor * found.deviation.square().mean(0).sqrt())
    return Solved(shape, Told(factor * bone_vectors(points, bones)[..., 2], rotations, sizes))
