"""SfAM: structure from articulated motion (Kovalenko, Golyanik, Malik, Elhayek, Stricker, Sensors 2019)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import ClassVar, Literal

import torch
from torch import Tensor

from kcs_torch.errors import OptionError
from kcs_torch.functional.align import nearest_rotation
from kcs_torch.functional.camera import complete_rotation
from kcs_torch.functional.spectral import dct_basis
from kcs_torch.functional.temporal import blend_windows, interpolate, window_starts
from kcs_torch.methods.base import Estimate, Method
from kcs_torch.methods.cameras import orthographic_cameras
from kcs_torch.methods.mirror import mirror_sign
from kcs_torch.methods.unseen import place_unseen
from kcs_torch.nn.unrolled import UnrolledSfAM
from kcs_torch.skeleton import Skeleton
from kcs_torch.solvers.camera_path import constant_path
from kcs_torch.solvers.completion import complete_tracks
from kcs_torch.solvers.iterate import Solution
from kcs_torch.types import Tracks

__all__ = ["SfAM"]


@dataclass(frozen=True)
class SfAM(Method):
    """Cameras by factorisation, then low-rank shapes with bones of constant length; needs a viewpoint that turns.

    Args:
        beta: stiffness of the bones (the paper's beta); 0 is plain low-rank structure from motion.
        num_steps: shrinkage steps; the weight of the nuclear norm falls with each.
        mu: first weight, a share of the data's largest singular value.
        final: last weight. The factor from step to step (the paper's rho) follows from the three.
        tau: step size of the articulated steps, below 1; the others take twice that.
        momentum: share of the last change that the next step starts ahead by; 0 is the printed iteration.
        articulate_from: share of the steps after which the bones' term joins; 0 is all of them, as printed. While mu
            is large the shapes are shrunk, and lengths taken from them would be too short.
        lengths: where the bone lengths come from: "shape" (re-estimated at each step), or "skeleton" (its
            proportions, at the scale of the shape), or one relative length per bone (fixed, as printed).
        rank: K shapes of the camera factorisation, or "auto": chosen by how evenly and how orthonormal the rows come.
        camera_path: "free" cameras; "constant" angular velocity; "auto" takes the latter where it explains the former.
            It concerns the cameras that are reported, not the shape.
        trajectories: number of cosines that the tracks' paths are smoothed to within a window, or None.
        window: frames that are solved together, or None for all.
        overlap: frames that neighbouring windows share.

    Raises:
        OptionError: a value is out of range.
    """

    name: ClassVar[str] = "sfam"
    beta: float = 1.5
    num_steps: int = 60
    mu: float = 0.5
    final: float = 1e-5
    tau: float = 0.5
    momentum: float = 0.8
    articulate_from: float = 0.6
    lengths: Literal["shape", "skeleton"] | Sequence[float] = "shape"
    rank: int | Literal["auto"] = "auto"
    camera_path: Literal["auto", "free", "constant"] = "auto"
    trajectories: int | None = None
    window: int | None = 200
    overlap: int = 50

    def __post_init__(self) -> None:
        super().__post_init__()
        self._expect(self.beta >= 0, "beta", "a number >= 0")
        self._expect(self.num_steps >= 1, "num_steps", "at least 1")
        self._expect(0 < self.mu < math.inf, "mu", "a positive number")
        self._expect(0 < self.final <= self.mu, "final", f"a positive number up to mu = {self.mu}")
        self._expect(0 < self.tau < 1, "tau", "a number between 0 and 1")
        self._expect(0 <= self.momentum < 1, "momentum", "a share within [0, 1)")
        self._expect(0 <= self.articulate_from <= 1, "articulate_from", "a share within 0..1")
        if not isinstance(self.lengths, str):
            positive = len(self.lengths) > 0 and all(0 < x < math.inf for x in self.lengths)
            self._expect(positive, "lengths", "'shape', 'skeleton' or positive numbers")
        self._expect(isinstance(self.rank, str) or self.rank >= 1, "rank", "'auto' or K >= 1")
        self._expect(self.trajectories is None or self.trajectories >= 1, "trajectories", "None or at least 1")
        self._expect(self.window is None or self.window >= 2, "window", "None or at least 2 frames")
        self._expect(self.overlap >= 1, "overlap", "at least 1 frame, by which windows are joined")
        if self.window is not None and self.overlap >= self.window:
            raise OptionError(f"sfam: overlap: expected below the window of {self.window} frames, got {self.overlap}")

    def solve(self, tracks: Tracks, cameras: Tensor | None) -> Estimate:
        """Solve all windows as one batch, then join them."""
        frames = tracks.num_frames
        window = min(self.window or frames, frames)
        starts = window_starts(frames, window, min(self.overlap, window - 1))
        cut = lambda x: torch.stack([x[s : s + window] for s in starts])  # noqa: E731
        filled = _fill_blank_frames(tracks)
        points, seen, weights = cut(filled.points), cut(filled.seen), cut(filled.weights)
        known = None if cameras is None else cut(cameras)
        local, rows, solution = self._windows(points, seen, weights, tracks.skeleton, known)
        flip = torch.ones(len(starts), 3, dtype=local.dtype, device=local.device)
        if cameras is None:  # known cameras know their mirror
            flip[:, 2] = _mirror_signs(local, starts)
        joined = blend_windows(local * flip[:, None, None], starts, frames)
        path = None
        if cameras is None:
            path = _join_rotations(complete_rotation(rows * flip[:, None, None]), starts, frames)
        known = None if cameras is None else cameras[None]
        return self._estimates([tracks], joined[None], None if path is None else path[None], known, solution)[0]

    def solve_all(self, tracks: Sequence[Tracks]) -> list[Estimate]:
        """Solve clips of one skeleton and equally many frames as one batch of windows."""
        groups: dict[object, list[int]] = {}
        for i, one in enumerate(tracks):
            whole = self.lengths == "shape" and one.num_frames <= (self.window or one.num_frames)
            kind = (one.skeleton, one.num_frames, one.points.dtype, one.points.device)
            groups.setdefault(kind if whole else i, []).append(i)
        out: dict[int, Estimate] = {}
        for group in groups.values():
            if len(group) == 1:
                out[group[0]] = self.solve(tracks[group[0]], None)
                continue
            clips = [tracks[i] for i in group]
            filled = [_fill_blank_frames(one) for one in clips]
            points = torch.stack([one.points for one in filled])
            seen, weights = torch.stack([one.seen for one in filled]), torch.stack([one.weights for one in filled])
            local, rows, solution = self._windows(points, seen, weights, clips[0].skeleton, None, one_body=False)
            out |= zip(group, self._estimates(clips, local, complete_rotation(rows), None, solution), strict=True)
        return [out[i] for i in range(len(tracks))]

    def _windows(
        self,
        points: Tensor,
        seen: Tensor,
        weights: Tensor,
        skeleton: Skeleton,
        cameras: Tensor | None,
        one_body: bool = True,
    ) -> tuple[Tensor, Tensor, Solution[Tensor]]:
        """Windows (W, T, N, 2): their points (W, T, N, 3) in each frame's camera, and the cameras (W, T, 2, 3)."""
        filled = complete_tracks(points, seen)
        if self.trajectories is not None:
            window = points.shape[1]
            basis = dct_basis(window, min(self.trajectories, window), dtype=filled.dtype, device=filled.device)
            filled = torch.einsum("tk,sk,wsnd->wtnd", basis, basis, filled)
            points = filled * (weights > 0)[..., None]
        rows = cameras
        if rows is None:  # some windows at a time: the search tries several starts for each
            rows = torch.cat([orthographic_cameras(part, self.rank) for part in filled.split(CHUNK)])
        solution = self.shape(points, rows, weights, skeleton, one_body=one_body)
        return solution.value @ complete_rotation(rows).mT, rows, solution

    def _estimates(
        self,
        tracks: Sequence[Tracks],
        points: Tensor,
        path: Tensor | None,
        cameras: Tensor | None,
        solution: Solution[Tensor],
    ) -> list[Estimate]:
        """What is found of K clips: points (K, T, N, 3), with their own camera paths (K, T, 3, 3) or known cameras."""
        notes: list[tuple[str, ...]] = [()] * len(tracks)
        if cameras is None:
            assert path is not None
            sign = points.new_ones(len(tracks), 3)
            sign[:, 2] = points.new_tensor([mirror_sign(x, t.skeleton) for x, t in zip(points, tracks, strict=True)])
            points = points * sign[:, None, None]
            cameras, notes = self._paths(complete_rotation(path[..., :2, :] * sign[:, None, None]))
        ones = points.new_ones(points.shape[1])
        placed = [place_unseen(x, t.seen.any(0), t.skeleton) for x, t in zip(points, tracks, strict=True)]
        return [
            Estimate(x, rows, ones, solution.converged, solution.iterations, note)
            for x, rows, note in zip(placed, cameras, notes, strict=True)
        ]

    def shape(
        self, tracks: Tensor, cameras: Tensor, weights: Tensor, skeleton: Skeleton, *, one_body: bool = True
    ) -> Solution[Tensor]:
        """Algorithm 1 with known cameras, for a batch of windows.

        Args:
            tracks: (W, T, N, 2), centred.
            cameras: (W, T, 2, 3).
            weights: (W, T, N).
            skeleton: of the N joints.
            one_body: the windows show one body, whose bones have one length in all of them.

        Returns:
            The shapes (W, T, N, 3) in the windows' world frames.

        Raises:
            OptionError: ``lengths`` are not one per bone, or the skeleton knows none.
        """
        lengths = None
        if self.lengths == "skeleton":
            lengths = skeleton.relative_lengths(dtype=tracks.dtype, device=tracks.device)
            if lengths is None:
                raise OptionError(
                    f"sfam: lengths: skeleton '{skeleton.name}' has neither proportions nor a template: "
                    "expected 'shape' or one relative length per bone"
                )
        elif not isinstance(self.lengths, str):
            lengths = torch.tensor(tuple(self.lengths), dtype=tracks.dtype, device=tracks.device)
            if len(lengths) != skeleton.num_bones:
                raise OptionError(f"sfam: lengths: expected {skeleton.num_bones}, one per bone, got {len(lengths)}")
        solver = UnrolledSfAM(
            skeleton,
            self.num_steps,
            mu=self.mu,
            final=self.final,
            tau=self.tau,
            momentum=self.momentum,
            beta=self.beta or 1.0,
            articulate_from=self.articulate_from if self.beta > 0 else 1.0,
            learnable=False,
        ).to(tracks.device)
        return solver.solve(tracks, cameras, weights=weights, lengths=lengths, one_body=one_body)

    def _paths(self, rotations: Tensor) -> tuple[Tensor, list[tuple[str, ...]]]:
        """Reported cameras (K, T, 2, 3): free, or of constant angular velocity where that explains them."""
        rows = rotations[..., :2, :]
        notes: list[tuple[str, ...]] = [()] * len(rotations)
        if self.camera_path == "free" or rotations.shape[1] < 10:
            return rows, notes
        path, angle = constant_path(rotations)
        first = path[:, 1] @ path[:, 0].mT
        trace = first.diagonal(dim1=-2, dim2=-1).sum(-1)
        turn = torch.arccos(((trace - 1) / 2).clamp(-1, 1)) * (path.shape[1] - 1)
        off = angle.median(-1).values
        even = off < EVEN * turn if self.camera_path == "auto" else torch.ones_like(off, dtype=torch.bool)
        for k in even.nonzero().flatten().tolist():
            degrees = float(torch.rad2deg(off[k]))
            notes[k] = (f"cameras follow a path of constant angular velocity (median deviation {degrees:.1f} degrees)",)
        return torch.where(even[:, None, None, None], path[..., :2, :], rows), notes


CHUNK = 32
"""Windows whose cameras are searched together: more would only take memory."""

EVEN = 0.05
"""A constant angular velocity explains the cameras where their median deviation is below this share of its turn."""


def _fill_blank_frames(tracks: Tracks) -> Tracks:
    """Fill frames without any seen joint between their neighbours, and count them as seen.

    No term would hold the shape of such a frame, and the nuclear norm would shrink it.
    """
    blank = ~tracks.seen.any(-1, keepdim=True)
    made = blank & tracks.seen.any(0)
    filled = interpolate(tracks.points, tracks.seen)
    return replace(
        tracks,
        points=torch.where(made[..., None], filled, tracks.points),
        weights=torch.where(made, torch.ones_like(tracks.weights), tracks.weights),
    )


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
    """Rotations (W, T, 3, 3), each window in a world frame of its own, as one run (frames, 3, 3) in the first's."""
    window = parts.shape[1]
    turned = [parts[0]]
    for i in range(1, len(starts)):
        shared = starts[i - 1] + window - starts[i]
        between = nearest_rotation((parts[i, :shared].mT @ turned[-1][window - shared :]).sum(0))
        turned.append(parts[i] @ between)
    return nearest_rotation(blend_windows(torch.stack(turned), starts, frames))
