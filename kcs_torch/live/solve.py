"""Solving the window again, in slices: what the filter is told of the body now and then."""

from __future__ import annotations

import math
import warnings
from collections.abc import Generator
from dataclasses import replace
from typing import NamedTuple

import torch
from torch import Tensor

from kcs_torch.functional.chain import bone_lengths, bone_vectors
from kcs_torch.functional.temporal import interpolate
from kcs_torch.live.filter import Known, Shape
from kcs_torch.methods.pkc import PKC, fixed_view
from kcs_torch.methods.pkc.body import Body
from kcs_torch.methods.pkc.limbs import limbs_of
from kcs_torch.methods.pkc.objective import Objective
from kcs_torch.skeleton import Skeleton
from kcs_torch.solvers.denoise import denoise_tracks
from kcs_torch.types import Tracks

__all__ = ["Solution", "solve_chain", "solve_window"]

SLICE = 4
"""L-BFGS steps of one slice."""

KEPT = 4
"""Hypotheses that are refined well."""


CLEAN, LEFT, FILLED = 0.003, 0.45, 0.015
"""Shares: of the body's size, the noise below which frames are taken as they are; of the noise, what smoothing leaves;
of the body's size, the deviation of a joint that is filled in."""


class Solution(NamedTuple):
    """What a window solve finds: the body, what the clip's frames show of it, and how many there are."""

    shape: Shape
    known: Known
    frames: int


def solve_window(
    skeleton: Skeleton, image: Tensor, weights: Tensor, rate: float, *, stride: int, steps: int, warm: Tensor
) -> Generator[None, None, Solution]:
    """Solve a window of a body with a template before a fixed viewpoint; yields after each slice of the work.

    Args:
        skeleton: with a template, spreads and a trunk.
        image: (T, N, 2), complete.
        weights: (T, N) confidences, 0 where ``image`` is a guess.
        rate: frames a second.
        stride: every so many frames are solved, the last one among them.
        steps: L-BFGS steps of each refinement.
        warm: (T, N) depths of the poses so far, in the tracks' units, as a further hypothesis.
    """
    smooth, noise = _clean(image, weights)
    yield
    pick = torch.arange((len(image) - 1) % stride, len(image), stride)
    few = smooth[pick] - smooth[pick].mean(1, keepdim=True)
    body = Body(skeleton, few, rate / stride, noise[pick])
    found = fixed_view(skeleton, body.image, rate=rate / stride, noise=body.noise, rounds=0, steps=1)
    z = warm[pick] * body.factor
    usual = body.objective.posture.rest_lengths
    own = bone_lengths(torch.cat([body.image, z[..., None]], -1), body.objective.bones).median(0).values
    depth = torch.cat([found.depth[:KEPT], z[None]])
    lengths = torch.cat([found.lengths[:KEPT], torch.where(own > 1e-3 * usual, own, usual)[None]])
    yield
    depth, lengths = yield from _descend(body.objective, depth, lengths, steps)
    flips = _flips(skeleton, body.objective, depth[0])
    if len(flips):
        more = torch.cat([depth[:1], flips]), lengths[:1].expand(1 + len(flips), -1)
        few_depth, few_lengths = yield from _descend(body.objective, *more, max(steps // 3, 1))
        depth, lengths = yield from _descend(body.objective, few_depth[:KEPT], few_lengths[:KEPT], steps)
    posture = body.objective.posture
    points = torch.cat([body.image, depth[0, ..., None]], -1)
    rotations = posture.frame(points)
    trunk = points[:, posture.trunk]
    rest = ((trunk - trunk.mean(1, keepdim=True)) @ rotations).mean(0)
    dz = bone_vectors(depth[0, ..., None], posture.bones)[..., 0]
    time = torch.arange(len(image))
    known = torch.zeros(len(image), 1, dtype=torch.bool)
    known[pick] = True
    full = dz.new_zeros(len(image), 1, dz.shape[1])
    full[pick] = dz[:, None]
    nearest = ((time - pick[0]).clamp_min(0) + stride // 2).div(stride, rounding_mode="floor").clamp_max(len(pick) - 1)
    shape = Shape(float(body.factor), lengths[0], rest)
    return Solution(shape, Known(interpolate(full, known)[:, 0], rotations[nearest]), len(image))


def solve_chain(
    skeleton: Skeleton, image: Tensor, weights: Tensor, rate: float, *, stride: int, method: PKC
) -> Generator[None, None, Solution]:
    """Solve a window of a body without a template by the viewpoint's turn, in one slice."""
    pick = torch.arange((len(image) - 1) % stride, len(image), stride)
    tracks = Tracks(image[pick], weights[pick], skeleton, fps=rate / stride)
    with warnings.catch_warnings():  # the pose says whether it is ready, not a warning in every window
        warnings.simplefilter("ignore")
        result = replace(method, viewpoint="moving", alternatives=0)(tracks)
    yield
    bones = skeleton.bone_index()
    centred = image - image.mean(1, keepdim=True)
    factor = 0.5 / float(centred.square().sum(-1).mean().sqrt())
    dz = bone_vectors(result.points, bones)[..., 2] * factor
    full = dz.new_zeros(len(image), 1, dz.shape[1])
    full[pick] = dz[:, None]
    known = torch.zeros(len(image), 1, dtype=torch.bool)
    known[pick] = True
    eye = torch.eye(3, dtype=image.dtype).expand(len(image), 3, 3)
    shape = Shape(factor, result.lengths * factor, image.new_zeros(0, 3))
    return Solution(shape, Known(interpolate(full, known)[:, 0], eye), len(image))


def _clean(image: Tensor, weights: Tensor) -> tuple[Tensor, Tensor]:
    """The window without noise, gaps and outliers, and the noise (T, N) that is left."""
    never = (weights > 0).sum(0) == 0
    clean = denoise_tracks(image, torch.where(never, weights.new_ones(()), weights))
    size = float((image - image.mean(1, keepdim=True)).square().sum(-1).mean().sqrt())
    level = float(clean.noise.median())
    keep = (weights > 0) & ~clean.outliers
    exact = keep if level <= CLEAN * size else torch.zeros_like(keep)
    left = 0.0 if level <= CLEAN * size else LEFT * level
    noise = torch.where(keep, left, math.hypot(left, FILLED * size)).to(image)
    return torch.where(exact[..., None], image, clean.points), noise


def _descend(
    objective: Objective, depth: Tensor, lengths: Tensor, steps: int
) -> Generator[None, None, tuple[Tensor, Tensor]]:
    """Refine hypotheses (H, T, N), (H, B) a slice of steps at a time; best first."""
    for begin in range(0, steps, SLICE):
        depth, lengths, _, _ = objective.minimise(depth, lengths, min(SLICE, steps - begin))
        yield
    return depth, lengths


def _flips(skeleton: Skeleton, objective: Objective, depth: Tensor) -> Tensor:
    """The pose (T, N) with one bone, or both, of each two-bone limb mirrored in depth, (F, T, N)."""
    dz = bone_vectors(depth[..., None], objective.bones)[..., 0]
    out = [dz.new_zeros(0, *depth.shape)]
    for limb in limbs_of(skeleton, objective.posture.trunk.tolist()):
        if limb.inner is not None:
            for part in ((limb.bones[0],), (limb.bones[1],), limb.bones):
                flipped = dz.clone()
                flipped[:, list(part)] *= -1
                out.append((flipped @ objective.tree.mT)[None])
    return torch.cat(out)
