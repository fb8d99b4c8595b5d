"""Cameras that move simply: paths of constant angular velocity or smooth ones, from rotations that align poses."""

from __future__ import annotations

import math
from typing import Literal, get_args

import torch
from torch import Tensor

from kcs_torch.errors import ShapeError, unknown
from kcs_torch.functional.align import nearest_rotation
from kcs_torch.functional.guarded import or_one
from kcs_torch.functional.inference import differentiating
from kcs_torch.functional.precision import widened
from kcs_torch.functional.ranks import median, nanmedian
from kcs_torch.functional.rotation import rotation_angle, rotation_matrix, rotation_vector, skew
from kcs_torch.functional.scatter import scatter_log_det
from kcs_torch.functional.spectral import dct_basis
from kcs_torch.solvers.lbfgs import lbfgs

__all__ = ["EVEN", "CameraPath", "choose_path", "constant_path", "settle_path", "view_energy"]

CameraPath = Literal["auto", "free", "smooth", "constant"]
KINDS: tuple[CameraPath, ...] = get_args(CameraPath)

EVEN = 0.05
"""A path explains rotations where their median deviation from it is below this share of its length ..."""

NEAR = math.radians(30)
"""... and below this angle, as a path that races through all directions has length enough for any deviation."""

STEPS = 20
"""Gauss-Newton steps that fit a path of constant angular velocity."""

WAVES, ROUNDS = 6, 20
"""Cosines of a smooth path, and rounds of weights that fit it."""

LEVELS, SETTLING = (1e-3, 1e-4, 1e-5), 40
"""Variances that the log-determinant does not look below where a path settles, in order, and L-BFGS steps for each."""

LEAST = 1e-3
"""Variance that the energy of a view does not look below, a share of the points' mean square."""

RUN = 2000
"""Frames whose waves are summed together: more would only take memory."""


@widened
def constant_path(rotations: Tensor, *, counts: Tensor | None = None) -> tuple[Tensor, Tensor]:
    """Fit R_t = exp(t w) R_0 to rotations: six numbers, robustly.

    Rotations that come from aligning poses also carry the body's own turning; a camera that moves evenly does
    not. Speeds around the median turn from frame to frame are tried, then iteratively reweighted Gauss-Newton
    (Cauchy weights) refines the best.

    Args:
        rotations: (..., T, 3, 3), T >= 2.
        counts: (...) frames of each clip, where shorter ones are padded at their end; a single one stands still.

    Returns:
        The paths (..., T, 3, 3), and their angles to each rotation (..., T), in radians; NaN in the padding.

    Raises:
        ShapeError: ``rotations`` is not (..., T, 3, 3) with T >= 2.
    """
    if rotations.ndim < 3 or rotations.shape[-2:] != (3, 3) or rotations.shape[-3] < 2:
        raise ShapeError(
            f"constant_path: expected rotations (T, 3, 3) of 2 frames or more, got {tuple(rotations.shape)}"
        )
    frames, batch = rotations.shape[-3], rotations.shape[:-3]
    rotations = rotations.reshape(-1, frames, 3, 3)
    time = torch.arange(frames, dtype=rotations.dtype, device=rotations.device)
    last = time[None, -1:] if counts is None else counts.to(time).reshape(-1, 1) - 1  # (K, 1)
    inside = time <= last  # (K or 1, T)
    nowhere = torch.where(inside, 0.0, torch.nan).to(time)  # medians pass over NaN
    time = time - last / 2
    step = rotation_vector(rotations[:, 1:] @ rotations[:, :-1].mT)
    turn = torch.where(last > 0, nanmedian(step + nowhere[:, 1:, None], 1), 0.0)  # (K, 3)
    factors = torch.linspace(0.8, 1.2, 161, dtype=turn.dtype, device=turn.device)
    means = _sum_unturned(rotations * inside[..., None, None], factors, time, turn)  # (K, 161, 3, 3)
    starts = nearest_rotation(means)
    best = (starts * means).sum((-2, -1)).argmax(-1)  # the agreement of path and rotations
    row = torch.arange(len(best), device=best.device)
    speed, start = turn * factors[best][:, None], starts[row, best]
    eye = torch.eye(6, dtype=turn.dtype, device=turn.device)
    for _ in range(STEPS):
        turned = time[..., None] * speed[:, None]  # (K, T, 3)
        spin = rotation_matrix(turned)
        error = rotation_vector(rotations @ (spin @ start[:, None]).mT)
        angle = error.norm(dim=-1)
        spread = nanmedian(angle + nowhere, -1, keepdim=True).clamp_min(1e-9)
        weight = inside / (1 + (angle / spread).square())
        jacobian = torch.cat([_left_jacobian(turned) * time[..., None, None], spin], -1)
        normal = (jacobian.mT * weight[..., None, None] @ jacobian).sum(1)
        target = (jacobian.mT @ (error * weight[..., None])[..., None]).sum(1)[..., 0]
        ridge = 1e-12 * normal.diagonal(dim1=-2, dim2=-1).mean(-1)[:, None, None] * eye
        move = torch.linalg.solve(normal + ridge, target)
        speed, start = speed + move[:, :3], rotation_matrix(move[:, 3:]) @ start
    path = rotation_matrix(time[..., None] * speed[:, None]) @ start[:, None]
    angle = rotation_angle(path, rotations) + nowhere
    return path.view(*batch, frames, 3, 3), angle.view(*batch, frames)


def _smoothed(rotations: Tensor, base: Tensor, angle: Tensor) -> tuple[Tensor, Tensor]:
    """Fit a path whose deviation from a constant path (T, 3, 3) is a sum of slow cosines, robustly; its angles (T,)."""
    frames = len(rotations)
    basis = dct_basis(frames, min(WAVES, frames), dtype=base.dtype, device=base.device)  # (T, K)
    deviation = (rotations @ base.mT).flatten(-2)
    path = base
    for _ in range(ROUNDS):
        weight = 1 / (1 + (angle / angle.median().clamp_min(1e-9)).square())
        normal = basis.mT @ (weight[:, None] * basis)
        ridge = 1e-9 * normal.diagonal().mean() * torch.eye(len(normal), dtype=base.dtype, device=base.device)
        share = torch.linalg.solve(normal + ridge, basis.mT @ (weight[:, None] * deviation))
        path = nearest_rotation((basis @ share).unflatten(-1, (3, 3))) @ base
        angle = rotation_angle(path, rotations)
    return path, angle


@widened
def choose_path(rotations: Tensor, kind: CameraPath = "auto") -> tuple[Tensor, CameraPath, Tensor]:
    """Return the simplest camera path that explains the rotations: constant angular velocity, smooth, or free.

    Args:
        rotations: (T, 3, 3).
        kind: "auto" chooses, by the median deviation as a share of the path's length; else the path to fit.

    Returns:
        The path (T, 3, 3), its kind, and its angle to each rotation (T,), in radians. Clips below 10 frames are free.

    Raises:
        ShapeError: ``rotations`` is not (T, 3, 3).
        OptionError: there is no such kind.
    """
    if kind not in KINDS:
        raise unknown("camera path", kind, KINDS)
    if rotations.ndim != 3 or rotations.shape[1:] != (3, 3):
        raise ShapeError(f"choose_path: expected rotations (T, 3, 3), got {tuple(rotations.shape)}")
    zero = rotations.new_zeros(len(rotations))
    if kind == "free" or len(rotations) < 10:
        return rotations, "free", zero
    path, angle = constant_path(rotations)
    if kind != "smooth" and (kind == "constant" or _explains(path, angle)):
        return path, "constant", angle
    path, angle = _smoothed(rotations, path, angle)
    if kind == "smooth" or _explains(path, angle):
        return path, "smooth", angle
    return rotations, "free", zero


def _explains(path: Tensor, angle: Tensor) -> bool:
    length = rotation_angle(path[1:], path[:-1]).sum()
    return bool(angle.median() < (EVEN * length).clamp_max(NEAR))


@differentiating
def settle_path(vectors: Tensor, path: Tensor) -> Tensor:
    """Refine a camera path so that the world poses vary least: T/2 log det of the scatter of the turned bones.

    A path fitted to rotations that align poses inherits the body's own turning. What a camera must explain is only
    that poses seen from it vary little: the axis and speed of the path, three numbers, are moved to where the
    log-determinant is least.

    Args:
        vectors: (T, B, 3) bones in the camera frame, of size near 1.
        path: (T, 3, 3) world to camera, of constant angular velocity.

    Returns:
        (T, 3, 3), turned as a whole nearest to ``path``.

    Raises:
        ShapeError: they are not of these shapes.
    """
    if path.ndim != 3 or path.shape[1:] != (3, 3) or vectors.ndim != 3 or vectors.shape[::2] != path.shape[:2]:
        got = f"{tuple(vectors.shape)} and {tuple(path.shape)}"
        raise ShapeError(f"settle_path: expected vectors (T, B, 3) and a path (T, 3, 3), got {got}")
    frames = len(path)
    if frames < 3:
        return path
    time = torch.arange(frames, dtype=path.dtype, device=path.device) - (frames - 1) / 2
    turn = median(rotation_vector(path[1:] @ path[:-1].mT), 0)
    spin = rotation_matrix(time[:, None] * turn)
    rest = spin.mT @ path  # one rotation, if the path is of constant angular velocity
    # a radian of tilt moves the axis, a radian of speed the path's ends
    size = turn.norm()
    axis = turn / size.clamp_min(1e-9)
    lean = size * (torch.eye(3, dtype=path.dtype, device=path.device) - axis[:, None] * axis)
    lean = lean + axis[:, None] * axis / frames
    if bool(size * frames < 1e-2):
        lean = torch.eye(3, dtype=path.dtype, device=path.device) / frames

    def turned(u: Tensor) -> Tensor:
        return rotation_matrix(time[:, None] * (turn + u @ lean)) @ rest

    def energy(u: Tensor) -> Tensor:
        aligned = (vectors @ turned(u)).flatten(-2)
        return scatter_log_det(aligned - aligned.mean(-2, keepdim=True), level)[None] / frames

    u = path.new_zeros(1, 3)
    for level in LEVELS:  # noqa: B007
        u = lbfgs(energy, u, num_steps=SETTLING, first_step=1e-2).value
    found = turned(u)
    return found @ nearest_rotation((found.mT @ path).sum(0))


def view_energy(points: Tensor, path: Tensor) -> Tensor:
    """How much poses vary in the world of known cameras: n/2 log det of their scatter there, of n independent poses.

    Depths of the wrong sign seem to turn with the camera, twice as fast: of a pose and its mirror image the right one
    varies less, whatever the body itself does, unless it turns in time with the camera. A turn of its own that takes
    all clip long does so by chance, so that frames count as one for as long as images resemble each other.

    Args:
        points: (..., T, N, 3) in the camera frame; the middle of each frame's joints does not count.
        path: (T, 3, 3) world to camera.

    Returns:
        (...). Only differences mean something, between points of the same clip.
    """
    points = points - points.mean(-2, keepdim=True)
    size = points[..., :2].square().mean((-3, -2, -1), keepdim=True).sqrt()
    world = (points / size.clamp_min(torch.finfo(size.dtype).tiny) @ path).flatten(-2)
    energy = scatter_log_det(world - world.mean(-2, keepdim=True), LEAST)
    return energy / _lasting(points[..., :2].flatten(-2))


def _lasting(values: Tensor) -> Tensor:
    """How many frames of values (..., T, D) count as one, (...): twice the sum of their autocorrelation up to its end.

    Twice, as the mean that is taken away shortens it.
    """
    values = values - values.mean(-2, keepdim=True)
    frames = values.shape[-2]
    power = torch.fft.rfft(values, 2 * frames, dim=-2).abs().square().sum(-1)
    alike = torch.fft.irfft(power, 2 * frames)[..., :frames]
    kept = (alike > 0).cumprod(-1)
    return 2 * (2 * (alike * kept).sum(-1) / or_one(alike[..., 0]) - 1).clamp_min(1.0)


def _sum_unturned(rotations: Tensor, factors: Tensor, time: Tensor, turn: Tensor) -> Tensor:
    """Sums over t of exp(-factor_s time_t turn) R_t (K, S, 3, 3), for R (K, T, 3, 3), time (K or 1, T), turns (K, 3).

    By Rodrigues' formula exp(-a n) = cos(a) (I - n n^T) + n n^T - sin(a) [n]: sums of R under S x T cosines and sines,
    of some frames at a time.
    """
    size = turn.norm(dim=-1)[:, None]
    axis = turn / or_one(size)
    hat = skew(axis)[:, None]
    along = (axis[:, :, None] * axis[:, None])[:, None]
    waves = rotations.new_zeros(2, len(rotations), len(factors), 9)
    for flat, angle in zip(rotations.flatten(-2).split(RUN, 1), (time * size).split(RUN, 1), strict=True):
        turned = factors[:, None] * angle[:, None]  # (K, S, T)
        waves += torch.stack([turned.cos() @ flat, turned.sin() @ flat])
    cosine, sine = waves.unflatten(-1, (3, 3))
    return cosine + along @ (rotations.sum(1)[:, None] - cosine) - hat @ sine


def _left_jacobian(vectors: Tensor) -> Tensor:
    """Left Jacobian of the exponential map at rotation vectors (..., 3), (..., 3, 3)."""
    angle = vectors.norm(dim=-1)[..., None, None]
    small = angle < 1e-6
    safe = torch.where(small, torch.ones_like(angle), angle)
    first = torch.where(small, 0.5 - angle.square() / 24, (1 - safe.cos()) / safe.square())
    second = torch.where(small, 1 / 6 - angle.square() / 120, (safe - safe.sin()) / safe**3)
    hat = skew(vectors)
    return torch.eye(3, dtype=vectors.dtype, device=vectors.device) + first * hat + second * (hat @ hat)
