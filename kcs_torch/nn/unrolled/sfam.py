"""SfAM as a layer: :class:`kcs_torch.SfAM` runs it over its windows."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

from torch import Tensor

from kcs_torch.errors import OptionError
from kcs_torch.functional.align import centre
from kcs_torch.functional.precision import full_precision, narrow, wide
from kcs_torch.functional.weights import known
from kcs_torch.nn.masks import clear_padding
from kcs_torch.nn.steps import aimed_lengths, continuation, data_scale, shape_step, start_shape
from kcs_torch.nn.unrolled.base import Gradient, Unrolled, row_length
from kcs_torch.skeleton import Skeleton, get_skeleton
from kcs_torch.solvers.iterate import Solution

__all__ = ["UnrolledSfAM"]


class UnrolledSfAM(Unrolled):
    """``num_steps`` steps of SfAM: FPC with the articulated term in the last of them.

    Args:
        skeleton: a :class:`Skeleton`, a built-in name or a file.
        num_steps: steps; each has its own step size, threshold, corner and stiffness.
        mu: first threshold, a share of the data's largest singular value.
        final: last threshold.
        tau: step size of the articulated steps; the others take twice that. From (1 + momentum) / (1 + 2 momentum) on
            many steps diverge.
        momentum: as in :class:`UnrolledFPC`; few steps want less of it than the method's many.
        corner: as in :class:`UnrolledFPC`.
        beta: stiffness of the bones.
        articulate_from: share of the steps after which the articulated term joins; 0 is all of them, as printed.
        lengths: relative bone lengths, one per bone, brought to the scale of each clip; lengths estimated from the
            shape at every step if None.
        learnable: as in :class:`UnrolledFPC`.
        learnable_lengths: the relative lengths are parameters, too; they start from the skeleton's if none are given.
        grad_steps: as in :class:`UnrolledFPC`.
        gradient: as in :class:`UnrolledFPC`.

    Raises:
        OptionError: a number is out of range.
        SkeletonError: the skeleton is unknown, or has no lengths where they are to be learned.

    Kovalenko et al. 2019, Algorithm 1.
    """

    bones: Tensor
    raw_threshold: Tensor
    raw_step: Tensor
    raw_stiffness: Tensor

    def __init__(
        self,
        skeleton: str | Path | Skeleton,
        num_steps: int = 10,
        *,
        mu: float = 0.5,
        final: float = 1e-4,
        tau: float = 0.5,
        momentum: float = 0.8,
        corner: float = 0.05,
        beta: float = 1.5,
        articulate_from: float = 0.2,
        lengths: Sequence[float] | None = None,
        learnable: bool = True,
        learnable_lengths: bool = False,
        grad_steps: int | None = None,
        gradient: Gradient = "unrolled",
    ) -> None:
        super().__init__(
            num_steps, momentum=momentum, learnable=learnable, grad_steps=grad_steps, gradient=gradient,
            mu=mu, final=final, tau=tau, corner=corner, beta=beta, articulate_from=articulate_from,
        )  # fmt: skip
        if not (0 < tau < math.inf and beta > 0 and corner > 0) or not 0 <= articulate_from <= 1:
            raise OptionError(
                f"UnrolledSfAM: expected tau (finite), beta and corner > 0 and articulate_from in 0..1, got {tau}, "
                f"{beta}, {corner} and {articulate_from}"
            )
        self.skeleton = get_skeleton(skeleton)
        self.rigid = list(self.skeleton.rigid)
        self.register_buffer("bones", self.skeleton.bone_index()[self.rigid], persistent=False)
        self.first = round(articulate_from * num_steps) if self.rigid else num_steps
        self._hold_corner(corner)
        self._positive("threshold", continuation(num_steps, mu, final))
        self._positive("step", [2 * tau] * self.first + [tau] * (num_steps - self.first))
        self._positive("stiffness", [beta] * num_steps)
        self._hold_lengths(self.skeleton, lengths, learnable_lengths)

    def forward(
        self,
        tracks: Tensor,
        cameras: Tensor,
        *,
        weights: Tensor | None = None,
        start: Tensor | None = None,
        lengths: Tensor | None = None,
        inside: Tensor | None = None,
    ) -> Tensor:
        """Return the shape in the world frame of the cameras.

        Args:
            tracks: (..., T, N, 2), NaN where unseen.
            cameras: (..., T, 2, 3).
            weights: (..., T, N), 0 where unseen.
            start: (..., T, N, 3), about any origin; the back-projected tracks if None.
            lengths: (..., B) bone lengths in the unit of the tracks, instead of the module's.
            inside: (..., T), False in padding, as of :meth:`UnrolledFPC.forward`.

        Returns:
            (..., T, N, 3).

        Raises:
            ShapeError: the shapes do not fit.

        Warns:
            ConvergenceWarning: with the implicit gradient, in the backward pass.
        """
        return self.solve(
            tracks, cameras, weights=weights, start=start, lengths=lengths, inside=inside, measure=False
        ).value

    def solve(
        self,
        tracks: Tensor,
        cameras: Tensor,
        *,
        weights: Tensor | None = None,
        start: Tensor | None = None,
        lengths: Tensor | None = None,
        one_body: bool = False,
        inside: Tensor | None = None,
        held: list[tuple[Tensor, Tensor]] | None = None,
        corner: Tensor | None = None,
        measure: bool = True,
    ) -> Solution[Tensor]:
        """As :meth:`forward`, as a :class:`kcs_torch.solvers.Solution`.

        Args:
            tracks: as of :meth:`forward`.
            cameras: as of :meth:`forward`.
            weights: as of :meth:`forward`.
            start: as of :meth:`forward`.
            lengths: as of :meth:`forward`.
            one_body: the batch (..., W, T, N, 2) are windows of one body, which share their bone lengths; ``lengths``
                are then proportions (..., B), brought to the scale of the shape.
            inside: as of :meth:`forward`.
            held: an empty list is filled with the lengths and rigidity that each articulated step aimed at; a filled
                one is what other windows of the same body aimed at, and is aimed at again.
            corner: (...) share of the scale, in all steps instead of the module's; may be infinite.
            measure: tell whether the last step stood still, which waits for the device.

        Returns:
            The solution; ``change`` is that of the last step, (...).
        """
        relative = one_body or lengths is None
        weights = self._check(
            tracks, cameras, weights, start, self.skeleton, lengths=None if relative else lengths, inside=inside
        )
        given, tracks = tracks, wide(known(tracks, weights))
        cameras, weights = clear_padding(wide(cameras), inside), wide(weights)
        length = row_length(cameras, of_clip=True)
        tracks, cameras = tracks / length, cameras / length
        threshold, step = self._values("threshold", tracks), self._step_sizes(weights, cameras)
        stiffness = self._values("stiffness", tracks)
        if lengths is not None:
            lengths = lengths.to(tracks.dtype)
        elif self.has_lengths:
            lengths = self._lengths(tracks)
        aims = self._aims(weights, inside, lengths, relative, one_body, held)

        def advance(shape: Tensor, k: int) -> Tensor:
            goal: dict[str, Tensor] = {}
            if k >= self.first:
                target, rigidity = aims(shape, k - self.first)
                goal = {"bones": self.bones, "lengths": target, "stiffness": stiffness[k] * rigidity}
            return shape_step(shape, tracks, cameras, weights, threshold[k] * scale, step[k], corner=corners[k], **goal)

        with full_precision(tracks):
            scale = data_scale(tracks, cameras, weights)
            corners = self._corners(scale, corner)
            begin = start_shape(tracks, cameras, weights) if start is None else centre(start.to(tracks.dtype))[0]
            solution = self._run(
                advance,
                clear_padding(begin, inside),
                inner=begin.ndim if one_body else 3,
                measure=measure,
                depends_on=(tracks, cameras, weights, lengths),
            )
        return replace(solution, value=narrow(solution.value, given))

    def _aims(
        self,
        weights: Tensor,
        inside: Tensor | None,
        lengths: Tensor | None,
        relative: bool,
        one_body: bool,
        held: list[tuple[Tensor, Tensor]] | None,
    ) -> Callable[[Tensor, int], tuple[Tensor, Tensor]]:
        """What tells the rigid bones' lengths and rigidity that an articulated step of a shape aims at, by its number.

        Arguments are as of :meth:`solve`; ``lengths`` may be the module's own, and are proportions if ``relative``.
        """
        fixed = None if lengths is None else lengths[..., self.rigid]
        graded, earlier = not self.skeleton.tree, list(held or ())

        def measured(shape: Tensor) -> tuple[Tensor, Tensor]:
            share, real = weights, inside
            if one_body:  # all windows as one clip
                shape, share = shape.flatten(-4, -3), share.flatten(-3, -2)
                real = None if real is None else real.flatten(-2)
            return aimed_lengths(shape, self.bones, share, fixed, relative=relative, graded=graded, inside=real)

        def aims(shape: Tensor, number: int) -> tuple[Tensor, Tensor]:
            target, rigidity = earlier[number] if earlier else measured(shape)
            if held is not None and not earlier:
                held.append((target, rigidity))
            if one_body and target.ndim > 1:
                return target[..., None, :], rigidity[..., None, :]
            return target, rigidity

        return aims
