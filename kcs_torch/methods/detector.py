"""How far off joints are that a detector found."""

from __future__ import annotations

import torch
from torch import Tensor

from kcs_torch.clean.detector import detected
from kcs_torch.types import Tracks

__all__ = ["detector_deviation"]

DETECTED = 0.027
"""Standard deviation of a joint that a detector is sure of, a share of the body's size, however smooth: what it gets
wrong it gets wrong for many frames."""

UNSURE = 0.05
"""Least confidence that counts."""


def detector_deviation(tracks: Tracks) -> Tensor:
    """Standard deviation (T, N), a share of the body's size, of joints that a detector found; else 0."""
    if not detected(tracks):
        return torch.zeros_like(tracks.weights)
    return DETECTED / tracks.weights.clamp_min(UNSURE).sqrt()
