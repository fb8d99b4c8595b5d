"""What the size of its image tells of a camera that nobody has calibrated: :func:`lens_of_image`."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from kcs_torch.clean.detector import detected
from kcs_torch.functional.chain import bone_lengths
from kcs_torch.methods.answer.finish import extent
from kcs_torch.methods.clips.template import clip_scale
from kcs_torch.methods.perspective.pinhole_coordinates import USUAL
from kcs_torch.methods.pkc.objective import usual_posture
from kcs_torch.types import Intrinsics, Tracks

__all__ = ["NEAR", "lens_of_image"]

NEAR = 10.0
"""Distance up to which a camera is near: from there on a wrong focal length does more harm than parallel rays."""

FOCAL = 0.85
"""Usual focal length over the image's longer side, that of phones, web and action cameras."""

SIZES: tuple[tuple[int, int], ...] = (
    (640, 360),
    (640, 480),
    (854, 480),
    (1280, 720),
    (1920, 1080),
    (2704, 1520),
    (3840, 2160),
)
"""Usual sizes of images, whichever side is up."""

INSIDE = 0.99
"""Share of the joints that an image of usual size holds: detectors place some a little beside it."""


def lens_of_image(tracks: Tracks, beside: Sequence[Tracks] = ()) -> tuple[Intrinsics, float, str] | None:
    """A likely lens of a camera that made an image of such a size, and what to say of it.

    Where nobody says how large the image is, it is taken to be the smallest of usual size that holds the tracks.

    Args:
        tracks: of a body with a template. A detector's are in pixels, whatever they say: files often tell the unit of
            the motion.
        beside: others in the same image, which holds them, too.

    Returns:
        A lens that looks at the image's middle, of a focal length between that of usual lenses, as images are cropped,
        and one that makes the camera's distance a usual one; the former; and a sentence. Or None where the tracks are
        not in pixels, no image of usual size holds them, they show a point, or a body so small that rays might as well
        be parallel.
    """
    tracks = replace(tracks, points=tracks.points.detach())
    points = tracks.points[tracks.seen]
    if not bool(extent(tracks) > 0) or not (tracks.units == "px" or detected(tracks)):
        return None
    size = tracks.image_size or _usual_size(
        torch.cat([points, *(one.points[one.seen].detach().to(points) for one in beside)])
    )
    if size is None:
        return None
    width, height = size
    focal, body = FOCAL * max(width, height), tracks.skeleton
    rest = body.template_points(dtype=points.dtype, device=points.device)
    lengths = bone_lengths(rest, body.bone_index(device=points.device))
    own = usual_posture(body, points.dtype, points.device).rest_lengths
    unit = float(clip_scale(tracks, rest).median() * (lengths / own).median())
    if not focal < NEAR * unit:
        return None
    said = (
        f"the image is taken to be {width} x {height} pixels, the smallest of usual size that holds the tracks: if it "
        "is not, give image_size=(width, height) (kcs-torch: --image-size), or the camera's intrinsics"
    )
    likely = math.sqrt(focal * USUAL * unit)
    return Intrinsics(likely, likely, width / 2, height / 2), focal, "" if tracks.image_size else said


def _usual_size(points: Tensor) -> tuple[int, int] | None:
    """The smallest image of usual size that holds points (n, 2), if one does."""
    usual = (size for wide, high in SIZES for size in ((wide, high), (high, wide)))
    return min((size for size in usual if _holds(points, size)), key=math.prod, default=None)


def _holds(points: Tensor, size: tuple[int, int]) -> bool:
    """Whether an image of such a size holds nearly all of points (n, 2)."""
    inside = ((points >= 0) & (points <= points.new_tensor(size))).all(-1)
    return float(inside.to(points.dtype).mean()) >= INSIDE
