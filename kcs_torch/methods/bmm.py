"""BMM: block matrix method, "prior-free" non-rigid structure from motion (Dai, Li, He, CVPR 2012 and IJCV 2014)."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar

from torch import Tensor

from kcs_torch.functional.camera import back_project, project
from kcs_torch.functional.spectral import spectral_norm, svt
from kcs_torch.methods.factorised import SETTLED, Factorised, camera_rows
from kcs_torch.nn.steps import continuation
from kcs_torch.solvers.iterate import Solution, iterate, relative_change

__all__ = ["BMM"]


@dataclass(frozen=True)
class BMM(Factorised):
    """Low rank alone: cameras from the null space of the constraints, shapes of least nuclear norm.

    Cameras: F = Q Q^T of least trace in the null space of the orthonormality constraints, refined by least squares.
    Shapes: with S# the T x 3N matrix that has a frame's points in a row, min_S mu |S#|_* + 1/2 |W - R S|^2 for a mu
    that falls towards 0, from the pseudo-inverse R^T W, by proximal gradient steps. The skeleton is not looked at.

    Args:
        rank: K of the cameras' factorisation, at most; the shapes need none.
        num_steps: shrinkage steps; mu falls with each.
        mu: first weight of the nuclear norm, a share of the data's largest singular value.
        final: last weight.
        momentum: share of the last change that the next step starts ahead by.

    Raises:
        OptionError: a value is out of range.
    """

    name: ClassVar[str] = "bmm"
    together: ClassVar[bool] = True
    rank: int = 12
    num_steps: int = 100
    mu: float = 0.5
    final: float = 1e-5
    momentum: float = 0.8

    def __post_init__(self) -> None:
        super().__post_init__()
        self._expect(self.rank >= 1, "rank", "K >= 1")
        self._expect(self.num_steps >= 1, "num_steps", "at least 1")
        self._expect(0 < self.mu < math.inf, "mu", "a positive number")
        self._expect(0 < self.final <= self.mu, "final", f"a positive number up to mu = {self.mu}")
        self._expect(0 <= self.momentum < 1, "momentum", "a share within [0, 1)")

    def find_cameras(self, tracks: Tensor) -> Tensor:
        """The paper's constraints leave each frame its scale."""
        return camera_rows(tracks, self.rank, evenness=0.0)

    def find_shape(self, tracks: Tensor, weights: Tensor, cameras: Tensor) -> Solution[Tensor]:
        """Nuclear norm by proximal gradient with continuation (Ma, Goldfarb, Chen 2011)."""
        share = weights[..., None]
        start = back_project(tracks, cameras)
        size = spectral_norm(start.flatten(-2))
        levels = continuation(self.num_steps, self.mu, self.final)

        def step(state: tuple[Tensor, Tensor], k: int) -> tuple[Tensor, Tensor]:
            shape, before = state
            ahead = shape + self.momentum * (shape - before)
            gradient = back_project(share * (project(ahead, cameras) - tracks), cameras)
            shrunk = svt((ahead - gradient).flatten(-2), levels[k] * size)
            return shrunk.unflatten(-1, ahead.shape[-2:]), shape

        shape, before = iterate(step, (start, start), num_steps=self.num_steps).value
        change = relative_change(before.flatten(-2), shape.flatten(-2))
        return Solution(shape, bool((change <= SETTLED).all()), self.num_steps, change=change)
