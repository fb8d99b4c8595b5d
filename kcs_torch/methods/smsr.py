"""SMSR: scalable dense monocular surface reconstruction (Ansari, Golyanik, Stricker, 3DV 2017)."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from kcs_torch.functional.camera import back_project, project
from kcs_torch.functional.spectral import dct_basis, spectral_norm
from kcs_torch.methods.factorised import SETTLED, Factorised, upgraded_rows
from kcs_torch.nn.steps import continuation
from kcs_torch.solvers.ist import ist, metric_upgrade
from kcs_torch.solvers.iterate import Solution, fpc, relative_change

__all__ = ["SMSR"]


@dataclass(frozen=True)
class SMSR(Factorised):
    """Cameras by iterative shrinkage, smooth trajectories by cosines, shapes of low rank by fixed-point continuation.

    Cameras: of the rank-3K motion space, F = Q Q^T of least trace with rows of equal length at right angles, by IST;
    Q is then refined by least squares, its scale even over time. Trajectories: the tracks are projected onto the first
    cosines over time. Shapes: min_S mu |S#|_* + 1/2 |W - R S|^2 by S <- shrink(S - tau R^T (R S - W), tau mu) for mu
    that falls towards 0, S# the T x 3N matrix that has a frame's points in a row. The skeleton's bones are not looked
    at: with them this is SfAM.

    Args:
        rank: K of the cameras' factorisation, at most; a third of the joints at most.
        cosines: share of the cosines over time that are kept; 1 keeps the tracks as they are.
        num_steps: shrinkage steps; mu falls with each.
        mu: first weight of the nuclear norm, a share of the data's largest singular value.
        final: last weight.
        tau: step size, below 2.

    Raises:
        OptionError: a value is out of range.
    """

    name: ClassVar[str] = "smsr"
    together: ClassVar[bool] = True
    rank: int = 13
    cosines: float = 0.5
    num_steps: int = 100
    mu: float = 0.5
    final: float = 1e-5
    tau: float = 1.0

    def __post_init__(self) -> None:
        super().__post_init__()
        self._expect(self.rank >= 1, "rank", "K >= 1")
        self._expect(0 < self.cosines <= 1, "cosines", "a share within (0, 1]")
        self._expect(self.num_steps >= 1, "num_steps", "at least 1")
        self._expect(0 < self.mu < math.inf, "mu", "a positive number")
        self._expect(0 < self.final <= self.mu, "final", f"a positive number up to mu = {self.mu}")
        self._expect(0 < self.tau < 2, "tau", "a number between 0 and 2")

    def find_cameras(self, tracks: Tensor) -> Tensor:
        """Factorisation, IST and least squares; the identity for clips with too few frames or joints to tell."""

        def upgrade(motion: Tensor) -> Tensor:
            return metric_upgrade(motion, ist(motion), evenness=1.0, tolerance=1e-6, together=1)[0]

        return upgraded_rows(tracks, self.rank, upgrade)

    def find_shape(self, tracks: Tensor, weights: Tensor, cameras: Tensor) -> Solution[Tensor]:
        """Smooth the trajectories, then continue from the back-projected tracks to low rank and a small residual."""
        frames, joints = tracks.shape[-3:-1]
        basis = dct_basis(frames, math.ceil(self.cosines * frames), dtype=tracks.dtype, device=tracks.device)
        smooth = torch.einsum("tk,sk,...snd->...tnd", basis, basis, tracks) if self.cosines < 1 else tracks

        def gradient(flat: Tensor) -> Tensor:
            residual = project(flat.unflatten(-1, (joints, 3)), cameras) - smooth
            return back_project(weights[..., None] * residual, cameras).flatten(-2)

        start = back_project(smooth, cameras).flatten(-2)
        size = spectral_norm(start)
        falling = torch.stack([mu * size for mu in continuation(self.num_steps, self.mu, self.final)])
        before = fpc(start, gradient, step=self.tau, weights=falling[:-1], steps_per_weight=1).value
        shape = fpc(before, gradient, step=self.tau, weights=falling[-1:], steps_per_weight=1).value
        change = relative_change(before, shape)
        shape = shape.unflatten(-1, (joints, 3))
        return Solution(shape, bool((change <= SETTLED).all()), self.num_steps, change=change)
