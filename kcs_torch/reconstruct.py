"""The entry call: :func:`reconstruct`."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import Any

from kcs_torch.errors import OptionError, unknown
from kcs_torch.functional.camera import camera_disagreement
from kcs_torch.methods import KCS, METHODS, SfAM
from kcs_torch.methods.base import Method
from kcs_torch.skeleton import Skeleton
from kcs_torch.types import Reconstruction, Tracks

__all__ = ["reconstruct"]

ENOUGH_TURN = 60.0
"""Degrees of viewpoint turn from which low-rank shapes beat a template."""

TRUSTED = 25.0
"""Degrees within which SfAM's cameras must agree with those that the template gives: wrong ones are far off."""


def reconstruct(
    tracks: Any,
    *,
    method: str | Method = "auto",
    skeleton: str | Path | Skeleton | None = None,
    confidence: Any = None,
    fps: float | None = None,
    units: str = "px",
    cameras: Any = None,
    **fields: Any,
) -> Reconstruction:
    """Turn 2D joint tracks of one body into 3D motion with bones of constant length; no training data.

    Args:
        tracks: a :class:`Tracks`, or an array (T, N, 2) with NaN where unseen.
        method: "auto", a name in :data:`kcs_torch.METHODS`, or a :class:`Method`. "auto" takes SfAM
            where the skeleton has no template, or the viewpoint turns enough and SfAM's cameras agree with those that
            the template gives; else KCS, with its frames in one row each and constant bones.
        skeleton: for arrays: a :class:`Skeleton`, a built-in name, or a YAML/JSON file.
        confidence: for arrays: (T, N) in 0..1.
        fps: for arrays: frames per second.
        units: for arrays.
        cameras: (T, 2, 3) camera rows, world to camera, where they are known.
        **fields: of the method, such as ``beta=2.0``.

    Returns:
        A :class:`Reconstruction`: points (T, N, 3) in the camera frame, cameras, lengths, diagnostics.

    Raises:
        OptionError: the method or a field is unknown, or its value is out of range; or array options come with Tracks.
        ShapeError: an array has the wrong shape or values.
        SkeletonError: the skeleton is unknown or does not fit.

    >>> from kcs_torch.data.synthetic import walking_person
    >>> result = reconstruct(walking_person(60).tracks, method="sfam", beta=2.0)
    >>> result.points.shape, result.method
    (torch.Size([60, 17, 3]), 'sfam')
    """
    if isinstance(tracks, Tracks):
        if skeleton is not None or confidence is not None or fps is not None:
            raise OptionError(
                "reconstruct: skeleton, confidence and fps belong to arrays; these tracks already have them"
            )
    else:
        tracks = Tracks.from_arrays(tracks, confidence, skeleton=skeleton, fps=fps, units=units)
    if isinstance(method, Method):
        if fields:
            raise OptionError(
                f"reconstruct: fields ({', '.join(fields)}) go with a method's name; set them on the method itself"
            )
        return method(tracks, cameras)
    if method == "auto":
        if fields:
            raise OptionError(f"reconstruct: fields ({', '.join(fields)}) need a method's name: {', '.join(METHODS)}")
        return _automatic(tracks, cameras)
    if not isinstance(method, str) or method not in METHODS:
        raise unknown("method", method, ["auto", *METHODS])
    return METHODS[method].from_options(**fields)(tracks, cameras)


def _automatic(tracks: Tracks, cameras: Any) -> Reconstruction:
    """The result of the method that suits the tracks.

    Low-rank shapes need a viewpoint that turns, a template needs a skeleton that has one. Where the turn is too small,
    SfAM may take the body's motion for the camera's; the template's cameras, rough as they are, give it away.
    """
    if tracks.skeleton.template is None:
        return SfAM()(tracks, cameras)
    chosen, told = _aside(KCS(arrangement="frames", bone_steps=20), tracks, cameras)
    if chosen.diagnostics.viewpoint_turn >= ENOUGH_TURN / 2:
        low_rank, more = _aside(SfAM(), tracks, cameras)
        turned = low_rank.diagnostics.viewpoint_turn >= ENOUGH_TURN
        if turned and (cameras is not None or float(camera_disagreement(low_rank.cameras, chosen.cameras)) <= TRUSTED):
            chosen, told = low_rank, more
    for warning in told:
        warnings.warn(warning.message, warning.category, stacklevel=3)
    return chosen


def _aside(method: Method, tracks: Tracks, cameras: Any) -> tuple[Reconstruction, list[warnings.WarningMessage]]:
    """A method's result, and its warnings for the case that it is chosen."""
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        return method(tracks, cameras), told
