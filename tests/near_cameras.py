"""Walks before a camera that is near."""

import warnings

import torch

import kcs_torch as kt
from kcs_torch.types import Intrinsics

LENS = (1500.0, 1480.0, 960.0, 540.0)


def filmed(nearest=2500.0, lens=LENS, frames=60, skeleton="h36m17", noise=0.0, **view):
    """Tracks in px of a walking person whose nearest joint comes as near as that (mm), and the true points (mm)."""
    clip = kt.data.walking_person(frames, skeleton=skeleton, **{"turn": 0, "yaw": 30, **view})
    points = clip.points.clone()
    points[..., 2] += nearest - float(points[..., 2].min())
    image = Intrinsics.of(lens).project(points)[:, : clip.skeleton.num_observed]
    image = image + noise * torch.randn(image.shape, generator=torch.Generator().manual_seed(0), dtype=image.dtype)
    return kt.Tracks.from_arrays(image, skeleton=clip.skeleton, fps=30.0), points


def quietly(tracks, **options):
    """A reconstruction, whatever it warns of."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", kt.KcsWarning)
        return kt.reconstruct(tracks, **options)


def error(points, truth):
    """Mean distance (mm) after the best rotation of each frame and one scale for the clip."""
    a, b = points - points.mean(1, keepdim=True), truth - truth.mean(1, keepdim=True)
    a = a @ kt.functional.nearest_rotation((a.mT @ b).mT).mT
    return float((a * ((a * b).sum() / (a * a).sum()) - b).norm(dim=-1).mean())
