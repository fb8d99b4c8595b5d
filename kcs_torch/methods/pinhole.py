"""The energy of a body seen through a pinhole: :class:`PinholeEnergy`."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from kcs_torch.functional.chain import bone_lengths, bone_vectors, chain_inverse, incidence
from kcs_torch.functional.spectral import dct_basis
from kcs_torch.methods.pkc.descent import HEAVY
from kcs_torch.methods.pkc.objective import Objective
from kcs_torch.methods.pkc.weights import Weights, at_pace, pace_of
from kcs_torch.nn.posture import trunk_joints
from kcs_torch.skeleton import Skeleton

__all__ = ["NEAREST", "Body", "PinholeEnergy"]

NEAREST = 0.15
"""Joints are kept at least this share of the body's distance before the camera."""

ACCELERATION = 0.05
"""Standard deviation of the second difference of a bone's depth at 30 frames a second, without a template."""

CLOSE = 0.3
"""Usual deviation of a bone's depth from the method's, for bodies without a template."""

SPEED, ROOT = 3.0, 0.01
"""Usual speed towards the camera a second, and the standard deviation of the second difference of the distance at 30
frames a second, for a body of 1.75."""

INDEPENDENT = 6.0
"""Frames that count as one for the speed at 30 frames a second."""

STRAY = 0.1
"""Usual deviation of the distance from what is given, as a share, all frames counting as one."""

FASTEST = 4.0
"""Periods a second of the fastest change of the distance."""

FREE = 0.1
"""Usual deviation of a length, as a share: how long steps are."""


class Body(NamedTuple):
    """Where joints are, of H hypotheses.

    Attributes:
        depth: (H, T, N) relative to the distance, of mean 0 over the joints unless they started otherwise.
        lengths: (H, B).
        distance: (H, T).
    """

    depth: Tensor
    lengths: Tensor
    distance: Tensor


class PinholeEnergy:
    """Energy of depths z, lengths L and distances D of a body seen along rays.

    Points lie at (u, v, 1) (D + z). Of a skeleton with a template the terms are those of PKC's
    :class:`kcs_torch.methods.pkc.objective.Objective`, for the image under parallel rays that z and D make of the rays;
    of another one bones keep their length, move smoothly and stay near the depths that the method found. The distance
    changes smoothly, and feet that stand still in the image stand still in space. Of a part of a clip whose other part
    told the lengths, these are given, and the distance may differ by a factor: it is what lengths and image leave.

    Unknowns are the bones' depths, the logarithms of lengths, and cosines of the distance's logarithm, in coordinates
    about the start in which the energy is nearly a sphere. What a length or a distance changes in the bones' lengths is
    made up for by their depths, as lengths are known too well to change alone.

    Args:
        skeleton: of the body.
        rays: (T, N, 2), complete.
        distance: (T,) as found so far, in a unit in which the body is about as large as a person of 1.75.
        depth: (H, T, N) starts, in this unit: the method's depths.
        rate: frames a second.
        noise: (T, N) standard deviation of joints in the image, in this unit.
        lengths: (H, B) known, or None.
        standing: (T, C) how surely the skeleton's contact points stand still, or None where nothing tells.

    Attributes:
        start: (H, D) the unknowns of the start.
    """

    def __init__(
        self,
        skeleton: Skeleton,
        rays: Tensor,
        distance: Tensor,
        depth: Tensor,
        rate: float,
        noise: Tensor,
        lengths: Tensor | None = None,
        standing: Tensor | None = None,
    ) -> None:
        self.slow = 30.0 / rate  # more frames a second tell no more, and move less from one to the next
        self.skeleton, self.rays, self.rate, self.known = skeleton, rays, rate, lengths is not None
        self.bones = skeleton.bone_index(device=rays.device)
        observed = torch.eye(skeleton.num_observed, dtype=rays.dtype, device=rays.device)
        self.complete = skeleton.complete(observed)[0].mT  # virtual joints follow their sources
        tree = chain_inverse(incidence(self.bones, skeleton.num_joints, dtype=rays.dtype))
        lines = tree[: skeleton.num_observed].mT @ self.complete
        self.lines = lines - lines.mean(-1, keepdim=True)  # (B, N)
        own = bone_lengths(self._points(depth, distance.expand(len(depth), -1)), self.bones)
        own = own.median(1).values.clamp_min(1e-6)
        self.distance = distance.expand(len(depth), -1)
        if lengths is not None:  # the distance that they tell
            ratio = (lengths / own).median(-1, keepdim=True).values
            depth, self.distance = depth * ratio[..., None], self.distance * ratio
        self.depth, self.lengths = depth, own if lengths is None else lengths
        most = math.ceil(2 * FASTEST * len(rays) / rate)
        waves = dct_basis(len(rays), max(1, min(len(rays), most)), dtype=rays.dtype, device=rays.device)
        waves = waves * math.sqrt(len(rays))
        self.waves = waves if self.known else waves[:, 1:]  # (T, K)
        self.rigid = torch.zeros_like(self.lengths[0])
        self.rigid[list(skeleton.rigid)] = 1
        self.model: Objective | None = None
        self.acceleration = ACCELERATION * self.slow**2
        points = self._points(depth, self.distance)
        if len(trunk_joints(skeleton)) >= 3:
            image = points[0, ..., :2] - points[0, ..., :2].mean(-2, keepdim=True)
            weights = at_pace(Weights(), rate, pace_of(image, skeleton, rate))
            self.model = Objective(skeleton, image, weights, noise, standing=standing)
            self.acceleration = weights.acceleration
        else:
            self.near = bone_vectors(points, self.bones)[..., 2]
            self.slack = math.hypot(Weights().length, float(noise.median()) if noise.numel() else 0.0)
        self.shear, self.drift, self.scale = self._coordinates(points)
        self.start = torch.zeros_like(self.scale)

    def unpack(self, state: Tensor) -> Body:
        """The body that unknowns (H, D) stand for."""
        part, grown, shares = (state * self.scale).split(self._sizes, 1)
        change = shares @ self.waves.mT  # (H, T) of the distance's logarithm
        dz = part.view_as(self.shear) - self.drift * change[..., None]
        lengths = self.lengths
        if not self.known:
            dz = dz + self.shear * grown[:, None]
            lengths = lengths * grown.exp()
        return Body(self.depth + dz @ self.lines, lengths, self.distance * change.exp())

    def __call__(self, state: Tensor) -> Tensor:
        """The energy of each hypothesis, (H,)."""
        depth, lengths, distance = self.unpack(state)
        points = self._points(depth, distance)
        total = (distance / self.distance).log().square().mean(-1) / (2 * STRAY**2)
        total = total + (distance.diff(n=2) / (ROOT * self.slow**2)).square().sum(-1) / 2
        total = total + (distance.diff() * self.rate / SPEED).square().sum(-1) / (2 * INDEPENDENT / self.slow)
        if self.model is None:
            return total + self._plain(points, lengths)
        terms = self.model.terms(depth, lengths, points[..., :2])
        total = total + sum(value for name, value in terms.items() if name != "proportions" or not self.known)
        return total + self._contact(depth, distance) - self._nearness(depth, distance)

    def _points(self, depth: Tensor, distance: Tensor) -> Tensor:
        """(H, T, N, 3) of depths (H, T, N) and distances (H, T)."""
        far = torch.maximum(distance[..., None] + depth, NEAREST * distance[..., None])
        flat = (self.rays * far[..., None])[..., : self.skeleton.num_observed, :]
        return torch.cat([(flat.mT @ self.complete).mT, depth[..., None]], -1)

    def _plain(self, points: Tensor, lengths: Tensor) -> Tensor:
        """The energy (H,) of bodies (H, T, N, 3) without a template."""
        vectors = bone_vectors(points, self.bones)
        dz = vectors[..., 2]
        off = (vectors.square().sum(-1) - lengths[:, None].square()) / (2 * lengths[:, None])
        each = HEAVY * torch.log1p(self.rigid * off.square() / (HEAVY * self.slack**2))
        total = len(self.rays) / 2 * torch.log1p(each.mean(1)).sum(-1)
        total = total + dz.diff(n=2, dim=1).square().sum((1, 2)) / (2 * self.acceleration**2)
        return total + (dz - self.near).square().sum((1, 2)) / (2 * CLOSE**2)

    def _contact(self, depth: Tensor, distance: Tensor) -> Tensor:
        """What standing feet cost that move along their rays, (H,)."""
        model = self.model
        if model is None or model.standing is None:
            return distance.new_zeros(len(distance))
        along = (distance[..., None] + depth) * (1 + self.rays.square().sum(-1)).sqrt()
        feet = torch.nn.functional.pad(along[..., None], (2, 0))
        return model.weights.contact * model.feet(feet, torch.zeros_like(distance), model.standing)

    def _nearness(self, depth: Tensor, distance: Tensor) -> Tensor:
        """By how much less likely foreshortened images are along rays than under parallel ones, (H,).

        A direction drawn evenly has an image of density 1 / (2 pi L |d|) under parallel rays, and of (D + z)^2 times
        that along rays: without it a body would cost less for being small, and near to the camera.
        """
        assert self.model is not None
        free = self.model.foreshortening
        share = self.model.clear * (free.free.to(distance) / free.correlation)  # (T, B)
        ends = torch.maximum(distance[..., None] + depth, NEAREST * distance[..., None])[..., self.bones]
        far = ends.mean(-1) / self.distance.mean(-1)[:, None, None]
        return 2 * (share * far.log()).sum((1, 2))

    @property
    def _sizes(self) -> list[int]:
        """Of bones' depths, lengths and waves among the unknowns."""
        frames, bones = len(self.rays), len(self.bones)
        return [frames * bones, 0 if self.known else bones, self.waves.shape[1]]

    def _coordinates(self, points: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """How bones' depths (H, T, B) go with log lengths and against log distances, and the unknowns' scale (H, D).

        Scales are the roots of the curvature's inverse, roughly: of the lengths', smoothness and posture terms and of
        the distance's own.
        """
        model = self.model
        vectors, size = bone_vectors(points, self.bones), self.lengths[:, None]
        dz, flat = vectors[..., 2], vectors[..., :2].square().sum(-1)
        off = (flat + dz.square() - size.square()) / (2 * size)
        precision = self.rigid / self.slack**2 if model is None else model.precision(self.lengths)
        spread = HEAVY * torch.log1p(precision * off.square() / HEAVY).mean(1, keepdim=True)
        pull = precision / (1 + spread.clamp_max(1))
        smooth = 6 / self.acceleration**2  # the mean square of a second difference's coefficients
        if model is None:
            shape = torch.full_like(size, 1 / CLOSE**2)
        else:
            usual = model.posture.deviation.square().mean(-1)
            shape = 5 / (model.weights.posture * (usual * size.square()).clamp_min(1e-3))
        curve = pull * (dz / size).square() + smooth + shape
        near = dz.square() + (0.5 * size).square()
        shear, drift = size.square() * dz / near, flat * dz / near
        own = (pull * (size - dz * shear / size).square()).sum(1) + 1 / FREE**2
        own = own + shear.diff(n=2, dim=1).square().sum(1) / self.acceleration**2
        left = (pull * (flat / size - dz * drift / size).square()).sum(-1)  # (H, T)
        steps = [self.waves.diff(n=n, dim=0).square().sum(0) for n in (1, 2)]  # (K,) each
        far = self.distance.square().mean(-1, keepdim=True)
        waves = left @ self.waves.square() + 1 / STRAY**2
        waves = waves + far * steps[1] / (ROOT * self.slow**2) ** 2
        waves = waves + drift.square().mean(1).sum(-1, keepdim=True) * steps[1] / self.acceleration**2
        if model is not None and model.standing is not None and model.standing.numel():
            firm = model.weights.contact / model.feet.slip**2
            both = torch.minimum(model.standing[1:], model.standing[:-1])
            each = torch.nn.functional.pad(both, (0, 0, 0, 1)) + torch.nn.functional.pad(both, (0, 0, 1, 0))
            lines = self.lines[:, list(self.skeleton.contacts)]  # (B, C)
            curve = curve + firm * each @ lines.mT.square()
            moves = torch.einsum("htb,bc->htcb", shear, lines).diff(dim=1)
            own = own + firm * torch.einsum("tc,htcb->hb", both, moves.square())
            moves = (self.distance[..., None] - drift @ lines).square() * each / 2
            waves = waves + firm * moves.sum(-1).mean(1, keepdim=True) * steps[0]
        parts = [curve.flatten(1), waves] if self.known else [curve.flatten(1), own, waves]
        return shear, drift, torch.cat(parts, 1).rsqrt()
