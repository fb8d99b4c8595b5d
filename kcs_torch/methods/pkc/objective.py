"""The one objective by which hypotheses of a body before a camera that hardly turns are refined and ranked."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from kcs_torch.functional.chain import bone_vectors, chain_inverse, incidence
from kcs_torch.nn.anatomy import HingeEnergy
from kcs_torch.nn.posture import ForeshorteningEnergy, PostureEnergy, ProportionEnergy
from kcs_torch.skeleton import Skeleton
from kcs_torch.solvers.iterate import Solution
from kcs_torch.solvers.lbfgs import lbfgs

__all__ = ["Objective", "Weights", "at_rate", "bone_noise"]

HEAVY = 4.0
"""Squared deviations of a length from here on count like an outlier's, in variances."""


@dataclass(frozen=True)
class Weights:
    """Weights of the objective's terms, for a body of 1.75 and 30 frames a second.

    Attributes:
        length: standard deviation of a bone's length about its mean.
        acceleration: standard deviation of a bone's second difference in depth.
        posture: frames that count as one for the posture.
        foreshortening: frames that count as one for the foreshortening.
        hinge: weight of a hinge in a frame.
        sine: sine of a wrong bend that costs half its weight.
        proportions: usual deviation of a length, as a share.
        twins: usual difference between left and right, as a share.
    """

    length: float = 0.003
    acceleration: float = 0.05
    posture: float = 6.0
    foreshortening: float = 10.0
    hinge: float = 0.08
    sine: float = 0.05
    proportions: float = 0.08
    twins: float = 0.03


def at_rate(weights: Weights, rate: float) -> Weights:
    """Weights for another frame rate: more frames a second tell no more, and move less from one to the next."""
    slow = 30.0 / rate
    return replace(
        weights,
        acceleration=weights.acceleration * slow**2,
        posture=weights.posture / slow,
        foreshortening=weights.foreshortening / slow,
        hinge=weights.hinge * slow,
    )


def bone_noise(noise: Tensor, bones: Tensor) -> Tensor:
    """Standard deviation (T, B) of bones' images from that of their joints (T, N)."""
    return (noise[:, bones[:, 0]].square() + noise[:, bones[:, 1]].square()).sqrt()


class Objective:
    """Energy of depths z and lengths L, given the image.

    T/2 sum_b log(1 + v_b)        bones keep their length,
    + sum_tb |second difference of dz|^2 / (2 a^2)        move smoothly,
    + PostureEnergy + HingeEnergy + ForeshorteningEnergy + ProportionEnergy.

    v_b is the robust mean over time of ((|b|^2 - L^2) / 2L)^2 / s^2: how well a bone keeps its length is for the data
    to say. Perspective and a detector's habits change lengths by much more than s, all clip long.

    Args:
        skeleton: with a template; virtual joints follow their sources.
        image: (T, N, 2), centred, in units of the template.
        weights: of the terms.
        noise: (T, N) standard deviation of each joint's image: its bones may look longer or shorter than they are.
        anchor: (B,) lengths known from elsewhere in the clip, or None.
    """

    def __init__(
        self, skeleton: Skeleton, image: Tensor, weights: Weights, noise: Tensor, anchor: Tensor | None = None
    ) -> None:
        self.skeleton, self.image, self.weights, self.anchor = skeleton, image, weights, anchor
        make = lambda module: module.to(image)  # noqa: E731
        self.posture = make(PostureEnergy(skeleton, correlation=weights.posture))
        self.foreshortening = make(ForeshorteningEnergy(skeleton, correlation=weights.foreshortening))
        self.proportions = make(ProportionEnergy(skeleton, spread=weights.proportions, twins=weights.twins))
        self.hinges = make(HingeEnergy(skeleton))
        self.bones = skeleton.bone_index(device=image.device)
        self.flat = bone_vectors(image, self.bones).square().sum(-1)  # (T, B)
        self.rigid = torch.zeros(skeleton.num_bones, dtype=image.dtype, device=image.device)
        self.rigid[list(skeleton.rigid)] = 1
        self.tree = chain_inverse(incidence(self.bones, skeleton.num_joints, dtype=image.dtype))  # (N, B)
        self.noise = bone_noise(noise, self.bones)  # (T, B)
        self.precision = self.rigid / (weights.length**2 + self.noise.square())
        least = self.noise.amin(0).square() + weights.length**2
        self.clear = least / (weights.length**2 + self.noise.square())  # a guessed image is no evidence
        observed = torch.eye(skeleton.num_observed, dtype=image.dtype, device=image.device)
        self.complete = skeleton.complete(observed)[0].mT  # (No, N): virtual joints follow their sources

    def pack(self, depth: Tensor, lengths: Tensor) -> Tensor:
        """Depths (H, T, N) and lengths (H, B) as unknowns (H, D)."""
        own = depth[..., : self.skeleton.num_observed]
        return torch.cat([own.flatten(1), (lengths / self.posture.rest_lengths).log()], 1)

    def unpack(self, state: Tensor) -> tuple[Tensor, Tensor]:
        """Depths (H, T, N), virtual joints among them, and lengths (H, B)."""
        count = len(self.image) * self.skeleton.num_observed
        own = state[:, :count].view(len(state), len(self.image), -1)
        return own @ self.complete, state[:, count:].exp() * self.posture.rest_lengths

    def terms(self, state: Tensor) -> dict[str, Tensor]:
        """Each term's value, (H,)."""
        w = self.weights
        depth, lengths = self.unpack(state)
        points = torch.cat([self.image.expand(len(state), *self.image.shape), depth[..., None]], -1)
        dz = depth[..., self.bones[:, 1]] - depth[..., self.bones[:, 0]]  # (H, T, B)
        off = (self.flat + dz.square() - lengths[:, None].square()) / (2 * lengths[:, None])
        out = {
            "length": self._length(off),
            "smoothness": dz.diff(n=2, dim=1).square().sum((1, 2)) / (2 * w.acceleration**2),
            "posture": self.posture(points, lengths),
            "hinges": w.hinge / w.sine**2 * self.hinges(points, lengths).sum(-1),
            "foreshortening": self.foreshortening(points, lengths, self.clear),
            "proportions": self.proportions(lengths),
            "centre": 100 * depth.mean(-1).square().sum(-1),
        }
        if self.anchor is not None:
            out["anchor"] = ((lengths / self.anchor).log() / 0.01).square().sum(-1) / 2
        return out

    def _length(self, off: Tensor) -> Tensor:
        """T/2 sum_b log(1 + v_b), v_b the mean over time of c log(1 + off^2 / (c s^2)), (H,) from (H, T, B)."""
        each = HEAVY * torch.log1p(self.precision * off.square() / HEAVY)
        return len(self.image) / 2 * torch.log1p(each.mean(1)).sum(-1)

    def __call__(self, state: Tensor) -> Tensor:
        """The energy of each hypothesis, (H,)."""
        return torch.stack(list(self.terms(state).values())).sum(0)

    def minimise(
        self, depth: Tensor, lengths: Tensor, num_steps: int
    ) -> tuple[Tensor, Tensor, Tensor, Solution[Tensor]]:
        """Refine hypotheses (H, T, N) and (H, B): depths, lengths and energies (H,), best first."""
        solution = lbfgs(self, self.pack(depth, lengths), num_steps=num_steps, tolerance=1e-5)
        with torch.no_grad():
            energy = self(solution.value)
        order = energy.argsort()
        depth, lengths = self.unpack(solution.value[order])
        return depth, lengths, energy[order], solution
