"""Solutions whose bones keep their length exactly, put together from paths that single bones can take."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from kcs_torch.functional.chain import bone_vectors, chain_inverse, incidence, points_from_bones
from kcs_torch.methods.lockstep import Search
from kcs_torch.solvers.bone_paths import BonePaths, nearest_paths
from kcs_torch.solvers.lifts import turning_cameras
from kcs_torch.solvers.procrustean import Pose, Stage, align_rotations

__all__ = ["Assembly", "followed"]

ALL, DRAWN = 256, 64
"""Combinations of all bones' likeliest paths, before or behind the image plane, and of paths that are drawn by cost."""

SPREAD = 5.0
"""Cost of a path that is drawn e times more seldom."""

TOP, KEEP = 12, 4
"""Starts that go on after the first stage and after the second."""

TIMES = 8
"""How often the best changes one bone's path at most."""

FEW, MANY = (8, TOP, KEEP), (4, 2, 1)
"""For bodies of few bones and of many: changes that are settled each time, and how many of them go on after the first
stage and after the second."""

GAIN = 1.0
"""How much cheaper a solution has to be to count as better."""

CHANGED = 0.02
"""Root mean square change of a bone's depth that is another path, of tracks of root mean square 1."""

FIT = 0.1
"""Root mean square difference, a share of the bone's length, of depths that follow a path."""


@dataclass(frozen=True)
class Assembly:
    """One clip, of which some frames are looked at.

    Attributes:
        image: (T, N, 2), of these frames.
        bones: (B, 2), a tree of the joints.
        paths: of the bones, at these frames.
        stages: that settle starts whose bones are as good as constant.
        value: (H,) of solutions; the lowest is best.
        descend: a search that settles starts by some of the stages.
        seed: of random numbers.
    """

    image: Tensor
    bones: Tensor
    paths: BonePaths
    stages: tuple[Stage, ...]
    value: Callable[[Pose], Tensor]
    descend: Callable[[Pose, tuple[Stage, ...]], Search[Any, Any, Pose]]
    seed: int

    def near(self, found: Pose) -> Search[Any, Any, Pose]:
        """Solutions, best first: those that are given, settled, the paths nearest to them, and changes of one bone."""
        return (yield from self._changed(_joined(found, self._nearest(found)), MANY))

    def searched(self, found: Pose) -> Search[Any, Any, Pose]:
        """As :meth:`near`, with all combinations of paths beside it; for few bones."""
        return (yield from self._changed(_joined(found, self._nearest(found), self._combined()), FEW))

    def _changed(self, found: Pose, kept: tuple[int, int, int]) -> Search[Any, Any, Pose]:
        """Solutions, settled, best first; the best takes other paths of single bones while that makes it better."""
        pose = yield from self._settled(found)
        for _ in range(TIMES):
            best, depth = self.value(pose)[0], self._changes(pose)
            if not len(depth):
                break
            tried = self._placed(depth, pose.rotations[:1], 2)
            tried = yield from self._settled(tried[self.value(tried).argsort()[: kept[0]]], *kept[1:])
            if not bool(self.value(tried)[0] < best - GAIN):
                break
            pose = _joined(tried[:1], pose)
        return pose

    def _settled(self, pose: Pose, top: int = TOP, keep: int = KEEP) -> Search[Any, Any, Pose]:
        for stages, kept in ((self.stages[:1], top), (self.stages[1:2], keep), (self.stages[2:], keep)):
            pose = yield from self.descend(pose, stages)
            pose = pose[self.value(pose).argsort()[:kept]]
        return pose

    def _placed(self, depth: Tensor, rotations: Tensor, num_steps: int = 10) -> Pose:
        """Bodies of bones' depths (H, B, T), aligned from rotations (H or 1, T, 3, 3)."""
        points, zero = _lifted(self.image, depth, self.bones), depth.new_zeros(len(depth))
        turned = align_rotations(points, rotations.expand(len(depth), -1, -1, -1), self.bones, num_steps=num_steps)
        return Pose(points, turned, zero, zero)

    def _nearest(self, found: Pose) -> Pose:
        return self._placed(nearest_paths(self.paths, _depths(found.points, self.bones)), found.rotations)

    def _combined(self) -> Pose:
        """Bones' likeliest paths with all signs (or some), and paths drawn by their cost, before turning cameras."""
        depth, cost = self.paths
        count = len(depth)
        generator = torch.Generator().manual_seed(self.seed)
        draw = lambda *size: torch.randint(0, 2, size, generator=generator, device="cpu")  # noqa: E731
        if 2 ** (count - 1) <= ALL:
            bits = torch.arange(count, device="cpu")
            index = torch.arange(2 ** (count - 1), device="cpu")[:, None] >> bits
            signs = torch.cat([index & 1, draw(DRAWN, count)])
        else:
            signs = draw(ALL + DRAWN, count)
        likely = (-cost / SPREAD).softmax(-1).double().cpu()
        drawn = likely.multinomial(DRAWN, replacement=True, generator=generator).mT  # (DRAWN, B)
        which = torch.cat([torch.zeros_like(signs[DRAWN:]), drawn]).to(depth.device)
        made = (1 - 2 * signs).to(depth)[..., None] * depth[torch.arange(count, device=depth.device), which]
        degrees = 360 * torch.rand(len(made), generator=generator, dtype=torch.float64, device="cpu")
        return self._placed(made, turning_cameras(degrees, depth.shape[-1], dtype=depth.dtype, device=depth.device))

    def _changes(self, pose: Pose) -> Tensor:
        """The best with another path, or the mirror image, of one bone, (H, B, T)."""
        own = _depths(pose.points[:1], self.bones)  # (1, B, T)
        paths, cost = self.paths
        mirrored = torch.cat([paths, -paths, -own[0, :, None]], 1)  # (B, 2 K + 1, T)
        real = torch.cat([cost.isfinite(), cost.isfinite(), torch.ones_like(cost[:, :1], dtype=torch.bool)], 1)
        real &= (mirrored - own[0, :, None]).square().mean(-1).sqrt() > CHANGED
        bone, path = real.nonzero().unbind(-1)
        out = own.repeat(len(bone), 1, 1)
        out[torch.arange(len(bone), device=out.device), bone] = mirrored[bone, path]
        return out


def followed(paths: BonePaths, points: Tensor, bones: Tensor, frames: Tensor) -> Tensor:
    """Points (H, T, N, 3) that are right at some frames, in between along those of the bones' paths that fit there."""
    depth = _depths(points, bones)
    near = nearest_paths(paths, depth)
    off = (near - depth)[..., frames].square().mean(-1)
    length = bone_vectors(points, bones).square().sum(-1).mean(-2)  # (H, B), squared
    fits = off < FIT**2 * length
    return _lifted(points[..., :2], torch.where(fits[..., None], near, depth), bones)


def _depths(points: Tensor, bones: Tensor) -> Tensor:
    """Depths (H, B, T) of the bones of points (H, T, N, 3)."""
    return bone_vectors(points[..., 2:], bones)[..., 0].mT


def _lifted(image: Tensor, depth: Tensor, bones: Tensor) -> Tensor:
    """Points (H, T, N, 3) of an image (T, N, 2) or (H, T, N, 2), and bones' depths (H, B, T)."""
    joints = points_from_bones(depth, chain_inverse(incidence(bones, image.shape[-2], dtype=depth.dtype))).mT
    return torch.cat([image.expand(*joints.shape, 2), joints[..., None]], -1)


def _joined(*poses: Pose) -> Pose:
    parts = ((p.points, p.rotations, p.objective, p.moved) for p in poses)
    return Pose(*(torch.cat(part) for part in zip(*parts, strict=True)))
