"""The coordinates in which PKC's objective is minimised."""

from __future__ import annotations

from copy import copy

import torch
from torch import Tensor

from kcs_torch.functional.chain import bone_vectors
from kcs_torch.methods.pkc.objective import Objective
from kcs_torch.methods.pkc.weights import HEAVY, wide

__all__ = ["Unknowns"]


class Unknowns:
    """Depths and lengths about a start, in coordinates in which the objective is nearly a sphere.

    A length is known so well that it can hardly move on its own: dz (dL/dz) = L dL moves a bone's depths with it. What
    is then left for the depths is scaled by the curvature of the length, smoothness and posture terms.

    Args:
        objective: that is minimised.
        depth: (H, T, N).
        lengths: (H, B).
    """

    def __init__(self, objective: Objective, depth: Tensor, lengths: Tensor) -> None:
        w, posture = objective.weights, objective.posture
        early = lambda values: values.mT.contiguous()  # noqa: E731
        self.objective, self.lengths = objective, lengths
        self.dz = early(bone_vectors(depth[..., None], objective.bones)[..., 0])
        size = lengths[..., None]
        off = (early(objective.flat) + self.dz.square() - size.square()) / (2 * size)
        precision = early(objective.precision(lengths))
        each = precision * off.square()
        spread = objective._mean(HEAVY * torch.log1p(each / HEAVY).mT)[..., None]
        pull = precision / (1 + spread.clamp_max(1))
        spread = posture.deviation.square().mean(-1).reshape(-1, size.shape[1], 1)
        shape = wide(w.posture, 2) * (spread * size.square()).clamp_min(1e-3)
        curve = pull * (self.dz / size).square() + 6 / wide(w.acceleration, 2) ** 2 + 5 / shape  # (H, B, T)
        self.shear = size.square() * self.dz / (self.dz.square() + (0.5 * size).square())
        left = size - self.dz * self.shear / size
        bend = self.shear.diff(n=2).square()
        if objective.time is not None:
            bend = bend * objective.time[:, None, 2:]
        bend = bend.sum(-1) / wide(w.acceleration, 1) ** 2
        along = (pull * left.square()).sum(-1) + 1 / wide(w.proportions, 1) ** 2 + bend  # (H, B)
        self.scale = torch.cat([curve.flatten(1), along], 1).rsqrt()

    def __call__(self, state: Tensor) -> tuple[Tensor, Tensor]:
        """Depths (H, T, N), centred, virtual joints among them, and lengths (H, B), of unknowns (H, B T + B)."""
        _, bones, frames = self.dz.shape
        part, grown = (state * self.scale).split([bones * frames, bones], 1)
        dz = self.dz + part.unflatten(1, (bones, frames)) + self.shear * grown[..., None]
        return self.objective.joints(dz.mT), self.lengths * grown.exp()

    def rows(self, index: Tensor) -> Unknowns:
        """Those of some hypotheses."""
        out = copy(self)
        out.objective = self.objective.rows(index)
        for name in ("lengths", "dz", "shear", "scale"):
            setattr(out, name, getattr(self, name)[index])
        return out
