"""A film of a motion: the tracks beside the 3D, which turns slowly to and fro."""

from __future__ import annotations

import itertools
import math
import shutil
import subprocess
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kcs_torch.errors import OutputError
from kcs_torch.types import Reconstruction
from kcs_torch.viewer.draw import any_letters
from kcs_torch.viewer.film import Film
from kcs_torch.viewer.names import as_people, clip_rate

__all__ = ["GIF", "MP4", "Pace", "animation", "pace", "save_gif", "save_mp4"]

TURN_SECONDS = 8.0
FPS = 25.0  # where the tracks' own rate is not known


@dataclass(frozen=True)
class Pace:
    """Which frames a film shows, and how fast.

    Attributes:
        most: frames at most; longer clips show every n-th.
        rate: frames a second at most.
        slowest: frames a second at least; where it takes more frames than ``most`` for that, the film runs faster.
    """

    most: int
    rate: float
    slowest: float


GIF = Pace(most=200, rate=20.0, slowest=8.0)
MP4 = Pace(most=900, rate=30.0, slowest=12.0)


def pace(frames: int, fps: float | None, limits: Pace) -> tuple[int, float, float]:
    """Choose the step between frames shown, the film's rate, and how many times faster than life it runs.

    >>> pace(300, 30.0, MP4), pace(300, 30.0, GIF), pace(10_000, 30.0, GIF)
    ((1, 30.0, 1.0), (2, 15.0, 1.0), (50, 8.0, 13.333333333333334))
    """
    own = fps or FPS
    step = max(math.ceil(own / limits.rate - 1e-9), math.ceil(frames / limits.most), 1)
    rate = min(max(own / step, limits.slowest), limits.rate)
    return step, rate, rate * step / own


def animation(
    results: Reconstruction | Sequence[Reconstruction], limits: Pace = MP4
) -> tuple[Iterator[NDArray[np.uint8]], int, float]:
    """Draw a motion frame by frame: tracks at the left, 3D at the right.

    The 3D view turns to and fro about the vertical by 25 degrees in 8 seconds, so that depth can be seen. Somebody who
    goes far stays in the middle.

    Args:
        results: one motion, or several of the same clip.
        limits: how many frames and how fast.

    Returns:
        The pictures, (H, W, 3) bytes, one after another; how many there are; and how many a second.

    Raises:
        OptionError: there is no result, or the frame rates differ.
        OutputError: no joint is at a finite place.
    """
    people = as_people(results, "animation")
    total = max(len(r.points) for r in people)
    step, rate, faster = pace(total, clip_rate(people, "animation"), limits)
    film = Film(people, faster)
    turns = (math.sin(2 * math.pi * k / rate / TURN_SECONDS) for k in itertools.count())
    frames = range(0, total, step)
    return (film.picture(frame, turn) for frame, turn in zip(frames, turns, strict=False)), len(frames), rate


@any_letters()
def save_gif(results: Reconstruction | Sequence[Reconstruction], path: Path) -> None:
    """Write a GIF of at most 200 frames and 20 frames a second.

    Raises:
        OutputError: nothing can be drawn.
    """
    from PIL import Image

    pictures, _, rate = animation(results, GIF)
    palette: Any = None
    frames = []
    for picture in pictures:
        image = Image.fromarray(picture)
        if palette is None:  # one palette for all: no flicker, and a smaller file
            palette = image.quantize(64, method=Image.Quantize.MAXCOVERAGE)
        frames.append(image.quantize(palette=palette, dither=Image.Dither.NONE))
    hold = max(round(100 / rate) * 10, 20)  # milliseconds, in the hundredths of a second that a GIF counts in
    frames[0].save(path, format="GIF", save_all=True, append_images=frames[1:], duration=hold, loop=0, optimize=False)


@any_letters()
def save_mp4(results: Reconstruction | Sequence[Reconstruction], path: Path) -> None:
    """Write an MP4 (H.264) of at most 900 frames and 30 frames a second.

    Raises:
        OutputError: there is no ffmpeg, it fails, or nothing can be drawn.
    """
    program = find_ffmpeg()
    pictures, _, rate = animation(results, MP4)
    first = next(pictures)
    height, width = first.shape[:2]
    command = [program, "-y", "-loglevel", "error", "-f", "rawvideo", "-pix_fmt", "rgb24", "-s", f"{width}x{height}"]
    command += ["-r", f"{rate:.6g}", "-i", "-", "-an", "-c:v", "libx264", "-pix_fmt", "yuv420p", "-crf", "20"]
    command += ["-movflags", "+faststart", "-f", "mp4", f"file:{path}"]
    with tempfile.TemporaryFile() as said:
        try:
            process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.DEVNULL, stderr=said)
        except OSError as error:
            raise OutputError(f"{program}: cannot be run: {error.strerror or error}") from None
        try:
            with process.stdin as pipe:  # type: ignore[union-attr]
                pipe.write(first.tobytes())
                for picture in pictures:
                    pipe.write(picture.tobytes())
        except BrokenPipeError:
            pass  # it ended early, and says why
        except BaseException:
            process.kill()
            process.wait()
            raise
        if process.wait():
            said.seek(0)
            words = said.read().decode("utf-8", "replace").strip().splitlines() or [f"exit code {process.returncode}"]
            raise OutputError(f"{path}: ffmpeg could not make an MP4: {words[-1]}")
    if not _is_whole(path):  # ffmpeg does not always say so
        raise OutputError(f"{path}: cannot be written: ffmpeg left half of an MP4 (is the disk full?)")


def _is_whole(path: Path) -> bool:
    """Whether the boxes of an MP4 fill it and its table of contents is among them."""
    left, kinds = path.stat().st_size, set()
    with path.open("rb") as file:
        while left >= 8:
            head = file.read(16)
            size, kind = int.from_bytes(head[:4], "big"), head[4:8]
            size = int.from_bytes(head[8:], "big") if size == 1 else size or left
            if size < 8:
                return False
            kinds.add(kind)
            left -= size
            file.seek(size - len(head), 1)
    return left == 0 and b"moov" in kinds


def find_ffmpeg() -> str:
    """The program that makes an MP4.

    Raises:
        OutputError: there is none.
    """
    try:
        from imageio_ffmpeg import get_ffmpeg_exe

        return str(get_ffmpeg_exe())
    except (ImportError, RuntimeError):  # RuntimeError: the package was built without the program
        found = shutil.which("ffmpeg")
    if found is None:
        raise OutputError(
            "an MP4 needs ffmpeg, which was not found: pip install imageio-ffmpeg, or install ffmpeg; "
            "a .gif needs neither"
        )
    return found
