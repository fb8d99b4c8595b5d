"""A body followed from frame to frame: the filter of its pose, its shape, and how large it looks."""

from __future__ import annotations

import copy
import math

import torch
from torch import Tensor

from kcs_torch.functional.chain import bone_vectors
from kcs_torch.live.filter import BodyFilter, ChainFilter, Shape, Told
from kcs_torch.live.size import SizeFilter, longest_image
from kcs_torch.skeleton import Skeleton

__all__ = ["Follower"]


class Follower:
    """Takes frames one at a time.

    Args:
        skeleton: a tree.
        pose: the filter of the bones' depths.
        fps: frames a second.

    Attributes:
        shape: of the body, as a solve found it; None before there is one.
    """

    def __init__(self, skeleton: Skeleton, pose: BodyFilter | ChainFilter, fps: float) -> None:
        self.pose, self.size = pose, SizeFilter(fps)
        self.bones, self.rigid = skeleton.bone_index(), list(skeleton.rigid)
        self.shape: Shape | None = None
        self._longest = torch.zeros(skeleton.num_bones, dtype=torch.float64)  # of the bones' images

    def taught(self, shape: Shape) -> Follower:
        """Another one, who knows the body's shape, for the frames that are taken again."""
        other = copy.copy(self)
        other.pose, other.size, other.shape = copy.copy(self.pose), copy.copy(self.size), shape
        other.pose.reset()
        return other

    def body(self) -> Shape:
        """The body, as large as it was in the frame before."""
        return self.pose.guess(self._longest) if self.shape is None else self.shape.sized(self.size.value)

    def take(self, image: Tensor, weights: Tensor, told: Told | None = None) -> tuple[Tensor, Shape]:
        """Filter a frame: dz (B,) of its bones, and the body, as large as frames tell.

        Args:
            image: (N, 2), complete.
            weights: (N,) confidences.
            told: what a window solve says of this frame, if anything.
        """
        self._longest = torch.maximum(self._longest, bone_vectors(image, self.bones).norm(dim=-1))
        if told is None:
            self.size.predict()
        else:
            self.size.value = float(told.sizes)
        shape = self.body()
        dz = self.pose.step(image, weights, shape, told)
        if told is None and self.shape is not None:
            self.size.correct(self._looks(image, weights, shape), self.pose.size)
        return dz, shape

    def begin_again(self, image: Tensor, weights: Tensor) -> None:
        """Before a frame is taken: find a known body anew in it, of any heading and size; it may be another one."""
        self.pose.reset()
        looks = self._looks(image, weights, self.body())
        self.size.value, self.size.slope = self.size.value + (0.0 if math.isnan(looks) else looks), 0.0

    def _looks(self, image: Tensor, weights: Tensor, shape: Shape) -> float:
        """Log of how long bones that hardly tilt look in a frame, over what is usual; NaN where too few are seen."""
        lengths = shape.lengths[self.rigid] / shape.factor
        return float(longest_image(image, weights > 0, self.bones[self.rigid], lengths)) - shape.usual
