"""Joints that some frames do not show: told by their noise, and filled in by a solution in space."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from kcs_torch.functional.ranks import kth_smallest
from kcs_torch.methods.clips.lockstep import Search
from kcs_torch.methods.pkc.descents import Descent
from kcs_torch.methods.pkc.moving_search import FINER, soften
from kcs_torch.methods.pkc.moving_solutions import MovingView, agreement
from kcs_torch.methods.pkc.moving_view import relative_weights
from kcs_torch.solvers.procrustean import FINE, Pose

__all__ = ["EXACT", "fill_gaps", "gaps_of", "likelier", "usual_noise"]

GAP, SHOWN = 3.0, 0.1
"""How many times as noisy a joint is in a frame that does not show it, at least, as in frames that do; and the share of
the frames that do, at least."""

EXACT = 0.001
"""Standard deviation of what is shown in exact tracks with gaps, a share of the body's size, of bodies without a
template: x and y are unknowns then, which gaps need; held where each joint's own path has them, all is bent by them."""

ALIKE, OTHER, DEARER = 0.9, 0.7, 6.0
"""Correlation of depths from which on two solutions are one, and below which they are bodies that differ; and by how
much a frame one has to be dearer so as to be no rival."""

SURER = 0.2
"""Share of a gap's noise that is left where it is filled in space."""


def gaps_of(noise: Tensor) -> Tensor:
    """Which joints (T, N) are seen in other frames only, of their noise (T, N) in the image."""
    usual = _shown(noise)
    return (noise > GAP * usual) & _ever(usual)


def usual_noise(noise: Tensor) -> float:
    """Median of the noise (T, N), of joints that some frame shows: that of others is a guess."""
    return float(noise[:, _ever(_shown(noise))].median())


def fill_gaps(image: Tensor, polished: Tensor, noise: Tensor) -> tuple[Tensor, Tensor]:
    """An image (T, N, 2), centred, whose gaps are filled by what other joints and the bones do; and its noise (T, N).

    Args:
        image: (T, N, 2), centred, whose gaps were filled by each joint's own path.
        polished: (T, N, 2) of a solution that was free to leave the image where it is noisy.
        noise: (T, N) standard deviation of the joints in the image.
    """
    gap = gaps_of(noise)
    rest = (~gap)[..., None].to(image)
    polished = polished - (rest * (polished - image)).sum(1, keepdim=True) / rest.sum(1, keepdim=True).clamp_min(1)
    image = torch.where(gap[..., None], polished, image)
    noise = torch.where(gap, (SURER * noise).maximum(_shown(noise)), noise)
    return image - image.mean(1, keepdim=True), noise


def likelier(free: MovingView, held: MovingView, image: Tensor, noise: Tensor) -> Search[Descent, Pose, MovingView]:
    """The likelier of two solutions of an image (T, N, 2) that both may leave in gaps now, by their noise (T, N).

    Args:
        free: that might leave it from the start.
        held: that might not. Its lead is one only if both agree: what it led is as wrong as what was held.
        image: of the tracks.
        noise: standard deviation of the joints in it.
    """
    stages, weights = tuple(soften(stage, EXACT) for stage in FINE), relative_weights(noise, EXACT)
    poses = []
    for moving in (free, held):
        pose, pull = moving.pose, FINER[moving.stiffness]
        (pose,) = yield [
            Descent(image, pose.points, pose.rotations, moving.bones, weights, moving.rigid, pull, EXACT, stages)
        ]
        poses.append(pose)
    agree = agreement(*(pose.points[0, ..., 2] for pose in poses))
    moving, pose = min(zip((free, held), poses, strict=True), key=lambda one: float(one[1].objective[0]))
    dearer = float((poses[0].objective[0] - poses[1].objective[0]).abs()) / len(image)
    lead = held.lead if agree > ALIKE else 0.0
    return replace(moving, pose=pose, lead=lead, rivalled=agree < OTHER and dearer < DEARER)


def _ever(usual: Tensor) -> Tensor:
    """Which joints (N,) some frame shows, of their noise where they are shown."""
    return usual <= GAP * usual.amin()


def _shown(noise: Tensor) -> Tensor:
    """Noise (N,) of each joint where it is shown."""
    return kth_smallest(noise, 1 + int(SHOWN * (len(noise) - 1)), 0)
