"""The one objective by which hypotheses of a body before a camera that hardly turns are refined and ranked."""

from __future__ import annotations

from copy import copy
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from kcs_torch.functional.chain import bone_vectors, chain_inverse, incidence
from kcs_torch.nn.anatomy import HingeEnergy
from kcs_torch.nn.posture import ForeshorteningEnergy, PostureEnergy, ProportionEnergy, free_bones
from kcs_torch.skeleton import Skeleton
from kcs_torch.solvers.iterate import Solution
from kcs_torch.solvers.lbfgs import lbfgs

__all__ = ["Objective", "Weights", "at_pace", "bone_noise", "pace_of"]

NOISE, CORNER = 0.8, 0.3
"""Share of the noise's variance that is not to be explained, and how gently its cost sets in."""

HEAVY = 4.0
"""Squared deviations of a length from here on count like an outlier's, in variances."""


WALK = 4.3
"""Frames in which a walking person's bones change in the image by as much as they stray, at 30 frames a second."""


@dataclass(frozen=True)
class Weights:
    """Weights of the objective's terms, for a body of 1.75 and 30 frames a second.

    Attributes:
        length: standard deviation of a bone's length about its mean.
        acceleration: standard deviation of a bone's second difference in depth.
        posture: frames that count as one for the posture.
        kappa: independent frames that the template's directions are worth.
        foreshortening: frames that count as one for the foreshortening.
        hinge: weight of a hinge in a frame.
        sine: sine of a wrong bend that costs half its weight.
        proportions: usual deviation of a length, as a share.
        twins: usual difference between left and right, as a share.
    """

    length: float = 0.003
    acceleration: float = 0.08
    posture: float = 6.0
    kappa: float = 20.0
    foreshortening: float = 10.0
    hinge: float = 0.08
    sine: float = 0.05
    proportions: float = 0.08
    twins: float = 0.03


def at_pace(weights: Weights, rate: float, pace: float = 1.0) -> Weights:
    """Weights for another frame rate, and for a body that moves slowly.

    More frames a second move less from one to the next; and frames tell no more for being many, but for being
    different: see :func:`pace_of`.
    """
    slow = 30.0 / rate
    return replace(
        weights,
        acceleration=weights.acceleration * slow**2,
        posture=weights.posture * pace,
        foreshortening=weights.foreshortening * pace,
        hinge=weights.hinge / pace,
    )


def pace_of(image: Tensor, skeleton: Skeleton, rate: float) -> float:
    """How many frames tell as much as one of a walking person's at 30 frames a second, at least ``rate / 30``.

    The deviation of the bones' images over that of their changes: the time in which a pose changes into another.

    Args:
        image: (T, N, 2).
        skeleton: with a template or proportions.
        rate: frames a second.
    """
    least = rate / 30
    usual = skeleton.relative_lengths(dtype=image.dtype)
    if len(image) < 3 or usual is None:
        return least
    vectors = bone_vectors(image, skeleton.bone_index(device=image.device))
    vectors = (vectors / usual.to(image).clamp_min(1e-3)[:, None])[:, free_bones(skeleton).to(image.device) > 0]
    moved = float(vectors.diff(dim=0).square().sum((1, 2)).mean().sqrt())
    spread = float((vectors - vectors.mean(0)).square().sum((1, 2)).mean().sqrt())
    time = spread / moved if moved > spread / len(image) else float(len(image))
    return max(least, time / WALK)


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
        self.posture = make(PostureEnergy(skeleton, kappa=weights.kappa, correlation=weights.posture))
        self.foreshortening = make(ForeshorteningEnergy(skeleton, correlation=weights.foreshortening))
        self.proportions = make(ProportionEnergy(skeleton, spread=weights.proportions, twins=weights.twins))
        self.hinges = make(HingeEnergy(skeleton))
        self.bones = skeleton.bone_index(device=image.device)
        self.flat = bone_vectors(image, self.bones).square().sum(-1)  # (T, B)
        self.rigid = torch.zeros(skeleton.num_bones, dtype=image.dtype, device=image.device)
        self.rigid[list(skeleton.rigid)] = 1
        self.tree = chain_inverse(incidence(self.bones, skeleton.num_joints, dtype=image.dtype))  # (N, B)
        self.noise = bone_noise(noise, self.bones)  # (T, B)
        self.noisy = bool((self.noise > 0).any())
        least = self.noise.amin(0).square() + weights.length**2
        self.clear = least / (weights.length**2 + self.noise.square())  # a guessed image is no evidence
        observed = torch.eye(skeleton.num_observed, dtype=image.dtype, device=image.device)
        self.complete = skeleton.complete(observed)[0].mT  # (No, N): virtual joints follow their sources

    def terms(self, depth: Tensor, lengths: Tensor) -> dict[str, Tensor]:
        """Each term's value, (H,), of depths (H, T, N) and lengths (H, B)."""
        w = self.weights
        points = torch.cat([self.image.expand(*depth.shape, 2), depth[..., None]], -1)
        dz = depth[..., self.bones[:, 1]] - depth[..., self.bones[:, 0]]  # (H, T, B)
        off = (self.flat + dz.square() - lengths[:, None].square()) / (2 * lengths[:, None])
        out = {
            "length": self._length(off, lengths),
            "smoothness": dz.diff(n=2, dim=1).square().sum((1, 2)) / (2 * w.acceleration**2),
            "posture": self.posture(points, lengths),
            "hinges": w.hinge / w.sine**2 * self.hinges(points, lengths).sum(-1),
            "foreshortening": self.foreshortening(points, lengths, self.clear),
            "proportions": self.proportions(lengths),
        }
        if self.anchor is not None:
            out["anchor"] = ((lengths / self.anchor).log() / 0.01).square().sum(-1) / 2
        return out

    def _length(self, off: Tensor, lengths: Tensor) -> Tensor:
        """T/2 sum_b log(1 + v_b) of off (H, T, B), (H,).

        v_b is the mean over time of c log(1 + off^2 / (c s^2)), less what noise alone leaves of it: depths that explain
        the noise away would have to be large, and the body with them.
        """
        precision = self.precision(lengths)
        spread = (HEAVY * torch.log1p(precision * off.square() / HEAVY)).mean(1)  # (H, B)
        if self.noisy:
            noise = NOISE * (self.rigid - self.weights.length**2 * precision).mean(1)
            over = spread - noise
            spread = (over + (over.square() + (CORNER * noise).square() + 1e-12).sqrt()) / 2
        return len(self.image) / 2 * torch.log1p(spread).sum(-1)

    def precision(self, lengths: Tensor) -> Tensor:
        """1 / s^2 (H, T, B): an image's noise counts less the more the bone points at the camera."""
        if not self.noisy:
            return (self.rigid / self.weights.length**2).expand(*lengths.shape[:1], *self.flat.shape)
        share = (self.flat / lengths[:, None].square()).clamp_max(1)
        return self.rigid / (self.weights.length**2 + share * self.noise.square())

    def __call__(self, depth: Tensor, lengths: Tensor) -> Tensor:
        """The energy (H,) of depths (H, T, N) and lengths (H, B)."""
        return torch.stack(list(self.terms(depth, lengths).values())).sum(0)

    def minimise(
        self, depth: Tensor, lengths: Tensor, num_steps: int, loose: float = 1.0
    ) -> tuple[Tensor, Tensor, Tensor, Solution[Tensor]]:
        """Refine hypotheses (H, T, N) and (H, B): depths, lengths and energies (H,), best first.

        A start whose bones are far from constant is best refined with lengths ``loose`` times less certain first; the
        energies are then those of the loose objective.
        """
        if loose > 1:
            rough = copy(self)
            rough.weights = replace(self.weights, length=loose * self.weights.length)
            return rough.minimise(depth, lengths, num_steps)
        unknowns = _Unknowns(self, depth, lengths)
        start = depth.new_zeros(len(depth), unknowns.scale.shape[-1])
        solution = lbfgs(lambda state: self(*unknowns(state)), start, num_steps=num_steps, tolerance=1e-5)
        with torch.no_grad():
            depth, lengths = unknowns(solution.value)
            energy = self(depth, lengths)
        order = energy.argsort()
        return depth[order], lengths[order], energy[order], solution


class _Unknowns:
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
        self.objective, self.lengths = objective, lengths
        self.dz = bone_vectors(depth[..., None], objective.bones)[..., 0]
        size = lengths[:, None]
        off = (objective.flat + self.dz.square() - size.square()) / (2 * size)
        precision = objective.precision(lengths)
        each = precision * off.square()
        spread = (HEAVY * torch.log1p(each / HEAVY)).mean(1, keepdim=True)
        pull = precision / (1 + spread.clamp_max(1))
        shape = w.posture * (posture.deviation.square().mean(-1) * size.square()).clamp_min(1e-3)
        curve = pull * (self.dz / size).square() + 6 / w.acceleration**2 + 5 / shape  # (H, T, B)
        self.shear = size.square() * self.dz / (self.dz.square() + (0.5 * size).square())
        left = size - self.dz * self.shear / size
        bend = self.shear.diff(n=2, dim=1).square().sum(1) / w.acceleration**2
        along = (pull * left.square()).sum(1) + 1 / w.proportions**2 + bend  # (H, B)
        self.scale = torch.cat([curve.flatten(1), along], 1).rsqrt()

    def __call__(self, state: Tensor) -> tuple[Tensor, Tensor]:
        """Depths (H, T, N), centred, virtual joints among them, and lengths (H, B), of unknowns (H, T B + B)."""
        obj = self.objective
        _, frames, bones = self.dz.shape
        part, grown = (state * self.scale).split([frames * bones, bones], 1)
        dz = self.dz + part.unflatten(1, (frames, bones)) + self.shear * grown[:, None]
        own = dz @ obj.tree[: obj.skeleton.num_observed].mT
        depth = own @ obj.complete
        return depth - depth.mean(-1, keepdim=True), self.lengths * grown.exp()
