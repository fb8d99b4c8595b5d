"""What flips of runs of frames cost: many at once, from sums over frames."""

from __future__ import annotations

from typing import NamedTuple, Protocol

import torch
from torch import Tensor

from kcs_torch.functional.chain import bone_vectors
from kcs_torch.functional.guarded import or_one
from kcs_torch.methods.pkc.objective import Objective

__all__ = ["Flipped", "ParallelRays", "RunCosts", "Runs", "Turnable", "inside"]

ROWS = 1024
"""Frames of changed solutions that are looked at together."""

BLOCK = 16
"""Frames whose scatter is summed at once: what a run's end cuts off is summed for itself."""


class Runs(NamedTuple):
    """Runs of frames over which parts of a body change their signs.

    Attributes:
        places: (P, M) frames from which on each part's signs may change, ascending; T where there are fewer.
        part: (K,) that each run is of.
        first: (K,) index of the place at which it starts.
        last: (K,) index of the place at which it has ended.
    """

    places: Tensor
    part: Tensor
    first: Tensor
    last: Tensor

    @property
    def starts(self) -> Tensor:
        """First frames (K,)."""
        return self.places[self.part, self.first]

    @property
    def ends(self) -> Tensor:
        """The frames after the last ones (K,)."""
        return self.places[self.part, self.last]

    def some(self, index: Tensor) -> Runs:
        """Some of the runs."""
        return Runs(self.places, self.part[index], self.first[index], self.last[index])

    def of(self, parts: slice) -> tuple[Runs, Tensor]:
        """The runs of some parts, which are numbered anew, and their indices."""
        found = ((self.part >= parts.start) & (self.part < parts.stop)).nonzero().flatten()
        runs = self.some(found)
        return runs._replace(places=self.places[parts], part=runs.part - parts.start), found


class Flipped(NamedTuple):
    """K bodies whose bones have other signs of depth.

    Attributes:
        depth: (K, T, N), centred.
        image: (T, N, 2), or (K, T, N, 2) of each, under parallel rays.
        ahead: (K, T, B) what the rays of bones' outer ends add to the depths along them; None under parallel rays.
        far: (K, T, B) distances of the outer ends, over the body's; None under parallel rays.
    """

    depth: Tensor
    image: Tensor
    ahead: Tensor | None = None
    far: Tensor | None = None

    def foreshortened(self, objective: Objective, lengths: Tensor) -> Tensor:
        """What it costs that bones of lengths (B,) look as short as they do, (K, T)."""
        dz = bone_vectors(self.depth[..., None], objective.bones)[..., 0]
        deep = dz if self.ahead is None else dz + self.ahead
        each = objective.foreshortening.each(deep, lengths.expand(len(dz), -1), objective.clear, objective.noise)
        return (each if self.far is None else each - 2 * objective.independent * self.far.log()).sum(-1)


class Turnable(Protocol):
    """A body whose bones may have other signs of depth.

    Attributes:
        own: (T, B) signed depths of bones.
    """

    @property
    def own(self) -> Tensor: ...

    def turned(self, signs: Tensor) -> Flipped:
        """Bodies with signs (K, T or 1, B) turned."""
        ...


class ParallelRays(NamedTuple):
    """A body under parallel rays: whatever the depths, its image is the same."""

    objective: Objective
    own: Tensor

    def turned(self, signs: Tensor) -> Flipped:
        return Flipped(self.objective.joints(self.own * signs), self.objective.image)


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


class RunCosts:
    """Energy of a solution whose bones change the signs of their depths over runs of frames, less that of contacts.

    Of most terms the objective counts sums over frames, and functions of such sums. Those of a run are the sums of a
    solution changed in all frames, within the run, and of the solution itself elsewhere: made once for a part of the
    body, they serve all of its runs. Smoothness adds what the frames at both ends cost.

    Args:
        objective: of one clip.
        body: the solution.
        lengths: (B,).
    """

    def __init__(self, objective: Objective, body: Turnable, lengths: Tensor) -> None:
        self.objective, self.body, self.lengths = objective, body, lengths
        self.base = self._frames(torch.ones_like(body.own[None, :1]))
        self.fixed = torch.cat(list(objective.length_terms(lengths[None]).values())).sum()

    def __call__(self, member: Tensor, runs: Runs) -> Tensor:
        """Energies (K,) of runs of at least two frames, or of the whole clip; members (P, B) are 1 for parts' bones."""
        energy = self.lengths.new_empty(len(runs.part))
        few = max(1, ROWS // len(self.body.own))
        for k in range(0, len(member), few):
            some, index = runs.of(slice(k, k + few))
            energy[index] = self._energy(self._frames(1 - 2 * member[k : k + few, None]), some)
        return energy

    @property
    def unchanged(self) -> Tensor:
        """The energy (1,) of the solution itself."""
        places = torch.tensor([[0, len(self.body.own)]], device=self.lengths.device)
        first = places[:, 0]
        return self._energy(self.base, Runs(places, first, first, first + 1))

    def _frames(self, signs: Tensor) -> _Frames:
        obj, lengths = self.objective, self.lengths.expand(len(signs), -1)
        turned = self.body.turned(signs)
        depth, image = turned.depth, turned.image
        flat = obj.flat if image is obj.image else bone_vectors(image, obj.bones).square().sum(-1)
        points = torch.cat([image.expand(*depth.shape, 2), depth[..., None]], -1)
        dz = depth[..., obj.bones[:, 1]] - depth[..., obj.bones[:, 0]]
        hinges = _sized(obj.hinges.bend(points, lengths), points, obj.hinges.joints)
        reach = _sized(-obj.adduction.abduction(points, lengths), points, obj.adduction.joints)
        parts = (
            obj.strayed(dz, lengths, flat),
            obj.hinges.firm.to(depth) * hinges[0].clamp_max(0).square(),
            hinges[1],
            reach[1],
            obj.stance.strayed(points, 1.0)[..., None],
            turned.foreshortened(obj, self.lengths)[..., None],
        )
        posture = obj.posture
        y = (posture.directions(points, lengths) - posture.mean.to(depth)) / posture.deviation.to(depth)
        return _Frames(torch.cat(parts, -1), posture.taken_apart(y.flatten(-2)), reach[0], dz)

    def _energy(self, frames: _Frames, runs: Runs) -> Tensor:
        """(K,) of runs of parts, with the frames of solutions in which these are changed throughout."""
        obj, base = self.objective, self.base
        count, w = len(self.body.own), obj.weights
        total = base.sums.sum(1) + _between(frames.sums - base.sums, runs.part, runs.starts, runs.ends)
        hinges, limbs = len(obj.hinges.joints), len(obj.adduction.joints)
        strayed, wrong, axes, sides, feet, short = total.split([len(self.lengths), hinges, hinges, limbs, 1, 1], -1)
        value = self.fixed + obj.length_value(strayed, self.lengths[None]) + short[:, 0]
        value = value + w.hinge / w.sine**2 / 2 * (wrong / or_one(axes / count)).sum(-1)
        reach = torch.where(inside(runs, count)[..., None], frames.reach[runs.part], base.reach)
        over = (reach / or_one(sides / count).sqrt()[:, None] - obj.adduction.limit).clamp_min(0).square()
        value = value + w.adduction / w.sine**2 / 2 * (over * obj.adduction.firm.to(over)).sum((1, 2))
        value = value + w.stance / 2 * torch.log1p(feet[:, 0] / (count * obj.stance.sway**2))
        bends = _bends(base.dz, frames.dz, runs.part, runs.starts, runs.ends)
        return value + bends / (2 * w.acceleration**2) + self._posture(frames.poses, runs)

    def _posture(self, poses: Tensor, runs: Runs) -> Tensor:
        """The posture's energy (K,), from sums and scatters of poses (V, S, T, K) within each run."""
        posture, base = self.objective.posture, self.base.poses
        frames = poses.shape[2]
        change, twice = poses - base, poses + base
        added = _products(change, twice, runs)  # what y' y gains is, of its two factors, the symmetric part
        scatter = base.mT @ base + (added + added.mT) / 2  # (K, S, K, K)
        change = change.transpose(1, 2).flatten(2)  # (V, T, S K)
        moved = _between(change, runs.part, runs.starts, runs.ends).unflatten(1, base.shape[1::2])
        mean = (base.sum(2) + moved) / frames  # (K, S, K)
        count = frames / posture.correlation
        pull = count * posture.kappa / (count + posture.kappa)
        scatter = scatter / posture.correlation + (pull - count) * mean[..., None] * mean[..., None, :]
        return posture.of_scatter(scatter, count).sum(-1)


def inside(runs: Runs, frames: int) -> Tensor:
    """Which of the frames are within each run, (K, T)."""
    time = torch.arange(frames, device=runs.part.device)
    return (time >= runs.starts[:, None]) & (time < runs.ends[:, None])


def _bends(base: Tensor, other: Tensor, part: Tensor, starts: Tensor, ends: Tensor) -> Tensor:
    """Sums (K,) of squared second differences of a solution (1, T, B) that is another one (V, T, B) over runs."""
    if other.shape[1] < 3:
        return other.new_zeros(len(part))

    def cost(before: Tensor, middle: Tensor, after: Tensor) -> Tensor:
        """(V, T) of frames that are of one solution each with those before and after them."""
        bend = before[:, :-2] - 2 * middle[:, 1:-1] + after[:, 2:]
        return torch.nn.functional.pad(bend.square().sum(-1), (1, 1))

    old, pad = cost(base, base, base), torch.nn.functional.pad
    later, sooner = (1, 0), (0, 1)  # the frame is the last one before a change, or the first one after it
    begin = pad(cost(base, base, other) - old, later) + pad(cost(base, other, other) - old, sooner)
    end = pad(cost(other, other, base) - old, later) + pad(cost(other, base, base) - old, sooner)
    least = torch.minimum(starts + 1, ends)
    inner = _between((cost(other, other, other) - old)[..., None], part, least, torch.maximum(ends - 1, least))
    return old.sum() + begin[part, starts] + inner[:, 0] + end[part, ends]


def _between(values: Tensor, part: Tensor, starts: Tensor, ends: Tensor) -> Tensor:
    """Sums (K, C) of values (V, T, C) over runs."""
    summed = torch.nn.functional.pad(values.cumsum(1), (0, 0, 1, 0))
    return summed[part, ends] - summed[part, starts]


def _products(left: Tensor, right: Tensor, runs: Runs) -> Tensor:
    """Products (K, S, C, C) of columns (V, S, T, C) within runs."""
    places = runs.places.shape[1]
    ends = runs.part * places + torch.stack([runs.first, runs.last])
    needed, index = ends.unique(return_inverse=True)  # of few runs or of many, most begin and end where others do
    part, place = needed // places, runs.places.flatten()[needed]
    short = BLOCK - left.shape[2] % BLOCK  # one block more than there are, or less: the last place is T
    left, right = (
        torch.nn.functional.pad(x, (0, 0, 0, short)).unflatten(2, (-1, BLOCK)).transpose(1, 2) for x in (left, right)
    )
    whole = torch.nn.functional.pad((left.mT @ right).cumsum(1)[:, :-1], (0, 0) * 3 + (1, 0))  # (V, T', S, C, C)
    within = torch.arange(BLOCK, device=place.device) < (place % BLOCK)[:, None]
    at = part, place // BLOCK
    before = whole[at] + (left[at] * within[:, None, :, None]).mT @ right[at]
    return before[index[1]] - before[index[0]]


def _sized(sine: Tensor, points: Tensor, joints: Tensor) -> tuple[Tensor, Tensor]:
    """Sines (V, T, H) times the axes' size in the clip, which they were divided by, and its square in each frame."""
    axis = points[..., joints[:, -2], :] - points[..., joints[:, -1], :]
    square = axis.square().sum(-1)
    return sine * or_one(square.mean(-2, keepdim=True)).sqrt(), square
