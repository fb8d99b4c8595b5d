"""Where a body stands on the ground."""

from __future__ import annotations

from pathlib import Path

import torch
from torch import Tensor

from kcs_torch.errors import ShapeError
from kcs_torch.functional.precision import narrow, wide
from kcs_torch.functional.shapes import fit_together
from kcs_torch.functional.weights import known
from kcs_torch.nn.checks import check_positive, check_tensor, check_whole
from kcs_torch.nn.layers import SkeletonModule
from kcs_torch.nn.masks import weighs_joints
from kcs_torch.skeleton import Skeleton
from kcs_torch.solvers.standing import RIDGE, root_velocity

__all__ = ["ContactEnergy"]


class ContactEnergy(SkeletonModule):
    """Feet that stand still in the image stand still in space: the root's depth has to move against them.

    1/2 sum_tc c_tc log(1 + ((z_c,t - z_c,t-1 + v_t)/s)^2) + 1/2 sum_t ((v_t - v_t-1)/a)^2, with the root's depth
    velocity v and the weights c of :func:`kcs_torch.functional.standing`. It holds for a camera that does not move. A
    small multiple of sum_t (v_t/s)^2 settles what no standing foot tells.

    Args:
        skeleton: with contacts; without them only a velocity that is given costs anything.
        slip: s, in units of the points per frame; what is usual is for a body of 1.75 units, metres say, at 30 frames a
            second: of a body in millimetres give a thousand times as much.
        change: a, of the root's velocity from frame to frame, in the same unit.
        num_steps: reweightings that find the best velocity where none is given.

    Raises:
        OptionError: a number is out of range.
    """

    contacts: Tensor

    def __init__(
        self, skeleton: str | Path | Skeleton, *, slip: float = 0.006, change: float = 0.004, num_steps: int = 10
    ) -> None:
        super().__init__(skeleton)
        check_positive(self, finite=True, slip=slip)
        check_positive(self, change=change)
        check_whole(self, 0, num_steps=num_steps)
        self.slip, self.change, self.num_steps = slip, change, num_steps
        contacts = torch.tensor(self.skeleton.contacts, dtype=torch.long)
        self.register_buffer("contacts", contacts, persistent=False)

    def forward(
        self, points: Tensor, velocity: Tensor | None, standing: Tensor, weights: Tensor | None = None
    ) -> Tensor:
        """Return (...).

        Args:
            points: (..., T, N, 3), depth relative to the root or the body's middle.
            velocity: v (..., T), the first frame's does not count; None takes the best one
                (:func:`kcs_torch.solvers.standing.root_velocity`), through whose reweightings derivatives run.
            standing: c (..., T, C).
            weights: (..., T, N) of the joints: a foot stands no more than it is seen; or (..., T) of the frames, 0 for
                one that pads a shorter clip.

        Raises:
            ShapeError: the shapes do not fit.
        """
        self._check(points, velocity, standing)
        inside = torch.ones_like(points[..., 0, 0], dtype=torch.bool)
        if weights is not None:
            of_joints = weighs_joints(weights, points, self)
            seen = weights[..., self.contacts] if of_joints else weights[..., None]
            standing = torch.where(seen > 0, torch.minimum(standing, seen), torch.zeros_like(standing))
            some = (weights.amax(-1) if of_joints else weights) > 0
            inside = some.flip(-1).cumsum(-1).flip(-1) > 0  # what follows the last frame of any weight pads a clip
        depth = wide(points)[..., self.contacts, 2]
        both = torch.minimum(standing[..., 1:, :], standing[..., :-1, :])
        step = known((depth[..., 1:, :] - depth[..., :-1, :])[..., None], both)[..., 0]
        velocity = self._best(step, both, inside) if velocity is None else wide(velocity)
        velocity = known(velocity[..., None], inside)[..., 0]
        move = step + velocity[..., 1:, None]
        slip = (both * torch.log1p((move / self.slip).square())).sum((-2, -1)) / 2
        change = (velocity[..., 2:] - velocity[..., 1:-1]) * inside[..., 2:]
        steady = (change / self.change).square().sum(-1) / 2
        return narrow(slip + steady + RIDGE / 2 * (velocity[..., 1:] / self.slip).square().sum(-1), points)

    def _check(self, points: Tensor, velocity: Tensor | None, standing: Tensor) -> None:
        self.check(points, clip=True)
        if points.shape[-1] != 3:
            raise ShapeError(f"ContactEnergy: points: expected (..., N, 3), got {tuple(points.shape)}")
        frames, batch = points.shape[-3], points.shape[:-3]
        wanted = (
            ("velocity", points[..., 0, 0] if velocity is None else velocity, (frames,), "T"),
            ("standing", standing, (frames, len(self.contacts)), "T, C"),
        )
        for name, value, shape, letters in wanted:
            check_tensor(value, name, self)
            dims = len(shape)
            if value.shape[-dims:] != shape or not fit_together(value.shape[:-dims], batch):
                expected = f"(..., {letters}) = (..., {', '.join(map(str, shape))})"
                got = f"{tuple(value.shape)} for points {tuple(points.shape)}"
                raise ShapeError(f"ContactEnergy: {name}: expected {expected}, got {got}")

    def _best(self, step: Tensor, standing: Tensor, inside: Tensor) -> Tensor:
        """The velocity (..., T) that costs least."""
        if not self.contacts.numel() or not step.shape[-2]:
            return step.new_zeros(*step.shape[:-2], step.shape[-2] + 1)
        own = standing.to(step), self.slip, self.change
        best = root_velocity(step, *own, num_steps=self.num_steps, inside=inside[..., 1:])
        return torch.nn.functional.pad(best, (1, 0))
