"""Read 3D motion from a path."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from kcs_torch.errors import FormatError, unknown
from kcs_torch.io.registry import MotionOptions, Probe, check_fps, discover_motion, only_format
from kcs_torch.skeleton import Skeleton
from kcs_torch.types import Motion
from kcs_torch.types.axes import AXES
from kcs_torch.types.size import METRES, short_unit

__all__ = ["MOTION_READERS", "detect_motion_format", "load_motion", "read_motion"]

UNITS = (*METRES, "px")
"""Units that a caller may say a file's numbers are in."""

MOTION_READERS = discover_motion()
"""The formats that 3D motion comes in, by name."""


def detect_motion_format(path: str | Path) -> str:
    """Tell the format of a file of 3D motion from its content; a name in ``MOTION_READERS``.

    Raises:
        FormatError: nothing is there, it is empty, or no reader recognises it.
    """
    probe = Probe(path)
    found = only_format(MOTION_READERS, probe)
    if found is None:
        maybe = next((r.name for r in MOTION_READERS.values() if r.holds is not None and r.holds(probe)), "")
        got = (
            f"landmarks of an image: if x, y and z are lengths, name the format: {maybe}" if maybe else "something else"
        )
        raise FormatError(
            f"{path}: expected 3D motion in one of the formats {', '.join(MOTION_READERS)}, got {got}; "
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
        up: the axis that points up in the file: y, z, x, -y (a camera's axes) or -z, whatever it says itself; as the
            file says if None, or y.
        units: of the file's numbers: m, cm, mm, in, ft or px, whatever it says itself; as the file says if None. BVH
            does not say.

    Returns:
        The motion, turned so that y is up; ``notes`` say what was assumed, and where ``up`` or ``units`` contradict the
        file.

    Raises:
        FormatError: the path cannot be read as motion.
        ShapeError: its numbers are no motion (infinite, nothing seen).
        SkeletonError: the joints do not fit the skeleton.
        OptionError: an option is unknown or out of range.
    """
    return read_motion(path, format, MotionOptions(skeleton, fps, up, units))


def read_motion(path: str | Path, format: str | None, options: MotionOptions) -> Motion:
    """As :func:`load_motion`, but some options may only fill in what the file does not say."""
    if format is not None and format not in MOTION_READERS:
        raise unknown("format", format, MOTION_READERS)
    if options.up is not None and options.up not in AXES:
        raise unknown("axis for up", options.up, AXES)
    if options.units is not None:
        options = replace(options, units=short_unit(options.units))
        if options.units not in UNITS:
            raise unknown("unit", options.units, UNITS)
    check_fps(options.fps)
    probe = Probe(path)
    reader = MOTION_READERS[detect_motion_format(path) if format is None else format]
    return reader.read(probe.path, options)
