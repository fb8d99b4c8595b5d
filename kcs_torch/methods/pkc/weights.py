"""The constants of PKC's objective, and how they change with the frame rate and the pace of a motion."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from kcs_torch.functional.chain import bone_vectors
from kcs_torch.methods.pkc.trunk import image_scale
from kcs_torch.nn.lengths import free_bones
from kcs_torch.skeleton import Skeleton

__all__ = ["ANCHOR", "CORNER", "HEAVY", "NOISE", "Weights", "at_pace", "in_noise", "pace_of", "slowness", "wide"]

NOISE, CORNER = 0.8, 0.3
"""Share of the noise's variance that is not to be explained, and how gently its cost sets in."""

HEAVY = 4.0
"""Squared deviations of a length from here on count like an outlier's, in variances."""

ANCHOR = 0.01
"""Standard deviation of a length that is known from elsewhere in the clip, as a share."""

WALK = 4.3
"""Frames in which a walking person's bones change in the image by as much as they stray, at 30 frames a second."""

STRAY = 0.1
"""How far bones' images stray within a clip, a share of their length, where it shows poses that have nothing to do with
each other: as of a person who walks towards the camera. Of n frames that are alike, as they stray by a share s of that,
n s^2 are independent."""

LEAST = 4.0
"""Independent frames that any clip counts as, at least."""

CALM, LOOSEST = 0.0008, 8.0
"""Noise of bones' images, for a body of 1.75, at which smoothness counts half: the tracks were smoothed before, and
where noise lets lengths hold depths only loosely, the smoothest depths are those that move least. And how many times as
large accelerations may be at most: a detector's errors, which were not smoothed, make depths tremble beyond it."""


@dataclass(frozen=True)
class Weights:
    """Weights of the objective's terms, for a body of 1.75 and 30 frames a second.

    Attributes:
        length: standard deviation of a bone's length about its mean.
        acceleration: standard deviation of a bone's second difference in depth, without noise.
        posture: frames that count as one for the posture.
        kappa: independent frames that the template's directions are worth.
        foreshortening: frames that count as one for the foreshortening.
        hinge: weight of a hinge in a frame.
        adduction: weight of an arm or a leg that reaches across the body, in a frame.
        stance: strength of the feet's place beneath the trunk, in a clip.
        sine: sine of a wrong bend, or beyond the limit, that costs half its weight.
        proportions: usual deviation of a length, as a share.
        twins: usual difference between left and right, as a share.
        contact: weight of feet that stand still, in a frame.
        slip: standard deviation of a standing foot's change of depth from a frame to the next.
        change: standard deviation of the second difference of the trunk's own.
    """

    length: float = 0.003
    acceleration: float = 0.08
    posture: float = 6.0
    kappa: float = 20.0
    foreshortening: float = 10.0
    hinge: float = 0.08
    adduction: float = 0.03
    stance: float = 12.0
    sine: float = 0.05
    proportions: float = 0.08
    twins: float = 0.03
    contact: float = 1.0
    slip: float = 0.009
    change: float = 0.009


def at_pace(weights: Weights, rate: float, pace: float = 1.0) -> Weights:
    """Weights for another frame rate, and for a body that moves slowly.

    More frames a second move less from one to the next; and frames tell no more for being many, but for being
    different: see :func:`pace_of`.
    """
    slow = 30.0 / rate
    return replace(
        weights,
        acceleration=weights.acceleration * slow**2,
        posture=weights.posture * pace,
        foreshortening=weights.foreshortening * pace,
        hinge=weights.hinge / pace,
        adduction=weights.adduction / pace,
        contact=weights.contact / pace,
        slip=weights.slip * slow,
        change=weights.change * slow**2,
    )


def in_noise(weights: Weights, noise: float) -> Weights:
    """Weights for bones whose images are off by ``noise``: there smoothness would take motion away."""
    return replace(weights, acceleration=weights.acceleration * min(math.hypot(1.0, noise / CALM), LOOSEST))


def pace_of(image: Tensor, skeleton: Skeleton, rate: float) -> float:
    """How many frames tell as much as one of a walking person's at 30 frames a second, usually at least ``rate / 30``.

    As :func:`slowness` says. But no clip, not even a single image, tells less of a body's posture than :data:`LEAST` of
    such frames: else a template whose proportions are not the body's would have it lean, which makes all bones look
    shorter.

    Args:
        image: (T, N, 2).
        skeleton: with a template or proportions.
        rate: frames a second.
    """
    return min(slowness(image, skeleton, rate), len(image) / (LEAST * Weights.posture))


def slowness(image: Tensor, skeleton: Skeleton, rate: float) -> float:
    """The deviation of the bones' images over that of their changes, in which a pose changes into another.

    It is over the same of a walking person, and at least ``rate / 30``; arguments as of :func:`pace_of`.
    """
    least = rate / 30
    usual = skeleton.relative_lengths(dtype=image.dtype, device=image.device)
    if len(image) < 3 or usual is None:
        return least
    bones, usual = skeleton.bone_index(device=image.device), usual.to(image).clamp_min(1e-3)
    vectors = bone_vectors(image, bones)
    rigid = skeleton.rigid_mask(device=image.device)
    scale = image_scale(image, usual, bones, rigid, torch.zeros_like(vectors[..., 0]))
    vectors = (vectors / usual[:, None])[:, free_bones(skeleton).to(image.device) > 0]
    moved = float(vectors.diff(dim=0).square().sum((1, 2)).mean().sqrt())
    spread = float((vectors - vectors.mean(0)).square().sum((1, 2)).mean().sqrt())
    several = STRAY * float(scale) * math.sqrt(vectors.shape[1])  # the spread of several poses
    if 0 < spread < several:
        spread = several**2 / spread
    time = spread / moved if moved > spread / len(image) else float(len(image))
    return max(least, time / WALK)


def wide(value: Tensor | float, dims: int) -> Tensor | float:
    """A number, or one for each hypothesis (H,), with further dimensions of one."""
    return value[(..., *[None] * dims)] if isinstance(value, Tensor) else value
