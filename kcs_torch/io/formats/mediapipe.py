"""MediaPipe landmarks of poses and hands, which have no official file: JSON, CSV or NPY; x and y from 0 to 1."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import numpy as np

from kcs_torch.errors import FormatError
from kcs_torch.io.frames import by_number
from kcs_torch.io.jsonfile import outline
from kcs_torch.io.landmark_tables import csv_columns, frame_shape, npy_shape, read_csv, read_npy
from kcs_torch.io.landmarks import BODIES, KEYS, Landmarks, read_landmarks_json
from kcs_torch.io.people import people_tracks
from kcs_torch.io.registry import Options, Probe, Reader
from kcs_torch.skeleton import SKELETONS
from kcs_torch.types import Tracks

__all__ = ["READERS"]

_HIDDEN = 0.3
"""Weight of a joint of visibility 0 within the image, beside 1 of one that is seen for certain. Against other
detections of the same video, joints of visibility below 0.5 are off by 2.5 times as much as the others, not by more:
a guess that is worth something."""
_SHARES = 2.0  # coordinates whose median is above this are no shares of the image


@cache
def _named() -> frozenset[str]:
    """Names of all landmarks; loading skeletons is left until they are needed."""
    return frozenset(j for b in BODIES.values() for j in SKELETONS[b].joints[: SKELETONS[b].num_observed])


def recognises(probe: Probe) -> bool:
    """Tell by MediaPipe's keys or by frames of points in JSON, by names of columns, or by the shape of an array."""
    if probe.head.startswith(b"\x93NUMPY"):
        shape = npy_shape(probe.head)
        return shape is not None and frame_shape(shape) is not None
    routes = outline(probe.head)
    if routes:
        if any(route[-2] in KEYS and route[-1] in ("list", "dict", "null") for route in routes if len(route) > 1):
            return True
        return any(route in routes for route in (("[]", "[]", "x", "number"), ("[]", "[]", "[]", "x", "number")))
    header = probe.head.split(b"\n", 1)[0]
    marks, cells = csv_columns(header.decode("utf-8", "replace").strip())
    if cells[:2] == ["track", "frame_idx"]:  # SLEAP's
        return False
    return len(_named() & set(marks)) >= 10 or (len(marks) >= 21 and all(m.isdecimal() for m in marks))


def read(path: Path, options: Options) -> list[Tracks]:
    """Read every pose, or every hand where there are no poses."""
    probe = Probe(path)
    if not probe.is_file:
        raise FormatError(f"{path}: expected a file of landmarks, got a folder")
    if probe.head.startswith(b"\x93NUMPY"):
        found = read_npy(path)
    elif outline(probe.head) or probe.suffix == ".json":
        found = read_landmarks_json(path)
    else:
        found = read_csv(path)
    _settle(found, path, options)
    joints = next((len(s.joints) for people in found.frames.values() for s in people), 33)
    skeleton = BODIES.get(joints) if found.names is None else None
    if joints == 21:
        found.notes.append("a hand's template is that of a right one: mirror the result of a left one")
    return people_tracks(
        by_number(found.frames, found.notes),
        options,
        source=str(path),
        names=found.names,
        skeleton=skeleton,
        fps=found.fps,
        notes=found.notes,
    )


def _settle(found: Landmarks, path: Path, options: Options) -> None:
    """Turn shares of the image into pixels, and visibilities into weights.

    A joint that is hidden is guessed less well, but is not unseen, unless it is out of the image.
    """
    people = [s.joints for frame in found.frames.values() for s in frame]
    everything = np.concatenate(people or [np.zeros((0, 3))])
    places = np.abs(everything[:, :2][np.isfinite(everything[:, :2])])
    if not len(places):
        raise FormatError(f"{path}: expected landmarks in at least one of {len(found.frames)} frames, got none")
    shares = bool(np.median(places) <= _SHARES)
    size = options.image_size or found.size
    if not shares:
        found.notes.append("the coordinates are pixels already")
    elif size is None:
        raise FormatError(
            f"{path}: its coordinates are shares of the image, which needs the video's size: give "
            "image_size=(width, height) (kcs-torch: --image-size 1920x1080)"
        )
    seen = everything[:, 2]
    known = bool((seen[np.isfinite(seen)] > 0).any())  # hands have 0 everywhere
    if known:
        found.notes.append(
            f"visibility v tells what is hidden, not how well it is placed: it counts as confidence {_HIDDEN:g} + "
            f"{1 - _HIDDEN:g} v, and outside the image as v"
        )
    for joints in people:
        outside = shares & ((joints[:, :2] < 0) | (joints[:, :2] > 1)).any(-1)
        visible = np.where(np.isnan(joints[:, 2]), 1.0, joints[:, 2].clip(0, 1)) if known else np.ones(len(joints))
        joints[:, 2] = np.where(outside, visible, _HIDDEN + (1 - _HIDDEN) * visible)
        if shares and size is not None:
            joints[:, :2] *= size


READERS = (Reader("mediapipe", "MediaPipe landmarks in JSON, CSV or NPY, with the video's size", recognises, read),)
