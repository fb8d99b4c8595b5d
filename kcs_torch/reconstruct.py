"""The entry call: :func:`reconstruct`."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

from kcs_torch.errors import OptionError, unknown
from kcs_torch.methods import METHODS
from kcs_torch.methods.base import Method
from kcs_torch.methods.found import find_skeleton
from kcs_torch.methods.perspective import reconstruct_perspective
from kcs_torch.skeleton import Skeleton
from kcs_torch.types import Intrinsics, Reconstruction, Tracks

__all__ = ["reconstruct"]

DEFAULT = "pkc"
"""What "auto" stands for."""


def reconstruct(
    tracks: Any,
    *,
    method: str | Method = "auto",
    skeleton: str | Path | Skeleton | None = None,
    confidence: Any = None,
    fps: float | None = None,
    units: str = "px",
    cameras: Any = None,
    intrinsics: Any = None,
    **fields: Any,
) -> Reconstruction:
    """Turn 2D joint tracks of one body into 3D motion with bones of constant length; no training data.

    Args:
        tracks: a :class:`Tracks`, or an array (T, N, 2) with NaN where unseen.
        method: "auto" (which is "pkc"), a name in :data:`kcs_torch.METHODS`, or a :class:`Method`.
        skeleton: for arrays: a :class:`Skeleton`, a built-in name, or a YAML/JSON file. "auto", which goes with tracks
            too, finds the bones from how the joints move (:func:`kcs_torch.find_skeleton`).
        confidence: for arrays: (T, N) in 0..1.
        fps: for arrays: frames per second.
        units: for arrays.
        cameras: (T, 2, 3) camera rows, world to camera, where they are known.
        intrinsics: (fx, fy, cx, cy) or a matrix K (3, 3) in the unit of the tracks, where it is known. Perspective is
            then taken into account, and ``result.in_space()`` lies before the camera and projects onto the tracks.
        **fields: of the method, such as ``beta=2.0``.

    Returns:
        A :class:`Reconstruction`: points (T, N, 3) in the camera frame, cameras, lengths, diagnostics.

    Raises:
        OptionError: the method or a field is unknown, or its value is out of range; or array options come with Tracks.
        ShapeError: an array, or the intrinsics, has the wrong shape or values.
        SkeletonError: the skeleton is unknown or does not fit.

    >>> from kcs_torch.data.synthetic import walking_person
    >>> result = reconstruct(walking_person(60).tracks, method="sfam", beta=2.0)
    >>> result.points.shape, result.method
    (torch.Size([60, 17, 3]), 'sfam')
    """
    lens = None if intrinsics is None else Intrinsics.of(intrinsics)
    find = isinstance(skeleton, str) and skeleton == "auto"
    if find:
        skeleton = None
    if isinstance(tracks, Tracks):
        if skeleton is not None or confidence is not None or fps is not None:
            raise OptionError(
                "reconstruct: skeleton, confidence and fps belong to arrays; these tracks already have them"
            )
    else:
        tracks = Tracks.from_arrays(tracks, confidence, skeleton=skeleton, fps=fps, units=units)
    if find:
        tracks = replace(tracks, skeleton=find_skeleton(tracks))
    if isinstance(method, Method):
        if fields:
            raise OptionError(
                f"reconstruct: fields ({', '.join(fields)}) go with a method's name; set them on the method itself"
            )
    else:
        if method == "auto":
            method = DEFAULT
        if not isinstance(method, str) or method not in METHODS:
            raise unknown("method", method, ["auto", *METHODS])
        method = METHODS[method].from_options(**fields)
    if lens is not None:
        return reconstruct_perspective(method, tracks, lens, cameras)
    return method(tracks, cameras)
