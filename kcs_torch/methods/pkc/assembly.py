"""Solutions whose bones keep their length exactly, put together from paths that single bones can take."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from kcs_torch.functional.chain import bone_vectors, chain_inverse, incidence, points_from_bones
from kcs_torch.methods.clips.lockstep import Search
from kcs_torch.solvers.bone_paths import BonePaths, nearest_paths
from kcs_torch.solvers.corners import Corners, agreeing_paths
from kcs_torch.solvers.lifts import rotations_over_time
from kcs_torch.solvers.procrustean import Pose, Stage, align_rotations

__all__ = ["SLACK", "TIGHT", "WORTH", "Assembly", "followed"]

COMBINED = 256
"""Combinations of bones' paths that are aligned."""

WORTH = 20.0
"""Weight of how likely the path of each bone is by itself: a bone keeps its direction for about so many frames, which
the other terms count one by one."""

TIGHT, SLACK = 10.0, 0.003
"""Weight of each length of a tree whose bones are rigid, and of each distance that an angle keeps; and their standard
deviation where solutions are compared."""

TOP, KEEP = 12, 4
"""Starts that are kept after the first group of stages and after those that follow."""

TIMES = 8
"""How often the best changes one bone's path at most."""

ALIGNED = 32
"""Changes of one bone that are aligned anew: those that cost least as the body lies."""

FEW, MANY = 8, 4
"""Changes that are settled each time, for bodies of few bones and of many."""

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
        corners: where bones meet whose angle may be kept.
        stages: groups of stages that settle starts whose bones are as good as constant; only the best go on after each.
            Coarse ones lose that, and more so the more bones there are.
        value: (H,) of solutions; the lowest is best.
        descend: a search that settles starts by some of the stages.
    """

    image: Tensor
    bones: Tensor
    paths: BonePaths
    corners: Corners
    stages: tuple[tuple[Stage, ...], ...]
    value: Callable[[Pose], Tensor]
    descend: Callable[[Pose, tuple[Stage, ...]], Search[Any, Any, Pose]]

    def near(self, found: Pose) -> Search[Any, Any, Pose]:
        """Solutions, best first: those that are given, settled, the paths nearest to them, and changes of one bone."""
        pose = yield from self._settled(_joined(found, self._nearest(found)))
        return (yield from self._changed(pose, MANY))

    def searched(self, found: Pose) -> Search[Any, Any, Pose]:
        """As :meth:`near`, with the combinations of paths that keep most angles beside it; for few bones."""
        pose = yield from self._settled(_joined(found, self._nearest(found)))
        exact = self._agreeing()
        exact = yield from self.descend(exact[self.value(exact).argsort()[:TOP]], self.stages[-1][-1:])
        pose = _joined(pose, exact)
        return (yield from self._changed(pose[self.value(pose).argsort()[:KEEP]], FEW))

    def _changed(self, pose: Pose, count: int) -> Search[Any, Any, Pose]:
        """Solutions, best first, of which the best takes other paths of single bones while that makes it better."""
        for _ in range(TIMES):
            best, depth = self.value(pose)[0], self._changes(pose)
            if not len(depth):
                break
            likely = self.value(self._placed(depth, pose.rotations[:1], 0)).argsort()[:ALIGNED]
            tried = self._placed(depth[likely], pose.rotations[:1], 2)
            tried = yield from self._settled(tried[self.value(tried).argsort()[:count]])
            if not bool(self.value(tried)[0] < best - GAIN):
                break
            pose = _joined(tried[:1], pose)
        return pose

    def _settled(self, pose: Pose) -> Search[Any, Any, Pose]:
        for k, stages in enumerate(self.stages):
            pose = yield from self.descend(pose, stages)
            pose = pose[self.value(pose).argsort()[: KEEP if k else TOP]]
        return pose

    def _placed(self, depth: Tensor, rotations: Tensor, num_steps: int = 10) -> Pose:
        """Bodies of bones' depths (H, B, T), aligned from rotations (H or 1, T, 3, 3)."""
        points, zero = _lifted(self.image, depth, self.bones), depth.new_zeros(len(depth))
        turned = align_rotations(points, rotations.expand(len(depth), -1, -1, -1), self.bones, num_steps=num_steps)
        return Pose(points, turned, zero, zero)

    def _nearest(self, found: Pose) -> Pose:
        return self._placed(nearest_paths(self.paths, _depths(found.points, self.bones)), found.rotations)

    def _agreeing(self) -> Pose:
        """Bones' paths that keep most angles, each frame aligned with the one before it at first."""
        flat = bone_vectors(self.image, self.bones).movedim(-2, 0)
        depth = agreeing_paths(self.paths, flat, self.corners, COMBINED, worth=WORTH, stiffness=TIGHT, slack=SLACK)
        vectors = bone_vectors(_lifted(self.image, depth, self.bones), self.bones)
        return self._placed(depth, rotations_over_time(vectors))

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
