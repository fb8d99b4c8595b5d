"""What all unrolled solvers share: positive parameters, the loop over steps, and how it is differentiated."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from numbers import Integral, Real
from typing import Any, Literal

import torch
from torch import Tensor, nn

from kcs_torch.errors import OptionError, ShapeError, SkeletonError
from kcs_torch.functional.guarded import or_one
from kcs_torch.functional.shapes import fit_together
from kcs_torch.functional.weights import seen_weights
from kcs_torch.nn.checks import check_beside, check_inside, check_joints, check_points, check_tensor, check_weights
from kcs_torch.nn.layers import inverse_softplus
from kcs_torch.nn.masks import clear_padding
from kcs_torch.nn.steps import corner_of
from kcs_torch.skeleton import Skeleton
from kcs_torch.solvers.implicit import Implicit, fixed_point
from kcs_torch.solvers.iterate import Solution, iterate, relative_change

__all__ = ["Gradient", "Unrolled", "row_length"]

Gradient = Literal["unrolled", "implicit"] | Implicit
"""How an unrolled solver is differentiated."""

SETTLED = 5e-3
"""A shape stands still where a step changes it by no more than this share."""

SHARPEST = 1e-6
"""Least corner that a step may learn: at 0 nothing would be shrunk but what is 0."""

STEEP = 1.01
"""Weights times squared rows of cameras up to this are 1 but for rounding."""

UNIT = 8
"""Lengths of rows that differ from 1 by fewer rounding errors than this are 1."""

SHORTEST = 1e-6
"""Least relative length that a bone may learn: measured lengths are divided by it."""


def row_length(cameras: Tensor, *, of_clip: bool) -> Tensor:
    """Root mean square length of rows of cameras (..., T, 2, 3), what tracks and cameras are divided by.

    Returns:
        That of each clip, (..., 1, 1, 1), or else of each frame, (..., T, 1, 1). Cameras of 0, as of padding, do not
        count: they have the clip's length. Where there are no others it is 1; so it is, exactly, where it is 1 but for
        rounding.
    """
    square = cameras.square().sum((-2, -1), keepdim=True) / 2
    usual = square.sum(-3, keepdim=True) / (square > 0).sum(-3, keepdim=True).clamp_min(1)
    length = or_one(usual if of_clip else torch.where(square > 0, square, usual)).sqrt()
    near = (length - 1).abs() < UNIT * torch.finfo(length.dtype).eps
    return torch.where(near, 1 + (length - length.detach()), length)


class Unrolled(nn.Module):
    """Base of the unrolled solvers: ``num_steps`` steps, each with parameters of its own.

    Args:
        num_steps: steps.
        momentum: share of the last change that the next step starts ahead by.
        learnable: what belongs to a step is a parameter (positive through a softplus); else a constant.
        grad_steps: record only the last so many steps for autograd; None all.
        gradient: "unrolled" differentiates the recorded steps; "implicit" goes on with the last step until the shape
            stands still, and differentiates that fixed point; an :class:`kcs_torch.solvers.Implicit` says how exactly.
        numbers: of the solver itself, looked at before it computes with them.

    Raises:
        OptionError: a number is none, or is out of range, or ``grad_steps`` is given with the implicit gradient.
    """

    raw_corner: Tensor

    def __init__(
        self,
        num_steps: int,
        *,
        momentum: float,
        learnable: bool,
        grad_steps: int | None,
        gradient: Gradient,
        **numbers: Any,
    ) -> None:
        super().__init__()
        numbers["momentum"] = momentum
        for name, value in numbers.items():
            if isinstance(value, bool) or not isinstance(value, Real):
                raise OptionError(f"{type(self).__name__}: {name}: expected a number, got {value!r}")
        whole = all(isinstance(x, Integral) for x in (num_steps, 0 if grad_steps is None else grad_steps))
        if not whole or num_steps < 1 or not 0 <= momentum < 1 or (grad_steps is not None and grad_steps < 0):
            raise OptionError(
                f"{type(self).__name__}: expected whole num_steps >= 1, grad_steps >= 0 or None, and momentum within "
                f"[0, 1), got {num_steps!r}, {grad_steps!r} and {momentum!r}"
            )
        if not isinstance(gradient, Implicit) and gradient not in ("unrolled", "implicit"):
            raise OptionError(
                f"{type(self).__name__}: gradient: expected 'unrolled', 'implicit' or an Implicit, got {gradient!r}"
            )
        if gradient != "unrolled" and grad_steps is not None:
            raise OptionError(
                f"{type(self).__name__}: grad_steps: the implicit gradient records one step: expected None, "
                f"got {grad_steps}"
            )
        self.num_steps, self.learnable, self.grad_steps, self.momentum = num_steps, learnable, grad_steps, momentum
        self.implicit = Implicit() if gradient == "implicit" else gradient if isinstance(gradient, Implicit) else None

    def extra_repr(self) -> str:
        shown = [f"num_steps={self.num_steps}", f"momentum={self.momentum:g}"]
        if self.grad_steps is not None:
            shown.append(f"grad_steps={self.grad_steps}")
        if self.implicit is not None:
            shown.append(f"gradient={self.implicit}")
        return ", ".join(shown)

    def _run(
        self,
        step: Callable[[Tensor, int], Tensor],
        start: Tensor,
        *,
        inner: int = 3,
        measure: bool = True,
        depends_on: Sequence[Tensor | None] = (),
    ) -> Solution[Tensor]:
        """Make all steps, each from a point ahead of the last shape; the state is (shape, point ahead).

        Args:
            step: (point ahead, number of the step) to the next shape.
            start: (..., *).
            inner: trailing dimensions of one problem.
            measure: tell whether the last step stood still, which waits for the device.
            depends_on: what the step depends on beside the parameters.
        """

        def advance(state: tuple[Tensor, Tensor], k: int) -> tuple[Tensor, Tensor]:
            shape = step(state[1], min(k, self.num_steps - 1))
            return shape, shape + self.momentum * (shape - state[0])

        def change(old: tuple[Tensor, Tensor], new: tuple[Tensor, Tensor]) -> Tensor:
            return relative_change(old[0].flatten(-2), new[0].flatten(-2))

        if self.implicit is None:
            solution = iterate(
                advance,
                (start, start),
                num_steps=self.num_steps,
                change=change if measure else None,
                tolerance=SETTLED,
                check_every=self.num_steps,
                grad_steps=self.grad_steps,
            )
            return Solution(solution.value[0], solution.converged, solution.iterations, change=solution.change)
        how, last = self.implicit, self.num_steps - 1
        with torch.no_grad():
            first = iterate(advance, (start, start), num_steps=self.num_steps)
            rest = iterate(
                lambda state, _: advance(state, last),
                first.value,
                num_steps=how.settle,
                change=change,
                tolerance=how.tolerance,
            )
        learned = any(x is not None and x.requires_grad for x in (*depends_on, *self.parameters()))
        with torch.set_grad_enabled(torch.is_grad_enabled() and learned):
            value = fixed_point(
                lambda shape: step(shape, last),
                rest.value[0],
                inner=inner,
                num_steps=how.adjoint_steps,
                tolerance=how.adjoint_tolerance,
                name=type(self).__name__,
            )
        return Solution(value, rest.converged, self.num_steps + rest.iterations)

    def _positive(self, name: str, values: Sequence[float] | Tensor, *, learnable: bool | None = None) -> None:
        """Hold positive numbers, in double precision until the module is cast, as softplus of what is learned."""
        raw = inverse_softplus(torch.as_tensor(values, dtype=torch.float64))
        if self.learnable if learnable is None else learnable:
            setattr(self, f"raw_{name}", nn.Parameter(raw))
        else:
            self.register_buffer(f"raw_{name}", raw)

    def _values(self, name: str, like: Tensor) -> Tensor:
        return nn.functional.softplus(getattr(self, f"raw_{name}")).to(like)

    def _step_sizes(self, weights: Tensor, cameras: Tensor) -> Tensor:
        """Step size (...) of each step, for weights (..., T, N) and cameras (..., T, 2, 3).

        Where weights are above 1 or rows of cameras longer than 1, the slope of the data term changes by as much more,
        and steps are shorter, or they would diverge. Where a fixed point is sought, which hardly depends on it, the
        derivative is 0: what has not settled leaves some slope. Adam, which divides by its size, would go on to steps
        that diverge.
        """
        size = self._values("step", weights)
        steep = (weights.amax(-1) * cameras.square().sum(-1).amax(-1)).amax(-1)
        steep = torch.where(steep > STEEP, steep, 1)
        if self.implicit is not None:
            size, steep = size.detach() + 0 * size, steep.detach()
        return size[(..., *[None] * steep.ndim)] / steep

    def _hold_corner(self, corner: float) -> None:
        """Hold the corner of each step; an infinite one is the plain nuclear norm, and nothing to learn."""
        self.corner = corner
        if math.isfinite(corner):
            self._positive("corner", [corner] * self.num_steps)

    def _corners(self, scale: Tensor, share: Tensor | None = None) -> Sequence[Tensor | float]:
        """Corner (...) of each step in the unit of the singular values: of the module, or one share (...) for all."""
        if share is not None:
            return [corner_of(share, scale)] * self.num_steps
        if not hasattr(self, "raw_corner"):
            return [math.inf] * self.num_steps
        return (self._values("corner", scale).clamp_min(SHARPEST) * scale[..., None]).unbind(-1)

    def _load_from_state_dict(self, state_dict: dict[str, Any], prefix: str, *arguments: Any) -> None:
        """Older states have no corners, which were not learned: they stay what the constructor was told."""
        if hasattr(self, "raw_corner"):
            state_dict.setdefault(f"{prefix}raw_corner", self.raw_corner.detach())
        super()._load_from_state_dict(state_dict, prefix, *arguments)

    def _hold_lengths(self, skeleton: Skeleton, lengths: Sequence[float] | None, learnable: bool) -> None:
        """Hold relative bone lengths with mean 1: those given, or the skeleton's where they are to be learned."""
        self.has_lengths = learnable or lengths is not None
        if not self.has_lengths:
            return
        if lengths is None:
            known = skeleton.relative_lengths(dtype=torch.float64)
            if known is None:
                raise SkeletonError(
                    f"{type(self).__name__}: learnable_lengths: skeleton '{skeleton.name}' has neither proportions nor "
                    "a template: expected lengths=..., one number per bone, to start from"
                )
        else:
            try:
                listed = [float(value) for value in lengths]
            except (TypeError, ValueError):  # no numbers
                listed = []
            known = torch.tensor(listed, dtype=torch.float64)
            if len(listed) != skeleton.num_bones or not all(0 < value < math.inf for value in listed):
                raise OptionError(
                    f"{type(self).__name__}: lengths: expected {skeleton.num_bones} positive numbers, one per bone of "
                    f"skeleton '{skeleton.name}', got {lengths!r}"
                )
        known = (known / known.mean()).clamp_min(1e-3)  # a bone without length in the template may grow
        self._positive("length", known, learnable=learnable)

    def _lengths(self, like: Tensor) -> Tensor:
        """Relative bone lengths (B,) that the module holds."""
        return self._values("length", like).clamp_min(SHORTEST)

    def _check(
        self,
        tracks: Tensor,
        cameras: Tensor | None,
        weights: Tensor | None,
        start: Tensor | None,
        skeleton: Skeleton | None = None,
        *,
        seek: bool = False,
        lengths: Tensor | None = None,
        scales: Tensor | None = None,
        inside: Tensor | None = None,
    ) -> Tensor:
        """Return the weights (..., T, N) in the dtype of the tracks, 0 where these are not finite, and in padding.

        Cameras have to be given unless they are what is sought.

        Raises:
            ShapeError: the arguments do not fit.
        """
        name = type(self).__name__
        check_points(tracks, self, "tracks")
        given = {"cameras": cameras, "start": start}
        for what, value in given.items():
            if value is not None or (what == "cameras" and not seek):
                check_tensor(value, what, self)
        if tracks.ndim < 3 or tracks.shape[-1] != 2 or (
            cameras is not None and cameras.shape[-3:] != (tracks.shape[-3], 2, 3)
        ):  # fmt: skip
            got = f"{tuple(tracks.shape)} and {None if cameras is None else tuple(cameras.shape)}"
            if cameras is not None and cameras.shape[-2:] == (3, 3):
                got += ": of rotations the first two rows, cameras[..., :2, :]"
            raise ShapeError(f"{name}: expected tracks (..., T, N, 2) and cameras (..., T, 2, 3), got {got}")
        if tracks.shape[-3] == 0:
            raise ShapeError(f"{name}: expected at least 1 frame, got none")
        if cameras is not None and (cameras.dtype != tracks.dtype or cameras.device != tracks.device):
            raise ShapeError(
                f"{name}: expected cameras of the tracks' dtype and device, got {cameras.dtype} on "
                f"{cameras.device} for {tracks.dtype} on {tracks.device}: use cameras.to(tracks)"
            )
        if skeleton is not None:
            check_joints(self, skeleton, tracks, "tracks (..., T, {}, 2)")
            check_beside(lengths, "lengths", (skeleton.num_bones,), tracks, self, "tracks")
        check_beside(scales, "scales", tracks.shape[-3:-2], tracks, self, "tracks")
        check_weights(weights, tracks, self)
        check_inside(inside, tracks, self)
        if start is not None and start.shape[-3:] != (*tracks.shape[-3:-1], 3):
            expected = f"(..., {tracks.shape[-3]}, {tracks.shape[-2]}, 3)"
            raise ShapeError(f"{name}: expected start {expected}, got {tuple(start.shape)}")
        for what, value in given.items():
            if value is not None and not fit_together(value.shape[:-3], tracks.shape[:-3]):
                expected = f"a batch of {what} like that of tracks {tuple(tracks.shape)}"
                raise ShapeError(f"{name}: expected {expected}, got {tuple(value.shape)}")
        return clear_padding(seen_weights(tracks, weights).to(tracks.dtype), inside, 1)
