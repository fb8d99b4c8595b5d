"""A body before a pinhole camera, and what is found of it: :class:`Scene` and :class:`Bodies`."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from kcs_torch.functional.chain import bone_lengths
from kcs_torch.functional.ranks import median
from kcs_torch.functional.temporal import blend_windows, window_starts
from kcs_torch.methods.clips.lockstep import run
from kcs_torch.methods.perspective.along_rays import AlongRays
from kcs_torch.methods.perspective.pinhole import NEAREST, PinholeEnergy
from kcs_torch.methods.pkc.batch import serve
from kcs_torch.methods.pkc.body import DAMPING, HOLD, Body
from kcs_torch.methods.pkc.fixed_answer import uncertain_signs
from kcs_torch.methods.pkc.flips import flipped, parts_of, promising
from kcs_torch.methods.pkc.hypotheses import Hypotheses
from kcs_torch.methods.pkc.limbs import limbs_of
from kcs_torch.methods.pkc.objective import Objective, bone_noise
from kcs_torch.methods.pkc.run_costs import RunCosts
from kcs_torch.methods.pkc.weights import Weights, at_pace, pace_of
from kcs_torch.nn.posture import has_trunk
from kcs_torch.skeleton import Skeleton
from kcs_torch.solvers.lbfgs import lbfgs
from kcs_torch.solvers.lm import fit_bones

__all__ = ["BLOCK", "GAIN", "STEPS", "Bodies", "Scene", "ahead"]

BLOCK, OVERLAP = 2000, 100
"""Frames of a long clip that are refined together, at most, and by how many blocks overlap."""

STEPS = 60
"""Of L-BFGS, in a refinement."""

FLIPS = 8
"""How often flips are tried at most."""

FEW, GAIN = 3, 1.0
"""How many flips are refined well, and how much cheaper than the best a body must be to be taken, a flip or not."""


@dataclass(frozen=True)
class Bodies:
    """Solutions in the virtual camera's frame: points are rays (u, v, 1) times distance + depth.

    Attributes:
        depth: (H, T, N).
        distance: (H, T).
        energy: (H,).
        origin: (H,) number of the start that each came from.
        focal: (H,) focal length, over that of the rays: of a longer one rays are narrower.
        moved: (H,) root mean square change of depths in the last ten steps, for a body of 1.75.
    """

    depth: Tensor
    distance: Tensor
    energy: Tensor
    origin: Tensor
    focal: Tensor
    moved: Tensor

    def __getitem__(self, index: Tensor | slice) -> Bodies:
        return Bodies(*(value[index] for value in vars(self).values()))

    def joined(self, other: Bodies) -> Bodies:
        """Both together, best first."""
        pairs = zip(vars(self).values(), vars(other).values(), strict=True)
        both = Bodies(*(torch.cat(pair) for pair in pairs))
        return both[both.energy.argsort()]

    def held(self, begin: int, frames: int) -> Bodies:
        """Bodies of so many frames that are as these from frame ``begin`` on, and as at their ends before and after."""
        index = (torch.arange(frames, device=self.depth.device) - begin).clamp(0, self.depth.shape[1] - 1)
        return replace(self, depth=self.depth[:, index], distance=self.distance[:, index])


@dataclass(frozen=True)
class Scene:
    """A body seen along rays.

    Attributes:
        skeleton: of the body.
        rays: (T, N, 2), complete.
        noise: (T, N) standard deviation of joints in the image, for a body of 1.75.
        rate: frames a second.
        unit: the length that 1 stands for in a body of 1.75, in units of the distance.
        standing: (T, C) how surely the skeleton's contact points stand still, or None where nothing tells.
        cuts: first frames of all shots of the film but the first.
        any_focal: whether the focal length is to be found, too.
        usual: focal length of usual lenses, over that of the rays; None where nothing tells.
    """

    skeleton: Skeleton
    rays: Tensor
    noise: Tensor
    rate: float
    unit: float
    standing: Tensor | None
    cuts: tuple[int, ...] = ()
    any_focal: bool = False
    usual: float | None = None

    def during(self, time: slice) -> Scene:
        """That of some frames."""
        standing = None if self.standing is None else self.standing[time]
        return replace(self, rays=self.rays[time], noise=self.noise[time], standing=standing, cuts=self._cuts(time))

    def _cuts(self, time: slice) -> tuple[int, ...]:
        """The cuts within some frames, counted from their first."""
        return tuple(cut - time.start for cut in self.cuts if time.start < cut < time.stop)

    def refined(
        self,
        distance: Tensor,
        depth: Tensor,
        focal: Tensor | None = None,
        *,
        steps: int = STEPS,
        same_focal: bool = False,
    ) -> Bodies:
        """Bodies of least :class:`PinholeEnergy`, each from its own start, best first.

        Memory is for as much as a block of a long clip. The liveliest block tells the lengths of the others, whose
        distances follow; blocks are blended, and their energies summed.

        Args:
            distance: (T,) that the starts were found with.
            depth: (H, T, N) starts.
            focal: (1,) that the starts were found with, over that of the rays; 1 if None.
            steps: of L-BFGS.
            same_focal: whether the focal length stays.
        """
        frames = len(self.rays)
        count = max(1, math.ceil((frames - OVERLAP) / (BLOCK - OVERLAP)))
        size = math.ceil((frames + (count - 1) * OVERLAP) / count)
        begins = window_starts(frames, size, min(OVERLAP, size - 1))
        focal = torch.ones_like(depth[:, 0, 0]) if focal is None else focal.expand(len(depth))
        path = distance / focal[0] / self.unit
        image = (self.rays * distance[:, None, None]).unfold(0, size, 1)[begins]  # (W, N, 2, T)
        lively = image.diff(dim=-1).square().sum((1, 2))
        free = self.any_focal and not same_focal
        z = depth.new_empty(len(begins), size, *depth[:, 0].shape)
        far = depth.new_empty(len(begins), size, len(depth))
        energy, moved, lengths = depth.new_zeros(len(depth)), depth.new_zeros(len(depth)), None
        for i in median(lively, -1).argsort(descending=True).tolist() if len(begins) > 1 else [0]:
            some = slice(begins[i], begins[i] + size)
            feet = None if self.standing is None else self.standing[some]
            lens = focal, torch.full_like(focal, free and lengths is None, dtype=torch.bool)
            pinhole = PinholeEnergy(
                self.skeleton, self.rays[some], path[some], depth[:, some] / self.unit, self.rate, self.noise[some],
                lengths, feet, lens if self.any_focal else None, self.usual, self._cuts(some),
            )  # fmt: skip
            solution = lbfgs(pinhole, pinhole.start, num_steps=steps, tolerance=1e-6, slopes=True, part=pinhole.rows)
            assert solution.energy is not None and solution.before is not None
            with torch.no_grad():
                body, before = pinhole.unpack(solution.value), pinhole.unpack(solution.before)
            if lengths is None:
                lengths, focal = body.lengths, body.focal
            energy = energy + solution.energy
            moved = moved + (body.depth - before.depth).square().mean((1, 2)) / len(begins)
            middle = body.depth.mean(-1, keepdim=True)
            z[i] = ((body.depth - middle) * self.unit).transpose(0, 1)
            far[i] = ((body.distance + middle[..., 0]) * self.unit).mT
        z, far = (x[0] if len(begins) == 1 else blend_windows(x, begins, frames) for x in (z, far))
        order = energy.argsort()
        number = torch.arange(len(energy), device=z.device)
        return Bodies(z.transpose(0, 1), far.mT, energy, number, focal, moved.sqrt())[order]

    def turned_over(self, found: Bodies) -> Bodies:
        """Bodies, best first, whose best one no flip of a run of its signs makes better.

        Straightened tracks agree with what is wrong in the depths that straightened them, so that no method finds it.
        Flips (:func:`kcs_torch.methods.pkc.flips.flipped`) whose joints stay on their rays (:class:`AlongRays`) are
        therefore refined under perspective. Bodies without a template, and clips of several blocks, are left as they
        are.
        """
        if not has_trunk(self.skeleton) or len(self.rays) > BLOCK or not bool(found.energy[0].isfinite()):
            return found
        for _ in range(FLIPS):
            better = self._better(found[:1], self._flips(found[:1]))
            if better is None:
                break
            found = found.joined(better)
        return found

    def _better(self, best: Bodies, depth: Tensor) -> Bodies | None:
        """The best body that depths (H, T, N) lead to, if it is better.

        They are refined a little, and a few of those that are already better then well.
        """
        if not len(depth):
            return None
        distance = best.distance[0]
        tried = self.refined(distance, depth, best.focal, steps=STEPS // 3)[:FEW]
        tried = tried[tried.energy < best.energy]
        if not len(tried.energy):
            return None
        better = self.refined(distance, tried.depth, best.focal)[:1]
        return replace(better, origin=best.origin) if bool(better.energy < best.energy - GAIN) else None

    def polished(self, found: Bodies) -> Bodies:
        """Bodies, the best polished on the image that its own depths make (:meth:`Body.polished`).

        Polishing moves joints by a few centimetres at most, of the image hardly more than a thousandth of that.
        """
        best = found[:1]
        body = Body(self.skeleton, self._image(best), self.rate, self.noise)
        if not body.spanned or not bool(best.depth.any()):
            return found
        depth = best.depth / self.unit * body.factor
        points = torch.cat([body.image[None], depth[..., None]], -1)
        lengths = median(bone_lengths(points, body.objective.bones), 1)
        now = Hypotheses(depth, lengths, body.objective(depth, lengths))
        better = run(body.polished(now, STEPS), serve).depth / body.factor * self.unit
        return replace(found, depth=torch.cat([better, found.depth[1:]]))

    def points(self, found: Bodies, k: int) -> Tensor:
        """Joints (T, N, 3) of body number ``k`` along the scene's rays, its bones as constant as noise allows.

        Where the image is exact joints stay on their rays. Else they move by the least that makes rigid bones constant,
        as :meth:`Body.bodies` does under parallel rays.
        """
        far = ahead(found.distance[k], found.depth[k])[..., None]
        points = torch.cat([self.rays * far, far], -1)
        rigid = torch.tensor(self.skeleton.rigid, dtype=torch.long, device=points.device)
        if not len(rigid) or not bool((self.noise > 0).any()):
            return points
        bones = self.skeleton.bone_index(device=points.device)[rigid]
        stiffness = (bone_noise(self.noise, bones) / Weights().length).square()
        middle = points.mean(-2, keepdim=True)
        body = (points - middle) / self.unit
        lengths = median(bone_lengths(body, bones), 0)
        held = []
        for some, stiff in zip(body.split(BLOCK), stiffness.split(BLOCK), strict=True):  # each frame by itself
            goal = lengths.expand(len(some), -1)
            held.append(fit_bones(some, goal, bones, stiffness=stiff, num_steps=HOLD, damping=DAMPING))
        body = torch.cat(held)
        return (body - body.mean(-2, keepdim=True)) * self.unit + middle

    def uncertain(self, found: Bodies) -> list[str]:
        """What is said of bones whose depth has another sign in a close rival of the best body."""
        depth = found.depth / self.unit
        points = torch.cat([self._image(found[:1])[None], depth[:1, ..., None]], -1)
        lengths = median(bone_lengths(points, self.skeleton.bone_index(device=depth.device)), 1)
        return uncertain_signs(Hypotheses(depth, lengths, found.energy), self.skeleton)

    def _image(self, best: Bodies) -> Tensor:
        """The image (T, N, 2) of a single body under parallel rays, in its unit."""
        image = (self.rays / best.focal * ahead(best.distance, best.depth)[..., None])[0] / self.unit
        return image - image.mean(-2, keepdim=True)

    def _flips(self, best: Bodies) -> Tensor:
        """Depths (H, T, N) of one body with promising runs of signs turned over."""
        depth, image = best.depth / self.unit, self._image(best)
        weights = at_pace(Weights(), self.rate, pace_of(image, self.skeleton, self.rate))
        objective = Objective(self.skeleton, image, weights, self.noise, standing=self.standing)
        points = torch.cat([image[None], depth[..., None]], -1)
        lengths = median(bone_lengths(points, objective.bones), 1)
        parts = parts_of(self.skeleton, limbs_of(self.skeleton, objective.posture.trunk.tolist()))
        body = AlongRays(objective, self.rays / float(best.focal), best.distance[0] / self.unit, depth[0])
        energy = RunCosts(objective, body, lengths[0]).unchanged + objective.ranking(depth, lengths)
        now = Hypotheses(depth, lengths, energy)
        tried = flipped(objective, parts, now, body)
        return tried.depth[promising(tried, now)] * self.unit


def ahead(distance: Tensor, depth: Tensor) -> Tensor:
    """Distance + depth (..., T, N), positive."""
    return torch.maximum(distance[..., None] + depth, NEAREST * distance[..., None])
