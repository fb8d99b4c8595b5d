"""Rigid factorisation (Tomasi, Kanade, IJCV 1992)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from kcs_torch.methods.factorised import Factorised, camera_rows, fit_basis_shapes
from kcs_torch.solvers.iterate import Solution

__all__ = ["Rigid"]


@dataclass(frozen=True)
class Rigid(Factorised):
    """One rigid shape before orthographic cameras: the tracks have rank 3, and their rows are a rotation's.

    Tracks W (2T x N) = R S; W = M' S' by the SVD, and Q with orthonormal rows M'Q gives R = M'Q. The shape is the same
    in all frames, bones keep their lengths as a matter of course, and nothing moves but the viewpoint. The skeleton is
    not looked at.

    Args:
        num_steps: steps of the metric upgrade, at most.
        cutoff: directions that the cameras show by less than this share of the best are left flat.

    Raises:
        OptionError: a value is out of range.
    """

    name: ClassVar[str] = "rigid"
    num_steps: int = 150
    cutoff: float = 0.01

    def __post_init__(self) -> None:
        super().__post_init__()
        self._expect(self.num_steps >= 1, "num_steps", "at least 1")
        self._expect(0 <= self.cutoff < 1, "cutoff", "a share within [0, 1)")

    def find_cameras(self, tracks: Tensor) -> Tensor:
        """Rank 3, upgraded by a.a = b.b = 1, a.b = 0."""
        return camera_rows(tracks, 1, num_steps=self.num_steps)

    def find_shape(self, tracks: Tensor, weights: Tensor, cameras: Tensor) -> Solution[Tensor]:
        """The least-squares shape."""
        one = torch.ones_like(tracks[:, :1, 0])
        shape = fit_basis_shapes(tracks, weights, cameras, one, cutoff=self.cutoff)
        return Solution(shape.expand(len(tracks), -1, -1), True, 1)
