"""Other frames of the same motion: a part of a clip, another frame rate."""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import pairwise, starmap

import numpy as np
import torch
from torch import Tensor

from kcs_torch.clean.common import Array, check_rate, check_seen, check_tracks, frame_rate, rebuilt, runs
from kcs_torch.errors import OptionError, ShapeError, unknown
from kcs_torch.skeleton import Skeleton
from kcs_torch.solvers.cuts import cut_frames
from kcs_torch.types import Tracks
from kcs_torch.types.arrays import as_doubles
from kcs_torch.types.hints import is_a

__all__ = ["cuts_of", "cuts_of_all", "resample", "shots_of", "split", "trim"]

_KINDS = {"linear": 1, "cubic": 3}
_EPS = 1e-6  # of a frame: rounding of times must not make a seen frame unseen


def trim(tracks: Tracks, start: int | None = None, stop: int | None = None) -> Tracks:
    """Take the frames from ``start`` to ``stop``, which is not included; counted from 0, as Python's slices are.

    The frames of the new clip are counted from 0, too, in the result and its notes.

    Args:
        tracks: what to take them of.
        start: first frame; the clip's first if None.
        stop: frame after the last; the clip's end if None, or if it lies beyond.

    Raises:
        OptionError: these are no frames of the clip.
        ShapeError: no joint is seen in them.

    >>> from kcs_torch.data.synthetic import walking_person
    >>> trim(walking_person(60).tracks, 10, 30).notes[-1]
    'trim: frames 10 to 29 of 60; in the result and other notes the first of them is frame 0'
    """
    check_tracks(tracks, "trim")
    frames = tracks.num_frames
    for name, value in (("start", start), ("stop", stop)):
        if value is not None and (not is_a(value, int) or value < 0):
            raise OptionError(f"trim: {name}: expected a frame counted from 0, or None, got {value!r}")
    first, end = start or 0, frames if stop is None else min(stop, frames)
    if not first < end:
        asked = f"{first}:{'' if stop is None else stop}"
        raise OptionError(f"trim: expected frames within 0:{frames} of {tracks.source}, got {asked}")
    cut = tracks.frames(first, end)
    if not bool(cut.seen.any()):
        raise ShapeError(f"{tracks.source}: no joint is seen in frames {first} to {end - 1}")
    note = f"trim: frames {first} to {end - 1} of {frames}"
    note += "; in the result and other notes the first of them is frame 0" if first else ""
    return replace(cut, points=cut.points.clone(), weights=cut.weights.clone(), notes=(*cut.notes, note))


def split(tracks: Tracks) -> list[Tracks]:
    """Divide a clip at the cuts of its film, where the body is suddenly seen from another side, or another one is.

    Shots of one body are better solved together by PKC, as they tell each other's depth; those of others by themselves.

    Args:
        tracks: what to divide.

    Returns:
        The shots, each with a note; the clip itself alone where there is no cut.

    >>> from kcs_torch.data.synthetic import walking_person
    >>> front, side = (walking_person(30, yaw=yaw, turn=0).tracks for yaw in (0, 90))
    >>> both = replace(front, points=torch.cat([front.points, side.points]), weights=torch.ones(60, 17).double())
    >>> [one.num_frames for one in split(both)]
    [30, 30]
    """
    check_tracks(tracks, "split")
    shots = shots_of(tracks)
    return [trim(tracks, shot.start, shot.stop) for shot in shots] if len(shots) > 1 else [tracks]


def shots_of(tracks: Tracks, *, leaps: bool = True) -> list[slice]:
    """The frames of each shot of a clip, which lie between its cuts (:func:`cuts_of`): all in one where it has none."""
    return list(starmap(slice, pairwise([0, *cuts_of(tracks, leaps=leaps), tracks.num_frames])))


def cuts_of(tracks: Tracks, *, leaps: bool = True) -> list[int]:
    """The first frames of the shots of a clip but the first; see :func:`kcs_torch.solvers.cuts.find_cuts`."""
    return cuts_of_all(tracks.points[None], tracks.seen[None], tracks.skeleton, leaps=leaps)[0]


def cuts_of_all(points: Tensor, seen: Tensor, body: Skeleton, *, leaps: bool = True) -> list[list[int]]:
    """:func:`cuts_of` of K clips: of points (K, T, N, 2), seen (K, T, N) or not, as padding is."""
    count = body.num_observed
    pairs = torch.tensor([pair for pair in body.mirror if max(pair) < count], dtype=torch.long, device=points.device)
    found = cut_frames(points[:, :, :count], seen[:, :, :count], pairs.view(-1, 2), leaps=leaps)
    cuts: list[list[int]] = [[] for _ in found]
    for clip, frame in found.nonzero().tolist():
        cuts[clip].append(frame)
    return cuts


def resample(tracks: Tracks, fps: float, *, kind: str = "cubic", source_fps: float | None = None) -> Tracks:
    """Put the same motion at another frame rate, by splines within runs of seen frames.

    Gaps stay gaps: a new frame sees a joint where the old frames on either side do, and as surely as the less sure of
    them. Nothing is smoothed: where the rate falls, noise stays what it is, so smooth first. Between two shots of a
    film (:func:`split`) a new frame shows the old one that is nearer: shots stay apart, and those of four new frames or
    more are found again.

    Args:
        tracks: what to resample.
        fps: the new frames a second.
        kind: "cubic" or "linear".
        source_fps: the old frames a second; as the tracks say if None.

    Returns:
        Tracks whose frame k is at time k / fps of the old clip.

    Raises:
        OptionError: a rate is unknown or no positive number.
        ShapeError: no joint is seen in any frame, or in any new one.

    >>> from kcs_torch.data.synthetic import walking_person
    >>> resample(walking_person(61, fps=30).tracks, 60).num_frames
    121
    """
    check_tracks(tracks, "resample")
    check_seen(tracks, "resample")
    if kind not in _KINDS:
        raise unknown("kind of resample", kind, _KINDS)
    check_rate(fps, "resample: fps")
    rate = frame_rate(tracks.fps, source_fps, "resample", tracks.source)
    frames, count = tracks.num_frames, tracks.skeleton.num_observed
    length = math.floor((frames - 1) * fps / rate + _EPS) + 1
    if length > 1_000_000 and length > 10 * frames:
        raise OptionError(f"resample: fps: expected a rate near the {rate:g} frames a second of the clip, got {fps:g}")
    place = np.minimum(np.arange(length) * (rate / fps), frames - 1)  # in old frames
    points = as_doubles(tracks.points[:, :count])
    weights = as_doubles(tracks.weights[:, :count])
    new_points, new_weights = np.zeros((length, count, 2)), np.zeros((length, count))
    for shot in shots_of(tracks):
        here = (place >= shot.start - 0.5) & (place < shot.stop - 0.5)
        inside = place[here].clip(shot.start, shot.stop - 1) - shot.start
        new_points[here], new_weights[here] = _at(inside, points[shot], weights[shot], _KINDS[kind])
    note = f"resample: from {frames} frames at {rate:g} a second to {length} at {fps:g} ({kind})"
    return rebuilt(tracks, torch.from_numpy(new_points), torch.from_numpy(new_weights), note, fps=float(fps))


def _at(place: Array, points: Array, weights: Array, degree: int) -> tuple[Array, Array]:
    """Points and weights of a shot (T, N, 2), (T, N) at places (L,) between its frames, by splines of a degree."""
    from scipy.interpolate import make_interp_spline

    new_points, new_weights = np.zeros((len(place), *points.shape[1:])), np.zeros((len(place), weights.shape[1]))
    for joint in range(points.shape[1]):
        for start, stop in runs(weights[:, joint] > 0):
            inside = np.flatnonzero((place >= start - _EPS) & (place <= stop - 1 + _EPS))
            if not len(inside):
                continue
            at, time = place[inside].clip(start, stop - 1), np.arange(start, stop)
            if stop - start == 1:
                new_points[inside, joint], new_weights[inside, joint] = points[start, joint], weights[start, joint]
                continue
            fitting = degree if stop - start > 3 else 1  # a cubic takes four frames
            new_points[inside, joint] = make_interp_spline(time, points[start:stop, joint], fitting)(at)
            before, after = np.floor(at + _EPS).astype(int), np.ceil(at - _EPS).astype(int)
            new_weights[inside, joint] = np.minimum(weights[before, joint], weights[after, joint])
    return new_points, new_weights
