"""Joints that some frames do not show: told by their noise, and filled in by a solution in space."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from kcs_torch.functional.ranks import kth_smallest
from kcs_torch.methods.clips.lockstep import Search
from kcs_torch.methods.pkc.descents import Descent
from kcs_torch.methods.pkc.moving_search import FINER, ROBOT, soften, too_long
from kcs_torch.methods.pkc.moving_view import MovingView, relative_weights
from kcs_torch.solvers.procrustean import FINE, Pose

__all__ = ["fill_gaps", "fillable", "freed", "gaps_of", "usual_noise"]

GAP, SHOWN = 3.0, 0.1
"""How many times as noisy a joint is in a frame that does not show it, at least, as in frames that do; and the share of
the frames that do, at least."""

EXACT = 0.003
"""Standard deviation of what is shown in exact tracks while their gaps are filled, a share of the body's size."""

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


def fillable(image: Tensor) -> bool:
    """Whether one solution of the moving viewpoint may fill the gaps of an image (T, N, 2) for the next."""
    return image.shape[1] > ROBOT and not too_long(image)


def freed(moving: MovingView, image: Tensor, noise: Tensor) -> Search[Descent, Pose, MovingView]:
    """Solutions whose x and y, held so far, may leave the image (T, N, 2) in gaps, by their noise (T, N)."""
    pose, stages = moving.pose, tuple(soften(stage, EXACT) for stage in FINE)
    weights, pull = relative_weights(noise, EXACT), FINER[moving.stiffness]
    (pose,) = yield [
        Descent(image, pose.points, pose.rotations, moving.bones, weights, moving.rigid, pull, EXACT, stages)
    ]
    return replace(moving, pose=pose)


def _ever(usual: Tensor) -> Tensor:
    """Which joints (N,) some frame shows, of their noise where they are shown."""
    return usual <= GAP * usual.amin()


def _shown(noise: Tensor) -> Tensor:
    """Noise (N,) of each joint where it is shown."""
    return kth_smallest(noise, 1 + int(SHOWN * (len(noise) - 1)), 0)
