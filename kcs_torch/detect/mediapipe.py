"""MediaPipe's legacy solutions, which bring their models: nothing is downloaded."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from kcs_torch.detect.detector import MEDIAPIPE, Detector, Image, People, need_detector, nobody
from kcs_torch.errors import OptionError
from kcs_torch.io.contents.landmarks import VISIBLE, by_visibility

__all__ = ["open_detector"]


def open_detector(what: str, models: Sequence[str | Path]) -> Detector:
    """Open MediaPipe Pose (33 landmarks, one person) or Hands (21 landmarks, two hands).

    Only the image coordinates are used, not MediaPipe's own guess of depth.

    Raises:
        OptionError: it is not installed, has no legacy solutions, or models were given.
    """
    if models:
        raise OptionError("detector mediapipe: brings its own models: leave --model out, or use --detector rtmlib")
    package = need_detector("mediapipe", "mediapipe")
    solutions = getattr(package, "solutions", None)
    if solutions is None:
        raise OptionError(
            f"detector mediapipe: version {getattr(package, '__version__', 'unknown')} has no models: "
            f"pip install mediapipe=={MEDIAPIPE}"
        )
    if what == "pose":
        model = solutions.pose.Pose(static_image_mode=False, model_complexity=1)
        names = tuple(landmark.name.lower() for landmark in solutions.pose.PoseLandmark)
        note = "MediaPipe follows one person at a time; where it goes over to another, a new track begins"
        seen = f"{VISIBLE}, and outside the image as 0"
        find = lambda image: _poses(model, image, len(names))  # noqa: E731
        return Detector("MediaPipe Pose", "mediapipe33", names, find, model.close, (note, seen))
    model = solutions.hands.Hands(static_image_mode=False, max_num_hands=2)
    names = tuple(landmark.name.lower() for landmark in solutions.hands.HandLandmark)
    note = "MediaPipe tells no confidence of a hand's joints: all count alike"
    find = lambda image: _hands(model, image, len(names))  # noqa: E731
    return Detector("MediaPipe Hands", "hand21", names, find, model.close, (note,))


def _poses(model: Any, image: Image, count: int) -> People:
    """The one person that Pose follows."""
    found = model.process(_rgb(image)).pose_landmarks
    if found is None:
        return nobody(count)
    return _pixels([found.landmark], image, visible=True)


def _hands(model: Any, image: Image, count: int) -> People:
    found = model.process(_rgb(image)).multi_hand_landmarks
    return _pixels([hand.landmark for hand in found], image, visible=False) if found else nobody(count)


def _pixels(people: Sequence[Any], image: Image, *, visible: bool) -> People:
    """Landmarks in pixels, weighted by visibility; those outside the image, which the model only supposes, count 0."""
    height, width = image.shape[:2]
    out = np.array([[(p.x, p.y, p.visibility if visible else 1.0) for p in person] for person in people], np.float64)
    inside = ((out[..., :2] >= 0) & (out[..., :2] <= 1)).all(-1)
    out[..., 2] = np.where(inside, by_visibility(out[..., 2].clip(0, 1)), 0.0)
    out[..., :2] *= (width, height)
    return out


def _rgb(image: Image) -> Image:
    return np.ascontiguousarray(image[..., ::-1])
