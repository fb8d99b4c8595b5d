"""More clips out of those at hand: mirrored, and seen from another side."""

from __future__ import annotations

import torch
from torch import Tensor

from kcs_torch.functional import centre, orbit
from kcs_torch.functional.guarded import or_one
from kcs_torch.functional.precision import wide
from kcs_torch.functional.weights import known, seen_weights
from kcs_torch.skeleton import Skeleton
from kcs_torch.training.batch import Batch

__all__ = ["mirrored", "turned", "unit_size"]


def mirrored(batch: Batch, skeleton: Skeleton, share: float = 0.5) -> Batch:
    """Mirror clips left to right, each with the probability ``share``; twins change places.

    Of a body without twins, such as a hand, nothing is mirrored: it would become another one.
    """
    if not skeleton.mirror:
        return batch
    order = list(range(skeleton.num_joints))
    for a, b in skeleton.mirror:
        order[a], order[b] = b, a
    flip = torch.rand(len(batch.tracks), device=batch.tracks.device) < share

    def mix(values: Tensor, sign: Tensor | None = None) -> Tensor:
        """Values (K, T, N, ...), mirrored where wanted."""
        other = values.index_select(2, torch.tensor(order, device=values.device))
        if sign is not None:
            other = other * sign.to(other)
        return torch.where(flip.reshape(-1, *[1] * (values.ndim - 1)), other, values)

    left = torch.tensor([-1.0, 1.0, 1.0])
    return batch._replace(
        tracks=mix(batch.tracks, left[:2]),
        weights=mix(batch.weights),
        points=mix(batch.points, left),
        pseudo=mix(batch.pseudo),
    )


def turned(batch: Batch, share: float = 0.5) -> Batch:
    """Show clips from another side, each with the probability ``share``, where their 3D is known or reconstructed.

    The body is turned about the image's vertical through the middle of each frame's joints, by any angle; how far the
    tracks were from its projection (noise) and which joints are hidden stay as they are, but that joints whose 3D is
    NaN are hidden, too. Clips with a frame without any 3D are left alone.
    """
    there = batch.points.isfinite().all(-1)
    told = there & ((batch.labelled > 0)[:, None, None] | (batch.pseudo > 0))
    chosen = told.any(-1).all(-1) & (torch.rand(len(batch.tracks), device=batch.tracks.device) < share)
    angle = 360 * torch.rand(len(batch.tracks), dtype=batch.points.dtype, device=batch.tracks.device)
    points, middle = centre(known(batch.points, there), there.to(batch.points.dtype))
    anew = points @ orbit(angle).mT[:, None]
    tracks = batch.tracks + (anew - points)[..., :2] * (batch.weights > 0)[..., None]
    pick = chosen[:, None, None]
    tracks = torch.where(pick[..., None], known(tracks, there), batch.tracks)
    points = torch.where((pick & there)[..., None], anew + middle, batch.points)
    return batch._replace(tracks=tracks, weights=batch.weights * (there | ~pick), points=points)


def unit_size(batch: Batch) -> Batch:
    """Bring every clip to root mean square 1, so that losses do not depend on units."""
    tracks = wide(batch.tracks)
    seen = (seen_weights(tracks, batch.weights) > 0).to(tracks)
    about = centre(known(tracks, seen), seen)[0] * seen[..., None]
    size = (about.square().sum((-3, -2, -1)) / seen.sum((-2, -1)).clamp_min(1)).sqrt()
    size = or_one(size)[:, None, None, None]
    points = (wide(batch.points) / size).to(batch.points.dtype)
    return batch._replace(tracks=(tracks / size).to(batch.tracks.dtype), points=points)
