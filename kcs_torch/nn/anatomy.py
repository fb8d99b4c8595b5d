"""Energies of what the skeleton knows about a body's joints."""

from __future__ import annotations

from pathlib import Path

import torch
from torch import Tensor

from kcs_torch.errors import ShapeError
from kcs_torch.nn.energies import check_lengths
from kcs_torch.nn.layers import SkeletonModule, wide
from kcs_torch.nn.masks import known_points, weighs_joints
from kcs_torch.skeleton import Skeleton

__all__ = ["HingeEnergy"]


class HingeEnergy(SkeletonModule):
    """1/2 sum_h f_h max(0, -s_h)^2 of each frame: no joint bends the wrong way.

    s_h = sign_h (u x v) . a / (|u| |v| |a|), where u and v are the bones above and below hinge h and a is its axis from
    right to left: the sine of the bend where the axis is square to both. f_h is how firm the hinge is. The lengths are
    the clip's, not each frame's, so that energy and gradient are smooth where a bone shrinks to nothing in a frame.

    Args:
        skeleton: a :class:`Skeleton`, a built-in name or a file; without hinges the energy is 0.

    >>> energy = HingeEnergy("h36m17")
    >>> energy(torch.randn(4, 30, 17, 3)).shape
    torch.Size([4, 30])
    """

    joints: Tensor
    limbs: Tensor
    sign: Tensor
    firm: Tensor

    def __init__(self, skeleton: str | Path | Skeleton) -> None:
        super().__init__(skeleton)
        hinges = self.skeleton.hinges
        where = {frozenset(bone): i for i, bone in enumerate(self.skeleton.bones)}
        joints = [(h.parent, h.joint, h.child, h.left, h.right) for h in hinges]
        limbs = [[where[frozenset(bone)] for bone in h.bones] for h in hinges]
        self.register_buffer("joints", torch.tensor(joints, dtype=torch.long).reshape(-1, 5), persistent=False)
        self.register_buffer("limbs", torch.tensor(limbs, dtype=torch.long).reshape(-1, 2), persistent=False)
        self.register_buffer("sign", torch.tensor([h.sign for h in hinges]), persistent=False)
        self.register_buffer("firm", torch.tensor([h.firm for h in hinges]), persistent=False)

    def forward(self, points: Tensor, lengths: Tensor | None = None, weights: Tensor | None = None) -> Tensor:
        """Return the energy of each frame.

        Args:
            points: (..., T, N, 3).
            lengths: (..., B) of the bones; None takes each bone's root mean square over the T frames, as is always done
                for the axes.
            weights: (..., T, N) of the joints: a hinge weighs as much as the least of the five that define it; or
                (..., T) of the frames: 0 for one that pads a shorter clip; all 1 if None.

        Returns:
            (..., T), without unit.

        Raises:
            ShapeError: the shapes do not fit.
        """
        wrong = (-self.bend(points, lengths, weights)).clamp_min(0)
        each = 0.5 * self.firm.to(wrong.dtype) * wrong.square()
        if weights is not None:
            each = each * self._share(points, weights)
        return each.sum(-1)

    def bend(self, points: Tensor, lengths: Tensor | None = None, weights: Tensor | None = None) -> Tensor:
        """The sine s of each hinge, (..., T, H), positive where it bends its way; arguments as in :meth:`forward`."""
        self.check(points, clip=True)
        if points.shape[-1] != 3:
            raise ShapeError(f"HingeEnergy: expected points (..., T, N, 3), got {tuple(points.shape)}")
        check_lengths(lengths, points, self)
        share = None if weights is None else self._share(points, weights)
        full = wide(known_points(points, weights, self))
        ends = full.index_select(-2, self.joints.mT.reshape(-1)).unflatten(-2, (5, len(self.joints)))
        parent, joint, child, left, right = ends.unbind(-3)  # each (..., T, H, 3)
        upper, lower, axis = joint - parent, child - joint, left - right
        if lengths is None:
            upper, lower = _to_size(upper, share), _to_size(lower, share)
        else:
            above, below = lengths.to(full.dtype)[..., None, self.limbs].unbind(-1)  # each (..., 1, H)
            upper, lower = _divide(upper, above[..., None]), _divide(lower, below[..., None])
        return (self.sign.to(full.dtype) * _triple(upper, lower, _to_size(axis, share))).to(points.dtype)

    def _share(self, points: Tensor, weights: Tensor) -> Tensor:
        """Weights of the hinges, (..., T, H), or of all alike, (..., T, 1)."""
        if weighs_joints(weights, points, self):
            return weights[..., self.joints].amin(-1)
        return weights[..., None]


def _triple(a: Tensor, b: Tensor, c: Tensor) -> Tensor:
    """(a x b) . c of vectors (..., 3)."""
    return (torch.linalg.cross(a, b) * c).sum(-1)


def _to_size(vectors: Tensor, weights: Tensor | None) -> Tensor:
    """Vectors (..., T, H, 3) over their root mean square length in the clip; 0 where they all are.

    Weights are (..., T, H) or (..., T, 1).
    """
    square = vectors.square().sum(-1, keepdim=True)
    if weights is None:
        square = square.mean(-3, keepdim=True)
    else:
        share = weights.to(square)[..., None]
        square = (share * square).sum(-3, keepdim=True) / share.sum(-3, keepdim=True).clamp_min(1e-9)
    return _divide(vectors, torch.where(square > 0, square, torch.ones_like(square)).sqrt())


def _divide(vectors: Tensor, lengths: Tensor) -> Tensor:
    """Vectors over lengths; 0 where a length is."""
    known = lengths > 0
    return vectors * torch.where(known, 1 / torch.where(known, lengths, torch.ones_like(lengths)), 0)
