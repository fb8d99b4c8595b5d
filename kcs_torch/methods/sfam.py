"""SfAM: structure from articulated motion (Kovalenko, Golyanik, Malik, Elhayek, Stricker, Sensors 2019)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import ClassVar, Literal

import torch
from torch import Tensor

from kcs_torch.errors import OptionError
from kcs_torch.functional.align import nearest_rotation
from kcs_torch.functional.camera import complete_rotation, factorize, rows_to_cameras
from kcs_torch.functional.spectral import dct_basis
from kcs_torch.functional.temporal import blend_windows, interpolate, window_starts
from kcs_torch.methods.base import Estimate, Method
from kcs_torch.nn.unrolled import continuation, data_scale, estimate_lengths, shape_step, start_shape
from kcs_torch.skeleton import Skeleton
from kcs_torch.solvers.camera_path import constant_path
from kcs_torch.solvers.ist import ist, metric_upgrade
from kcs_torch.solvers.iterate import iterate, relative_change
from kcs_torch.types import Tracks

__all__ = ["SfAM"]


@dataclass(frozen=True)
class SfAM(Method):
    """Cameras by factorisation, then low-rank shapes with bones of constant length; needs a viewpoint that turns.

    Args:
        beta: stiffness of the bones (the paper's beta); 0 is plain low-rank structure from motion.
        mu: first weight of the nuclear norm, a share of the data's largest singular value.
        rho: factor from one weight to the next.
        num_weights: how many weights.
        steps_per_weight: shrinkage steps at each weight, at most.
        tolerance: go on to the next weight where a step changes the shape by less than this share.
        tau: step size of the articulated steps, below 1; the others take twice that.
        articulate_from: share of the weights after which the bones' term joins; 0 is all of them, as printed. While mu
            is large the shapes are shrunk, and lengths taken from them would be too short.
        lengths: where the bone lengths come from: "shape" (re-estimated from the shape at each weight), or "skeleton"
            (its proportions, at the scale of the shape; fixed, as printed).
        rank: K shapes of the camera factorisation, or "auto": chosen by how evenly the camera moves.
        camera_path: "free" cameras; "constant" angular velocity; "auto" takes the latter where it explains the former.
            It concerns the cameras that are reported, not the shape.
        trajectories: number of cosines that the tracks' paths are smoothed to, or None.
        window: frames that are solved together, or None for all.
        overlap: frames that neighbouring windows share.

    Raises:
        OptionError: a value is out of range.
    """

    name: ClassVar[str] = "sfam"
    beta: float = 1.5
    mu: float = 0.5
    rho: float = 0.25
    num_weights: int = 8
    steps_per_weight: int = 30
    tolerance: float = 1e-5
    tau: float = 0.5
    articulate_from: float = 0.75
    lengths: Literal["shape", "skeleton"] = "shape"
    rank: int | Literal["auto"] = "auto"
    camera_path: Literal["auto", "free", "constant"] = "auto"
    trajectories: int | None = None
    window: int | None = 200
    overlap: int = 50

    def __post_init__(self) -> None:
        self._expect(self.beta >= 0, "beta", "a number >= 0")
        self._expect(self.mu > 0, "mu", "a positive number")
        self._expect(0 < self.rho < 1, "rho", "a number between 0 and 1")
        self._expect(self.num_weights >= 1, "num_weights", "at least 1")
        self._expect(self.steps_per_weight >= 1, "steps_per_weight", "at least 1")
        self._expect(0 < self.tau < 1, "tau", "a number between 0 and 1")
        self._expect(0 <= self.articulate_from <= 1, "articulate_from", "a share within 0..1")
        self._expect(self.lengths in ("shape", "skeleton"), "lengths", "'shape' or 'skeleton'")
        self._expect(self.rank == "auto" or (isinstance(self.rank, int) and self.rank >= 1), "rank", "'auto' or K >= 1")
        self._expect(self.camera_path in ("auto", "free", "constant"), "camera_path", "'auto', 'free' or 'constant'")
        self._expect(self.trajectories is None or self.trajectories >= 1, "trajectories", "None or at least 1")
        self._expect(self.window is None or self.window >= 2, "window", "None or at least 2 frames")
        self._expect(0 <= self.overlap, "overlap", "at least 0 frames")
        if self.window is not None and self.overlap >= self.window:
            raise OptionError(f"sfam: overlap: expected below the window of {self.window} frames, got {self.overlap}")

    def solve(self, tracks: Tracks, cameras: Tensor | None) -> Estimate:
        """Solve all windows as one batch, then join them."""
        frames = tracks.num_frames
        window = min(self.window or frames, frames)
        starts = window_starts(frames, window, min(self.overlap, window - 1))
        cut = lambda x: torch.stack([x[s : s + window] for s in starts])  # noqa: E731
        filled = interpolate(tracks.points, tracks.seen)
        if self.trajectories is not None:
            basis = dct_basis(frames, min(self.trajectories, frames), dtype=filled.dtype, device=filled.device)
            filled = torch.einsum("tk,sk,snd->tnd", basis, basis, filled)
            tracks = Tracks(filled * tracks.seen[..., None], tracks.weights, tracks.skeleton, source=tracks.source)
        points, weights = cut(tracks.points), cut(tracks.weights)
        rows = cut(cameras) if cameras is not None else orthographic_cameras(cut(filled), self.rank)
        shape, converged, iterations = self.shape(points, rows, weights, tracks.skeleton)
        turned = complete_rotation(rows)  # (W, T, 3, 3)
        local = shape @ turned.mT
        sign = _mirror_signs(local, starts)
        flip = torch.ones(len(starts), 3, dtype=local.dtype, device=local.device)
        flip[:, 2] = sign
        depth = blend_windows(local * flip[:, None, None], starts, frames)
        if cameras is not None:
            path, notes = cameras, ()
        else:
            free = _join_rotations(complete_rotation(rows * flip[:, None, None]), starts, frames)
            path, notes = self._path(free)
        return Estimate(depth, path, torch.ones_like(depth[:, 0, 0]), converged, iterations, notes)

    def shape(
        self, tracks: Tensor, cameras: Tensor, weights: Tensor, skeleton: Skeleton
    ) -> tuple[Tensor, bool, int]:
        """Algorithm 1 with known cameras, for a batch of windows of one body.

        Args:
            tracks: (W, T, N, 2), centred.
            cameras: (W, T, 2, 3).
            weights: (W, T, N).
            skeleton: of the N joints.

        Returns:
            Shapes (W, T, N, 3) in the windows' world frames, whether all settled, and steps made.
        """
        rigid = list(skeleton.rigid)
        bones = skeleton.bone_index(device=tracks.device)[rigid]
        scale = data_scale(tracks, cameras, weights)
        first = round(self.articulate_from * self.num_weights) if rigid and self.beta > 0 else self.num_weights
        mus = continuation(self.num_weights, self.mu, self.mu * self.rho ** (self.num_weights - 1))
        shape, converged, made = start_shape(tracks, cameras, weights), False, 0
        for k, mu in enumerate(mus):
            step = self._step(shape, tracks, cameras, weights, mu * scale, bones if k >= first else None, skeleton)
            solution = iterate(
                step,
                shape,
                num_steps=self.steps_per_weight,
                change=lambda old, new: relative_change(old.flatten(-2), new.flatten(-2)),
                tolerance=self.tolerance,
            )
            shape, converged, made = solution.value, solution.converged, made + solution.iterations
        return shape, converged, made

    def _step(
        self,
        shape: Tensor,
        tracks: Tensor,
        cameras: Tensor,
        weights: Tensor,
        threshold: Tensor,
        bones: Tensor | None,
        skeleton: Skeleton,
    ) -> Callable[[Tensor, int], Tensor]:
        """The step at one weight; bone lengths are taken from the shape that it starts from."""
        if bones is None:
            return lambda x, _: shape_step(x, tracks, cameras, weights, threshold, 2 * self.tau)
        # one body, one set of lengths: all windows' frames together
        length, rigidity = estimate_lengths(shape.flatten(0, 1), bones, weights.flatten(0, 1), graded=not skeleton.tree)
        known = skeleton.relative_lengths(dtype=shape.dtype, device=shape.device) if self.lengths == "skeleton" else None
        if known is not None:
            known = known[list(skeleton.rigid)]
            length = known * (length / known).median()
        stiffness = self.beta * rigidity
        return lambda x, _: shape_step(
            x, tracks, cameras, weights, threshold, self.tau, bones=bones, lengths=length, stiffness=stiffness
        )

    def _path(self, rotations: Tensor) -> tuple[Tensor, tuple[str, ...]]:
        """Reported cameras (T, 2, 3): free, or of constant angular velocity where that explains them."""
        if self.camera_path == "free" or len(rotations) < 10:
            return rotations[:, :2], ()
        path, angle = constant_path(rotations)
        first = path[1] @ path[0].mT
        turn = torch.arccos(((first.trace() - 1) / 2).clamp(-1, 1)) * (len(path) - 1)
        if self.camera_path == "auto" and not bool(angle.median() < EVEN * turn):
            return rotations[:, :2], ()
        degrees = float(torch.rad2deg(angle.median()))
        return path[:, :2], (f"cameras follow a path of constant angular velocity (median deviation {degrees:.1f} degrees)",)


EVEN = 0.05
"""A constant angular velocity explains the cameras where their median deviation is below this share of its turn."""


def orthographic_cameras(
    tracks: Tensor,
    rank: int | Literal["auto"] = "auto",
    *,
    num_starts: int = 5,
    smoothness: float = 0.1,
    seed: int = 0,
) -> Tensor:
    """Estimate orthographic cameras by rank-3K factorisation and metric upgrade.

    Many subspaces have nearly orthonormal rows; the wrong ones make the camera jump. So for every K the upgrade
    runs from the convex relaxation (:func:`ist`) and some random starts, with a weak pull to smooth rows, and the
    candidate with the least product of both faults wins: the rows' root mean square defect, and the unevenness of
    the camera's motion.

    Args:
        tracks: (W, T, N, 2), complete.
        rank: K, or "auto" to try 1..6.
        num_starts: random starts beside the relaxation's.
        smoothness: weight of the rows' second differences.
        seed: of the random starts.

    Returns:
        (W, T, 2, 3) orthonormal rows; each window has a world frame and a mirror of its own. Windows too short or with
        too few joints to tell (2T < 3 or N < 4) get the identity.

    Kovalenko et al. 2019, section 3.2.
    """
    windows, frames, joints, _ = tracks.shape
    limit = min(2 * frames, joints - 1)
    if limit < 3:
        return torch.eye(3, dtype=tracks.dtype, device=tracks.device)[:2].expand(windows, frames, 2, 3)
    motion, _ = factorize(tracks - tracks.mean(-2, keepdim=True), min(limit, 18 if rank == "auto" else 3 * rank))
    size = motion[..., 0].square().mean((-2, -1)).sqrt()
    motion = motion / torch.where(size > 0, size, torch.ones_like(size))[..., None, None, None]
    generator = torch.Generator().manual_seed(seed)
    cameras, defects = [], []
    for r in range(3, motion.shape[-1] + 1, 3) if rank == "auto" else [motion.shape[-1]]:
        part = motion[..., :r]
        random = torch.randn(num_starts, 1, r, 3, generator=generator, dtype=torch.float64).to(motion)
        starts = torch.cat([ist(part)[None], random.expand(-1, windows, -1, -1)])
        q, defect = metric_upgrade(part, starts, smoothness=smoothness, tolerance=1e-3)
        cameras.append(rows_to_cameras(part @ q[:, :, None])[0])
        defects.append(defect)
    candidates, defect = torch.cat(cameras), torch.cat(defects)  # (C, W, T, 2, 3), (C, W)
    turn = complete_rotation(candidates)
    turn = turn[:, :, 1:] @ turn[:, :, :-1].mT
    uneven = torch.linalg.matrix_norm(turn.diff(dim=2)).mean(-1) if frames > 2 else torch.ones_like(defect)
    choice = (uneven * defect.sqrt()).argmin(0)
    return candidates[choice, torch.arange(windows, device=choice.device)]


def _mirror_signs(parts: Tensor, starts: list[int]) -> Tensor:
    """Signs (W,) that give all windows (W, T, N, 3) the same mirror: neighbours' depths agree where they overlap."""
    window = parts.shape[1]
    agree = [torch.ones((), dtype=parts.dtype, device=parts.device)]
    for i in range(1, len(starts)):
        shared = starts[i - 1] + window - starts[i]
        overlap = (parts[i - 1, window - shared :, :, 2] * parts[i, :shared, :, 2]).sum()
        agree.append(torch.where(overlap < 0, -torch.ones_like(overlap), torch.ones_like(overlap)))
    return torch.stack(agree).cumprod(0)


def _join_rotations(parts: Tensor, starts: list[int], frames: int) -> Tensor:
    """Rotations (W, T, 3, 3), each window in a world frame of its own, as one run (frames, 3, 3) in the first's frame."""
    window = parts.shape[1]
    turned = [parts[0]]
    for i in range(1, len(starts)):
        shared = starts[i - 1] + window - starts[i]
        between = nearest_rotation((parts[i, :shared].mT @ turned[-1][window - shared :]).sum(0))
        turned.append(parts[i] @ between)
    return nearest_rotation(blend_windows(torch.stack(turned), starts, frames))
