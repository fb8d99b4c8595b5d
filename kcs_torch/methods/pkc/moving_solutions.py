"""Solutions of a body that is seen from a viewpoint that turns, and how sure their depths are."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from kcs_torch.functional.chain import bone_vectors
from kcs_torch.solvers.camera_path import CameraPath, choose_path, settle_path
from kcs_torch.solvers.procrustean import Pose, depth_deviation

__all__ = ["MovingView", "agreement"]

FARTHER = 1.8
"""How far depths are off, in deviations of the image, beyond what exact tracks leave open: fitted to dogs, hands and
people in noise of 1 to 4 % of their size, and with 30 % missing, before a camera that goes round by 180 degrees."""


@dataclass(frozen=True)
class MovingView:
    """Solutions of one clip, best first, none like another or its mirror image.

    Attributes:
        pose: points (H, T, N, 3) in the camera frame, and the rotations that align them.
        value: (H,) by which they are ranked.
        bones: (B, 2) tree that the poses were aligned in.
        rigid: (P, 2) pairs that keep their distance.
        stiffness: weight of each length.
        lead: by how much the next solution is dearer, for each frame compared, where paths of bones were combined; 0
            where they were not, or no solution was left to compare.
        noise: (T, N) deviations of the image, a joint's own and those of its frame, or None where it is exact.
        rivalled: whether another search found a body that differs and is hardly dearer.
        found: whether the pairs were chosen for keeping their distance, so that it tells nothing that they do.
    """

    pose: Pose
    value: Tensor
    bones: Tensor
    rigid: Tensor
    stiffness: float
    lead: float = 0.0
    rivalled: bool = False
    noise: Tensor | None = None
    found: bool = False

    def cameras(self, index: int = 0) -> tuple[Tensor, CameraPath]:
        """Rotations (T, 3, 3), world to camera, of one solution, and the kind of path they follow.

        What aligns poses also turns with the body; a camera moves simply. See
        :func:`kcs_torch.solvers.camera_path.choose_path`.
        """
        path, kind, _ = choose_path(self.pose.rotations[index])
        if kind == "constant":
            path = settle_path(bone_vectors(self.pose.points[index], self.bones), path)
        return path, kind

    def deviation(self, cameras: Tensor, index: int = 0) -> Tensor:
        """Standard deviation (T, N) of the depths of one solution, for camera rotations (T, 3, 3)."""
        pose, views = self.pose[index : index + 1], cameras[None, :, 2]
        telling = self.rigid[:0] if self.found else self.rigid
        own = depth_deviation(
            pose.points, pose.rotations, self.bones, views=views, rigid=telling, stiffness=self.stiffness
        )[0]
        return own if self.noise is None else torch.hypot(own, FARTHER * self.noise)


def agreement(depth: Tensor, other: Tensor) -> float:
    """Correlation of two solutions' depths (T, N), whichever mirror images they are."""
    a, b = (z - z.mean(-1, keepdim=True) for z in (depth, other))
    return float((a * b).sum().abs() / (a.norm() * b.norm()).clamp_min(torch.finfo(a.dtype).tiny))
