"""Landmarks as people save MediaPipe's in JSON, of several layouts."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kcs_torch.errors import FormatError
from kcs_torch.io.containers.jsonfile import as_frame_number, as_joints, as_text, entries, read_json
from kcs_torch.io.contents.landmarks import (
    BODIES,
    CONFIDENCES,
    FACE_LEFT_OUT,
    SIDES,
    VISIBILITIES,
    Landmarks,
    put_together,
)
from kcs_torch.io.contents.people import Sighting
from kcs_torch.io.contents.times import frames_of_times, rate_of_times, time_unit
from kcs_torch.io.folders import frame_numbers
from kcs_torch.skeleton import SKELETONS, Skeleton
from kcs_torch.types.image_size import told_image_size
from kcs_torch.types.intake import FARTHEST

__all__ = ["KEYS", "SHORT_KEYS", "nested_landmarks", "read_landmarks_json"]

_POSE = ("pose_landmarks", "poseLandmarks", "pose", "landmarks", "landmark", "keypoints")
_HANDS = ("hand_landmarks", "handLandmarks", "multi_hand_landmarks", "multiHandLandmarks")
_ONE_HAND = {
    key: side
    for side in SIDES
    for key in (f"{side}_hand_landmarks", f"{side}HandLandmarks", f"{side}_hand", f"{side}Hand")
}
_FACE = ("face_landmarks", "faceLandmarks", "face")
KEYS = frozenset([*_POSE[:2], *_HANDS, *(key for key in _ONE_HAND if key.lower().endswith("landmarks"))])
"""Keys that only MediaPipe's results have."""
SHORT_KEYS = frozenset([_POSE[2], *_ONE_HAND, "hands", *_FACE]) - KEYS
"""Keys of other files, too, where nothing like landmarks stands below them."""
_UNLIKE = 0.25  # share by which a rate that is told and that of the times differ if they are of other frames
_SAID = ("handedness", "label", "side", "hand", "type")  # what a hand's side is called
_LISTS = ("frames", "results", "data", "detections")
_FRAME_KEYS = ("frame", "frame_id", "frame_number", "frame_idx", "frame_index", "index")
_NESTED = re.compile(rb"\[(?:(?:null|\[\]),)*\[{1,2}((?:\[[^\[\]{}]*\],?)+)\]")


def nested_landmarks(head: bytes) -> bool:
    """Whether JSON begins with lists of numbers of which a frame, or a person of it, has 33 or 21."""
    first = _NESTED.match(head.translate(None, b" \t\r\n"))
    return first is not None and first[1].count(b"[") in BODIES


def read_landmarks_json(path: Path, body: Skeleton | None = None) -> Landmarks:
    """Read a list of frames, an object that holds one, or a frame a line; as :func:`put_together`."""
    data = read_json(path, lines=True)
    out = Landmarks()
    if isinstance(data, dict):
        sizes = [data.get("image_size"), *([data.get(k + s) for s in ("width", "height")] for k in ("", "image_"))]
        out.size = next(filter(None, map(told_image_size, sizes)), None)
        out.fps = _positive(data, "fps")
    poses: dict[int, list[Sighting]] = {}
    hands: dict[int, list[Sighting]] = {}
    listed = list(_frames(data, path))
    for number, (_, frame, where) in zip(_numbers(listed, out), listed, strict=True):
        if number in poses:
            raise FormatError(f"{where}: expected every frame once, got frame {number} again")
        poses[number], hands[number] = _people(frame, where, out.seen)
    if any(isinstance(frame, dict) and any(map(frame.get, _FACE)) for _, frame, _ in listed):
        out.notes.append(FACE_LEFT_OUT)
    put_together(out, poses, hands, body)
    return out


def _numbers(listed: Sequence[tuple[int | None, Any, str]], out: Landmarks) -> list[int]:
    """The number of each frame: as it says, else by its time, else in their order; ``out`` gets times and rate."""
    frames = [frame if isinstance(frame, dict) else {} for _, frame, _ in listed]
    key = next((k for frame in frames for k in frame if time_unit(k) is not None), "")
    times = [_as_time(frame.get(key)) for frame in frames]
    numbers = [i if number is None else number for i, (number, _, _) in enumerate(listed)]
    by_time = len(set(times)) == len(times) > 1 and not any(map(math.isnan, times))
    if by_time and all(number is None for number, _, _ in listed):
        placed = frames_of_times(times, out.notes)
        numbers = [placed[time] for time in times]
    out.times = dict(zip(numbers, times, strict=True))
    if out.fps is None:
        out.fps = rate_of_times(out.times, time_unit(key) or "", out.notes)
    else:
        real = rate_of_times(out.times, time_unit(key) or "", [])
        if real is None or abs(real / out.fps - 1) > _UNLIKE:  # else it is the rate of the frames that are listed
            out.fps /= frame_numbers(sorted(numbers), [])[1]
    return numbers


def _as_time(value: Any) -> float:
    """A time, NaN where it is none."""
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not abs(value) < FARTHEST:
        return math.nan
    return float(value)


def _frames(data: Any, path: Path) -> Iterator[tuple[int | None, Any, str]]:
    """The number, content and place of each frame; None where nothing numbers it."""
    if isinstance(data, dict):
        key = next((k for k in _LISTS if isinstance(data.get(k), list)), None)
        if key is not None:
            yield from _frames(data[key], path)
        elif data and all(k.isdecimal() and len(k) < 16 for k in data):
            yield from ((int(k), frame, f"{path}: frame {int(k)}") for k, frame in data.items())
        else:
            yield None, data, str(path)
        return
    if not isinstance(data, list):
        raise FormatError(f"{path}: expected a list of frames with landmarks, got other JSON")
    if _is_person(data):
        yield None, data, str(path)
        return
    for i, frame in enumerate(data):
        key = next((k for k in _FRAME_KEYS if k in frame), None) if isinstance(frame, dict) else None
        number = None if key is None else as_frame_number(frame[key])
        if key is not None and number is None:
            raise FormatError(f"{path}: entry {i}: '{key}': expected a whole number, got {as_text(frame[key])}")
        yield number, frame, f"{path}: frame {i if number is None else number}"


def _people(frame: Any, where: str, seen: set[str]) -> tuple[list[Sighting], list[Sighting]]:
    """Poses and hands of a frame."""
    found: list[tuple[Any, Any]] = []  # landmarks and who it is
    if isinstance(frame, dict):
        sides = frame.get("handedness", frame.get("handednesses"))
        for keys in (_POSE, _HANDS):
            key = next((key for key in keys if _each_person(frame.get(key))), "")
            people = _each_person(frame.get(key))
            who = [_side(s) for s in sides] if isinstance(sides, list) and key not in _POSE[:3] else []
            found += zip(people, who if len(who) == len(people) else [None] * len(people), strict=True)
        found += [(p, side) for key, side in _ONE_HAND.items() for p in _each_person(frame.get(key))]
        listed = frame.get("hands")
        for hand in listed if isinstance(listed, list) else ():
            side = next((_side(hand[k]) for k in _SAID if hand.get(k)), None) if isinstance(hand, dict) else None
            found += [(p, side) for p in _each_person(hand)]
        if not found and not (KEYS | SHORT_KEYS | {*_POSE}) & set(frame):
            raise FormatError(f"{where}: expected 'pose_landmarks' or 'hand_landmarks', got {_keys(frame)}")
    elif isinstance(frame, list) or frame is None:
        found = [(p, None) for p in _each_person(frame)]
    else:
        raise FormatError(f"{where}: expected landmarks, got {as_text(frame)}")
    poses: list[Sighting] = []
    hands: list[Sighting] = []
    for landmarks, who in found:
        joints = _joints(landmarks, where, seen)
        if len(joints) not in BODIES:
            raise FormatError(f"{where}: expected 33 landmarks of a pose or 21 of a hand, got {len(joints)}")
        (poses if len(joints) == 33 else hands).append(Sighting(joints, who))
    return poses, hands


def _is_person(value: Any) -> bool:
    """Whether this is the list of one person's landmarks."""
    first = value[0] if isinstance(value, list) and value else None
    if isinstance(first, dict):
        return "x" in first and "y" in first
    return isinstance(first, list) and len(first) > 1 and all(isinstance(v, (int, float)) for v in first)


def _each_person(value: Any) -> list[Any]:
    """The landmarks of each person; nobody where there is nothing."""
    value = _inside(value)
    if not value:
        return []
    if not isinstance(value, list) or _is_person(value):
        return [value]
    return [inside for person in value if (inside := _inside(person))]


def _inside(value: Any) -> Any:
    """The landmarks in MediaPipe's messages, which hold them in an object."""
    if isinstance(value, dict):
        return next((value[k] for k in ("landmark", "landmarks") if k in value), value)
    return value


def _joints(landmarks: Any, where: str, seen: set[str]) -> NDArray[np.float64]:
    """x, y, confidence or visibility of each landmark; NaN where it is not given. ``seen`` gets what it is called."""
    if isinstance(landmarks, dict):  # by name
        by_name = {str(k).lower().replace(" ", "_"): v for k, v in landmarks.items()}
        body = next((b for b in map(SKELETONS.get, BODIES.values()) if b and set(by_name) & set(b.joints)), None)
        if body is None:
            raise FormatError(f"{where}: expected landmarks, got an object with {_keys(landmarks)}")
        landmarks = [by_name.get(j, {"x": None, "y": None}) for j in body.joints[: body.num_observed]]
    if not isinstance(landmarks, list) or not landmarks:
        raise FormatError(f"{where}: expected a list of landmarks, got {as_text(landmarks)}")
    if isinstance(landmarks[0], dict):
        rows = []
        for here, mark in entries(landmarks, where):
            if "x" not in mark or "y" not in mark:
                raise FormatError(f"{here}: expected a landmark with 'x' and 'y', got {_keys(mark)}")
            key = next((k for k in (*CONFIDENCES, *VISIBILITIES) if mark.get(k) is not None), "")
            seen |= {key} - {""}
            rows.append([mark["x"], mark["y"], mark.get(key)])
        return as_joints(rows, where)
    joints = as_joints(landmarks, where)
    width = len(landmarks[0]) if isinstance(landmarks[0], list) else 3
    seen.add("visibility")
    if width > 3:  # x, y, z, visibility
        joints[:, 2] = as_joints([row[2:4] for row in landmarks], where)[:, 1]
    elif width == 2:
        joints[:, 2] = math.nan
    return joints


def _side(value: Any) -> Any:
    """'left' or 'right' as MediaPipe's classifications say it, however deep they are."""
    for _ in range(4):
        if isinstance(value, list) and value:
            value = value[0]
        elif isinstance(value, dict):
            keys = ("category_name", "categoryName", "label", "display_name", "classification")
            value = next((value[k] for k in keys if value.get(k)), None)
    return value.lower() if isinstance(value, str) and value.lower() in ("left", "right") else None


def _positive(data: dict[str, Any], key: str) -> float | None:
    value = data.get(key)
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not 0 < value < FARTHEST:
        return None
    return float(value)


def _keys(value: dict[str, Any]) -> str:
    shown = ", ".join(as_text(k) for k in list(value)[:6])
    return f"the keys {shown}" if shown else "no keys"
