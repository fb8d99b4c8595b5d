"""A camera that nobody has calibrated: the focal length that explains the tracks best."""

from __future__ import annotations

import math
import time
import warnings
from dataclasses import fields, replace
from typing import Any

from torch import Tensor

from kcs_torch.clean.timing import cuts_of
from kcs_torch.errors import KcsWarning, OptionError
from kcs_torch.methods.answer.finish import Estimate
from kcs_torch.methods.base import Method, apart, check_cameras
from kcs_torch.methods.clips.lockstep import Search
from kcs_torch.methods.perspective.answer import in_every_solution, noted, timed
from kcs_torch.methods.perspective.calibrated import reconstruct_perspective
from kcs_torch.methods.perspective.image_lens import LikelyLens, lens_of_image
from kcs_torch.methods.perspective.near_or_far import NEAR, is_far, may_be_near, nearness
from kcs_torch.methods.perspective.parallel_image import body_unit, clean_image
from kcs_torch.methods.perspective.pinhole_coordinates import USUAL
from kcs_torch.methods.perspective.scene import BLOCK
from kcs_torch.methods.perspective.view import lens_note
from kcs_torch.methods.pkc import PKC
from kcs_torch.methods.pkc.long_gaps import time_seen
from kcs_torch.methods.pkc.near import SEEMS_FAR, SEEMS_NEAR
from kcs_torch.nn.posture import has_trunk
from kcs_torch.types import Intrinsics, Reconstruction, Tracks, as_floats

__all__ = ["likely_lens", "looking", "reconstruct_uncalibrated"]

CLOSE = 5.0
"""Distance up to which the search under parallel rays ends: what is farther away it finds signs of better. Nor can
a body of two sides be far away that comes out as near; a hand, whose template tells less, may."""


def reconstruct_uncalibrated(
    method: Method,
    tracks: Tracks,
    cameras: Tensor | None = None,
    lifted: Reconstruction | None = None,
) -> Reconstruction:
    """Reconstruct a body before a camera of which nothing is known.

    The nearer a camera is, the more the size of a limb in the image changes with its depth: bones of constant length
    and the template's posture tell how much. Where the image's size is known, or can be guessed, the tracks are lifted
    through the lens that such a camera usually has (:func:`lens_of_image`). Where nothing tells of the image, PKC
    solves them as if rays were parallel, but ends where it has found a body whose camera seems near all the same
    (:func:`likely_lens`), before it turns runs of signs over; the principal point is then taken to be the tracks'
    middle. Either way the focal length is found together with depths, lengths, distances and signs by
    :func:`kcs_torch.methods.perspective.reconstruct_perspective`.

    Args:
        method: any.
        tracks: of a body with a template.
        cameras: as of :func:`kcs_torch.methods.perspective.reconstruct_perspective`.
        lifted: what PKC, :func:`looking` for a near camera, found under parallel rays, if it was asked before: where
            :func:`lens_of_image` tells nothing, or another's tracks told that the camera is far away.

    Returns:
        As :func:`kcs_torch.methods.perspective.reconstruct_perspective`; a note tells the intrinsics. Where the tracks
        show no perspective, the method's own solution, for parallel rays.

    Raises:
        OptionError: the skeleton has no template with a trunk.
    """
    if not has_trunk(tracks.skeleton):
        raise OptionError(
            f"intrinsics: 'auto' needs a skeleton with a template and a trunk, '{tracks.skeleton.name}' has none: "
            "expected (fx, fy, cx, cy) or a matrix K (3, 3)"
        )
    begin = time.perf_counter()
    before = 0.0 if lifted is None else lifted.diagnostics.seconds
    likely = lens_of_image(tracks)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", KcsWarning)  # of solutions on the way
        if likely is not None and lifted is None:
            result = _by_image(method, tracks, cameras, likely)
        else:
            result = _by_tracks(method, tracks, cameras, likely, lifted)
    method.warn(result)
    result = in_every_solution(result, _without_mark)
    return timed(result, before + time.perf_counter() - begin)


def _without_mark(one: Reconstruction) -> Reconstruction:
    """A solution without the mark that :func:`looking` leaves."""
    notes = tuple(note for note in one.diagnostics.notes if note != SEEMS_FAR)
    return replace(one, diagnostics=replace(one.diagnostics, notes=notes))


def _by_tracks(
    method: Method, tracks: Tracks, cameras: Tensor | None, likely: LikelyLens | None, lifted: Reconstruction | None
) -> Reconstruction:
    """A body before a camera of which the tracks tell whether it is near."""
    judge = method if isinstance(method, PKC) else PKC()
    result = looking(judge)(tracks, cameras) if lifted is None else lifted
    lens = None if SEEMS_FAR in result.diagnostics.notes else likely_lens(result, cameras)
    if lens is not None and likely is not None:
        return _by_image(method, tracks, cameras, likely)
    if lens is not None:
        near = _through(method, tracks, cameras, reconstruct_perspective(judge, tracks, lens, cameras, lifted=result))
        if bool(near.points.isfinite().all()):
            return near
    return method(tracks, cameras) if judge is not method or SEEMS_NEAR in result.diagnostics.notes else result


def _by_image(method: Method, tracks: Tracks, cameras: Tensor | None, likely: LikelyLens) -> Reconstruction:
    """A body before a camera with a likely lens, unless it comes out far away and parallel rays explain it better."""
    judge = method if isinstance(method, PKC) else PKC()
    near = reconstruct_perspective(judge, tracks, likely.lens, cameras, guessed=likely.usual)
    if not bool(near.points.isfinite().all()):
        return method(tracks, cameras)
    assert near.intrinsics is not None
    if near.intrinsics.focal > CLOSE * body_unit(near) or not tracks.skeleton.mirror:
        lifted = judge(tracks, cameras)
        if is_far(near, lifted):
            return lifted if judge is method else method(tracks, cameras)
    near = _through(method, tracks, cameras, near)
    return noted(near, likely.said) if likely.said else near


def _through(method: Method, tracks: Tracks, cameras: Tensor | None, near: Reconstruction) -> Reconstruction:
    """What a method finds through the lens that PKC found: the same if the method is PKC."""
    lens = near.intrinsics
    if isinstance(method, PKC) or lens is None:
        return near
    return noted(reconstruct_perspective(method, tracks, lens, cameras), lens_note(lens, tracks.units))


def likely_lens(lifted: Reconstruction, cameras: Tensor | None = None) -> Intrinsics | None:
    """A lens through which a body looks more likely than under the parallel rays that it was solved for.

    The solution is refined twice under perspective (:class:`.PinholeEnergy`), at a distance of
    34 of its units (a person is 1.75 tall), and at any distance. Five seconds of the clip tell.

    Args:
        lifted: a body with a template, under parallel rays.
        cameras: (T, 2, 3) that were known.

    Returns:
        A lens of usual distance whose principal point is the tracks' middle, to start from; or None where rays might as
        well be parallel.
    """
    tracks = lifted.tracks
    with apart([tracks], differentiates=False):
        if cameras is not None:
            cameras = check_cameras(as_floats(cameras, "cameras", 3).to(tracks.points), tracks.num_frames)
        flat, unit = clean_image(lifted), body_unit(lifted)
        x, y = flat[time_seen(tracks)].mean((0, 1)).tolist()
        near = SEEMS_NEAR in lifted.diagnostics.notes
        if not near:
            distance = nearness(tracks, flat, lifted.points[..., 2] / unit, unit, cameras)
            near = distance is not None and distance < NEAR
    return Intrinsics(USUAL * unit, USUAL * unit, x, y) if near else None


class _Looking(PKC):
    """PKC that looks for a near camera before it turns runs of signs over, which is then left to full perspective."""

    def _seems_near(self, tracks: Tracks, flat: Tensor, depth: Tensor, unit: float, cameras: Tensor | None) -> str:
        distance = nearness(tracks, flat, depth, unit, cameras)
        if distance is None:
            return ""
        return SEEMS_NEAR if distance < CLOSE else SEEMS_FAR if distance == math.inf else ""

    def _steps(self, tracks: Tracks, cameras: Tensor | None) -> Search[Any, Any, Estimate]:
        # in longer clips no signs are turned over under perspective
        asked = tracks.num_frames <= BLOCK and may_be_near(tracks) and not cuts_of(tracks)
        return super()._steps(tracks, cameras) if asked else _as(PKC, self)._steps(tracks, cameras)

    def _for_hands(self) -> PKC:
        return _as(PKC, self)  # whether the camera is near the body tells


def looking(method: Method) -> Method:
    """The method for tracks of a camera that may be near; only PKC itself is another one."""
    return _as(_Looking, method) if type(method) is PKC else method


def _as(kind: type[PKC], method: Method) -> PKC:
    """PKC of a kind with a method's fields."""
    return kind(**{f.name: getattr(method, f.name) for f in fields(method)})
