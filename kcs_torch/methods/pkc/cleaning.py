"""The tracks that PKC solves: smoothed where they are noisy, complete, and how far off each joint may be."""

from __future__ import annotations

import math
from functools import partial
from itertools import pairwise
from typing import Any

import torch
from torch import Tensor

from kcs_torch.clean.detector import detected, detector_deviation
from kcs_torch.clean.gating import steady
from kcs_torch.clean.timing import cuts_of
from kcs_torch.errors import counted
from kcs_torch.functional.temporal import interpolate
from kcs_torch.methods.clips.lockstep import Search
from kcs_torch.methods.clips.unseen import gap_deviation, place_unseen, within_reach
from kcs_torch.methods.pkc.batch import Noisy
from kcs_torch.methods.pkc.gate import plausible
from kcs_torch.methods.pkc.weights import slowness
from kcs_torch.nn.posture import has_trunk
from kcs_torch.solvers.denoise import Denoised
from kcs_torch.solvers.noise import SHORT
from kcs_torch.solvers.spectrum import window_at
from kcs_torch.solvers.stray import each_joint, in_motion
from kcs_torch.types import Tracks

__all__ = ["CLEAN", "HELD", "PLAIN", "cleaned", "nobody_at_ends"]

CLEAN, PLAIN = 0.0013, 0.0007
"""Noise below this share of the body's size, .6 mm of a person, is left in tracks at 30 frames a second or less: they
count as exact. That of motion capture comes to a fifth of it, and where it moves quickly to nine tenths; at more frames
a second less noise does harm. And the same of bodies whose lengths no template tells: where tracks count as exact bones
do, too, so that a little noise may make all of them wrong."""

QUICK = 2.2
"""Frequency in Hz from which on what joints do not share is noise rather than motion."""

HINT = "If a detector found the joints, detections=True allows for its errors, which last"

UNTOLD = 0.015
"""Noise that is assumed where a clip is too short to tell it, or shows hardly more than one pose: that of good
detections."""

FAR = 0.5
"""Share of the body's size from which on a jump is surely wrong; smaller ones are for the model of the clip to tell."""

MANY = 0.03
"""Share of the detections that must jump so: of fewer the model makes sense, and knows quick hands from wrong ones."""

HELD = 0.1
"""Standard deviation, a share of the body's size, of joints in frames before the body is first seen and after it was
last seen, and the largest in gaps."""


def cleaned(
    tracks: Tracks, denoise: bool, template: bool = True, time: Tensor | None = None
) -> Search[Any, Any, tuple[Tensor, Tensor, tuple[str, ...]]]:
    """Smooth noisy tracks, reject outliers and fill gaps; each shot by itself where a film has cuts.

    Args:
        tracks: of root mean square 1.
        denoise: whether to smooth and reject; else gaps are filled linearly.
        template: whether a template tells the body's lengths.
        time: (T,) of each frame, in frames, where some of long gaps were left out.

    Returns:
        Complete tracks (T, N, 2), the standard deviation (T, N) of the noise that is left in them, and what was done.
    """
    parts = list(pairwise([0, *cuts_of(tracks), tracks.num_frames]))
    shots = [tracks.frames(*some) for some in parts]
    if not denoise:
        made = [_complete(shot, interpolate(shot.points, shot.seen), shot.seen, 0.0) for shot in shots]
    else:
        rate = tracks.rate
        window = window_at(rate)
        quick = math.ceil(2 * QUICK * window / rate)
        kept = [_likely(shot) for shot in shots]
        asked = [torch.where(keep, shot.weights, 0) for shot, keep in zip(shots, kept, strict=True)]
        time = torch.arange(tracks.num_frames, device=tracks.points.device) if time is None else time
        times = [time[slice(*some)] for some in parts]
        found = yield [
            Noisy(shot.points, w, at, window, quick) for shot, w, at in zip(shots, asked, times, strict=True)
        ]
        levels = [one.noise.median().expand(shot.num_frames) for one, shot in zip(found, shots, strict=True)]
        level = float(torch.cat(levels).median())  # one for all shots, or the sharper ones would fill the others
        clean = level <= (CLEAN * min(1.0, 30 / rate) if template else PLAIN)
        rows = zip(shots, times, kept, found, strict=True)
        made = [_smoothed(*one, None if clean else level, template) for one in rows]
    points, noise, notes = zip(*made, strict=True)
    return torch.cat(points), torch.cat(noise), tuple(dict.fromkeys(note for some in notes for note in some))


def _likely(tracks: Tracks) -> Tensor:
    """Which detections (T, N) of a shot a body may have made, without those that jump far away where many do."""
    count = tracks.skeleton.num_observed
    points, seen = tracks.points[:, :count], tracks.seen[:, :count]
    kept = tracks.seen
    if bool(seen.any()):
        still = steady(points, seen, tracks.rate, floor=FAR)
        if int((seen & ~still).sum()) > MANY * int(seen.sum()):
            kept = kept & (tracks.skeleton.complete(points, still.to(points))[1] > 0)
    return plausible(tracks.points, kept, tracks.skeleton)


def _smoothed(
    tracks: Tracks, time: Tensor, keep: Tensor, found: Denoised, level: float | None, template: bool
) -> tuple[Tensor, Tensor, list[str]]:
    """A shot whose outliers are rejected, and smoothed unless it is exact: then there is no level of noise."""
    notes = []
    outliers = found.outliers & keep
    if level is None and bool(outliers.any()):
        right = keep & ~outliers
        moving = each_joint(partial(in_motion, time=time[None]), tracks.points[None], right[None])[0]
        if bool(moving[outliers].all()):
            outliers = torch.zeros_like(outliers)  # a kick: one that is really wrong is seldom so near
    wrong = int((outliers | (tracks.seen & ~keep)).sum())
    if wrong:
        share = wrong / int(tracks.seen.sum())
        notes.append(f"{counted(wrong, 'detection')} ({100 * share:.1f} %) rejected as outliers")
    keep = keep & ~outliers
    exact = keep
    if level is not None:
        exact = torch.zeros_like(keep)
        smoothed = f"tracks smoothed: noise of {100 * level:.1f} % of the body's size"
        untold = tracks.detector is None and not detected(tracks)
        notes.append(f"{smoothed}. {HINT}" if template and untold else smoothed)
    points = torch.where(exact[..., None], tracks.points, found.points)
    points, noise, more = _complete(tracks, points, keep, 0.0 if level is None else float(found.left.median()))
    return points, noise, [*notes, *more]


def _complete(tracks: Tracks, points: Tensor, keep: Tensor, left: float) -> tuple[Tensor, Tensor, list[str]]:
    """A shot of points (T, N, 2), of which those to keep (T, N) have so much noise left; all others are placed."""
    notes = []
    known = keep.any(0)
    if not bool(known.all()):
        flat = torch.nn.functional.pad(points, (0, 1))
        points = place_unseen(flat, known, tracks.skeleton)[..., :2]
    points = within_reach(points, keep, tracks.skeleton)
    points, _ = tracks.skeleton.complete(points[:, : tracks.skeleton.num_observed])  # virtual ones follow their sources
    noise = (gap_deviation(points, keep, tracks.rate, HELD).square() + left**2).sqrt()
    if detected(tracks):
        noise = noise.maximum(detector_deviation(tracks))
        notes.append("taken for a detector's joints: they may be off by 3 % of the body's size or more")
    if len(points) / _alike(tracks, points) < SHORT:
        noise = noise.clamp_min(UNTOLD)
    held = _nearest_shown(keep)
    away = held != torch.arange(len(held), device=held.device)
    if bool(away.any()):  # nothing tells what goes on there, and a model of motion would run off
        points, noise = points[held], torch.where(away[:, None], points.new_full((), HELD), noise)
        notes.append(nobody_at_ends(int(away.sum())))
    return points, noise, notes


def nobody_at_ends(count: int) -> str:
    """What is noted of so many frames before a body is first seen and after it was last seen."""
    return f"{counted(count, 'frame')} at the clip's ends {'shows' if count == 1 else 'show'} nobody: nearest pose held"


def _alike(tracks: Tracks, points: Tensor) -> float:
    """How many frames of a shot tell as much as one of a person who walks, at least 1; 1 where no template tells."""
    body = tracks.skeleton
    return max(1.0, slowness(points, body, tracks.rate)) if has_trunk(body) else 1.0


def _nearest_shown(seen: Tensor) -> Tensor:
    """Each frame's own index (T,), but that of the nearest frame that shows something at the clip's ends."""
    shown = (seen.sum(-1) > 1).nonzero().flatten()
    index = torch.arange(len(seen), device=seen.device)
    return index if not len(shown) else index.clamp(int(shown[0]), int(shown[-1]))
