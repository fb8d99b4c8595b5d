"""The energy of a body seen through a pinhole: :class:`PinholeEnergy`."""

from __future__ import annotations

import math
from collections.abc import Sequence
from copy import copy
from typing import NamedTuple

import torch
from torch import Tensor

from kcs_torch.functional.chain import bone_vectors, chain_inverse, incidence
from kcs_torch.functional.guarded import or_one
from kcs_torch.functional.ranks import median
from kcs_torch.functional.spectral import dct_basis
from kcs_torch.methods.perspective.pinhole_coordinates import EASY, FIRM, STRAY, USUAL, coordinates
from kcs_torch.methods.perspective.plain_body import PlainBody
from kcs_torch.methods.pkc.descent import ObjectiveGradient
from kcs_torch.methods.pkc.image import bend_cost
from kcs_torch.methods.pkc.objective import Objective
from kcs_torch.methods.pkc.weights import Weights, at_pace, pace_of
from kcs_torch.nn.posture import has_trunk
from kcs_torch.skeleton import Skeleton

__all__ = ["NEAREST", "Body", "PinholeEnergy"]

NEAREST = 0.15
"""Joints are kept at least this share of the body's distance before the camera."""

SPEED, ROOT = 3.0, 0.01
"""Usual speed towards the camera a second, and the standard deviation of the second difference of the distance at 30
frames a second, for a body of 1.75."""

INDEPENDENT = 6.0
"""Frames that count as one for the speed at 30 frames a second."""

FASTEST = 4.0
"""Periods a second of the fastest change of the distance."""


class Body(NamedTuple):
    """Where joints are, of H hypotheses.

    Attributes:
        depth: (H, T, N) relative to the distance, of mean 0 over the joints unless they started otherwise.
        lengths: (H, B).
        distance: (H, T).
        focal: (H,) focal length, over that of the rays' camera.
    """

    depth: Tensor
    lengths: Tensor
    distance: Tensor
    focal: Tensor


class _Laid(NamedTuple):
    """Bodies in space, time last, as an evaluation needs them.

    Attributes:
        depth: (H, N, T).
        own: (H, B, T) depths of bones.
        lengths: (H, B).
        path: (H, T) distances, times the rays' focal length over the true one.
        wide: (H, 1) that focal length's inverse.
        far: (H, N, T) what rays are multiplied by, and where that is held (H, N, T).
        held: (H, N, T).
        image: (H, 2, B, T) of bones, under parallel rays.
    """

    depth: Tensor
    own: Tensor
    lengths: Tensor
    path: Tensor
    wide: Tensor
    far: Tensor
    held: Tensor
    image: Tensor


class PinholeEnergy:
    """Energy of depths z, lengths L and distances D of a body seen along rays, and its gradient.

    Points lie at (u, v, 1) (D + z). Of a skeleton with a template the terms are those of PKC's
    :class:`kcs_torch.methods.pkc.objective.Objective`, for the image under parallel rays that z and D make of the rays;
    of another one bones keep their length, move smoothly and stay near the depths that the method found. The distance
    changes smoothly, and feet that stand still in the image stand still in space. Of a part of a clip whose other part
    told the lengths, these are given, and the distance may differ by a factor: it is what lengths and image leave.

    Where the focal length is not known, rays are (u, v, 1 / w), of a focal length w times as short: then D = P / w with
    a path P that the size in the image tells, and points lie at (u (P + w z), v (P + w z), P / w + z). To w = 0 belong
    parallel rays. It is likely to make the camera's distance a usual one, and to be as long as lenses usually are.
    Where usual focal lengths are known, it costs little to be farther away than usual.

    Unknowns are the bones' depths, the logarithms of lengths, and cosines of the distance's logarithm, and that of w,
    in coordinates about the start in which the energy is nearly a sphere. What a length, a distance or w changes in the
    bones' lengths is made up for by their depths, as lengths are known too well to change alone.

    Args:
        skeleton: of the body.
        rays: (T, N, 2), complete.
        distance: (T,) as found so far, in a unit in which the body is about as large as a person of 1.75.
        depth: (H, T, N) starts, in this unit: the method's depths.
        rate: frames a second.
        noise: (T, N) standard deviation of joints in the image, in this unit.
        lengths: (H, B) known, or None.
        standing: (T, C) how surely the skeleton's contact points stand still, or None where nothing tells.
        focal: (H,) where the search for a focal length starts, over that of the rays' camera, and which are free (H,);
            None where it is known.
        usual: focal length of usual lenses, over that of the rays' camera; None where nothing tells.
        cuts: first frames of all shots of the film but the first, where the distance steps.

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
        focal: tuple[Tensor, Tensor] | None = None,
        usual: float | None = None,
        cuts: Sequence[int] = (),
    ) -> None:
        cuts = list(cuts)
        self.slow = 30.0 / rate  # more frames a second tell no more, and move less from one to the next
        self.skeleton, self.rate, self.known = skeleton, rate, lengths is not None
        self.rays = rays.permute(2, 1, 0).contiguous()  # (2, N, T)
        spread = (rays - rays.mean(1, keepdim=True)).square().sum(-1).mean().sqrt()
        self.size = or_one(spread)  # of images, wherever the start is
        self.bones = skeleton.bone_index(device=rays.device)
        tree = self._links(rays)
        self.toward = self.rays[:, self.bones[:, 1]]  # (2, B, T) bones' rays
        self.path, self.depth = distance.expand(len(depth), -1), depth.mT.contiguous()  # P (H, T), z (H, N, T)
        self.wide = (torch.ones_like(depth[:, 0, 0]) if focal is None else 1 / focal[0])[:, None]  # w (H, 1)
        self.free = None if focal is None else focal[1]  # (H,) whose w is an unknown
        self.usual = usual
        self.own = bone_vectors(depth[..., None], self.bones)[..., 0].mT.contiguous()
        size = (self.own.square() + self._first_image().square().sum(1)).sqrt()
        self.lengths = median(size, -1).clamp_min(1e-6)
        if lengths is not None:  # the distance that they tell
            ratio = median(lengths / self.lengths, -1, keepdim=True)
            self.path, self.lengths = self.path * ratio, lengths
            self.depth, self.own = self.depth * ratio[..., None], self.own * ratio[..., None]
        waves = torch.block_diag(*(_waves(shot, rate) for shot in rays.tensor_split(cuts)))
        self.waves = waves[:, 0 if self.known else 1 :]  # (T, K); unknown lengths make up for the first
        self.follows = rays.new_ones(len(rays))  # (T,) 0 in the first frames of shots
        self.follows[cuts] = 0
        self.bends = self.follows * self.follows.roll(1)  # (T,) and in their second ones
        self.rough = (ROOT * self.slow**2) ** -2
        self.model: Objective | None = None
        self.body: ObjectiveGradient | PlainBody
        image = self._first_image()
        if has_trunk(skeleton):
            flat = (tree @ image[0]).permute(2, 1, 0)  # (T, N, 2), centred
            weights = at_pace(Weights(), rate, pace_of(flat, skeleton, rate))
            self.model = Objective(skeleton, flat, weights, noise, standing=standing)
            self.body = ObjectiveGradient(self.model)
            self.share = self.model.independent.mT  # (B, T)
        else:
            slack = math.hypot(Weights().length, float(noise.median()) if noise.numel() else 0.0)
            self.body = PlainBody(skeleton, self.own, slack, self.slow)
        self.shear, self.drift, self.lean, self.scale = coordinates(self, image)
        self.start = torch.zeros_like(self.scale)

    def _links(self, like: Tensor) -> Tensor:
        """Hold what makes bones of joints and joints of bones; returns the tree (N, B) that does the latter."""
        skeleton, n = self.skeleton, self.skeleton.num_observed
        complete = skeleton.complete(torch.eye(n, dtype=like.dtype, device=like.device))[0].mT  # (No, N)
        ends = incidence(self.bones, skeleton.num_joints, dtype=like.dtype)  # (N, B)
        tree = chain_inverse(ends)
        self.seen = (complete @ ends).mT.contiguous()  # (B, No) bones of observed joints: virtual ones follow these
        lines = tree[:n].mT @ complete
        self.lines = (lines - lines.mean(-1, keepdim=True)).mT.contiguous()  # (N, B)
        self.outer = ends.clamp_min(0)  # (N, B) of bones' far ends
        return tree

    def _first_image(self) -> Tensor:
        """The image (H, 2, B, T) of the start."""
        return self._imaged(self._far(self.depth, self.path, self.wide)[0])

    def rows(self, index: Tensor) -> PinholeEnergy:
        """That of some hypotheses."""
        out = copy(self)
        for name in ("path", "wide", "depth", "own", "lengths", "shear", "drift", "lean", "scale", "start"):
            setattr(out, name, getattr(self, name)[index])
        if self.free is not None:
            out.free = self.free[index]
        if isinstance(self.body, PlainBody):
            out.body = self.body.rows(index)
        return out

    def unpack(self, state: Tensor) -> Body:
        """The body that unknowns (H, D) stand for."""
        laid = self._laid(state)
        return Body(laid.depth.mT, laid.lengths, laid.path / laid.wide, 1 / laid.wide[:, 0])

    def __call__(self, state: Tensor) -> tuple[Tensor, Tensor]:
        """The energy of each hypothesis, (H,), and its gradient (H, D)."""
        laid = self._laid(state)
        path, wide, far = laid.path, laid.wide, laid.far
        change = (path / self.path).log()
        distance = path / wide
        value, along = self._steady(distance)
        firm = 0.0 if self.free is None else FIRM * self.free.to(value)
        away = (wide * USUAL / self.path.mean(-1, keepdim=True)).log()  # (H, 1)
        lens = torch.zeros_like(away) if self.usual is None else (wide * self.usual).log()
        unusual = away if self.usual is None else torch.where(away < 0, EASY * away, away)  # slope, in log w
        value = value + firm * (away * unusual + lens.square())[:, 0] / 2
        pulled = firm * (unusual + lens)[:, 0]
        value = value + change.square().mean(-1) / (2 * STRAY**2)
        rays = self.toward * wide[..., None, None]
        cost, slope, growth, drawn, shrink = self.body.with_image(laid.own, laid.lengths, laid.image, rays)
        value, shrink = value + cost, shrink / wide[:, 0]  # in w
        if self.model is not None and self.known:
            value = value - self.model.proportions(laid.lengths)
        n = self.seen.shape[1]
        pull = torch.zeros_like(far)  # in far
        pull[:, :n] = ((self.seen.mT @ drawn) * self.rays[:, :n]).sum(1)
        deep = torch.zeros_like(far)  # in the depth
        if self.model is not None:
            value = value - self._nearness(far, pull)
            if self.model.standing is not None:
                value = value + self._contact(laid, distance, deep, along, shrink)
        free = torch.where(laid.held, 0, pull)
        deep.addcmul_(free, wide[..., None])
        shrink = shrink + (free * laid.depth).sum((1, 2)) - (along * path).sum(-1) / wide[:, 0].square()
        along = along / wide + torch.where(laid.held, NEAREST * pull, pull).sum(1)
        slope = slope + self.lines.mT @ deep
        along = along * path + change / (STRAY**2 * change.shape[-1]) - (self.drift * slope).sum(1)
        parts = [slope.flatten(1), along @ self.waves]
        if not self.known:
            parts.insert(1, growth + (self.shear * slope).sum(-1))
        if self.free is not None:
            parts.append((shrink * wide[:, 0] + pulled - (self.lean * slope).sum((1, 2)))[:, None])
        return value, torch.cat(parts, 1).mul_(self.scale)

    def _laid(self, state: Tensor) -> _Laid:
        """Where the unknowns (H, D) lay bodies."""
        part, grown, shares, focus = (state * self.scale).split(self.sizes, 1)
        change = shares @ self.waves.mT  # (H, T) of the path's logarithm
        moved = part.view_as(self.own) - self.drift * change[:, None]
        lengths, wide = self.lengths, self.wide
        if not self.known:
            moved = moved.addcmul_(self.shear, grown[..., None])
            lengths = lengths * grown.exp()
        if self.free is not None:
            moved = moved.addcmul_(self.lean, focus[..., None], value=-1)
            wide = wide * focus.exp()
        path, depth = self.path * change.exp(), self.depth + self.lines @ moved
        far, held = self._far(depth, path, wide)
        return _Laid(depth, self.own + moved, lengths, path, wide, far, held, self._imaged(far))

    def _far(self, depth: Tensor, path: Tensor, wide: Tensor) -> tuple[Tensor, Tensor]:
        """What rays are multiplied by, (H, N, T), and where joints would come too near."""
        far, least = torch.addcmul(path[:, None], depth, wide[..., None]), NEAREST * path[:, None]
        held = far < least
        return torch.maximum(far, least), held

    def _imaged(self, far: Tensor) -> Tensor:
        """The image of bones under parallel rays, (H, 2, B, T)."""
        n = self.seen.shape[1]
        return self.seen @ (self.rays[:, :n] * far[:, None, :n])

    def _steady(self, distance: Tensor) -> tuple[Tensor, Tensor]:
        """What speed and changes of it cost, (H,), and the slope in the distance (H, T)."""
        quick = (self.rate / SPEED) ** 2 * self.slow / INDEPENDENT
        pull = quick * distance.diff() * self.follows[1:]
        slope = _gathered(pull)
        value = (pull * distance.diff()).sum(-1) / 2
        return value + bend_cost(distance[:, None], self.rough, slope[:, None], self.bends), slope

    def _contact(self, laid: _Laid, distance: Tensor, deep: Tensor, along: Tensor, shrink: Tensor) -> Tensor:
        """What standing feet cost that move along their rays, (H,); adds to slopes in depths, distance and w."""
        model = self.model
        assert model is not None and model.standing is not None
        feet = list(self.skeleton.contacts)
        if not feet or distance.shape[-1] < 2:
            return distance.new_zeros(len(distance))
        slant = self.rays[:, feet].square().sum(0)  # (C, T)
        steep = (1 + laid.wide.square()[..., None] * slant).sqrt()
        where = distance[:, None] + laid.depth[:, feet]
        step = (where * steep).diff()
        both = torch.minimum(model.standing[1:], model.standing[:-1]).mT * model.weights.contact * self.follows[1:]
        ratio = step / model.feet.slip**2
        value = (both * (ratio * step).log1p()).sum((1, 2)) / 2
        pull = both * ratio / (1 + ratio * step)
        drawn = _gathered(pull)
        shrink += (drawn * where * slant / steep).sum((1, 2)) * laid.wide[:, 0]
        drawn = drawn * steep
        deep[:, feet] += drawn
        along += drawn.sum(1)
        return value

    def _nearness(self, far: Tensor, pull: Tensor) -> Tensor:
        """By how much less likely foreshortened images are along rays than under parallel ones, (H,).

        A direction drawn evenly has an image of density 1 / (2 pi L |d|) under parallel rays. With a bone b whose outer
        end is at the distance s along the optical axis, on the ray r = (u, v, 1), it is s^2 / (2 pi L |b . r|): without
        s^2 a body would cost less for being small, and near to the camera. Images are measured by the body's, so that
        energies of other starts, and of other focal lengths, compare. The slope is taken from ``pull``.
        """
        ends = self.outer.mT @ far
        pull -= self.outer @ (2 * self.share / ends)
        return 2 * (self.share * (ends * self.size).log()).sum((1, 2))

    @property
    def sizes(self) -> list[int]:
        """Of bones' depths, lengths, waves and the focal length among the unknowns."""
        frames, bones = self.rays.shape[-1], len(self.bones)
        return [frames * bones, 0 if self.known else bones, self.waves.shape[1], 0 if self.free is None else 1]


def _waves(rays: Tensor, rate: float) -> Tensor:
    """Cosines (T, K) that make up slow changes, the first of them constant, of rays (T, ...)."""
    frames, most = len(rays), math.ceil(2 * FASTEST * len(rays) / rate)
    basis = dct_basis(frames, max(1, min(frames, most)), dtype=rays.dtype, device=rays.device)
    return basis * math.sqrt(frames)


def _gathered(pull: Tensor) -> Tensor:
    """The slope (..., T) in values whose differences have the slope (..., T - 1)."""
    return torch.nn.functional.pad(pull, (1, 0)) - torch.nn.functional.pad(pull, (0, 1))
