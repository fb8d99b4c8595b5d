"""Pictures that show which joint is which: tracks on one frame, and a skeleton by itself."""

from __future__ import annotations

import textwrap
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray

from kcs_torch.errors import OptionError
from kcs_torch.skeleton import Skeleton, get_skeleton
from kcs_torch.types import Tracks
from kcs_torch.types.arrays import as_doubles
from kcs_torch.types.hints import is_a
from kcs_torch.types.people import files_named
from kcs_torch.viewer.colours import COLOURS, bone_keys, joint_keys
from kcs_torch.viewer.labels import write_labels
from kcs_torch.viewer.layout import flat_layout
from kcs_torch.viewer.names import printable

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["any_letters", "clearest_frame", "draw_skeleton", "draw_tracks", "fit", "frame_alone", "new_figure"]

LOOK = 100  # frames from the first in which anybody is seen, among which a clear one is looked for
CLEAR = 0.9  # share of the most joints seen in any of these frames, from which on a frame is clear
NAMED = 3  # people drawn by themselves, with names
SIDE = 8.0  # inches of a panel
MANY = 45  # joints from which on a panel is larger, one person has names, and crowded joints have their numbers alone
CROWDED = 24.0  # points to the nearest joint below which one is crowded
Array = NDArray[np.float64]


def draw_tracks(people: Tracks | Sequence[Tracks], *, frame: int | None = None) -> Figure:
    """Draw one frame of tracks with the joints' numbers and names, so that a wrong order of joints is seen at once.

    Of several people the first panel shows all, and one panel each the three of whom most is seen; where bodies have
    hands, too, one panel the first of these. Joints without room for a name have their number alone.

    Args:
        people: tracks of the people of one clip.
        frame: which; if None, see :func:`clearest_frame`.

    Returns:
        A matplotlib figure, of no window; ``figure.savefig(path)`` writes it.

    Raises:
        OptionError: there is nobody, somebody who is no tracks, or no such frame.
    """
    people = [people] if isinstance(people, Tracks) else list(people)
    if not people:
        raise OptionError("draw_tracks: expected tracks of at least one person, got none")
    if wrong := [one for one in people if not isinstance(one, Tracks)]:
        raise OptionError(f"draw_tracks: expected Tracks, got {type(wrong[0]).__name__}")
    frames = max(p.num_frames for p in people)
    chosen = clearest_frame(people) if frame is None else frame
    if not (is_a(chosen, int) and 0 <= chosen < frames):
        raise OptionError(f"draw_tracks: expected a frame from 0 to {frames - 1}, got {frame!r}")
    poses = [_pose(p, chosen) for p in people]
    counts = [int(np.isfinite(x[: p.skeleton.num_observed]).all(-1).sum()) for p, x in zip(people, poses, strict=True)]
    there = [k for k in range(len(people)) if counts[k]] or [0]
    most = max(p.num_joints for p in people)
    named = sorted(sorted(there, key=lambda k: -counts[k])[: 1 if most > MANY else NAMED])
    panels: list[list[int]] = ([there] if len(people) > 1 else []) + [[k] for k in named]
    figure, axes = _panels(len(panels), most)
    head = f"{files_named(people)}: frame {chosen} of {frames} (the first is 0)"
    which = ", the first that is clear" if frame is None and chosen else ""
    _title(figure, f"{head}{which} · skeleton {people[0].skeleton.name}")
    for axis, members in zip(axes, panels, strict=True):
        together = len(panels) > 1 and axis is axes[0]
        _fit_places(axis, np.concatenate([poses[k] for k in members]))
        for k in members:
            _body(axis, people[k].skeleton, poses[k], named=not together)
            if together:
                _tag(axis, poses[k], f"person {k}")
        if together:
            axis.set_title(f"{len(there)} of {len(people)} people are seen", fontsize=11)
        else:
            _say(axis, people[members[0]], poses[members[0]], f"person {members[0]}: " if len(people) > 1 else "")
    return figure


def draw_skeleton(skeleton: str | Path | Skeleton) -> Figure:
    """Draw a skeleton with the joints' numbers and names: mirror pairs in their colours, virtual joints hollow.

    It shows the template pose from where its joints are best told apart. Of a skeleton without one it shows which
    joints the bones join.

    Returns:
        A matplotlib figure, of no window; ``figure.savefig(path)`` writes it.

    Raises:
        SkeletonError: there is no skeleton of that name.
    """
    skeleton = get_skeleton(skeleton)
    figure, (axis,) = _panels(1, skeleton.num_joints)
    virtual = skeleton.num_joints - skeleton.num_observed
    facts = [f"{skeleton.num_observed} joints", *([f"{virtual} virtual (hollow)"] if virtual else [])]
    facts += [
        f"{skeleton.num_bones} bones",
        *([f"{len(skeleton.flexible)} flexible (dashed)"] * bool(skeleton.flexible)),
    ]
    facts += ["template pose" if skeleton.template is not None else "no template pose: only what joins what"]
    _title(figure, f"{skeleton.name}: {', '.join(facts)}")
    places = flat_layout(skeleton)
    _fit_places(axis, places)
    _body(axis, skeleton, places, named=True, whole=True)
    return figure


def clearest_frame(people: Sequence[Tracks]) -> int:
    """The first frame in which nine tenths of the joints are seen that are seen at once near the start of the clip."""
    total = np.zeros(max(p.num_frames for p in people), int)
    for person in people:
        total[: person.num_frames] += person.seen.sum(1).cpu().numpy()
    first = int(np.argmax(total > 0))
    near = total[first : first + LOOK]
    return first + int(np.argmax(near >= CLEAR * near.max()))


def new_figure(width: float, height: float, dpi: int, layout: Literal["constrained"] | None = None) -> Figure:
    """An empty figure of no window, in inches."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), dpi=dpi, layout=layout)
    FigureCanvasAgg(figure)
    return figure


@contextmanager
def any_letters() -> Iterator[None]:
    """Write whatever a file's or a joint's name holds, without a warning of letters that the font has not."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="Glyph")
        yield


def frame_alone(axis: Any) -> None:
    """Leave of a picture's axes a pale frame, without ticks."""
    axis.set_xticks([])
    axis.set_yticks([])
    for spine in axis.spines.values():
        spine.set_color("#dddddd")


def fit(axis: Any, middle: Array, half: Array, share: tuple[float, float]) -> None:
    """Limits so that what reaches ``half`` to either side of the middle fills a share of the width and of the height.

    Both axes have one scale, with y down; the larger of the two shares that come out is as asked.
    """
    box = axis.get_window_extent()
    room = np.array([box.width, box.height])
    half = room / (share * room / np.maximum(half, 1e-9)).min()
    axis.set_xlim(middle[0] - half[0], middle[0] + half[0])
    axis.set_ylim(middle[1] + half[1], middle[1] - half[1])


def _panels(count: int, joints: int) -> tuple[Figure, list[Any]]:
    side = SIDE * (1.6 if joints > MANY else 1.0)
    figure = new_figure(side * count, side + 0.7, 110)
    axes = figure.subplots(1, count, squeeze=False)[0]
    figure.subplots_adjust(left=0.01, right=0.99, bottom=0.45 / (side + 0.7), top=1 - 0.75 / (side + 0.7), wspace=0.02)
    for axis in axes:
        frame_alone(axis)
    return figure, list(axes)


def _title(figure: Figure, text: str) -> None:
    width = int(12 * figure.get_size_inches()[0])
    lines = textwrap.wrap(printable(text), width)
    figure.suptitle("\n".join(lines[:2]), fontsize=11, y=1 - 0.08 / figure.get_size_inches()[1], parse_math=False)


def _pose(tracks: Tracks, frame: int) -> Array:
    """(N, 2); NaN where unseen."""
    if frame >= tracks.num_frames:
        return np.full((tracks.num_joints, 2), np.nan)
    points = as_doubles(tracks.points[frame])
    return np.where(tracks.seen[frame].cpu().numpy()[:, None], points, np.nan)


def _fit_places(axis: Any, places: Array) -> None:
    """Fit a panel to the known places, with room for names."""
    known = places[np.isfinite(places).all(-1)]
    low, high = (known.min(0), known.max(0)) if len(known) else (np.zeros(2), np.ones(2))
    fit(axis, (low + high) / 2, (high - low) / 2, (0.68, 0.84))


def _body(axis: Any, skeleton: Skeleton, places: Array, *, named: bool, whole: bool = False) -> None:
    """Draw a body; if it is ``named`` with its joints' names, of many crowded ones only where all are (``whole``)."""
    from matplotlib.collections import LineCollection

    bones, ends = bone_keys(skeleton), joint_keys(skeleton)
    known = np.isfinite(places.sum(-1))
    drawn = [b for b, (p, c) in enumerate(skeleton.bones) if known[p] and known[c]]
    lines = np.array([places[list(skeleton.bones[b])] for b in drawn]).reshape(-1, 2, 2)
    styles = ["--" if b in set(skeleton.flexible) else "-" for b in drawn]
    colours = [COLOURS[bones[b]] for b in drawn]
    thin = skeleton.num_joints > MANY or not named
    axis.add_collection(
        LineCollection(list(lines), colors=colours, linewidths=1.3 if thin else 2.6, linestyles=styles, alpha=0.75)
    )
    hues = np.array([COLOURS[key] for key in ends])
    hollow = np.arange(len(places)) >= skeleton.num_observed
    faces = np.where(hollow, "#ffffff", hues)
    axis.scatter(
        *places[known].T, s=12 if thin else 42, c=faces[known], edgecolors=hues[known], linewidths=1.4, zorder=3
    )
    if named:
        names = [n if n == f"joint{j}" or hollow[j] else f"{j} {n}" for j, n in enumerate(skeleton.joints)]
        many = skeleton.num_joints > MANY
        if many and not whole:
            near = _crowded(axis, places)
            names = [str(j) if near[j] and not hollow[j] else n for j, n in enumerate(names)]
        write_labels(axis, places, names, list(hues), lines, size=7.0 if many and whole else 10.5)


def _crowded(axis: Any, places: Array) -> Array:
    """Which joints (N,) have no room for a name beside them."""
    spots = axis.transData.transform(places) * 72 / axis.figure.dpi
    gaps = np.linalg.norm(spots[:, None] - spots, axis=-1)
    np.fill_diagonal(gaps, np.inf)
    return np.asarray(np.nan_to_num(gaps, nan=np.inf).min(1) < CROWDED)


def _tag(axis: Any, places: Array, words: str) -> None:
    known = places[np.isfinite(places).all(-1)]
    if len(known):
        top = known[known[:, 1].argmin()]
        axis.annotate(words, top, (0, 8), textcoords="offset points", ha="center", fontsize=10, weight="bold")


def _say(axis: Any, tracks: Tracks, places: Array, start: str) -> None:
    """How many joints are seen above the panel, and which are not below it."""
    body = tracks.skeleton
    known = np.isfinite(places[: body.num_observed]).all(-1)
    axis.set_title(f"{start}{known.sum()} of {body.num_observed} joints seen", fontsize=11)
    unseen = [body.joints[j] for j in np.flatnonzero(~known)]
    if unseen:
        lines = textwrap.wrap(printable(f"unseen: {', '.join(unseen)}"), 110)
        axis.set_xlabel("\n".join([*lines[:2], *(["..."] if len(lines) > 2 else [])]), fontsize=8, parse_math=False)
