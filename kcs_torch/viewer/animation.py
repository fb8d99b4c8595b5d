"""A film of a motion: the tracks beside the 3D, which turns slowly to and fro."""

from __future__ import annotations

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

from kcs_torch.errors import OptionError, OutputError
from kcs_torch.types import Reconstruction
from kcs_torch.viewer.colours import COLOURS, bone_keys, joint_keys
from kcs_torch.viewer.draw import new_figure
from kcs_torch.viewer.names import person_names, printable

__all__ = ["GIF", "MP4", "Pace", "animation", "pace", "save_gif", "save_mp4"]

SIZE, DPI = (8.8, 4.4), 100  # inches
YAW, SWING, PITCH = -35.0, 25.0, 12.0  # degrees: the middle of the 3D view, how far it turns to either side, its height
TURN_SECONDS = 8.0
FPS = 25.0  # where the tracks' own rate is not known
LOST = 0.002  # share of points left out at either end of an axis
Array = NDArray[np.float64]


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

    The 3D view turns to and fro about the vertical by 25 degrees in 8 seconds, so that depth can be seen.

    Args:
        results: one motion, or several of the same clip.
        limits: how many frames and how fast.

    Returns:
        The pictures, (H, W, 3) bytes, one after another; how many there are; and how many a second.

    Raises:
        OptionError: there is no result.
        OutputError: matplotlib is not installed, or no joint is at a finite place.
    """
    people = [results] if isinstance(results, Reconstruction) else list(results)
    if not people:
        raise OptionError("animation: expected at least one result, got none")
    film = _Film(people, limits)
    return film.pictures(), len(film.frames), film.rate


def save_gif(results: Reconstruction | Sequence[Reconstruction], path: Path) -> None:
    """Write a GIF of at most 200 frames and 20 frames a second.

    Raises:
        OutputError: pillow, which comes with matplotlib, is not installed; or nothing can be drawn.
    """
    try:
        from PIL import Image
    except ImportError as error:
        raise OutputError(f"a GIF needs the package pillow ({error}): pip install pillow") from None
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


def save_mp4(results: Reconstruction | Sequence[Reconstruction], path: Path) -> None:
    """Write an MP4 (H.264) of at most 900 frames and 30 frames a second.

    Raises:
        OutputError: there is no ffmpeg, it fails, or nothing can be drawn.
    """
    program = _ffmpeg()
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
            raise OutputError(f"ffmpeg could not make an MP4: {words[-1]}")


def _ffmpeg() -> str:
    try:
        from imageio_ffmpeg import get_ffmpeg_exe

        return str(get_ffmpeg_exe())
    except (ImportError, RuntimeError):  # RuntimeError: the package was built without the program
        found = shutil.which("ffmpeg")
    if found is None:
        raise OutputError(
            "an MP4 needs ffmpeg, which was not found: pip install 'kcs-torch[video]', or install ffmpeg; "
            "a .gif needs neither"
        )
    return found


class _Film:
    """The figure, and what changes in it from frame to frame."""

    def __init__(self, people: list[Reconstruction], limits: Pace) -> None:
        from matplotlib.collections import LineCollection

        total = max(len(r.points) for r in people)
        self.fps = next((r.fps for r in people if r.fps), None)
        step, self.rate, self.faster = pace(total, self.fps, limits)
        self.frames = range(0, total, step)
        self.total = total
        self.points = [r.points.detach().cpu().double().numpy() for r in people]
        seen = [r.tracks.seen.cpu().numpy() for r in people]
        tracks = [r.tracks.points.detach().cpu().double().numpy() for r in people]
        self.tracks = [np.where(s[..., None], x, np.nan) for x, s in zip(tracks, seen, strict=True)]
        # Among several people one is shown from the first frame in which anything is seen of them to the last.
        there = [np.flatnonzero(s.any(1)) for s in seen]
        self.spans = [(int(f[0]), int(f[-1])) if len(people) > 1 and len(f) else (0, total) for f in there]
        self.bones = [r.skeleton.bone_index().numpy() for r in people]
        self.space = _Space(self.points)
        self.figure = new_figure(*SIZE, DPI)
        axes = self.figure.subplots(1, 2, gridspec_kw={"width_ratios": (1, 1.2)})
        self.figure.subplots_adjust(left=0.01, right=0.99, bottom=0.02, top=0.86, wspace=0.03)
        flat = np.concatenate([x[np.isfinite(x).all(-1)] for x in self.tracks])
        flat = flat if len(flat) else np.zeros((1, 2))
        low, high = np.quantile(flat, [LOST, 1 - LOST], axis=0)
        _limits(axes[0], (low + high) / 2, (high - low) / 2)
        _limits(axes[1], self.space.middle, self.space.half)
        for axis, title in zip(axes, ("tracks", "3D"), strict=True):
            axis.set_title(title, fontsize=9, pad=3)
        names = ", ".join(dict.fromkeys(Path(r.tracks.source).name for r in people))
        title = f"{', '.join(dict.fromkeys(r.method for r in people))}: {names}"
        self.title = printable(title)[:90]
        self.head = self.figure.suptitle("", fontsize=10, y=0.985, parse_math=False)
        self.artists: list[tuple[Any, Any, list[str]]] = []  # bones, joints, the bones' colours
        self.tags = [
            axes[1].text(0, 0, n if len(people) > 1 else "", ha="center", fontsize=8) for n in person_names(people)
        ]
        for tag in self.tags:
            tag.set_parse_math(False)
        self.floor = LineCollection([], colors="#e4e4e0", linewidths=0.8, zorder=0)
        axes[1].add_collection(self.floor)
        self.shadows = [LineCollection([], colors="#d9d9d6", linewidths=2.4, zorder=1) for _ in people]
        for shadow in self.shadows:
            axes[1].add_collection(shadow)
        for axis, wide in ((axes[0], 2.0), (axes[1], 3.2)):
            for result in people:
                colours = [COLOURS[key] for key in bone_keys(result.skeleton)]
                lines = LineCollection([], colors=colours, linewidths=wide, capstyle="round", zorder=2)
                axis.add_collection(lines)
                hues = [COLOURS[key] for key in joint_keys(result.skeleton)]
                dots = axis.scatter(
                    np.zeros(len(hues)), np.zeros(len(hues)), s=3.5 * wide, c=hues, zorder=3, linewidths=0
                )
                self.artists.append((lines, dots, colours))

    def pictures(self) -> Iterator[NDArray[np.uint8]]:
        canvas: Any = self.figure.canvas
        for k, frame in enumerate(self.frames):
            self.draw(frame, YAW + SWING * math.sin(2 * math.pi * k / self.rate / TURN_SECONDS))
            canvas.draw()
            picture = np.asarray(canvas.buffer_rgba())[..., :3]
            height, width = picture.shape[:2]
            yield np.ascontiguousarray(picture[: height // 2 * 2, : width // 2 * 2])  # H.264 wants even sizes

    def draw(self, frame: int, yaw: float) -> None:
        """Move everything to where it is in a frame."""
        pace = f" · {self.faster:.3g} times faster" if self.faster > 1.01 else ""
        when = f" · {frame / self.fps:.2f} s" if self.fps else ""
        self.head.set_text(f"{self.title}\nframe {frame} of {self.total}{when}{pace}")
        self.floor.set_segments(list(self.space.floor(yaw)))
        count = len(self.points)
        for k in range(count):
            there = frame < len(self.points[k]) and self.spans[k][0] <= frame <= self.spans[k][1]
            for artist in (*self.artists[k][:2], *self.artists[count + k][:2], self.tags[k], self.shadows[k]):
                artist.set_visible(there)
            if not there:
                continue
            flat = self.space.seen(self.points[k][frame], yaw)
            far_first = np.argsort(-np.nan_to_num(flat[self.bones[k], 2].mean(-1)), kind="stable")
            for (lines, dots, hues), places in (
                (self.artists[k], self.tracks[k][frame]),
                (self.artists[count + k], flat[:, :2]),
            ):
                lines.set_segments(list(places[self.bones[k][far_first]]))
                lines.set_color([hues[b] for b in far_first])
                dots.set_offsets(places)
            self.shadows[k].set_segments(list(self.space.fallen(self.points[k][frame], yaw)[self.bones[k]]))
            known = flat[np.isfinite(flat).all(-1)]
            if len(known):
                top = known[known[:, 1].argmin()]
                self.tags[k].set_position((top[0], top[1] - 0.05 * self.space.size))


class _Space:
    """The room that a motion takes, looked at along parallel rays from a height."""

    def __init__(self, people: list[Array]) -> None:
        every = np.concatenate([x[np.isfinite(x).all(-1)] for x in people])
        if not len(every):
            raise OutputError("a film needs at least one joint at a finite place")
        every = every[:: max(1, len(every) // 50_000)]
        low, high = np.quantile(every, [LOST, 1 - LOST], axis=0)
        self.centre = (low + high) / 2
        self.size = max(float((high - low).max()), 1e-9)
        self.ground = float(high[1])
        self.reach = np.maximum((high - low)[[0, 2]] / 2, 0.25 * self.size) + 0.05 * self.size
        views = []
        for yaw in (YAW - SWING, YAW, YAW + SWING):
            views += [self.seen(every, yaw)[:, :2], self.floor(yaw).reshape(-1, 2)]
        ends = np.array([np.quantile(v, [LOST, 1 - LOST], axis=0) for v in views])
        low, high = ends[:, 0].min(0), ends[:, 1].max(0)
        low[1] -= 0.06 * (high[1] - low[1])  # for people's names
        self.middle, self.half = (low + high) / 2, (high - low) / 2

    def seen(self, points: Array, yaw: float) -> Array:
        """(..., 3) to the right, down and away on the picture; the angle is in degrees, negative from the left."""
        a, b = np.radians([yaw, PITCH])
        x, y, z = np.moveaxis(points - self.centre, -1, 0)
        right, away = x * np.cos(a) + z * np.sin(a), z * np.cos(a) - x * np.sin(a)
        return np.stack([right, y * np.cos(b) - away * np.sin(b), away * np.cos(b) + y * np.sin(b)], -1)

    def fallen(self, points: Array, yaw: float) -> Array:
        """Points let down on the floor, on the picture."""
        return self.seen(np.where([False, True, False], self.ground, points), yaw)[..., :2]

    def floor(self, yaw: float) -> Array:
        """Lines of the floor on the picture, (L, 2, 2)."""
        lines = np.array([ends for c in np.linspace(-1, 1, 9) for ends in (((c, -1), (c, 1)), ((-1, c), (1, c)))])
        x, z = np.moveaxis(lines * self.reach + self.centre[[0, 2]], -1, 0)
        return self.seen(np.stack([x, np.full(x.shape, self.ground), z], -1), yaw)[..., :2]


def _limits(axis: Any, middle: Array, half: Array) -> None:
    """Both axes in one scale, y down, with a margin; without ticks."""
    box = axis.get_window_extent()
    half = np.maximum(half, 1e-9 + 1e-3 * half.max())
    scale = 0.9 * min(box.width / half[0], box.height / half[1])
    half = np.array([box.width, box.height]) / scale
    axis.set_xlim(middle[0] - half[0], middle[0] + half[0])
    axis.set_ylim(middle[1] + half[1], middle[1] - half[1])
    axis.set_xticks([])
    axis.set_yticks([])
    for spine in axis.spines.values():
        spine.set_color("#dddddd")
