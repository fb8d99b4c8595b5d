"""Starts for a descent with many valleys: depths from bone lengths with random slow signs, and turning cameras."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from kcs_torch.functional.align import nearest_rotation
from kcs_torch.functional.chain import bone_vectors, chain_inverse, incidence
from kcs_torch.functional.guarded import safe_norm
from kcs_torch.functional.rotation import rotation_matrix, running_products

__all__ = ["random_lifts", "rotations_over_time", "turning_cameras"]


def turning_cameras(
    degrees: Sequence[float] | Tensor, frames: int, *, dtype: torch.dtype, device: torch.device | None = None
) -> Tensor:
    """Return rotations (H, T, 3, 3) of cameras that turn evenly about the image's vertical by ``degrees`` in all."""
    angle = torch.deg2rad(torch.as_tensor(degrees, dtype=dtype, device=device))
    time = torch.linspace(-0.5, 0.5, frames, dtype=dtype, device=device) if frames > 1 else angle.new_zeros(1)
    return rotation_matrix(torch.nn.functional.pad((angle[:, None] * time)[..., None], (1, 1)))


def rotations_over_time(vectors: Tensor) -> Tensor:
    """Return rotations (..., T, 3, 3) that turn each frame's bones onto those of the one before, one after another.

    From these :func:`kcs_torch.solvers.procrustean.align_rotations` may start.

    Args:
        vectors: (..., T, B, 3) bones.
    """
    turn = nearest_rotation(vectors[..., 1:, :, :].mT @ vectors[..., :-1, :, :])
    first = torch.eye(3, dtype=turn.dtype, device=turn.device).expand(*vectors.shape[:-3], 1, 3, 3)
    return running_products(torch.cat([first, turn], -3))


def random_lifts(
    tracks: Tensor, bones: Tensor, count: int, *, waves: int = 3, generator: torch.Generator | None = None
) -> Tensor:
    """Lift tracks by the lengths of their bones, dz = s sqrt(L^2 - |b|^2), with random slow signs s in (-1, 1).

    A bone is about as long as it ever looks (in 98 % of the frames). Signs are tanh of a few random cosines in time: a
    bone that keeps to one side, or passes through the image plane now and then.

    Args:
        tracks: (T, N, 2).
        bones: (B, 2) pairs; each separate piece is centred by itself.
        count: starts to make.
        waves: highest cosine.
        generator: of the random numbers.

    Returns:
        (count, T, N, 3).
    """
    frames, joints, _ = tracks.shape
    size = safe_norm(bone_vectors(tracks, bones))  # (T, B)
    length = 1.02 * size.quantile(0.98, -2)  # an outlier is no length
    depth = (length.square() - size.square()).clamp_min(0).sqrt()
    time = torch.linspace(0, 1, frames, dtype=tracks.dtype, device=tracks.device)
    order = torch.arange(waves + 1, dtype=tracks.dtype, device=tracks.device)
    basis = (math.pi * order * time[:, None]).cos()  # (T, waves + 1)
    draw = torch.randn(count, waves + 1, len(bones), generator=generator, dtype=torch.float64, device="cpu").to(tracks)
    signed = depth * (3 * (basis @ draw)).tanh()  # (count, T, B)
    inverse = chain_inverse(incidence(bones, joints, dtype=tracks.dtype))
    return torch.cat([tracks.expand(count, -1, -1, -1), (signed @ inverse.mT)[..., None]], -1)
