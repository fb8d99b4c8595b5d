"""The step that SfAM and its unrolled layers share, and what it needs: start, scale, weights and bone lengths."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from kcs_torch.errors import OptionError
from kcs_torch.functional.camera import back_project, project
from kcs_torch.functional.chain import bone_lengths, bone_vectors
from kcs_torch.functional.guarded import or_one
from kcs_torch.functional.ranks import median, nanmedian
from kcs_torch.functional.spectral import spectral_norm, svt
from kcs_torch.functional.temporal import interpolate
from kcs_torch.nn.reprojection import centred_residual
from kcs_torch.solvers.lm import fit_bones

__all__ = ["aimed_lengths", "continuation", "corner_of", "data_scale", "estimate_lengths", "shape_step", "start_shape"]


def continuation(num_weights: int, mu: float = 0.5, final: float = 1e-5) -> list[float]:
    """Weights that fall geometrically from ``mu`` to ``final``, shares of the data's largest singular value.

    >>> [round(w, 3) for w in continuation(3, 1.0, 0.01)]
    [1.0, 0.1, 0.01]
    """
    if num_weights < 1 or not 0 < final <= mu < math.inf:
        raise OptionError(
            f"continuation: expected num_weights >= 1 and 0 < final <= mu, finite, got {num_weights}, {final} and {mu}"
        )
    ratio = (final / mu) ** (1 / max(num_weights - 1, 1))
    return [mu * ratio**k for k in range(num_weights)]


def data_scale(tracks: Tensor, cameras: Tensor, weights: Tensor | None = None) -> Tensor:
    """Largest singular value of the back-projected, centred tracks as S# (T x 3N): the unit of the shrinkage, (...).

    Args:
        tracks: (..., T, N, 2).
        cameras: (..., T, 2, 3).
        weights: (..., T, N).
    """
    data = -centred_residual(torch.zeros_like(tracks), tracks, weights)
    if weights is not None:
        data = data * weights[..., None]
    return spectral_norm(back_project(data, cameras).flatten(-2))


def corner_of(share: Tensor, scale: Tensor) -> Tensor:
    """The corner of the shrinkage (...), a share of the scale; infinite where the share is, for every scale."""
    finite = share.isfinite()
    return torch.where(finite, torch.where(finite, share, torch.zeros_like(share)) * scale, torch.inf)


def estimate_lengths(
    shape: Tensor,
    bones: Tensor,
    weights: Tensor | None = None,
    *,
    graded: bool = False,
    inside: Tensor | None = None,
) -> tuple[Tensor, Tensor]:
    """Return each bone's median length over time, and how rigid it is.

    Args:
        shape: (..., T, N, 3).
        bones: (B, 2).
        weights: (..., T, N); lengths are taken from frames in which both ends are seen, if there are any.
        graded: True grades bones by how little their length varies beside the steadiest quarter of all bones, for
            links that nobody has declared rigid; False trusts all.
        inside: (..., T), False in frames that pad a shorter clip; takes weights.

    Returns:
        lengths (..., B) and rigidity (..., B) in [0, 1], a constant for autograd: among bones that all keep their
        length, rounding alone grades them.
    """
    size = bone_lengths(shape, bones)
    if weights is not None:
        seen = torch.minimum(weights[..., bones[:, 0]], weights[..., bones[:, 1]]) > 0
        if inside is not None:
            seen = seen & inside[..., None]
            seen = seen | inside[..., None] & ~seen.any(-2, keepdim=True)
        seen = seen | ~seen.any(-2, keepdim=True)
        lengths = nanmedian(torch.where(seen, size, torch.nan), -2)
    else:
        lengths = median(size, -2)
    if not graded or size.shape[-1] == 0:
        return lengths, torch.ones_like(lengths)
    with torch.no_grad():
        whole = torch.maximum(lengths, 1e-6 * size.amax(-2))  # a bone that has no length in most frames is not rigid
        off = (size - lengths[..., None, :]).abs()
        if inside is None:
            off = off.mean(-2)
        else:
            off = (off * inside[..., None]).sum(-2) / inside.sum(-1, keepdim=True).clamp_min(1)
        variation = off / or_one(whole)
        steady = variation.quantile(0.25, -1, keepdim=True)
        ratio = variation / or_one(steady)
        return lengths, 1 / (1 + ratio.square()).square()


def aimed_lengths(
    shape: Tensor,
    bones: Tensor,
    weights: Tensor,
    given: Tensor | None,
    *,
    relative: bool,
    graded: bool,
    inside: Tensor | None,
) -> tuple[Tensor, Tensor]:
    """Lengths (..., B) that bones are to have, those ``given`` or else as :func:`estimate_lengths` has them; rigidity.

    Args:
        shape: as of :func:`estimate_lengths`, and so are bones, weights, ``graded`` and ``inside``.
        bones: (B, 2).
        weights: (..., T, N).
        given: (..., B) lengths, or None.
        relative: whether these are proportions, to be brought to the scale of the shape.
        graded: whether links may turn out not to be rigid.
        inside: (..., T), or None.
    """
    measured, rigidity = estimate_lengths(shape, bones, weights, graded=graded, inside=inside)
    if given is None:
        return measured, rigidity
    return _to_scale(given, measured) if relative else given, rigidity


def _to_scale(proportions: Tensor, lengths: Tensor) -> Tensor:
    """Relative lengths (..., B), brought to the scale of measured ones (..., B): the median bone of both agrees."""
    there = proportions > 0
    ratio = lengths / torch.where(there, proportions, torch.ones_like(proportions))
    return proportions * median(ratio, -1, keepdim=True)


def shape_step(
    shape: Tensor,
    tracks: Tensor,
    cameras: Tensor,
    weights: Tensor | None,
    threshold: Tensor,
    step: Tensor | float,
    *,
    corner: Tensor | float = math.inf,
    bones: Tensor | None = None,
    lengths: Tensor | None = None,
    stiffness: Tensor | None = None,
) -> Tensor:
    """One step of SfAM: S <- shrink(S - tau (R^T w (R S + t - W) + (S - A)), tau mu), A the bone-length step.

    Args:
        shape: S (..., T, N, 3) in the world frame.
        tracks: W (..., T, N, 2).
        cameras: R (..., T, 2, 3).
        weights: w (..., T, N) or None.
        threshold: mu (...), in the unit of S#'s singular values.
        step: tau (...), or a number.
        corner: (...), of :func:`kcs_torch.functional.svt`.
        bones: (B, 2), or None for plain FPC without A.
        lengths: (..., B) target lengths.
        stiffness: (..., B), the paper's beta of each bone.

    Returns:
        (..., T, N, 3).

    Kovalenko et al. 2019, Algorithm 1, lines 5-10. With points as rows ``S.flatten(-2)`` is the reshuffled S#.
    """
    residual = centred_residual(project(shape, cameras), tracks, weights)
    gradient = back_project(residual if weights is None else residual * weights[..., None], cameras)
    if bones is not None and lengths is not None and stiffness is not None:
        # A bone of no length has no direction either: it stays, and no derivative piles up step by step.
        directed = bone_vectors(shape.detach(), bones).any(-1).to(shape.dtype)
        beta = stiffness[..., None, :] * directed
        articulated = fit_bones(shape, lengths[..., None, :], bones, stiffness=beta, num_steps=1)
        gradient = gradient + (shape - articulated)
    size = step[..., None, None, None] if isinstance(step, Tensor) else step
    return svt((shape - size * gradient).flatten(-2), step * threshold, corner).unflatten(-1, shape.shape[-2:])


def start_shape(tracks: Tensor, cameras: Tensor, weights: Tensor | None) -> Tensor:
    """The back-projected, centred tracks (..., T, N, 3).

    Unseen joints are put at the centre of the seen ones, and frames that show fewer than two joints between their
    neighbours: started at a single point they would stay there, or grow out of rounding.
    """
    centred = -centred_residual(torch.zeros_like(tracks), tracks, weights)
    if weights is None:
        return back_project(centred, cameras)
    seen = weights > 0
    shape = back_project(torch.where(seen[..., None], centred, torch.zeros_like(centred)), cameras)
    return interpolate(shape, seen.sum(-1, keepdim=True) > 1)
