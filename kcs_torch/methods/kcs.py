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
from kcs_torch.methods.base import Estimate, Method
from kcs_torch.methods.lockstep import Search, run, together
from kcs_torch.methods.template import clip_scale, rigid_shape
from kcs_torch.nn.deviation import Arrangement, deviation_scale, deviation_step, frame_scales
from kcs_torch.nn.steps import continuation
from kcs_torch.skeleton import Skeleton
from kcs_torch.solvers.iterate import iterate, relative_change
from kcs_torch.solvers.lm import fit_bones
from kcs_torch.solvers.pose import CameraFit, fit_cameras, steady_cameras
from kcs_torch.types import Tracks, as_floats

__all__ = ["KCS"]


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
        self._expect(0 < self.rho < 1, "rho", "a number between 0 and 1")
        self._expect(self.num_weights >= 1, "num_weights", "at least 1")
        self._expect(self.steps_per_weight >= 1, "steps_per_weight", "at least 1")
        self._expect(self.scale_range >= 1, "scale_range", "a factor >= 1")
        self._expect(self.robust is None or self.robust > 0, "robust", "None or a positive share")
        self._expect(self.continuity >= 0, "continuity", "a number >= 0")
        self._expect(self.bone_steps >= 0, "bone_steps", "at least 0")

    def solve(self, tracks: Tracks, cameras: Tensor | None) -> Estimate:
        """Alternate cameras and shape until the cameras stand still."""
        return run(self._steps(tracks, cameras), self._fits)

    def solve_all(self, tracks: Sequence[Tracks]) -> list[Estimate]:
        """Several clips, whose cameras are fitted together: each frame is a problem of its own."""
        return run(together([self._steps(one, None) for one in tracks]), self._fits)

    def _steps(self, tracks: Tracks, cameras: Tensor | None) -> Search[_Fit, CameraFit, Estimate]:
        body = tracks.skeleton.with_links(self.links) if self.links else tracks.skeleton
        body = body.connected()
        bones = body.bone_index(device=tracks.points.device)
        matrix = incidence(bones, body.num_joints, dtype=tracks.points.dtype)
        inverse = chain_inverse(matrix)
        rest, notes = self._template(tracks, cameras)
        scale = clip_scale(tracks, rest)
        low, high = scale / self.scale_range, scale * self.scale_range
        if math.isinf(self.scale_range):
            low, high = torch.zeros_like(scale), torch.full_like(scale, math.inf)
        if cameras is not None and not (self.template is None and tracks.skeleton.template is None):
            # A template has a frame of its own: turn it into the world, as it is seen over the whole clip.
            seen_from, _ = yield from self._cameras(
                tracks, rest.expand(tracks.num_frames, -1, 3), low, high, None, None
            )
            rest = rest @ nearest_rotation((complete_rotation(cameras).mT @ seen_from).sum(0)).mT
        shape = rest.expand(tracks.num_frames, -1, 3)
        rotations: Tensor | None = None
        deviation = torch.zeros(tracks.num_frames, len(bones), 3, dtype=rest.dtype, device=rest.device)
        converged, made = False, 0
        for _ in range(self.rounds):
            last = rotations
            rotations, scales = yield from self._cameras(tracks, shape, low, high, last, cameras)
            deviation, settled, steps = self._deviation(
                tracks, rest, deviation, rotations[:, :2], scales, matrix, inverse
            )
            shape, made = rest + inverse @ deviation, made + steps
            if last is not None:
                moved = ((rotations - last).square().sum((-2, -1)).mean() / 2).sqrt()
                converged = bool(moved <= self.tolerance)
            if converged or cameras is not None or not bool(tracks.seen.any()):
                converged = settled
                break
        assert rotations is not None
        size = scales.mean()
        points = size * shape @ rotations.mT
        if self.bone_steps:
            points = self._constant_bones(points, body, tracks.seen)
        points = points - points.mean(-2, keepdim=True)
        return Estimate(points, rotations[:, :2], scales / size, converged, made, notes)

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
        return centre(rest)[0], ()

    def _cameras(
        self, tracks: Tracks, shape: Tensor, low: Tensor, high: Tensor, last: Tensor | None, known: Tensor | None
    ) -> Search[_Fit, CameraFit, tuple[Tensor, Tensor]]:
        """Rotations (T, 3, 3) and scales (T,) of the camera step (eq. 22-25), consistent over time."""
        if known is not None:
            return complete_rotation(known), frame_scales(shape, tracks.points, known, tracks.weights, low, high)
        (fit,) = yield [_Fit(tracks.points, shape, tracks.weights, low, high, last)]
        return steady_cameras(fit, self.continuity)

    def _fits(self, asked: list[_Fit]) -> list[CameraFit]:
        """Fit the cameras of several clips: those of one number of joints, and with or without a start, together."""
        groups: dict[object, list[int]] = {}
        for i, one in enumerate(asked):
            points = one.points
            kind = (one.start is None, points.shape[1], points.dtype, points.device)
            groups.setdefault(kind, []).append(i)
        out: dict[int, CameraFit] = {}
        for group in groups.values():
            tracks, points, weights, low, high = (
                torch.cat(parts) for parts in zip(*(asked[i][:5] for i in group), strict=True)
            )
            starts = [start for i in group if (start := asked[i].start) is not None]
            start = torch.cat(starts) if starts else None
            fit = fit_cameras(tracks, points, weights, low, high, robust=self.robust, start=start)
            counts = [len(asked[i].tracks) for i in group]
            parts = zip(*(x.split(counts, 1) for x in (fit.rotations, fit.scales, fit.cost)), strict=True)
            out |= {i: CameraFit(*part) for i, part in zip(group, parts, strict=True)}
        return [out[i] for i in range(len(asked))]

    def _constant_bones(self, points: Tensor, body: Skeleton, seen: Tensor) -> Tensor:
        """Alternate the bone-length step with the image positions of seen joints."""
        bones = body.bone_index(device=points.device)[list(body.rigid)]
        lengths = bone_lengths(points, bones).median(0).values
        image = points[..., :2]
        for _ in range(self.bone_steps):
            points = fit_bones(points, lengths, bones, num_steps=1)
            points = torch.cat([torch.where(seen[..., None], image, points[..., :2]), points[..., 2:]], -1)
        return points

    def _deviation(
        self,
        tracks: Tracks,
        rest: Tensor,
        start: Tensor,
        cameras: Tensor,
        scales: Tensor,
        matrix: Tensor,
        inverse: Tensor,
    ) -> tuple[Tensor, bool, int]:
        """Shape step (eq. 21): deviations (T, B, 3) of least nuclear norm that meet the tracks, by SVT continuation."""
        goal = tracks.points / scales[:, None, None]
        given = (rest, goal, cameras, tracks.weights)
        top = deviation_scale(*given, matrix=matrix, arrangement=self.arrangement)

        def step(state: Tensor, threshold: Tensor) -> Tensor:
            return deviation_step(
                state, *given, threshold, matrix=matrix, inverse=inverse, arrangement=self.arrangement
            )

        state, settled, made = start, False, 0
        for mu in continuation(self.num_weights, self.mu, self.mu * self.rho ** (self.num_weights - 1)):
            solution = iterate(
                lambda x, _, mu=mu: step(x, mu * top),  # type: ignore[misc]
                state,
                num_steps=self.steps_per_weight,
                change=lambda old, new: relative_change(old.flatten(0, 1), new.flatten(0, 1)),
                tolerance=1e-4,
            )
            state, settled, made = solution.value, solution.converged, made + solution.iterations
        return state, settled, made


class _Fit(NamedTuple):
    """Arguments of :func:`fit_cameras` for one clip."""

    tracks: Tensor
    points: Tensor
    weights: Tensor
    low: Tensor
    high: Tensor
    start: Tensor | None
