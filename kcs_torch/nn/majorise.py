"""Majorise-minimise steps on the energy of a moving viewpoint: each is one linear solve a frame, and none raises it.

With world points y_t, their bones b_t, camera rows R_t and tracks w_t of root mean square 1

    F = T/2 log det(cov(b) + eps I)
      + sum_tb rho((|b_tb| - L_b) / slack)
      + sum_tn u_tn rho(|R_t y_tn + t - w_tn| / noise)

with Cauchy's rho(r) = c^2/2 log(1 + (r/c)^2), c = 3, as in PKC. A log-determinant lies below its tangent tr(M cov),
M = (cov + eps I)^-1; rho(r) below w r^2/2 with w = 1 / (1 + (r/c)^2); and (|b| - L)^2 below |b - L b/|b||^2 at the
present direction: together a quadratic in each frame's points alone, whose minimum is the next iterate.
"""

from __future__ import annotations

import torch
from torch import Tensor

from kcs_torch.functional.align import nearest_rotation
from kcs_torch.functional.camera import back_project, project
from kcs_torch.functional.chain import bone_vectors
from kcs_torch.functional.guarded import or_one
from kcs_torch.nn.masks import clear_padding
from kcs_torch.nn.reprojection import centred_residual

__all__ = ["majorise_step", "turn_onto_mean"]

REACH = 3.0
"""Residuals beyond this many standard deviations stop pulling."""


def majorise_step(
    points: Tensor,
    tracks: Tensor,
    cameras: Tensor,
    weights: Tensor,
    lengths: Tensor,
    *,
    bones: Tensor,
    rigid: Tensor,
    eps: Tensor | float,
    slack: Tensor | float,
    noise: Tensor | float,
    inside: Tensor | None = None,
) -> Tensor:
    """Minimise the quadratic that touches F at ``points`` and nowhere lies below it.

    Args:
        points: y (..., T, N, 3) in the world frame.
        tracks: w (..., T, N, 2), of root mean square near 1.
        cameras: R (..., T, 2, 3).
        weights: u (..., T, N).
        lengths: L (..., P).
        bones: (B, 2) whose covariance counts.
        rigid: (P, 2) that keep their length.
        eps: variance that the log-determinant does not look below.
        slack: standard deviation of a rigid bone's length.
        noise: standard deviation of the tracks.
        inside: (..., T), False in frames that pad a shorter clip, whose weights are 0.

    Returns:
        (..., T, N, 3), about the joints' mean; 0 in padding.
    """
    joints = points.shape[-2]
    eye = torch.eye(3 * joints, dtype=points.dtype, device=points.device)
    centred, mean, frames = _bones_about_mean(points, bones, inside)
    scatter = _floor(centred.mT @ centred / frames, eps)
    precision = torch.cholesky_inverse(torch.linalg.cholesky_ex(scatter)[0])  # (..., 3B, 3B)
    axes = torch.eye(3, dtype=points.dtype, device=points.device)
    spread = _kron(_incidence(bones, joints, points), axes)  # (3N, 3B)
    normal = spread @ precision @ spread.mT  # (..., 3N, 3N), of all frames
    goal = (spread @ (precision @ mean[..., None])).mT  # (..., 1, 3N)

    vectors = bone_vectors(points, rigid)
    size = _sizes(vectors, lengths)
    pull = 1 / (slack**2 * (1 + ((size - lengths[..., None, :]) / (REACH * slack)).square()))
    pull = pull * vectors.detach().any(-1)  # a bone of no length has no direction either
    stiff = _laplacian(pull, rigid, joints)  # (..., T, N, N)
    aim = _gather((pull * lengths[..., None, :] / size)[..., None] * vectors, rigid, joints)

    off = centred_residual(project(points, cameras), tracks, weights).square().sum(-1)
    share = weights / (noise**2 * (1 + off / (REACH * noise) ** 2))
    total = weights.sum(-1, keepdim=True)
    part = weights / or_one(total)
    about = torch.eye(joints, dtype=points.dtype, device=points.device) - part[..., None, :]  # less the weighted mean
    held = about.mT @ (share[..., None] * about)
    seen = back_project(held @ tracks, cameras)

    local = _kron(stiff, axes) + _kron(held, cameras.mT @ cameras)
    whole = normal[..., None, :, :] + local  # (..., T, 3N, 3N)
    # Nothing holds the body's place in depth, nor what no bone and no track reaches: it stays at the middle.
    ridge = 1e-9 + 1e-12 * whole.detach().diagonal(dim1=-2, dim2=-1).amax(-1)
    factor, _ = torch.linalg.cholesky_ex(whole + ridge[..., None, None] * eye)
    right = goal + (aim + seen).flatten(-2)
    found = torch.cholesky_solve(right[..., None], factor).squeeze(-1).unflatten(-1, (joints, 3))
    return clear_padding(found - found.mean(-2, keepdim=True), inside)


def turn_onto_mean(points: Tensor, rotations: Tensor, bones: Tensor) -> tuple[Tensor, Tensor]:
    """Turn each frame's world points, and its camera with them, onto the clip's mean pose (one Procrustes round).

    Args:
        points: (..., T, N, 3).
        rotations: (..., T, 3, 3), world to camera.
        bones: (B, 2).

    Returns:
        Points (..., T, N, 3) and rotations (..., T, 3, 3); in the camera frame nothing moves.
    """
    mean = bone_vectors(points.mean(-3, keepdim=True), bones)
    seen = points @ rotations.mT
    turned = nearest_rotation(bone_vectors(seen, bones).mT @ mean)
    return seen @ turned, turned


def _bones_about_mean(
    points: Tensor, bones: Tensor, inside: Tensor | None = None
) -> tuple[Tensor, Tensor, Tensor | int]:
    """Bones (..., T, 3B) about their mean (..., 3B) over time, and the number of frames; padding is 0."""
    flat = bone_vectors(points, bones).flatten(-2)
    if inside is None:
        mean = flat.mean(-2)
        return flat - mean[..., None, :], mean, flat.shape[-2]
    real = inside[..., None].to(flat.dtype)
    frames = real.sum(-2, keepdim=True).clamp_min(1)
    mean = (flat * real).sum(-2) / frames.squeeze(-1)
    return (flat - mean[..., None, :]) * real, mean, frames


def _floor(scatter: Tensor, eps: Tensor | float) -> Tensor:
    return scatter + eps * torch.eye(scatter.shape[-1], dtype=scatter.dtype, device=scatter.device)


def _sizes(vectors: Tensor, lengths: Tensor) -> Tensor:
    """Lengths (..., P) with a derivative at 0: as in :func:`kcs_torch.solvers.fit_bones`."""
    least = 1e-4 * lengths.detach().abs().mean(-1)[..., None, None] if lengths.shape[-1] else lengths.new_zeros(())
    return (vectors.square().sum(-1) + least.square() + 1e-12).sqrt()


def _laplacian(pull: Tensor, pairs: Tensor, joints: int) -> Tensor:
    """C diag(pull) C^T (..., N, N) of pairs (P, 2), for pull (..., P)."""
    matrix = _incidence(pairs, joints, pull)
    return (matrix * pull[..., None, :]) @ matrix.mT


def _gather(vectors: Tensor, pairs: Tensor, joints: int) -> Tensor:
    """C v (..., N, 3) for v (..., P, 3)."""
    return _incidence(pairs, joints, vectors) @ vectors


def _incidence(pairs: Tensor, joints: int, like: Tensor) -> Tensor:
    """C (N, P): +1 at a bone's child, -1 at its parent, by comparison, which any transform can follow."""
    number = torch.arange(joints, device=pairs.device)[:, None]
    return (number == pairs[:, 1]).to(like.dtype) - (number == pairs[:, 0]).to(like.dtype)


def _kron(left: Tensor, right: Tensor) -> Tensor:
    """Kronecker product (..., 3N, 3M) of (..., N, M) and (..., 3, 3)."""
    product = left[..., :, None, :, None] * right[..., None, :, None, :]
    return product.flatten(-2).flatten(-3, -2)
