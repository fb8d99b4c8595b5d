"""What a detector is, and how one that is not installed is told."""

from __future__ import annotations

import importlib
from collections.abc import Callable
from dataclasses import dataclass
from types import ModuleType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kcs_torch.errors import OptionError

__all__ = ["EXTRAS", "MEDIAPIPE", "Detector", "Image", "People", "need_detector", "nobody"]

Image = NDArray[np.uint8]
"""(H, W, 3): blue, green, red."""

People = NDArray[np.float64]
"""(P, N, 3): x, y in pixels and confidence of each joint of each person of a frame."""

MEDIAPIPE = "0.10.21"
"""The last version that ships its models."""

EXTRAS = {"mediapipe": "detect", "rtmlib": "onnx"}
"""The extra of this package that installs a detector."""


@dataclass(frozen=True)
class Detector:
    """An opened detector.

    Attributes:
        words: what it is, for notes.
        skeleton: a built-in name.
        joints: names of the joints that it finds, of which the skeleton may take only some.
        find: finds the people of a frame.
        close: gives back what it holds.
        notes: what to know of it.
    """

    words: str
    skeleton: str
    joints: tuple[str, ...]
    find: Callable[[Image], People]
    close: Callable[[], None] = lambda: None
    notes: tuple[str, ...] = ()


def nobody(joints: int) -> People:
    """What a frame without people gives."""
    return np.zeros((0, joints, 3))


def need_detector(package: str, name: str) -> ModuleType:
    """Import what a detector needs.

    Raises:
        OptionError: it is not installed, or does not load; the message has the commands that install it.
    """
    try:
        return importlib.import_module(package)
    except Exception as reason:  # a package built for another numpy raises whatever it likes
        raise OptionError(_advice(package, name, reason)) from None


def _advice(package: str, name: str, reason: Any) -> str:
    words = f"detector {name}: needs the package {package}, which does not load ({reason})"
    if name == "mediapipe":
        return (
            f"{words}: pip install mediapipe=={MEDIAPIPE} (the extra '{EXTRAS[name]}'), on Python 3.11 or 3.12, best "
            "in an environment of its own, as it needs numpy below 2; the tracks that `kcs-torch detect VIDEO -o "
            "tracks.npz` writes there are read by kcs-torch anywhere"
        )
    return f"{words}: pip install rtmlib onnxruntime (the extra '{EXTRAS[name]}')"
