"""KCS: kinematic chain space (Wandt, Ackermann, Rosenhahn, ECCV workshops 2018)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar, NamedTuple

import torch
from torch import Tensor

from kcs_torch.errors import ShapeError
from kcs_torch.functional.align import centre, nearest_rotation
from kcs_torch.functional.camera import complete_rotation
from kcs_torch.functional.chain import bone_lengths, chain_inverse, incidence
from kcs_torch.functional.guarded import or_one
from kcs_torch.functional.ranks import median
from kcs_torch.methods.answer.mirror import mirror_sign
from kcs_torch.methods.base import Estimate, Method
from kcs_torch.methods.clips.batches import Clips, in_batches, padded
from kcs_torch.methods.clips.template import clip_scale, guessed, rigid_shape
from kcs_torch.nn.deviation import (
    Arrangement,
    deviation_goal,
    deviation_scale,
    deviation_step,
    frame_scales,
    told_scales,
)
from kcs_torch.nn.steps import continuation
from kcs_torch.skeleton import Skeleton
from kcs_torch.solvers.iterate import relative_change
from kcs_torch.solvers.lm import fit_bones
from kcs_torch.solvers.pose import CameraFit, fit_cameras, steady_cameras
from kcs_torch.types import Tracks, as_floats

__all__ = ["KCS"]

DEEP = 0.3
"""Least extent of the tracks' best rigid shape, over its middle one, from which on it is solid: the viewpoint turns.
Seen without a turn it is flat."""

CHECK = 5
"""Steps from one look at whether a clip has settled to the next."""


class _Found(NamedTuple):
    """Cameras and shapes of K clips.

    Attributes:
        shape: (K, T, N, 3) poses in the world, in the template's size.
        rotations: (K, T, 3, 3) world to camera.
        scales: (K, T) of each frame's image.
        converged: (K,).
        made: (K,) steps.
    """

    shape: Tensor
    rotations: Tensor
    scales: Tensor
    converged: Tensor
    made: Tensor


@dataclass(frozen=True)
class KCS(Method):
    """A template's bones plus a deviation of least nuclear norm, alternating with weak-perspective cameras.

    Pose = B0 + A S in bone space: B0 is the template, A S the deviation with min ||A||_* subject to the tracks.

    Args:
        template: rest pose, N positions (x right, y down, z away), any unit, limbs symmetric (a stride of one frame
            looks like a body turned about in the next); the skeleton's if None; where that has none, the rigid shape
            that best explains the tracks.
        links: extra rigid links as pairs of joint names (two hands on one sword); they may close chains.
        arrangement: how the deviations of all frames form one matrix: "stacked", 3T x B as printed, or "frames",
            T x 3B, in which a deviation that recurs under another viewpoint gains depth.
        rounds: alternations of cameras and shape, at most.
        tolerance: stop where the cameras change by less than this in a round (radians, root mean square).
        mu: first weight of the nuclear norm, a share of the data's largest singular value.
        rho: factor from one weight to the next.
        num_weights: how many weights.
        steps_per_weight: singular value thresholding steps at each weight, at most.
        scale_range: factor by which a frame's weak-perspective scale may leave the clip's, which is told by
            the longest projections of the bones; inf leaves each frame free, as printed.
        robust: residuals of this share of the body's size count half in the cameras; None is least squares, as printed.
        continuity: weight of the turn between frames (radians squared) in choosing among a frame's possible
            cameras; 0 takes each frame's best, as printed.
        bone_steps: steps that then bring the bones to their median lengths, image positions of seen joints held; 0 is
            none, as printed: the nuclear norm alone does not make lengths constant.

    Raises:
        OptionError: a value is out of range.
    """

    name: ClassVar[str] = "kcs"
    differentiates: ClassVar[bool] = False
    keeps_lengths: ClassVar[bool] = False
    template: Sequence[Sequence[float]] | None = None
    links: tuple[tuple[str, str], ...] = ()
    arrangement: Arrangement = "stacked"
    rounds: int = 3
    tolerance: float = 1e-2
    mu: float = 0.5
    rho: float = 0.25
    num_weights: int = 8
    steps_per_weight: int = 15
    scale_range: float = 1.1
    robust: float | None = 0.4
    continuity: float = 1.0
    bone_steps: int = 0

    def __post_init__(self) -> None:
        super().__post_init__()
        self._expect(self.rounds >= 1, "rounds", "at least 1")
        self._expect(self.tolerance >= 0, "tolerance", "a number >= 0")
        self._expect(0 < self.mu < math.inf, "mu", "a positive number")
        self._expect(self.num_weights >= 1, "num_weights", "at least 1")
        self._expect(0 < self.rho < 1, "rho", "a number between 0 and 1")
        last = self.mu * self.rho ** (self.num_weights - 1)
        self._expect(last > 0, "rho", "a number that leaves the last weight, mu rho^(num_weights - 1), above 0")
        self._expect(self.steps_per_weight >= 1, "steps_per_weight", "at least 1")
        self._expect(self.scale_range >= 1, "scale_range", "a factor >= 1")
        self._expect(self.robust is None or self.robust > 0, "robust", "None or a positive share")
        self._expect(self.continuity >= 0, "continuity", "a number >= 0")
        self._expect(self.bone_steps >= 0, "bone_steps", "at least 0")

    def knows_template(self, skeleton: Skeleton) -> bool:
        return self.template is not None or skeleton.template is not None

    def solve(self, tracks: Tracks, cameras: Tensor | None) -> Estimate:
        """Alternate cameras and shape until the cameras stand still."""
        return self._solve([tracks], cameras)[0]

    def solve_all(self, tracks: Sequence[Tracks]) -> list[Estimate]:
        """Several clips as few batches; a clip that has settled leaves its batch."""
        return in_batches(tracks, lambda clips: self._solve(clips, None))

    def _solve(self, tracks: Sequence[Tracks], cameras: Tensor | None) -> list[Estimate]:
        """Clips of one skeleton; known cameras (T, 2, 3) are those of a single clip."""
        body = tracks[0].skeleton.with_links(self.links) if self.links else tracks[0].skeleton
        body = body.connected()
        clips = Clips.of(tracks)
        rests, notes = zip(*(self._template(one, cameras) for one in tracks), strict=True)
        rest = torch.stack(rests)[:, None]  # (K, 1, N, 3)
        scale = padded([clip_scale(one, own) for one, own in zip(tracks, rests, strict=True)])
        low, high = scale / self.scale_range, scale * self.scale_range
        if math.isinf(self.scale_range):
            low, high = torch.zeros_like(scale), torch.full_like(scale, math.inf)
        known = None if cameras is None else complete_rotation(cameras)[None]
        if known is not None and not (self.template is None and body.template is None):
            # A template has a frame of its own: turn it into the world, as it is seen over the whole clip.
            seen_from, _ = self._cameras(clips, rest, low, high, None)
            rest = rest @ nearest_rotation((known.mT @ seen_from).sum(1, keepdim=True)).mT
        found = self._alternate(clips, body, rest, low, high, known)
        return self._estimates(clips, body, found, notes, mirror=cameras is None)

    def _alternate(
        self, clips: Clips, body: Skeleton, rest: Tensor, low: Tensor, high: Tensor, known: Tensor | None
    ) -> _Found:
        """Cameras and shape in turns, until each clip's cameras stand still.

        Args:
            clips: K of them.
            body: their skeleton, in one piece.
            rest: (K, 1, N, 3) templates.
            low: (K, T) least weak-perspective scales.
            high: (K, T) largest ones.
            known: (1, T, 3, 3) cameras of a single clip, if they are known.
        """
        bones = body.bone_index(device=rest.device)
        matrix = incidence(bones, body.num_joints, dtype=rest.dtype)
        inverse = chain_inverse(matrix)
        count, frames = low.shape
        rotations, scales = rest.new_zeros(count, frames, 3, 3), torch.zeros_like(low)
        deviation = rest.new_zeros(count, frames, 3, len(bones))
        shape = rest + (deviation @ inverse.mT).mT
        converged = torch.zeros(count, dtype=torch.bool, device=rest.device)
        made = torch.zeros(count, dtype=torch.long, device=rest.device)
        live = torch.arange(count, device=rest.device)
        for turn in range(self.rounds):
            part, bounds = clips.take(live), (low[live], high[live])
            if known is None:
                seen_from, size = self._cameras(part, shape[live], *bounds, rotations[live] if turn else None)
            else:
                seen_from, size = known, frame_scales(shape, part.points, known[..., :2, :], part.weights, *bounds)
            size = part.fill(told_scales(size, part.weights), 0)
            found, settled, steps = self._deviation(
                part, rest[live], deviation[live], seen_from[..., :2, :], size, matrix, inverse
            )
            moved = (part.mean((seen_from - rotations[live]).square().sum((-2, -1))) / 2).sqrt()
            done = (moved <= self.tolerance) & (turn > 0) | ~(part.weights > 0).any(-1).any(-1) | (known is not None)
            before = scales[live][..., None, None] * shape[live] @ rotations[live].mT
            rotations[live], scales[live], deviation[live] = seen_from, size, found
            shape[live] = rest[live] + (found @ inverse.mT).mT
            if turn and not bool(done.all()):
                done = done | _same(part, before, size[..., None, None] * shape[live] @ seen_from.mT)
            converged[live], made[live] = done & settled, made[live] + steps
            live = live[~done]
            if not len(live):
                break
        return _Found(shape, rotations, scales, converged, made)

    def _estimates(
        self, clips: Clips, body: Skeleton, found: _Found, notes: Sequence[tuple[str, ...]], *, mirror: bool
    ) -> list[Estimate]:
        """What was found in each clip; ``mirror``: a stand-in for the template may be the mirror image in depth."""
        mean = clips.mean(found.scales)[:, None]
        points, rotations = mean[..., None, None] * found.shape @ found.rotations.mT, found.rotations
        if self.bone_steps:
            kept = zip(clips.cut(points), clips.cut(clips.weights > 0), strict=True)
            points = padded([self._constant_bones(one, body, seen) for one, seen in kept])
        points = points - points.mean(-2, keepdim=True)
        if mirror and any(notes):
            stand_in = torch.tensor([bool(note) for note in notes], device=points.device)  # of either mirror image
            flip = torch.ones_like(points[:, :1, 0])
            flip[..., 2] = torch.where(stand_in, mirror_sign(points, body, clips.inside), 1)[:, None]
            points, rotations = points * flip[:, None], complete_rotation(rotations[..., :2, :] * flip[:, None])
        each = [clips.cut(x) for x in (points, rotations[..., :2, :], found.scales / mean)]
        ends = zip(*each, found.converged.tolist(), found.made.tolist(), notes, strict=True)
        return [Estimate(x, rows, own, good, steps, note) for x, rows, own, good, steps, note in ends]

    def _template(self, tracks: Tracks, cameras: Tensor | None) -> tuple[Tensor, tuple[str, ...]]:
        """The rest pose (N, 3), centred; a stand-in is in the world of the cameras where they are known."""
        like = tracks.points
        joints = tracks.num_joints
        rest = None
        if self.template is not None:
            rest = as_floats(self.template, "kcs: template", 2).to(like)
            if rest.shape != (joints, 3) or not torch.isfinite(rest).all():
                raise ShapeError(
                    f"kcs: template: expected {joints} finite positions (x, y, z), got shape {tuple(rest.shape)}"
                )
        elif tracks.skeleton.template is not None:
            rest = tracks.skeleton.template_points(dtype=like.dtype, device=like.device)
        if rest is None:
            note = f"skeleton '{tracks.skeleton.name}' has no template: the tracks' best rigid shape serves"
            return centre(rigid_shape(tracks, cameras))[0], (note,)
        if self.template is None and guessed(tracks.skeleton):
            own = centre(rigid_shape(tracks, cameras))[0]
            least, middle, _ = torch.linalg.eigvalsh(own.mT @ own).tolist()
            if least > DEEP**2 * middle:
                return own, ("the viewpoint turns: the tracks' best rigid shape serves, not a template of any animal",)
        return centre(rest)[0], ()

    def _cameras(
        self, clips: Clips, shape: Tensor, low: Tensor, high: Tensor, last: Tensor | None
    ) -> tuple[Tensor, Tensor]:
        """Rotations (K, T, 3, 3) and scales (K, T) of the camera step (eq. 22-25), consistent over time."""
        shape = shape.expand(*clips.weights.shape, 3)
        given = (clips.frames(x) for x in (clips.points, shape, clips.weights, low, high))
        start = None if last is None else clips.frames(last)
        fit = fit_cameras(*given, robust=self.robust, start=start)
        fit = CameraFit(*(clips.as_clips(x) for x in (fit.rotations, fit.scales, fit.cost)))
        return steady_cameras(fit, self.continuity, inside=clips.inside)

    def _constant_bones(self, points: Tensor, body: Skeleton, seen: Tensor) -> Tensor:
        """Alternate the bone-length step with the image positions of seen joints."""
        bones = body.bone_index(device=points.device)[list(body.rigid)]
        lengths = median(bone_lengths(points, bones), 0)
        image = points[..., :2]
        for _ in range(self.bone_steps):
            points = fit_bones(points, lengths, bones, num_steps=1)
            points = torch.cat([torch.where(seen[..., None], image, points[..., :2]), points[..., 2:]], -1)
        return points

    def _deviation(
        self,
        clips: Clips,
        rest: Tensor,
        start: Tensor,
        cameras: Tensor,
        scales: Tensor,
        matrix: Tensor,
        inverse: Tensor,
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Shape step (eq. 21): deviations (K, T, 3, B) of least nuclear norm that meet the tracks, by SVT continuation.

        With them come whether each clip settled at the last weight, and its steps: at a weight a clip that has settled
        rests, so that what is beside it in the batch makes no difference.
        """
        image = clips.points / or_one(scales)[..., None, None]
        given = (deviation_goal(rest, image, cameras, clips.weights), cameras, clips.weights)
        top = deviation_scale(*given, matrix=matrix, arrangement=self.arrangement)
        state, made = start, torch.zeros(len(start), dtype=torch.long, device=start.device)
        for mu in continuation(self.num_weights, self.mu, self.mu * self.rho ** (self.num_weights - 1)):
            resting = torch.zeros_like(made, dtype=torch.bool)
            for k in range(1, self.steps_per_weight + 1):
                new = deviation_step(
                    state, *given, mu * top, matrix=matrix, inverse=inverse, arrangement=self.arrangement
                )
                last, state = state, torch.where(resting[:, None, None, None], state, new) if k > CHECK else new
                made = made + ~resting
                if k % CHECK == 0 or k == self.steps_per_weight:
                    resting = resting | (relative_change(last.flatten(1, 2), state.flatten(1, 2)) <= 1e-4)
                    if bool(resting.all()):
                        break
        return state, resting, made


def _same(clips: Clips, before: Tensor, after: Tensor) -> Tensor:
    """Whether poses (K, T, N, 3) of each clip (K,) are the same but for rounding, or mirror images in depth.

    Cameras may differ then: a flat body's images have two, a straight one's any number, and rounding chooses.
    """
    before, after = (x - x.mean(-2, keepdim=True) for x in (before, after))
    flip = after.new_tensor([1.0, 1.0, -1.0])
    apart, mirrored = (clips.mean((after - x).square().sum((-2, -1))) for x in (before, before * flip))
    size = clips.mean(after.square().sum((-2, -1)))
    return torch.minimum(apart, mirrored) <= torch.finfo(after.dtype).eps * size
