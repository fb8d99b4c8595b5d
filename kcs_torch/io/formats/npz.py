"""The native .npz: tracks in, everything out. Plain arrays, no pickle.

Tracks are ``points2d`` (T, N, 2) with NaN where unseen, ``confidence`` (T, N), ``edges`` (B, 2), ``joint_names``
(N,), ``fps`` (NaN: unknown) and ``units``; all but the first may be absent. What this library writes has ``skeleton``
and ``notes`` as JSON text, too, and, where they are known, ``detector``, whether a detector made the tracks,
``image_size``, width and height in pixels, and ``image_guess``, what these are taken to be; confidences have then been
through a threshold and count as they are. A result adds, for the same N joints, ``points3d`` (T, N, 3), and

- ``points3d_all`` (T, M, 3) and ``joint_names_all`` (M,): with the virtual joints, which come last; ``bones`` (B, 2)
  are (parent, child) indices into them and ``lengths`` (B,) their lengths;
- ``cameras`` (T, 2, 3), ``scales`` (T,), ``units3d``, ``method``, ``objective``, and where they are known
  ``uncertainty`` (T, M), ``root_depth`` (T,), ``distance`` (T,) and ``intrinsics`` (fx, fy, cx, cy);
- ``diagnostics`` as JSON text;
- ``alternatives``, how many other solutions there are, best first: what belongs to number 1 begins with
  ``alternative1_`` (``alternative1_points3d_all``, ...). Tracks and skeleton are those of the result.

3D motion is ``points3d`` (T, N, 3) with NaN where unseen and ``up``, the axis that points up; without it the axes are
the camera's. ``joint_names``, ``edges``, ``fps``, ``units``, ``skeleton`` and ``notes`` are as above.
"""

from __future__ import annotations

import dataclasses
import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from kcs_torch.errors import FormatError, KcsError
from kcs_torch.io.containers.archive import Archive, array_names
from kcs_torch.io.contents.build_motion import build_motion
from kcs_torch.io.contents.build_tracks import build_tracks
from kcs_torch.io.contents.shares import are_shares, in_pixels
from kcs_torch.io.registry import MotionOptions, MotionReader, Options, Probe, Reader, Saving, Writer
from kcs_torch.skeleton import Skeleton
from kcs_torch.types import Diagnostics, Intrinsics, Motion, Reconstruction, Tracks
from kcs_torch.types.arrays import as_array
from kcs_torch.types.axes import AXES, from_y_up
from kcs_torch.types.image_size import told_image_size
from kcs_torch.types.size import short_unit

__all__ = ["MOTION_READERS", "READERS", "WRITERS", "load_reconstruction"]


def recognises(probe: Probe) -> bool:
    """Tell a zip archive of .npy files, damaged ones included, by its first member."""
    zipped = probe.head.startswith(b"PK\x03\x04") and b".npy" in probe.head[:512]
    return zipped and "positions_2d" not in array_names(probe.path)  # that is VideoPose3D's


def read(path: Path, options: Options) -> list[Tracks]:
    """Read the one body's tracks of a native file."""
    file = Archive(path)
    if "points2d" not in file and "points3d" in file:
        raise FormatError(
            f"{path}: expected 2D tracks under 'points2d', got 3D motion only (points3d): "
            "load_motion(path) reads it, and its .tracks() makes 2D tracks"
        )
    if "points2d" not in file.keys:
        raise FormatError(
            f"{path}: expected an array 'points2d' (frames, joints, 2), as numpy.savez(path, points2d=..., "
            f"confidence=..., joint_names=...) writes it, got {', '.join(file.keys) or 'none'}"
        )
    points = file.array("points2d", "fiu", 3)
    units = short_unit(file.text("units")) if "units" in file else "px"
    notes = _json(file, "notes", list) if "notes" in file else []
    size = _size_in(file)
    written = "skeleton" in file  # by this library
    if units == "px" and points.shape[-1] == 2 and are_shares(points):
        points = in_pixels(points, options.size_of(size), notes)
    tracks = build_tracks(
        points,
        _confidence(file),
        dataclasses.replace(options, threshold=0.0) if written and options.threshold is None else options,
        source=str(path),
        names=file.texts("joint_names") if "joint_names" in file else None,
        edges=file.array("edges", "iu") if "edges" in file else None,
        skeleton=_skeleton(file) if written else None,
        fps=file.number("fps") if "fps" in file else None,
        units=units,
        notes=notes,
        detector=_detector_in(file),
        size=size,
    )
    return [dataclasses.replace(tracks, image_guess=_size_in(file, "image_guess", 0))]


def write_tracks(tracks: Tracks, path: Path) -> None:
    """Write tracks, so that the reader gives them back."""
    _save(_tracks_out(tracks), path)


def write_motion(motion: Motion, path: Path, saving: Saving) -> None:
    """Write 3D motion, so that :func:`kcs_torch.load_motion` gives it back."""
    points = as_array(from_y_up(motion.points, saving.up))
    weights = as_array(motion.weights)
    arrays = {
        "points3d": np.where(weights[..., None] > 0, points, np.nan),
        "confidence": weights,
        "up": np.array(saving.up),
    }
    _save(arrays | _facts_out(motion, motion.skeleton.num_joints), path)


def _facts_out(clip: Tracks | Motion, joints: int) -> dict[str, Any]:
    """What a file tells of the first so many joints besides where they are."""
    body = clip.skeleton
    bones = [pair for pair in body.bones if max(pair) < joints]
    return {
        "joint_names": np.array(body.joints[:joints]),
        "edges": np.array(bones, np.int64).reshape(-1, 2),
        "fps": np.float64(math.nan if clip.fps is None else clip.fps),
        "units": np.array(clip.units),
        "source": np.array(clip.source),
        "skeleton": np.array(json.dumps(body.to_dict())),
        "notes": np.array(json.dumps(clip.notes)),
    }


def _tracks_out(tracks: Tracks) -> dict[str, Any]:
    body = tracks.skeleton
    n = body.num_observed
    points, weights = as_array(tracks.points), as_array(tracks.weights)
    arrays: dict[str, Any] = {
        "points2d": np.where(weights[:, :n, None] > 0, points[:, :n], np.nan),
        "confidence": weights[:, :n],
        **_facts_out(tracks, n),
    }
    maybe = {"detector": tracks.detector, "image_size": tracks.image_size, "image_guess": tracks.image_guess}
    arrays |= {key: np.array(value) for key, value in maybe.items() if value is not None}
    if body.virtual:
        arrays |= {"points2d_virtual": points[:, n:], "confidence_virtual": weights[:, n:]}
    return arrays


def _detector_in(file: Archive) -> bool | None:
    """Whether a detector made the tracks, where the file says so."""
    return bool(file.array("detector", "b", 0)) if "detector" in file else None


def _size_in(file: Archive, key: str = "image_size", least: int = 1) -> tuple[int, int] | None:
    """Width and height of the image, where the file tells them."""
    return told_image_size(file.array(key, "fiubUS").tolist(), least) if key in file else None


def _save(arrays: dict[str, Any], path: Path) -> None:
    with path.open("wb") as file:
        np.savez_compressed(file, **arrays)


def write(result: Reconstruction, path: Path) -> None:
    """Write everything that a result holds, so that :func:`load_reconstruction` gives it back exactly."""
    body = result.skeleton
    arrays = _tracks_out(result.tracks) | {
        "points3d": as_array(result.observed),
        "joint_names_all": np.array(body.joints),
        "bones": np.array(body.bones, np.int64).reshape(-1, 2),
        "alternatives": np.int64(len(result.alternatives)),
    }
    for k, solution in enumerate((result, *result.alternatives)):
        arrays |= {_prefix(k) + key: value for key, value in _solution_out(solution).items()}
    _save(arrays, path)


def _prefix(number: int) -> str:
    """What the names of a solution's arrays begin with."""
    return f"alternative{number}_" if number else ""


def _solution_out(result: Reconstruction) -> dict[str, Any]:
    """What solutions of the same tracks do not share."""
    arrays = {
        "points3d_all": as_array(result.points),
        "lengths": as_array(result.lengths),
        "cameras": as_array(result.cameras),
        "scales": as_array(result.scales),
        "units3d": np.array(result.units),
        "method": np.array(result.method),
        "objective": np.float64(result.objective),
        "diagnostics": np.array(json.dumps(_diagnostics_out(result.diagnostics))),
    }
    if result.intrinsics is not None:
        arrays["intrinsics"] = np.array(dataclasses.astuple(result.intrinsics), np.float64)
    maybe = {"uncertainty": result.uncertainty, "root_depth": result.root_depth, "distance": result.distance}
    return arrays | {key: as_array(value) for key, value in maybe.items() if value is not None}


def load_reconstruction(path: str | Path) -> Reconstruction:
    """Read back what :func:`kcs_torch.save` wrote to an .npz file: the same numbers, bit by bit.

    Args:
        path: the file.

    Raises:
        FormatError: it is no such file.
    """
    probe = Probe(path)
    if not recognises(probe):
        raise FormatError(f"{path}: expected a result (.npz) of `kcs-torch lift` or save(), got something else")
    file = Archive(probe.path)
    wanted = ("points2d", "confidence", "points3d_all", "cameras", "scales", "lengths", "skeleton", "diagnostics")
    missing = [k for k in wanted if k not in file]
    if missing:
        raise FormatError(
            f"{path}: expected a result of `kcs-torch lift` or save(), got a file without {', '.join(missing)}; "
            "load_tracks() reads tracks"
        )
    tracks = _tracks_in(file)
    best = _solution_in(file, tracks)
    others = file.number("alternatives") if "alternatives" in file else 0
    if others != others // 1 or not 0 <= others <= len(file.keys):
        raise FormatError(f"{path}: 'alternatives': expected how many there are, got {others:g}")
    return dataclasses.replace(
        best, alternatives=tuple(_solution_in(file, tracks, _prefix(k)) for k in range(1, int(others) + 1))
    )


def _tensor(file: Archive, key: str, *shape: int) -> Tensor:
    array = file.array(key, "f", len(shape))
    if array.shape != shape or array.dtype.itemsize not in (4, 8):
        raise FormatError(f"{file.path}: '{key}': expected {shape} floats, got {array.shape} of {array.dtype}")
    return torch.from_numpy(array.astype(array.dtype.newbyteorder("="), copy=False))


def _tracks_in(file: Archive) -> Tracks:
    """The tracks of a result, exactly."""
    body = _skeleton(file)
    t, n, m = len(file.array("points2d", "f", 3)), body.num_observed, body.num_joints
    points, weights = _tensor(file, "points2d", t, n, 2), _tensor(file, "confidence", t, n)
    points = torch.where(weights[..., None] > 0, points, torch.zeros_like(points))
    if body.virtual:
        points = torch.cat([points, _tensor(file, "points2d_virtual", t, m - n, 2)], 1)
        weights = torch.cat([weights, _tensor(file, "confidence_virtual", t, m - n)], 1)
    if not (torch.isfinite(points).all() and (weights >= 0).all() and (weights <= 1).all()):
        raise FormatError(f"{file.path}: 'points2d': expected finite numbers wherever the confidence is above 0")
    fps = file.number("fps") if "fps" in file else math.nan
    if not (math.isnan(fps) or 0 < fps < math.inf):
        raise FormatError(f"{file.path}: 'fps': expected a positive number or NaN, got {fps:g}")
    return Tracks(
        points,
        weights,
        body,
        None if math.isnan(fps) else fps,
        file.text("units") if "units" in file else "px",
        file.text("source") if "source" in file else str(file.path),
        tuple(map(str, _json(file, "notes", list))) if "notes" in file else (),
        _detector_in(file),
        _size_in(file),
        _size_in(file, "image_guess", 0),
    )


def _solution_in(file: Archive, tracks: Tracks, prefix: str = "") -> Reconstruction:
    """One solution for the tracks of the file."""
    t, m = tracks.num_frames, tracks.skeleton.num_joints

    def tensor(key: str, *shape: int) -> Tensor:
        values = _tensor(file, prefix + key, *shape)
        if not torch.isfinite(values).all():
            raise FormatError(f"{file.path}: '{prefix + key}': expected finite numbers, got others")
        return values

    def maybe(key: str, *shape: int) -> Tensor | None:
        return _tensor(file, prefix + key, *shape) if prefix + key in file else None

    return Reconstruction(
        points=tensor("points3d_all", t, m, 3),
        cameras=tensor("cameras", t, 2, 3),
        scales=tensor("scales", t),
        lengths=tensor("lengths", tracks.skeleton.num_bones),
        tracks=tracks,
        method=file.text(prefix + "method") if prefix + "method" in file else "unknown",
        diagnostics=_diagnostics_in(file, prefix + "diagnostics"),
        uncertainty=maybe("uncertainty", t, m),
        root_depth=maybe("root_depth", t),
        distance=maybe("distance", t),
        intrinsics=None if (lens := maybe("intrinsics", 4)) is None else _lens_in(file, lens),
        units=file.text(prefix + "units3d") if prefix + "units3d" in file else "",
        objective=file.number(prefix + "objective") if prefix + "objective" in file else math.nan,
    )


def _lens_in(file: Archive, values: Tensor) -> Intrinsics:
    try:
        return Intrinsics(*values.tolist())
    except KcsError as error:
        raise FormatError(f"{file.path}: {error}") from None


def read_motion(path: Path, options: MotionOptions) -> Motion:
    """Read the 3D motion of a native file, or of a result."""
    file = Archive(path)
    if "points3d_all" in file and "diagnostics" in file:
        motion = Motion.of(load_reconstruction(path))
        return build_motion(
            torch.where(motion.seen[..., None], from_y_up(motion.points, "-y"), math.nan),
            options,
            source=motion.source,
            names=motion.skeleton.joints,
            skeleton=motion.skeleton,
            fps=motion.fps,
            units=motion.units,
            up="-y",
            notes=motion.notes,
        )
    if "points3d" not in file:
        raise FormatError(f"{path}: expected 3D motion under 'points3d', got {', '.join(file.keys) or 'nothing'}")
    points = torch.from_numpy(file.array("points3d", "fiu", 3).astype(np.float64))
    confidence = None if "points2d" in file else _confidence(file)  # they would be the tracks'
    if points.shape[2] != 3:
        raise FormatError(f"{path}: 'points3d': expected shape (frames, joints, 3), got {tuple(points.shape)}")
    notes = _json(file, "notes", list) if "notes" in file else []
    if "up" not in file and options.up is None:
        notes.append(
            "the axes are taken to be the camera's, y down: give up=... (kcs-torch: --from-up) if they are not"
        )
    axis = file.text("up") if "up" in file else None
    if axis is not None and axis not in AXES:
        raise FormatError(f"{path}: 'up': expected one of {', '.join(AXES)}, got {axis[:20]!r}")
    names = file.texts("joint_names") if "joint_names" in file else [f"joint{i}" for i in range(points.shape[1])]
    if len(names) != points.shape[1]:
        raise FormatError(f"{path}: 'joint_names': expected {points.shape[1]} names, got {len(names)}")
    return build_motion(
        points,
        options,
        source=str(path),
        names=names,
        edges=file.array("edges", "iu") if "edges" in file else None,
        skeleton=_skeleton(file) if "skeleton" in file else None,
        fps=file.number("fps") if "fps" in file else None,
        units=file.text("units3d" if "units3d" in file else "units") if "units" in file else "",
        up=axis,
        likely_up="-y",
        notes=[str(note) for note in notes],
        confidence=None if confidence is None else torch.from_numpy(confidence.astype(np.float64)),
    )


def _confidence(file: Archive) -> NDArray[Any] | None:
    """The joints' confidences, where the file has any."""
    key = next((key for key in ("confidence", "confidences") if key in file), None)
    return None if key is None else file.array(key, "fiub", 2)


def _skeleton(file: Archive) -> Skeleton:
    try:
        return Skeleton.from_dict(_json(file, "skeleton", dict), source=f"{file.path}: 'skeleton'")
    except KcsError as error:
        raise FormatError(str(error)) from None


def _json(file: Archive, key: str, kind: type) -> Any:
    text = file.text(key)
    try:
        value = json.loads(text)
    except (ValueError, RecursionError) as error:  # of JSON, and of numbers with thousands of digits
        raise FormatError(f"{file.path}: '{key}': expected JSON text, got {error}") from None
    if not isinstance(value, kind):
        raise FormatError(f"{file.path}: '{key}': expected a JSON {kind.__name__}, got {type(value).__name__}")
    return value


def _diagnostics_out(diagnostics: Diagnostics) -> dict[str, Any]:
    """As JSON holds it, which has no NaN: null instead."""
    values = dataclasses.asdict(diagnostics)
    return {k: None if isinstance(v, float) and math.isnan(v) else v for k, v in values.items()}


def _diagnostics_in(file: Archive, key: str) -> Diagnostics:
    values = _json(file, key, dict)
    known = {f.name: values[f.name] for f in dataclasses.fields(Diagnostics) if f.name in values}
    known = {k: math.nan if v is None else tuple(v) if isinstance(v, list) else v for k, v in known.items()}
    try:
        return Diagnostics(**known)
    except TypeError as error:
        raise FormatError(f"{file.path}: '{key}': {error}") from None


READERS = (Reader("npz", "native .npz: points2d, and confidence, edges, joint_names, fps, units", recognises, read),)
MOTION_READERS = (
    MotionReader(
        "npz", "native .npz: points3d, and up, edges, joint_names, fps, units; or a result", recognises, read_motion
    ),
)
WRITERS = (
    Writer(
        ".npz",
        "native .npz: everything, exactly; readable again as tracks and as a result",
        write,
        write_motion,
        write_tracks,
    ),
)
