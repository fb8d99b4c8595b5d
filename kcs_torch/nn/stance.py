"""How a body stands on its feet."""

from __future__ import annotations

from numbers import Real
from pathlib import Path

import torch
from torch import Tensor

from kcs_torch.errors import ShapeError
from kcs_torch.functional.chain import bone_vectors, chain_inverse, incidence
from kcs_torch.functional.guarded import or_one
from kcs_torch.functional.precision import full_precision, narrow, wide
from kcs_torch.nn.checks import check_beside, check_one, check_positive
from kcs_torch.nn.layers import SkeletonModule
from kcs_torch.nn.lengths import usual_size
from kcs_torch.nn.masks import bone_share, known_points, weighs_joints
from kcs_torch.nn.posture import PostureEnergy
from kcs_torch.skeleton import Skeleton

__all__ = ["StanceEnergy"]


class StanceEnergy(SkeletonModule):
    """1/2 log(1 + mean_t q_t / sway^2) of a clip: the feet are beneath the trunk, or in front of it, as a rule.

    Where the middle of the feet lies, seen from the trunk, strays from the template by (a, b), over its distance there:
    a to the side and b to the back. Then

        q = max(0, b)^2 + fold^2 log(1 + (a^2 + min(0, b)^2) / fold^2),

    as whoever walks keeps the balance, many bend forward, sit or raise a leg, and hardly anybody bends backward. How
    far a body strays is for the clip to say: the energy is that of a Gaussian of unknown variance. Of a body that is
    seen from the front, hardly anything else tells how far its trunk leans.

    Args:
        skeleton: with a template, spreads and a trunk; without contacts the energy is 0.
        sway: by how much the feet of a walking person stray.
        fold: how far in front or to the side they are where straying further costs hardly more.

    Raises:
        SkeletonError: the skeleton has no template, no spreads or no trunk.
        OptionError: sway or fold is not positive.

    >>> energy = StanceEnergy("h36m17")
    >>> energy(torch.randn(4, 30, 17, 3)).shape
    torch.Size([4])
    """

    line: Tensor  # (B,) that makes of bones the way from the trunk's middle to that of the feet, 1 in the template
    usual: Tensor  # (2,) where the template has them, to the side and to the back
    joints: Tensor  # of the trunk and the feet

    def __init__(self, skeleton: str | Path | Skeleton, *, sway: float = 0.06, fold: float = 0.15) -> None:
        super().__init__(skeleton)
        check_positive(self, sway=sway)
        check_positive(self, finite=True, fold=fold)
        self.sway, self.fold = sway, fold
        self.posture = PostureEnergy(self.skeleton)
        feet, body = list(self.skeleton.contacts), self.skeleton
        line, usual = torch.zeros(body.num_bones, dtype=torch.float64), torch.zeros(3, dtype=torch.float64)
        if feet:
            tree = chain_inverse(incidence(body.bone_index(), body.num_joints, dtype=torch.float64))
            line = tree[feet].mean(0) - tree[self.posture.trunk].mean(0)
            usual = line @ (self.posture.mean * self.posture.rest_lengths[:, None])
            if not float(usual.norm()) > 0:
                feet, line = [], torch.zeros_like(line)
        self.feet = feet
        self.register_buffer("joints", torch.cat([self.posture.trunk, torch.tensor(feet).long()]), persistent=False)
        far = usual.norm() if feet else 1.0
        self.register_buffer("line", line / far, persistent=False)
        self.register_buffer("usual", usual[::2] / far, persistent=False)

    def forward(self, points: Tensor, size: Tensor | float | None = None, weights: Tensor | None = None) -> Tensor:
        """Return the energy of each clip.

        Args:
            points: (..., T, N, 3).
            size: (...) of the body, over that of a template about 1.75 tall; None takes it from the bones' root mean
                square lengths in the frames that count.
            weights: (..., T, N) of the joints: a frame counts as much as the least joint of the trunk and the feet; or
                (..., T) of the frames: 0 for one that pads a shorter clip; all 1 if None.

        Returns:
            (...), without unit.

        Raises:
            ShapeError: the shapes do not fit, or the size is neither a number nor a tensor.
        """
        each = self.strayed(points, size, weights)
        if weights is None:
            mean = each.mean(-1) if each.shape[-1] else each.sum(-1)
        else:
            share = self._share(points, weights).to(each).clamp_min(0)
            mean = (share * each).sum(-1) / or_one(share.sum(-1))
        return narrow(torch.log1p(mean / self.sway**2) / 2, points)

    def strayed(self, points: Tensor, size: Tensor | float | None = None, weights: Tensor | None = None) -> Tensor:
        """How far the feet stray, q of each frame, (..., T); arguments as in :meth:`forward`.

        Half precision comes back as single.
        """
        self.check(points, clip=True)
        if points.shape[-1] != 3:
            raise ShapeError(f"StanceEnergy: expected points (..., T, N, 3), got {tuple(points.shape)}")
        if isinstance(size, (int, float, Real)):
            size = torch.tensor(float(size), dtype=torch.float64)
        check_beside(size, "size", (), points, self)
        if size is not None:
            check_one(size, 0, "sizes ()", points, self)
        joints = weights is not None and weighs_joints(weights, points, self)
        with full_precision(points):
            points = wide(known_points(points, weights, self))
            vectors = bone_vectors(points, self.bones)
            if size is None:
                share = None
                if weights is not None:
                    share = bone_share(weights, self.bones) if joints else weights[..., None]
                each = usual_size(vectors, share)
                known = torch.ones_like(each) if share is None else (share > 0).any(-2).to(each)
                size = (known * each).sum(-1) / or_one((known * self.posture.rest_lengths.to(each)).sum(-1))
            size = torch.where(size > 0, size, torch.inf).to(vectors)[..., None, None]
            way = (self.line.to(vectors) @ vectors)[..., None, :] @ self.posture.frame(points)  # (..., T, 1, 3)
            off = way[..., 0, ::2] / size - self.usual.to(vectors)
            back = off[..., 1].clamp_min(0).square()
            return back + self.fold**2 * torch.log1p((off.square().sum(-1) - back) / self.fold**2)

    def _share(self, points: Tensor, weights: Tensor) -> Tensor:
        """What each frame counts, (..., T)."""
        if weighs_joints(weights, points, self):
            return weights[..., self.joints].amin(-1)
        return weights
