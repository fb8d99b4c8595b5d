"""RTMPose and RTMO models in the user's own ONNX files, run by rtmlib."""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from kcs_torch.detect.detector import Detector, Image, People, need_detector, nobody
from kcs_torch.errors import FormatError, OptionError
from kcs_torch.io.contents.layout import names_of

__all__ = ["open_detector"]

_SKELETONS = {17: "coco17", 21: "hand21", 26: "halpe26", 133: "wholebody63"}
"""By the number of joints that a model finds."""


@dataclass(frozen=True)
class _Model:
    """An ONNX file: its role ("people", "pose" or "both"), size of the pictures it takes, and joints it finds."""

    path: Path
    role: str
    size: tuple[int, int]  # width, height
    joints: int


def open_detector(what: str, models: Sequence[str | Path]) -> Detector:
    """Open the models of ONNX files: RTMPose after a person detector (YOLOX, RTMDet), RTMPose alone, or RTMO.

    Args:
        what: "pose" or "hands".
        models: one or two files; which is which is told by their outputs. Nothing is downloaded.

    Raises:
        OptionError: rtmlib is not installed, or the files are not of a kind that fits.
        FormatError: a file is no ONNX model.
    """
    if not 1 <= len(models) <= 2:
        raise OptionError(
            "detector rtmlib: expected one or two ONNX files: --model POSE.onnx (RTMPose or RTMO), and before RTMPose, "
            f"as it looks at one person at a time, --model PEOPLE.onnx (YOLOX or RTMDet); got {len(models)}"
        )
    package = need_detector("rtmlib", "rtmlib")
    runtime = need_detector("onnxruntime", "rtmlib")
    looked = [_look(runtime, Path(model)) for model in models]
    pose, people = _told_apart(looked, hands=what == "hands")
    with contextlib.redirect_stdout(sys.stderr):  # it prints what it loads
        find, note = _finder(package, pose, people)
    skeleton = _SKELETONS[pose.joints]
    return Detector(
        f"rtmlib ({', '.join(m.path.name for m in looked)})",
        skeleton,
        names_of(skeleton, pose.joints),
        lambda image: _joined(find(image), pose.joints),
        notes=(note,) if note else (),
    )


def _told_apart(looked: Sequence[_Model], hands: bool) -> tuple[_Model, _Model | None]:
    """The model of poses, of hands if so, and that of people before it if there is one."""
    pose = [m for m in looked if m.role != "people"]
    people = [m for m in looked if m.role == "people"]
    if len(pose) != 1 or (pose[0].role == "both" and people):
        roles = ", ".join(f"{m.path.name} ({_ROLES[m.role]})" for m in looked)
        raise OptionError(
            f"detector rtmlib: expected one model of poses, and at most one of people before RTMPose, got {roles}"
        )
    path, joints = pose[0].path, pose[0].joints
    if joints not in _SKELETONS:
        known = ", ".join(map(str, _SKELETONS))
        raise OptionError(f"detector rtmlib: {path}: expected a model of {known} joints, got {joints}")
    if hands != (_SKELETONS[joints] == "hand21"):
        raise OptionError(
            f"detector rtmlib: {path}: finds {joints} joints, those of "
            f"{'a body: leave out --what hands' if hands else 'a hand: add --what hands'}"
        )
    return pose[0], people[0] if people else None


def _finder(package: Any, pose: _Model, people: _Model | None) -> tuple[Callable[[Image], Any], str]:
    """What finds poses in a picture, and what a user should know of it, if anything."""
    if pose.role == "both":
        return _load(package.RTMO, pose), ""
    one = _load(package.RTMPose, pose)
    if people is None:  # the whole picture is the box
        return one, "no model of people was given: each picture is taken to show one person who fills it"
    kind = "RTMDet" if "rtmdet" in people.path.name.lower() else "YOLOX"
    boxes = _load(getattr(package, kind), people)
    note = f"people are looked for by {people.path.name}, taken for a {kind} model"
    return lambda image: _in_boxes(one, boxes(image), image), note


_ROLES = {"people": "finds people", "pose": "finds a pose", "both": "finds people and poses"}


def _look(runtime: Any, path: Path) -> _Model:
    """What an ONNX file is, by the names and shapes of what goes in and out."""
    if not path.is_file():
        raise FormatError(f"{path}: expected an ONNX model, got {'a folder' if path.is_dir() else 'no such file'}")
    try:
        session = runtime.InferenceSession(str(path), providers=["CPUExecutionProvider"])
    except Exception as error:  # of many classes, which the package does not export
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise FormatError(f"{path}: cannot be read as an ONNX model: {reason}") from None
    shape = list(session.get_inputs()[0].shape)
    outputs = {out.name: list(out.shape) for out in session.get_outputs()}
    if len(shape) != 4 or not all(isinstance(side, int) for side in shape[2:]):
        raise OptionError(f"detector rtmlib: {path}: expected pictures (1, 3, height, width) of one size, got {shape}")
    size = (shape[3], shape[2])
    if "simcc_x" in outputs:
        return _Model(path, "pose", size, _count(path, outputs["simcc_x"], 1))
    if "keypoints" in outputs:
        return _Model(path, "both", size, _count(path, outputs["keypoints"], 2))
    if "dets" in outputs or (len(outputs) == 1 and len(next(iter(outputs.values()))) == 3):
        return _Model(path, "people", size, 0)
    raise OptionError(
        f"detector rtmlib: {path}: expected outputs simcc_x and simcc_y (RTMPose), dets and keypoints (RTMO), or dets "
        f"(YOLOX, RTMDet), got {', '.join(outputs)}"
    )


def _count(path: Path, shape: list[Any], axis: int) -> int:
    if len(shape) <= axis or not isinstance(shape[axis], int):
        raise OptionError(f"detector rtmlib: {path}: expected an output with a fixed number of joints, got {shape}")
    return int(shape[axis])


def _load(kind: Any, model: _Model) -> Any:
    """An rtmlib model. Pose models take (width, height), the others are square or take (height, width)."""
    size = model.size if model.role == "pose" else model.size[::-1]
    return kind(str(model.path), model_input_size=size, backend="onnxruntime", device="cpu")


def _in_boxes(pose: Any, boxes: Any, image: Image) -> Any:
    """Poses in the boxes of people; without any rtmlib would take the whole picture for one."""
    return pose(image, bboxes=boxes) if len(boxes) else None


def _joined(found: Any, joints: int) -> People:
    """Key points (P, N, 2) and scores (P, N) as one array."""
    if found is None or len(found[0]) == 0:
        return nobody(joints)
    points, scores = (np.asarray(part, np.float64) for part in found)
    return np.concatenate([points, scores[..., None]], -1)
