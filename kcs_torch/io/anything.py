"""Read whatever is at a path: a result, 3D motion, or tracks."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from kcs_torch.errors import FormatError, OptionError, unknown
from kcs_torch.io.containers.archive import Archive
from kcs_torch.io.formats.npz import load_reconstruction
from kcs_torch.io.load import READERS, describe, load_tracks
from kcs_torch.io.motion import MOTION_READERS, load_motion
from kcs_torch.io.registry import Probe, check_fps, only_format
from kcs_torch.skeleton import Skeleton
from kcs_torch.types import Motion, Reconstruction, Tracks

__all__ = ["kind_of", "load_any"]

_SPOKEN = {"result": "a result, which has its own", "motion": "3D motion"}


def load_any(
    path: str | Path,
    *,
    format: str | None = None,
    skeleton: str | Path | Skeleton | None = None,
    fps: float | None = None,
    up: str | None = None,
    units: str | None = None,
    person: int | None = None,
    threshold: float | None = None,
    image_size: tuple[int, int] | None = None,
    trust: bool = False,
) -> Reconstruction | Motion | Tracks:
    """Read a result if there is one, else 2D tracks, else 3D motion, as the content tells.

    Args:
        path: a file, or a folder of tracks.
        format: a name in ``READERS`` or ``MOTION_READERS``; found by content if None.
        skeleton: as of :func:`load_tracks` and :func:`load_motion`; not for results, which have theirs.
        fps: frames per second; as the file says if None.
        up: as of :func:`load_motion`.
        units: as of :func:`load_motion`.
        person: as of :func:`load_tracks`.
        threshold: as of :func:`load_tracks`.
        image_size: as of :func:`load_tracks`.
        trust: as of :func:`load_tracks`.

    Raises:
        FormatError: nothing that is known is there.
        OptionError: an option is unknown, out of range, or does not suit what is there.
    """
    if format is not None and format not in READERS and format not in MOTION_READERS:
        raise unknown("format", format, {*READERS, *MOTION_READERS})
    check_fps(fps)
    kind = kind_of(path, format)
    for option, given in {"image_size": image_size, "threshold": threshold, "trust": trust or None}.items():
        if kind != "tracks" and given is not None:
            name = f"{option} (kcs-torch: --{option.replace('_', '-')})"
            raise OptionError(f"{path}: {name} belongs to 2D tracks, got {_SPOKEN[kind]}: leave it out")
    if kind == "result":
        if skeleton is not None or up is not None or units is not None or person is not None:
            raise OptionError(f"{path}: a result has its own skeleton, axes, units and person; save it as motion first")
        result = load_reconstruction(path)
        return result if fps is None else result.moved(lambda x: x, replace(result.tracks, fps=fps))
    if kind == "motion":
        if person is not None:
            raise OptionError(f"{path}: a person is chosen of 2D tracks, got 3D motion of one body")
        return load_motion(path, format=format, skeleton=skeleton, fps=fps, up=up, units=units)
    if up is not None or units is not None:
        raise OptionError(f"{path}: an axis that points up and units of length are for 3D motion, got 2D tracks")
    return load_tracks(
        path, format=format, person=person, skeleton=skeleton, fps=fps, threshold=threshold, image_size=image_size,
        trust=trust,
    )  # fmt: skip


def kind_of(path: str | Path, format: str | None = None) -> str:
    """Say whether there is a "result", "motion" or "tracks".

    Raises:
        FormatError: nothing that is known is there.
    """
    probe = Probe(path)
    if format == "npz" or (format is None and MOTION_READERS["npz"].recognises(probe)):
        keys = Archive(probe.path).keys
        if {"points3d_all", "diagnostics", "points2d"} <= set(keys):
            return "result"
        return "motion" if "points3d" in keys and "points2d" not in keys else "tracks"
    if format is not None:
        motion = MOTION_READERS.get(format)
        holds = motion and (motion.holds or motion.recognises)
        return "motion" if holds and (format not in READERS or holds(probe)) else "tracks"
    if any(reader.recognises(probe) for reader in MOTION_READERS.values()):
        return "motion"
    if only_format(READERS, probe) is None:
        known = ", ".join([*READERS, *MOTION_READERS])
        raise FormatError(f"{path}: expected tracks or motion in one of {known}, got {describe(probe)}")
    return "tracks"
