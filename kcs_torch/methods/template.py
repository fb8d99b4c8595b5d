"""What a template needs beside itself: its scale in the image, and a stand-in where there is none."""

from __future__ import annotations

import itertools

import torch
from torch import Tensor

from kcs_torch.functional.camera import back_project
from kcs_torch.functional.chain import bone_lengths, bone_vectors
from kcs_torch.functional.temporal import interpolate
from kcs_torch.methods.cameras import orthographic_cameras
from kcs_torch.types import Tracks

__all__ = ["clip_scale", "rigid_shape"]


def clip_scale(tracks: Tracks, rest: Tensor, *, span: int = 60, quantile: float = 0.95) -> Tensor:
    """Weak-perspective scale of each frame, from the longest projections of the bones around it.

    A bone's projection is at most scale times its length, and reaches it where the bone lies in the image plane. In
    spans of frames, each bone's high quantile of |projection| / length votes, and the median bone wins: an arm held out
    does not enlarge the body.

    Args:
        tracks: the tracks.
        rest: (N, 3) template.
        span: frames of a span; scales between spans are interpolated.
        quantile: of a bone's projections within a span.

    Returns:
        (T,), positive.
    """
    body = tracks.skeleton
    frames, device = tracks.num_frames, tracks.points.device
    index = body.bone_index(device=device)[list(body.rigid)]
    fallback = tracks.points.square().sum(-1).mean().sqrt() / rest.square().sum(-1).mean().sqrt().clamp_min(1e-12)
    if len(index) == 0:
        return fallback.clamp_min(1e-12).expand(frames)
    length = bone_lengths(rest, index)
    seen = (tracks.weights[:, index[:, 0]] > 0) & (tracks.weights[:, index[:, 1]] > 0) & (length > 0)
    ratio = bone_vectors(tracks.points, index).norm(dim=-1) / torch.where(length > 0, length, torch.ones_like(length))
    ratio = torch.where(seen, ratio, torch.nan)
    count = max(1, round(frames / span))
    edges = [round(i * frames / count) for i in range(count + 1)]
    spans = list(itertools.pairwise(edges))
    votes = torch.stack([ratio[a:b].nanquantile(quantile, 0).nanmedian() for a, b in spans])
    overall = ratio.nanquantile(quantile, 0).nanmedian()
    overall = torch.where(torch.isfinite(overall) & (overall > 0), overall, fallback.clamp_min(1e-12))
    votes = torch.where(torch.isfinite(votes) & (votes > 0), votes, overall)
    at = torch.tensor([(a + b - 1) / 2 for a, b in spans], dtype=votes.dtype, device=device)
    time = torch.arange(frames, dtype=votes.dtype, device=device)
    right = torch.bucketize(time, at).clamp(1, max(count - 1, 1)).clamp_max(count - 1)
    left = (right - 1).clamp_min(0)
    gap = (at[right] - at[left]).clamp_min(1e-12)
    share = ((time - at[left]) / gap).clamp(0, 1)
    return votes[left] * (1 - share) + votes[right] * share


def rigid_shape(tracks: Tracks, cameras: Tensor | None = None) -> Tensor:
    """The one rigid shape that best explains the tracks: a template for want of any.

    Args:
        tracks: the tracks.
        cameras: (T, 2, 3) where they are known; else those of :func:`orthographic_cameras`.

    Returns:
        (N, 3), in the world frame of the cameras. Where the viewpoint does not turn its depth is nearly zero.
    """
    filled = interpolate(tracks.points, tracks.seen)
    filled = filled - filled.mean(-2, keepdim=True)
    if cameras is None:
        cameras = orthographic_cameras(filled[None])[0]
    normal = (cameras.mT @ cameras).mean(0) + 1e-3 * torch.eye(3, dtype=filled.dtype, device=filled.device)
    return torch.linalg.solve(normal, back_project(filled, cameras).mean(0).mT).mT
