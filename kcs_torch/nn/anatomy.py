"""Energies of what the skeleton knows about a body's joints."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path

import torch
from torch import Tensor

from kcs_torch.errors import OptionError, ShapeError
from kcs_torch.functional.guarded import or_one, unit_size
from kcs_torch.functional.precision import narrow, wide
from kcs_torch.functional.weights import known
from kcs_torch.nn.checks import check_lengths
from kcs_torch.nn.layers import SkeletonModule
from kcs_torch.nn.masks import known_points, weighs_joints
from kcs_torch.skeleton import Skeleton
from kcs_torch.types.hints import is_a

__all__ = ["AdductionEnergy", "HingeEnergy"]


class _JointEnergy(SkeletonModule):
    """1/2 sum_h f_h wrong_h^2 of each frame, of joints whose bones are seen against an axis across the body.

    Lengths are the clip's, not each frame's, so that energy and gradient are smooth where a bone shrinks to nothing in
    a frame.
    """

    joints: Tensor  # (H, K): those of a chain outwards, then the left and the right end of the axis
    limbs: Tensor  # (H, K - 3): the bones of the chain
    firm: Tensor  # (H,)

    def _take(
        self, joints: Sequence[tuple[int, ...]], limbs: Sequence[list[int]], firm: list[float], size: int
    ) -> None:
        self.register_buffer("joints", torch.tensor(joints, dtype=torch.long).reshape(-1, size), persistent=False)
        self.register_buffer("limbs", torch.tensor(limbs, dtype=torch.long).reshape(-1, size - 3), persistent=False)
        self.register_buffer("firm", torch.tensor(firm), persistent=False)

    def _wrong(self, points: Tensor, lengths: Tensor | None, weights: Tensor | None) -> Tensor:
        """How far each joint is where it should not be, (..., T, H)."""
        raise NotImplementedError

    def forward(self, points: Tensor, lengths: Tensor | None = None, weights: Tensor | None = None) -> Tensor:
        """Return the energy of each frame.

        Args:
            points: (..., T, N, 3).
            lengths: (..., B) of the bones; None takes each bone's root mean square over the T frames, as is always done
                for the axes.
            weights: (..., T, N) of the joints: each term weighs as much as the least joint that defines it; or (..., T)
                of the frames: 0 for one that pads a shorter clip; all 1 if None.

        Returns:
            (..., T), without unit.

        Raises:
            ShapeError: the shapes do not fit.
        """
        wrong = self._wrong(points, lengths, weights)
        each = 0.5 * self.firm.to(wrong.dtype) * wrong.square()
        if weights is not None:
            each = each * self._share(points, weights)
        return narrow(each.sum(-1), points)

    def _vectors(self, points: Tensor, lengths: Tensor | None, weights: Tensor | None) -> tuple[Tensor, ...]:
        """Bones of the chains and then the axes, each (..., T, H, 3) over its length; arguments as in forward.

        They are 0 where nothing counts: a bone to a joint that is not known may be of any length.
        """
        self.check(points, clip=True)
        if points.shape[-1] != 3:
            raise ShapeError(f"{type(self).__name__}: expected points (..., T, N, 3), got {tuple(points.shape)}")
        check_lengths(lengths, points, self)
        share = None if weights is None else self._share(points, weights)
        full = wide(known_points(points, weights, self))
        ends = full.index_select(-2, self.joints.mT.reshape(-1)).unflatten(-2, self.joints.mT.shape)
        *chain, left, right = ends.unbind(-3)  # each (..., T, H, 3)
        edges = [known(b - a, share) for a, b in pairwise(chain)]
        if lengths is None:
            edges = [_to_size(edge, share) for edge in edges]
        else:
            sizes = lengths.to(full.dtype)[..., None, self.limbs, None].unbind(-2)  # each (..., 1, H, 1)
            edges = [edge / torch.where(size > 0, size, torch.inf) for edge, size in zip(edges, sizes, strict=True)]
        return *edges, _to_size(known(left - right, share), share)

    def _share(self, points: Tensor, weights: Tensor) -> Tensor:
        """Weights of the joints' terms, (..., T, H), or of all alike, (..., T, 1)."""
        if weighs_joints(weights, points, self):
            return weights[..., self.joints].amin(-1).clamp_min(0)
        return weights[..., None].clamp_min(0)


class HingeEnergy(_JointEnergy):
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

    sign: Tensor

    def __init__(self, skeleton: str | Path | Skeleton) -> None:
        super().__init__(skeleton)
        hinges, where = self.skeleton.hinges, _bone_places(self.skeleton)
        joints = [(h.parent, h.joint, h.child, h.left, h.right) for h in hinges]
        self._take(joints, [[where[frozenset(bone)] for bone in h.bones] for h in hinges], [h.firm for h in hinges], 5)
        self.register_buffer("sign", torch.tensor([h.sign for h in hinges]), persistent=False)

    def _wrong(self, points: Tensor, lengths: Tensor | None, weights: Tensor | None) -> Tensor:
        return (-self._sines(points, lengths, weights)).clamp_min(0)

    def bend(self, points: Tensor, lengths: Tensor | None = None) -> Tensor:
        """The sine s of each hinge, (..., T, H), positive where it bends its way; arguments as in :meth:`forward`."""
        return narrow(self._sines(points, lengths, None), points)

    def _sines(self, points: Tensor, lengths: Tensor | None, weights: Tensor | None) -> Tensor:
        upper, lower, axis = self._vectors(points, lengths, weights)
        return self.sign.to(axis.dtype) * _triple(upper, lower, axis)


class AdductionEnergy(_JointEnergy):
    """1/2 sum_l max(0, -s_l - limit)^2 of each frame: no upper arm or thigh reaches far across the body.

    s_l = side_l (u . a) / (|u| |a|), where u is the bone from the shoulder or hip outwards, a is the axis from the
    right one to the left, and side_l is +1 on the left and -1 on the right: the sine of the abduction. An arm goes up
    to 90 degrees and more to its own side, but to the other only as far as the trunk lets it. Lengths are the clip's.

    Args:
        skeleton: a :class:`Skeleton`, a built-in name or a file. Limbs are those from one of two twins, hips or
            shoulders, to a hinge whose axis joins both; without any the energy is 0.
        limit: sine of the adduction from which on it costs.

    Raises:
        OptionError: the limit is not within 0 to 1.

    >>> energy = AdductionEnergy("h36m17")
    >>> energy(torch.randn(4, 30, 17, 3)).shape
    torch.Size([4, 30])
    """

    side: Tensor

    def __init__(self, skeleton: str | Path | Skeleton, *, limit: float = 0.35) -> None:
        super().__init__(skeleton)
        if not (is_a(limit, float) and 0 <= limit <= 1):
            raise OptionError(f"AdductionEnergy: limit: expected a sine within 0..1, got {limit!r}")
        self.limit = limit
        where = _bone_places(self.skeleton)
        twins = {frozenset(pair) for pair in self.skeleton.mirror}
        limbs = {  # each once, however many hinges are at its end
            (h.parent, h.joint, h.left, h.right): where[frozenset(h.bones[0])]
            for h in self.skeleton.hinges
            if h.parent in (h.left, h.right) and frozenset((h.left, h.right)) in twins
        }
        self._take(list(limbs), [[bone] for bone in limbs.values()], [1.0] * len(limbs), 4)
        side = [1.0 if parent == left else -1.0 for parent, _, left, _ in limbs]
        self.register_buffer("side", torch.tensor(side), persistent=False)

    def _wrong(self, points: Tensor, lengths: Tensor | None, weights: Tensor | None) -> Tensor:
        return (-self.limit - self._sines(points, lengths, weights)).clamp_min(0)

    def abduction(self, points: Tensor, lengths: Tensor | None = None, weights: Tensor | None = None) -> Tensor:
        """The sine s of each limb, (..., T, L), positive to its own side; arguments as in :meth:`forward`."""
        return narrow(self._sines(points, lengths, weights), points)

    def _sines(self, points: Tensor, lengths: Tensor | None, weights: Tensor | None) -> Tensor:
        upper, axis = self._vectors(points, lengths, weights)
        return self.side.to(axis.dtype) * (upper * axis).sum(-1)


def _bone_places(skeleton: Skeleton) -> dict[frozenset[int], int]:
    """The index of the bone between two joints."""
    return {frozenset(bone): i for i, bone in enumerate(skeleton.bones)}


def _triple(a: Tensor, b: Tensor, c: Tensor) -> Tensor:
    """(a x b) . c of vectors (..., 3)."""
    return (torch.linalg.cross(a, b) * c).sum(-1)


def _to_size(vectors: Tensor, weights: Tensor | None) -> Tensor:
    """Vectors (..., T, H, 3) over their root mean square length in the clip; 0 where they all are.

    Weights are (..., T, H) or (..., T, 1).
    """
    vectors = unit_size(vectors.transpose(-3, -2), 2).transpose(-3, -2)  # of each joint by itself
    square = vectors.square().sum(-1, keepdim=True)
    if weights is None:
        square = square.mean(-3, keepdim=True)
    else:
        share = weights.to(square)[..., None]
        square = (share * square).sum(-3, keepdim=True) / or_one(share.sum(-3, keepdim=True))
    return vectors / or_one(square).sqrt()
