"""The Procrustean objective's value and gradient in one pass, written out: what its stages spend their time on."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from copy import copy
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from kcs_torch.functional.chain import incidence
from kcs_torch.solvers.curvature import CHANGE, REACH, shown

if TYPE_CHECKING:
    from kcs_torch.solvers.procrustean import Stage

__all__ = ["Descent", "Turn", "cross_matrix"]


RUN = 4096
"""Frames of a long clip whose changes and slopes are made at a time: they would be most of an evaluation's memory."""


class Descent:
    """Energy (H,) and gradient (H, T D) of one stage over steps that ``roots`` whiten, D = free N + 3.

    Equal to autograd's of the stage's energies, see :func:`kcs_torch.solvers.procrustean`: a frame's step is
    ``roots @ u``, shifts of the joints' last ``free`` coordinates and a rotation vector. Time comes last inside, so
    that what belongs to a bone or to a frame is spread over long rows.

    Args:
        points: (H, T, N, 3) to start from.
        rotations: (H, T, 3, 3) to start from.
        roots: (H, T, D, D).
        bones: (B, 2).
        rigid: (P, 2) pairs that keep their distance.
        stiffness: (P,).
        stage: weights and scales.
        tracks: (T, N, 2), where they are not exact.
        weights: (T, N) of them.
        noise: of them; 0 holds x and y.
        counts: (H,) frames of each start, where some are padded with zeros.
        anchor: depths (H, T, N) that hold each depth, and by what weights (H,); or None.
    """

    def __init__(
        self,
        points: Tensor,
        rotations: Tensor,
        roots: Tensor,
        bones: Tensor,
        rigid: Tensor,
        stiffness: Tensor,
        stage: Stage,
        *,
        tracks: Tensor,
        weights: Tensor,
        noise: float,
        counts: Tensor | None = None,
        anchor: tuple[Tensor, Tensor] | None = None,
    ) -> None:
        joints = points.shape[-2]
        self.slack, self.noise = stage.slack, noise
        self.free = 3 if noise > 0 else 1
        self.points = points.permute(0, 3, 2, 1).contiguous()  # (H, 3, N, T)
        self.rotations = rotations.permute(0, 2, 3, 1).contiguous()  # (H, 3, 3, T)
        self.away: Tensor | None = None
        if anchor is not None:
            self.away, self.anchor = (points[..., 2] - anchor[0]).mT.contiguous(), anchor[1]  # (H, N, T) and (H,)
        self.roots = roots
        self.ends = incidence(bones, joints, dtype=points.dtype).mT  # (B, N)
        self.pairs = None if torch.equal(bones, rigid) else incidence(rigid, joints, dtype=points.dtype).mT
        self.rigid, self.stiffness = len(rigid) > 0, stiffness
        if noise > 0:
            self.tracks, self.weights = (
                tracks.permute(2, 1, 0).contiguous(),
                weights.mT.contiguous(),
            )  # (2, N, T), (N, T)
        self.bones = self.ends @ self.points  # (H, 3, B, T), of which the first 3 - free never move
        self.links = self.bones if self.pairs is None else self.pairs @ self.points  # (H, 3, P, T)
        self.flat = self.links[:, : 3 - self.free].square().sum(1)  # (H, P, T)
        self.cross = cross_matrix(points)
        frames = points.shape[1]
        self.still, self.moving = stage.still > 0, stage.moving > 0 and frames > 2
        self.counts = points.new_tensor([float(frames)]) if counts is None else counts  # (1,) or (H,)
        self.within = None if counts is None else shown(counts, frames)[:, None]  # (H, 1, T)
        levels = [(stage.still, stage.eps, 0)] if self.still else []
        levels += [(stage.moving, CHANGE * stage.eps, 1)] if self.moving else []
        # weights, eps and frames less than the clip's of the log-determinants: (levels, 1, 1, 1) each
        *self.levels, less = points.new_tensor(levels).view(len(levels), 3, 1, 1, 1).unbind(1)
        self.frames = (self.counts[:, None, None] - less).clamp_min_(1)  # (levels, 1 or H, 1, 1)

    def rows(self, index: Tensor) -> Descent:
        """That of some hypotheses."""
        out = copy(self)
        for name in ("points", "rotations", "roots", "bones", "links", "flat"):
            setattr(out, name, getattr(self, name)[index])
        if self.within is not None:
            out.within, out.counts, out.frames = self.within[index], self.counts[index], self.frames[:, index]
        if self.away is not None:
            out.away, out.anchor = self.away[index], self.anchor[index]
        return out

    def moved(self, u: Tensor) -> tuple[Tensor, Tensor]:
        """Points (H, T, N, 3) and rotations (H, T, 3, 3) of steps u (H, T D)."""
        shift, turn = self._step(u)
        rotations = _times(turn.matrices(), self.rotations)
        return self._placed(shift), rotations.permute(0, 3, 1, 2).contiguous()

    def _step(self, u: Tensor) -> tuple[Tensor, Turn]:
        """Shifts (H, free, N, T) and turns."""
        count, _, joints, frames = self.points.shape
        step = (u.view(count, frames, 1, -1) @ self.roots.mT).squeeze(-2).mT.contiguous()  # (H, D, T)
        return step[:, :-3].view(count, self.free, joints, frames), Turn(step[:, -3:], self.cross)

    def _placed(self, shift: Tensor) -> Tensor:
        """Shifted points (H, T, N, 3)."""
        points = self.points.clone()
        points[:, -self.free :] += shift
        return points.permute(0, 3, 2, 1).contiguous()

    def __call__(self, u: Tensor) -> tuple[Tensor, Tensor]:
        """Value (H,) and gradient (H, T D) of steps u (H, T D)."""
        count, _, _, frames = self.points.shape
        shift, turn = self._step(u)
        rotations = _times(turn.matrices(), self.rotations)
        loose = self.bones[:, -self.free :] + self.ends @ shift  # (H, free, B, T)
        bones = [*self.bones[:, : -self.free].unbind(1), *loose.unbind(1)]  # (H, B, T) each
        aligned = rotations[:, 0, :, None] * bones[0][:, None]  # (H, 3, B, T)
        for j in (1, 2):
            aligned.addcmul_(rotations[:, j, :, None], bones[j][:, None])
        value, slopes = self._motion(aligned.view(count, -1, frames))
        turned, drawn = rotations.new_empty(count, 3, 3, frames), torch.empty_like(loose)
        for run in _runs(frames):
            pull = slopes(run).unflatten(1, (3, -1))
            for j, bone in enumerate(bones):
                torch.sum(pull * bone[:, None, :, run], 2, out=turned[:, j, :, run])  # of R_jk
            for j in range(self.free):
                torch.sum(rotations[:, j - self.free, :, None, run] * pull, 1, out=drawn[:, j, :, run])
        # drawn is the gradient (H, free, B, T) in the bones, slope (H, free, N, T) in the joints
        if not self.rigid:
            slope = self.ends.mT @ drawn
        elif self.pairs is None:
            cost, along = self._lengths(loose)
            value, slope = value + cost, self.ends.mT @ drawn.add_(along)
        else:
            cost, along = self._lengths(self.links[:, -self.free :] + self.pairs @ shift)
            value, slope = value + cost, self.ends.mT @ drawn + self.pairs.mT @ along
        if self.noise > 0:
            value = value + self._tracks(self.points + shift, slope)
        if self.away is not None:
            off = self.away + shift[:, -1]
            value = value + self.anchor / 2 * off.square().sum((-2, -1))
            slope[:, -1] += self.anchor[:, None, None] * off
        spun = turn.slopes((turned[:, :, None] * self.rotations[:, None]).sum(3))
        step = torch.cat([slope.flatten(1, 2), spun], 1).mT.contiguous()  # (H, T, D)
        return value, (step.unsqueeze(-2) @ self.roots).view(count, -1)

    def _motion(self, aligned: Tensor) -> tuple[Tensor, Callable[[slice], Tensor]]:
        """The log-determinants (H,) of aligned bones (H, 3 B, T), centred in place, and their slopes in runs of frames.

        Of few frames, Y^T Y is the smaller matrix: it has the eigenvalues of Y Y^T but for zeros, and
        (Y Y^T + e I)^-1 Y = Y (Y^T Y + e I)^-1.
        """
        weights, eps = self.levels
        last = aligned.shape[-1]
        zeros = max(0, aligned.shape[1] - last)
        aligned -= self._mean(aligned)
        if self.within is not None:
            aligned *= self.within

        def changes(run: slice) -> Tensor:
            """To the next frame, 0 from the last one on."""
            some = aligned[..., run.start : run.stop + 1].diff()
            some = some if run.stop < last else torch.nn.functional.pad(some, (0, 1))
            if self.within is not None:  # 0 in its last frame, too
                some *= torch.nn.functional.pad(self.within[..., 1:], (0, 1))[..., run]
            return some

        kept = changes(slice(0, last)) if self.moving and last <= RUN else None
        poses = lambda run: aligned[..., run]  # noqa: E731
        moves = changes if kept is None else lambda run: kept[..., run]
        levels = [poses] * self.still + [moves] * self.moving
        if not levels:
            return aligned.new_zeros(len(aligned)), lambda run: torch.zeros_like(aligned[..., run])
        square = lambda y: torch.bmm(y.mT, y) if zeros else torch.bmm(y, y.mT)  # noqa: E731
        # (levels, H, 3 B, 3 B) or (levels, H, T, T)
        parts = (torch.stack([square(rows(run)) for rows in levels]) for run in _runs(last))
        scatter = functools.reduce(Tensor.add_, parts).div_(self.frames)
        scatter.diagonal(dim1=-2, dim2=-1).add_(eps[..., 0])
        factor, info = torch.linalg.cholesky_ex(scatter)
        factor.masked_fill_((info != 0)[..., None, None], torch.nan)  # where nothing is left of eps
        half = factor.diagonal(dim1=-2, dim2=-1).log().sum(-1)
        value = ((weights * self.frames)[..., 0, 0] * (half + zeros / 2 * eps[..., 0, 0].log())).sum(0)
        inverse = torch.cholesky_inverse(factor).mul_(weights)
        times = lambda y, part: torch.bmm(y, part) if zeros else torch.bmm(part, y)  # noqa: E731

        def slopes(run: slice) -> Tensor:
            slope = times(poses(run), inverse[0]) if self.still else torch.zeros_like(poses(run))
            if self.moving:
                early = min(run.start, 1)
                pull = times(moves(slice(run.start - early, run.stop)), inverse[-1])
                slope -= pull[..., early:]
                slope[..., 1 - early :] += pull[..., :-1]
            return slope

        return value, slopes

    def _mean(self, values: Tensor) -> Tensor:
        """Over the frames of each clip, (H, D, 1) of (H, D, T) that are zero beyond them."""
        if self.within is None:
            return values.mean(-1, keepdim=True)
        return values.sum(-1, keepdim=True) / self.counts[:, None, None]

    def _lengths(self, loose: Tensor) -> tuple[Tensor, Tensor]:
        """The energy (H,) of lengths that vary, and its gradient (H, free, P, T) in the pairs' free coordinates."""
        least = self.slack**2
        size = (self.flat + loose.square().sum(1)).sqrt_()  # (H, P, T)
        off = size - self._mean(size)
        if self.within is not None:
            off *= self.within
        spread = self._mean(off.square())[..., 0]
        low, high = spread + least, spread + REACH**2 * least
        pull = self.stiffness * (1 / low - 1 / high)
        along = off.mul_(pull[..., None]).div_(size.clamp_min_(torch.finfo(size.dtype).tiny ** 0.5))
        value = self.counts / 2 * (self.stiffness * (low / high).log()).sum(-1)
        return value, along[:, None] * loose

    def _tracks(self, points: Tensor, slope: Tensor) -> Tensor:
        off = points[:, :2] - self.tracks
        square = off.square().sum(1).mul_(1 / (REACH * self.noise) ** 2)  # (H, N, T)
        slope[:, :2] += off * (self.weights / self.noise**2 / (1 + square))[:, None]
        return REACH**2 / 2 * (self.weights * square.log1p()).sum((-2, -1))


class Turn:
    """Turns by rotation vectors w, exp [w] = (1 - c q) I + s [w] + c w w^T by Rodrigues' formula.

    q is the squared angle, s = sin(angle) / angle and c = (1 - cos(angle)) / q.

    Args:
        vector: (..., 3, T).
        cross: :func:`cross_matrix`.
    """

    def __init__(self, vector: Tensor, cross: Tensor) -> None:
        self.vector, self.cross, self.square = vector, cross, vector.square().sum(-2, keepdim=True)  # (..., 1, T)
        half = self.square.sqrt() / (2 * math.pi)
        self.sine, self.versine = (2 * half).sinc(), half.sinc().square_().div_(2)

    def matrices(self) -> Tensor:
        """Rotation matrices (..., 3, 3, T)."""
        out = (self.cross @ (self.vector * self.sine)).unflatten(-2, (3, 3))
        out.addcmul_((self.vector * self.versine).unsqueeze(-2), self.vector.unsqueeze(-3))
        out.diagonal(dim1=-3, dim2=-2).add_((1 - self.versine * self.square).mT)
        return out

    def slopes(self, slopes: Tensor) -> Tensor:
        """Slopes in the vectors (..., 3, T), of slopes in the matrices (..., 3, 3, T)."""
        vector, sine, versine = self.vector, self.sine, self.versine
        twist = self.cross.mT @ slopes.flatten(-3, -2)
        both = ((slopes + slopes.transpose(-3, -2)) * vector.unsqueeze(-3)).sum(-2)  # (G + G^T) w
        # Slopes of sine and versine in half the squared angle: what rounding does to them near 0, the vector undoes.
        safe = self.square.clamp_min(torch.finfo(vector.dtype).tiny)
        even = 1 - versine * self.square
        bent = (even - sine) / safe * twist + (sine / 2 - versine) / safe * both
        trace = slopes.diagonal(dim1=-3, dim2=-2).sum(-1).unsqueeze(-2)
        along = (vector * bent).sum(-2, keepdim=True) - sine * trace
        return sine * twist + versine * both + along * vector


def cross_matrix(like: Tensor) -> Tensor:
    """The matrix (9, 3) that makes [w] of w."""
    eye = torch.eye(3, dtype=like.dtype, device=like.device)
    return torch.linalg.cross(eye[None], eye[:, None]).flatten(0, 1)


def _times(left: Tensor, right: Tensor) -> Tensor:
    """Products (H, 3, 3, T) of matrices in each frame."""
    return (left[:, :, :, None] * right[:, None]).sum(2)


def _runs(frames: int) -> list[slice]:
    """Runs of frames that are dealt with at a time."""
    return [slice(begin, min(begin + RUN, frames)) for begin in range(0, frames, RUN)]
