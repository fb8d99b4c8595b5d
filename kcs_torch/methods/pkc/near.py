"""How near the camera of a body with a template seems, asked while it is searched as under parallel rays."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

from torch import Tensor

from kcs_torch.clean.detector import detected
from kcs_torch.methods.pkc.body import Body
from kcs_torch.methods.pkc.hypotheses import Hypotheses
from kcs_torch.types import Tracks

__all__ = ["SEEMS_FAR", "SEEMS_NEAR", "Asked", "Question"]

SEEMS_NEAR = "the camera seems near: runs of signs are left to full perspective"
"""What is noted of a search that ended early, as the camera seems near."""

SEEMS_FAR = "the camera seems far"
"""What is noted where nobody needs to look for a near camera any more."""

Question = Callable[[Tracks, Tensor, Tensor, float, Tensor | None], str]
"""What is to be noted of how near a camera seems, by tracks of a body with a template, their image (T, N, 2) without
noise, depths (T, N) for a body of 1.75, the unit of such a body in the tracks, and known cameras (T, 2, 3) or None."""


class Asked:
    """A question about a clip that is answered by hypotheses of some of its frames.

    Args:
        question: that is asked.
        tracks: of the clip.
        points: (T, N, 2) their image without noise.
        cameras: (T, 2, 3) that are known, or None.
        body: in whose units hypotheses are.

    Attributes:
        told: the answer, "" so far.
    """

    def __init__(self, question: Question, tracks: Tracks, points: Tensor, cameras: Tensor | None, body: Body) -> None:
        self.question, self.points, self.cameras, self.body = question, points, cameras, body
        self.tracks, self.told = replace(tracks, detector=detected(tracks)), ""

    def __call__(self, frames: slice, found: Hypotheses) -> bool:
        """Whether it seems near by the best hypothesis of some frames."""
        tracks, usual = self.tracks, self.body.objective.posture.rest_lengths
        size = float((found.lengths[0] / usual).median())
        if not 0 < size < math.inf:
            return False
        fps = None if tracks.fps is None else tracks.fps / (frames.step or 1)
        some = replace(tracks, points=tracks.points[frames], weights=tracks.weights[frames], fps=fps)
        cameras = None if self.cameras is None else self.cameras[frames]
        unit = size / float(self.body.factor)
        self.told = self.question(some, self.points[frames], found.depth[0] / size, unit, cameras)
        return self.told == SEEMS_NEAR
