"""Curvature of the Procrustean objective, frame by frame: what its descent is preconditioned with."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from kcs_torch.functional.chain import bone_vectors, incidence
from kcs_torch.functional.guarded import safe_norm
from kcs_torch.functional.scatter import inverse_scatter

__all__ = ["Curvature", "Levels", "block_roots", "frame_curvature", "shown", "whitening"]

Levels = list[tuple[float, Tensor, float, int]]
"""(weight, rows (H, T, 3B), eps, frames that a row links) of each log-determinant."""


@dataclass
class Curvature:
    """Blocks of the Hessian: the joints' free coordinates (the last ``free`` of x, y, z), then the rotation.

    Attributes:
        matrix: (H, T, free N + 3, free N + 3); coordinates come in blocks of N, all x first.
        free: 1 (depths) or 3.
        joints: N.
    """

    matrix: Tensor
    free: int
    joints: int

    def add_lengths(self, points: Tensor, rigid: Tensor, pull: Tensor) -> None:
        """Add the Gauss-Newton term of the lengths (P, 2), with weights (H, P)."""
        if len(rigid) == 0:
            return
        vectors = bone_vectors(points, rigid)
        size = safe_norm(vectors)
        along = vectors / size.clamp_min(torch.finfo(size.dtype).tiny)[..., None]
        along = along[..., 3 - self.free :] * pull.sqrt()[..., None, :, None]  # (H, T, P, free)
        ends = incidence(rigid, self.joints, dtype=points.dtype)
        rows = (along.mT[..., None, :] * ends).flatten(-3, -2)  # (H, T, free N, P)
        count = self.free * self.joints
        self.matrix[..., :count, :count] += rows @ rows.mT

    def add_tracks(self, precision: Tensor) -> None:
        """Add the curvature (H, T, N) of the residuals of x and of y."""
        count = 2 * self.joints
        self.matrix.diagonal(dim1=-2, dim2=-1)[..., :count] += torch.cat([precision, precision], -1)


CHANGE = 0.1
"""The eps of the changes, a share of the poses'."""

REACH = 3.0
"""Residuals beyond this many standard deviations, and lengths beyond this many slacks, stop pulling."""

RIDGE = 1e-6
"""What is added to a block's diagonal, a share of it and of its mean curvature along the depth."""

RUN = 2**20
"""Numbers of blocks that are made together: all would take much memory, and fall out of the processor's cache."""


def whitening(
    points: Tensor,
    rotations: Tensor,
    bones: Tensor,
    levels: Levels,
    free: int,
    rigid: Tensor,
    stiffness: Tensor,
    slack: float,
    precision: Tensor | None = None,
    counts: Tensor | None = None,
    anchor: Tensor | None = None,
) -> Tensor:
    """Return roots (H, T, D, D) of the inverse of each frame's Hessian, of lengths and log-determinants.

    Args:
        points: (H, T, N, 3).
        rotations: (H, T, 3, 3).
        bones: (B, 2).
        levels: the log-determinants; links between frames count on the diagonal only.
        free: coordinates of a joint that are free, 1 (depth) or 3.
        rigid: (P, 2) pairs that keep their distance.
        stiffness: (P,) weights of their lengths.
        slack: standard deviation of a length.
        precision: curvature (H, T, N) of the residuals of x and of y, where they are free.
        counts: (H,) frames of each start, where some are padded.
        anchor: (H,) curvature of what pulls on each depth.
    """
    hypotheses, frames, joints, _ = points.shape
    inverse = points.new_zeros(hypotheses, 3 * len(bones), 3 * len(bones))
    for weight, rows, eps, linked in levels:
        # Where rounding leaves nothing of eps the value is NaN, so that no step is taken: any root does.
        inverse = inverse + linked * weight * inverse_scatter(rows, eps).nan_to_num(0.0)
    length = safe_norm(bone_vectors(points, rigid))
    if counts is None:
        spread = (length - length.mean(-2, keepdim=True)).square().mean(-2)  # var() warns where no pair is rigid
    else:
        off = (length - length.sum(-2, keepdim=True) / counts[:, None, None]) * shown(counts, frames)[..., None]
        spread = off.square().sum(-2) / counts[:, None]
    pull = stiffness * (1 / (spread + slack**2) - 1 / (spread + (REACH * slack) ** 2))
    size = free * joints + 3
    out = points.new_empty(hypotheses, frames, size, size)
    run = max(1, RUN // (max(hypotheses, 1) * size**2))
    for part in (slice(first, first + run) for first in range(0, frames, run)):
        curvature = frame_curvature(points[:, part], rotations[:, part], bones, inverse, free)
        curvature.add_lengths(points[:, part], rigid, pull)
        if precision is not None:
            curvature.add_tracks(precision[:, part])
        if anchor is not None:
            curvature.matrix.diagonal(dim1=-2, dim2=-1)[..., (free - 1) * joints : -3] += anchor[:, None, None]
        out[:, part] = block_roots(curvature)
    return out


def shown(counts: Tensor, frames: int) -> Tensor:
    """(H, T) ones in the frames that each start has, zeros in those that pad it."""
    return (torch.arange(frames, device=counts.device) < counts[:, None]).to(counts)


def frame_curvature(points: Tensor, rotations: Tensor, bones: Tensor, precision: Tensor, free: int) -> Curvature:
    """Return each frame's Hessian of the log-determinants, their covariances held (the majoriser's).

    With S the precision of the aligned bones, the block of joints n, m and coordinates i, j is
    sum_kl R_ik R_jl (C S_kl C^T)_nm: nine N x N matrices serve all frames.

    Args:
        points: (H, T, N, 3).
        rotations: (H, T, 3, 3).
        bones: (B, 2).
        precision: S (H, 3B, 3B).
        free: coordinates of a joint that are free, 1 (depth) or 3.
    """
    hypotheses, frames, joints, _ = points.shape
    count = len(bones)
    ends = incidence(bones, joints, dtype=points.dtype)
    vectors = bone_vectors(points, bones)
    nine = precision.view(hypotheses, count, 3, count, 3).permute(0, 2, 4, 1, 3)
    nine = (ends @ nine @ ends.mT).flatten(1, 2).flatten(-2)  # (H, 9, N N)
    rows = rotations[:, :, 3 - free :]  # (H, T, free, 3)
    pairs = (rows[:, :, :, None, :, None] * rows[:, :, None, :, None, :]).flatten(-2)  # (H, T, free, free, 9)
    joint = (pairs.flatten(1, 3) @ nine).view(hypotheses, frames, free, free, joints, joints).transpose(3, 4)
    # A turn by w moves a bone b by b x w, before the rotation.
    eye = torch.eye(3, dtype=points.dtype, device=points.device)
    turned = torch.linalg.cross(vectors[..., None, :].expand(*vectors.shape, 3), eye.expand(*vectors.shape, 3), dim=-1)
    turned = (turned.flatten(-3, -2) @ rotations).unflatten(-2, (count, 3)).mT.flatten(-3, -2)  # (H, T, 3B, 3)
    weighed = (turned.mT.flatten(1, 2) @ precision).unflatten(1, (frames, 3)).mT  # (H, T, 3B, 3)
    cross = torch.einsum("htik,htbkw->htibw", rows, weighed.unflatten(-2, (count, 3)))
    cross = (ends @ cross).flatten(2, 3)  # (H, T, free N, 3)
    size = free * joints
    matrix = points.new_empty(hypotheses, frames, size + 3, size + 3)
    matrix[..., :size, :size].view(*joint.shape).copy_(joint)
    matrix[..., :size, size:], matrix[..., size:, :size] = cross, cross.mT
    matrix[..., size:, size:] = turned.mT @ weighed
    return Curvature(matrix, free, joints)


def block_roots(curvature: Curvature) -> Tensor:
    """Return P (H, T, D, D) with P P^T the inverse of each block, shifts along the depth held in place.

    A common depth of all joints moves no bone: its curvature, zero, becomes the mean one.
    """
    matrix = curvature.matrix.clone()
    joints, free = curvature.joints, curvature.free
    depth = slice((free - 1) * joints, free * joints)
    typical = matrix.diagonal(dim1=-2, dim2=-1)[..., depth].mean(-1)
    matrix[..., depth, depth] += (typical / joints)[..., None, None]
    diagonal = matrix.diagonal(dim1=-2, dim2=-1)
    diagonal.mul_(1 + RIDGE).add_(RIDGE * typical[..., None] + torch.finfo(matrix.dtype).tiny)
    factor, info = torch.linalg.cholesky_ex(matrix)
    if bool(info.any()):  # rounding spoilt a block
        plain = diagonal.clamp_min(torch.finfo(matrix.dtype).tiny).sqrt().diag_embed()
        factor = torch.where((info == 0)[..., None, None], factor, plain)
    eye = torch.eye(matrix.shape[-1], dtype=matrix.dtype, device=matrix.device).expand_as(matrix)
    return torch.linalg.solve_triangular(factor, eye, upper=False).mT.contiguous()
