"""The figure of a film: the tracks at the left, the 3D in its room at the right."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from kcs_torch.errors import OutputError
from kcs_torch.types import Reconstruction
from kcs_torch.types.arrays import as_doubles
from kcs_torch.types.people import files_named
from kcs_torch.viewer.colours import COLOURS, bone_keys, joint_keys
from kcs_torch.viewer.draw import fit, frame_alone, new_figure
from kcs_torch.viewer.layout import turned
from kcs_torch.viewer.names import person_names, printable
from kcs_torch.viewer.together import points_together

__all__ = ["Film"]

SIZE, DPI = (8.8, 4.4), 100  # inches
YAW, SWING, PITCH = -35.0, 25.0, 12.0  # degrees: the middle of the 3D view, how far it turns to either side, its height
LOST = 0.002  # share of points left out at either end of an axis
FILLED = (0.9, 0.9)  # share of a picture's width and height
FAR = 2.5  # a body that goes farther than so many of its sizes stays in the middle of the picture
Array = NDArray[np.float64]


class Film:
    """The figure, and what changes in it from frame to frame."""

    def __init__(self, people: list[Reconstruction], faster: float) -> None:
        total = max(len(r.points) for r in people)
        self.fps = next((r.fps for r in people if r.fps), None)
        self.total, self.faster = total, faster
        self.points = points_together(people)
        seen = [r.tracks.seen.cpu().numpy() for r in people]
        tracks = [as_doubles(r.tracks.points) for r in people]
        self.tracks = [np.where(s[..., None], x, np.nan) for x, s in zip(tracks, seen, strict=True)]
        # Among several people one is shown from the first frame in which anything is seen of them to the last.
        there = [np.flatnonzero(s.any(1)) for s in seen]
        self.spans = [(int(f[0]), int(f[-1])) if len(people) > 1 and len(f) else (0, total) for f in there]
        self.bones = [r.skeleton.bone_index().numpy() for r in people]
        if len(people) == 1 and _goes_far(self.points[0]):
            self.points = [self.points[0] - _path(self.points[0], self.fps)]
            self.tracks = [self.tracks[0] - _path(self.tracks[0], self.fps)]
        self.space = Room(self.points)
        self.figure = new_figure(*SIZE, DPI)
        axes = self.figure.subplots(1, 2, gridspec_kw={"width_ratios": (1, 1.2)})
        self.figure.subplots_adjust(left=0.01, right=0.99, bottom=0.02, top=0.86, wspace=0.03)
        flat = np.concatenate([x[np.isfinite(x).all(-1)] for x in self.tracks])
        flat = flat if len(flat) else np.zeros((1, 2))
        low, high = np.quantile(flat, [LOST, 1 - LOST], axis=0)
        fit(axes[0], (low + high) / 2, (high - low) / 2, FILLED)
        fit(axes[1], self.space.middle, self.space.half, FILLED)
        for axis, title in zip(axes, ("tracks", "3D"), strict=True):
            frame_alone(axis)
            axis.set_title(title, fontsize=9, pad=3)
        title = f"{', '.join(dict.fromkeys(r.method for r in people))}: {files_named(r.tracks for r in people)}"
        self.title = printable(title)[:90]
        doubts = dict.fromkeys(r.diagnostics.brief_doubt for r in people if r.diagnostics.doubt)
        self.doubt = "".join(f" · {doubt}" for doubt in doubts)
        self.head = self.figure.suptitle("", fontsize=10, y=0.985, parse_math=False)
        self._draw(people, axes)

    def _draw(self, people: list[Reconstruction], axes: Any) -> None:
        """Make what moves from frame to frame: names, floor, shadows, bones and joints."""
        from matplotlib.collections import LineCollection

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

    def picture(self, frame: int, turn: float) -> NDArray[np.uint8]:
        """A frame as (H, W, 3) bytes, the 3D view turned by -1 to 1 of its swing."""
        self._move(frame, YAW + SWING * turn)
        canvas: Any = self.figure.canvas
        canvas.draw()
        picture = np.asarray(canvas.buffer_rgba())[..., :3]
        height, width = picture.shape[:2]
        return np.ascontiguousarray(picture[: height // 2 * 2, : width // 2 * 2])  # H.264 wants even sizes

    def _move(self, frame: int, yaw: float) -> None:
        """Put everything where it is in a frame."""
        pace = f" · {self.faster:.3g} times faster" if self.faster > 1.01 else ""
        when = f" · {frame / self.fps:.2f} s" if self.fps else ""
        self.head.set_text(f"{self.title}\nframe {frame} of {self.total}{when}{pace}{self.doubt}")
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


def _goes_far(points: Array) -> bool:
    """Whether a body's path is so long that the body would be small beside it."""
    known = points[np.isfinite(points).all(-1)]
    if not len(known):
        return False
    low, high = np.quantile(known, [LOST, 1 - LOST], axis=0)
    sizes = [np.ptp(x[k], axis=0).max() for x in points if (k := np.isfinite(x).all(-1)).any()]
    return bool((high - low).max() > FAR * np.median(sizes))


def _path(points: Array, fps: float | None) -> Array:
    """(T, 1, D): the middle of the known joints, smoothed over a second, steady where nothing is known."""
    known = np.isfinite(points).all(-1, keepdims=True)
    number = known.sum(1)
    middle = np.where(known, points, 0).sum(1) / np.maximum(number, 1)
    there, every = np.flatnonzero(number[:, 0]), np.arange(len(points))
    if not len(there):
        return np.zeros((len(points), 1, points.shape[-1]))
    middle = np.stack([np.interp(every, there, column[there]) for column in middle.T], 1)
    half = min(round((fps or 25.0) / 2), len(points) - 1)
    if not half:
        return middle[:, None]
    # Beyond its ends the path goes on as it came: a steady one stays as it is.
    total = np.cumsum(np.pad(middle, ((half, half), (0, 0)), mode="reflect", reflect_type="odd"), axis=0)
    total = np.pad(total, ((1, 0), (0, 0)))
    return ((total[2 * half + 1 :] - total[: -2 * half - 1]) / (2 * half + 1))[:, None]


class Room:
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
        return turned(points - self.centre, yaw, PITCH)

    def fallen(self, points: Array, yaw: float) -> Array:
        """Points let down on the floor, on the picture."""
        return self.seen(np.where([False, True, False], self.ground, points), yaw)[..., :2]

    def floor(self, yaw: float) -> Array:
        """Lines of the floor on the picture, (L, 2, 2)."""
        lines = np.array([ends for c in np.linspace(-1, 1, 9) for ends in (((c, -1), (c, 1)), ((-1, c), (1, c)))])
        x, z = np.moveaxis(lines * self.reach + self.centre[[0, 2]], -1, 0)
        return self.seen(np.stack([x, np.full(x.shape, self.ground), z], -1), yaw)[..., :2]
