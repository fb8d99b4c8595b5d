"""Unseen joints from the rest of the clip: low-rank completion of 2D tracks."""

from __future__ import annotations

import torch
from torch import Tensor

from kcs_torch.errors import OptionError
from kcs_torch.functional.shapes import check_core
from kcs_torch.functional.spectral import singular_values
from kcs_torch.functional.temporal import interpolate
from kcs_torch.solvers.iterate import fpc

__all__ = ["complete_tracks"]


def complete_tracks(
    tracks: Tensor,
    seen: Tensor,
    *,
    num_steps: int = 60,
    first: float = 0.3,
    last: float = 2e-3,
    inside: Tensor | None = None,
) -> Tensor:
    """Fill unseen joints so that a clip's poses, as a T x 2N matrix about their mean, have low rank.

    Starts from linear interpolation in time; nuclear-norm completion then makes what is filled consistent with
    how the joints move together elsewhere in the clip, where interpolation alone breaks the rank that a camera
    factorisation builds on. Frames without any seen joint stay interpolated between their completed neighbours.

    Args:
        tracks: (..., T, N, 2), finite.
        seen: (..., T, N), True where the tracks hold.
        num_steps: shrinkage steps; the weight falls geometrically.
        first: first weight, a share of the largest singular value.
        last: last weight.
        inside: (..., T), False in frames that pad a shorter clip at its end: they do not count, and are 0.

    Returns:
        (..., T, N, 2), equal to the tracks where they are seen.

    Raises:
        ShapeError: they are not of these shapes.
        OptionError: a weight is not positive.

    Mazumder, Hastie, Tibshirani 2010 (soft-impute).
    """
    if not (first > 0 and last > 0):
        raise OptionError(f"complete_tracks: expected positive first and last weights, got {first} and {last}")
    if inside is not None:
        check_core(tracks, "complete_tracks: tracks", "T", "N", 2)
        check_core(seen, "complete_tracks: seen", *tracks.shape[-3:-1])
        check_core(inside, "complete_tracks: inside", tracks.shape[-3])
        seen = seen & inside[..., None]
    filled = interpolate(tracks, seen)
    real = torch.ones_like(seen[..., 0]) if inside is None else inside
    filled = filled * real[..., None, None]
    gaps = (real & ~seen.all(-1)).any(-1)
    if not bool(gaps.any()):
        return filled
    if gaps.ndim and not bool(gaps.all()):  # what has no gaps takes no steps
        options = {"num_steps": num_steps, "first": first, "last": last}
        found = complete_tracks(tracks[gaps], seen[gaps], inside=real[gaps], **options)  # type: ignore[arg-type]
        return filled.index_put((gaps,), found)
    here = real[..., None, None].to(tracks.dtype)
    mean = filled.sum(-3, keepdim=True) / here.sum(-3, keepdim=True)
    kept = (seen[..., None] * here).expand_as(tracks).flatten(-2)
    goal = ((tracks - mean).flatten(-2)) * kept
    start = ((filled - mean) * here).flatten(-2)
    ratio = (last / first) ** (1 / max(num_steps - 1, 1))
    top = singular_values(start)[..., 0]
    weights = [first * ratio**k * top for k in range(num_steps)]
    found = fpc(start, lambda x: x * kept - goal, step=1.0, weights=weights, steps_per_weight=1).value
    found = torch.where(seen[..., None], tracks, found.unflatten(-1, tracks.shape[-2:]) + mean)
    # The least nuclear norm puts a frame without any seen joint at the mean pose: a jump that no camera makes.
    return interpolate(found, seen.any(-1, keepdim=True)) * here
