"""A virtual camera that looks at a body along its line of sight: :class:`View`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import torch
from torch import Tensor

from kcs_torch.clean.timing import cuts_of
from kcs_torch.functional.guarded import or_one
from kcs_torch.functional.temporal import interpolate
from kcs_torch.methods.clips.size import slow_waves, weak_perspective
from kcs_torch.methods.perspective.pinhole import NEAREST
from kcs_torch.types import Intrinsics, Tracks

__all__ = ["View", "lens_note", "slow_part", "zoomed"]

APPARENT = 0.004
"""Root mean square tangent between joints and the line of sight from which on distances follow the size over time, even
if it is not sure to change: that of a person some 100 metres away."""


class View(NamedTuple):
    """What a virtual camera sees that looks at a body along its line of sight, ray by ray.

    Attributes:
        lens: of the camera.
        look: (T, 3, 3) rotations from the camera's frame to the virtual one's, which turns slowly.
        rays: (T, N, 2) of the tracks.
        cuts: first frames of all shots of the film but the first.
    """

    lens: Intrinsics
    look: Tensor
    rays: Tensor
    cuts: tuple[int, ...]

    @classmethod
    def of(cls, tracks: Tracks, lens: Intrinsics, rate: float) -> View:
        """That of tracks seen through a lens, at so many frames a second."""
        rays, cuts = lens.rays(tracks.points), tuple(cuts_of(tracks))
        look = _line_of_sight(rays, tracks.weights, rate, cuts)
        return cls(lens, look, _onto(rays @ look.mT), cuts)

    def along(self, image: Tensor) -> Tensor:
        """Rays (T, N, 2) of points in the image (T, N, 2)."""
        return _onto(self.lens.rays(image) @ self.look.mT)

    def seen_from(self, other: View, rays: Tensor) -> Tensor:
        """Another view's rays (T, N, 2) in this one, of the same points in the image."""
        image = other.lens.project(torch.cat([rays, torch.ones_like(rays[..., :1])], -1) @ other.look)
        return self.along(image)

    def first_distance(self, tracks: Tracks, rate: float) -> Tensor:
        """Distances (T,) that the body's size in the image tells, the focal length on average."""
        size = weak_perspective(self.rays, tracks.seen, tracks.skeleton, rate, self.cuts)
        wide = float(self.rays[tracks.seen].square().sum(-1).mean().sqrt()) if bool(tracks.seen.any()) else 0.0
        distance = torch.full_like(self.rays[:, 0, 0], self.lens.focal)
        return distance / size.path if size.sure or wide > APPARENT else distance


def zoomed(lens: Intrinsics, by: float) -> Intrinsics:
    """A lens of so many times the focal length."""
    return replace(lens, fx=lens.fx * by, fy=lens.fy * by)


def lens_note(lens: Intrinsics, units: str, whose: str = "") -> str:
    """What is told of a lens that was found, from the tracks of somebody else if it says ``whose``."""
    of = f" of {whose}" if whose else ""
    focal, x, y = (f"{v:.0f}" if lens.focal > 100 else f"{v:.4g}" for v in (lens.focal, lens.cx, lens.cy))
    return (
        f"focal length of {focal} {units} found from the tracks{of}, a guess: the true one may be half or twice as "
        f"long; principal point taken to be ({x}, {y}), from which x and y are measured"
    )


def slow_part(values: Tensor, rate: float, cuts: Sequence[int] = (), *, most: int = 12) -> Tensor:
    """The slow part of (T, D), of each shot by itself."""
    return torch.cat([_slow(shot, rate, most) for shot in values.tensor_split(list(cuts))])


def _slow(values: Tensor, rate: float, most: int) -> Tensor:
    """:func:`slow_part` of a single shot."""
    waves = slow_waves(len(values), rate, values, most=most)
    basis = torch.cat([torch.ones_like(waves[:, :1]), waves], -1)
    ridge = 1e-6 * len(values) * torch.eye(basis.shape[1], dtype=values.dtype, device=values.device)
    mean = values.mean(0)
    return mean + basis @ torch.linalg.solve(basis.mT @ basis + ridge, basis.mT @ (values - mean))


def _onto(rays: Tensor) -> Tensor:
    """Rays (T, N, 3) where they pass the plane z = 1."""
    return rays[..., :2] / rays[..., 2:].clamp_min(NEAREST)


def _line_of_sight(rays: Tensor, weights: Tensor, rate: float, cuts: Sequence[int]) -> Tensor:
    """Rotations (T, 3, 3) from the camera's frame to one that looks at the body, turning slowly."""
    count = weights.sum(-1, keepdim=True)
    middle = (rays * weights[..., None]).sum(-2) / or_one(count)
    middle = interpolate(middle[:, None], count > 0)[:, 0]
    smooth = slow_part(middle, rate, cuts, most=60)
    if not bool((count > 0).any()):
        smooth = smooth + smooth.new_tensor([0.0, 0.0, 1.0])  # nobody to look at
    ahead = torch.nn.functional.normalize(smooth, dim=-1)
    right = torch.zeros_like(ahead)
    right[:, 0] = 1
    right = torch.nn.functional.normalize(right - ahead[:, :1] * ahead, dim=-1)
    return torch.stack([right, torch.linalg.cross(ahead, right), ahead], 1)
