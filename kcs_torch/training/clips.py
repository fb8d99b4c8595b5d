"""Motion to train on: from files, or made up."""

from __future__ import annotations

import glob
import math
import warnings
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import torch
from torch import Tensor

from kcs_torch.data import random_motion, walking_person
from kcs_torch.errors import FormatError, KcsWarning, OptionError, SkeletonError, listed
from kcs_torch.io.folders import natural_key
from kcs_torch.io.motion import read_motion
from kcs_torch.io.registry import MotionOptions
from kcs_torch.skeleton import Skeleton, get_skeleton, map_joints
from kcs_torch.training.seeds import generator_of
from kcs_torch.types import Motion
from kcs_torch.types.axes import from_y_up
from kcs_torch.types.bodies import IN_ORDER, numbered
from kcs_torch.types.size import unit_ratio
from kcs_torch.types.upright import upside_down

__all__ = ["SYNTHETIC", "Clip", "file_clips", "find_files", "resampled", "synthetic_clips"]

SYNTHETIC = "synthetic"
"""What stands for made-up motion instead of files."""


class Clip(NamedTuple):
    """Motion of one body in a world of x right, y down, z away, about the middle of it all.

    Attributes:
        points: (T, N, 3).
        known: (T, N) True where ``points`` hold.
        source: the file.
        skeleton: of the N joints.
    """

    points: Tensor
    known: Tensor
    source: str
    skeleton: Skeleton


def find_files(
    patterns: str | Path | Sequence[str | Path],
    folder: str | Path = ".",
    *,
    of: str = "3D motion",
    folders: bool = False,
) -> list[Path]:
    """List the files of one pattern or several in natural order, without those of patterns that begin with ``!``.

    A file that is found by several paths is listed once.

    Args:
        patterns: one or several.
        folder: that they are relative to.
        of: what is in the files, for messages.
        folders: whether a folder counts as a file (OpenPose writes one a clip).

    Raises:
        OptionError: there are none, or a pattern that begins with ``!`` leaves out none of them.
    """
    every = [patterns] if isinstance(patterns, (str, Path)) else list(patterns)
    found: dict[Path, Path] = {}  # by where they really are
    left_out: dict[str, set[Path]] = {}
    for pattern in map(str, every):
        paths = (Path(folder, p) for p in glob.glob(pattern.removeprefix("!"), root_dir=folder, recursive=True))
        files = {p.resolve(): p for p in sorted(paths) if p.is_file() or (folders and p.is_dir())}
        if pattern.startswith("!"):
            left_out[pattern] = set(files)
        else:
            found = files | found
    out = sorted((found[p] for p in found.keys() - set().union(*left_out.values())), key=lambda p: natural_key(str(p)))
    for pattern, which in left_out.items():
        if found and not which & found.keys():
            raise OptionError(
                f"data: pattern {pattern}: expected it to leave out some of the files of {of} in "
                f"{Path(folder).resolve()}, it leaves out none"
            )
    if not out:
        raise OptionError(
            f"data: expected files of {of} that match {', '.join(map(str, every)) or 'a pattern'} in "
            f"{Path(folder).resolve()}, found none"
        )
    return out


def file_clips(
    files: Sequence[Path],
    *,
    skeleton: str | Path | Skeleton | None,
    fps: float | None,
    up: str | None,
    units: str,
    file_units: str | None = None,
    file_fps: float | None = None,
) -> list[Clip]:
    """Read motion files, all onto one skeleton, frame rate and unit.

    Args:
        files: in any format of :func:`kcs_torch.load_motion`.
        skeleton: whose joints are found by name; as the first file says if None.
        fps: frames per second that they are brought to; as they are if None.
        up: the axis that points up in those files that do not say.
        units: of the clips.
        file_units: of the numbers of those files that do not say.
        file_fps: frames per second of those files that do not say.

    Raises:
        FormatError: a file is no motion, or its frame rate or unit is unknown.
        SkeletonError: a file has other joints than the first one, none for a joint of the skeleton, or as many but with
            names most of which are not the skeleton's.

    Warns:
        KcsWarning: a file has as many joints as the skeleton, without its names or some of them: they are taken in
            their order.
        KcsWarning: a body stands on its head, as the file does not say which axis is up.
    """
    body = None if skeleton is None else get_skeleton(skeleton)
    options = MotionOptions(body, None, up, file_units, fill_in=("up", "units"))
    out = []
    told: set[str] = set()
    for path in files:
        motion = read_motion(path, None, options)
        motion = motion if motion.fps is not None else replace(motion, fps=file_fps)
        if body is None:
            body = motion.skeleton
        elif skeleton is not None and (taken := [note for note in motion.notes if note.startswith(IN_ORDER)]):
            _check_names(read_motion(path, None, replace(options, skeleton=None)).skeleton, body, path)
            if taken[0] not in told:
                warnings.warn(f"{path}: {taken[0]}", KcsWarning, stacklevel=2)
            told.add(taken[0])
        elif motion.skeleton != body and motion.skeleton.joints != body.joints:
            raise SkeletonError(
                f"{path}: expected the joints of {files[0]} ({', '.join(body.joints)}), got "
                f"{', '.join(motion.skeleton.joints)}: give skeleton=..., whose joints are found by name"
            )
        clip = _clip_of(motion, body, path, fps, units)
        if up is None and upside_down(clip.points[..., 1], clip.known, clip.skeleton):
            warnings.warn(
                f"{path}: the body stands on its head: say which axis points up, with up='y' or 'z' where the file "
                "does not, else by writing it anew (kcs-torch convert IN OUT --from-up -y)",
                KcsWarning,
                stacklevel=2,
            )
        out.append(clip)
    return out


def _clip_of(motion: Motion, body: Skeleton, path: Path, fps: float | None, units: str) -> Clip:
    """A file's motion at so many frames a second and in a unit of length, if it tells its own."""
    never = [body.joints[n] for n in (~motion.seen.any(0)).nonzero().flatten().tolist()]
    if never:
        raise SkeletonError(
            f"{path}: no frame has {', '.join(never)} of skeleton '{body.name}': choose a skeleton whose joints "
            "the file has"
        )
    points, known = motion.points, motion.seen
    if fps is not None:
        if motion.fps is None:
            raise FormatError(
                f"{path}: its frame rate is unknown: give file_fps=... (data.file_fps=...), or fps=None "
                "(data.fps=null) to take its frames as they are"
            )
        points, known = resampled(points, known, motion.fps, fps)
    ratio = unit_ratio(motion.units, units)
    if ratio is None:
        how = (
            "set its true size first (kcs-torch convert --scale height=1.75m)"
            if motion.units == "px"
            else "give file_units=..., one of m, cm, mm"
        )
        raise FormatError(
            f"{path}: expected a unit of length that converts to {units}, got {motion.units or 'none'}: {how}"
        )
    return _placed(from_y_up(points, "-y") * ratio, known, str(path), body)


def _check_names(own: Skeleton, body: Skeleton, path: Path) -> None:
    """Make sure that joints that are to be taken in their order are those of the skeleton, where they have names.

    Raises:
        SkeletonError: most names are of something else.
    """
    names, wanted = own.joints[: own.num_observed], body.joints[: body.num_observed]
    lacking = [name for name, found in zip(wanted, map_joints(names, wanted), strict=True) if found is None]
    if not numbered(names) and 2 * len(lacking) > len(wanted):
        raise SkeletonError(
            f"{path}: expected the joints of skeleton '{body.name}', got as many others, none of them named "
            f"{listed(lacking, 6)}; they are {listed(names, 40)}: choose a skeleton whose joints these are, or write "
            "one with these names"
        )


def synthetic_clips(
    count: int, *, skeleton: str | Path | Skeleton, fps: float, units: str, seed: int, split: str, num_frames: int = 300
) -> list[Clip]:
    """Make up motion: by turns a walking person, of any size and pace, and random motion.

    Bodies whose joints are not a person's move at random only.
    """
    body = get_skeleton(skeleton)
    ratio = unit_ratio("mm", units)
    if ratio is None:
        raise OptionError(f"data: units: expected a unit of length, got {units!r}")
    out = []
    for i in range(count):
        generator = generator_of(seed, split, "synthetic", i)
        height, pace = torch.rand(2, generator=generator, dtype=torch.float64).tolist()
        stature = 1.5 + 0.45 * height
        points = None
        if i % 2 == 0:
            try:
                walk = walking_person(
                    num_frames,
                    skeleton=body,
                    fps=fps / (0.8 + 0.5 * pace),
                    yaw=0.0,
                    pitch=0.0,
                    turn=0.0,
                    height=stature,
                )
                points = walk.points
            except SkeletonError:
                pass
        if points is None:
            dance = random_motion(body, num_frames, fps=fps, swing=30.0, turn=0.0, generator=generator)
            points = dance.points * (stature / 1.75 * 4)  # a person's bones are together four metres long or so
        known = torch.ones_like(points[..., 0], dtype=torch.bool)
        out.append(_placed(points * ratio, known, f"{SYNTHETIC} {split} {i}", body))
    return out


def resampled(points: Tensor, known: Tensor, old: float, new: float) -> tuple[Tensor, Tensor]:
    """Bring motion from ``old`` frames per second to ``new``: cubic between four known frames, else linear.

    Args:
        points: (T, N, D).
        known: (T, N) True where they hold.
        old: frames per second.
        new: frames per second.

    Returns:
        (T', N, D) and (T', N); a new frame is known where the old ones on either side are.

    >>> x = torch.arange(9.0)[:, None, None] ** 2
    >>> resampled(x, torch.ones(9, 1, dtype=torch.bool), 120, 60)[0].flatten().tolist()
    [0.0, 4.0, 16.0, 36.0, 64.0]
    """
    frames = len(points)
    length = math.floor((frames - 1) * new / old + 1e-6) + 1
    place = (torch.arange(length, dtype=torch.float64, device=points.device) * (old / new)).clamp_max(frames - 1)
    near = place.round()
    place = torch.where((place - near).abs() < 1e-6, near, place)
    start = place.floor().long()
    share = (place - start).to(points)[:, None, None]
    index = start[:, None] + torch.arange(-1, 3, device=points.device)
    inside = ((index >= 0) & (index < frames)).all(-1)[:, None]
    index = index.clamp(0, frames - 1)
    a, b, c, d = points[index].unbind(1)
    every = known[index]  # (T', 4, N)
    exact = share[..., 0] == 0
    both = every[:, 1] & (every[:, 2] | exact)
    slope, next_slope = (c - a) / 2, (d - b) / 2  # Catmull and Rom's
    cubic = b + share * (slope + share * (3 * (c - b) - 2 * slope - next_slope
                                          + share * (2 * (b - c) + slope + next_slope)))  # fmt: skip
    linear = b + share * (c - b)
    out = torch.where((every.all(1) & inside)[..., None], cubic, linear)
    out = torch.where(exact[..., None], b, out)
    return torch.where(both[..., None], out, torch.zeros_like(out)), both


def _placed(points: Tensor, known: Tensor, source: str, body: Skeleton) -> Clip:
    """A clip of points with y down, about the middle of their bounding box."""
    far = torch.full_like(points, math.inf)
    low = torch.where(known[..., None], points, far).amin((0, 1))
    high = torch.where(known[..., None], points, -far).amax((0, 1))
    points = torch.where(known[..., None], points - (low + high) / 2, torch.zeros_like(points))
    return Clip(points.float(), known, source, body)
