"""OpenPose JSON: a folder with one file a frame, or one such file."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kcs_torch.errors import FormatError, counted
from kcs_torch.io.containers.jsonfile import MOST_PIXELS, kind, outline, read_json, short
from kcs_torch.io.contents.layout import BY_COUNT, likeliest
from kcs_torch.io.contents.people import Sighting, people_tracks
from kcs_torch.io.folders import frames_of_files
from kcs_torch.io.registry import Options, Probe, Reader
from kcs_torch.skeleton import SKELETONS, get_skeleton
from kcs_torch.types import Tracks

__all__ = ["READERS"]

LAYOUTS = {count: BY_COUNT[count] for count in (25, 18, 15, 21)}
"""Skeletons by the number of joints that a person has; the usual one first."""
_BODY = "pose_keypoints_2d"
_OTHERS = ("face_keypoints_2d", "hand_left_keypoints_2d", "hand_right_keypoints_2d")

Person = NDArray[np.float64]  # (..., N, 3): x, y, confidence


def recognises(probe: Probe) -> bool:
    """Tell by the key "people" in the JSON of the path, or of some files of the folder."""
    if probe.is_file:
        return any(route[0] == "people" for route in outline(probe.head) if len(route) > 1)
    files = probe.like(".json")
    return any(f.stem.endswith("_keypoints") or _is_frame(f) for f in (*files[:3], *files[-1:]))


def _is_frame(file: Path) -> bool:
    try:
        return recognises(Probe(file))
    except FormatError:  # an empty file, say, which is told by name once the folder is read
        return False


def read(path: Path, options: Options) -> list[Tracks]:
    """Read everybody, linked over the frames."""
    notes: list[str] = []
    probe = Probe(path)
    files, frames = ((path,), [0]) if probe.is_file else _frame_files(probe, notes)
    found = _read_files(files, notes)
    joints = next((len(p) for people in found for p in people), None)
    if joints is None:
        raise FormatError(f"{path}: expected people in at least one of {len(files)} files, got none with '{_BODY}'")
    people: list[list[Sighting]] = [[] for _ in range(frames[-1] + 1)]
    for frame, persons in zip(frames, found, strict=True):
        people[frame] = [Sighting(p) for p in persons]
    layout = _layout(joints, [np.stack(p) for p in found if p], options, path, notes)
    return people_tracks(people, options, source=str(path), names=None, skeleton=layout, notes=notes)


def _frame_files(probe: Probe, notes: list[str]) -> tuple[Sequence[Path], list[int]]:
    """The files of a folder in the order of their frames, and the frame of each."""
    files = probe.like(".json")
    if not files:
        suffixes = sorted({f.suffix or f.name for f in probe.files})
        raise FormatError(f"{probe.path}: expected a folder of OpenPose .json files, got {', '.join(suffixes[:5])}")
    if len(files) < len(probe.files):
        others = len(probe.files) - len(files)
        are = "is" if others == 1 else "are"
        notes.append(f"{counted(others, 'file')} that {are} not .json {are} left out")
    return files, frames_of_files(files, probe.path, notes)


def _read_files(files: Sequence[Path], notes: list[str]) -> list[list[Person]]:
    """The people of each frame's file."""
    found: list[list[Person]] = []
    first: tuple[int, Path] | None = None
    others = False
    for file in files:
        found.append([])
        for person in _people(file):
            others = others or any(person.get(k) for k in _OTHERS)
            numbers = _numbers(person.get(_BODY), file)
            if not numbers:
                continue
            first = first or (len(numbers), file)
            if len(numbers) != first[0]:
                raise FormatError(
                    f"{file}: expected {first[0]} numbers a person as in {first[1].name}, got {len(numbers)}"
                )
            joints = np.array(numbers, float).reshape(-1, 3)
            joints[~np.isfinite(joints).all(-1)] = 0
            found[-1].append(joints)
    if others:
        notes.append("face and hand joints are left out: only the body is read")
    return found


def _people(file: Path) -> Iterable[dict[str, Any]]:
    """The people of one frame's file."""
    data = read_json(file)
    people = data.get("people") if isinstance(data, dict) else None
    if not isinstance(people, list) or not all(isinstance(p, dict) for p in people):
        raise FormatError(f"{file}: expected OpenPose's {{'people': [...]}}, got other JSON")
    return people


def _numbers(values: Any, file: Path) -> list[float]:
    """The numbers of one person, checked one by one: JSON may hold anything in their place."""
    if values is None:
        return []
    if not isinstance(values, list):
        raise FormatError(f"{file}: '{_BODY}': expected a list of numbers x, y, confidence, got {kind(values)}")
    if len(values) % 3:
        raise FormatError(f"{file}: '{_BODY}': expected 3 numbers a joint, got {len(values)} numbers")
    for i, v in enumerate(values):
        if type(v) not in (int, float):
            raise FormatError(f"{file}: '{_BODY}': number {i}: expected a number, got {kind(v)}")
        if abs(v) > MOST_PIXELS:
            raise FormatError(f"{file}: '{_BODY}': number {i} is {short(v)}: expected pixels and confidences")
        if i % 3 == 2 and v < 0:
            raise FormatError(f"{file}: '{_BODY}': joint {i // 3} has a negative confidence {v:g}; expected 0..1")
    return values


def _layout(joints: int, detections: list[Person], options: Options, path: Path, notes: list[str]) -> str | None:
    """The built-in skeleton that a number of joints means; None where the caller's own fits."""
    if joints in LAYOUTS:
        usual = LAYOUTS[joints][0]
        best, _ = likeliest(LAYOUTS[joints], np.concatenate(detections))
        if best != usual:
            notes.append(f"{3 * joints} numbers per person usually mean {usual}, but the joints lie as those of {best}")
        return best
    if options.skeleton is not None and get_skeleton(options.skeleton).num_observed == joints:
        return None
    known = ", ".join(f"{3 * n} ({' or '.join(names)})" for n, names in LAYOUTS.items())
    fits = [s.name for s in SKELETONS.values() if s.num_observed == joints]
    hint = f"; {joints} joints fit skeleton={' or '.join(map(repr, fits))}" if fits else "; give skeleton=..."
    raise FormatError(f"{path}: expected {known} numbers a person, got {3 * joints}{hint}")


READERS = (Reader("openpose", "OpenPose JSON: a folder with one file a frame, or one file", recognises, read),)
