"""Layers: bones, their lengths, the KCS matrix and singular value thresholding as ``nn.Module``s."""

from __future__ import annotations

import math
from numbers import Real
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from kcs_torch.errors import OptionError
from kcs_torch.functional.chain import bone_lengths, bone_vectors, pose_matrix
from kcs_torch.functional.precision import full_precision, narrow, wide
from kcs_torch.functional.shapes import check_core
from kcs_torch.functional.spectral import svt
from kcs_torch.nn.checks import check_coordinates, check_joints, check_points, shown
from kcs_torch.skeleton import Skeleton, get_skeleton

__all__ = ["SVT", "BoneLengths", "BoneVectors", "KCSMatrix"]


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


def inverse_softplus(value: Tensor) -> Tensor:
    """Return x with softplus(x) = value, for positive values, without overflow."""
    return value + torch.log(-torch.expm1(-value))
