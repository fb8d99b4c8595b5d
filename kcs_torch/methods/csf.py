"""CSF: column space fitting (Gotardo, Martinez, PAMI 2011)."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from kcs_torch.functional.spectral import dct_basis, singular_values
from kcs_torch.methods.factorised import Factorised, camera_rows, fit_basis_shapes, trajectory_design
from kcs_torch.solvers.iterate import Solution, iterate

__all__ = ["CSF"]

FAINT = 2e-4
"""Singular values of the tracks below this share of the largest do not count for their rank."""

RIDGE = 1e-9
"""Of the shapes' normal matrix, a share of its mean diagonal: before a camera that stands still it is singular."""

MOST = 128
"""Cosines, at most: a Gauss-Newton step solves a system of as many times K unknowns."""


@dataclass(frozen=True)
class CSF(Factorised):
    """Few basis shapes whose weights over time are smooth: the weights are fitted, the shapes follow.

    A frame's points are sum_k c_tk S_k, the weights C = Omega X a combination of d cosines Omega (T x d). The motion
    matrix is M(X) = D (Omega X x I_3), with the cameras in D, and what X explains is the column space of M: minimised
    is f(X) = 1/2 |W - M M^+ W|^2 by damped Gauss-Newton, from the first K cosines, which are PTA's solution. The
    skeleton is not looked at.

    Args:
        rank: K basis shapes; at most a fifth of the joints, as 3K columns explain the tracks of as many joints anyway,
            no more than a third of the tracks' rank, and 128.
        cosines: d, the share of the number of frames.
        num_steps: Gauss-Newton steps, at most.
        tolerance: stop where steps lower the cost by less than this share.
        cutoff: singular values of the motion matrix below this share of the largest are dropped, at the end.
        camera_rank: K of the cameras' factorisation, at most.

    Raises:
        OptionError: a value is out of range.
    """

    name: ClassVar[str] = "csf"
    rank: int = 7
    cosines: float = 0.1
    num_steps: int = 200
    tolerance: float = 1e-4
    cutoff: float = 0.2
    camera_rank: int = 12

    def __post_init__(self) -> None:
        super().__post_init__()
        self._expect(self.rank >= 1, "rank", "K >= 1")
        self._expect(0 < self.cosines <= 1, "cosines", "a share within (0, 1]")
        self._expect(self.num_steps >= 1, "num_steps", "at least 1")
        self._expect(self.tolerance >= 0, "tolerance", "a number >= 0")
        self._expect(0 <= self.cutoff < 1, "cutoff", "a share within [0, 1)")
        self._expect(self.camera_rank >= 1, "camera_rank", "at least 1")

    def find_cameras(self, tracks: Tensor) -> Tensor:
        """Rows (T, 2, 3), found as PTA finds them."""
        return camera_rows(tracks, self.camera_rank)

    def find_shape(self, tracks: Tensor, weights: Tensor, cameras: Tensor) -> Solution[Tensor]:
        """Weights of the shapes by Gauss-Newton, then the shapes by least squares."""
        frames, joints = tracks.shape[:2]
        size = singular_values(tracks.mT.flatten(0, 1))
        told = int((size > FAINT * size[0]).sum())  # a stiff body has one shape: weights of others would be arbitrary
        rank = max(1, min(self.rank, frames, (joints - 1) // 5, math.ceil(told / 3), MOST))
        count = min(max(round(self.cosines * frames), rank), MOST, frames)
        basis = dct_basis(frames, count, dtype=tracks.dtype, device=tracks.device)
        fitted = fit_column_space(
            trajectory_design(cameras, basis),
            tracks.mT.flatten(0, 1),
            rank,
            num_steps=self.num_steps,
            tolerance=self.tolerance,
        )
        over_time = basis @ fitted.value
        shapes = fit_basis_shapes(tracks, weights, cameras, over_time, cutoff=self.cutoff)
        return Solution(torch.einsum("tk,knj->tnj", over_time, shapes), fitted.converged, fitted.iterations)


def fit_column_space(
    design: Tensor, tracks: Tensor, rank: int, *, num_steps: int = 200, tolerance: float = 1e-4
) -> Solution[Tensor]:
    """Return X (d, K) of min_X |W - M M^+ W|^2, M = design (X x I_3), by Levenberg-Marquardt on variable projection.

    With A = design^T design, B = design^T W, S = M^+ W and P the projection off the columns of M, Kaufman's
    Gauss-Newton matrix and gradient are those of the residual P (design (dX x I_3) S):

        H[(a,k),(b,l)] = sum_ij (design^T P design)[(a,i),(b,j)] (S S^T)[(k,i),(l,j)],
        g[(a,k)] = sum_in (B - A (X x I_3) S)[(a,i),n] S[(k,i),n],

    so that nothing in a step is as long as the clip: its 2T rows enter by A and B alone.

    Args:
        design: (2T, 3d), from :func:`kcs_torch.methods.factorised.trajectory_design`.
        tracks: W (2T, N).
        rank: K, at most d.
        num_steps: steps, at most; each is kept only where it lowers the cost.
        tolerance: stop where steps lower the cost by less than this share.

    Returns:
        X with orthonormal columns.
    """
    gram, goal, energy = design.mT @ design, design.mT @ tracks, tracks.square().sum()
    count = design.shape[1] // 3
    three = torch.eye(3, dtype=design.dtype, device=design.device)
    tiny = torch.finfo(design.dtype).tiny
    ridge = RIDGE * gram.diagonal().mean() + tiny
    state = tuple[Tensor, ...]

    def evaluate(x: Tensor) -> state:
        """X, cost, shapes S (3K, N), design^T M, and the factor of M^T M."""
        wide = torch.einsum("ak,ij->aikj", x, three).reshape(3 * count, 3 * rank)
        across, seen = gram @ wide, wide.mT @ goal
        square = wide.mT @ across
        factor, _ = torch.linalg.cholesky_ex(square + ridge * torch.eye(3 * rank).to(square))
        shapes = torch.cholesky_solve(seen, factor)
        return x, (energy - (shapes * seen).sum()).clamp_min(0), shapes, across, factor

    def step(now: tuple[state, Tensor, Tensor], _: int) -> tuple[state, Tensor, Tensor]:
        (x, cost, shapes, across, factor), damping, progress = now
        left = (gram - across @ torch.cholesky_solve(across.mT, factor)).reshape(count, 3, count, 3)
        each = shapes.reshape(rank, 3, -1)
        pairs = torch.einsum("kin,ljn->kilj", each, each)
        hessian = torch.einsum("aibj,kilj->akbl", left, pairs).reshape(count * rank, count * rank)
        gradient = torch.einsum("ain,kin->ak", (goal - across @ shapes).reshape(count, 3, -1), each)
        size = hessian.diagonal().mean()
        hessian.diagonal().add_(damping * size + tiny)
        solver, _ = torch.linalg.cholesky_ex(hessian)
        move = torch.cholesky_solve(gradient.reshape(-1, 1), solver).reshape(count, rank)
        trial = evaluate(torch.linalg.qr(torch.where(move.isfinite(), x + move, x)).Q)
        better = bool(trial[1] < cost)  # False for NaN, too
        gain = 1 - trial[1] / cost if better else torch.zeros_like(cost)
        damping = (damping / 4 if better else damping * 4).clamp(1e-9, 1e9)
        return trial if better else now[0], damping, progress / 2 + gain  # halved, not zeroed, by a refused step

    begin = evaluate(torch.eye(count, rank, dtype=design.dtype, device=design.device))
    one = torch.ones((), dtype=design.dtype, device=design.device)
    found = iterate(
        step,
        (begin, 1e-3 * one, one),
        num_steps=num_steps,
        change=lambda _, new: new[2] * (new[0][1] > 1e-14 * energy),
        tolerance=tolerance,
    )
    return Solution(found.value[0][0], found.converged, found.iterations)
