"""How large the body looks, from frame to frame: it grows as the body comes nearer. Causal, O(1) a frame."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from kcs_torch.functional.chain import bone_vectors

__all__ = ["SizeFilter", "longest_image"]

HIGH = 0.8
"""Share of the bones that look shorter, for their lengths, than the one that tells the body's size."""

SECONDS = 0.5
"""Time in which a difference of size is made good; a steady approach is followed without lag."""

SHRINKS = 3.0
"""Seconds in which a body without a trunk returns to the size that was solved: bones that tilt look short, too."""

SMALL = 0.02
"""Difference of the log of the size that counts as noise: a size that wavers costs more depth than one that is off."""

LARGEST, FASTEST = 0.1, 1.0
"""Largest difference of the log of the size that a frame tells, and largest change of it in a second."""

LEAST = 0.5
"""Share of the bones that must be seen in a frame for it to tell the size."""


def longest_image(image: Tensor, seen: Tensor, bones: Tensor, lengths: Tensor) -> Tensor:
    """Log (...) of how long bones look, for their lengths, that hardly tilt; NaN where too few are seen.

    Args:
        image: (..., N, 2), complete.
        seen: (..., N) bool.
        bones: (B, 2).
        lengths: (B,), in the image's unit.
    """
    both = seen[..., bones].all(-1)  # (..., B)
    share = bone_vectors(image, bones).norm(dim=-1) / lengths.clamp_min(1e-12)
    count = both.sum(-1, keepdim=True)
    rank = (HIGH * (count - 1)).round().long().clamp_min(0)
    chosen = torch.where(both, share, torch.inf).sort(-1).values.gather(-1, rank)
    told = (count > 0) & (count >= LEAST * len(bones)) & (chosen > 0)
    return torch.where(told, chosen, torch.nan)[..., 0].log()


class SizeFilter:
    """Follows the log of the body's size in the image, and its change, by a critically damped filter of fixed gain.

    Args:
        rate: frames a second.

    Attributes:
        value: log of the size over that of the newest solved frame.
        slope: its change a frame.
    """

    def __init__(self, rate: float) -> None:
        self.keep = math.exp(-1 / (rate * SECONDS))
        self.back = math.exp(-1 / (rate * SHRINKS))
        self.most = FASTEST / rate
        self.value = self.slope = 0.0

    def predict(self) -> float:
        """Go on to the next frame: its value, before the frame has been looked at."""
        self.value += self.slope
        return self.value

    def correct(self, bones: float, trunk: float | None) -> None:
        """Take what a frame tells, over what was predicted.

        Args:
            bones: log of how long bones look, over what is usual; NaN where nothing is known.
            trunk: log of the trunk's size, which a turn does not change, NaN where nothing is known; None for a body
                without one, of which only growth is believed at once.
        """
        if trunk is None:
            off = max(bones, 0.0)
            if bones <= 0:
                self.value *= self.back
        elif bones * trunk > 0:  # where they agree, the smaller counts
            off = math.copysign(min(abs(bones), abs(trunk)), bones)
        else:
            off = 0.0 if bones * trunk <= 0 else math.nan
        if math.isnan(off):
            self.slope *= self.keep
            return
        off = math.copysign(min(max(abs(off) - SMALL, 0.0), LARGEST), off)
        self.value += (1 - self.keep**2) * off
        self.slope += (1 - self.keep) ** 2 * off
        self.slope = min(max(self.slope, -self.most), self.most)
        if trunk is None and bones <= 0:
            self.slope *= self.keep
