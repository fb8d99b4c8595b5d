"""A frame's pose: joints from the depths of their bones, which have constant length."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from kcs_torch.functional.chain import bone_vectors, chain_inverse, incidence
from kcs_torch.functional.ranks import median
from kcs_torch.live.filter import Shape
from kcs_torch.skeleton import Skeleton

__all__ = ["Chain", "LivePose"]

USUAL = 0.1
"""Standard deviation of a bone's length as a share, before a window has been solved."""

FLAT = 0.25
"""Share of its length below which a bone's depth is no better known for being small."""

APART = 3.0
"""A joint that is so many times as far from where the chain places it as usual counts a fourth for the body's place."""

DRIFT, FARTHEST = 1.0, 0.3
"""Speed at which an unseen joint's deviation grows, a second, and how far; a person being 1.75 tall."""


@dataclass(frozen=True)
class LivePose:
    """The pose of one frame.

    Attributes:
        frame: its number, from 0.
        points: (N, 3) in the camera frame, in the units of the tracks: x and y in the image, depth relative to the
            body's middle. NaN until a joint has been seen.
        uncertainty: (N,) standard deviation of the depths, in the same units: what the last solve said of them, how far
            live ones usually are from those that solves find later, doubts about signs, and how far the joint is from
            where it was detected. Infinite until a joint, or without a template a bone, has been seen.
        seen: (N,) bool, False where a joint is placed by prediction.
        ready: whether the body's bone lengths have been found; before, they are the template's.
        delay: frames since the window ended from which the bone lengths come; -1 before there is one.
    """

    frame: int
    points: Tensor
    uncertainty: Tensor
    seen: Tensor
    ready: bool
    delay: int


class Chain:
    """The bones of a body as a tree along which depths add up.

    Args:
        body: a tree.
        trunk: (B,) bool, bones whose direction the trunk's rotation gives.
        fps: frames a second.
    """

    def __init__(self, body: Skeleton, trunk: Tensor, fps: float) -> None:
        self.bones, self.trunk, self.fps = body.bone_index(), trunk, fps
        self.tree = chain_inverse(incidence(self.bones, body.num_joints, dtype=torch.float64))  # (N, B)
        self.squares = self.tree.square()
        self.rigid = body.rigid_mask()

    def place(self, image: Tensor, weights: Tensor, dz: Tensor, shape: Shape) -> Tensor:
        """Place the joints (N, 3), in the tracks' units, so that rigid bones have their length.

        A bone that looks too long is shortened. Bones of the trunk keep the direction that image and rotation give.
        The body is where most of its seen joints are in the image: one that is elsewhere moves no other.

        Args:
            image: (N, 2), complete.
            weights: (N,) confidences, 0 where ``image`` is a guess.
            dz: (B,) depths of the bones, in the template's units.
            shape: what is known of the body.
        """
        image, length = image * shape.factor, shape.lengths
        flat = bone_vectors(image, self.bones)
        size = flat.norm(dim=-1).clamp_min(1e-12)
        whole = torch.where(self.trunk, torch.hypot(size, dz), size)
        share = torch.where(self.trunk, length / whole, (length / whole).clamp_max(1.0))
        deep = torch.copysign((length.square() - size.square()).clamp_min(0).sqrt(), dz)
        depth = torch.where(self.trunk, dz * share, deep)
        vectors = torch.cat([flat * share[:, None], depth[:, None]], -1)
        vectors = torch.where(self.rigid[:, None], vectors, torch.cat([flat, dz[:, None]], -1))
        points = self.tree @ vectors
        shift = torch.cat([_middle(image - points[:, :2], weights), -points[:, 2].mean(0, keepdim=True)])
        return (points + shift) / shape.factor

    def deviation(self, dz: Tensor, shape: Shape, doubt: Tensor, age: Tensor, stray: Tensor, off: Tensor) -> Tensor:
        """Standard deviation of the joints' depths (N,), in the tracks' units; infinite while no bone has a length.

        Args:
            dz: (B,) depths of the bones, in the template's units.
            shape: what is known of the body.
            doubt: (B,) probability that a bone's depth has the other sign.
            age: (N,) frames since each joint was seen.
            stray: (N,) how far depths usually were from what solves found later, in the template's units.
            off: (N,) how far each joint is from its image, in the tracks' units.
        """
        length = shape.lengths
        known = length > 0  # of a body without a template bones that have not been seen have no length
        if not bool(known.any()):
            return torch.full_like(age, torch.inf)
        if shape.deviation is None:
            length = torch.where(known, length, length[known].mean())
            wrong = length * USUAL / (dz.abs() / length).clamp_min(FLAT)
            variance = self.squares @ wrong.square()
        else:
            variance = shape.deviation.square()
        variance = variance + stray.square() + self.squares @ (doubt * (2 * dz).square())
        variance = variance + (age * (DRIFT / self.fps)).clamp_max(FARTHEST).square()
        return (variance.sqrt() / shape.factor).hypot(off)


def _middle(off: Tensor, weights: Tensor) -> Tensor:
    """Mean (D,) of the joints' offsets (N, D), those far from their median counting less; of all, if none is seen."""
    weights = weights if bool((weights > 0).any()) else torch.ones_like(weights)
    middle = median(off[weights > 0], 0)
    far = (off - middle).norm(dim=-1)
    usual = median(far[weights > 0], 0)
    if not bool(usual > 0):
        return middle
    share = weights / (1 + (far / (APART * usual)).square()).square()
    return share @ off / share.sum()
