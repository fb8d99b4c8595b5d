"""Fixed-point continuation as a layer."""

from __future__ import annotations

import math
from dataclasses import replace

from torch import Tensor

from kcs_torch.errors import OptionError
from kcs_torch.functional.align import centre
from kcs_torch.functional.precision import full_precision, narrow, wide
from kcs_torch.functional.weights import known
from kcs_torch.nn.masks import clear_padding
from kcs_torch.nn.steps import continuation, data_scale, shape_step, start_shape
from kcs_torch.nn.unrolled.base import Gradient, Unrolled, row_length
from kcs_torch.solvers.iterate import Solution

__all__ = ["UnrolledFPC"]


class UnrolledFPC(Unrolled):
    """``num_steps`` steps of fixed-point continuation from 2D tracks and cameras to 3D shape.

    Args:
        num_steps: steps; each has its own step size, threshold and corner.
        mu: first threshold, a share of the data's largest singular value.
        final: last threshold; between them they fall geometrically.
        tau: step size.
        momentum: share of the last change that the next step starts ahead by.
        corner: singular values well above this share of the data's largest are hardly shrunk, of
            :func:`kcs_torch.functional.svt`; infinite is the plain nuclear norm, in all steps and for good.
        learnable: step sizes, thresholds and finite corners are parameters (positive through a softplus); else
            constants.
        grad_steps: record only the last so many steps for autograd; None all.
        gradient: "unrolled", or "implicit": go on with the last step until the shape stands still, and differentiate
            that fixed point, in the memory of one step; an :class:`kcs_torch.solvers.Implicit` sets tolerances.

    Raises:
        OptionError: a number is out of range.

    >>> import torch
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
        corner: float = math.inf,
        learnable: bool = True,
        grad_steps: int | None = None,
        gradient: Gradient = "unrolled",
    ) -> None:
        super().__init__(
            num_steps, momentum=momentum, learnable=learnable, grad_steps=grad_steps, gradient=gradient,
            mu=mu, final=final, tau=tau, corner=corner,
        )  # fmt: skip
        if not (0 < tau < math.inf and corner > 0):
            raise OptionError(f"{type(self).__name__}: expected finite tau > 0 and corner > 0, got {tau} and {corner}")
        self._hold_corner(corner)
        self._positive("threshold", continuation(num_steps, mu, final))
        self._positive("step", [tau] * num_steps)

    def forward(
        self,
        tracks: Tensor,
        cameras: Tensor,
        *,
        weights: Tensor | None = None,
        start: Tensor | None = None,
        inside: Tensor | None = None,
    ) -> Tensor:
        """Return the shape in the world frame of the cameras.

        Args:
            tracks: (..., T, N, 2), NaN where unseen.
            cameras: (..., T, 2, 3).
            weights: (..., T, N), 0 where unseen.
            start: (..., T, N, 3), a network's output, say, in any precision and about any origin, as each frame is
                centred; the back-projected tracks if None.
            inside: (..., T), False in frames that pad a shorter clip; None where all are real. A clip is solved as if
                it stood alone, and its padding is 0, whatever the other arguments have there.

        Returns:
            (..., T, N, 3).

        Raises:
            ShapeError: the shapes do not fit.

        Warns:
            ConvergenceWarning: with the implicit gradient, in the backward pass.
        """
        return self.solve(tracks, cameras, weights=weights, start=start, inside=inside, measure=False).value

    def solve(
        self,
        tracks: Tensor,
        cameras: Tensor,
        *,
        weights: Tensor | None = None,
        start: Tensor | None = None,
        inside: Tensor | None = None,
        measure: bool = True,
    ) -> Solution[Tensor]:
        """As :meth:`forward`, as a :class:`kcs_torch.solvers.Solution`.

        With ``measure`` it tells whether the last step stood still, which waits for the device.
        """
        weights = self._check(tracks, cameras, weights, start, inside=inside)
        given, tracks = tracks, wide(known(tracks, weights))
        cameras, weights = clear_padding(wide(cameras), inside), wide(weights)
        length = row_length(cameras, of_clip=True)
        tracks, cameras = tracks / length, cameras / length
        threshold, step = self._values("threshold", tracks), self._step_sizes(weights, cameras)
        with full_precision(tracks):
            scale = data_scale(tracks, cameras, weights)
            corners = self._corners(scale)

            def advance(shape: Tensor, k: int) -> Tensor:
                return shape_step(shape, tracks, cameras, weights, threshold[k] * scale, step[k], corner=corners[k])

            begin = start_shape(tracks, cameras, weights) if start is None else centre(start.to(tracks.dtype))[0]
            solution = self._run(
                advance,
                clear_padding(begin, inside),
                measure=measure,
                depends_on=(tracks, cameras, weights),
            )
        return replace(solution, value=narrow(solution.value, given))
