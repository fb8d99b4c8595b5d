"""The one objective by which hypotheses of a body before a camera that hardly turns are refined and ranked."""

from __future__ import annotations

import math
from collections.abc import Sequence
from copy import copy
from dataclasses import fields, replace
from functools import lru_cache
from typing import Any

import torch
from torch import Tensor

from kcs_torch.functional.chain import bone_vectors, chain_inverse, incidence
from kcs_torch.functional.ranks import median
from kcs_torch.methods.pkc.weights import ANCHOR, CORNER, HEAVY, NOISE, Weights, in_noise, wide
from kcs_torch.nn.anatomy import AdductionEnergy, HingeEnergy
from kcs_torch.nn.contact import ContactEnergy
from kcs_torch.nn.lengths import ForeshorteningEnergy, ProportionEnergy, foreshortening, oddity
from kcs_torch.nn.posture import PostureEnergy
from kcs_torch.nn.stance import StanceEnergy
from kcs_torch.skeleton import Skeleton

__all__ = ["MOST", "Objective", "bone_noise", "usual_posture"]

BLUR = 2.0
"""By how much a bone's direction strays, over its noise in the image per length: the trunk's frame is noisy as well."""

SHAKY = 6.0
"""By how much a standing foot strays in depth, over its noise in the image: it hangs on a chain of bones."""

NEVER = 3.5
"""A bone's least noise, over that of the clearest bone, from which on a joint of it is a guess in all frames."""

STEADY = 5
"""Reweightings by which the body's velocity is found; more change what contacts cost by .02 on average."""

VOLUME = 4.0
"""How much more, in noise, foreshortening counts among hypotheses than within one: noise lasts for less time than
poses."""

SHORT = 0.001
"""Bones are no shorter than this, a standing person being about 1.75 tall."""

MOST = 40_000
"""Frames of a clip's hypotheses that are taken together: memory is for few of a very long clip."""


def bone_noise(noise: Tensor, bones: Tensor) -> Tensor:
    """Standard deviation (T, B) of bones' images from that of their joints (T, N)."""
    return (noise[:, bones[:, 0]].square() + noise[:, bones[:, 1]].square()).sqrt()


class Objective:
    """Energy of depths z and lengths L, given the image.

    T/2 sum_b log(1 + v_b)        bones keep their length,
    + sum_tb |second difference of dz|^2 / (2 a^2)        move smoothly,
    + PostureEnergy + StanceEnergy + HingeEnergy + AdductionEnergy + ForeshorteningEnergy + ProportionEnergy
    + ContactEnergy + volume; the last two rank hypotheses and do not pull on them.

    v_b is the robust mean over time of ((|b|^2 - L^2) / 2L)^2 / s^2: how well a bone keeps its length is for the data
    to say. Perspective and a detector's habits change lengths by much more than s, all clip long.

    Args:
        skeleton: with a template; virtual joints follow their sources.
        image: (T, N, 2), centred, in units of the template.
        weights: of the terms.
        noise: (T, N) standard deviation of each joint's image: its bones may look longer or shorter than they are.
        anchor: (B,) lengths known from elsewhere in the clip, or None.
        standing: (T, C) how surely the skeleton's contact points stand still, or None where nothing tells.
    """

    def __init__(
        self,
        skeleton: Skeleton,
        image: Tensor,
        weights: Weights,
        noise: Tensor,
        anchor: Tensor | None = None,
        standing: Tensor | None = None,
    ) -> None:
        self.skeleton, self.image, self.anchor = skeleton, image, anchor
        self.bones = skeleton.bone_index(device=image.device)
        self.noise = bone_noise(noise, self.bones)  # (T, B)
        self.noisy = bool((self.noise > 0).any())
        quiet = self.noise.amin(0)
        usual = quiet.amin()
        never = quiet > NEVER * usual  # bones of joints that no frame shows
        self.usual_noise = float(self.noise[:, ~never].median())
        self.weights = in_noise(weights, self.usual_noise) if self.noisy else weights
        make = lambda module: module.to(image)  # noqa: E731
        plain = usual_posture(skeleton, image.dtype, image.device)
        blur = BLUR * median(self.noise, 0) / plain.rest_lengths.clamp_min(SHORT)
        spread = (plain.deviation.square() + blur.square()[:, None]).sqrt()
        self.posture = _altered(plain, kappa=weights.kappa, correlation=weights.posture, deviation=spread)
        self.foreshortening = make(ForeshorteningEnergy(skeleton, correlation=weights.foreshortening))
        self.proportions = make(ProportionEnergy(skeleton, spread=weights.proportions, twins=weights.twins))
        self.hinges = make(HingeEnergy(skeleton))
        self.adduction = make(AdductionEnergy(skeleton))
        self.stance = usual_stance(skeleton, image.dtype, image.device)
        self.standing = standing
        shaken = SHAKY * float(noise[:, list(skeleton.contacts)].median()) if skeleton.contacts else 0.0
        slip = math.hypot(weights.slip, shaken)
        self.feet = make(ContactEnergy(skeleton, slip=slip, change=weights.change, num_steps=STEADY))
        self.flat = bone_vectors(image, self.bones).square().sum(-1)  # (T, B)
        self.rigid = skeleton.rigid_mask(dtype=image.dtype, device=image.device)
        self.tree = chain_inverse(incidence(self.bones, skeleton.num_joints, dtype=image.dtype))  # (N, B)
        self.hinges.firm[never[self.hinges.limbs].any(-1)] = 0
        feet = torch.tensor(self.stance.feet, dtype=torch.long, device=image.device)
        guessed = not len(feet) or bool(never[torch.isin(self.bones, feet).any(-1)].any())
        strength = 0.0 if guessed else min(weights.stance, 2 * len(image) / weights.posture)
        self.weights = replace(self.weights, stance=strength)
        least = torch.where(never, usual, quiet).square() + weights.length**2
        self.clear = least / (weights.length**2 + self.noise.square())  # a guessed image is no evidence
        observed = torch.eye(skeleton.num_observed, dtype=image.dtype, device=image.device)
        self.complete = skeleton.complete(observed)[0].mT  # (No, N): virtual joints follow their sources
        # Of several clips together, see joined(): which frames are real (H, T), what they count for the posture, and
        # whose lengths are anchored (H,).
        self.count: Tensor | int = len(image)
        self.time: Tensor | None = None
        self.share: Tensor | None = None
        self.held: Tensor | float = 1.0

    def terms(self, depth: Tensor, lengths: Tensor, image: Tensor | None = None) -> dict[str, Tensor]:
        """Each term's value, (H,), of depths (H, T, N) and lengths (H, B).

        Another image (H, T, N, 2) than the objective's own may go with them; its noise and gaps are taken to be those.
        """
        w = self.weights
        flat = self.flat if image is None else bone_vectors(image, self.bones).square().sum(-1)
        own = self.image if image is None else image
        points = torch.cat([own.expand(*depth.shape, 2), depth[..., None]], -1)
        dz = self._own(depth)
        bend = dz.diff(n=2, dim=1).square()
        if self.time is not None:
            bend = bend * self.time[:, 2:, None]
        out = {
            "length": self.length_value(self.strayed(dz, lengths, flat).sum(1), lengths),
            "smoothness": bend.sum((1, 2)) / (2 * w.acceleration**2),
            "posture": self.posture(points, lengths, independent=self.share),
            "stance": w.stance * self.stance(points, 1.0, self.time),
            "hinges": w.hinge / w.sine**2 * self.hinges(points, lengths, self.time).sum(-1),
            "adduction": w.adduction / w.sine**2 * self.adduction(points, lengths, self.time).sum(-1),
            "foreshortening": self.foreshortening(points, lengths, bone_weights=self.clear, bone_noise=self.noise),
        }
        return out | self.length_terms(lengths)

    @property
    def independent(self) -> Tensor:
        """How many independent frames each bone's foreshortening counts for, (T, B)."""
        free = self.foreshortening
        return self.clear * (free.free.to(self.clear) / free.correlation)

    def length_terms(self, lengths: Tensor) -> dict[str, Tensor]:
        """Values (H,) of the terms that know lengths (H, B) alone."""
        out = {"proportions": self.proportions(lengths)}
        if self.anchor is not None:
            out["anchor"] = self.held * ((lengths / self.anchor).log() / ANCHOR).square().sum(-1) / 2
        return out

    def joints(self, own: Tensor) -> Tensor:
        """Depths (..., T, N), centred, virtual joints among them, of bones' depths (..., T, B)."""
        depth = own @ self.tree[: self.skeleton.num_observed].mT @ self.complete
        return depth - depth.mean(-1, keepdim=True)

    def contact(self, depth: Tensor) -> Tensor:
        """What feet that should stand still cost, (H,), of depths (H, T, N).

        It is the trunk that moves steadily, whatever the arms do. The term ranks solutions but does not pull on them:
        it ties the depths of both legs to each other, so stiffly that a descent with it gets stuck.
        """
        if self.standing is None:
            return depth.new_zeros(len(depth))
        few = max(1, MOST // depth.shape[1])
        depth = depth - depth[..., self.posture.trunk].mean(-1, keepdim=True)
        pad = torch.nn.functional.pad
        parts = (pad(part[..., None], (2, 0)) for part in depth.split(few))
        return torch.cat([self.weights.contact * self.feet(part, None, self.standing) for part in parts])

    def volume(self, depth: Tensor, lengths: Tensor) -> Tensor:
        """What a hypothesis gains by the room that the image's noise leaves its depths, (H,); arguments as of ranking.

        A hypothesis is as likely as all depths near it are together, not as its best ones: noise n of a bone's image w
        lets its depth vary by n |w| / |dz|. By Laplace's approximation this adds half the logarithm of the curvature's
        determinant: but for constants, what the foreshortening adds up. Bones that lean away from the image plane all
        the time would win without it, as they can explain any noise.
        """
        if not self.noisy:
            return depth.new_zeros(len(depth))
        share, eps = self._room, self.foreshortening.eps
        few, out = max(1, MOST // depth.shape[1]), []
        for z, length in zip(depth.split(few), lengths.split(few), strict=True):
            room = share * foreshortening(self._own(z), length[:, None], eps, self.noise)
            out.append(room.sum((1, 2)))
        return torch.cat(out)

    @property
    def _room(self) -> Tensor:
        """How much room counts for each bone, (T, B): exact images leave none."""
        square = self.noise.square()
        return VOLUME * self.independent * square / (square + self.weights.length**2)

    def drawn(self, size: Tensor) -> Tensor:
        """What an image costs that is drawn ``size`` (T,) times as large as this one.

        A density of places in an image falls with its area. Of one image it is a constant; among several, of which
        each is the same tracks divided by another size, small ones would win without it.
        """
        return 2 * ((self.independent + self._room).sum(-1) * size.log()).sum()

    def ranking(self, depth: Tensor, lengths: Tensor) -> Tensor:
        """What ranks solutions and does not pull on them, (H,), of depths (H, T, N) and lengths (H, B)."""
        return self.contact(depth) + self.volume(depth, lengths)

    def _own(self, depth: Tensor) -> Tensor:
        """Depths (H, T, B) of bones, of joints' (H, T, N)."""
        return depth[..., self.bones[:, 1]] - depth[..., self.bones[:, 0]]

    def oddity(self, lengths: Tensor) -> float:
        """How far lengths (B,) of rigid bones stray from the template's: root mean square of the logarithm."""
        rigid = list(self.skeleton.rigid)
        return oddity(lengths[rigid], self.posture.rest_lengths[rigid])

    def carries(self, member: Tensor) -> Tensor:
        """Which parts (P,) move feet against the trunk, for members (P, B) that are 1 for a part's bones."""
        return member @ self.feet_moved().any(-1).to(member) > 0

    def feet_moved(self) -> Tensor:
        """How far depths of 1 of each bone move each contact point against the trunk, (B, C)."""
        lines = self.joints(torch.eye(len(self.bones), dtype=self.tree.dtype, device=self.tree.device))  # (B, N)
        feet = lines[:, list(self.skeleton.contacts)] - lines[:, self.posture.trunk].mean(-1, keepdim=True)
        return torch.where(feet.abs() > 1e-9, feet, 0)

    def strayed(self, dz: Tensor, lengths: Tensor, flat: Tensor) -> Tensor:
        """How far bones of depths (H, T, B) are from lengths (H, B): c log(1 + off^2 / (c s^2)), (H, T, B).

        ``flat`` (T, B) or (H, T, B) are their squared images.
        """
        off = (flat + dz.square() - lengths[:, None].square()) / (2 * lengths[:, None])
        return HEAVY * torch.log1p(self.precision(lengths) * off.square() / HEAVY)

    def length_value(self, strayed: Tensor, lengths: Tensor) -> Tensor:
        """T/2 sum_b log(1 + v_b), (H,), of sums over time (H, B) of what bones stray from their lengths (H, B).

        v_b is the mean over time, less what noise alone leaves of it: depths that explain the noise away would have to
        be large, and the body with them.
        """
        spread = strayed / wide(self.count, 1)
        if self.noisy:
            noise = NOISE * self._mean(self.rigid - wide(self.weights.length, 2) ** 2 * self.precision(lengths))
            over = spread - noise
            spread = (over + (over.square() + (CORNER * noise).square() + 1e-12).sqrt()) / 2
        return self.count / 2 * torch.log1p(spread).sum(-1)

    def _mean(self, values: Tensor) -> Tensor:
        """Mean over time (H, B) of (H, T, B), which is 0 in frames that pad a clip."""
        return values.mean(1) if self.time is None else values.sum(1) / wide(self.count, 1)

    def precision(self, lengths: Tensor) -> Tensor:
        """1 / s^2 (H, T, B): an image's noise counts less the more the bone points at the camera."""
        least = wide(self.weights.length, 2) ** 2
        if not self.noisy:
            return (self.rigid / least).expand(*lengths.shape[:1], *self.flat.shape[-2:])
        share = (self.flat / lengths[:, None].square()).clamp_max(1)
        return self.rigid / (least + share * self.noise.square())

    def __call__(self, depth: Tensor, lengths: Tensor) -> Tensor:
        """The energy (H,) of depths (H, T, N) and lengths (H, B), less what :meth:`ranking` adds."""
        return torch.stack(list(self.terms(depth, lengths).values())).sum(0)

    @classmethod
    def joined(cls, parts: Sequence[Objective], counts: Sequence[int]) -> Objective:
        """One objective over the hypotheses of several clips of one skeleton, those of shorter ones padded.

        Args:
            parts: the clips' objectives.
            counts: of the hypotheses of each clip, which follow each other.
        """
        first = parts[0]
        out = copy(first)
        frames = [len(part.image) for part in parts]
        each = torch.repeat_interleave(torch.arange(len(parts)), torch.tensor(counts)).to(first.image.device)

        def padded(tensors: list[Tensor]) -> Tensor:
            return torch.nn.utils.rnn.pad_sequence(tensors, batch_first=True)[each]

        gather = lambda values: first.image.new_tensor(values)[each]  # noqa: E731
        each_weight = {f.name: gather([getattr(part.weights, f.name) for part in parts]) for f in fields(Weights)}
        out.weights = Weights(**each_weight)  # type: ignore[arg-type]  # (H,) each
        out.image = padded([part.image for part in parts])
        out.flat, out.noise = padded([part.flat for part in parts]), padded([part.noise for part in parts])
        out.time = padded([part.image.new_ones(n) for part, n in zip(parts, frames, strict=True)])
        out.rigid = first.rigid * out.time[..., None]
        spread = torch.stack([part.posture.deviation for part in parts])[each][:, None]
        out.posture = _altered(first.posture, deviation=spread)
        out.standing = None  # contacts rank the hypotheses of each clip by itself, when all are refined
        out.count, out.noisy = gather(frames), any(part.noisy for part in parts)
        out.share = out.time / gather([part.posture.correlation for part in parts])[:, None]
        ratio = [first.foreshortening.correlation / part.foreshortening.correlation for part in parts]
        out.clear = padded([part.clear.expand_as(part.flat) * r for part, r in zip(parts, ratio, strict=True)])
        if any(part.anchor is not None for part in parts):
            one = first.image.new_ones(first.skeleton.num_bones)
            out.anchor = torch.stack([one if part.anchor is None else part.anchor for part in parts])[each]
            out.held = gather([float(part.anchor is not None) for part in parts])
        return out

    def rows(self, index: Tensor) -> Objective:
        """That of some hypotheses, of several clips together; of one clip it is the same for all."""
        if self.time is None:
            return self
        out, pick = copy(self), lambda value: value[index]
        for name in ("image", "flat", "noise", "time", "rigid", "count", "share", "clear"):
            setattr(out, name, pick(getattr(self, name)))
        out.weights = Weights(**{f.name: pick(getattr(self.weights, f.name)) for f in fields(Weights)})
        out.posture = _altered(self.posture, deviation=pick(self.posture.deviation))
        if self.anchor is not None:
            out.anchor, out.held = pick(self.anchor), pick(self.held)
        return out


@lru_cache(maxsize=16)
def usual_posture(skeleton: Skeleton, dtype: torch.dtype, device: torch.device) -> PostureEnergy:
    """The skeleton's posture, made once for all clips: not to be changed."""
    with torch.inference_mode(False):
        return PostureEnergy(skeleton).to(device, dtype)


@lru_cache(maxsize=16)
def usual_stance(skeleton: Skeleton, dtype: torch.dtype, device: torch.device) -> StanceEnergy:
    """The skeleton's stance, made once for all clips: not to be changed."""
    with torch.inference_mode(False):
        return StanceEnergy(skeleton).to(device, dtype)


def _altered(posture: PostureEnergy, **values: Any) -> PostureEnergy:
    """One that shares all but some values."""
    out = copy(posture)
    out.__dict__["_buffers"] = dict(posture._buffers)
    for name, value in values.items():
        setattr(out, name, value)
    return out
