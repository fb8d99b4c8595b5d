"""Rotations as matrices, as vectors (axis times angle) and as Euler angles."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from kcs_torch.errors import OptionError
from kcs_torch.functional.precision import alike, full_precision
from kcs_torch.functional.shapes import check_batches, check_core, check_floats

__all__ = ["euler_angles", "euler_rotation", "rotation_angle", "rotation_matrix", "rotation_vector", "running_products"]

AXES = "XYZ"

SMALL = 1e-5
"""Squared angle below which three terms of a series tell its functions to rounding."""


def rotation_matrix(vectors: Tensor) -> Tensor:
    """Return exp([v]) = cos(a) I + sin(a)/a [v] + (1 - cos(a))/a^2 v v^T, a = |v|: the rotation about v by |v| radians.

    Args:
        vectors: (..., 3).

    Returns:
        (..., 3, 3). Differentiable, also where the angle is 0, and twice.

    Raises:
        ShapeError: the vectors are not (..., 3).

    >>> rotation_matrix(torch.tensor([0.0, 0.0, torch.pi / 2])).round(decimals=5).abs().tolist()
    [[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]
    """
    check_core(vectors, "rotation_matrix: vectors", 3)
    x, y, z = vectors.unbind(-1)
    square = x * x + y * y + z * z
    small = square < SMALL
    angle = torch.where(small, 1, square).sqrt()
    half = angle / 2
    # The unit quaternion (cosine, sine v), of the squared angle: so its derivatives have no gap at 0.
    cosine = torch.where(small, 1 + square * (square / 384 - 1 / 8), half.cos())
    sine = torch.where(small, 1 / 2 + square * (square / 3840 - 1 / 48), half.sin() / angle)
    u, v, w = sine * x, sine * y, sine * z
    i, j, k = 2 * u, 2 * v, 2 * w
    a, b, c = cosine * i, cosine * j, cosine * k
    xx, yy, zz, xy, yz, zx = u * i, v * j, w * k, u * j, v * k, w * i
    rows = [1 - yy - zz, xy - c, zx + b, xy + c, 1 - xx - zz, yz - a, zx - b, yz + a, 1 - xx - yy]
    return torch.stack(rows, -1).unflatten(-1, (3, 3))


def rotation_vector(matrices: Tensor) -> Tensor:
    """Return the least v with exp([v]) = R, of length 0 to pi: the inverse of :func:`rotation_matrix`.

    Args:
        matrices: (..., 3, 3) rotations.

    Returns:
        (..., 3). Differentiable, also at the identity; where R is a half turn, v and -v are one rotation.

    Raises:
        ShapeError: the matrices are not (..., 3, 3), or not in floating point.

    Through the unit quaternion, whose outer square is linear in R: a row of it far from 0 is the quaternion up to a
    factor, however large or small the angle is (Markley 2008).

    >>> rotation_vector(rotation_matrix(torch.tensor([0.1, -2.0, 0.5]))).round(decimals=5).tolist()
    [0.10000000149011612, -2.0, 0.5]
    """
    check_floats(matrices, "rotation_vector: matrices", 3, 3)
    (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = (row.unbind(-1) for row in matrices.unbind(-2))
    outer = torch.stack(
        [
            *(1 + xx - yy - zz, xy + yx, zx + xz, zy - yz),
            *(xy + yx, 1 - xx + yy - zz, yz + zy, xz - zx),
            *(zx + xz, yz + zy, 1 - xx - yy + zz, yx - xy),
            *(zy - yz, xz - zx, yx - xy, 1 + xx + yy + zz),
        ],
        -1,
    ).unflatten(-1, (4, 4))
    largest = outer.diagonal(dim1=-2, dim2=-1).argmax(-1)[..., None, None]
    row = outer.gather(-2, largest.expand(*largest.shape[:-1], 4)).squeeze(-2)
    row = torch.where(row[..., 3:] < 0, -row, row)
    axis, cosine = row[..., :3], row[..., 3:]
    square = axis.square().sum(-1, keepdim=True)
    tiny = square <= (torch.finfo(row.dtype).eps * cosine).square()
    sine = torch.where(tiny, 1, square).sqrt()
    return 2 * axis * torch.where(tiny, 1 / torch.where(tiny, cosine, 1), torch.atan2(sine, cosine) / sine)


def rotation_angle(first: Tensor, second: Tensor) -> Tensor:
    """Return the angle (...) in radians between rotations (..., 3, 3): |A - B| = 2 sqrt(2) sin(angle / 2).

    The derivative is 0 where they are equal or a half turn apart, at which it has a kink.

    Raises:
        ShapeError: one of them is not (..., 3, 3), or not in floating point.
    """
    check_floats(first, "rotation_angle: first", 3, 3)
    check_floats(second, "rotation_angle: second", 3, 3)
    check_batches("rotation_angle: first and second", first, second, cores=(2, 2))
    first, second = alike(first, second)
    sine = torch.linalg.matrix_norm(first - second) / math.sqrt(8)  # of half the angle
    far = sine > 0.75
    with full_precision(first):
        turn = first.mT @ second
    both = torch.linalg.matrix_norm(turn - turn.mT) / math.sqrt(32)  # sine times cosine, exact near a half turn
    cosine = both / torch.where(far, sine, 1)
    rest = 2 * torch.where(far, cosine, sine).clamp_max(1).asin()
    return torch.where(far, math.pi - rest, rest)


def euler_rotation(order: str, angles: Tensor) -> Tensor:
    """Return the product of turns about the axes named, each the one that the turns before have moved.

    Args:
        order: letters X, Y, Z, any number of them.
        angles: (..., number of letters), in radians.

    Returns:
        (..., 3, 3).

    Raises:
        OptionError: there is another letter.
        ShapeError: the angles are not as many, or not in floating point.

    >>> torch.allclose(euler_rotation("ZX", torch.tensor([0.3, 0.0])), rotation_matrix(torch.tensor([0, 0, 0.3])))
    True
    """
    if not set(order) <= set(AXES):
        raise OptionError(f"euler_rotation: expected axes X, Y and Z, got {order!r}")
    check_floats(angles, "euler_rotation: angles", len(order))
    eye = torch.eye(3, dtype=angles.dtype, device=angles.device)
    total = eye.expand(*angles.shape[:-1], 3, 3)
    with full_precision(angles):
        for axis, angle in zip(order, angles.unbind(-1), strict=True):
            total = total @ rotation_matrix(angle[..., None] * eye[AXES.index(axis)])
    return total


def euler_angles(order: str, matrices: Tensor) -> Tensor:
    """Return the angles of :func:`euler_rotation` about three different axes.

    Args:
        order: the letters X, Y, Z in any order.
        matrices: (..., 3, 3).

    Returns:
        (..., 3) in radians, the second within a quarter turn. Where that is a quarter turn the third is 0, and the
        second and third have the derivative 0.

    Raises:
        OptionError: the order is another one.
        ShapeError: the matrices are not (..., 3, 3), or not in floating point.
    """
    if not isinstance(order, str) or sorted(order) != list(AXES):
        order = order if isinstance(order, str) else f"a {type(order).__name__}"
        raise OptionError(f"euler_angles: expected X, Y and Z in some order, got {order!r}")
    check_floats(matrices, "euler_angles: matrices", 3, 3)
    i, j, k = (AXES.index(axis) for axis in order)
    sign = 1 if (j - i) % 3 == 1 else -1
    r = matrices
    sine, cosine = sign * r[..., i, k], torch.hypot(r[..., i, i].detach(), r[..., i, j].detach())
    locked = cosine < 1e-7  # there neither a length nor an angle of what is nearly 0 has a derivative
    along, across = torch.where(locked, 1, r[..., i, i]), torch.where(locked, 0, r[..., i, j])
    cosine = torch.where(locked, cosine, torch.hypot(along, across))
    first = torch.atan2(
        torch.where(locked, sign * r[..., k, j], -sign * r[..., j, k]), torch.where(locked, r[..., j, j], r[..., k, k])
    )
    third = torch.where(locked, torch.zeros_like(sine), torch.atan2(-sign * across, along))
    return torch.stack([first, torch.atan2(sine, cosine), third], -1)


def skew(vectors: Tensor) -> Tensor:
    """The skew-symmetric matrices [v] (..., 3, 3) of vectors v (..., 3), with [v] w = v x w."""
    x, y, z = vectors.unbind(-1)
    zero = torch.zeros_like(x)
    return torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], -1).unflatten(-1, (3, 3))


def running_products(turns: Tensor) -> Tensor:
    """Return R_0, R_1 R_0, R_2 R_1 R_0, ... of matrices (..., T, 3, 3), by doubling.

    >>> running_products(torch.eye(3).expand(4, 3, 3) * 2)[:, 0, 0].tolist()
    [2.0, 4.0, 8.0, 16.0]
    """
    span = 1
    while span < turns.shape[-3]:  # products of the last frames, of twice as many each time
        later = turns[..., span:, :, :] @ turns[..., :-span, :, :]
        turns = torch.cat([turns[..., :span, :, :], later], -3)
        span *= 2
    return turns
