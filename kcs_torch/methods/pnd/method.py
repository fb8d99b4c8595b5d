"""The method: a start of low rank, the fit, and its posterior mean."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import ClassVar

import torch
from torch import Tensor

from kcs_torch.functional.camera import complete_rotation
from kcs_torch.methods.base import Estimate, Method
from kcs_torch.methods.pnd.distribution import ProcrusteanNormal
from kcs_torch.methods.pnd.fit import fit_procrustean_normal
from kcs_torch.methods.sfam import SfAM
from kcs_torch.methods.unseen import place_unseen
from kcs_torch.types import Tracks

__all__ = ["PND"]

FEWEST = 3
"""Seen joints without which a frame says nothing of its rotation: its start is then taken for seen."""

SETTLED = 5e-3
"""Share of the shapes that the last step may change them by."""


@dataclass(frozen=True)
class PND(Method):
    """Shapes without their rigid motion follow one Gaussian; depth, rotations and scales are fitted to the tracks.

    With Y_t = X_t R_t / c_t the shapes, turned and scaled onto their mean M as generalised Procrustes analysis does,
    vec(Y_t) ~ N(vec M, S), where S has no variance in the directions in which M moves, turns or grows: nothing rigid
    is taken for deformation. The tracks are c_t Y_t R_t^T without depth, and noise. EM finds S, M, the noise and, by
    Gauss-Newton on the likelihood of each frame, R_t and c_t; it starts from shapes of low rank (:class:`SfAM` without
    bones). Unseen joints are unknowns of the E-step. No rank is chosen, no smoothness assumed, and bones are not
    looked at.

    Args:
        num_steps: EM steps.
        noise: first variance of the noise, a share of that of the deformation.
        final: variance of the noise, a share of that of the tracks, that it does not fall below.
        fall: factor by which it falls in a step, at most; falling slowly it keeps the fit from the nearest optimum.
        spread: variance that is added to the start's in every direction, a share of their mean.

    Raises:
        OptionError: a value is out of range.
    """

    name: ClassVar[str] = "pnd"
    keeps_lengths: ClassVar[bool] = False
    knows_bones: ClassVar[bool] = False
    num_steps: int = 50
    noise: float = 0.015
    final: float = 1e-6
    fall: float = 0.88
    spread: float = 3e-3

    def __post_init__(self) -> None:
        super().__post_init__()
        self._expect(self.num_steps >= 1, "num_steps", "at least 1")
        self._expect(0 < self.noise < math.inf, "noise", "a positive number")
        self._expect(0 < self.final < 1, "final", "a number between 0 and 1")
        self._expect(0 < self.fall < 1, "fall", "a number between 0 and 1")
        self._expect(0 <= self.spread < math.inf, "spread", "a number >= 0")

    def solve(self, tracks: Tracks, cameras: Tensor | None) -> Estimate:
        """Start from low rank, fit, and take the posterior mean of the shapes."""
        given = tracks.points
        if given.device.type != "mps":  # what the noise leaves of a covariance is small beside the shapes
            tracks = replace(tracks, points=given.double(), weights=tracks.weights.double())
        known = tracks.seen.any(0)
        start = SfAM(beta=0.0, camera_path="free").solve(tracks, None if cameras is None else cameras.to(tracks.points))
        points, rows, settled, steps = start.points, start.cameras, True, 1
        local = points[:, known] - points[:, known].mean(1, keepdim=True)
        if local.shape[1] > 3 and bool(local.isfinite().all()) and bool(local.square().sum() > 0):
            seen = tracks.seen[:, known]
            thin = seen.sum(1, keepdim=True) < FEWEST
            weights = torch.where(thin, torch.ones_like(local[..., 0]), tracks.weights[:, known])
            image = torch.where((seen & ~thin)[..., None], tracks.points[:, known], local[..., :2])
            first = ProcrusteanNormal.of_shapes(local, complete_rotation(rows), spread=self.spread)
            fitted, _, change = fit_procrustean_normal(
                image, weights, first, num_steps=self.num_steps, noise=self.noise, final=self.final, fall=self.fall
            )
            points = points.clone()
            points[:, known] = fitted.shapes()
            rows, settled, steps = fitted.rotations[:, :2], change <= SETTLED, self.num_steps
        points = place_unseen(points, known, tracks.skeleton).to(given)
        one = torch.ones_like(points[:, 0, 0])
        return Estimate(points, rows.to(given) if cameras is None else cameras, one, settled, steps)
