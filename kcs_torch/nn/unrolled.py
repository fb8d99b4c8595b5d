"""Unrolled solvers: a fixed number of steps of FPC and SfAM as layers, with learnable step sizes and weights.

Untrained they are the method: :class:`kcs_torch.SfAM` runs :class:`UnrolledSfAM` over its windows.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import torch
from torch import Tensor, nn

from kcs_torch.errors import OptionError, ShapeError
from kcs_torch.nn.energies import check_weights
from kcs_torch.nn.layers import full_precision, inverse_softplus, known
from kcs_torch.nn.steps import continuation, data_scale, estimate_lengths, shape_step, start_shape
from kcs_torch.skeleton import Skeleton, get_skeleton
from kcs_torch.solvers.iterate import Solution, iterate, relative_change

__all__ = ["UnrolledFPC", "UnrolledSfAM"]

SETTLED = 5e-3
"""A shape stands still where a step changes it by no more than this share."""


class UnrolledFPC(nn.Module):
    """``num_steps`` steps of fixed-point continuation from 2D tracks and cameras to 3D shape.

    Args:
        num_steps: steps; each has its own step size and threshold.
        mu: first threshold, a share of the data's largest singular value.
        final: last threshold; between them they fall geometrically.
        tau: step size.
        momentum: share of the last change that the next step starts ahead by.
        learnable: step sizes and thresholds are parameters (positive through a softplus); else constants.
        grad_steps: record only the last so many steps for autograd; None all.

    Raises:
        OptionError: a number is out of range.

    >>> cameras = torch.eye(3)[:2].expand(50, 2, 3)
    >>> UnrolledFPC(num_steps=5)(torch.randn(50, 17, 2), cameras).shape
    torch.Size([50, 17, 3])
    """

    raw_threshold: Tensor
    raw_step: Tensor

    def __init__(
        self,
        num_steps: int = 10,
        *,
        mu: float = 0.5,
        final: float = 1e-5,
        tau: float = 1.0,
        momentum: float = 0.8,
        learnable: bool = True,
        grad_steps: int | None = None,
    ) -> None:
        super().__init__()
        if num_steps < 1 or not tau > 0 or not 0 <= momentum < 1:
            raise OptionError(
                f"{type(self).__name__}: expected num_steps >= 1, tau > 0 and momentum within [0, 1), "
                f"got {num_steps}, {tau} and {momentum}"
            )
        self.num_steps, self.learnable, self.grad_steps, self.momentum = num_steps, learnable, grad_steps, momentum
        self._positive("threshold", continuation(num_steps, mu, final))
        self._positive("step", [tau] * num_steps)

    def forward(
        self, tracks: Tensor, cameras: Tensor, *, weights: Tensor | None = None, start: Tensor | None = None
    ) -> Tensor:
        """Return the shape in the world frame of the cameras.

        Args:
            tracks: (..., T, N, 2).
            cameras: (..., T, 2, 3).
            weights: (..., T, N), 0 where unseen.
            start: (..., T, N, 3), a network's output, say, in any precision; the back-projected tracks if None.

        Returns:
            (..., T, N, 3).

        Raises:
            ShapeError: the shapes do not fit.
        """
        return self.solve(tracks, cameras, weights=weights, start=start).value

    def solve(
        self, tracks: Tensor, cameras: Tensor, *, weights: Tensor | None = None, start: Tensor | None = None
    ) -> Solution[Tensor]:
        """As :meth:`forward`, as a :class:`kcs_torch.solvers.Solution` that tells whether the last step stood still."""
        self._check(tracks, cameras, weights, start)
        tracks = known(tracks, weights)
        threshold, step = self._values("threshold", tracks), self._values("step", tracks)
        with full_precision(tracks):
            scale = data_scale(tracks, cameras, weights)
            return self._run(
                lambda shape, k: shape_step(shape, tracks, cameras, weights, threshold[k] * scale, step[k]),
                start_shape(tracks, cameras, weights) if start is None else start.to(tracks.dtype),
            )

    def _run(self, step: Callable[[Tensor, int], Tensor], start: Tensor) -> Solution[Tensor]:
        """Make all steps, each from a point ahead of the last shape; the state is (shape, point ahead)."""

        def advance(state: tuple[Tensor, Tensor], k: int) -> tuple[Tensor, Tensor]:
            shape = step(state[1], k)
            return shape, shape + self.momentum * (shape - state[0])

        solution = iterate(
            advance,
            (start, start),
            num_steps=self.num_steps,
            change=lambda old, new: relative_change(old[0].flatten(-2), new[0].flatten(-2)),
            tolerance=SETTLED,
            check_every=self.num_steps,
            grad_steps=self.grad_steps,
        )
        return Solution(solution.value[0], solution.converged, solution.iterations)

    def _check(self, tracks: Tensor, cameras: Tensor, weights: Tensor | None, start: Tensor | None) -> None:
        if tracks.ndim < 3 or tracks.shape[-1] != 2 or cameras.shape[-3:] != (tracks.shape[-3], 2, 3):
            raise ShapeError(
                f"{type(self).__name__}: expected tracks (..., T, N, 2) and cameras (..., T, 2, 3), "
                f"got {tuple(tracks.shape)} and {tuple(cameras.shape)}"
            )
        if cameras.dtype != tracks.dtype or cameras.device != tracks.device:
            raise ShapeError(
                f"{type(self).__name__}: expected cameras of the tracks' dtype and device, got {cameras.dtype} on "
                f"{cameras.device} for {tracks.dtype} on {tracks.device}: use cameras.to(tracks)"
            )
        check_weights(weights, tracks, self)
        if start is not None and start.shape[-3:] != (*tracks.shape[-3:-1], 3):
            expected = f"(..., {tracks.shape[-3]}, {tracks.shape[-2]}, 3)"
            raise ShapeError(f"{type(self).__name__}: expected start {expected}, got {tuple(start.shape)}")

    def _positive(self, name: str, values: list[float]) -> None:
        """Hold positive numbers, in double precision until the module is cast, as softplus of what is learned."""
        raw = inverse_softplus(torch.tensor(values, dtype=torch.float64))
        if self.learnable:
            setattr(self, f"raw_{name}", nn.Parameter(raw))
        else:
            self.register_buffer(f"raw_{name}", raw)

    def _values(self, name: str, like: Tensor) -> Tensor:
        return nn.functional.softplus(getattr(self, f"raw_{name}")).to(like)


class UnrolledSfAM(UnrolledFPC):
    """``num_steps`` steps of SfAM: FPC with the articulated term in the last of them.

    Args:
        skeleton: a :class:`Skeleton`, a built-in name or a file.
        num_steps: steps; each has its own step size, threshold and stiffness.
        mu: first threshold, a share of the data's largest singular value.
        final: last threshold.
        tau: step size of the articulated steps, below 1; the others take twice that.
        momentum: as in :class:`UnrolledFPC`.
        beta: stiffness of the bones.
        articulate_from: share of the steps after which the articulated term joins; 0 is all of them, as printed.
        learnable: as in :class:`UnrolledFPC`.
        grad_steps: as in :class:`UnrolledFPC`.

    Raises:
        OptionError: a number is out of range.
        SkeletonError: the skeleton is unknown.

    Kovalenko et al. 2019, Algorithm 1.
    """

    bones: Tensor
    rigid: Tensor

    def __init__(
        self,
        skeleton: str | Path | Skeleton,
        num_steps: int = 10,
        *,
        mu: float = 0.5,
        final: float = 1e-5,
        tau: float = 0.5,
        momentum: float = 0.8,
        beta: float = 1.5,
        articulate_from: float = 0.6,
        learnable: bool = True,
        grad_steps: int | None = None,
    ) -> None:
        super().__init__(
            num_steps, mu=mu, final=final, tau=tau, momentum=momentum, learnable=learnable, grad_steps=grad_steps
        )
        if not beta > 0 or not 0 <= articulate_from <= 1:
            raise OptionError(
                f"UnrolledSfAM: expected beta > 0 and articulate_from in 0..1, got {beta} and {articulate_from}"
            )
        self.skeleton = get_skeleton(skeleton)
        rigid = list(self.skeleton.rigid)
        self.register_buffer("bones", self.skeleton.bone_index()[rigid], persistent=False)
        self.first = round(articulate_from * num_steps) if rigid else num_steps
        self._positive("step", [2 * tau] * self.first + [tau] * (num_steps - self.first))
        self._positive("stiffness", [beta] * num_steps)

    def forward(
        self,
        tracks: Tensor,
        cameras: Tensor,
        *,
        weights: Tensor | None = None,
        start: Tensor | None = None,
        lengths: Tensor | None = None,
    ) -> Tensor:
        """Return the shape in the world frame of the cameras.

        Args:
            tracks: (..., T, N, 2).
            cameras: (..., T, 2, 3).
            weights: (..., T, N), 0 where unseen.
            start: (..., T, N, 3); the back-projected tracks if None.
            lengths: (..., B) bone lengths in the unit of the tracks; estimated at every step if None.

        Returns:
            (..., T, N, 3).

        Raises:
            ShapeError: the shapes do not fit.
        """
        return self.solve(tracks, cameras, weights=weights, start=start, lengths=lengths).value

    def solve(
        self,
        tracks: Tensor,
        cameras: Tensor,
        *,
        weights: Tensor | None = None,
        start: Tensor | None = None,
        lengths: Tensor | None = None,
        one_body: bool = False,
    ) -> Solution[Tensor]:
        """As :meth:`forward`, with a :class:`kcs_torch.solvers.Solution` that tells whether the last step stood still.

        ``one_body`` takes the batch (W, T, N, ...) for windows of one body, which share their bone lengths;
        ``lengths`` are then proportions (B,), brought to the scale of the shape.
        """
        self._check(tracks, cameras, weights, start)
        tracks = known(tracks, weights)
        joints, count = self.skeleton.num_joints, self.skeleton.num_bones
        given = None if lengths is None else tuple(lengths.shape)
        if tracks.shape[-2] != joints or (given is not None and given[-1:] != (count,)):
            raise ShapeError(
                f"UnrolledSfAM: expected tracks (..., T, {joints}, 2) and lengths (..., {count}) for skeleton "
                f"'{self.skeleton.name}', got {tuple(tracks.shape)} and {given}"
            )
        threshold, step = self._values("threshold", tracks), self._values("step", tracks)
        stiffness = self._values("stiffness", tracks)
        fixed = None if lengths is None else lengths[..., list(self.skeleton.rigid)]
        pooled = weights.flatten(0, 1) if weights is not None and one_body else weights
        graded = not self.skeleton.tree

        def advance(shape: Tensor, k: int) -> Tensor:
            if k < self.first:
                return shape_step(shape, tracks, cameras, weights, threshold[k] * scale, step[k])
            target, rigidity = estimate_lengths(
                shape.flatten(0, 1) if one_body else shape, self.bones, pooled, graded=graded
            )
            if fixed is not None:
                target = fixed * (target / fixed).median(-1, keepdim=True).values if one_body else fixed
            return shape_step(
                shape, tracks, cameras, weights, threshold[k] * scale, step[k],
                bones=self.bones, lengths=target, stiffness=stiffness[k] * rigidity,
            )  # fmt: skip

        with full_precision(tracks):
            scale = data_scale(tracks, cameras, weights)
            return self._run(
                advance, start_shape(tracks, cameras, weights) if start is None else start.to(tracks.dtype)
            )
