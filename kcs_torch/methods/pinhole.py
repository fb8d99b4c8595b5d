"""The energy of a body seen through a pinhole: :class:`PinholeEnergy`."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from kcs_torch.functional.chain import bone_lengths, bone_vectors
from kcs_torch.methods.size import slow_waves
from kcs_torch.nn.anatomy import AdductionEnergy, HingeEnergy
from kcs_torch.nn.lengths import ForeshorteningEnergy, ProportionEnergy
from kcs_torch.nn.posture import PostureEnergy, trunk_joints
from kcs_torch.skeleton import Skeleton

__all__ = ["NEAREST", "PinholeEnergy"]

NEAREST = 0.15
"""Joints are kept at least this share of the body's distance before the camera."""

LENGTH, ACCELERATION = 0.003, 0.05
"""Standard deviations of a bone's length and of the second difference of its depth at 30 frames a second."""

HINGE, ADDUCTION, SINE = 0.08, 0.03, 0.05
"""Weights of a hinge, and of an arm or a leg that reaches across the body, in a frame at 30 frames a second; and the
sine of a wrong bend, or beyond the limit, that costs half of them."""

POSTURE, FORESHORTENING = 6.0, 10.0
"""Frames that count as one for these energies at 30 frames a second."""

SPEED = 3.0
"""Usual speed towards the camera a second, for a body of 1.75."""

STRAY = 0.1
"""Usual deviation of a slow change of distance from what is given, as a share."""

HEAVY = 4.0
"""Squared deviations of a length from here on count like an outlier's, in variances."""

CLOSE = 0.3
"""Usual deviation of a bone's depth from the method's, for bodies without a template."""


class PinholeEnergy:
    """Energy of depths z, lengths L and distances D of a body seen along rays.

    Points lie at (u, v, 1) (D + z). Bones keep their length and move smoothly; the distance changes slowly. Where the
    skeleton has a trunk come the energies of anatomy; elsewhere bones stay near the depths that the
    method found. Of a part of a clip whose other part told the lengths, these are given, and the distance may differ by
    a factor: it is what lengths and image leave.

    Args:
        skeleton: of the body.
        rays: (T, N, 2), complete.
        distance: (T,) as found so far, in a unit in which the body is about as large as a person of 1.75.
        near: (H, T, N) the method's depths, in this unit.
        rate: frames a second.
        noise: standard deviation of joints in the image, in this unit.
        lengths: (H, B) known, or None.
    """

    def __init__(
        self,
        skeleton: Skeleton,
        rays: Tensor,
        distance: Tensor,
        near: Tensor,
        rate: float,
        noise: float,
        lengths: Tensor | None = None,
    ) -> None:
        self.slow = slow = 30.0 / rate  # more frames a second tell no more, and move less from one to the next
        self.skeleton, self.rays, self.distance, self.rate, self.lengths = skeleton, rays, distance, rate, lengths
        self.bones = skeleton.bone_index(device=rays.device)
        self.rigid = torch.tensor(skeleton.rigid, dtype=torch.long, device=rays.device)
        self.slack = math.hypot(LENGTH, noise)
        self.waves = slow_waves(len(rays), rate, rays)
        self.waves = self.waves - self.waves.mean(0)
        if lengths is not None:
            self.waves = torch.cat([torch.ones_like(self.waves[:, :1]), self.waves], -1)
        observed = torch.eye(skeleton.num_observed, dtype=rays.dtype, device=rays.device)
        self.complete = skeleton.complete(observed)[0].mT  # virtual joints follow their sources
        self.anatomy = len(trunk_joints(skeleton)) >= 3
        if self.anatomy:
            posture = PostureEnergy(skeleton, correlation=POSTURE / slow, symmetric=False)  # its weight is set for this
            self.posture = posture.to(rays)
            self.foreshortening = ForeshorteningEnergy(skeleton, correlation=FORESHORTENING / slow).to(rays)
            self.proportions = ProportionEnergy(skeleton).to(rays)
            self.hinges = HingeEnergy(skeleton).to(rays)
            self.adduction = AdductionEnergy(skeleton).to(rays)
        else:
            self.near = bone_vectors(near[..., None], self.bones)[..., 0]

    def points(self, depth: Tensor, distance: Tensor) -> Tensor:
        """(..., T, N, 3) of depths (..., T, N) and distances (..., T)."""
        far = torch.maximum(distance[..., None] + depth, NEAREST * distance[..., None])
        flat = (self.rays * far[..., None])[..., : self.skeleton.num_observed, :]
        return torch.cat([(flat.mT @ self.complete).mT, depth[..., None]], -1)

    def pack(self, depth: Tensor) -> Tensor:
        """Unknowns (H, D) of depths (H, T, N), at the distances given; where lengths are known, at those they tell."""
        own = bone_lengths(self.points(depth, self.distance), self.bones).median(1).values.clamp_min(1e-6)
        shares = depth.new_zeros(len(depth), self.waves.shape[1])
        observed = depth[..., : self.skeleton.num_observed].flatten(1)
        if self.lengths is None:
            return torch.cat([observed, own.log(), shares], 1)
        ratio = (self.lengths / own).median(-1, keepdim=True).values
        shares[:, :1] = ratio.log()
        return torch.cat([observed * ratio, shares], 1)

    def unpack(self, state: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Depths (H, T, N), lengths (H, B) and the slow waves' shares in the distance (H, K)."""
        count, waves = len(self.rays) * self.skeleton.num_observed, self.waves.shape[1]
        own = state[:, :count].view(len(state), len(self.rays), -1)
        lengths = state[:, count : state.shape[1] - waves].exp() if self.lengths is None else self.lengths
        return own @ self.complete, lengths, state[:, state.shape[1] - waves :]

    def path(self, shares: Tensor) -> Tensor:
        """Distances (H, T) of the waves' shares (H, K)."""
        return self.distance * (shares @ self.waves.mT).exp()

    def __call__(self, state: Tensor) -> Tensor:
        """The energy of each hypothesis, (H,)."""
        depth, lengths, shares = self.unpack(state)
        distance = self.path(shares)
        points = self.points(depth, distance)
        vectors = bone_vectors(points, self.bones)
        off = (vectors.square().sum(-1) - lengths[:, None].square()) / (2 * lengths[:, None])
        off, dz = off.index_select(-1, self.rigid), vectors[..., 2]
        each = HEAVY * torch.log1p(off.square() / (HEAVY * self.slack**2))
        total = len(self.rays) / 2 * torch.log1p(each.mean(1)).sum(-1)
        total = total + dz.diff(n=2, dim=1).square().sum((1, 2)) / (2 * (ACCELERATION * self.slow**2) ** 2)
        total = total + 100 * depth.mean(-1).square().sum(-1)
        total = total + (shares / STRAY).square().sum(-1) / 2
        total = total + (distance.diff(dim=1) * self.rate / SPEED).square().sum(-1) / (2 * POSTURE / self.slow)
        if not self.anatomy:
            return total + (dz - self.near).square().sum((1, 2)) / (2 * CLOSE**2)
        total = total + self.posture(points, lengths) + self.foreshortening(points, lengths)
        total = total + HINGE * self.slow / SINE**2 * self.hinges(points, lengths).sum(-1)
        total = total + ADDUCTION * self.slow / SINE**2 * self.adduction(points, lengths).sum(-1)
        return total if self.lengths is not None else total + self.proportions(lengths)
