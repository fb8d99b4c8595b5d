"""A recording for the rerun viewer: 3D, tracks, bone lengths and uncertainty on one time line."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kcs_torch.errors import OutputError
from kcs_torch.types import Reconstruction
from kcs_torch.types.arrays import as_doubles
from kcs_torch.viewer.colours import COLOURS, bone_keys, joint_keys
from kcs_torch.viewer.names import as_people, clip_rate, person_names, printable
from kcs_torch.viewer.together import points_together

__all__ = ["need_rerun", "save_recording"]


def save_recording(results: Reconstruction | Sequence[Reconstruction], path: str | Path) -> None:
    """Write a rerun recording (.rrd) of one or several people; open it with ``rerun FILE``.

    3D is in the camera's axes (x right, y down, z away), one time line counts frames, another seconds where the rate
    is known. Unseen joints are left out of the tracks.

    Raises:
        OptionError: there is no result, or the frame rates differ.
        OutputError: rerun is not installed, or it cannot write the file.
    """
    people = as_people(results, "save_recording")
    clip_rate(people, "save_recording")
    rr, rrb = need_rerun()
    layout = rrb.Horizontal(
        rrb.Spatial3DView(origin="/space", name="3D"),
        rrb.Vertical(
            rrb.Spatial2DView(origin="/image", name="tracks"),
            rrb.TimeSeriesView(origin="/lengths", name="bone lengths, deviation in %"),
            rrb.TimeSeriesView(origin="/uncertainty", name="standard deviation of depth"),
        ),
    )
    recording = rr.RecordingStream("kcs_torch")
    try:
        recording.save(str(path), default_blueprint=rrb.Blueprint(layout, collapse_panels=True))
        recording.log("space", rr.ViewCoordinates.RDF, static=True)
        for name, result, points in zip(person_names(people), people, points_together(people), strict=True):
            _log(recording, rr, name, result, points)
        recording.flush()
        recording.disconnect()
    except (OSError, RuntimeError) as error:
        raise OutputError(f"rerun could not write the recording: {error}") from None


def need_rerun() -> tuple[Any, Any]:
    """The modules rerun and rerun.blueprint.

    Raises:
        OutputError: they are not installed.
    """
    try:
        import rerun as rr
        import rerun.blueprint as rrb
    except ImportError as error:
        raise OutputError(f"a recording needs the package rerun-sdk ({error}): pip install rerun-sdk") from None
    return rr, rrb


def _log(recording: Any, rr: Any, name: str, result: Reconstruction, points: NDArray[np.float64]) -> None:
    body = result.skeleton
    seen = result.tracks.seen.cpu().numpy()
    places = as_doubles(result.tracks.points)
    bones = body.bone_index().numpy()
    hues, limbs = _colours(joint_keys(body)), _colours(bone_keys(body))
    labels = [printable(j) for j in body.joints]
    rigid = np.array(body.rigid, dtype=int)
    lengths = np.linalg.norm(points[:, bones[rigid, 1]] - points[:, bones[rigid, 0]], axis=-1)
    deviation = 100 * (lengths / np.maximum(np.nanmean(lengths, 0), 1e-12) - 1) if len(rigid) else lengths
    spread = None if result.uncertainty is None else as_doubles(result.uncertainty)
    names = [f"{labels[a]}-{labels[b]}" for a, b in bones[rigid]]
    if len(rigid):
        recording.log(["lengths", name], rr.SeriesLines(names=names, colors=limbs[rigid]), static=True)
    if spread is not None:
        recording.log(["uncertainty", name], rr.SeriesLines(names=labels, colors=hues), static=True)
    radius = 0.008 * float(np.nanmax(np.nanmax(points, (0, 1)) - np.nanmin(points, (0, 1))))
    for t in range(len(points)):
        recording.set_time("frame", sequence=t)
        if result.fps:
            recording.set_time("time", duration=t / result.fps)
        joints = rr.Points3D(points[t], colors=hues, labels=labels, show_labels=False, radii=1.4 * radius)
        recording.log(["space", name, "joints"], joints)
        recording.log(["space", name, "bones"], rr.LineStrips3D(points[t][bones], colors=limbs, radii=radius))
        dots = rr.Points2D(
            places[t][seen[t]],
            colors=hues[seen[t]],
            labels=[label for label, known in zip(labels, seen[t], strict=True) if known],
            show_labels=False,
        )
        recording.log(["image", name, "joints"], dots)
        both = seen[t][bones].all(1)
        recording.log(["image", name, "bones"], rr.LineStrips2D(places[t][bones[both]], colors=limbs[both]))
        if len(rigid):
            recording.log(["lengths", name], rr.Scalars(deviation[t]))
        if spread is not None:
            recording.log(["uncertainty", name], rr.Scalars(spread[t]))


def _colours(keys: Sequence[str]) -> np.ndarray[Any, np.dtype[np.uint8]]:
    return np.array([[int(COLOURS[k][i : i + 2], 16) for i in (1, 3, 5)] for k in keys], np.uint8).reshape(-1, 3)
