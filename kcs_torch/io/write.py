"""Write results, motion and tracks to files; the suffix chooses the format."""

from __future__ import annotations

import os
import warnings
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

from kcs_torch.errors import KcsWarning, OptionError, OutputError, unknown, users_level
from kcs_torch.io.atomic import atomic_path
from kcs_torch.io.load import WRITERS
from kcs_torch.io.registry import Saving, Writer
from kcs_torch.skeleton import Skeleton
from kcs_torch.types import Motion, Reconstruction, Tracks
from kcs_torch.types.size import METRES, size_hint, unit_ratio
from kcs_torch.types.upright import lean

__all__ = [
    *("check_skeleton", "people_writer", "ready_writer", "save", "save_people", "takes_up", "units_ratio"),
    "writer_for",
]

UP = ("y", "z")

LEANING = (12, 60)
"""Degrees by which a body leans in the mean if the camera may have looked down, or up, by so much."""

SCENES = frozenset((".fbx", ".glb", ".gltf", ".usd", ".usda", ".usdc", ".dae", ".abc"))
"""Suffixes of scenes, which nothing here writes."""

_NO_UNIT = (
    "got motion in an unknown one: give it where the motion is made, with units=... (kcs-torch convert: --from-units "
    "cm), or the true size, with scaled(units=..., height=1.75) (--scale height=1.75m)"
)


def save(
    data: Reconstruction | Motion | Tracks,
    path: str | Path,
    *,
    up: str | None = None,
    units: str | None = None,
    pitch: float | None = None,
    notes: list[str] | None = None,
) -> Path:
    """Write to a file in the format of its suffix (see ``kcs_torch.io.WRITERS``).

    Missing parent folders are created. The file appears whole or not at all; one that was there is replaced.

    Results stay in the camera's axes (x right, y down, z away) in .npz, .json, .html, .png and, unless ``up`` or
    ``pitch`` is given, in .csv. Files for other tools (.bvh, .trc, .c3d) hold motion with y or z up
    (:meth:`Motion.of`), in the unit that is usual there: BVH centimetres, TRC metres, C3D millimetres. Where the size
    of the body is not known, numbers stay as they are and a warning says so: :meth:`Reconstruction.scaled` sets it.

    Args:
        data: a :class:`Reconstruction`, a :class:`Motion` or, to .npz only, :class:`Tracks`.
        path: where to.
        up: the axis that points up in the file: y or z.
        units: of length in the file: m, cm, mm, in or ft.
        pitch: degrees by which the camera looked down (below 0: up), to level a result, whose up is the camera's.
        notes: sentences on how it was written are added to it; where None, those that matter are warnings.

    Returns:
        The path.

    Raises:
        OutputError: the suffix is unknown or does not suit, the data is something else or has no frames, or the file
            cannot be written; nothing is left behind.
        OptionError: ``up``, ``units`` or ``pitch`` is unknown or cannot be met.
    """
    writer = writer_for(path)
    saving = Saving(up or "y", Path(path).name)
    if not isinstance(data, (Reconstruction, Motion, Tracks)):
        raise OutputError(
            f"{path}: expected a result, motion or tracks, got {type(data).__name__}: save each by itself, or several "
            "people by kcs_torch.io.save_people"
        )
    if not len(data.points):
        raise OutputError(f"{path}: expected at least 1 frame, got none")
    if up is not None and up not in UP:
        raise unknown("axis for up", up, UP)
    if isinstance(data, Tracks):
        if writer.write_tracks is None:
            raise OutputError(
                f"{path}: expected 3D motion, got 2D tracks, which go to {_suffixes('write_tracks')}: reconstruct() or "
                "`kcs-torch lift` makes motion of them"
            )
        if up is not None or units is not None or pitch is not None:
            raise OptionError("up, units and pitch are for 3D motion, got 2D tracks")
        with atomic_path(path) as temporary:
            writer.write_tracks(data, temporary)
        return Path(path)
    if pitch is not None and isinstance(data, Motion):
        raise OptionError(f"{path}: pitch is for results, which are as the camera saw them, got motion: leave it out")
    asked = [name for name, value in (("up", up), ("pitch", pitch)) if value is not None]
    if isinstance(data, Reconstruction) and writer.write is not None and not (asked and writer.turns):
        if asked:
            those = ", ".join(suffix for suffix in WRITERS if takes_up(f"x{suffix}"))
            raise OptionError(f"{path}: {asked[0]} is for {those}; this one holds results in the camera's axes")
        if units is not None:
            data = data.scaled(units=units, factor=units_ratio(data.units, units))
        with atomic_path(path) as temporary:
            writer.write(data, temporary)
        return Path(path)
    if writer.write_motion is None:
        raise OutputError(f"{path}: expected a result, got motion, which goes to {_suffixes('write_motion')}")
    check_skeleton(path, data.skeleton)
    motion = _as_motion(data, pitch, writer, units, path, saving)
    with atomic_path(path) as temporary:
        writer.write_motion(motion, temporary, saving)
    if notes is not None:
        notes.extend([*saving.warnings, *saving.notes])
    else:
        for warning in saving.warnings:
            warnings.warn(f"{path}: {warning}", KcsWarning, stacklevel=users_level())
    return Path(path)


def _as_motion(
    data: Reconstruction | Motion,
    pitch: float | None,
    writer: Writer,
    units: str | None,
    path: str | Path,
    saving: Saving,
) -> Motion:
    """Motion in the unit that the file is to have; what there is to say of it goes to ``saving``."""
    motion = Motion.of(data, pitch=0.0 if pitch is None else pitch) if isinstance(data, Reconstruction) else data
    motion = replace(motion, points=motion.points.detach())
    if isinstance(data, Reconstruction):
        known = data.distance is not None or data.root_depth is not None
        saving.notes.append(
            "the body walks through space, by the depth that was found"
            if known
            else "the body stays at one depth: how far it walks towards or away from the camera is not known"
        )
        if pitch is None and (said := _leaning(motion)):
            saving.notes.append(said)
    wanted = units or writer.unit
    if units is not None or (wanted and motion.units in METRES):
        motion = motion.scaled(units=wanted, factor=units_ratio(motion.units, wanted))
    elif writer.names_unit and not motion.units:
        raise OptionError(f"{path}: expected motion in a unit of length, which the file names, {_NO_UNIT}")
    elif wanted:
        saving.warnings.append(
            f"the true size is not known: lengths are in {motion.units or 'an unknown unit'}; set it with "
            f"{size_hint(motion.skeleton)}"
        )
    return motion


def _leaning(motion: Motion) -> str:
    """What to say of a result whose body leans as far as if the camera was not level; else empty."""
    by = round(lean(motion.points, motion.seen, motion.skeleton))
    if not LEANING[0] <= abs(by) <= LEANING[1]:
        return ""
    side, way = ("towards", "down") if by > 0 else ("away from", "up")
    return (
        f"up is the camera's, and the body leans {abs(by)} degrees {side} it in the mean: if the camera looked {way} "
        f"by so much, level the motion with pitch={by} (kcs-torch: --pitch {by})"
    )


def takes_up(path: str | Path) -> bool:
    """Whether a result goes to this file with y or z up, and not in the camera's axes.

    Raises:
        OutputError: the suffix is unknown.
    """
    writer = writer_for(path)
    return writer.turns or writer.write is None


def save_people(results: Sequence[Reconstruction], path: str | Path) -> Path:
    """Write several people of one clip to one file, in the first one's unit: .html, .gif, .mp4 or .rrd.

    Raises:
        OutputError: files of this suffix hold one person, or it is unknown, or the file cannot be written.
        OptionError: there is nobody, the frame rates differ, or units that do not convert.

    Warns:
        KcsWarning: the clips are not equally long, so that they may begin at different frames.
    """
    write_people = people_writer(path)
    frames = [len(result.points) for result in results]
    if len(set(frames)) > 1:
        warnings.warn(
            f"{path}: people have {', '.join(map(str, frames))} frames: all are shown from their own first one on, "
            "which is another time where each was trimmed (kcs-torch lift: --frames seen)",
            KcsWarning,
            stacklevel=users_level(),
        )
    with atomic_path(path) as temporary:
        write_people(results, temporary)
    return Path(path)


def people_writer(path: str | Path) -> Callable[[Sequence[Reconstruction], Path], None]:
    """Return what writes several people to one file of such a suffix.

    Raises:
        OutputError: files of this suffix hold one person, or it is unknown.
    """
    write_people = writer_for(path).write_people
    if write_people is None:
        raise OutputError(f"{path}: several people in one file go to {_suffixes('write_people')}")
    return write_people


def writer_for(path: str | Path) -> Writer:
    """Return the writer that the suffix of a path chooses.

    Raises:
        OutputError: there is none; the message lists the suffixes.
    """
    if not isinstance(path, (str, os.PathLike)):
        raise OutputError(f"path: expected the name of a file, such as 'motion.npz', got {path!r}")
    suffix = Path(path).suffix.lower()
    if suffix not in WRITERS:
        got = f"'{suffix}'" if suffix else "none"
        hint = "; Blender and others import .bvh" if suffix in SCENES else ""
        raise OutputError(f"{path}: expected a file with one of the suffixes {', '.join(WRITERS)}, got {got}{hint}")
    return WRITERS[suffix]


def ready_writer(path: str | Path) -> Writer:
    """Return the writer that the suffix of a path chooses, if what it needs is there.

    Raises:
        OutputError: there is no such writer, or it needs a package or a program that is not installed.
    """
    writer = writer_for(path)
    if writer.ready is not None:
        try:
            writer.ready()
        except OutputError as error:
            raise OutputError(f"{path}: {error}") from None
    return writer


def check_skeleton(path: str | Path, body: Skeleton) -> None:
    """Make sure that motion of a skeleton can be written to a file.

    Raises:
        OutputError: it cannot; BVH, say, takes trees only.
    """
    fits = writer_for(path).fits
    if fits is not None:
        try:
            fits(body)
        except OutputError as error:
            raise OutputError(f"{path}: {error}") from None


def units_ratio(old: str, new: str) -> float:
    """How many new units of length an old one has.

    Raises:
        OptionError: that is not known.
    """
    if new not in METRES and new != old:
        raise unknown("unit of length", new, METRES)
    if not old:
        raise OptionError(f"units: expected motion in a unit of length, {_NO_UNIT}")
    ratio = unit_ratio(old, new)
    if ratio is None:
        raise OptionError(
            f"units: the true size is not known, only lengths in {old}; set it first with "
            f"scaled(units={new!r}, height=...) or --scale height=..."
        )
    return ratio


def _suffixes(what: str) -> str:
    """The suffixes of those writers that can do something."""
    return ", ".join(suffix for suffix, writer in WRITERS.items() if getattr(writer, what))
