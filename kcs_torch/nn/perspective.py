"""Reprojection through a pinhole, as an energy of relative or of absolute points."""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor, nn

from kcs_torch.errors import OptionError, ShapeError
from kcs_torch.functional.camera import perspective, pinhole_translation
from kcs_torch.functional.guarded import LOST, or_one, safe_root, unit_size
from kcs_torch.functional.precision import full_precision, narrow, wide
from kcs_torch.functional.shapes import fit_together
from kcs_torch.functional.weights import known, seen_weights
from kcs_torch.nn.checks import check_clip, check_one, check_tensor, check_weights, shown
from kcs_torch.nn.reprojection import huber_square
from kcs_torch.types.hints import is_a
from kcs_torch.types.intrinsics import SKEW, Intrinsics

__all__ = ["PerspectiveEnergy"]

BEHIND = 0.01
"""What a distance behind the camera counts for, beside the body's size: one joint has none."""


class PerspectiveEnergy(nn.Module):
    """1/2 sum_n w_n |pi(x_n + t) - y_n|^2 of each frame, pi(X) = (fx X/Z + cx, fy Y/Z + cy).

    The translation t, where the body stands, is found from the rays by linear least squares
    (:func:`kcs_torch.functional.pinhole_translation`), so that points may be about any origin and in any unit.
    Gradients run through it. What would lie behind the camera, or too close, is seen as if it were at the nearest
    depth, and charged 1/2 w fx fy (how far behind, in nearest depths)^2 on top.

    Args:
        translation: False leaves t at 0: points are where they are before the camera.
        huber: residuals above this length count linearly, in the unit of the tracks; None is plain least squares.
        nearest: share of the body's distance before the camera (or of its size, where that is more) that joints keep
            from the camera.

    Raises:
        OptionError: ``huber`` or ``nearest`` is not positive.

    >>> energy = PerspectiveEnergy()
    >>> energy(torch.randn(4, 30, 17, 3), torch.randn(4, 30, 17, 2), (1000, 1000, 0, 0)).shape
    torch.Size([4, 30])
    """

    def __init__(self, *, translation: bool = True, huber: float | None = None, nearest: float = 0.15) -> None:
        super().__init__()
        numbers = all(is_a(x, float) and x > 0 for x in (nearest, 1.0 if huber is None else huber))
        if not numbers or nearest == math.inf:
            raise OptionError(
                "PerspectiveEnergy: expected a positive huber length or None, and a finite positive nearest depth, "
                f"got {huber!r} and {nearest!r}"
            )
        self.translation, self.huber, self.nearest = translation, huber, nearest

    def extra_repr(self) -> str:
        return shown(self, "translation", "huber", "nearest")

    def forward(self, points: Tensor, tracks: Tensor, intrinsics: Any, weights: Tensor | None = None) -> Tensor:
        """Return the energy of each frame.

        Args:
            points: (..., T, N, 3) in the camera's axes.
            tracks: (..., T, N, 2), NaN where unseen.
            intrinsics: of all clips: (fx, fy, cx, cy), K (3, 3) or :class:`kcs_torch.types.Intrinsics`; of each clip: a
                tensor (..., 4) or (..., 3, 3). In the unit of the tracks.
            weights: (..., T, N) confidences; 0 where unseen.

        Returns:
            (..., T), in squared units of the tracks. 0 where one joint is seen, which can be anywhere on its ray.

        Raises:
            ShapeError: the shapes do not fit.
            OptionError: the intrinsics make no sense.
        """
        check_clip(points, self)
        check_weights(weights, points, self)
        check_tensor(tracks, "tracks", self)
        fits = tracks.shape[-3:] == (*points.shape[-3:-1], 2) and fit_together(tracks.shape[:-3], points.shape[:-3])
        if not fits or points.shape[-1] != 3:
            expected = f"points (..., T, N, 3) and tracks (..., {points.shape[-3]}, {points.shape[-2]}, 2)"
            got = f"{tuple(points.shape)} and {tuple(tracks.shape)}"
            raise ShapeError(f"PerspectiveEnergy: expected {expected}, got {got}")
        with full_precision(points):
            lens = lens_tensor(intrinsics, wide(points))
            if not fit_together(lens.shape[:-1], points.shape[:-3]):
                got = f"got those of {tuple(lens.shape[:-1])} for points {tuple(points.shape)}"
                raise ShapeError(f"PerspectiveEnergy: expected intrinsics of all clips, or of each, {got}")
            check_one(lens, 1, "intrinsics (4,)", points, self)
            lens = lens[..., None, None, :]  # (..., 1, 1, 4)
            weights = seen_weights(tracks, weights)
            at, seen = unit_size(wide(known(points, weights)), 2), known(wide(tracks), weights)
            share = weights.to(at.dtype).expand(at.shape[:-1])
            if self.translation:
                at = at + pinhole_translation(at, (seen - lens[..., 2:]) / lens[..., :2], share)[..., None, :]
            near = self.nearest * _reach(at, share)[..., None]
            behind = (near - at[..., 2]).clamp_min(0) / near
            ahead = torch.cat([at[..., :2], torch.maximum(at[..., 2], near)[..., None]], -1)
            square = huber_square((perspective(ahead, lens) - seen).square().sum(-1), self.huber)
            square = square + lens[..., 0] * lens[..., 1] * behind.square()
            return narrow(0.5 * (square * share).sum(-1), points)


def lens_tensor(intrinsics: Any, like: Tensor) -> Tensor:
    """Intrinsics as a tensor (..., 4) of fx, fy, cx, cy, of which tensors have a derivative.

    Raises:
        OptionError: some make no sense; numbers that are being traced or mapped are not looked at.
    """
    if not isinstance(intrinsics, Tensor):
        return Intrinsics.of(intrinsics).tensor(like)
    matrices = intrinsics.shape[-2:] == (3, 3)
    if not matrices and intrinsics.shape[-1:] != (4,):
        return Intrinsics.of(intrinsics).tensor(like)  # which tells what is wrong
    lens = intrinsics
    if matrices:
        each = [intrinsics[..., row, column] for row, column in ((0, 0), (1, 1), (0, 2), (1, 2))]
        lens = torch.stack(each, -1)
    wrong = ~(lens.isfinite().all(-1) & (lens[..., :2] > 0).all(-1))
    if matrices:
        rest = intrinsics[..., [1, 2, 2], [0, 0, 1]].abs().sum(-1) + (intrinsics[..., 2, 2] - 1).abs()
        wrong = wrong | (rest != 0) | (intrinsics[..., 0, 1].abs() > SKEW * intrinsics[..., 0, 0].abs())
    if not (torch.compiler.is_compiling() or wrong.is_meta) and _any(wrong):
        at = tuple(wrong.nonzero()[0].tolist())
        Intrinsics.of(intrinsics[at].detach())  # tells it
    return lens.to(like)


def _any(flags: Tensor) -> bool:
    """Whether any is true; False under ``torch.func.vmap``, where no number can be looked at."""
    try:
        return bool(flags.any())
    except RuntimeError:
        return False


def _reach(points: Tensor, share: Tensor) -> Tensor:
    """Distance of a body (..., N, 3) before the camera along z, or its size, where that is more, (...).

    1 where neither is more than rounding of points of size 1: what is divided by it has bounds.

    Were the distance behind the camera to count like that before it, what lies behind would cost the same however far:
    nothing would push it ahead.
    """
    total = or_one(share.sum(-1, keepdim=True))[..., None]
    middle = (share[..., None] * points).sum(-2, keepdim=True) / total
    size = safe_root((share[..., None] * (points - middle).square() / total).sum((-2, -1)))
    far = middle[..., 0, 2]
    reach = torch.maximum(torch.maximum(far, -BEHIND * far), size)
    return torch.where(reach > LOST * torch.finfo(reach.dtype).eps, reach, torch.ones_like(reach))
