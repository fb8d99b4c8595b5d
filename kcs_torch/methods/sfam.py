"""SfAM: structure from articulated motion (Kovalenko, Golyanik, Malik, Elhayek, Stricker, Sensors 2019)."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import ClassVar, Literal

import torch
from torch import Tensor

from kcs_torch.errors import OptionError
from kcs_torch.functional.camera import complete_rotation, viewpoint_turn
from kcs_torch.functional.chain import bone_lengths
from kcs_torch.functional.guarded import or_one
from kcs_torch.functional.ranks import nanmedian
from kcs_torch.functional.spectral import dct_basis, nuclear_norm
from kcs_torch.functional.temporal import interpolate, window_starts
from kcs_torch.functional.weights import of_largest
from kcs_torch.methods.answer.mirror import mirror_sign
from kcs_torch.methods.base import Estimate, Method
from kcs_torch.methods.clips.batches import Clips, in_batches, padded
from kcs_torch.methods.clips.cameras import camera_choices, orthographic_cameras
from kcs_torch.methods.clips.unseen import place_unseen
from kcs_torch.methods.clips.windows import join_windows, spread_first
from kcs_torch.nn.unrolled import UnrolledSfAM
from kcs_torch.nn.unrolled.base import SETTLED
from kcs_torch.skeleton import Skeleton
from kcs_torch.solvers.camera_path import EVEN, constant_path
from kcs_torch.solvers.completion import complete_tracks
from kcs_torch.solvers.iterate import Solution
from kcs_torch.types import Tracks

__all__ = ["SfAM"]

SEARCH, CHUNK = 32, 8
"""Windows of a clip whose cameras are searched together; and windows beyond the first ones that are solved together:
more would only take memory."""

LEAD = 40
"""Windows of a clip that are solved first, together: they tell the lengths of its bones, which the others take."""

CHOSEN = 24
"""Frames of a clip below which cameras are chosen by the shapes that come of them."""

GRANTED = 0.005
"""Variation of bones, a share of their lengths, that all cameras are granted where they are chosen."""

TURNS = 45.0, 90.0
"""Degrees that a window's viewpoint turns: up to the first the nuclear norm is the plain one, from the second on the
reweighted."""

SHORT = 10
"""Frames from which on a constant angular velocity is looked for."""


@dataclass(frozen=True)
class SfAM(Method):
    """Cameras by factorisation, then low-rank shapes with bones of constant length; needs a viewpoint that turns.

    Args:
        beta: stiffness of the bones (the paper's beta); 0 is plain low-rank structure from motion.
        num_steps: shrinkage steps; the weight of the nuclear norm falls with each.
        mu: first weight, a share of the data's largest singular value.
        final: last weight. The factor from step to step (the paper's rho) follows from the three.
        tau: step size of the articulated steps, below (1 + momentum) / (1 + 2 momentum); the others take twice that.
        momentum: share of the last change that the next step starts ahead by; 0 is the printed iteration.
        corner: singular values well above this share of the data's largest are hardly shrunk (the reweighted nuclear
            norm), where the viewpoint turns: by less than 45 degrees the norm is the plain one, which keeps depths
            small that nothing tells. Infinite is the plain norm always, as printed.
        articulate_from: share of the steps after which the bones' term joins; 0 is all of them, as printed. While mu
            is large the shapes are shrunk, and lengths taken from them would be too short.
        lengths: where the bone lengths come from: "shape" (re-estimated at each step), or "skeleton" (its
            proportions, at the scale of the shape), or one relative length per bone (fixed, as printed).
        rank: K shapes of the camera factorisation, or "auto": chosen by how evenly and how orthonormal the rows come;
            in clips of fewer than 24 frames by the shapes that come of them.
        camera_path: "free" cameras; "constant" angular velocity; "auto" takes the latter where it explains the former.
            It concerns the cameras that are reported, not the shape.
        trajectories: number of cosines that the tracks' paths are smoothed to within a window, or None.
        window: frames that are solved together, or None for all.
        overlap: frames that neighbouring windows share.

    Raises:
        OptionError: a value is out of range.
    """

    name: ClassVar[str] = "sfam"
    differentiates: ClassVar[bool] = False
    beta: float = 1.5
    num_steps: int = 50
    mu: float = 0.5
    final: float = 1e-4
    tau: float = 0.5
    momentum: float = 0.88
    corner: float = 0.05
    articulate_from: float = 0.2
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
        self._expect(0 <= self.momentum < 1, "momentum", "a share within [0, 1)")
        limit = (1 + self.momentum) / (1 + 2 * self.momentum)
        self._expect(
            0 < self.tau < limit, "tau", f"a positive number below {limit:.3g}, as steps diverge from there on"
        )
        self._expect(self.corner > 0, "corner", "a positive number")
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
        """Solve windows as one batch, then join them."""
        return self._solve([tracks], cameras)[0]

    def solve_all(self, tracks: Sequence[Tracks]) -> list[Estimate]:
        """Solve clips of one skeleton and equally many windows as one batch, padded to one length."""

        def kind(one: Tracks) -> tuple[int, bool, int]:
            # Where frames are fewer than joints their number decides how many shapes there may be.
            frames = one.num_frames
            return len(self._starts(frames)), frames < CHOSEN, min(frames, max(one.num_joints, SHORT))

        return in_batches(tracks, lambda clips: self._solve(clips, None), kind)

    def _starts(self, frames: int) -> list[int]:
        """First frames of a clip's windows."""
        window = min(self.window or frames, frames)
        return window_starts(frames, window, min(self.overlap, window - 1))

    def _solve(self, tracks: Sequence[Tracks], cameras: Tensor | None) -> list[Estimate]:
        """Clips of one skeleton and one number of windows; known cameras (T, 2, 3) are those of a single clip."""
        clips = Clips.of(tracks)
        clips = _fill_blank_frames(replace(clips, weights=of_largest(clips.weights)))
        starts = [self._starts(count) for count in clips.counts]
        window = min(self.window or max(clips.counts), max(clips.counts))
        first = torch.tensor(starts, device=clips.points.device)  # (K, V)
        order = spread_first(first.shape[1], LEAD)
        held: list[tuple[Tensor, Tensor]] = []
        parts = []
        for some in (order[:LEAD], *order[LEAD:].split(CHUNK)) if len(order) > LEAD else (order,):
            parts.append(self._windows(clips, first[:, some], window, tracks[0].skeleton, cameras, held))
        back = order.argsort()
        local, rows, change = (torch.cat(x, 1)[:, back] for x in zip(*parts, strict=True))
        del parts
        local, joined = _join(local, rows if cameras is None else None, clips.counts, starts)
        rows = joined if cameras is None else cameras[None]
        settled = change.amax(1) <= SETTLED
        notes: list[tuple[str, ...]] = [()] * len(tracks)
        if cameras is None:
            flip = torch.ones_like(local[:, 0, 0])
            flip[:, 2] = mirror_sign(local, tracks[0].skeleton, clips.inside)
            local = local * flip[:, None, None]
            rows, notes = self._paths(complete_rotation(rows * flip[:, None, None]), clips)
        pairs = zip(clips.cut(local), tracks, strict=True)
        placed = [place_unseen(x, one.seen.any(0), one.skeleton) for x, one in pairs]
        found = zip(placed, clips.cut(rows), settled.tolist(), notes, strict=True)
        return [Estimate(x, r, x.new_ones(len(x)), good, self.num_steps, note) for x, r, good, note in found]

    def _windows(
        self,
        clips: Clips,
        first: Tensor,
        window: int,
        skeleton: Skeleton,
        cameras: Tensor | None,
        held: list[tuple[Tensor, Tensor]],
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Points (K, V, T, N, 3) of windows that begin at frames (K, V), their cameras and their last step's change."""
        at = first[..., None] + torch.arange(window, device=first.device)
        clip = torch.arange(len(first), device=first.device)[:, None, None]
        inside = None if clips.inside is None or first.shape[1] > 1 else clips.inside[:, None]
        points, weights = clips.points[clip, at], clips.weights[clip, at]  # (K, V, T, N, ...)
        filled = complete_tracks(points, weights > 0, inside=inside)
        counts = None if inside is None else inside.sum(-1)
        if self.trajectories is not None:
            lengths = [window] * first.numel() if counts is None else counts.flatten().tolist()
            smooth = [self._smooth(x[:n]) for x, n in zip(filled.flatten(0, 1), lengths, strict=True)]
            filled = padded(smooth).view_as(filled)
            points = filled * (weights > 0)[..., None]
        if cameras is None and self.rank == "auto" and first.shape[1] == 1 and window < CHOSEN:
            return self._chosen(points, filled, weights, skeleton, inside)
        rows = self._cameras(filled, counts) if cameras is None else cameras[at]
        if inside is not None:
            rows = rows * inside[..., None, None]
        points, weights = points.squeeze(0), weights.squeeze(0)
        solution = self.shape(points, rows.squeeze(0), weights, skeleton, inside=inside, held=held)
        local = solution.value.view(*filled.shape[:-1], 3) @ complete_rotation(rows).mT
        assert solution.change is not None
        return local, rows, solution.change.view(first.shape)

    def _chosen(
        self, points: Tensor, filled: Tensor, weights: Tensor, skeleton: Skeleton, inside: Tensor | None
    ) -> tuple[Tensor, Tensor, Tensor]:
        """As :meth:`_windows`, of short clips (K, 1, T, N, ...), by the best of the cameras of each rank.

        Cameras of a high rank explain any few frames. So what tells is what the method wants of the shapes that come of
        them: their nuclear norm, times how much their bones vary in length.
        """
        counts = None if inside is None else inside.sum((1, 2))
        rows = camera_choices(filled[:, 0], counts=counts)[:, :, None]  # (C, K, 1, T, 2, 3)
        if inside is not None:
            rows = rows * inside[..., None, None]
        number = len(rows)
        points, weights = (x.expand(number, *x.shape).flatten(0, 1) for x in (points, weights))
        real = None if inside is None else inside.expand(number, *inside.shape).flatten(0, 1)
        solution = self.shape(points, rows.flatten(0, 1), weights, skeleton, inside=real)
        cost = nuclear_norm(solution.value.flatten(-2)) * _variation(solution.value, weights, skeleton, real)
        best = cost.view(number, -1).argmin(0), torch.arange(len(filled), device=cost.device)
        assert solution.change is not None
        shapes, change = (x.unflatten(0, (number, -1))[best] for x in (solution.value, solution.change))
        return shapes @ complete_rotation(rows[best]).mT, rows[best], change.view(len(filled), 1)

    def _cameras(self, tracks: Tensor, counts: Tensor | None) -> Tensor:
        """Cameras (K, V, T, 2, 3) of windows, some of a long clip at a time: the search tries several starts."""
        sizes = None if counts is None else counts.flatten()
        parts = [
            orthographic_cameras(part.flatten(0, 1), self.rank, together=part.shape[1], counts=sizes)
            for part in tracks.split(SEARCH, 1)
        ]
        return torch.cat([part.unflatten(0, (len(tracks), -1)) for part in parts], 1)

    def _smooth(self, tracks: Tensor) -> Tensor:
        """Tracks (T, N, 2) as sums of a few cosines."""
        assert self.trajectories is not None
        frames = len(tracks)
        basis = dct_basis(frames, min(self.trajectories, frames), dtype=tracks.dtype, device=tracks.device)
        return torch.einsum("tk,sk,snd->tnd", basis, basis, tracks)

    def shape(
        self,
        tracks: Tensor,
        cameras: Tensor,
        weights: Tensor,
        skeleton: Skeleton,
        *,
        one_body: bool = True,
        inside: Tensor | None = None,
        held: list[tuple[Tensor, Tensor]] | None = None,
    ) -> Solution[Tensor]:
        """Algorithm 1 with known cameras, for a batch of windows.

        Args:
            tracks: (..., W, T, N, 2), centred.
            cameras: (..., W, T, 2, 3).
            weights: (..., W, T, N).
            skeleton: of the N joints.
            one_body: the W windows show one body, whose bones have one length in all of them.
            inside: as of :meth:`kcs_torch.nn.UnrolledSfAM.solve`.
            held: as of :meth:`kcs_torch.nn.UnrolledSfAM.solve`.

        Returns:
            The shapes (..., W, T, N, 3) in the windows' world frames.

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
            corner=self.corner,
            beta=self.beta or 1.0,
            articulate_from=self.articulate_from if self.beta > 0 else 1.0,
            learnable=False,
        ).to(tracks.device)
        shown = cameras if inside is None else torch.where(inside[..., None, None], cameras, cameras[..., :1, :, :])
        told = ((viewpoint_turn(shown) - TURNS[0]) / (TURNS[1] - TURNS[0])).clamp(0, 1)
        return solver.solve(
            tracks, cameras, weights=weights, lengths=lengths, one_body=one_body, inside=inside, held=held,
            corner=self.corner / told,
        )  # fmt: skip

    def _paths(self, rotations: Tensor, clips: Clips) -> tuple[Tensor, list[tuple[str, ...]]]:
        """Reported cameras (K, T, 2, 3): free, or of constant angular velocity where that explains them."""
        rows = rotations[..., :2, :]
        notes: list[tuple[str, ...]] = [()] * len(rotations)
        if self.camera_path == "free" or min(clips.counts) < SHORT:
            return rows, notes
        counts = torch.tensor(clips.counts, device=rows.device)
        path, angle = constant_path(rotations, counts=counts)
        first = path[:, 1] @ path[:, 0].mT
        trace = first.diagonal(dim1=-2, dim2=-1).sum(-1)
        turn = torch.arccos(((trace - 1) / 2).clamp(-1, 1)) * (counts - 1)
        off = nanmedian(angle, -1)
        even = off < EVEN * turn if self.camera_path == "auto" else torch.ones_like(off, dtype=torch.bool)
        for k in even.nonzero().flatten().tolist():
            degrees = float(torch.rad2deg(off[k]))
            notes[k] = (f"cameras follow a path of constant angular velocity (median deviation {degrees:.1f} degrees)",)
        return torch.where(even[:, None, None, None], path[..., :2, :], rows), notes


def _join(
    points: Tensor, cameras: Tensor | None, counts: Sequence[int], starts: Sequence[list[int]]
) -> tuple[Tensor, Tensor]:
    """Windows (K, V, T, ...) of clips as one run (K, F, ...) each, padded; clips of one length are joined together.

    Without cameras, the second is empty.
    """
    parts: list[tuple[Tensor, Tensor]] = []
    order = sorted(range(len(counts)), key=lambda i: counts[i])
    for frames, group in itertools.groupby(order, key=lambda i: counts[i]):
        index = list(group)
        some: slice | list[int] = slice(None) if len(index) == len(counts) else index
        x, r = join_windows(points[some], None if cameras is None else cameras[some], starts[index[0]], frames)
        parts += zip(x, x[..., :0, :] if r is None else r, strict=True)
    back = sorted(range(len(order)), key=order.__getitem__)
    joined, rows = (padded([parts[i][end] for i in back]) for end in (0, 1))
    return joined, rows


def _variation(points: Tensor, weights: Tensor, skeleton: Skeleton, inside: Tensor | None) -> Tensor:
    """How much rigid bones of points (..., T, N, 3) vary in length, (...,), a share; 1 where there are none.

    Bones of joints that no frame shows, by weights (..., T, N), do not count.
    """
    bones = skeleton.bone_index(device=points.device)[list(skeleton.rigid)]
    lengths = bone_lengths(points, bones)  # (..., T, B)
    real = torch.ones_like(lengths[..., :1]) if inside is None else inside[..., None].to(lengths)
    count = real.sum(-2)
    mean = (lengths * real).sum(-2) / count
    off = ((lengths - mean[..., None, :]) * real).square().sum(-2) / count / or_one(mean).square()
    shown = (weights > 0).any(-2)[..., bones].all(-1).to(lengths)  # (..., B)
    told = shown.sum(-1)
    return torch.where(told > 0, ((off * shown).sum(-1) / or_one(told)).sqrt() + GRANTED, 1)


def _fill_blank_frames(clips: Clips) -> Clips:
    """Fill frames without any seen joint between their neighbours, and count them as seen.

    No term would hold the shape of such a frame, and the nuclear norm would shrink it.
    """
    seen = clips.weights > 0
    made = ~seen.any(-1, keepdim=True) & seen.any(-2, keepdim=True)
    if clips.inside is not None:
        made = made & clips.inside[..., None]
    points = torch.where(made[..., None], interpolate(clips.points, seen), clips.points)
    return replace(clips, points=points, weights=torch.where(made, torch.ones_like(clips.weights), clips.weights))
