"""Energies: one module is the loss of a network and the term of a solver.

Each returns energies per frame (..., T) or per clip (...); the reduction is left to the caller. Weights of 0, or below,
take a joint out, whatever its coordinates are, NaN included, and tracks that are NaN weigh 0; an energy over nothing is
0, not NaN. Half precision is widened inside; what it cannot hold comes back as its largest number.
"""

from __future__ import annotations

import math
from pathlib import Path

import torch
from torch import Tensor, nn

from kcs_torch.errors import OptionError, ShapeError
from kcs_torch.functional.chain import bone_lengths
from kcs_torch.functional.guarded import LOST, largest, or_one, safe_root
from kcs_torch.functional.precision import full_precision, narrow, wide
from kcs_torch.functional.shapes import fit_together
from kcs_torch.functional.spectral import log_det, nuclear_norm, svt
from kcs_torch.functional.weights import known
from kcs_torch.nn.checks import (
    check_clip,
    check_lengths,
    check_tensor,
    check_weights,
    shown,
)
from kcs_torch.nn.layers import SkeletonModule
from kcs_torch.nn.masks import bone_share
from kcs_torch.skeleton import Skeleton
from kcs_torch.solvers.lm import fit_bones
from kcs_torch.types.hints import is_a

__all__ = ["BoneLengthEnergy", "LowRankEnergy", "SmoothnessEnergy", "SymmetryEnergy"]


class BoneLengthEnergy(SkeletonModule):
    """1/2 sum_b w_b (|b| - L_b)^2 of each frame: bones keep their length (SfAM eq. 13).

    Args:
        skeleton: a :class:`Skeleton`, a built-in name or a file. Its flexible bones do not count.

    >>> energy = BoneLengthEnergy("h36m17")
    >>> energy(torch.randn(4, 30, 17, 3)).shape
    torch.Size([4, 30])
    """

    rigid: Tensor

    def __init__(self, skeleton: str | Path | Skeleton) -> None:
        super().__init__(skeleton)
        self.register_buffer("rigid", self.skeleton.rigid_mask(dtype=torch.get_default_dtype()), persistent=False)

    def forward(self, points: Tensor, lengths: Tensor | None = None, weights: Tensor | None = None) -> Tensor:
        """Return the energy of each frame.

        Args:
            points: (..., T, N, 3).
            lengths: (..., B) target lengths; a bone of which it is NaN or negative does not count. None takes each
                bone's own (weighted) mean over the T frames, which makes this half the bone's variance: 0 for clips of
                one frame. A batch of single poses is (..., 1, N, 3) and needs lengths; as (T, N, 3) it would pass for
                one clip of one body.
            weights: (..., T, N) of the joints; a bone weighs as much as the lesser of its two ends.

        Returns:
            (..., T), in squared units.

        Raises:
            ShapeError: the shapes do not fit.
        """
        self.check(points, clip=True)
        check_weights(weights, points, self)
        check_lengths(lengths, points, self)
        size = bone_lengths(known(wide(points), weights), self.bones)  # (..., T, B)
        share = self.rigid.to(size.dtype).expand_as(size)
        if lengths is not None:
            lengths, asked = _targets(lengths)
            share = share * asked
        if weights is not None:
            share = share * bone_share(weights, self.bones)
        if lengths is None:
            lengths = (size * share).sum(-2, keepdim=True) / or_one(share.sum(-2, keepdim=True))
        return narrow(0.5 * (share * (size - lengths).square()).sum(-1), points)

    def prox(self, points: Tensor, lengths: Tensor, stiffness: Tensor | float = 1.5, *, num_steps: int = 3) -> Tensor:
        """argmin_A stiffness * energy(A) + 1/2 |A - points|^2, by :func:`kcs_torch.solvers.fit_bones`.

        Args:
            points: (..., T, N, 3).
            lengths: (..., B), as in :meth:`forward`.
            stiffness: the paper's beta, not negative; a tensor broadcasts against (..., T, B).
            num_steps: Levenberg-Marquardt steps; from 2 on they never raise what is minimised.

        Returns:
            (..., T, N, 3).

        Raises:
            ShapeError: the shapes do not fit.
            OptionError: a number for the stiffness, or ``num_steps``, is negative.
        """
        self.check(points, clip=True)
        check_tensor(lengths, "lengths", self)
        check_lengths(lengths, points, self)
        if not isinstance(stiffness, Tensor) and not stiffness >= 0:
            raise OptionError(f"BoneLengthEnergy: stiffness: expected a number that is not negative, got {stiffness}")
        beta = torch.as_tensor(stiffness, dtype=points.dtype, device=points.device)
        full = (*points.shape[:-2], len(self.bones))
        if beta.ndim > len(full) or not fit_together(beta.shape, full):
            got = tuple(beta.shape)
            raise ShapeError(f"BoneLengthEnergy: stiffness: expected a shape that broadcasts to {full}, got {got}")
        lengths, asked = _targets(lengths.to(points.dtype))
        beta = beta * self.rigid.to(points.dtype)
        with full_precision(points):
            return fit_bones(points, lengths, self.bones, stiffness=beta * asked, num_steps=num_steps)


def _targets(lengths: Tensor) -> tuple[Tensor, Tensor]:
    """Target lengths (..., 1, B) of all frames, 0 where NaN or negative, and which bones (..., 1, B) have one."""
    asked = lengths[..., None, :] >= 0
    return torch.where(asked, lengths[..., None, :], 0), asked


class LowRankEnergy(nn.Module):
    """How far a clip's poses are from few shapes: the nuclear norm of S# (T x 3N), or a log-determinant.

    Args:
        kind: "nuclear" (SfAM, KCS), or "log_det": T/2 log det(Sigma + eps I) of the poses' covariance, a tighter
            surrogate of rank. A clip at rest, but for rounding, has no derivative there.
        eps: of the log-determinant, relative to the mean variance of a coordinate.

    Raises:
        OptionError: the kind is unknown, or eps is not positive.
    """

    def __init__(self, kind: str = "nuclear", *, eps: float = 1e-3) -> None:
        super().__init__()
        if kind not in ("nuclear", "log_det") or not (is_a(eps, float) and 0 < eps < math.inf):
            shown = repr(kind) if isinstance(kind, str) else f"a {type(kind).__name__}"
            raise OptionError(
                f"LowRankEnergy: expected kind 'nuclear' or 'log_det' and finite eps > 0, got {shown} and {eps!r}"
            )
        self.kind, self.eps = kind, eps

    def extra_repr(self) -> str:
        return shown(self, "kind", "eps")

    def forward(self, points: Tensor, weights: Tensor | None = None) -> Tensor:
        """Return the energy of each clip.

        Args:
            points: (..., T, N, D).
            weights: (..., T, N) of the joints. A frame or a joint of weight 0 is out, as if the matrix had no such row
                or columns. A joint that is unseen in some frames is taken for 0 there by the nuclear norm, and for its
                mean over time by the log-determinant, whose covariance divides by what each joint was seen.

        Returns:
            (...): in the unit of the points, or without one.

        Raises:
            ShapeError: the shapes do not fit.
        """
        check_clip(points, self)
        check_weights(weights, points, self)
        matrix = known(points, weights).flatten(-2)
        # (..., T, N D)
        share = None if weights is None else weights.clamp_min(0).repeat_interleave(points.shape[-1], -1)
        with full_precision(points):
            matrix = wide(matrix)
            if self.kind == "log_det":
                return narrow(self._log_det(matrix, share), points)
            return narrow(nuclear_norm(matrix if share is None else matrix * safe_root(share.to(matrix.dtype))), points)

    def _log_det(self, matrix: Tensor, share: Tensor | None) -> Tensor:
        """T/2 log det(Sigma + eps I) of rows (..., T, D); what has no share in any frame adds nothing."""
        if share is None:
            frames: Tensor | int = matrix.shape[-2]
            off = matrix - matrix.sum(-2, keepdim=True) / max(frames, 1)
            centred, counts = off / max(frames, 1) ** 0.5, None
            gone = torch.zeros_like(matrix.sum(-2))
        else:
            share = share.to(matrix.dtype)
            frames, count = share.amax(-1).sum(-1), share.sum(-2, keepdim=True)
            off, counts = matrix - (share * matrix).sum(-2, keepdim=True) / or_one(count), share > 0
            centred = safe_root(share / or_one(count)) * off
            gone = (count <= 0).to(matrix.dtype).squeeze(-2)
        real = (1 - gone).sum(-1)
        still = largest(off, 2, counts) <= LOST * torch.finfo(off.dtype).eps * largest(matrix, 2, counts)
        unit = or_one(largest(centred, 2))  # squares of what is small would underflow
        unit, centred = torch.where(still, 1, unit), torch.where(still, 0, centred / unit)
        covariance = centred.mT @ centred
        level = self.eps * or_one(covariance.diagonal(dim1=-2, dim2=-1).sum(-1) / or_one(real))
        low = log_det(covariance + torch.diag_embed(gone * (1 - level[..., None])), level)
        return frames / 2 * (low + 2 * real * unit[..., 0, 0].log())

    def prox(self, points: Tensor, threshold: Tensor | float) -> Tensor:
        """Singular value shrinkage of S#, the nuclear norm's proximal map: (..., T, N, D)."""
        check_clip(points, self)
        return svt(points.flatten(-2), threshold).unflatten(-1, points.shape[-2:])


class SmoothnessEnergy(nn.Module):
    """1/2 |n-th difference in time|^2 of the joints, per frame; the first n frames have none and give 0.

    Args:
        order: 1 speed, 2 acceleration, 3 jerk.

    Raises:
        OptionError: the order is below 1.
    """

    def __init__(self, order: int = 2) -> None:
        super().__init__()
        if not is_a(order, int) or order < 1:
            shown = order if isinstance(order, (int, float)) else f"a {type(order).__name__}"
            raise OptionError(f"SmoothnessEnergy: expected a whole order >= 1, got {shown}")
        self.order = order

    def extra_repr(self) -> str:
        return shown(self, "order")

    def forward(self, points: Tensor, weights: Tensor | None = None) -> Tensor:
        """Return (..., T) of points (..., T, N, D); a difference weighs as much as the least of its frames."""
        check_clip(points, self)
        check_weights(weights, points, self)
        frames = points.shape[-3]
        if frames <= self.order:
            return (0 * known(points, weights)).sum((-2, -1))
        square = known(wide(points), weights).diff(n=self.order, dim=-3).square().sum(-1)  # (..., T - n, N)
        if weights is not None:
            square = square * weights.unfold(-2, self.order + 1, 1).amin(-1).clamp_min(0)
        return narrow(nn.functional.pad(0.5 * square.sum(-1), (self.order, 0)), points)


class SymmetryEnergy(SkeletonModule):
    """1/2 sum over mirror bones of w (|left| - |right|)^2, per frame.

    Raises:
        SkeletonError: see :class:`Skeleton`; a skeleton without mirror pairs gives 0.
    """

    pairs: Tensor

    def __init__(self, skeleton: str | Path | Skeleton) -> None:
        super().__init__(skeleton)
        pairs = torch.tensor(self.skeleton.mirror_bones, dtype=torch.long).reshape(-1, 2)
        self.register_buffer("pairs", pairs, persistent=False)

    def forward(self, points: Tensor, weights: Tensor | None = None) -> Tensor:
        """Return (..., T) of points (..., T, N, 3) and weights (..., T, N): twins weigh as the least of their ends."""
        self.check(points, clip=True)
        check_weights(weights, points, self)
        size = bone_lengths(known(wide(points), weights), self.bones)
        square = (size[..., self.pairs[:, 0]] - size[..., self.pairs[:, 1]]).square()
        if weights is not None:
            share = bone_share(weights, self.bones)
            square = square * torch.minimum(share[..., self.pairs[:, 0]], share[..., self.pairs[:, 1]])
        return narrow(0.5 * square.sum(-1), points)
