"""The method: a start of low rank, the fit, and its posterior mean."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import ClassVar

import torch
from torch import Tensor

from kcs_torch.functional.camera import complete_rotation
from kcs_torch.functional.weights import of_largest
from kcs_torch.methods.base import Estimate, Method
from kcs_torch.methods.clips.batches import in_batches, padded
from kcs_torch.methods.clips.unseen import place_unseen
from kcs_torch.methods.pnd.distribution import ProcrusteanNormal
from kcs_torch.methods.pnd.fit import fit_procrustean_normal
from kcs_torch.methods.sfam import SfAM
from kcs_torch.types import Tracks

__all__ = ["PND"]

FEWEST = 3
"""Seen joints without which a frame says nothing of its rotation: its start is then taken for seen."""

SETTLED = 5e-3
"""Share of the shapes that the last step may change them by."""

NUMBERS, GPU_NUMBERS = 2**20, 2**25
"""Numbers in the covariances of the clips that are fitted together, at most."""


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
    differentiates: ClassVar[bool] = False
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
        return self._solve([tracks], cameras)[0]

    def solve_all(self, tracks: Sequence[Tracks]) -> list[Estimate]:
        """Solve clips in which equally many joints are seen as one batch, padded to one length."""
        return in_batches(tracks, lambda clips: self._solve(clips, None), lambda one: int(one.seen.any(0).sum()))

    def _solve(self, clips: Sequence[Tracks], cameras: Tensor | None) -> list[Estimate]:
        """Clips of one skeleton with equally many joints seen; known cameras (T, 2, 3) are those of a single clip."""
        given = clips[0].points
        if given.device.type != "mps":  # what the noise leaves of a covariance is small beside the shapes
            clips = [replace(one, points=one.points.double(), weights=one.weights.double()) for one in clips]
        clips = [replace(one, weights=of_largest(one.weights)) for one in clips]
        start = SfAM(beta=0.0, camera_path="free")
        if cameras is None:
            found = start.solve_all(clips)
        else:
            found = [start.solve(clips[0], cameras.to(clips[0].points))]
        found = [replace(one, converged=True, iterations=1) for one in found]
        parts = [_seen_part(one, first.points) for one, first in zip(clips, found, strict=True)]
        bodies = [i for i, (_, _, local) in enumerate(parts) if _is_body(local)]
        most = max(1, (NUMBERS if given.device.type == "cpu" else GPU_NUMBERS) // (3 * clips[0].num_joints) ** 2)
        for some in (bodies[i : i + most] for i in range(0, len(bodies), most)):
            fitted = self._fit([parts[i] for i in some], [found[i].cameras for i in some])
            for i, (shapes, rows, settled) in zip(some, fitted, strict=True):
                points = found[i].points.clone()
                points[:, clips[i].seen.any(0)] = shapes
                found[i] = replace(found[i], points=points, cameras=rows, converged=settled, iterations=self.num_steps)
        shown = [one.cameras.to(given) for one in found] if cameras is None else [cameras]
        return [
            replace(
                x,
                points=place_unseen(x.points, one.seen.any(0), one.skeleton).to(given),
                cameras=rows,
                scales=x.scales.to(given),
            )
            for one, x, rows in zip(clips, found, shown, strict=True)
        ]

    def _fit(
        self, parts: Sequence[tuple[Tensor, Tensor, Tensor]], cameras: Sequence[Tensor]
    ) -> list[tuple[Tensor, Tensor, bool]]:
        """Shapes (T, N, 3) and camera rows of clips, and whether they settled, from what :func:`_seen_part` tells."""
        image, weights, local = (padded(x) for x in zip(*parts, strict=True))
        inside, frames = (weights > 0).any(-1), [len(x) for x in cameras]
        first = ProcrusteanNormal.of_shapes(
            local, complete_rotation(padded(cameras)), spread=self.spread, inside=inside
        )
        fitted, _, change = fit_procrustean_normal(
            image, weights, first, num_steps=self.num_steps, noise=self.noise, final=self.final, fall=self.fall
        )
        found = zip(fitted.shapes(), fitted.rotations, (change <= SETTLED).tolist(), frames, strict=True)
        return [(shapes[:n], turn[:n, :2], settled) for shapes, turn, settled, n in found]


def _seen_part(tracks: Tracks, start: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Tracks, weights and start (T, N, 3), centred, of the joints that are seen at all."""
    known = tracks.seen.any(0)
    local = start[:, known] - start[:, known].mean(1, keepdim=True)
    seen = tracks.seen[:, known]
    thin = seen.sum(1, keepdim=True) < FEWEST
    weights = torch.where(thin, torch.ones_like(local[..., 0]), tracks.weights[:, known])
    image = torch.where((seen & ~thin)[..., None], tracks.points[:, known], local[..., :2])
    return image, weights, local


def _is_body(local: Tensor) -> bool:
    """Whether there is something to fit in shapes (T, N, 3)."""
    return local.shape[1] > 3 and bool(local.isfinite().all()) and bool(local.square().sum() > 0)
