"""From the people that a detector lists frame by frame to one :class:`Tracks` each."""

from __future__ import annotations

import itertools
from bisect import bisect
from collections import Counter
from collections.abc import Hashable, Iterable, Sequence
from functools import partial
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from kcs_torch.errors import FormatError
from kcs_torch.io.contents.build_tracks import OVERSHOOT, build_tracks, nothing_seen
from kcs_torch.io.contents.layout import choose_layout
from kcs_torch.io.contents.link import follow_people, longest_gap
from kcs_torch.io.contents.shares import ASK, are_shares
from kcs_torch.io.registry import Options, brief
from kcs_torch.skeleton import Skeleton
from kcs_torch.types import Tracks
from kcs_torch.types.intake import at_the_corner

__all__ = ["Sighting", "people_tracks"]

_WELL_SEEN = 0.95  # quantile of the confidences that counts as certain where they are on another scale
_ODD = 0.01  # share of the confidences that may be slips where all others end at 1
_TELLING = 10  # others that tell
_PER_CENT = (50.0, 100.0)  # between these the largest confidence is per cent
_MOST_IN_FRAME = 100  # people of one frame
_MOST_NUMBERS = 5e7  # of all tracks together: each person has a place in every frame

_Seen = list[tuple[int, int]]
"""A person: frames, and the index among those seen there."""


class Sighting(NamedTuple):
    """One person in one frame.

    Attributes:
        joints: (N, 3) x, y, confidence; NaN or confidence 0 where unseen.
        track: who it is, where the file says so.
    """

    joints: NDArray[np.float64]
    track: Hashable = None


def people_tracks(
    frames: Sequence[Sequence[Sighting]],
    options: Options,
    *,
    source: str,
    names: Sequence[str] | None = None,
    edges: Any = None,
    skeleton: str | Skeleton | None = None,
    fps: float | None = None,
    units: str = "px",
    notes: Sequence[str] = (),
    measured: bool = False,
    size: Any = None,
) -> list[Tracks]:
    """Follow the people of T frames and wrap each as :class:`Tracks`.

    By the file's track ids where every person has one and no frame has one twice; by their places otherwise. Who
    appears within a second where somebody else disappeared has got a new id, as trackers lose people. Where ids differ,
    a note says which one each person has. Joints are recognised by their number where neither names nor a
    skeleton are given. Joints whose x or y is exactly 0, or both -1, are unseen.

    Args:
        frames: the people of each frame.
        options: of the caller.
        source: the path.
        names: the file's joint names.
        edges: the file's (B, 2) bones.
        skeleton: the file's own skeleton.
        fps: the file's frames per second.
        units: the file's units.
        notes: sentences for the user.
        measured: no detector made them: only joints at (0, 0) or (-1, -1) with all others beyond are unseen.
        size: width and height of the image, as the file tells them.

    Raises:
        FormatError: nobody is in any frame, or people have different numbers of joints.
        OptionError: the caller says the size of an image that people, by their units, are not in.
        ShapeError: no joint reaches the threshold.
        SkeletonError: the joints do not fit the skeleton.
    """
    remarks = list(notes)
    listed = any(frames)
    frames = _without_zeros(_checked(frames, source, measured, remarks), measured, remarks)
    if not measured:
        frames = _in_pixels(frames, options.size_of(size), remarks)
    everybody = [s.joints for frame in frames for s in frame]
    if not everybody:
        why = " with a joint that is seen: every confidence is 0, or every place missing" if listed else ""
        raise FormatError(f"{source}: expected people in at least one of {len(frames)} frames, got none{why}")
    if names is None and skeleton is None:
        skeleton, names = choose_layout(everybody, options, source, remarks)
    people, gap = _by_ids(frames, remarks), longest_gap(options.fps or fps)
    if people is None:
        people = _by_places(frames, gap)
    elif len(people) > 1:
        remarks.append("people are followed by the file's own track ids")
        people = _without_breaks(people, frames, gap, remarks)
    several = len({s.track for frame in frames for s in frame} - {None}) > 1
    wrap = partial(
        build_tracks, source=source, names=names, edges=edges, skeleton=skeleton, fps=fps, units=units, size=size
    )
    out = []
    for seen in _shown(people, frames, options.least, source, remarks):
        track = np.zeros((len(frames), *everybody[0].shape))
        for t, i in seen:
            track[t] = frames[t][i].joints
        points = np.where(track[..., 2:] > 0, track[..., :2], np.nan)
        told = [*_called(frames, seen), *remarks] if several else remarks
        out.append(wrap(points, track[..., 2], options, notes=told))
    return out


def _shown(
    people: list[_Seen],
    frames: Sequence[Sequence[Sighting]],
    least: float,
    source: str,
    remarks: list[str],
) -> list[_Seen]:
    """The people who reach the threshold ``least``, no more than memory holds; remarks say who is left out."""
    joints = [s.joints for frame in frames for s in frame]
    lowest = max(least, 1e-12)
    visible = [seen for seen in people if any((frames[t][i].joints[:, 2] >= lowest).any() for t, i in seen)]
    if not visible:
        raise nothing_seen(source, least, max(float(one[:, 2].max()) for one in joints))
    if len(visible) < len(people):
        remarks.append(f"{len(people) - len(visible)} people never reach the confidence threshold: left out")
    most = max(int(_MOST_NUMBERS / (len(frames) * joints[0].size)), 1)
    if len(visible) > most:
        remarks.append(f"{len(visible) - most} people who are seen least are left out: {most} tracks fill the memory")
    return visible[:most]


def _called(frames: Sequence[Sequence[Sighting]], seen: Sequence[tuple[int, int]]) -> list[str]:
    """What the file's track ids say of who this is, most of the time; nothing where there are none."""
    ids = Counter(frames[t][i].track for t, i in seen if frames[t][i].track is not None)
    if not ids:
        return []
    (name, count), *_ = ids.most_common(1)
    often = "" if count == len(seen) else f" in {count} of {len(seen)} frames"
    return [f"the file calls this one '{brief(name)}'{often}"]


def _without_zeros(frames: Sequence[Sequence[Sighting]], measured: bool, notes: list[str]) -> list[list[Sighting]]:
    """Without joints at 0, 0, which stand for none; nor is one 0 a detector's: in real files joints jump to x = 0."""
    everybody = [s.joints for frame in frames for s in frame]
    if not everybody:
        return [list(frame) for frame in frames]
    joints = np.stack(everybody)
    seen = joints[..., 2] > 0
    if measured:
        zero = at_the_corner(torch.from_numpy(joints[..., :2]), torch.from_numpy(seen), notes).numpy() | ~seen
    else:
        zero, minus = (joints[..., :2] == 0).any(-1), (joints[..., :2] == -1).all(-1)
        for gone, how in ((zero, "whose x or y is exactly 0"), (minus, "whose x and y are both -1")):
            if count := int((gone & seen).sum()):
                are = f"joint {how} is" if count == 1 else f"joints {how} are"
                notes.append(f"{count} {are} taken as unseen")
        zero |= minus
    kept = iter(np.where(zero[..., None], 0.0, joints))
    return [[s._replace(joints=next(kept)) for s in frame] for frame in frames]


def _in_pixels(
    frames: Sequence[Sequence[Sighting]], size: tuple[int, int] | None, notes: list[str]
) -> Sequence[Sequence[Sighting]]:
    """With shares of an image of this size as pixels: some detectors write shares if they are told to."""
    seen = [s.joints[s.joints[:, 2] > 0, :2] for frame in frames for s in frame]
    if not seen or not are_shares(np.concatenate(seen)):
        return frames
    if size is None:
        notes.append(ASK)
        return frames
    return [[s._replace(joints=s.joints * [*size, 1]) for s in frame] for frame in frames]


def _checked(
    frames: Sequence[Sequence[Sighting]], source: str, measured: bool, notes: list[str]
) -> list[list[Sighting]]:
    """The same people with confidences within 0..1, 0 where unseen; those without any joint are left out."""
    counts = Counter(len(s.joints) for frame in frames for s in frame)
    if len(counts) > 1:
        (usual, _), (other, _) = counts.most_common(2)
        odd = next(t for t, found in enumerate(frames) if any(len(s.joints) == other for s in found))
        raise FormatError(f"{source}: expected {usual} joints of every person, got {other} in frame {odd}")
    scores = np.concatenate([s.joints[:, 2] for frame in frames for s in frame] or [np.zeros(0)])
    scores = scores[scores > 0]
    largest, scale = float(scores.max(initial=0)), 1.0
    if largest > 1 and _up_to_one(scores):
        notes.append(f"confidences above 1 (up to {largest:.3g}) are taken as 1")
    elif _PER_CENT[0] < largest <= _PER_CENT[1]:
        scale = _PER_CENT[1]
        notes.append(f"confidences up to {largest:.4g} are taken as per cent")
    elif largest > OVERSHOOT:
        scale = float(np.quantile(scores, _WELL_SEEN))
        notes.append(f"confidences up to {largest:.4g}: divided by {scale:.4g}, their 95th percentile, and cut at 1")
    out, negative, crowded = [], 0, 0
    for frame in frames:
        kept = []
        for sighting in frame:
            joints = sighting.joints.copy()
            negative += int((joints[:, 2] < 0).sum())
            unseen = ~np.isfinite(joints).all(-1) | (joints[:, 2] <= 0)
            if not measured:
                unseen |= (joints[:, :2] == 0).all(-1)
            joints[:, 2] = (joints[:, 2] / scale).clip(max=1)
            joints[unseen] = 0
            if not unseen.all():
                kept.append(sighting._replace(joints=joints))
        if len(kept) > _MOST_IN_FRAME:
            crowded += 1
            kept = sorted(kept, key=lambda s: -s.joints[:, 2].sum())[:_MOST_IN_FRAME]
        out.append(kept)
    if negative:
        notes.append(f"{negative} joints of negative confidence are taken as unseen")
    if crowded:
        notes.append(f"{crowded} frames have more than {_MOST_IN_FRAME} people: the best seen are taken")
    return out


def _up_to_one(scores: NDArray[np.float64]) -> bool:
    """Whether confidences end at 1 but for a few, which are slips: a decimal point that was lost, say.

    Where all others are next to 0, these few are the ones that are seen.
    """
    others = scores[scores <= OVERSHOOT]
    odd = len(scores) - len(others)
    few = odd <= max(_ODD * len(scores), 1) and len(others) >= _TELLING
    return odd == 0 or (few and float(np.quantile(others, _WELL_SEEN)) > 0.5)


def _by_ids(frames: Sequence[Sequence[Sighting]], notes: list[str]) -> list[_Seen] | None:
    """(frame, index) of each person by track ids, the most seen first; None where they do not say who is who."""
    people: dict[Hashable, _Seen] = {}
    for t, frame in enumerate(frames):
        ids = [s.track for s in frame]
        if None in ids or len(set(ids)) < len(ids):
            if any(s.track is not None for found in frames for s in found):
                wrong = "is missing" if None in ids else "stands twice"
                notes.append(f"a track id {wrong} in frame {t}: people are followed by their places, not by the ids")
            return None
        for i, sighting in enumerate(frame):
            people.setdefault(sighting.track, []).append((t, i))
    return _best_seen_first(people.values(), frames)


def _by_places(frames: Sequence[Sequence[Sighting]], gap: int) -> list[_Seen]:
    """(frame, index) of each person, who may be out of sight for ``gap`` frames, the most seen first."""
    return follow_people([np.array([s.joints for s in frame]) for frame in frames], max_gap=gap)


def _without_breaks(
    people: list[_Seen], frames: Sequence[Sequence[Sighting]], gap: int, notes: list[str]
) -> list[_Seen]:
    """Join people by ids of whom one begins, within ``gap`` frames, where another ends."""
    begins, ends = ({seen[edge]: k for k, seen in enumerate(people)} for edge in (0, -1))
    starts = sorted(t for t, _ in begins)
    if not any(starts[i] - t <= gap for t, _ in ends if (i := bisect(starts, t)) < len(starts)):
        return people
    after = {
        ends[old]: begins[new]
        for person in _by_places(frames, gap)
        for old, new in itertools.pairwise(person)
        if old in ends and new in begins
    }
    if not after:
        return people
    name = lambda k: f"'{brief(frames[people[k][0][0]][people[k][0][1]].track)}'"  # noqa: E731
    breaks = sorted(after.items(), key=lambda ids: people[ids[1]][0])
    told = [f"{name(new)} begins where {name(old)} ends" for old, new in breaks[:3]]
    more = f" and {len(after) - 3} more" if len(after) > 3 else ""
    notes.append(f"track ids that break are joined by place: {', '.join(told)}{more}")
    joined = []
    for k in sorted(set(range(len(people))) - set(after.values())):
        whole = list(people[k])
        while k in after:
            k = after[k]
            whole += people[k]
        joined.append(whole)
    return _best_seen_first(joined, frames)


def _best_seen_first(people: Iterable[_Seen], frames: Sequence[Sequence[Sighting]]) -> list[_Seen]:
    """By the sum of confidences."""
    return sorted(people, key=lambda seen: -sum(float(frames[t][i].joints[:, 2].sum()) for t, i in seen))
