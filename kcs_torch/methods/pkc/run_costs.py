"""What flips of runs of frames cost: many at once, from sums over frames."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from kcs_torch.methods.pkc.objective import Objective

__all__ = ["RunCosts"]

ROWS = 4096
"""Frames of changed solutions that are looked at together."""


class _Frames(NamedTuple):
    """What V solutions count in each frame.

    Attributes:
        sums: (V, T, C) what the objective counts only in sum over frames.
        poses: (V, S, T, K) whitened directions of bones, of which it counts the mean and the scatter as well.
        reach: (V, T, L) how far limbs reach across the body, as a length.
        dz: (V, T, B).
    """

    sums: Tensor
    poses: Tensor
    reach: Tensor
    dz: Tensor

    def one(self, index: int) -> _Frames:
        """Those of one solution, without their first dimension."""
        return _Frames(*(values[index] for values in self))


class RunCosts:
    """Energy of a solution whose bones change the signs of their depths over runs of frames, less that of contacts.

    Of most terms the objective counts sums over frames, and functions of such sums. Those of a run are the sums of a
    solution changed in all frames, within the run, and of the solution itself elsewhere: made once for a part of the
    body, they serve all of its runs. Smoothness adds what the frames at both ends cost.

    Args:
        objective: of one clip.
        own: (T, B) depths of the bones.
        lengths: (B,).
    """

    def __init__(self, objective: Objective, own: Tensor, lengths: Tensor) -> None:
        self.objective, self.own, self.lengths = objective, own, lengths
        self.base = self._frames(own[None])
        self.fixed = torch.cat(list(objective.length_terms(lengths[None]).values())).sum()

    def __call__(self, member: Tensor, starts: Tensor, ends: Tensor, which: Tensor) -> Tensor:
        """Energies (K,) of runs of at least two frames, or of the whole clip.

        Args:
            member: (P, B), 1 for the bones of each part.
            starts: (K,) first frames of runs.
            ends: (K,) the frames after their last ones.
            which: (K,) part that each is of.
        """
        energy = self.own.new_empty(len(which))
        few = max(1, ROWS // len(self.own))
        for k in range(0, len(member), few):
            frames = self._frames(self.own * (1 - 2 * member[k : k + few, None]))
            bends = _Bends(self.base.dz, frames.dz)
            for i in range(len(frames.sums)):
                some = (which == k + i).nonzero().flatten()
                if len(some):
                    first, last = starts[some], ends[some]
                    smooth = bends(i, first, last) / (2 * self.objective.weights.acceleration**2)
                    energy[some] = smooth + self._energy(frames.one(i), first, last)
        return energy

    def _frames(self, own: Tensor) -> _Frames:
        obj, lengths = self.objective, self.lengths.expand(len(own), -1)
        depth = obj.joints(own)
        points = torch.cat([obj.image.expand(*depth.shape, 2), depth[..., None]], -1)
        dz = depth[..., obj.bones[:, 1]] - depth[..., obj.bones[:, 0]]
        hinges = _sized(obj.hinges.bend(points, lengths), points, obj.hinges.joints)
        reach = _sized(-obj.adduction.abduction(points, lengths), points, obj.adduction.joints)
        parts = (
            obj.strayed(dz, lengths),
            obj.hinges.firm.to(own) * hinges[0].clamp_max(0).square(),
            hinges[1],
            reach[1],
            obj.foreshortening.each(dz, lengths, obj.clear).sum(-1, keepdim=True),
        )
        posture = obj.posture
        y = (posture.directions(points, lengths) - posture.mean.to(own)) / posture.deviation.to(own)
        poses = y.flatten(-2)[:, None] @ posture.halves.to(own).mT
        return _Frames(torch.cat(parts, -1), poses, reach[0], dz)

    def _energy(self, frames: _Frames, starts: Tensor, ends: Tensor) -> Tensor:
        """All but smoothness, (R,), of runs of one part, with the frames that are changed throughout."""
        obj, base = self.objective, self.base.one(0)
        count, w = len(self.own), obj.weights
        inside = frames.sums - base.sums
        total = base.sums.sum(0) + _between(inside, starts, ends)
        hinges, limbs = len(obj.hinges.joints), len(obj.adduction.joints)
        strayed, wrong, axes, sides, short = total.split([len(self.lengths), hinges, hinges, limbs, 1], -1)
        value = self.fixed + obj.length_value(strayed, self.lengths[None]) + short[:, 0]
        value = value + w.hinge / w.sine**2 / 2 * (wrong / _known(axes / count)).sum(-1)
        time = torch.arange(count, device=starts.device)
        within = (time >= starts[:, None]) & (time < ends[:, None])
        reach = torch.where(within[..., None], frames.reach, base.reach) / _known(sides / count).sqrt()[:, None]
        over = (reach - obj.adduction.limit).clamp_min(0).square() * obj.adduction.firm.to(reach)
        return value + w.adduction / w.sine**2 / 2 * over.sum((1, 2)) + self._posture(frames.poses, starts, ends)

    def _posture(self, poses: Tensor, starts: Tensor, ends: Tensor) -> Tensor:
        """The posture's energy (R,), from sums and scatters of poses (S, T, K) up to where runs start and end."""
        posture, base = self.objective.posture, self.base.poses[0]
        places, at = torch.cat([starts, ends]).unique(return_inverse=True)
        before = (torch.arange(poses.shape[1], device=places.device) < places[:, None]).to(poses)  # (M, T)
        both, sign = torch.cat([poses, base], 1), torch.cat([before, -before], 1)
        first, last = at.split(len(starts))
        # Up to each place, (S, M, K, K): what the change adds to the scatter.
        added = ((both.mT[:, None] * sign[:, None]).flatten(1, 2) @ both).unflatten(1, (len(places), -1))
        scatter = (base.mT @ base)[:, None] + added[:, last] - added[:, first]  # (S, R, K, K)
        added = sign @ both
        mean = (base.sum(1)[:, None] + added[:, last] - added[:, first]) / poses.shape[1]  # (S, R, K)
        count = poses.shape[1] / posture.correlation
        pull = count * posture.kappa / (count + posture.kappa)
        scatter = scatter / posture.correlation + (pull - count) * mean[..., None] * mean[..., None, :]
        return posture.of_scatter(scatter, count).sum(0)


class _Bends:
    """Sums of squared second differences (T, B) of a solution that is another one (V, T, B) over a run."""

    def __init__(self, base: Tensor, other: Tensor) -> None:
        def cost(a: Tensor, b: Tensor, c: Tensor) -> Tensor:
            """Of sequences whose frames before a middle one, it and those after it are of different solutions."""
            if other.shape[1] < 3:
                return other.new_zeros(other.shape[:2])
            bend = a[:, :-2] - 2 * b[:, 1:-1] + c[:, 2:]
            return torch.nn.functional.pad(bend.square().sum(-1), (1, 1))

        old = cost(base, base, base)
        after, before = (1, 0), (0, 1)  # the frame is the last one before a change, or the first one after it
        pad = torch.nn.functional.pad
        self.begin = pad(cost(base, base, other) - old, after) + pad(cost(base, other, other) - old, before)
        self.end = pad(cost(other, other, base) - old, after) + pad(cost(other, base, base) - old, before)
        self.inside = cost(other, other, other) - old
        self.total = old.sum()

    def __call__(self, index: int, starts: Tensor, ends: Tensor) -> Tensor:
        """(R,) of runs of the solution with this index."""
        least = torch.minimum(starts + 1, ends)
        inner = _between(self.inside[index, :, None], least, torch.maximum(ends - 1, least))[:, 0]
        return self.total + self.begin[index, starts] + inner + self.end[index, ends]


def _between(values: Tensor, starts: Tensor, ends: Tensor) -> Tensor:
    """Sums (R, C) of values (T, C) over runs."""
    summed = torch.nn.functional.pad(values.cumsum(0), (0, 0, 1, 0))
    return summed[ends] - summed[starts]


def _sized(sine: Tensor, points: Tensor, joints: Tensor) -> tuple[Tensor, Tensor]:
    """Sines (V, T, H) times the axes' size in the clip, which they were divided by, and its square in each frame."""
    axis = points[..., joints[:, -2], :] - points[..., joints[:, -1], :]
    square = axis.square().sum(-1)
    return sine * _known(square.mean(-2, keepdim=True)).sqrt(), square


def _known(square: Tensor) -> Tensor:
    """Squares of sizes, 1 where they are 0."""
    return torch.where(square > 0, square, 1)
