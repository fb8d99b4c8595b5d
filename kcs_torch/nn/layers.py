"""Layers: bones, their lengths, the KCS matrix and singular value thresholding as ``nn.Module``s."""

from __future__ import annotations

import math
from collections.abc import Sequence
from numbers import Integral, Real
from pathlib import Path
from typing import Any, cast

import torch
from torch import Tensor, nn

from kcs_torch.errors import OptionError, ShapeError
from kcs_torch.functional.chain import bone_lengths, bone_vectors, pose_matrix
from kcs_torch.functional.precision import full_precision, wide
from kcs_torch.functional.shapes import check_core, fit_together
from kcs_torch.functional.spectral import svt
from kcs_torch.functional.weights import known
from kcs_torch.skeleton import Skeleton, get_skeleton

__all__ = ["SVT", "BoneLengths", "BoneVectors", "KCSMatrix"]


def check_tensor(value: Any, what: str, module: nn.Module) -> None:
    """Raise a ShapeError unless ``value`` is a tensor."""
    if not isinstance(value, Tensor):
        kind = type(value).__name__
        raise ShapeError(
            f"{type(module).__name__}: expected a tensor of {what}, got {kind}: use torch.as_tensor({what})"
        )


def check_points(points: Any, module: nn.Module, what: str = "points") -> None:
    """Raise a ShapeError unless ``points`` are a tensor of floating-point numbers with at most three coordinates."""
    check_tensor(points, what, module)
    if not points.is_floating_point():
        raise ShapeError(f"{type(module).__name__}: expected {what} in floating point, got {points.dtype}")


def check_beside(
    value: Any, what: str, shape: Sequence[int], clip: Tensor, module: nn.Module, of: str = "points"
) -> None:
    """Raise a ShapeError unless ``value`` is None or a tensor (..., *shape) whose batch fits (..., T, N, D)."""
    if value is None:
        return
    check_tensor(value, what, module)
    given, own = tuple(value.shape), value.ndim - len(shape)
    if own < 0 or given[own:] != tuple(shape) or not fit_together(given[:own], clip.shape[:-3]):
        expected = f"{what} (..., {', '.join(map(str, shape))})"
        raise ShapeError(f"{type(module).__name__}: expected {expected}, got {given} for {of} {tuple(clip.shape)}")


def check_coordinates(points: Tensor, module: nn.Module) -> None:
    """Raise a ShapeError unless ``points`` (..., N, D) have at most three coordinates."""
    if not 0 < points.shape[-1] <= 3:
        raise ShapeError(
            f"{type(module).__name__}: expected points of 2 or 3 coordinates, got {tuple(points.shape)}; confidences "
            "are no coordinate: pass points[..., :3], and weights where the module takes them"
        )


def check_joints(module: nn.Module, skeleton: Skeleton, points: Tensor, form: str) -> None:
    """Raise a ShapeError unless ``points`` have the joints of the skeleton, and are where the module is.

    Args:
        module: which is asking; holds the skeleton's bones.
        skeleton: whose joints they have to be.
        points: (..., N, D).
        form: such as "points (..., T, {}, 3)": what is expected, with a place for the number of joints.
    """
    joints, own = skeleton.num_joints, cast(Tensor, module.bones).device
    if own != points.device:
        name = type(module).__name__
        raise ShapeError(
            f"{name}: expected points on the device of the module, {own}, got {points.device}: move the module, "
            "module.to(points.device)"
        )
    if points.ndim >= form.count(",") and points.shape[-2] == joints:
        return
    dims = int(form.rstrip(")").rpartition(" ")[2])
    message = (
        f"{type(module).__name__}: expected {form.format(joints)} for skeleton '{skeleton.name}', "
        f"got {tuple(points.shape)}"
    )
    if points.ndim >= 2 and points.shape[-2] == skeleton.num_observed < joints:
        virtual = ", ".join(skeleton.joints[skeleton.num_observed :])
        message += f": without its virtual joints {virtual}, which skeleton.complete(points, weights) appends to both"
    elif points.ndim >= 2 and points.shape[-1] in (joints, skeleton.num_observed) and points.shape[-2] == dims:
        message += ": their last two axes are swapped, .mT puts them right"
    elif points.ndim and points.shape[-1] in (dims * joints, dims * skeleton.num_observed):
        message += f": flat, unflatten(-1, ({points.shape[-1] // dims}, {dims})) gives joints their axis"
    raise ShapeError(message)


def check_positive(module: nn.Module, *, finite: bool = False, **options: Any) -> None:
    """Raise an OptionError unless all options are positive numbers, and below infinity if ``finite``."""
    for name, value in options.items():
        if not isinstance(value, Real) or not float(value) > 0 or (finite and float(value) == math.inf):
            kind = "positive number that is finite" if finite else "positive number"
            raise OptionError(f"{type(module).__name__}: {name}: expected a {kind}, got {value!r}")


def check_whole(module: nn.Module, least: int, **options: Any) -> None:
    """Raise an OptionError unless all options are whole numbers, ``least`` or more."""
    for name, value in options.items():
        if not isinstance(value, Integral) or value < least:
            raise OptionError(
                f"{type(module).__name__}: {name}: expected a whole number, at least {least}, got {value!r}"
            )


def shown(module: nn.Module, *names: str) -> str:
    """Settings of a module, as its text tells them."""
    return ", ".join(f"{name}={getattr(module, name)!r}" for name in names)


class SkeletonModule(nn.Module):
    """Base of modules that know a skeleton: holds its bones as a buffer and checks what comes in."""

    bones: Tensor

    def __init__(self, skeleton: str | Path | Skeleton) -> None:
        super().__init__()
        self.skeleton = get_skeleton(skeleton)
        columns = self.skeleton.bone_index().mT.contiguous()  # so that parents and children are, each, in one piece
        self.register_buffer("bones", columns.mT, persistent=False)

    def check(self, points: Tensor, *, clip: bool = False) -> None:
        """Raise a ShapeError unless ``points`` are (..., N, D), or a clip (..., T, N, D), with this skeleton's N."""
        check_points(points, self)
        check_joints(self, self.skeleton, points, "points (..., T, {}, 3)" if clip else "points (..., {}, 3)")
        check_coordinates(points, self)

    def extra_repr(self) -> str:
        return f"skeleton='{self.skeleton.name}'"


class BoneVectors(SkeletonModule):
    """Child minus parent for each bone: (..., N, D) to (..., B, D). See :func:`kcs_torch.functional.bone_vectors`.

    >>> BoneVectors("h36m17")(torch.zeros(2, 17, 3)).shape
    torch.Size([2, 16, 3])
    """

    def forward(self, points: Tensor) -> Tensor:
        self.check(points)
        return bone_vectors(points, self.bones)


class BoneLengths(SkeletonModule):
    """Length of each bone: (..., N, D) to (..., B). See :func:`kcs_torch.functional.bone_lengths`."""

    def forward(self, points: Tensor) -> Tensor:
        self.check(points)
        return bone_lengths(points, self.bones)


class KCSMatrix(SkeletonModule):
    """The KCS matrix Psi = B B^T: (..., N, D) to (..., B, B). See :func:`kcs_torch.functional.pose_matrix`.

    Squares of millimetres leave the range of half precision: what it cannot hold comes back as its largest number.
    Metres, or ``normalise``, fit.

    Args:
        skeleton: a :class:`Skeleton`, a built-in name or a file.
        normalise: divide by the mean squared bone length of each pose, which frees Psi of scale.

    >>> KCSMatrix("h36m17")(torch.zeros(2, 17, 3)).shape
    torch.Size([2, 16, 16])
    """

    def __init__(self, skeleton: str | Path | Skeleton, *, normalise: bool = False) -> None:
        super().__init__(skeleton)
        self.normalise = normalise

    def extra_repr(self) -> str:
        return f"{super().extra_repr()}, {shown(self, 'normalise')}"

    def forward(self, points: Tensor) -> Tensor:
        self.check(points)
        with full_precision(points):
            return narrow(pose_matrix(wide(points), self.bones, normalise=self.normalise), points)


class SVT(nn.Module):
    """Singular value thresholding of (..., M, N) matrices. See :func:`kcs_torch.functional.svt`.

    Args:
        threshold: non-negative; in the unit of the matrix, or with ``relative`` as a share of its Frobenius norm.
        learnable: make the threshold a parameter, kept positive by a softplus.
        relative: scale the threshold with each matrix.

    Raises:
        OptionError: the threshold is negative, zero where it is to be learned, or a tensor that requires a gradient.
    """

    def __init__(self, threshold: float, *, learnable: bool = False, relative: bool = False) -> None:
        super().__init__()
        given: Any = threshold
        number = isinstance(given, (Real, Tensor))
        if isinstance(given, Tensor) and given.requires_grad:
            told = "expected a number, got a tensor that requires a gradient: learnable=True makes a parameter of one"
            raise OptionError(f"SVT: threshold: {told}")
        if not number or not 0 <= float(threshold) < math.inf or (learnable and threshold == 0):
            kind = "positive" if learnable else "non-negative"
            raise OptionError(f"SVT: expected a {kind}, finite threshold, got {threshold!r}")
        self.relative = relative
        self.raw = nn.Parameter(inverse_softplus(torch.tensor(float(threshold)))) if learnable else None
        self.fixed = float(threshold)

    @property
    def threshold(self) -> Tensor | float:
        return self.fixed if self.raw is None else nn.functional.softplus(self.raw)

    def extra_repr(self) -> str:
        return f"threshold={float(torch.as_tensor(self.threshold).detach()):g}, {shown(self, 'relative')}"

    def forward(self, matrix: Tensor) -> Tensor:
        check_points(matrix, self, "matrices")
        check_core(matrix, "SVT: matrix", "M", "N")
        level = self.threshold
        if self.relative:
            level = level * torch.linalg.matrix_norm(wide(matrix))
        return svt(matrix, level)


def narrow(value: Tensor, like: Tensor) -> Tensor:
    """A value in the dtype of ``like``; beyond its range it is the largest number, with the gradient it has."""
    if value.dtype == like.dtype:
        return value
    top = torch.finfo(like.dtype).max
    # In this order: beside a value that is far larger, its largest number would be lost to rounding. Infinity less
    # itself is NaN.
    return ((value - value.detach()).nan_to_num() + value.detach().clamp(-top, top)).to(like.dtype)


def seen_weights(tracks: Tensor, weights: Tensor | None) -> Tensor:
    """Weights (..., T, N) of tracks (..., T, N, 2), 0 where these are not finite: NaN is unseen, as everywhere.

    Those below 0 count as 0.

    Args:
        tracks: (..., T, N, 2).
        weights: (..., T, N); 1 if None.
    """
    finite = tracks.isfinite().all(-1)
    if weights is None:
        return finite.to(tracks.dtype)
    weights = weights.clamp_min(0)
    return torch.where(finite, weights, torch.zeros((), dtype=weights.dtype, device=weights.device))


def known_frames(points: Tensor, weights: Tensor | None) -> Tensor:
    """Points (..., T, N, D), 0 in frames whose weight (..., T) is 0."""
    return points if weights is None else known(points.flatten(-2), weights).unflatten(-1, points.shape[-2:])


def inverse_softplus(value: Tensor) -> Tensor:
    """Return x with softplus(x) = value, for positive values, without overflow."""
    return value + torch.log(-torch.expm1(-value))
