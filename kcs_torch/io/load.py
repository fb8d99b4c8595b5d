"""Read tracks from a path: find out its format, read everybody in it, choose one."""

from __future__ import annotations

import json
import re
import warnings
from collections.abc import Sequence
from dataclasses import fields, replace
from pathlib import Path

import torch

from kcs_torch.errors import FormatError, KcsWarning, OptionError, listed, unknown, users_level
from kcs_torch.io.containers.hdf5 import read_tree
from kcs_torch.io.contents.shares import ASK
from kcs_torch.io.motion import MOTION_READERS
from kcs_torch.io.registry import Options, Probe, Reader, brief, check_fps, discover, only_format
from kcs_torch.io.tables.landmark_tables import ARRAYS
from kcs_torch.io.video import looks_like_video
from kcs_torch.skeleton import Skeleton, get_skeleton
from kcs_torch.types import Tracks
from kcs_torch.types.hints import is_a
from kcs_torch.types.image_size import as_image_size, may_be_shares
from kcs_torch.types.intake import as_number
from kcs_torch.types.people import guess_images, tell_apart

__all__ = [
    *("READERS", "WRITERS"),
    *("check_person", "check_reading", "describe", "detect_format", "load_people", "load_tracks", "most_seen"),
]

READERS, WRITERS = discover()
"""The formats that tracks come in, by name, and those that can be written, by suffix."""

MANY_FILES = 20
"""So many files of a folder that no reader knows as a whole are looked at one by one."""


def detect_format(path: str | Path) -> str:
    """Tell the format of a file or folder from its content; a name in ``READERS``.

    Raises:
        FormatError: nothing is there, it is empty, or no reader recognises it.
    """
    probe = Probe(path)
    found = only_format(READERS, probe)
    if found is None:
        raise FormatError(f"{path}: expected tracks in one of the formats {', '.join(READERS)}, got {describe(probe)}")
    return found


def load_people(
    path: str | Path,
    *,
    format: str | None = None,
    skeleton: str | Path | Skeleton | None = None,
    fps: float | None = None,
    threshold: float | None = None,
    image_size: tuple[int, int] | None = None,
    trust: bool = False,
) -> list[Tracks]:
    """Read the tracks of everybody in a file or folder, the most seen (sum of weights) first.

    Args:
        path: a file, a folder of files, or the beginning of the names of a folder's files (``shots/cam01``).
        format: a name in ``kcs_torch.io.READERS``; found by content if None.
        skeleton: a :class:`Skeleton`, a built-in name or a YAML/JSON file; as the file says if None. Joints are
            matched by name where the file names them, by their order otherwise.
        fps: frames per second; as the file says if None.
        threshold: a joint with less confidence counts as unseen, 0..1. None: .3, or 0 for tracks that this library
            wrote, whose joints have been through one.
        image_size: width and height of the video in pixels; as the file says if None. It turns coordinates that are
            shares of the image (as MediaPipe's are) into pixels, and tells the lens of a near camera roughly.
        trust: read a file although it is a pickle (VideoPose3D's .npz): arrays and numbers are taken from it, no code.

    Returns:
        At least one :class:`Tracks`; those of one video have the same number of frames. The ``source`` of several names
        the person: ``walk.json, person 1``. Where nobody says how large their image is, they carry a guess.

    Raises:
        FormatError: the path cannot be read as tracks.
        ShapeError: its numbers are no tracks (infinite, negative confidence, nothing seen).
        SkeletonError: the joints do not fit the skeleton.
        OptionError: an option is unknown or out of range.

    Warns:
        KcsWarning: coordinates lie within 0 and 1, so that they may be shares of an image whose size is not known.
    """
    options = check_reading(format, skeleton, fps, threshold, image_size, trust)
    probe = Probe(path)
    reader: Reader = READERS[detect_format(path) if format is None else format]
    people = reader.read(probe.path, options)
    if any(ASK in one.notes for one in people) and may_be_shares(torch.cat([one.points[one.seen] for one in people])):
        doubt = f"{path}: {ASK}; else the body is as distorted as the image is not square"
        warnings.warn(doubt, KcsWarning, stacklevel=users_level())
    return guess_images(tell_apart(sorted(people, key=_amount_seen, reverse=True)))


def load_tracks(
    path: str | Path,
    *,
    format: str | None = None,
    person: int | None = None,
    skeleton: str | Path | Skeleton | None = None,
    fps: float | None = None,
    threshold: float | None = None,
    image_size: tuple[int, int] | None = None,
    trust: bool = False,
) -> Tracks:
    """Read one person's tracks from a file or folder. Arguments as of :func:`kcs_torch.io.load_people`.

    Args:
        path: a file, a folder of files, or the beginning of the names of a folder's files.
        format: a name in ``kcs_torch.io.READERS``; found by content if None.
        person: which one, counted from 0 in the order of :func:`~kcs_torch.io.load_people`; the most seen if None.
        skeleton: a :class:`Skeleton`, a built-in name or a YAML/JSON file; as the file says if None.
        fps: frames per second; as the file says if None.
        threshold: a joint with less confidence counts as unseen, 0..1. None: .3, or 0 for tracks that this library
            wrote, whose joints have been through one.
        image_size: width and height of the video in pixels; as the file says if None. It turns coordinates that are
            shares of the image (as MediaPipe's are) into pixels, and tells the lens of a near camera roughly.
        trust: read a file although it is a pickle (VideoPose3D's .npz): arrays and numbers are taken from it, no code.

    Returns:
        The tracks; ``notes`` say what was assumed.

    Raises:
        FormatError: the path cannot be read as tracks, or holds fewer people.
        ShapeError: its numbers are no tracks (infinite, negative confidence, nothing seen).
        SkeletonError: the joints do not fit the skeleton.
        OptionError: an option is unknown or out of range.

    Warns:
        KcsWarning: as :func:`~kcs_torch.io.load_people`.
    """
    if person is not None and not (is_a(person, int) and person >= 0):
        raise OptionError(f"person: expected None or a number from 0, got {person!r}")
    people = load_people(
        path, format=format, skeleton=skeleton, fps=fps, threshold=threshold, image_size=image_size, trust=trust
    )
    if person is not None:
        return people[check_person(path, person, len(people))]
    return most_seen(people)


def most_seen(people: Sequence[Tracks]) -> Tracks:
    """The first of :func:`load_people`'s, with a note where there are others."""
    if len(people) == 1:
        return people[0]
    note = f"{len(people)} people found: this is the most seen one, number 0"
    return replace(people[0], notes=(*people[0].notes, note))


def check_reading(
    format: str | None = None,
    skeleton: str | Path | Skeleton | None = None,
    fps: float | None = None,
    threshold: float | None = None,
    image_size: tuple[int, int] | None = None,
    trust: bool = False,
    **unknown_options: object,
) -> Options:
    """Options of :func:`load_people` as readers take them.

    Raises:
        OptionError: an option is unknown or out of range.
        SkeletonError: there is no such skeleton.
        FormatError: the skeleton's file cannot be read.
    """
    for name in unknown_options:
        raise unknown("reading option", name, ["format", *(field.name for field in fields(Options))])
    if format is not None and format not in READERS:
        raise unknown("format", format, READERS)
    least = 0.0 if threshold is None else as_number(threshold)
    if least is None or not 0 <= least <= 1:
        raise OptionError(f"threshold: expected a number from 0 to 1, got {threshold!r}")
    check_fps(fps)
    body = None if skeleton is None else get_skeleton(skeleton)
    return Options(body, fps, threshold, as_image_size(image_size), trust)


def check_person(path: str | Path, person: int, count: int) -> int:
    """The number of one of ``count`` people.

    Raises:
        FormatError: there are fewer people.
    """
    if person < count:
        return person
    there = "0, as there is one person" if count == 1 else f"0 to {count - 1}, as there are {count} people"
    raise FormatError(f"{path}: person: expected {there}, got {person}")


def _amount_seen(tracks: Tracks) -> float:
    return float(tracks.weights[:, : tracks.skeleton.num_observed].double().sum())


def _clips(probe: Probe) -> str:
    """Two of several files that readers know one by one, and their formats, for the user; empty where there is none."""
    found: list[str] = []
    for file in probe.files[:MANY_FILES]:
        one = Probe(file)
        try:
            name = next((reader.name for reader in READERS.values() if reader.recognises(one)), None)
        except FormatError:
            continue
        found += [f"{file.name} ({name})"] if name is not None else []
        if len(found) == 2:
            break
    return " and ".join(found)


def describe(probe: Probe) -> str:
    """What a path that no reader recognises holds, in a few words."""
    motion = [reader.name for reader in MOTION_READERS.values() if reader.recognises(probe)]
    if motion:
        depths = "; if z are depths of a detector's, leave these columns out" if motion[0] == "csv" else ""
        return (
            f"3D motion ({motion[0]}): `kcs-torch convert`, `angles` and `score` take it; in Python "
            f"load_motion(path) reads it, and its .tracks() makes 2D tracks{depths}"
        )
    if probe.files:
        suffixes = sorted({f.suffix or f.name for f in probe.files})
        if clips := _clips(probe):
            return (
                f"files that are each a clip of its own, such as {clips}: give one of them ("
                "scripts/reconstruct_many.py reads all of a folder)"
            )
        kind = "a folder without tracks" if probe.is_folder else "files without tracks"
        return f"{kind} ({len(probe.files)} files: {listed(suffixes, 5)})"
    if probe.suffix == ".json":
        try:
            text = probe.path.read_bytes()
            held = json.loads(text) if text.strip() else None
        except RecursionError:
            return "JSON that is nested too deeply"
        except (OSError, ValueError) as error:
            return f"text that is not JSON ({error})"
        landmarks = '[{"pose_landmarks": [{"x": .5, "y": .5, "visibility": 1}, ...]}, ...], a frame each'
        return (
            f"JSON with other content (landmarks of MediaPipe's are {landmarks})" if held else "JSON with nothing in it"
        )
    if looks_like_video(probe.head):
        return "a video: find the joints in it first, with `kcs-torch detect VIDEO -o tracks.npz`"
    if probe.head.startswith(b"\x89HDF"):
        try:
            held = sorted(read_tree(probe.path, ()).shapes)
        except FormatError as error:
            return f"an HDF5 file that cannot be read ({str(error).removeprefix(f'{probe.path}: ')})"
        return f"an HDF5 file with other content ({listed(held, 8) or 'nothing'})"
    if probe.head.startswith(b"\x80"):
        return "a pickle, which may hold code: write what it holds with json.dump, or arrays with numpy.savez"
    if probe.head.startswith(b"PK\x03\x04"):
        return "a binary file with other content"
    if probe.head.startswith(b"\x1f\x8b"):
        return "a compressed file: unpack it first, with gunzip"
    if probe.head.startswith((b"\xff\xfe", b"\xfe\xff")):
        return "text in UTF-16, which some spreadsheets write: save it in UTF-8"
    if probe.head.startswith(b"\x93NUMPY"):
        if b"'|O'" in probe.head[:256]:
            return "an array of Python objects, which may hold code: write what it holds with json.dump"
        return (
            "a single array: write it with numpy.savez(path, points2d=array), (frames, joints, 2), NaN where unseen "
            f"(of MediaPipe's landmarks: {ARRAYS})"
        )
    if probe.suffix in (".csv", ".tsv"):
        line = probe.head.split(b"\n", 1)[0].decode("utf-8", "replace").strip("\ufeff\r")
        wanted = "csv has a row a frame and columns name_x, name_y of each joint, or columns frame, joint, x, y"
        bare = "without names above its columns, " if re.fullmatch(r"[-+0-9.eE,;\t ]+", line) else ""
        return f"a table {bare}that begins with {brief(line)!r}: {wanted}"
    start = probe.head[:16]
    return f"a file that begins with {start.decode()!r}" if start.isascii() else f"a file that begins with {start!r}"
