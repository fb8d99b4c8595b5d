"""What a detector's confidences tell of its joints."""

from __future__ import annotations

import torch
from torch import Tensor

__all__ = ["detected", "detector_deviation"]

DETECTED = 0.027
"""Standard deviation of a joint that a detector is sure of, a share of the body's size, however smooth: what it gets
wrong it gets wrong for many frames."""

UNSURE = 0.05
"""Least confidence that counts."""

PARTLY, GRADES = 0.05, 10
"""Share of confidences below 1, and number of different ones, from which on they are a detector's."""


def detected(weights: Tensor) -> bool:
    """Whether confidences (T, N) are a detector's: between 0 and 1, and of many values, which nobody would choose."""
    seen = weights[weights > 0]
    partly = seen[seen < 1]
    return len(partly) > PARTLY * len(seen) and len(partly.unique()) > GRADES


def detector_deviation(weights: Tensor) -> Tensor:
    """Standard deviation (T, N), a share of the body's size, of joints of a detector's confidences; else 0."""
    if not detected(weights):
        return torch.zeros_like(weights)
    return DETECTED / weights.clamp_min(UNSURE).sqrt()
