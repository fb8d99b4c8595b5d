"""A video's frames, by OpenCV."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from kcs_torch.detect.detector import Image, need_detector
from kcs_torch.errors import FormatError
from kcs_torch.io.video import is_video

__all__ = ["Video", "open_video"]

_FASTEST = 1000.0  # frames a second that a file may claim; some claim their clock's rate


@dataclass(frozen=True)
class Video:
    """An opened video.

    Attributes:
        width: of the frames, in pixels, as they are shown: turned as the file says.
        height: of the frames, in pixels.
        fps: frames a second, or None where the file does not say.
        num_frames: as the file claims, 0 where it does not say.
    """

    width: int
    height: int
    fps: float | None
    num_frames: int
    _source: Any

    def frames(self, start: int = 0, stop: int | None = None) -> Iterator[Image]:
        """Frames from ``start`` to ``stop`` (not included), once."""
        number = 0
        while stop is None or number < stop:
            if not self._source.grab():
                return
            if number >= start:
                good, image = self._source.retrieve()
                if not good:
                    return
                yield image
            number += 1


@contextmanager
def open_video(path: str | Path, detector: str) -> Iterator[Video]:
    """Open a video file for a detector, whose extra brings OpenCV.

    Raises:
        FormatError: there is no such file, or it is no video that can be decoded.
        OptionError: OpenCV is not installed.
    """
    path = Path(path)
    try:
        there = path.is_file()
    except (OSError, ValueError):
        there = False
    if not there:
        wrong = "expected a video file, got a folder" if path.is_dir() else "there is no such file"
        raise FormatError(f"{path}: {wrong}")
    if not is_video(path):
        raise FormatError(f"{path}: expected a video (such as .mp4, .mov, .avi, .mkv or .webm), got something else")
    cv2 = need_detector("cv2", detector)
    source = cv2.VideoCapture(str(path.resolve()))
    try:
        width, height = (int(source.get(key)) for key in (cv2.CAP_PROP_FRAME_WIDTH, cv2.CAP_PROP_FRAME_HEIGHT))
        if not source.isOpened() or min(width, height) < 1:
            raise FormatError(f"{path}: cannot be decoded as a video: damaged, or of a kind that OpenCV cannot decode")
        fps = float(source.get(cv2.CAP_PROP_FPS))
        count = source.get(cv2.CAP_PROP_FRAME_COUNT)
        rate = fps if math.isfinite(fps) and 0 < fps < _FASTEST else None
        yield Video(width, height, rate, max(0, int(count)) if math.isfinite(count) else 0, source)
    finally:
        source.release()
