"""A network with a solver at its end: :class:`RefinedLifter`."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor, nn

from kcs_torch.errors import SkeletonError
from kcs_torch.functional import centre
from kcs_torch.functional.guarded import largest, or_one
from kcs_torch.functional.precision import narrow, wide
from kcs_torch.functional.weights import seen_weights
from kcs_torch.nn.checks import check_inside, check_points, check_weights
from kcs_torch.nn.masks import clear_padding
from kcs_torch.skeleton import Skeleton

__all__ = ["RefinedLifter"]


class RefinedLifter(nn.Module):
    """A lifting network whose answer is the start of an unrolled solver, in the camera frame.

    The solver brings what the network cannot promise: points that project to the tracks, bones of one length. It
    centres every frame; the points are put back to where the tracks are.

    Args:
        network: (tracks, weights) to points, such as :class:`TemporalLifter`.
        solver: called as ``solver(tracks, cameras, weights=..., start=points)``, such as :class:`UnrolledSfAM`; with
            ``inside``, too, where that is given.

    Raises:
        SkeletonError: the two are of different skeletons.

    >>> from kcs_torch.nn import TemporalLifter, UnrolledSfAM
    >>> network = RefinedLifter(TemporalLifter("h36m17"), UnrolledSfAM("h36m17", num_steps=3))
    >>> network(torch.rand(2, 27, 17, 2)).shape
    torch.Size([2, 27, 17, 3])
    """

    def __init__(self, network: nn.Module, solver: nn.Module) -> None:
        super().__init__()
        bodies = [getattr(module, "skeleton", None) for module in (network, solver)]
        if None not in bodies and bodies[0] != bodies[1]:
            one, other = (f"'{body.name}'" for body in bodies if body is not None)
            raise SkeletonError(f"RefinedLifter: expected a solver of the network's skeleton, {one}, got {other}")
        self.network, self.solver = network, solver

    @property
    def skeleton(self) -> Skeleton:
        """Of the network."""
        own: Any = self.network.skeleton
        assert isinstance(own, Skeleton)
        return own

    def forward(self, tracks: Tensor, weights: Tensor | None = None, *, inside: Tensor | None = None) -> Tensor:
        """Lift tracks.

        Args:
            tracks: (..., T, N, 2), NaN where unseen.
            weights: (..., T, N), 0 where unseen.
            inside: (..., T), False in frames that pad a shorter clip, as of :meth:`UnrolledFPC.forward`.

        Returns:
            (..., T, N, 3); 0 in padding.

        Raises:
            ShapeError: the tracks are not of the network's skeleton, or the arguments do not fit.
        """
        more = {}
        if inside is not None:
            check_points(tracks, self, "tracks")
            check_weights(weights, tracks, self)
            check_inside(inside, tracks, self)
            weights, more = clear_padding(seen_weights(tracks, weights), inside, 1), {"inside": inside}
        points = clear_padding(wide(self.network(tracks, weights)), inside)
        top = or_one(largest(points, 3))  # divided out first, so that neither sums nor squares overflow
        points, middle = centre(points / top)
        weights = seen_weights(tracks, weights)
        image = torch.where(weights[..., None] > 0, wide(tracks) / top, points[..., :2] + middle[..., :2])
        square = points[..., :2].square().mean((-3, -2, -1), keepdim=True)
        if inside is not None:
            square = square * (points.shape[-3] / inside.sum(-1).clamp_min(1))[..., None, None, None]
        size = or_one(square.sqrt().detach())
        cameras = torch.eye(3, dtype=image.dtype, device=image.device)[:2].expand(*image.shape[:-2], 2, 3)
        image, start = (image - middle[..., :2]) / size, points / size
        refined: Tensor = self.solver(image, cameras, weights=weights, start=start, **more)
        return narrow(clear_padding((refined * size + middle) * top, inside), tracks)
