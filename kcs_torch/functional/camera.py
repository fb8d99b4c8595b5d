"""Weak-perspective cameras: projection, its adjoint, factorisation and the metric upgrade."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from kcs_torch.errors import ShapeError
from kcs_torch.functional.angles import angle_between
from kcs_torch.functional.derivatives import why_failed
from kcs_torch.functional.eigen import eigh
from kcs_torch.functional.guarded import or_one
from kcs_torch.functional.precision import alike, double, full_precision, wide, widened
from kcs_torch.functional.shapes import check_batches, check_core, check_floats

__all__ = [
    "back_project",
    "complete_rotation",
    "factorize",
    "orbit",
    "orthonormality_defect",
    "perspective",
    "pinhole_translation",
    "project",
    "rows_to_cameras",
    "viewpoint_turn",
]


def project(points: Tensor, cameras: Tensor) -> Tensor:
    """Return R_t X_t: points (..., T, N, 3) seen by camera rows (..., T, 2, 3), as (..., T, N, 2).

    >>> project(torch.tensor([[[1.0, 2, 3]]]), torch.eye(3)[None, :2]).tolist()
    [[[1.0, 2.0]]]

    Raises:
        ShapeError: they are not of these shapes, or not in floating point.
    """
    check_floats(points, "project: points", "N", 3)
    check_floats(cameras, "project: cameras", 2, 3)
    check_batches("project: points and cameras", points, cameras, cores=(2, 2))
    points, cameras = alike(points, cameras)
    with full_precision(points):
        return points @ cameras.mT


def perspective(points: Tensor, intrinsics: Tensor) -> Tensor:
    """Return (fx X/Z + cx, fy Y/Z + cy), the image of points through a pinhole.

    Args:
        points: (..., 3) in the camera frame, Z not 0.
        intrinsics: (..., 4) fx, fy, cx, cy, which broadcast against the points.

    Returns:
        (..., 2), in the unit of the intrinsics.

    Raises:
        ShapeError: the points are not (..., 3), or the intrinsics not (..., 4).

    >>> perspective(torch.tensor([1.0, 2.0, 4.0]), torch.tensor([100.0, 100.0, 50.0, 0.0])).tolist()
    [75.0, 50.0]
    """
    check_core(points, "perspective: points", 3)
    check_core(intrinsics, "perspective: intrinsics", 4)
    check_batches("perspective: points and intrinsics", points, intrinsics, cores=(1, 1))
    return intrinsics[..., :2] * (points[..., :2] / points[..., 2:]) + intrinsics[..., 2:]


def pinhole_translation(points: Tensor, rays: Tensor, weights: Tensor) -> Tensor:
    """Return the t that minimises sum_n w_n |(x + t_x, y + t_y) - ray (z + t_z)|^2: where a body stands.

    Args:
        points: (..., N, 3), about any origin; finite.
        rays: (..., N, 2) where the joints are seen, as X/Z and Y/Z; finite.
        weights: (..., N), 0 or less where unseen.

    Returns:
        (..., 3). Where all rays are the same one, the distance is arbitrary: ten times the body's size.

    Raises:
        ShapeError: they are not of these shapes, or not in floating point.

    >>> X = torch.tensor([[0.0, 0, 0], [1, 0, 0], [0, 2, 1]])
    >>> t = torch.tensor([1.0, 2, 5])
    >>> pinhole_translation(X, (X + t)[:, :2] / (X + t)[:, 2:], torch.ones(3)).round(decimals=4).tolist()
    [1.0, 2.0, 5.0]
    """
    check_floats(points, "pinhole_translation: points", "N", 3)
    check_floats(rays, "pinhole_translation: rays", points.shape[-2], 2)
    check_core(weights, "pinhole_translation: weights", points.shape[-2])
    check_batches("pinhole_translation: points, rays and weights", points, rays, weights, cores=(2, 2, 1))
    share = weights.clamp_min(0)[..., None]
    total = share.sum(-2, keepdim=True)
    total = or_one(total)
    mean = lambda values: (share * values).sum(-2, keepdim=True) / total  # noqa: E731
    off = points[..., :2] - rays * points[..., 2:]  # + t_xy - ray t_z is to vanish
    middle, rest = mean(rays), mean(off)
    apart = rays - middle
    spread = (mean(apart.square())).sum(-1, keepdim=True)
    firm = spread > (16 * torch.finfo(rays.dtype).eps) ** 2 * (1 + mean(rays.square()).sum(-1, keepdim=True))
    found = mean(apart * (off - rest)).sum(-1, keepdim=True) / torch.where(firm, spread, torch.ones_like(spread))
    heart = mean(points)
    with torch.no_grad():
        size = mean((points - heart).square()).sum(-1, keepdim=True).sqrt()
    depth = torch.where(firm, found, 10 * or_one(size) - heart[..., 2:])
    return torch.cat([middle * depth - rest, depth], -1).squeeze(-2)


def back_project(tracks: Tensor, cameras: Tensor) -> Tensor:
    """Return R_t^T w_t, the adjoint of :func:`project`: (..., T, N, 2) to (..., T, N, 3).

    Raises:
        ShapeError: the tracks are not (..., N, 2), or the cameras not (..., 2, 3); or not in floating point.
    """
    check_floats(tracks, "back_project: tracks", "N", 2)
    check_floats(cameras, "back_project: cameras", 2, 3)
    check_batches("back_project: tracks and cameras", tracks, cameras, cores=(2, 2))
    tracks, cameras = alike(tracks, cameras)
    with full_precision(tracks):
        return tracks @ cameras


def complete_rotation(cameras: Tensor) -> Tensor:
    """Append the viewing direction r1 x r2 to camera rows.

    Args:
        cameras: (..., 2, 3), orthonormal rows.

    Returns:
        (..., 3, 3) rotations, world to camera.

    Raises:
        ShapeError: the cameras are not (..., 2, 3).
    """
    check_core(cameras, "complete_rotation: cameras", 2, 3)
    return torch.cat([cameras, torch.linalg.cross(cameras[..., :1, :], cameras[..., 1:, :])], -2)


@widened
def factorize(tracks: Tensor, rank: int) -> tuple[Tensor, Tensor]:
    """Return motion M and shape S with ``stack(tracks) ~ M @ S``, the best of the given rank (Tomasi, Kanade 1992).

    Args:
        tracks: (..., T, N, 2), centred per frame.
        rank: at most min(2T, N).

    Returns:
        M (..., T, 2, rank) whose columns carry the singular values, in falling order, and S (..., rank, N) with
        orthonormal rows. Derivatives are those of singular vectors: none, NaN that is, where singular values coincide
        or are 0, as those of tracks that do not move.

    Raises:
        ShapeError: the tracks are not (..., T, N, 2) in floating point, or the rank is out of range.
        NotFiniteError: the tracks hold NaN.
    """
    check_floats(tracks, "factorize: tracks", "T", "N", 2)
    frames, joints = tracks.shape[-3:-1]
    if not 1 <= rank <= min(2 * frames, joints):
        raise ShapeError(f"factorize: expected a rank within 1..{min(2 * frames, joints)}, got {rank}")
    stacked = tracks.mT.flatten(-3, -2)  # (..., 2T, N), rows x1, y1, x2, y2, ...
    try:
        if stacked.shape[-2] >= joints:
            exact = double(stacked)
            _, vectors = eigh(exact.mT @ exact)
            shape = vectors.flip(-1)[..., :rank].mT.to(stacked.dtype)
        else:
            shape = torch.linalg.svd(stacked, full_matrices=False)[2][..., :rank, :]
    except torch.linalg.LinAlgError as error:
        raise why_failed(stacked, error) from None
    motion = stacked @ shape.mT
    return motion.unflatten(-2, (frames, 2)), shape


def orthonormality_defect(rows: Tensor) -> Tensor:
    """Return how far row pairs are from equal length and right angle: ((a.a - b.b)/2)^2 + (a.b)^2.

    Args:
        rows: (..., 2, 3) pairs a, b; scaled by the root of the defect's dimension, length^4.

    Returns:
        (...).

    Raises:
        ShapeError: the rows are not pairs.
    """
    check_core(rows, "orthonormality_defect: rows", 2, "D")
    a, b = rows[..., 0, :], rows[..., 1, :]
    return ((a.square().sum(-1) - b.square().sum(-1)) / 2).square() + (a * b).sum(-1).square()


def rows_to_cameras(rows: Tensor) -> tuple[Tensor, Tensor]:
    """Return the nearest orthonormal camera rows and the scale of each frame.

    Args:
        rows: (..., 2, 3), any pair of rows.

    Returns:
        cameras (..., 2, 3) with orthonormal rows and scales (...), non-negative: ``rows ~ scale * cameras``.
        Rows that vanish or are parallel give an arbitrary valid camera.

    Raises:
        ShapeError: the rows are not (..., 2, 3), or not in floating point.

    Note:
        With n the unit normal of the rows' plane, the second row of a camera in this plane is n x c for a first row c.
        So c.a + (n x c).b = c.(a + b x n) is to be as large as can be, and c is the direction of a + b x n.
    """
    check_floats(rows, "rows_to_cameras: rows", 2, 3)
    dtype, rows = rows.dtype, wide(rows)
    with torch.no_grad():
        size = rows.abs().amax((-2, -1), keepdim=True)
        size = or_one(size)
    a, b = (rows / size).unbind(-2)
    normal = torch.linalg.cross(a, b)
    with torch.no_grad():
        length = lambda x: torch.linalg.vector_norm(x, dim=-1, keepdim=True)  # noqa: E731
        firm = length(normal) > 16 * torch.finfo(rows.dtype).eps * torch.maximum(length(a), length(b)).square()
        spare = _across(torch.where(length(a) >= length(b), a, b))
    normal = torch.where(firm, normal, spare)
    normal = normal / torch.linalg.vector_norm(normal, dim=-1, keepdim=True)
    along = a + torch.linalg.cross(b, normal)
    with torch.no_grad():
        some = along.any(-1, keepdim=True)
    along = torch.where(some, along, _across(normal).detach())
    first = along / torch.linalg.vector_norm(along, dim=-1, keepdim=True)
    second = torch.linalg.cross(normal, first)  # a right angle, if not quite of length 1 where the plane is uncertain
    cameras = torch.stack([first, second / torch.linalg.vector_norm(second, dim=-1, keepdim=True)], -2)
    return cameras.to(dtype), ((rows * cameras).sum((-2, -1)) / 2).to(dtype)


def _across(vectors: Tensor) -> Tensor:
    """Some direction at a right angle to each vector (..., 3), at any length but 0."""
    least = vectors.abs().argmin(-1, keepdim=True)
    axis = torch.zeros_like(vectors).scatter_(-1, least, 1.0)
    found = torch.linalg.cross(vectors, axis)
    return torch.where(found.any(-1, keepdim=True), found, axis)


def viewpoint_turn(cameras: Tensor, inside: Tensor | None = None) -> Tensor:
    """Return the largest angle in degrees between two viewing directions of a clip.

    Args:
        cameras: (..., T, 2, 3), orthonormal rows.
        inside: (..., T), False in frames that pad a shorter clip, where the cameras are 0.

    Returns:
        (...). Turning about the optical axis does not count: it tells nothing of depth. Found in three sweeps, which is
        exact for a path; of directions scattered at random it may miss a fifth. 0 of no frames.

    Raises:
        ShapeError: the cameras are not (..., T, 2, 3) in floating point, or ``inside`` does not fit them.
    """
    check_floats(cameras, "viewpoint_turn: cameras", "T", 2, 3)
    if inside is not None:
        check_core(inside, "viewpoint_turn: inside", cameras.shape[-3])
        check_batches("viewpoint_turn: cameras and inside", cameras, inside, cores=(3, 1))
    if not cameras.shape[-3]:
        return cameras.new_zeros(cameras.shape[:-3])
    view = complete_rotation(cameras)[..., 2, :]  # (..., T, 3)
    far = view.mean(-2, keepdim=True)
    if inside is not None:
        far = far * (view.shape[-2] / inside.sum(-1).clamp_min(1))[..., None, None]
    for _ in range(3):  # the farthest from the mean, the farthest from that, and once more
        anchor = far
        away = (view - anchor).square().sum(-1)
        index = (away if inside is None else torch.where(inside, away, -1)).argmax(-1)
        far = view.gather(-2, index[..., None, None].expand(*index.shape, 1, 3))
    return torch.rad2deg(angle_between(anchor, far)).squeeze(-1)


def orbit(yaw: Tensor, pitch: float = 0.0) -> Tensor:
    """Return world-to-camera rotations of a camera that stands around a body and looks at it.

    Args:
        yaw: (...) degrees by which it stands to the body's left of its front: 0 looks along z, 90 along x.
        pitch: degrees by which it looks down.

    Returns:
        (..., 3, 3); the world has y down, like the camera.

    Raises:
        ShapeError: the yaw is no tensor of floating-point numbers.

    >>> (orbit(torch.tensor(90.0)) @ torch.tensor([1.0, 0, 0])).round().tolist()
    [0.0, 0.0, 1.0]
    """
    check_floats(yaw, "orbit: yaw")
    angle, p = torch.deg2rad(yaw), math.radians(pitch)
    c, s, o, i = angle.cos(), angle.sin(), torch.zeros_like(angle), torch.ones_like(angle)
    turn = torch.stack([torch.stack(row, -1) for row in ((c, o, -s), (o, i, o), (s, o, c))], -2)
    tilt = yaw.new_tensor([[1, 0, 0], [0, math.cos(p), -math.sin(p)], [0, math.sin(p), math.cos(p)]])
    with full_precision(yaw):
        return tilt @ turn
