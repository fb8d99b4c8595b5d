"""What a template needs beside itself: its scale in the image, and a stand-in where there is none."""

from __future__ import annotations

import torch
from torch import Tensor

from kcs_torch.anatomy import quadruped_places, template_by_names
from kcs_torch.functional.camera import back_project
from kcs_torch.functional.temporal import interpolate
from kcs_torch.methods.clips.cameras import orthographic_cameras
from kcs_torch.nn.deviation import template_scale
from kcs_torch.skeleton import Skeleton, known_by_names
from kcs_torch.types import Tracks

__all__ = ["clip_scale", "guessed", "rigid_shape"]


def clip_scale(tracks: Tracks, rest: Tensor) -> Tensor:
    """Weak-perspective scale of each frame, by :func:`kcs_torch.nn.deviation.template_scale`.

    Args:
        tracks: the tracks.
        rest: (N, 3) template.

    Returns:
        (T,), positive.
    """
    index = tracks.skeleton.bone_index(device=tracks.points.device)[list(tracks.skeleton.rigid)]
    return template_scale(tracks.points, tracks.weights, rest, index)


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


def guessed(body: Skeleton) -> bool:
    """Whether a body's template is an animal's that this library guessed, and not one that somebody gave."""
    names = body.joints
    if body.template is None or quadruped_places(names) is None:
        return False
    ours = known_by_names(names)
    return body.template in (template_by_names("quadruped", names), None if ours is None else ours.template)
