"""The Procrustean objective's value and gradient in one pass, written out: what its stages spend their time on."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from kcs_torch.functional.chain import incidence

if TYPE_CHECKING:
    from kcs_torch.solvers.procrustean import Stage

__all__ = ["Descent", "turn_by", "turn_slopes"]


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
        change: eps of the changes, a share of the poses'.
        reach: slacks, and standard deviations of the tracks, from which on nothing pulls.
        tracks: (T, N, 2), where they are not exact.
        weights: (T, N) of them.
        noise: of them; 0 holds x and y.
        extra: further energy (H,) of points (H, T, N, 3), whose gradient autograd tells.
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
        change: float,
        reach: float,
        tracks: Tensor,
        weights: Tensor,
        noise: float,
        extra: Callable[[Tensor], Tensor] | None = None,
    ) -> None:
        joints = points.shape[-2]
        self.stage, self.change, self.reach, self.noise, self.extra = stage, change, reach, noise, extra
        self.free = 3 if noise > 0 else 1
        self.base, self.turns = points, rotations
        self.points = points.permute(0, 3, 2, 1).contiguous()  # (H, 3, N, T)
        self.rotations = rotations.permute(0, 2, 3, 1).contiguous()  # (H, 3, 3, T)
        self.roots, self.rows = roots, roots.mT.contiguous()  # a row times a matrix is the faster product
        self.ends = incidence(bones, joints, dtype=points.dtype).mT  # (B, N)
        self.pairs = None if torch.equal(bones, rigid) else incidence(rigid, joints, dtype=points.dtype).mT
        self.rigid, self.stiffness = len(rigid) > 0, stiffness
        self.tracks, self.weights = tracks.permute(2, 1, 0).contiguous(), weights.mT.contiguous()  # (2, N, T), (N, T)

    def moved(self, u: Tensor) -> tuple[Tensor, Tensor]:
        """Points (H, T, N, 3) and rotations (H, T, 3, 3) of steps u (H, T D)."""
        points, _, rotations, _ = self._move(u)
        return points.permute(0, 3, 2, 1).contiguous(), rotations.permute(0, 3, 1, 2).contiguous()

    def _move(self, u: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Points (H, 3, N, T), rotation vectors (H, 3, T), rotations (H, 3, 3, T) and what they turned by."""
        count, _, joints, frames = self.points.shape
        step = (u.view(count, frames, 1, -1) @ self.rows).squeeze(-2).mT.contiguous()  # (H, D, T)
        shift = step[:, :-3].view(count, self.free, joints, frames)
        if self.free == 3:
            points = self.points + shift
        else:
            points = torch.cat([self.points[:, :2], self.points[:, 2:] + shift], 1)
        vector = step[:, -3:]
        turned = turn_by(vector)
        return points, vector, (turned[:, :, :, None] * self.rotations[:, None]).sum(2), turned

    def __call__(self, u: Tensor) -> tuple[Tensor, Tensor]:
        """Value (H,) and gradient (H, T D) of steps u (H, T D)."""
        count, _, joints, frames = self.points.shape
        points, vector, rotations, _ = self._move(u)
        bones = self.ends @ points  # (H, 3, B, T)
        aligned = rotations[:, 0, :, None] * bones[:, 0, None]  # (H, 3, B, T)
        aligned.addcmul_(rotations[:, 1, :, None], bones[:, 1, None])
        aligned.addcmul_(rotations[:, 2, :, None], bones[:, 2, None])
        value, pull = self._motion(aligned.view(count, -1, frames))
        pull = pull.view_as(aligned)
        first = 3 - self.free
        drawn = torch.stack([(rotations[:, j, :, None] * pull).sum(1) for j in range(first, 3)], 1)  # (H, free, B, T)
        turned = torch.stack([(pull * bones[:, j, None]).sum(2) for j in range(3)], 1)  # (H, 3, 3, T): of R_jk
        slope = points.new_zeros(count, self.free, joints, frames)
        if self.rigid:
            pairs = bones if self.pairs is None else self.pairs @ points
            cost, along = self._lengths(pairs)
            value = value + cost
            if self.pairs is None:
                drawn += along
            else:
                slope += self.pairs.mT @ along
        slope += self.ends.mT @ drawn
        if self.noise > 0:
            value = value + self._tracks(points, slope)
        if self.extra is not None:
            with torch.enable_grad():
                leaf = points.permute(0, 3, 2, 1).requires_grad_()
                cost = self.extra(leaf)
                (more,) = torch.autograd.grad(cost.sum(), leaf)
            value = value + cost.detach()
            slope += more.permute(0, 3, 2, 1)[:, first:]
        spun = turn_slopes(vector, (turned[:, :, None] * self.rotations[:, None]).sum(3))
        step = torch.cat([slope.flatten(1, 2), spun], 1).mT  # (H, T, D)
        return value, (step.unsqueeze(-2) @ self.roots).reshape(count, -1)

    def _motion(self, aligned: Tensor) -> tuple[Tensor, Tensor]:
        """The log-determinants (H,) of aligned bones (H, 3 B, T), and their gradient."""
        stage, frames = self.stage, aligned.shape[-1]
        value = aligned.new_zeros(len(aligned))
        slope = torch.zeros_like(aligned) if stage.still <= 0 else None
        if stage.still > 0:
            mean = aligned.mean(-1, keepdim=True)
            scatter = torch.baddbmm(mean @ mean.mT, aligned, aligned.mT, beta=-1, alpha=1 / frames)
            log_det, inverse = _determinant(scatter, stage.eps)
            value = value + stage.still * frames / 2 * log_det
            inverse = inverse * stage.still
            slope = torch.baddbmm(inverse @ mean, inverse, aligned, beta=-1)
        assert slope is not None
        if stage.moving > 0 and frames > 2:
            change = aligned.diff()
            log_det, inverse = _determinant(torch.bmm(change, change.mT) / (frames - 1), self.change * stage.eps)
            value = value + stage.moving * (frames - 1) / 2 * log_det
            pull = torch.bmm(inverse * stage.moving, change)
            slope[..., 1:] += pull
            slope[..., :-1] -= pull
        return value, slope

    def _lengths(self, pairs: Tensor) -> tuple[Tensor, Tensor]:
        """The energy (H,) of lengths that vary, and its gradient (H, free, P, T) in the pairs (H, 3, P, T)."""
        frames, least = pairs.shape[-1], self.stage.slack**2
        size = pairs.square().sum(1).sqrt()  # (H, P, T)
        off = size - size.mean(-1, keepdim=True)
        spread = off.square().mean(-1)
        low, high = spread + least, spread + self.reach**2 * least
        pull = self.stiffness * (1 / low - 1 / high)
        along = off.mul_(pull[..., None]).div_(size.masked_fill_(size == 0, torch.inf))
        value = frames / 2 * (self.stiffness * (low / high).log()).sum(-1)
        return value, along[:, None] * pairs[:, 3 - self.free :]

    def _tracks(self, points: Tensor, slope: Tensor) -> Tensor:
        off = points[:, :2] - self.tracks
        square = off.square().sum(1).mul_(1 / (self.reach * self.noise) ** 2)  # (H, N, T)
        slope[:, :2] += off * (self.weights / self.noise**2 / (1 + square))[:, None]
        return self.reach**2 / 2 * (self.weights * square.log1p()).sum((-2, -1))


def turn_by(vector: Tensor) -> Tensor:
    """Rotation matrices (..., 3, 3, T) of rotation vectors (..., 3, T), by Rodrigues' formula."""
    square, sine, versine = _rodrigues(vector)
    x, y, z = (vector * sine).unbind(-2)
    zero = torch.zeros_like(x)
    cross = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], -2).unflatten(-2, (3, 3))
    out = torch.addcmul(cross, (vector * versine).unsqueeze(-2), vector.unsqueeze(-3))
    out.diagonal(dim1=-3, dim2=-2).add_((1 - versine * square).mT)
    return out


def turn_slopes(vector: Tensor, slopes: Tensor) -> Tensor:
    """Slopes in rotation vectors (..., 3, T), of slopes (..., 3, 3, T) in the matrices that :func:`turn_by` gives."""
    square, sine, versine = _rodrigues(vector)
    (aa, ab, ac), (ba, bb, bc), (ca, cb, cc) = (row.unbind(-2) for row in slopes.unbind(-3))
    twist = torch.stack([cb - bc, ac - ca, ba - ab], -2)
    both = ((slopes + slopes.transpose(-3, -2)) * vector.unsqueeze(-3)).sum(-2)  # (G + G^T) w
    # Slopes of sine and versine in half the squared angle: what rounding does to them near 0, the vector undoes.
    safe = square.clamp_min(torch.finfo(square.dtype).tiny)
    bent = (1 - versine * square - sine) / safe, (sine / 2 - versine) / safe
    along = bent[0] * (vector * twist).sum(-2, keepdim=True) + bent[1] * (vector * both).sum(-2, keepdim=True)
    return sine * twist + versine * both + (along - sine * (aa + bb + cc).unsqueeze(-2)) * vector


def _rodrigues(vector: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """The squared angle q, sin(angle) / angle and (1 - cos(angle)) / q, (..., 1, T) each."""
    square = vector.square().sum(-2, keepdim=True)
    turns = square.sqrt() / math.pi
    return square, turns.sinc(), (turns / 2).sinc().square() / 2


def _determinant(scatter: Tensor, eps: float) -> tuple[Tensor, Tensor]:
    """Log-determinant (H,) and inverse (H, D, D) of scatter + eps I; NaN where nothing is left of eps."""
    scatter.diagonal(dim1=-2, dim2=-1).add_(eps)
    factor, info = torch.linalg.cholesky_ex(scatter)
    factor = torch.where((info == 0)[..., None, None], factor, torch.full_like(factor, torch.nan))
    return 2 * factor.diagonal(dim1=-2, dim2=-1).log().sum(-1), torch.cholesky_inverse(factor)
