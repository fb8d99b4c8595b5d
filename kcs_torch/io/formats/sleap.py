"""SLEAP's analysis files, HDF5 and CSV: predictions and labels of one animal or several."""

from __future__ import annotations

import csv
import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from kcs_torch.errors import FormatError
from kcs_torch.io.containers.hdf5 import Tree, read_tree
from kcs_torch.io.containers.jsonfile import as_frame_number
from kcs_torch.io.contents.animals import LIMIT, Animal, build_animals, frames_of, refuse_3d
from kcs_torch.io.contents.build_motion import build_motion
from kcs_torch.io.contents.link import link_people, longest_gap
from kcs_torch.io.registry import MotionOptions, MotionReader, Options, Probe, Reader, brief
from kcs_torch.io.tables.bounded import bounded_rows
from kcs_torch.io.tables.header import Header, first_line
from kcs_torch.io.tables.wide import as_float, no_numbers
from kcs_torch.types import Motion, Tracks

__all__ = ["MOTION_READERS", "READERS"]

_FIRST = ["track", "frame_idx", "instance.score"]
_ORDERS = (("track", "xy", "node", "frame"), ("frame", "track", "node", "xy"))
"""Of the dimensions of ``tracks``: SLEAP's own, which MATLAB sees reversed, and that of sleap-io's "standard" files."""
_WANTED = ("tracks", "point_scores", "node_names", "track_names", "edge_inds")
_Frames = dict[int, list[NDArray[np.float64]]]  # of one track, by frame


def recognises(probe: Probe) -> bool:
    """Tell the HDF5 by its datasets, a project (which is refused) by its own, the CSV by its header."""
    if probe.hdf5 is not None:
        shapes = probe.hdf5.shapes
        if len(shapes.get("tracks", ())) == 4:
            return "node_names" in shapes or "track_occupancy" in shapes or len(shapes) == 1
        return _is_project(probe.hdf5)
    return Header.of(first_line(probe.text)).cells[:3] == _FIRST


def read(path: Path, options: Options) -> list[Tracks]:
    """Read every track as one animal."""
    notes: list[str] = []
    if Probe(path).head.startswith(b"\x89HDF"):
        animals, edges, size = _read_hdf5(path, notes)
    else:
        animals, edges, size = _read_csv(path, options, notes), None, None
    return build_animals(animals, options, path, notes, edges=edges, size=size)


def recognises_motion(probe: Probe) -> bool:
    """Tell 3D points that are triangulated from SLEAP's by their dataset and its last dimension."""
    return probe.hdf5 is not None and recognises(probe) and _is_3d(probe.hdf5)


def _is_3d(tree: Tree) -> bool:
    """Whether ``tracks`` are (frames, tracks, nodes, 3), and not (tracks, 2, nodes, 3 frames)."""
    shape = tree.shapes.get("tracks", ())
    told = "dims" in tree.attributes.get("tracks", {})
    return len(shape) == 4 and shape[3] == 3 and not told and (shape[1] != 2 or len(tree.shapes) == 1)


def read_motion(path: Path, options: MotionOptions) -> Motion:
    """Read the 3D motion of the animal that is seen most: ``tracks`` (frames, tracks, nodes, 3)."""
    tree = read_tree(path, _WANTED)
    points = tree.arrays.get("tracks", np.zeros(0))
    if points.ndim != 4 or points.shape[3] != 3 or 0 in points.shape:
        raise FormatError(f"{path}: expected 3D motion 'tracks' (frames, tracks, nodes, 3), got {points.shape}")
    names = tree.texts.get("node_names")
    if names is None or len(names) != points.shape[2]:
        names = [f"joint{i}" for i in range(points.shape[2])]
    most = int(np.isfinite(points).sum((0, 2, 3)).argmax())
    several = points.shape[1] > 1
    notes = [f"{points.shape[1]} animals: this is number {most}, the most seen one"] if several else []
    edges = _edges(tree, points.shape[2], path)
    return build_motion(
        torch.from_numpy(points[:, most].copy()), options, source=str(path), names=names, edges=edges, notes=notes
    )


def _is_project(tree: Tree) -> bool:
    return {"frames", "instances", "pred_points"} <= set(tree.shapes) and "metadata" in tree.attributes


def _read_hdf5(path: Path, notes: list[str]) -> tuple[list[Animal], NDArray[np.int64] | None, list[Any] | None]:
    """The animals, the skeleton's links, and width and height of the image."""
    tree = read_tree(path, _WANTED)
    if _is_project(tree):
        raise FormatError(
            f"{path}: expected SLEAP's analysis file, got a project: write one with "
            f"sleap-convert --format analysis {path.name}"
        )
    if "tracks" not in tree.arrays or tree.arrays["tracks"].ndim != 4:
        held = ", ".join(f"{k} {v}" for k, v in sorted(tree.shapes.items())[:8]) or "nothing"
        raise FormatError(f"{path}: expected 'tracks' (tracks, 2, nodes, frames), got {held}")
    if _is_3d(tree):
        raise refuse_3d(path)
    names = tree.texts.get("node_names")
    points = _in_order(tree, "tracks", names, path)
    tracks, frames, nodes = points.shape[:3]
    if 0 in (tracks, frames):
        raise FormatError(f"{path}: expected at least one frame of one animal, got {frames} of {tracks}")
    if names is None:
        notes.append("the file does not name the joints")
        names = [f"joint{i}" for i in range(nodes)]
    scores = np.ones(points.shape[:3])
    if "point_scores" in tree.arrays:
        scores = _in_order(tree, "point_scores", names, path)[..., 0]
        if scores.shape != points.shape[:3]:
            raise FormatError(f"{path}: 'point_scores': expected the shape {points.shape[:3]}, got {scores.shape}")
        scores = _by_hand(points, scores, notes)
    called = tree.texts.get("track_names", [])
    if len(called) != tracks:
        called = [f"track {i}" for i in range(tracks)]
    animals = [Animal(called[i] if tracks > 1 else "", names, points[i], scores[i]) for i in range(tracks)]
    return animals, _edges(tree, nodes, path), _size(tree)


def _size(tree: Tree) -> list[Any] | None:
    """Width and height, of the video's shape (frames, height, width, channels), which sleap-io writes where known."""
    try:
        told = json.loads(tree.attributes.get("", {}).get("video_backend_metadata", ""))
    except (ValueError, RecursionError):
        return None
    shape = told.get("shape") if isinstance(told, dict) else None
    return shape[2:0:-1] if isinstance(shape, list) and len(shape) == 4 else None


def _in_order(tree: Tree, key: str, names: list[str] | None, path: Path) -> NDArray[np.float64]:
    """A dataset with its dimensions in the order track, frame, node, and x, y (or a single one) last."""
    array = tree.arrays[key]
    plain = key != "tracks"
    told = tree.attributes.get(key, {}).get("dims")
    orders = [tuple(d for d in order if not (plain and d == "xy")) for order in _ORDERS]
    if told is not None:
        orders = [_dims(told, key, path)]
        if sorted(orders[0]) != sorted(d for d in _ORDERS[0] if not (plain and d == "xy")):
            raise FormatError(f"{path}: '{key}': expected dims such as {json.dumps(_ORDERS[0])}, got {told[:80]}")
    sizes = [dict(zip(o, array.shape, strict=True)) for o in orders if len(o) == array.ndim]
    fits = [s for s in sizes if s.get("xy", 2) == 2 and (names is None or s["node"] == len(names))]
    if fits:
        # Two orders may fit, of as many nodes as frames say: the number of tracks tells, or it is SLEAP's own.
        known = len(tree.texts.get("track_names", []))
        chosen = max(fits, key=lambda size: size["track"] == known)
        order = list(chosen)
        moved = array.transpose([order.index(d) for d in ("track", "frame", "node", "xy") if d in order])
        return moved[..., None] if plain else moved
    named = "" if names is None else f" of {len(names)} nodes"
    raise FormatError(f"{path}: '{key}': expected dimensions {', '.join(orders[0])}{named}, got {array.shape}")


def _dims(told: str, key: str, path: Path) -> tuple[str, ...]:
    """The names of a dataset's dimensions, from JSON."""
    try:
        names = json.loads(told)
    except (ValueError, RecursionError):
        names = None
    if not isinstance(names, list) or not all(isinstance(n, str) for n in names):
        raise FormatError(f"{path}: '{key}': expected dims such as {json.dumps(_ORDERS[0])}, got {told[:80]!r}")
    return tuple(names)


def _by_hand(points: NDArray[np.float64], scores: NDArray[np.float64], notes: list[str]) -> NDArray[np.float64]:
    """Points without a score were placed by hand."""
    placed = np.isfinite(points).all(-1) & np.isnan(scores)
    if placed.any():
        notes.append(f"{int(placed.sum())} points have no score, as those placed by hand: their confidence is 1")
    return np.where(placed, 1.0, scores)


def _edges(tree: Tree, nodes: int, path: Path) -> NDArray[np.int64] | None:
    """The skeleton's own links, which need not be a tree."""
    if "edge_inds" not in tree.arrays:
        return None
    edges = tree.arrays["edge_inds"]
    paired = edges.ndim == 2 and edges.shape[1] == 2
    wrong = edges[~np.isin(edges, np.arange(nodes))]
    if not paired or wrong.size:
        got = f"{wrong[0]:g}" if paired else f"shape {edges.shape}"
        raise FormatError(f"{path}: 'edge_inds': expected (edges, 2) node numbers 0..{nodes - 1}, got {got}")
    return edges.astype(np.int64) if edges.size else None


def _read_csv(path: Path, options: Options, notes: list[str]) -> list[Animal]:
    """Read the table with one line for every animal in every frame."""
    names, instances = _instances(path)
    numbers = sorted({f for frames in instances.values() for f in frames})
    places_of = dict(zip(numbers, frames_of([(f,) for f in numbers], path, notes)[1], strict=True))
    length = places_of[numbers[-1]] + 1
    if length * len(names) * 3 * len(instances) > LIMIT:
        raise FormatError(
            f"{path}: {length} frames of {len(instances)} tracks are more than fits: join tracks in SLEAP"
        )
    tracks: dict[str, NDArray[np.float64]] = {}
    twice = 0
    for name, frames in instances.items():
        if not name and max(map(len, frames.values())) > 1:
            tracks |= _linked(frames, places_of, length, len(names), options, notes)
            continue
        whole = tracks.setdefault(name, np.full((length, len(names), 3), np.nan))
        for frame, found in frames.items():
            twice += len(found) - 1
            whole[places_of[frame]] = found[0]
    if twice:
        lines_tell = "1 line tells" if twice == 1 else f"{twice} lines tell"
        notes.append(f"{lines_tell} a frame of a track again: the first one counts")
    scores = _by_hand(*_split(tracks), notes)
    return [
        Animal(name if len(tracks) > 1 else "", names, whole[..., :2], scores[i])
        for i, (name, whole) in enumerate(tracks.items())
    ]


def _instances(path: Path) -> tuple[list[str], dict[str, _Frames]]:
    """The nodes' names, and what stands of each track in each frame: (nodes, 3) places and scores, perhaps several."""
    instances: dict[str, _Frames] = {}
    try:
        with bounded_rows(path) as lines:
            _, header = next(lines, (0, []))
            names = list(dict.fromkeys(c.rpartition(".")[0] for c in header[3:]))
            places = [[_place(header, f"{n}.{c}") for c in ("x", "y", "score")] for n in names]
            if not names or any(None in p[:2] for p in places):
                raise FormatError(
                    f"{path}: expected columns node.x, node.y, node.score, got {brief(', '.join(header[3:7]))}"
                )
            for number, line in lines:
                if len(line) != len(header):
                    raise FormatError(f"{path}: line {number}: expected {len(header)} cells, got {len(line)}")
                try:
                    frame = as_frame_number(float(line[1]))  # tables that pandas wrote again may say 7.0
                    values = [[as_float(line[i]) if i is not None else math.nan for i in p] for p in places]
                except ValueError:
                    wrong = no_numbers([f"'{brief(column)}'" for column in header[1:]], line[1:])
                    raise FormatError(f"{path}: line {number}: {wrong}") from None
                if frame is None or not 0 <= frame < 10**15:
                    raise FormatError(f"{path}: line {number}: expected a frame number, got {brief(line[1])}")
                instances.setdefault(line[0], {}).setdefault(frame, []).append(np.array(values))
    except csv.Error as error:
        raise FormatError(f"{path}: expected SLEAP's analysis CSV, got damaged text: {error}") from None
    if not instances:
        raise FormatError(f"{path}: expected at least one animal, got a header only")
    return names, instances


def _split(tracks: dict[str, NDArray[np.float64]]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    every = np.stack(list(tracks.values()))
    return every[..., :2], every[..., 2]


def _linked(
    frames: _Frames,
    places: dict[int, int],
    length: int,
    joints: int,
    options: Options,
    notes: list[str],
) -> dict[str, NDArray[np.float64]]:
    """Several animals a frame that were not tracked: follow them."""
    detections = [np.zeros((0, joints, 3))] * length
    for frame, found in frames.items():
        poses = np.stack(found)
        poses[..., 2] = np.where(np.isnan(poses[..., 2]), 1.0, poses[..., 2])
        poses[~np.isfinite(poses).all(-1)] = 0
        detections[places[frame]] = poses
    linked = link_people(detections, max_gap=longest_gap(options.fps))
    notes.append("animals without a track are followed over the frames by where they are")
    return {f"untracked {i}": np.where(t[..., 2:] > 0, t, np.nan) for i, t in enumerate(linked)}


def _place(header: list[str], column: str) -> int | None:
    return header.index(column) if column in header else None


MOTION_READERS = (
    MotionReader(
        "sleap", "3D points triangulated from SLEAP's (points3d.h5); y up unless told", recognises_motion, read_motion
    ),
)
READERS = (Reader("sleap", "SLEAP analysis HDF5 and CSV, one animal or several", recognises, read),)
