"""Read 3D motion from a path."""

from __future__ import annotations

from pathlib import Path

from kcs_torch.errors import FormatError, unknown
from kcs_torch.io.registry import MotionOptions, Probe, check_fps, discover_motion, only_format
from kcs_torch.skeleton import Skeleton
from kcs_torch.types import Motion
from kcs_torch.types.axes import AXES

__all__ = ["MOTION_READERS", "detect_motion_format", "load_motion"]

MOTION_READERS = discover_motion()
"""The formats that 3D motion comes in, by name."""


def detect_motion_format(path: str | Path) -> str:
    """Tell the format of a file of 3D motion from its content; a name in ``MOTION_READERS``.

    Raises:
        FormatError: nothing is there, it is empty, or no reader recognises it.
    """
    found = only_format(MOTION_READERS, Probe(path))
    if found is None:
        raise FormatError(
            f"{path}: expected 3D motion in one of the formats {', '.join(MOTION_READERS)}, got something else; "
            "load_tracks() reads 2D tracks"
        )
    return found


def load_motion(
    path: str | Path,
    *,
    format: str | None = None,
    skeleton: str | Path | Skeleton | None = None,
    fps: float | None = None,
    up: str | None = None,
    units: str | None = None,
) -> Motion:
    """Read 3D motion of one body: to score against, to make tracks of (:meth:`Motion.tracks`), to convert.

    Args:
        path: a file.
        format: a name in ``kcs_torch.io.MOTION_READERS``; found by content if None.
        skeleton: a :class:`Skeleton`, a built-in name or a YAML/JSON file, whose joints are found by name; as the file
            says if None. For AMC the .asf file, if it is not beside it.
        fps: frames per second; as the file says if None.
        up: the axis that points up in the file: y, z, x, -y (a camera's axes) or -z; as the file says if None, or y.
        units: of the file's numbers, where it does not say (BVH).

    Returns:
        The motion, turned so that y is up; ``notes`` say what was assumed.

    Raises:
        FormatError: the path cannot be read as motion.
        ShapeError: its numbers are no motion (infinite, nothing seen).
        SkeletonError: the joints do not fit the skeleton.
        OptionError: an option is unknown or out of range.
    """
    if format is not None and format not in MOTION_READERS:
        raise unknown("format", format, MOTION_READERS)
    if up is not None and up not in AXES:
        raise unknown("axis for up", up, AXES)
    check_fps(fps)
    probe = Probe(path)
    reader = MOTION_READERS[detect_motion_format(path) if format is None else format]
    return reader.read(probe.path, MotionOptions(skeleton, fps, up, units))
