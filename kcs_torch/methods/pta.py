"""PTA: point trajectory approach (Akhter, Sheikh, Khan, Kanade, NIPS 2008 and PAMI 2011)."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar, Literal

import torch
from torch import Tensor

from kcs_torch.functional.spectral import dct_basis
from kcs_torch.methods.factorised import Factorised, camera_rows, fit_basis_shapes, trajectory_design
from kcs_torch.solvers.iterate import Solution

__all__ = ["PTA"]

ROUNDING = 1e-13
"""Share of the tracks' energy that no fit explains."""

FREE = 0.1
"""Share of the measurements that must be left over for cross-validation to tell anything."""


@dataclass(frozen=True)
class PTA(Factorised):
    """Joints follow few cosines of time: linear in what is unknown, once the cameras are found.

    Every coordinate of every joint is a combination of K cosines theta (T x K), so W = R (theta x I_3) A. The columns
    of the motion matrix that go with the constant cosine are the rotations themselves: the metric upgrade seeks the
    3K x 3 matrix Q whose M'Q has orthonormal rows. With the cameras known A follows by least squares. The skeleton is
    not looked at.

    Args:
        rank: K cosines, or "auto": as few as explain the tracks to ``tolerance``.
        tolerance: root mean square reprojection error to reach, a share of the tracks' root mean square.
        most: cosines to try, at most.
        cutoff: singular values of the motion matrix below this share of the largest are dropped: where cosines are as
            quick as the camera's turn, the tracks do not tell one from the other.
        camera_rank: K of the cameras' factorisation, at most.

    Raises:
        OptionError: a value is out of range.
    """

    name: ClassVar[str] = "pta"
    rank: int | Literal["auto"] = "auto"
    tolerance: float = 0.015
    most: int = 100
    cutoff: float = 0.2
    camera_rank: int = 12

    def __post_init__(self) -> None:
        super().__post_init__()
        self._expect(isinstance(self.rank, str) or self.rank >= 1, "rank", "'auto' or K >= 1")
        self._expect(0 < self.tolerance < math.inf, "tolerance", "a positive number")
        self._expect(self.most >= 1, "most", "at least 1")
        self._expect(0 <= self.cutoff < 1, "cutoff", "a share within [0, 1)")
        self._expect(self.camera_rank >= 1, "camera_rank", "at least 1")

    def find_cameras(self, tracks: Tensor) -> Tensor:
        """Metric upgrade from 3K columns to 3."""
        return camera_rows(tracks, self.camera_rank)

    def find_shape(self, tracks: Tensor, weights: Tensor, cameras: Tensor) -> Solution[Tensor]:
        """Coefficients of the cosines by least squares."""
        frames = len(tracks)
        rank = self._rank(tracks, cameras) if isinstance(self.rank, str) else min(self.rank, frames)
        cosines = dct_basis(frames, rank, dtype=tracks.dtype, device=tracks.device)
        shapes = fit_basis_shapes(tracks, weights, cameras, cosines, cutoff=self.cutoff)
        return Solution(torch.einsum("tk,knj->tnj", cosines, shapes), True, 1)

    def _rank(self, tracks: Tensor, cameras: Tensor) -> int:
        """The least K that explains the tracks to the tolerance; where none does, that of least cross-validation.

        Designs of fewer cosines are the first columns of those of more, so one normal matrix serves all. With e the
        squared error of a fit by p of 2T unknowns a joint, cross-validation (generalised) is e / (1 - p / 2T)^2.
        """
        frames = len(tracks)
        most = min(self.most, frames)
        cosines = dct_basis(frames, most, dtype=tracks.dtype, device=tracks.device)
        design = trajectory_design(cameras, cosines)
        normal, goal = design.mT @ design, design.mT @ tracks.mT.flatten(0, 1)
        energy, tolerance = tracks.square().sum(), float(self.tolerance)  # squares of whole numbers have no bound
        errors = {}
        rank = 1
        while rank <= most:
            value, vector = torch.linalg.eigh(normal[: 3 * rank, : 3 * rank])
            kept = (value > self.cutoff**2 * value[-1]) & (value > 0)
            told = (vector.mT @ goal[: 3 * rank]).square().sum(-1) / torch.where(kept, value, torch.ones_like(value))
            error = energy - (told * kept).sum()
            if bool(error <= max(tolerance * tolerance, ROUNDING) * energy):
                return rank
            free = 1 - int(kept.sum()) / (2 * frames)
            if free < FREE:
                break
            errors[rank] = float(error) / free**2
            rank += max(1, rank // 8)
        return min(errors, key=lambda k: errors[k], default=1)
