"""How long bones usually are: beside their images, and beside each other."""

from __future__ import annotations

import math
from pathlib import Path

import torch
from torch import Tensor

from kcs_torch.errors import OptionError, ShapeError, SkeletonError
from kcs_torch.functional.chain import bone_vectors
from kcs_torch.functional.guarded import largest, or_one, safe_root
from kcs_torch.functional.precision import narrow, wide
from kcs_torch.functional.ranks import median
from kcs_torch.functional.shapes import fit_together
from kcs_torch.functional.weights import known
from kcs_torch.nn.checks import check_beside, check_lengths, check_points, check_positive, check_tensor, check_weights
from kcs_torch.nn.layers import SkeletonModule
from kcs_torch.nn.masks import bone_share
from kcs_torch.skeleton import Skeleton

__all__ = [
    "LEAST",
    "ForeshorteningEnergy",
    "ProportionEnergy",
    "foreshortening",
    "free_bones",
    "oddities",
    "oddity",
    "usual_size",
]

LIMB_SPREAD = 26.0
"""Bones that stray from the template by more than this, in degrees, are of the limbs."""

LEAST = 0.01
"""Length of a bone whose joints coincide, over the root mean square of all bones': what is divided by it has bounds."""

HIDDEN = 2 * math.pi / (math.gamma(1.25) ** 2 * math.sqrt(8))
"""How large squared depths have to be to be told from 0, over noise of the image times length: 2.7. Where a bone of
length L looks as long as it is, noise n makes of 1 / |dz| the density Gamma(5/4) 8^(1/4) / sqrt(2 pi L n)."""


class ForeshorteningEnergy(SkeletonModule):
    """sum_tb w_b/tau [log L_b + 1/2 log(dz_tb^2 + (eps L_b)^2)]: bones point anywhere, and are as often seen long.

    A direction drawn evenly from the sphere has an image of density 1 / (L |dz|): a bone that is longer than any of its
    images would have to avoid the image plane all the time. This keeps lengths down where smoothness, which prefers
    long bones that hardly turn, would let them grow. In an image with noise n, sqrt(dz^4 + (2.7 n L)^2) takes the place
    of dz^2: a smaller depth cannot be told from 0, and noise would make bones short if it counted.

    Args:
        skeleton: bones of its trunk, where it has one, do not count.
        correlation: tau, frames that tell as much as one independent frame.
        eps: share of the length below which depths are not told apart.

    Raises:
        OptionError: a number is not positive.
    """

    free: Tensor

    def __init__(self, skeleton: str | Path | Skeleton, *, correlation: float = 10.0, eps: float = 0.1) -> None:
        super().__init__(skeleton)
        check_positive(self, correlation=correlation)
        check_positive(self, finite=True, eps=eps)
        self.correlation, self.eps = correlation, eps
        self.register_buffer("free", free_bones(self.skeleton), persistent=False)

    def forward(
        self,
        points: Tensor,
        lengths: Tensor | None = None,
        weights: Tensor | None = None,
        *,
        bone_weights: Tensor | None = None,
        bone_noise: Tensor | None = None,
    ) -> Tensor:
        """Return the energy of each clip.

        Args:
            points: (..., T, N, 3).
            lengths: (..., B); None takes each bone's root mean square over the frames in which it counts, and
                a hundredth of all bones', so that none is 0.
            weights: (..., T, N) of the joints: a bone weighs as much as the lesser of its two ends.
            bone_weights: (..., T, B) in place of ``weights``.
            bone_noise: (..., T, B) standard deviation of the bones' lengths in the image, in the points' unit; anything
                where the bone's weight is 0.

        Returns:
            (...).

        Raises:
            ShapeError: the shapes do not fit.
            OptionError: weights and bone_weights are both given.
        """
        self.check(points, clip=True)
        if weights is not None and bone_weights is not None:
            raise OptionError("ForeshorteningEnergy: expected weights or bone_weights, got both")
        if points.shape[-1] != 3:
            raise ShapeError(f"ForeshorteningEnergy: expected points (..., T, N, 3), got {tuple(points.shape)}")
        check_weights(weights, points, self)
        check_lengths(lengths, points, self)
        bones = (points.shape[-3], len(self.bones))
        check_beside(bone_weights, "bone_weights", bones, points, self)
        check_beside(bone_noise, "bone_noise", bones, points, self)
        if weights is not None:
            bone_weights = bone_share(weights, self.bones)
        if bone_weights is not None:
            bone_weights = bone_weights.clamp_min(0)
            if bone_noise is not None:
                bone_noise = known(bone_noise[..., None], bone_weights)[..., 0]
        vectors = known(bone_vectors(wide(points), self.bones), bone_weights)
        if lengths is None:
            lengths = usual_size(vectors, bone_weights, LEAST)
            lengths = lengths.clamp_min(torch.finfo(lengths.dtype).tiny ** 0.5)
        each = self.each(vectors[..., 2], wide(lengths), bone_weights, bone_noise)
        return narrow(each.sum((-2, -1)), points)

    def each(
        self, depth: Tensor, lengths: Tensor, bone_weights: Tensor | None = None, bone_noise: Tensor | None = None
    ) -> Tensor:
        """What each bone adds in each frame, (..., T, B), of depths (..., T, B) and lengths (..., B)."""
        each = self.free.to(depth) * foreshortening(depth, lengths[..., None, :], self.eps, bone_noise)
        return (each if bone_weights is None else each * bone_weights) / self.correlation


class ProportionEnergy(SkeletonModule):
    """How unusual bone lengths are: sum_b log(1 + (l_b/s)^2/2) + max(0, l_b/r)^2/2 + sum_twins (l_b - l_twin)^2/2p^2.

    l_b is the log of a length over the skeleton's, less the mean over bones: the size of the body does not count. The
    heavy tail is for joints that a data set defines in its own way. It ends where bones are far too long, which depth
    alone can make them: in a long bone that points at the camera noise leaves no trace.

    Args:
        skeleton: with a template or proportions.
        spread: s, usual deviation of a length, as a share.
        twins: p, usual difference of left and right, as a share.
        excess: r, the same of lengths that are too long to be another definition of a joint.

    Raises:
        SkeletonError: the skeleton knows no lengths.
        OptionError: a number is not positive.
    """

    usual: Tensor
    pairs: Tensor

    def __init__(
        self, skeleton: str | Path | Skeleton, *, spread: float = 0.08, twins: float = 0.03, excess: float = 0.45
    ) -> None:
        super().__init__(skeleton)
        usual = self.skeleton.relative_lengths(dtype=torch.float64)
        if usual is None:
            raise SkeletonError(f"skeleton '{self.skeleton.name}' has neither proportions nor a template")
        check_positive(self, spread=spread, twins=twins, excess=excess)
        self.spread, self.twins, self.excess = spread, twins, excess
        self.register_buffer("usual", usual, persistent=False)
        pairs = torch.tensor(self.skeleton.mirror_bones, dtype=torch.long).reshape(-1, 2)
        self.register_buffer("pairs", pairs, persistent=False)

    def forward(self, lengths: Tensor, weights: Tensor | None = None) -> Tensor:
        """Return (...) of lengths (..., B), positive, in any unit; weights (..., B), 0 for bones that are not known."""
        count = len(self.usual)
        check_points(lengths, self, "lengths")
        if lengths.shape[-1:] != (count,):
            raise ShapeError(f"ProportionEnergy: expected lengths (..., {count}), got {tuple(lengths.shape)}")
        if weights is not None:
            check_tensor(weights, "weights", self)
            if weights.shape[-1:] != (count,) or not fit_together(weights.shape, lengths.shape):
                got = f"got {tuple(weights.shape)} for lengths {tuple(lengths.shape)}"
                raise ShapeError(f"ProportionEnergy: expected weights (..., {count}), {got}")
        return narrow(self._energy(wide(lengths), weights), lengths)

    def _energy(self, lengths: Tensor, weights: Tensor | None) -> Tensor:
        tiny = torch.finfo(lengths.dtype).tiny
        if weights is not None:
            weights = weights.clamp_min(0)
            lengths = torch.where(weights > 0, lengths, self.usual.to(lengths))
        log = (lengths.clamp_min(tiny) / self.usual.to(lengths).clamp_min(tiny)).log()
        apart = ((log[..., self.pairs[:, 0]] - log[..., self.pairs[:, 1]]) / self.twins).square()
        if weights is None:
            off = log - log.mean(-1, keepdim=True)
            return self._unusual(off).sum(-1) + apart.sum(-1) / 2
        off = log - (weights * log).sum(-1, keepdim=True) / or_one(weights.sum(-1, keepdim=True))
        both = torch.minimum(weights[..., self.pairs[:, 0]], weights[..., self.pairs[:, 1]])
        return (weights * self._unusual(off)).sum(-1) + (both * apart).sum(-1) / 2

    def _unusual(self, off: Tensor) -> Tensor:
        return torch.log1p((off / self.spread).square() / 2) + (off / self.excess).clamp_min(0).square() / 2


def foreshortening(depth: Tensor, length: Tensor, eps: float, noise: Tensor | None = None) -> Tensor:
    """Log L + 1/2 log(dz^2 + (eps L)^2), elementwise: -log density of an image of an evenly drawn direction.

    With noise n of the image, sqrt(dz^4 + (2.7 n L)^2) takes the place of dz^2.
    """
    tiny = torch.finfo(depth.dtype).tiny
    size = torch.maximum(depth.abs(), length).detach()
    unit = torch.where(size > tiny**0.5, size, 1)  # in which no square overflows
    square, own = (depth / unit).square(), length / unit
    if noise is not None:
        square = torch.hypot(square, (HIDDEN * (noise / unit) * own).clamp_min(tiny**0.5))
    return length.clamp_min(tiny).log() + unit.log() + 0.5 * (square + (eps * own).square()).clamp_min(tiny).log()


def free_bones(skeleton: Skeleton) -> Tensor:
    """1 for bones of the limbs, which point anywhere, 0 for those of trunk and head, (B,)."""
    if skeleton.spread is None:
        return torch.ones(skeleton.num_bones)
    return torch.tensor([float(s > LIMB_SPREAD) for s in skeleton.spread])


def usual_size(vectors: Tensor, share: Tensor | None, least: float = 0.0) -> Tensor:
    """Root mean square length (..., B) of bones (..., T, B, D) over frames in which they have a share (..., T, B or 1).

    Nothing is shorter than ``least`` times the root mean square over the bones; 0 where all are.
    """
    unit = or_one(largest(vectors, 3))  # no square of a large clip overflows
    square = (vectors / unit).square().sum(-1)
    if share is None:
        square = square.sum(-2) / max(square.shape[-2], 1)
    else:
        seen = (share > 0).to(square)
        square = (square * seen).sum(-2) / seen.sum(-2).clamp_min(1)
    return safe_root(square + least**2 * square.mean(-1, keepdim=True)) * unit[..., 0, 0]


def oddity(lengths: Tensor, usual: Tensor) -> float:
    """How far lengths (B,) stray from usual ones (B,), whatever the size: root mean square of the ratio's logarithm.

    0 where no usual length is known, which is then 0.
    """
    return float(oddities(lengths, usual))


def oddities(lengths: Tensor, usual: Tensor) -> Tensor:
    """:func:`oddity` of each body, (...), of lengths (..., B)."""
    known = usual > 0
    log = (lengths[..., known].clamp_min(torch.finfo(lengths.dtype).tiny) / usual[known]).log()
    if not log.shape[-1]:
        return lengths.new_zeros(lengths.shape[:-1])
    return (log - median(log, -1, keepdim=True)).square().mean(-1).sqrt()
