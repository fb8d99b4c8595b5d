"""Reprojection under weak perspective: an energy, and its residual with the translation at its optimum."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from kcs_torch.errors import OptionError, ShapeError
from kcs_torch.functional.camera import back_project, project
from kcs_torch.functional.guarded import or_one
from kcs_torch.functional.precision import full_precision, narrow, wide
from kcs_torch.functional.shapes import fit_together
from kcs_torch.functional.weights import known, seen_weights
from kcs_torch.nn.checks import check_clip, check_tensor, check_weights, shown
from kcs_torch.types.hints import is_a

__all__ = ["ReprojectionEnergy", "centred_residual", "huber_square"]


class ReprojectionEnergy(nn.Module):
    """1/2 sum_n w_n |R x_n + t - y_n|^2 of each frame, the translation t at its least-squares optimum.

    Args:
        translation: False leaves t at 0 (points and tracks already share an origin).
        huber: residuals above this length count linearly, in the unit of the tracks; None is plain least squares.

    Raises:
        OptionError: ``huber`` is not positive.
    """

    def __init__(self, *, translation: bool = True, huber: float | None = None) -> None:
        super().__init__()
        if huber is not None and not (is_a(huber, float) and huber > 0):
            raise OptionError(f"ReprojectionEnergy: expected a positive huber length or None, got {huber!r}")
        self.translation, self.huber = translation, huber

    def extra_repr(self) -> str:
        return shown(self, "translation", "huber")

    def forward(
        self, points: Tensor, tracks: Tensor, cameras: Tensor | None = None, weights: Tensor | None = None
    ) -> Tensor:
        """Return the energy of each frame.

        Args:
            points: (..., T, N, 3).
            tracks: (..., T, N, 2), NaN where unseen.
            cameras: (..., T, 2, 3), scaled rows allowed; None: points are in the camera frame.
            weights: (..., T, N) confidences; 0 where unseen.

        Returns:
            (..., T), in squared units of the tracks.

        Raises:
            ShapeError: the shapes do not fit.
        """
        square = huber_square(self._residual(points, tracks, cameras, weights).square().sum(-1), self.huber)
        return narrow(0.5 * (square * seen_weights(tracks, weights)).sum(-1), finer(points, tracks))

    def residual(
        self, points: Tensor, tracks: Tensor, cameras: Tensor | None = None, weights: Tensor | None = None
    ) -> Tensor:
        """R x + t - y, (..., T, N, 2); of no meaning where the weight is 0 or a track NaN."""
        return narrow(self._residual(points, tracks, cameras, weights), finer(points, tracks))

    def _residual(self, points: Tensor, tracks: Tensor, cameras: Tensor | None, weights: Tensor | None) -> Tensor:
        """The same, at least in single precision: a sum of pixels over joints leaves the range of half precision."""
        check_clip(points, self)
        check_tensor(tracks, "tracks", self)
        if tracks.shape[-3:] != (*points.shape[-3:-1], 2) or not fit_together(tracks.shape[:-3], points.shape[:-3]):
            expected = f"(..., {points.shape[-3]}, {points.shape[-2]}, 2) for points {tuple(points.shape)}"
            raise ShapeError(f"ReprojectionEnergy: expected tracks {expected}, got {tuple(tracks.shape)}")
        if cameras is not None:
            check_tensor(cameras, "cameras", self)
            fits = fit_together(cameras.shape[:-3], points.shape[:-3])
            if cameras.shape[-3:] != (points.shape[-3], 2, 3) or not fits or points.shape[-1] != 3:
                expected = f"points (..., T, N, 3) and cameras (..., {points.shape[-3]}, 2, 3)"
                got = f"{tuple(points.shape)} and {tuple(cameras.shape)}"
                raise ShapeError(f"ReprojectionEnergy: expected {expected}, got {got}")
        check_weights(weights, points, self)
        weights = wide(seen_weights(tracks, weights))
        points, tracks = known(wide(points), weights), known(wide(tracks), weights)
        with full_precision(points):
            dtype = torch.promote_types(points.dtype, tracks.dtype)
            seen = points[..., :2] if cameras is None else project(points.to(dtype), cameras.to(dtype))
        return centred_residual(seen, tracks, weights) if self.translation else seen - tracks

    def grad(self, points: Tensor, tracks: Tensor, cameras: Tensor, weights: Tensor | None = None) -> Tensor:
        """Gradient in ``points`` of the plain least-squares energy, R^T (w o residual): (..., T, N, 3)."""
        check_tensor(cameras, "cameras", self)
        residual = self.residual(points, tracks, cameras, weights)
        return back_project(residual * seen_weights(tracks, weights)[..., None].to(residual), cameras.to(residual))


def finer(points: Tensor, tracks: Tensor) -> Tensor:
    """That of the two which has more digits."""
    return tracks if torch.promote_types(points.dtype, tracks.dtype) == tracks.dtype else points


def huber_square(square: Tensor, huber: float | None) -> Tensor:
    """Squared lengths, beyond ``huber`` growing with the length only."""
    if huber is None:
        return square
    far = square > huber**2
    root = torch.where(far, square, torch.ones_like(square)).sqrt()
    return torch.where(far, 2 * huber * root - huber**2, square)


def centred_residual(seen: Tensor, tracks: Tensor, weights: Tensor | None) -> Tensor:
    """``seen - tracks`` minus its weighted mean over joints: the translation at its optimum."""
    difference = seen - tracks
    if weights is None:
        return difference - difference.mean(-2, keepdim=True)
    share = weights[..., None]
    total = share.sum(-2, keepdim=True)
    return difference - (difference * share).sum(-2, keepdim=True) / or_one(total)
