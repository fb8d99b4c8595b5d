"""MediaPipe landmarks of poses, hands and both, which have no official file: JSON, CSV or NPY; x and y from 0 to 1."""

from __future__ import annotations

from pathlib import Path

from kcs_torch.errors import FormatError
from kcs_torch.io.containers.jsonfile import outline
from kcs_torch.io.contents.frames import by_number
from kcs_torch.io.contents.landmarks import BODIES, settle
from kcs_torch.io.contents.landmarks_json import KEYS, SHORT_KEYS, nested_landmarks, read_landmarks_json
from kcs_torch.io.contents.people import people_tracks
from kcs_torch.io.registry import Options, Probe, Reader
from kcs_torch.io.tables.landmark_tables import frame_shape, npy_shape, read_csv, read_npy, table_kind
from kcs_torch.skeleton import get_skeleton
from kcs_torch.types import Tracks

__all__ = ["READERS"]


def recognises(probe: Probe) -> bool:
    """Tell by MediaPipe's keys or by frames of points in JSON, by names of columns, or by the shape of an array."""
    if probe.head.startswith(b"\x93NUMPY"):
        shape = npy_shape(probe.head)
        return shape is not None and frame_shape(shape) is not None
    routes = outline(probe.head)
    if routes:
        if any(route[-2] in KEYS and route[-1] in ("list", "dict", "null") for route in routes if len(route) > 1):
            return True
        if any(route[-2:] == ("x", "number") and "landmarks" in route for route in routes):  # JavaScript's results
            return True
        if any(route[-1] == "number" and route[-2] in ("x", "[]") and SHORT_KEYS & {*route} for route in routes):
            return True
        first = {(route[0].isdecimal() or route[0] == "[]", *route[1:]) for route in routes}
        if first & {(True, "[]", "x", "number"), (True, "[]", "[]", "x", "number")}:
            return True
        return nested_landmarks(probe.head)
    return table_kind(probe.text) == "landmarks"


def read(path: Path, options: Options) -> list[Tracks]:
    """Read every pose, or every hand where there are no poses."""
    probe = Probe(path)
    if not probe.is_file:
        raise FormatError(f"{path}: expected a file of landmarks, got a folder")
    body = None if options.skeleton is None else get_skeleton(options.skeleton)
    if probe.head.startswith(b"\x93NUMPY"):
        found = read_npy(path, body)
    elif outline(probe.head) or probe.suffix == ".json":
        found = read_landmarks_json(path, body)
    else:
        found = read_csv(path, body)
    settle(found, path, options, shares=True)
    joints = next((len(s.joints) for people in found.frames.values() for s in people), 33)
    skeleton = BODIES.get(joints) if found.names is None else None
    if joints == 21 and options.skeleton is None:
        found.notes.append(
            "a hand's template is that of a right one: mirror the result of a left one, or give a skeleton whose "
            "joints are called left"
        )
    return people_tracks(
        by_number(found.frames, found.notes),
        options,
        source=str(path),
        names=found.names,
        skeleton=skeleton,
        fps=found.fps,
        units=found.units,
        notes=found.notes,
        size=found.size,
    )


READERS = (Reader("mediapipe", "MediaPipe landmarks in JSON, CSV or NPY, with the video's size", recognises, read),)
