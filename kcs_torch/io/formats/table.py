"""Plain tables: CSV with a row a frame and columns ``name_x, name_y`` for each joint, whatever it is called.

A third column of a joint may hold its confidence (``_confidence``, ``_conf``, ``_score``, ``_likelihood``,
``_probability``, ``_prob``, ``_c``), which is its weight, or MediaPipe's visibility. With ``name_z`` of every joint the
table is 3D motion: so the results that we write as CSV are read back. Long tables have a row a frame and joint, and
columns ``frame, joint, x, y``.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from kcs_torch.anatomy import places_of_known
from kcs_torch.errors import FormatError
from kcs_torch.io.contents.build_motion import build_motion
from kcs_torch.io.contents.frames import by_number
from kcs_torch.io.contents.landmarks import settle
from kcs_torch.io.contents.people import people_tracks
from kcs_torch.io.registry import MotionOptions, MotionReader, Options, Probe, Reader
from kcs_torch.io.tables.header import Columns, Header, Layout, first_line
from kcs_torch.io.tables.landmark_tables import some_joints, table_kind
from kcs_torch.io.tables.long import MOST, LongHeader, read_long
from kcs_torch.io.tables.wide import read_wide
from kcs_torch.skeleton import SKELETONS
from kcs_torch.types import Motion, Tracks

__all__ = ["MOTION_READERS", "READERS"]

_UPPER = ("headtop", "head", "nose", "eye", "ear", "upperneck", "neck", "thorax", "shoulder")
_LOWER = ("ankle", "heel", "bigtoe", "smalltoe", "knee")


def recognises(probe: Probe) -> bool:
    """Tell by the columns' names, where no other format has them."""
    return table_kind(probe.text) == "tracks"


def recognises_motion(probe: Probe) -> bool:
    """Tell by a column z of every joint."""
    return table_kind(probe.text) == "motion"


def holds_motion(probe: Probe) -> bool:
    """Tell by a column z of every joint, where the joints may have MediaPipe's names."""
    line = first_line(probe.text)
    long = LongHeader.of(line) if _is_long(probe) else None
    if long is not None:
        return long.deep
    joints = Header.of(line).joints
    return bool(joints) and all("z" in columns for columns in joints.values())


def read(path: Path, options: Options) -> list[Tracks]:
    """Read everybody: a row is a person where a column ``person`` or ``id`` says who."""
    probe = _file(path)
    if recognises_motion(probe):
        raise FormatError(
            f"{path}: expected 2D tracks, got 3D motion (x, y, z): kcs_torch.load_motion reads it; "
            "leave the columns z out if these are tracks with depths"
        )
    found = read_long(path) if _is_long(probe) else read_wide(path, _layout)
    settle(found, path, options, shares=False)
    frames = by_number(found.frames, found.notes)
    return people_tracks(
        frames,
        options,
        source=str(path),
        names=found.names,
        fps=found.fps,
        units=found.units,
        notes=found.notes,
        measured=True,
    )


def read_motion(path: Path, options: MotionOptions) -> Motion:
    """Read the motion of the one body in the table."""
    probe = _file(path)
    found = (read_long if _is_long(probe) else read_wide)(path, depth=True)
    several = max(len({s.track for f in found.frames.values() for s in f}), *map(len, found.frames.values()), 0)
    if several > 1:
        raise FormatError(
            f"{path}: expected the motion of one body, got several: column '{found.who}' has {several}: "
            "write a table for each"
        )
    names = found.names or ()
    frames = by_number(found.frames, found.notes)
    if len(frames) * len(names) * 3 > MOST:
        raise FormatError(f"{path}: {len(frames)} frames of {len(names)} joints are more than fits: split the file")
    if not frames:
        raise FormatError(f"{path}: expected a row a frame below the columns' names, got none")
    points = np.full((len(frames), len(names), 3), np.nan)
    for t, people in enumerate(frames):
        for one in people:
            points[t] = one.joints
    up = None if options.up else _up(names, points)
    if up is not None:
        found.notes.append(
            f"{up} is taken to point up, as the head is above the feet there: give up=... (kcs-torch: --from-up) if it "
            "does not"
        )
    return build_motion(
        torch.from_numpy(points),
        options,
        source=str(path),
        names=names,
        fps=found.fps,
        units=found.unit,
        likely_up=up,
        notes=found.notes,
    )


def _layout(joints: Columns, notes: list[str]) -> Layout:
    """The table's own, but for some joints of COCO the whole body."""
    return some_joints(joints, SKELETONS["coco17"], notes) or (tuple(joints), list(joints.values()))


def _is_long(probe: Probe) -> bool:
    """Whether a row is a joint: a table that may be read as both has a row a frame."""
    line = first_line(probe.text)
    return LongHeader.of(line) is not None and len(Header.of(line).joints) < 2


def _file(path: Path) -> Probe:
    probe = Probe(path)
    if not probe.is_file:
        raise FormatError(f"{path}: expected a table, got a folder")
    return probe


def _up(names: tuple[str, ...], points: NDArray[np.float64]) -> str | None:
    """The axis along which heads are furthest above feet; None where the names tell neither."""
    parts = [None if place is None else place[1] for place in places_of_known(names)]
    upper, lower = (points[:, [part in wanted for part in parts]].reshape(-1, 3) for wanted in (_UPPER, _LOWER))
    if not (np.isfinite(upper).any(0).all() and np.isfinite(lower).any(0).all()):
        return None
    x, y, z = np.nanmean(upper, 0) - np.nanmean(lower, 0)
    height = {"y": y, "z": z, "-y": -y, "x": x, "-z": -z}
    return max(height, key=lambda axis: height[axis])


READERS = (
    Reader(
        "csv",
        "plain CSV: a row a frame, columns name_x, name_y, name_confidence of each joint; or a row a frame and joint, "
        "columns frame, joint, x, y, confidence",
        recognises,
        read,
    ),
)
MOTION_READERS = (
    MotionReader(
        "csv",
        "plain CSV: columns name_x, name_y, name_z, as results are written; or frame, joint, x, y, z",
        recognises_motion,
        read_motion,
        holds_motion,
    ),
)
