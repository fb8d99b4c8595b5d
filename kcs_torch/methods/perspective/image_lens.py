"""What the size of its image tells of a camera that nobody has calibrated: its likely lens."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

from kcs_torch.clean.detector import detected
from kcs_torch.functional.chain import bone_lengths
from kcs_torch.methods.answer.finish import extent
from kcs_torch.methods.clips.template import clip_scale
from kcs_torch.methods.perspective.pinhole_coordinates import EASY, USUAL
from kcs_torch.methods.pkc.long_gaps import time_seen
from kcs_torch.methods.pkc.objective import usual_posture
from kcs_torch.types import Intrinsics, Tracks
from kcs_torch.types.image_size import usual_size

__all__ = ["LikelyLens", "lens_of_image"]

FOCAL = 0.85
"""Usual focal length over the image's longer side, that of phones, web and action cameras."""

FARTHEST = 100.0
"""Distance, for a body of 1.75, from which on a usual camera would show it so small that nobody could detect its
joints: coordinates are then hardly pixels."""

SAY_SIZE = "image_size=(width, height) (kcs-torch: --image-size), or "
"""What is asked for first where tracks say that they are in pixels."""


class LikelyLens(NamedTuple):
    """What the size of an image tells of the camera.

    Attributes:
        lens: looks at the image's middle, of a focal length between the usual one, as images are cropped, and one that
            makes the camera's distance a usual one.
        usual: focal length of usual cameras with such an image.
        said: what to say of it; empty where somebody said how large the image is.
    """

    lens: Intrinsics
    usual: float
    said: str


def lens_of_image(tracks: Tracks) -> LikelyLens | None:
    """A likely lens of a camera that made an image of such a size.

    Where nobody says how large the image is, it is taken to be the smallest of usual size that holds the tracks, and
    those of all others in it who are known (:attr:`Tracks.image_guess`).

    Args:
        tracks: of a body with a template. A detector's are in pixels, whatever they say: files often tell the unit of
            the motion.

    Returns:
        The lens; or None where the tracks are not in pixels, no image of usual size holds them, or they show a point or
        a body of a few pixels: coordinates may be metres.
    """
    time = time_seen(tracks)
    tracks = replace(tracks, points=tracks.points.detach()).frames(time.start, time.stop)
    points = tracks.points[tracks.seen]
    if not bool(extent(tracks) > 0) or not (tracks.units == "px" or detected(tracks)):
        return None
    width, height = tracks.image_size or tracks.image_guess or usual_size(points)
    if not width:
        return None
    usual, body = FOCAL * max(width, height), tracks.skeleton
    rest = body.template_points(dtype=points.dtype, device=points.device)
    lengths = bone_lengths(rest, body.bone_index(device=points.device))
    own = usual_posture(body, points.dtype, points.device).rest_lengths
    unit = float(clip_scale(tracks, rest).median() * (lengths / own).median())
    if usual > FARTHEST * unit:
        return None
    whose = " of all people in the file" if tracks.image_guess else ""
    said = (
        f"the image is taken to be {width} x {height} pixels, the smallest of usual size that holds the tracks{whose}: "
        f"if it is not, give {SAY_SIZE if tracks.units == 'px' else ''}the camera's intrinsics"
    )
    near = USUAL * unit  # focal length of a camera at the usual distance
    pull = 1.0 if usual < near else EASY
    likely = (usual * near**pull) ** (1 / (1 + pull))
    lens = Intrinsics(likely, likely, width / 2, height / 2)
    return LikelyLens(lens, usual, "" if tracks.image_size else said)
