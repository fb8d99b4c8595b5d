"""OpenPose JSON: a folder with one file a frame, or one such file."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from kcs_torch.errors import FormatError, ShapeError
from kcs_torch.io.build import build_tracks
from kcs_torch.io.folders import frame_numbers
from kcs_torch.io.link import link_people
from kcs_torch.io.registry import Options, Probe, Reader, read_error
from kcs_torch.skeleton import SKELETONS, Skeleton, get_skeleton
from kcs_torch.types import Tracks

__all__ = ["READERS"]

LAYOUTS = {25: ("body25", "body25b"), 18: ("coco18",), 15: ("mpi15",), 21: ("hand21",)}
"""Skeletons by the number of joints that a person has; the usual one first."""
_BODY = "pose_keypoints_2d"
_OTHERS = ("face_keypoints_2d", "hand_left_keypoints_2d", "hand_right_keypoints_2d")
_NAME = re.compile(r"(?P<prefix>.*?)(?P<number>[0-9]+)?(?:_keypoints)?\Z", re.DOTALL)
_BLANK = b"\xef\xbb\xbf \t\r\n"  # what may stand before the JSON, a byte order mark included
_FARTHEST = 1e9  # pixels
_CLEARLY = 0.7  # bones this much shorter, by another layout's order of joints, tell that it is the right one
_OVERSHOOT = 1.5  # some networks' confidences pass 1; above this they are on another scale
_FPS = 30.0  # assumed for how long somebody may be out of sight, where nothing is known

Person = NDArray[np.float64]  # (..., N, 3): x, y, confidence


def recognises(probe: Probe) -> bool:
    """Tell by the word "people" in the JSON of the path, or of some files of the folder."""
    if probe.is_file:
        return probe.head.lstrip(_BLANK).startswith(b"{") and b'"people"' in probe.head
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
    detections = [np.zeros((0, joints, 3))] * (frames[-1] + 1)
    for frame, people in zip(frames, found, strict=True):
        if people:
            detections[frame] = np.stack(people)
    layout = _layout(joints, detections, options, path, notes)
    linked = link_people(detections, max_gap=max(round(options.fps or _FPS), 1))
    visible = [t for t in linked if (t[..., 2] >= max(options.threshold, 1e-12)).any()]
    if not visible:
        raise ShapeError(f"{path}: no joint has a confidence of {options.threshold:g} or more: lower the threshold")
    if len(visible) < len(linked):
        notes.append(f"{len(linked) - len(visible)} people never reach the confidence threshold: left out")
    return [
        build_tracks(
            np.where(track[..., 2:] > 0, track[..., :2], np.nan),
            track[..., 2],
            options,
            source=str(path),
            skeleton=layout,
            notes=notes,
        )
        for track in visible
    ]


def _frame_files(probe: Probe, notes: list[str]) -> tuple[Sequence[Path], list[int]]:
    """The files of a folder in the order of their frames, and the frame of each."""
    files = probe.like(".json")
    if not files:
        suffixes = sorted({f.suffix or f.name for f in probe.files})
        raise FormatError(f"{probe.path}: expected a folder of OpenPose .json files, got {', '.join(suffixes[:5])}")
    if len(files) < len(probe.files):
        notes.append(f"{len(probe.files) - len(files)} files that are not .json are left out")
    names = [_NAME.match(f.stem) for f in files]
    prefixes = sorted({m["prefix"] for m in names if m and m["number"]})
    if len(prefixes) > 1:
        folder = files[0].parent
        ways = " or ".join(repr(str(folder / f"{p}*")) for p in prefixes[:4])
        raise FormatError(
            f"{probe.path}: expected the files of one recording, got {len(prefixes)} kinds of file names: give {ways}"
        )
    numbers = [int(m["number"]) if m and m["number"] else None for m in names]
    for i, number in enumerate(numbers[1:]):
        if number is not None and number == numbers[i]:
            raise FormatError(f"{probe.path}: expected one file a frame, got {files[i].name} and {files[i + 1].name}")
    return files, frame_numbers(numbers, notes)


def _read_files(files: Sequence[Path], notes: list[str]) -> list[list[Person]]:
    """The people of each frame's file."""
    found: list[list[Person]] = []
    first: tuple[int, Path] | None = None
    others, halves, largest = False, 0, 0.0
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
            # A missing joint is 0, 0, 0. Neither is one 0 a measurement: in real files joints jump to x = 0.
            unseen = ~np.isfinite(joints).all(-1) | (joints[:, :2] == 0).any(-1)
            halves += int((unseen & (joints[:, 2] > 0)).sum())
            joints[unseen] = 0
            largest = max(largest, float(joints[:, 2].max()))
            if largest <= _OVERSHOOT:
                joints[:, 2] = joints[:, 2].clip(max=1)
            found[-1].append(joints)
    if others:
        notes.append("face and hand joints are left out: only the body is read")
    if halves:
        notes.append(f"{halves} joints whose x or y is exactly 0 are taken as unseen")
    if 1 < largest <= _OVERSHOOT:
        notes.append(f"confidences above 1 (up to {largest:.3g}) are taken as 1")
    return found


def _people(file: Path) -> Iterable[dict[str, Any]]:
    """The people of one frame's file."""
    try:
        data = json.loads(file.read_bytes())
    except OSError as error:
        raise read_error(file, error) from None
    except (ValueError, RecursionError) as error:  # also of bytes that are no text
        raise FormatError(f"{file}: expected JSON, got text that does not parse: {error}") from None
    people = data.get("people") if isinstance(data, dict) else None
    if not isinstance(people, list) or not all(isinstance(p, dict) for p in people):
        raise FormatError(f"{file}: expected OpenPose's {{'people': [...]}}, got other JSON")
    return people


def _numbers(values: Any, file: Path) -> list[float]:
    """The numbers of one person, checked one by one: JSON may hold anything in their place."""
    if values is None:
        return []
    if not isinstance(values, list) or not all(type(v) in (int, float) for v in values):
        raise FormatError(f"{file}: '{_BODY}': expected a list of numbers x, y, confidence, got something else")
    if len(values) % 3:
        raise FormatError(f"{file}: '{_BODY}': expected 3 numbers a joint, got {len(values)} numbers")
    for i, v in enumerate(values):
        if not (math.isnan(v) or abs(v) <= _FARTHEST):
            raise FormatError(f"{file}: '{_BODY}': number {i} is {v:.3g}: expected pixels and confidences")
        if i % 3 == 2 and v < 0:
            raise FormatError(f"{file}: '{_BODY}': joint {i // 3} has a negative confidence {v:g}; expected 0..1")
    return values


def _layout(joints: int, detections: list[Person], options: Options, path: Path, notes: list[str]) -> str | None:
    """The built-in skeleton that a number of joints means; None where the caller's own fits."""
    if joints in LAYOUTS:
        usual, *others = LAYOUTS[joints]
        spread = {name: _mean_bone(SKELETONS[name], np.concatenate(detections)) for name in (usual, *others)}
        best = min(spread, key=lambda name: spread[name])
        if spread[best] < _CLEARLY * spread[usual]:
            notes.append(f"{3 * joints} numbers a person are {usual} as a rule; the joints' places say {best}")
            return best
        return usual
    if options.skeleton is not None and get_skeleton(options.skeleton).num_observed == joints:
        return None
    known = ", ".join(f"{3 * n} ({' or '.join(names)})" for n, names in LAYOUTS.items())
    fits = [s.name for s in SKELETONS.values() if s.num_observed == joints]
    hint = f"; {joints} joints fit skeleton={' or '.join(map(repr, fits))}" if fits else "; give skeleton=..."
    raise FormatError(f"{path}: expected {known} numbers a person, got {3 * joints}{hint}")


def _mean_bone(skeleton: Skeleton, people: Person) -> float:
    """Mean length of the bones that all detections (P, N, 3) have by a skeleton: small if it is the right one."""
    data = torch.from_numpy(people)
    points, weights = skeleton.complete(data[..., :2], data[..., 2])
    start, end = skeleton.bone_index().unbind(-1)
    weight = torch.minimum(weights[:, start], weights[:, end])
    length = (points[:, end] - points[:, start]).norm(dim=-1)
    return float((weight * length).sum() / weight.sum().clamp(min=1e-9)) if weight.any() else math.inf


READERS = (Reader("openpose", "OpenPose JSON: a folder with one file a frame, or one file", recognises, read),)
