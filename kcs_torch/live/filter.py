"""The pose of the newest frame, from what is known of the body and the frames before: causal, O(1) a frame."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import torch
from torch import Tensor

from kcs_torch.functional.chain import bone_vectors
from kcs_torch.live.turn import HIGH, LOW, follow_rotation
from kcs_torch.methods.pkc.limbs import Limb, SignCosts, limbs_of
from kcs_torch.methods.pkc.trunk import TURN, mirror
from kcs_torch.nn.posture import PostureEnergy, trunk_joints
from kcs_torch.skeleton import Skeleton
from kcs_torch.solvers.pose import fit_cameras
from kcs_torch.solvers.sign_filter import SignFilter
from kcs_torch.solvers.signs import sign_table

__all__ = ["BodyFilter", "ChainFilter", "Known", "Shape", "place"]

SWITCH = 8.0
"""Largest cost of the trunk's change of sign from one frame to the next."""

TRUST, MOST = 0.1, 20.0
"""Weight of the limbs' votes for the trunk's sign, and the most that one limb's counts."""

SOLVED = 1.0
"""Cost in a frame of leaving the trunk's sign that a window solve found, and of each limb's."""

STEPS = 5
"""Levenberg-Marquardt steps of the trunk's rotation from frame to frame."""


UNSEEN = 0.02
"""Weight in the trunk's rotation of joints whose place is predicted."""


@dataclass(frozen=True)
class Shape:
    """What is known of a body.

    Attributes:
        factor: units of the template per unit of the tracks.
        lengths: (B,), in units of the template.
        trunk: (trunk joints, 3) in rest, centred; empty where there is no trunk.
    """

    factor: float
    lengths: Tensor
    trunk: Tensor

    def blended(self, before: Shape, share: float) -> Shape:
        """This size with the proportions of an earlier shape, of which this one counts ``share``."""
        positive = (self.lengths > 0) & (before.lengths > 0)
        ratio = torch.where(positive, self.lengths / torch.where(positive, before.lengths, 1.0), 1.0)
        size = ratio[positive].median() if bool(positive.any()) else ratio.new_ones(())
        old = torch.where(positive, before.lengths * size, self.lengths)
        lengths = torch.where(positive, self.lengths**share * old ** (1 - share), self.lengths)
        return Shape(self.factor, lengths, share * self.trunk + (1 - share) * size * before.trunk)


@dataclass(frozen=True)
class Known:
    """What a window solve tells of each frame of a clip.

    Attributes:
        depths: dz (T, B) of the bones, in units of the template.
        rotations: (T, 3, 3) of the trunk, template to camera.
    """

    depths: Tensor
    rotations: Tensor


class _Group:
    """Limbs of equally many bones, side by side."""

    def __init__(self, limbs: Sequence[Limb], posture: PostureEnergy, costs: SignCosts) -> None:
        self.costs = costs
        self.bones = torch.tensor([limb.bones for limb in limbs])  # (J, M)
        self.signs = sign_table(self.bones.shape[1], posture.mean)
        self.mean, self.deviation = posture.mean[self.bones], posture.deviation[self.bones]
        hinges = [(limb.inner, limb.entry if limb.before >= 0 else None) for limb in limbs]
        self.before = torch.tensor([max(limb.before, 0) for limb in limbs])
        self.axes: list[Tensor | None] = []  # (J, 3) times the sign and the root of the weight, of inner and of entry
        for kind in (0, 1):
            rows = []
            for pair in hinges:
                hinge = pair[kind]
                axis = posture.rest.new_zeros(3)
                if hinge is not None:
                    axis = posture.rest[hinge.left] - posture.rest[hinge.right]
                    axis = axis / axis.norm() * (-hinge.sign * math.sqrt(costs.hinge * hinge.firm / 2) / costs.sine)
                rows.append(axis)
            axes = torch.stack(rows)
            self.axes.append(axes if bool(axes.any()) else None)
        self.filter = SignFilter(cap=costs.cap)

    def unary(self, flat: Tensor, near: Tensor, lengths: Tensor, rotations: Tensor) -> tuple[Tensor, Tensor]:
        """Costs (T, J, C, S) of each frame's signs, and depths |dz| (T, J, M).

        Args:
            flat: (T, B, 2) bones' images.
            near: dz (T, B) as it was a frame ago, for the bones before.
            lengths: (B,).
            rotations: (C, T, 3, 3).
        """
        length = lengths[self.bones]
        flat_limbs = flat[:, self.bones]  # (T, J, M, 2)
        depth = (length.square() - flat_limbs.square().sum(-1)).clamp_min(0).sqrt()
        unit, deep = flat_limbs / length[..., None], depth / length
        across = torch.einsum("tjmk,ctki->tcjmi", unit, rotations[..., :2, :])
        along = deep[:, None, ..., None] * rotations[:, :, 2].transpose(0, 1)[:, :, None, None]  # (T, C, J, M, 3)
        a, b = (across - self.mean) / self.deviation, along / self.deviation
        still = (a.square() + b.square()).sum((-1, -2))
        swing = 2 * (a * b).sum(-1)
        unary = (still[..., None] + swing @ self.signs.mT) / (2 * self.costs.posture)  # (T, C, J, S)
        signed = deep[:, :, None] * self.signs  # (T, J, S, M)
        states = len(self.signs)
        full = lambda m: torch.cat(  # noqa: E731
            [unit[:, :, None, m].expand(-1, -1, states, -1), signed[..., m, None]], -1
        )
        if self.axes[0] is not None:
            unary = unary + _bent(torch.linalg.cross(full(0), full(1)), rotations, self.axes[0])
        if self.axes[1] is not None:
            size = lengths[self.before]
            before = torch.cat([flat[:, self.before], near[:, self.before, None]], -1) / size[:, None]
            first = full(0)
            bend = torch.linalg.cross(before[:, :, None].expand_as(first), first)
            unary = unary + _bent(bend, rotations, self.axes[1])
        return unary.transpose(1, 2), depth


def _bent(bend: Tensor, rotations: Tensor, axes: Tensor) -> Tensor:
    """Cost (T, C, J, S) of bends u x v (T, J, S, 3) about axes (J, 3) that turn with the trunk."""
    lateral = rotations @ axes.mT  # (C, T, 3, J)
    return torch.einsum("tjsi,ctij->tcjs", bend, lateral).clamp_min(0).square()


class BodyFilter:
    """Trunk and limbs of a body with a template, followed from frame to frame.

    The trunk is a rigid shape under weak perspective: its rotation follows from the one before, up to the mirror image
    in depth. Each limb keeps the least cost of every combination of signs, for both; the limbs vote on the trunk's.

    Args:
        skeleton: with a template, spreads and a trunk.
        rate: frames a second.
    """

    def __init__(self, skeleton: Skeleton, rate: float) -> None:
        slow = 30.0 / rate
        costs = SignCosts()
        costs = replace(
            costs,
            acceleration=costs.acceleration * slow**2,
            posture=costs.posture / slow,
            foreshortening=costs.foreshortening / slow,
            hinge=costs.hinge * slow,
        )
        self.skeleton, self.costs, self.turn = skeleton, costs, TURN * slow
        self.posture = PostureEnergy(skeleton).double()
        self.trunk = torch.tensor(trunk_joints(skeleton))
        self.limbs = limbs_of(skeleton, self.trunk.tolist())
        self.bones = skeleton.bone_index()
        of_limbs = {b for limb in self.limbs for b in limb.bones}
        self.body = [i not in of_limbs for i in range(skeleton.num_bones)]
        rest = self.posture.rest[self.trunk]
        self.usual = Shape(1.0, self.posture.rest_lengths, rest - rest.mean(0))
        self.reset()

    def reset(self) -> None:
        """Forget all frames."""
        sizes = sorted({len(limb.bones) for limb in self.limbs}, reverse=True)
        self.groups = [_Group([x for x in self.limbs if len(x.bones) == m], self.posture, self.costs) for m in sizes]
        self.rotation: Tensor | None = None
        self.path = torch.zeros(0, 3, 3, dtype=torch.float64)
        self.vote = torch.zeros(2, dtype=torch.float64)
        self.depths = torch.zeros(self.skeleton.num_bones, dtype=torch.float64)
        self.doubt = torch.zeros(self.skeleton.num_bones, dtype=torch.float64)

    def run(
        self, image: Tensor, weights: Tensor, shape: Shape, known: Known | None = None, start: Tensor | None = None
    ) -> Tensor:
        """Take frames and return their bones' dz (T, B), signed, before lengths are enforced.

        Args:
            image: (T, N, 2), complete, in the tracks' units.
            weights: (T, N) confidences, for the trunk.
            shape: of the body.
            known: what a window solve found in these frames; they then start afresh.
            start: (T, 3, 3) rotations of the trunk near by; those known, or the last frame's, if None.
        """
        if known is not None:
            self.reset()
            start = known.rotations
        image = image * shape.factor
        path = self._follow(image, weights, shape, start)
        paths = torch.stack([path, mirror(path)])
        flat = bone_vectors(image, self.bones)
        frames = len(image)
        near = self.depths.expand(frames, -1) if known is None else known.depths
        costs = [group.unary(flat, near, shape.lengths, paths) for group in self.groups]
        if known is not None:
            costs = [(self._told(u, group, known, shape), d) for group, (u, d) in zip(self.groups, costs, strict=True)]
        before = path[:1] if self.rotation is None else self.rotation[None]
        moves = self._moves(torch.cat([before, path]))  # (T, 2, 2)
        rest = torch.zeros(self.skeleton.num_joints, 3, dtype=image.dtype)
        rest[self.trunk] = shape.trunk
        deep = (bone_vectors(rest, self.bones) @ paths[:, :, 2, :, None])[..., 0]  # (2, T, B)
        out = []
        for t in range(frames):
            margins = [
                group.filter.step(unary[t], depth[t] / self.costs.acceleration, moves[t])
                for group, (unary, depth) in zip(self.groups, costs, strict=True)
            ]
            votes = self.vote[:, None] + moves[t]
            self.vote = votes.amin(0)
            for group, margin in zip(self.groups, margins, strict=True):
                if group.axes[0] is not None:
                    self.vote = self.vote + TRUST * margin.amin(-1).clamp_max(MOST).sum(0)
            if known is not None:
                self.vote[1] += SOLVED
            self.vote = self.vote - self.vote.amin()
            side = int(self.vote.argmin())
            other = float(torch.softmax(-self.vote, 0)[1 - side])
            dz, doubt = deep[side, t].clone(), torch.full_like(self.doubt, other)
            for group, (_, depth), margin in zip(self.groups, costs, margins, strict=True):
                sign = group.signs[margin[:, side].argmin(-1)]  # (J, M)
                chance = torch.softmax(-margin[:, side], -1)  # (J, S)
                dz[group.bones] = sign * depth[t]
                doubt[group.bones] = ((1 - sign * (chance @ group.signs)) / 2).clamp(0, 1)
            self.depths, self.doubt = dz, doubt
            out.append(dz)
        self.rotation, self.path = path[-1], path
        return torch.stack(out)

    def _follow(self, image: Tensor, weights: Tensor, shape: Shape, start: Tensor | None) -> Tensor:
        """The trunk's rotations (T, 3, 3), from those near by; from many headings where there are none."""
        frames, weights = len(image), weights[:, self.trunk].clamp_min(UNSEEN)
        goal, rest = image[:, self.trunk], shape.trunk
        if start is None and self.rotation is None:
            one = image.new_ones(frames)
            fit = fit_cameras(goal, rest.expand(frames, -1, 3), weights, LOW * one, HIGH * one, robust=None)
            return fit.rotations[fit.cost.argmin(0), torch.arange(frames)]
        share = (weights / weights.sum(-1, keepdim=True))[..., None]
        y, x = goal - (goal * share).sum(1, keepdim=True), rest - (rest * share).sum(1, keepdim=True)
        gram, moment = x.mT @ (x * share), y.mT @ (x * share)
        out, near = [], self.rotation
        for t in range(frames):
            near = near if start is None else start[t]
            assert near is not None
            near = follow_rotation(gram[t], moment[t], near, num_steps=STEPS)
            out.append(near)
        return torch.stack(out)

    def _moves(self, path: Tensor) -> Tensor:
        """Cost (T, 2, 2) of the trunk's turns between T + 1 rotations and their mirror images."""
        both = torch.stack([path, mirror(path)])
        trace = torch.einsum("atij,btij->tab", both[:, :-1], both[:, 1:])
        angle = torch.arccos(((trace - 1) / 2).clamp(-1, 1))
        return (angle.square() / (2 * self.turn**2)).clamp_max(SWITCH)

    def _told(self, unary: Tensor, group: _Group, known: Known, shape: Shape) -> Tensor:
        """Costs (T, J, C, S) with what it costs to leave the signs that a window solve found."""
        share = (known.depths[:, group.bones] / shape.lengths[group.bones]).clamp(-1, 1)  # (T, J, M)
        against = (-(share[:, :, None] * group.signs)).clamp_min(0).sum(-1)  # (T, J, S)
        return unary + SOLVED * against[:, :, None]


class ChainFilter:
    """Bones of a body without a template: each keeps its length, and its depth's sign until it crosses the image plane.

    Args:
        skeleton: a tree.
        rate: frames a second.
    """

    def __init__(self, skeleton: Skeleton, rate: float) -> None:
        self.skeleton = skeleton
        costs = SignCosts()
        self.cap, self.acceleration = costs.cap, costs.acceleration * (30.0 / rate) ** 2
        self.bones = skeleton.bone_index()
        self.body = [False] * skeleton.num_bones
        self.reset()

    def reset(self) -> None:
        """Forget all frames."""
        self.filter = SignFilter(cap=self.cap)
        self.depths = torch.zeros(self.skeleton.num_bones, dtype=torch.float64)
        self.doubt = torch.full_like(self.depths, 0.5)
        self.path = torch.eye(3, dtype=torch.float64)[None]

    def run(
        self, image: Tensor, weights: Tensor, shape: Shape, known: Known | None = None, start: Tensor | None = None
    ) -> Tensor:
        """Take frames and return their bones' dz (T, B); as :meth:`BodyFilter.run`."""
        if known is not None:
            self.reset()
        size = bone_vectors(image * shape.factor, self.bones).square().sum(-1)
        depth = (shape.lengths.square() - size).clamp_min(0).sqrt()  # (T, B)
        out = []
        for t in range(len(image)):
            unary = torch.zeros(len(self.bones), 1, 2, dtype=torch.float64)
            if known is not None:
                share = known.depths[t] / shape.lengths
                unary = SOLVED * torch.stack([-share, share], -1).clamp_min(0)[:, None]
            margins = self.filter.step(unary, depth[t, :, None] / self.acceleration)[:, 0]
            chance = torch.softmax(-margins, -1)
            sign = torch.where(margins[:, 0] <= margins[:, 1], 1.0, -1.0)
            self.depths, self.doubt = sign * depth[t], chance.amin(-1)
            out.append(self.depths)
        self.path = torch.eye(3, dtype=torch.float64).expand(len(image), 3, 3)
        return torch.stack(out)


def place(
    skeleton: Skeleton, image: Tensor, depths: Tensor, lengths: Tensor, body: Sequence[bool]
) -> tuple[Tensor, Tensor]:
    """Joints (N, 3) whose rigid bones have their length, and their dz (B,), from the root outwards.

    A joint stays where it is seen if its bone reaches so far, else it moves along the line to it. Bones of the trunk
    point where its rotation says.

    Args:
        skeleton: a tree.
        image: (N, 2), in units of the lengths.
        depths: (B,) signed.
        lengths: (B,).
        body: which bones are of the trunk.
    """
    seen, deep, size = image.tolist(), depths.tolist(), lengths.tolist()
    flexible = set(skeleton.flexible)
    joints: list[tuple[float, float, float] | None] = [None] * skeleton.num_joints
    out = [0.0] * skeleton.num_bones
    for bone, near, far, forward in _outwards(skeleton):
        x, y, z = joints[near] = joints[near] or (*seen[near], 0.0)
        u, v = seen[far][0] - x, seen[far][1] - y
        w, length = deep[bone] * forward, size[bone]
        if bone not in flexible:
            flat = math.hypot(u, v)
            if body[bone]:
                whole = math.hypot(flat, w)
                u, v, w = (c * length / whole for c in (u, v, w)) if whole > 0 else (0.0, length, 0.0)
            elif flat >= length:
                share = length / flat if flat > 0 else 0.0
                u, v, w = u * share, v * share, 0.0
            else:
                w = math.copysign(math.sqrt(length * length - flat * flat), w)
        joints[far] = (x + u, y + v, z + w)
        out[bone] = w * forward
    return torch.tensor(joints, dtype=torch.float64), torch.tensor(out, dtype=torch.float64)


@lru_cache(maxsize=64)
def _outwards(skeleton: Skeleton) -> tuple[tuple[int, int, int, float], ...]:
    """(bone, nearer joint, farther joint, +1 or -1 where the bone runs inwards), from the root outwards."""
    children = {b for _, b in skeleton.bones}
    root = next(a for a, _ in skeleton.bones if a not in children)
    done, order = {root}, []
    queue = [root]
    while queue:
        joint = queue.pop(0)
        for i, (a, b) in enumerate(skeleton.bones):
            for near, far, forward in ((a, b, 1.0), (b, a, -1.0)):
                if near == joint and far not in done:
                    done.add(far)
                    queue.append(far)
                    order.append((i, near, far, forward))
    return tuple(order)
