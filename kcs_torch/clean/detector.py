"""Whether a detector found the joints, so that their errors last, and how far off they are then."""

from __future__ import annotations

import torch
from torch import Tensor

from kcs_torch.nn.posture import has_trunk
from kcs_torch.solvers.noise import measure_noise
from kcs_torch.solvers.spectrum import window_at
from kcs_torch.types import Tracks

__all__ = ["detected", "detector_deviation", "found_by_detector"]

PARTLY, GRADES = 0.05, 10
"""Share of confidences below 1, and number of different ones, from which on they are a detector's."""

SKELETONS = (
    *("ap10k", "body25", "body25b", "coco17", "coco18", "halpe26"),
    *("hand21", "mediapipe33", "mpi15", "mpii16", "wholebody63"),
)
"""Whose joints detectors find: noise in them is a detector's."""

NOISY, LOUD = 0.002, 0.0045
"""Noise, a share of the body's size, above which joints of such a skeleton are a detector's; and above which they are
in clips too short to tell it well, or to tell a filter from motion, and those of any skeleton if it lasts. That of
motion capture comes to .0027 where a quick motion looks like it."""

LASTING, FILTERED = 1.2, 10.0
"""Noise of a few frames over that of single ones from which on it lasts, and from which on a filter has been there. Of
white noise it is 1 at most, of eight views of two detectors at 60 frames a second 1.3 to 3, and after a Butterworth
filter 90 to 560. At 30 frames a second noise that lasts is told only where it has been filtered."""

OWN, SMOOTH, SMOOTHED = 0.05, 0.06, 0.03
"""Share that joints do not share of what is a few frames long, from which on it is noise; that of a filtered clip, for
motion capture that was smoothed comes to .05; and of one that has a detector's skeleton."""

DETECTED = 0.027
"""Standard deviation of a joint that a detector is sure of, a share of the body's size, however smooth: what it gets
wrong it gets wrong for many frames."""

UNSURE = 0.05
"""Least confidence that counts."""


def detected(tracks: Tracks) -> bool:
    """Whether a detector found the joints, as is known, or as confidences tell: of many values from 0 to 1."""
    if tracks.detector is not None:
        return tracks.detector
    seen = tracks.weights[tracks.weights > 0]
    partly = seen[seen < 1]  # nobody would choose so many
    return len(partly) > PARTLY * len(seen) and len(partly.unique()) > GRADES


def found_by_detector(tracks: Tracks) -> bool:
    """As :func:`detected`; where nothing is known of a body with a template, noise tells, too.

    Noise that lasts for several frames, or that a filter has left, is a detector's, and so is any noise of a skeleton
    that detectors have. In a clip too short to tell a filter from quick motion only the latter is, if it is loud.
    """
    known = detected(tracks)
    if known or tracks.detector is not None or not has_trunk(tracks.skeleton):
        return known
    noise = measure_noise(tracks.points, tracks.weights, window=window_at(tracks.rate))
    if noise is None:
        return False
    ratio, usual = noise.restless / max(noise.white, 1e-12), tracks.skeleton.name in SKELETONS
    filtered = ratio > FILTERED
    if filtered and noise.told:
        return noise.share > (SMOOTHED if usual else SMOOTH)
    if usual:
        return max(noise.white, noise.restless) > (NOISY if noise.restless > 0 and not filtered else LOUD)
    return not filtered and ratio > LASTING and noise.share > OWN and noise.restless > LOUD


def detector_deviation(tracks: Tracks) -> Tensor:
    """Standard deviation (T, N), a share of the body's size, of joints that a detector found; else 0."""
    if not detected(tracks):
        return torch.zeros_like(tracks.weights)
    return DETECTED / tracks.weights.clamp_min(UNSURE).sqrt()
