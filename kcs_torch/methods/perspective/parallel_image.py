"""What a method's solution for parallel rays tells of the image: how it is without noise, and how noisy it was."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from kcs_torch.clean.detector import detector_deviation
from kcs_torch.functional.guarded import or_one
from kcs_torch.functional.weights import rms
from kcs_torch.methods.clips.unseen import gap_deviation
from kcs_torch.methods.pkc.objective import usual_posture
from kcs_torch.nn.posture import has_trunk
from kcs_torch.types import Reconstruction, Tracks

__all__ = ["body_unit", "clean_image", "image_noise"]


def clean_image(lifted: Reconstruction) -> Tensor:
    """A method's image (T, N, 2) under parallel rays: of all joints, and without noise."""
    flat = lifted.points[..., :2]
    middle = flat.mean(1, keepdim=True)
    return middle + lifted.scales[:, None, None] * (flat - middle)


def image_noise(tracks: Tracks, flat: Tensor, unit: float) -> Tensor:
    """Standard deviation (T, N) of tracks' joints in their clean image (T, N, 2), for a body of 1.75."""
    off = flat - flat.mean(1, keepdim=True)
    size = rms(off, torch.ones_like(off[..., 0])) / unit
    stray = (flat - tracks.points.detach()).square().sum(-1)[tracks.seen]
    level = math.sqrt(float(stray.median()) / 1.39) / unit / 2 if len(stray) else 0.0  # whatever outliers there are
    share = gap_deviation(off / or_one(size * unit), tracks.seen, tracks.rate)
    return (size * share.maximum(detector_deviation(tracks))).clamp_min(level)


def body_unit(lifted: Reconstruction) -> float:
    """The unit in which the body is about as large as a person of 1.75."""
    if has_trunk(lifted.skeleton):
        usual = usual_posture(lifted.skeleton, lifted.lengths.dtype, lifted.lengths.device).rest_lengths
        unit = float((lifted.lengths / usual).median())
    else:
        points = lifted.points - lifted.points.mean(1, keepdim=True)
        unit = 2 * float(points.square().sum(-1).mean().sqrt())
    return unit if 0 < unit < math.inf else 1.0
