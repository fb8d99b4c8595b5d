"""The pose of the newest frame, from what is known of the body and the frames before: causal, O(1) a frame."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from kcs_torch.functional.chain import bone_vectors
from kcs_torch.methods.pkc.limbs import Limb, SignCosts, limbs_of
from kcs_torch.methods.pkc.trunk import TURN, mirror
from kcs_torch.nn.posture import PostureEnergy
from kcs_torch.skeleton import Skeleton
from kcs_torch.solvers.pose import fit_cameras
from kcs_torch.solvers.sign_filter import SignFilter
from kcs_torch.solvers.signs import sign_table

__all__ = ["BodyFilter", "ChainFilter", "Shape", "Told"]

SWITCH = 8.0
"""Largest cost of the trunk's change of sign from one frame to the next."""

TRUST, MOST = 0.1, 20.0
"""Weight of the limbs' votes for the trunk's sign, and the most that one limb's counts."""

SOLVED = 1.0
"""Cost in a frame of leaving the trunk's sign that a window solve found, and of each limb's."""

LOW, HIGH, STEPS = 0.9, 1.1, 2
"""Bounds of the trunk's scale in a frame, over the body's, and Levenberg-Marquardt steps of its rotation."""

UNSEEN = 0.02
"""Weight in the trunk's rotation of joints whose place is predicted."""


@dataclass(frozen=True)
class Shape:
    """What is known of a body.

    Attributes:
        factor: units of the template per unit of the tracks.
        lengths: (B,), in units of the template.
        trunk: (trunk joints, 3) in rest, centred; empty where there is no trunk.
        usual: log of how long bones usually look that hardly tilt, over their lengths.
        deviation: (N,) standard deviation of the joints' depths, in units of the template; None where no
            window has told it.
    """

    factor: float
    lengths: Tensor
    trunk: Tensor
    usual: float = 0.0
    deviation: Tensor | None = None

    def blended(self, before: Shape, share: float) -> Shape:
        """This size with the proportions of an earlier shape, of which this one counts ``share``."""
        tiny = torch.finfo(self.lengths.dtype).tiny
        lengths = self.lengths.clamp_min(tiny) ** share * before.lengths.clamp_min(tiny) ** (1 - share)
        return replace(self, lengths=lengths, trunk=torch.lerp(before.trunk, self.trunk, share))

    def sized(self, size: float) -> Shape:
        """The same body, larger in the image by the log ``size``."""
        return replace(self, factor=self.factor * math.exp(-size))


@dataclass(frozen=True)
class Told:
    """What a window solve says of frames.

    Attributes:
        depths: dz (T, B) of the bones, in units of the template.
        rotations: (T, 3, 3) of the trunk, template to camera.
        sizes: (T,) log of the body's size in the image, over that of the last frame.
    """

    depths: Tensor
    rotations: Tensor
    sizes: Tensor

    def __getitem__(self, index: int) -> Told:
        """What is said of one frame."""
        return Told(self.depths[index], self.rotations[index], self.sizes[index])


class _Group:
    """J limbs of M bones each, side by side."""

    def __init__(self, limbs: Sequence[Limb], posture: PostureEnergy, costs: SignCosts) -> None:
        self.bones = torch.tensor([limb.bones for limb in limbs])  # (J, M)
        self.signs = sign_table(self.bones.shape[1], posture.mean)  # (S, M)
        self.filter = SignFilter(cap=costs.cap)
        axes = posture.rest.new_zeros(len(limbs), 3)  # lateral, times the sign and the root of the weight
        for axis, limb in zip(axes, limbs, strict=True):
            if limb.inner is not None:
                across = posture.rest[limb.inner.left] - posture.rest[limb.inner.right]
                weight = math.sqrt(costs.hinge * limb.inner.firm / 2) / costs.sine
                axis.copy_(across / across.norm() * (-limb.inner.sign * weight))
        self.axes = axes if bool(axes.any()) else None

    def hinges(self, unit: Tensor, deep: Tensor, rotations: Tensor) -> Tensor | float:
        """Cost (C, J, S) of hinges that bend the wrong way.

        Args:
            unit: (B, 2) images of the bones over their lengths.
            deep: (B,) depths over lengths, without sign.
            rotations: (C, 3, 3) of the trunk.
        """
        if self.axes is None:
            return 0.0
        count = len(self.signs)
        first, second = (
            torch.cat([unit[bones, None].expand(-1, count, -1), (deep[bones, None] * self.signs[:, m])[..., None]], -1)
            for m, bones in enumerate(self.bones.mT[:2])
        )
        lateral = rotations @ self.axes.mT  # (C, 3, J)
        return torch.einsum("jsi,cij->cjs", torch.linalg.cross(first, second), lateral).clamp_min(0).square()


class BodyFilter:
    """Trunk and limbs of a body with a template, followed from frame to frame.

    The trunk is a rigid shape under weak perspective: its rotation follows from the one before, up to the mirror image
    in depth. Each limb keeps the least cost of every combination of signs, for both; the limbs vote on the trunk's.

    Args:
        skeleton: with a template, spreads and a trunk.
        rate: frames a second.

    Attributes:
        body: (B,) bool, bones of the trunk.
        doubt: (B,) chance that the sign of a bone's depth is wrong.
        size: log of the trunk's size in the newest frame, over the body's; NaN where the frame does not tell it.
    """

    size: float | None

    def __init__(self, skeleton: Skeleton, rate: float) -> None:
        slow = 30.0 / rate
        costs = SignCosts()
        self.costs = replace(
            costs,
            acceleration=costs.acceleration * slow**2,
            posture=costs.posture / slow,
            hinge=costs.hinge * slow,
        )
        self.turn = TURN * slow
        self.posture = PostureEnergy(skeleton).double()
        self.limbs = limbs_of(skeleton, self.posture.trunk.tolist())
        self.bones = skeleton.bone_index()
        self.body = torch.ones(skeleton.num_bones, dtype=torch.bool)
        self.body[[b for limb in self.limbs for b in limb.bones]] = False
        self.reset()

    def reset(self) -> None:
        """Forget all frames."""
        sizes = sorted({len(limb.bones) for limb in self.limbs}, reverse=True)
        self.groups = [_Group([x for x in self.limbs if len(x.bones) == m], self.posture, self.costs) for m in sizes]
        self.rotation: Tensor | None = None
        self.size = math.nan
        self.vote = self.posture.rest.new_zeros(2)
        self.doubt = self.posture.rest.new_zeros(len(self.bones))

    def guess(self, longest: Tensor) -> Shape:
        """The template, where nothing else is known, given the scale (B,) of bones' longest images over the usual."""
        rest = self.posture.rest[self.posture.trunk]
        scale = float(torch.quantile(longest / self.posture.rest_lengths.clamp_min(1e-9), 0.6))
        return Shape(1 / scale if scale > 0 else 1.0, self.posture.rest_lengths, rest - rest.mean(0))

    def step(self, image: Tensor, weights: Tensor, shape: Shape, told: Told | None = None) -> Tensor:
        """Take a frame and return its bones' dz (B,), signed, in units of the template.

        Args:
            image: (N, 2), complete, in the tracks' units.
            weights: (N,) confidences, for the trunk.
            shape: of the body.
            told: what a window solve says of this frame, dz (B,) and rotation (3, 3), or None.
        """
        image = image * shape.factor
        before, self.size = self.rotation, math.nan
        self.rotation = self._turned(image, weights, shape) if told is None else told.rotations
        both = torch.stack([self.rotation, mirror(self.rotation)])  # (2, 3, 3)
        moves = self._moves(self.rotation if before is None else before, both)
        unit = bone_vectors(image, self.bones) / shape.lengths[:, None]  # (B, 2)
        deep = (1 - unit.square().sum(-1)).clamp_min(0).sqrt()  # (B,), without sign
        # Seen from the trunk a direction is R_xy^T (x, y) + R_z^T z: parts that all signs share but for the sign.
        across = (unit @ both[:, :2] - self.posture.mean) / self.posture.deviation  # (2, B, 3)
        along = deep[:, None] * both[:, 2, None] / self.posture.deviation
        still, swing = (across.square() + along.square()).sum(-1), 2 * (across * along).sum(-1)
        votes = self.vote[:, None] + moves
        self.vote = votes.amin(0)
        margins = []
        for group in self.groups:
            fit = still[:, group.bones].sum(-1)[..., None] + swing[:, group.bones] @ group.signs.mT  # (2, J, S)
            unary = fit / (2 * self.costs.posture) + group.hinges(unit, deep, both)
            if told is not None:
                share = (told.depths / shape.lengths)[group.bones].clamp(-1, 1)
                unary = unary + SOLVED * (-(share[:, None] * group.signs)).clamp_min(0).sum(-1)
            depth = (deep * shape.lengths)[group.bones] / self.costs.acceleration
            margins.append(group.filter.step(unary.transpose(0, 1), depth, moves))  # (J, 2, S)
            if group.axes is not None:
                self.vote = self.vote + TRUST * margins[-1].amin(-1).clamp_max(MOST).sum(0)
        if told is not None:
            self.vote[1] += SOLVED
        self.vote = self.vote - self.vote.amin()
        side = int(self.vote.argmin())
        self.doubt = torch.full_like(deep, float(torch.softmax(-self.vote, 0)[1 - side]))
        rest = image.new_zeros(len(image), 3).index_copy(0, self.posture.trunk, shape.trunk)
        dz = bone_vectors(rest, self.bones) @ both[side, 2]
        for group, margin in zip(self.groups, margins, strict=True):
            sign = group.signs[margin[:, side].argmin(-1)]  # (J, M)
            likely = torch.softmax(-margin[:, side], -1) @ group.signs
            dz[group.bones] = sign * (deep * shape.lengths)[group.bones]
            self.doubt[group.bones] = ((1 - sign * likely) / 2).clamp(0, 1)
        return dz

    def _turned(self, image: Tensor, weights: Tensor, shape: Shape) -> Tensor:
        """The trunk's rotation (3, 3), from the one before; from many headings where there is none."""
        joints = self.posture.trunk
        goal, rest, share = image[None, joints], shape.trunk[None], weights[None, joints].clamp_min(UNSEEN)
        low, high = image.new_tensor([[LOW], [HIGH]])
        if self.rotation is None:
            fit = fit_cameras(goal, rest, share, low, high, robust=None)
            return fit.rotations[fit.cost[:, 0].argmin(), 0]
        start = self.rotation[None]
        fit = fit_cameras(goal, rest, share, low, high, robust=None, start=start, num_yaws=1, num_steps=STEPS)
        if bool((weights[joints] > 0).all()):
            self.size = math.log(float(fit.scales[0, 0]))
        return fit.rotations[0, 0]

    def _moves(self, before: Tensor, both: Tensor) -> Tensor:
        """Cost (2, 2) of the trunk's turn from a rotation or its mirror image to each of both."""
        trace = torch.einsum("aij,bij->ab", torch.stack([before, mirror(before)]), both)
        angle = torch.arccos(((trace - 1) / 2).clamp(-1, 1))
        return (angle.square() / (2 * self.turn**2)).clamp_max(SWITCH)


class ChainFilter:
    """Bones of a body without a template: each keeps its length, and its depth's sign until it crosses the image plane.

    Args:
        skeleton: a tree.
        rate: frames a second.

    Attributes:
        body: (B,) bool, all False: there is no trunk.
        doubt: (B,) chance that the sign of a bone's depth is wrong.
        size: None: there is no trunk that tells it.
    """

    size: float | None = None

    def __init__(self, skeleton: Skeleton, rate: float) -> None:
        costs = SignCosts()
        self.cap, self.acceleration = costs.cap, costs.acceleration * (30.0 / rate) ** 2
        self.bones = skeleton.bone_index()
        self.body = torch.zeros(skeleton.num_bones, dtype=torch.bool)
        self.reset()

    def reset(self) -> None:
        """Forget all frames."""
        self.filter = SignFilter(cap=self.cap)
        self.doubt = torch.zeros(len(self.bones), dtype=torch.float64)

    def guess(self, longest: Tensor) -> Shape:
        """Bones as long as their longest images (B,), in the image plane."""
        size = float(longest.sum())
        factor = 2.0 / size if size > 0 else 1.0
        return Shape(factor, longest * factor, longest.new_zeros(0, 3))

    def step(self, image: Tensor, weights: Tensor, shape: Shape, told: Told | None = None) -> Tensor:
        """Take a frame and return its bones' dz (B,); as :meth:`BodyFilter.step`."""
        flat = bone_vectors(image * shape.factor, self.bones).square().sum(-1)
        depth = (shape.lengths.square() - flat).clamp_min(0).sqrt()
        unary = depth.new_zeros(len(depth), 1, 2)
        if told is not None:
            share = told.depths / shape.lengths
            unary = SOLVED * torch.stack([-share, share], -1).clamp_min(0)[:, None]
        margins = self.filter.step(unary, depth[:, None] / self.acceleration)[:, 0]
        self.doubt = torch.softmax(-margins, -1).amin(-1)
        return torch.where(margins[:, 0] <= margins[:, 1], depth, -depth)
