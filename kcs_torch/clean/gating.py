"""Detections that jump away from where their joint is just before and after."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from kcs_torch.clean.common import check_seen, check_tracks, number, rebuilt, share
from kcs_torch.clean.timing import shots_of
from kcs_torch.errors import listed
from kcs_torch.functional.ranks import nanmedian
from kcs_torch.solvers.stray import around_usual, body_size
from kcs_torch.types import Tracks

__all__ = ["gate", "steady"]

_SIDE = 5
"""Neighbours looked at before and after a frame, at most; at high frame rates they lie further apart."""

_LEAST = 3
"""Neighbours without which a detection is not judged."""

_ROUNDS = 2
"""What is dropped first no longer spoils the prediction of its neighbours."""

_NUMBERS = 2**16
"""Detections that are judged at once: this takes some 3 kB each."""


def gate(tracks: Tracks, *, threshold: float = 6.0, floor: float = 0.2, reach: float = 0.1) -> Tracks:
    """Drop detections that jump: they become unseen, and a note says how many and of which joints.

    Each detection y is compared with the straight line p that its joint follows in the frames around it (Siegel's
    repeated median, which up to half of the neighbours may spoil), and dropped where

        |y - p| > threshold * usual + floor * size.

    ``usual`` is the median of |y - p| of the joint, over the clip or, where it moves more abruptly, over the nearest
    frames (four times the clip's at most). ``size`` is the body's: the median distance of its joints from their
    middle. Where a film has cuts (:func:`~kcs_torch.clean.split`), each shot is a clip of its own. Runs of outliers
    that last longer than ``reach`` look like motion and stay, as do detections that have fewer than three neighbours.

    Args:
        tracks: what to clean.
        threshold: in usual errors.
        floor: in body sizes; a fifth is about 8 cm of a person.
        reach: seconds before and after that are looked at: at least three frames, and three where the rate is unknown.

    Returns:
        Tracks with outliers unseen; all else as it was.

    Raises:
        OptionError: an option is not positive.
        ShapeError: no joint is seen, or none is left.

    >>> from kcs_torch.data.synthetic import walking_person
    >>> tracks = walking_person(60).tracks
    >>> tracks.points[30, 9] += 100.0
    >>> cleaned = gate(tracks)
    >>> cleaned.seen[30, 9].item(), cleaned.notes[-1]
    (False, 'gate: 1 of 1020 (0.098 %) detections dropped as outliers: neck 1')
    """
    check_tracks(tracks, "gate")
    check_seen(tracks, "gate")
    number(threshold, "gate: threshold", "a positive number of usual errors")
    number(floor, "gate: floor", "a positive share of the body's size")
    number(reach, "gate: reach", "a positive number of seconds")
    count = tracks.skeleton.num_observed
    points, seen = tracks.points[:, :count].double(), tracks.seen[:, :count]
    shots = [steady(points[shot], seen[shot], tracks.fps, threshold, floor, reach) for shot in shots_of(tracks)]
    kept = torch.cat(shots)
    dropped = (seen & ~kept).sum(0)
    total = int(dropped.sum())
    which = [f"{tracks.skeleton.joints[n]} {int(dropped[n])}" for n in dropped.argsort(descending=True).tolist()]
    which = which[: int((dropped > 0).sum())]
    names = f": {listed(which, 6)}" if which else ""
    note = f"gate: {share(total, int(seen.sum()))} detections dropped as outliers{names}"
    return rebuilt(tracks, tracks.points[:, :count], tracks.weights[:, :count] * kept, note)


def steady(
    points: Tensor, seen: Tensor, rate: float | None, threshold: float = 6.0, floor: float = 0.2, reach: float = 0.1
) -> Tensor:
    """Which detections to keep (T, N), of points (T, N, 2) that are seen (T, N); options as of :func:`gate`."""
    side = 3 if rate is None else max(3, round(reach * rate))
    offsets = sorted({round(1 + i * (side - 1) / (_SIDE - 1)) for i in range(_SIDE)})
    size = body_size(points[None], seen[None])
    kept = seen
    for _ in range(_ROUNDS):
        error = (points - _line(points, kept, offsets)).norm(dim=-1)
        known = torch.where(kept, error, math.nan)
        usual = around_usual(known, nanmedian(known, 0, keepdim=True))
        kept = seen & ~(error > threshold * usual + floor * size)  # NaN, not judged, is not above
    return kept


def _line(points: Tensor, seen: Tensor, offsets: list[int]) -> Tensor:
    """(T, N, 2) where the lines through a joint's seen neighbours put it; NaN where there are too few."""
    few, away = max(1, _NUMBERS // max(points.shape[1], 1)), offsets[-1]
    lines = []
    for at in range(0, len(points), few):
        part = slice(max(0, at - away), at + few + away)
        lines.append(_line_through(points[part], seen[part], offsets)[min(at, away) :][:few])
    return torch.cat(lines)


def _line_through(points: Tensor, seen: Tensor, offsets: list[int]) -> Tensor:
    """As :func:`_line`, of all frames at once."""
    frames = len(points)
    shifts = [*(-k for k in reversed(offsets)), *offsets]
    held = torch.where(seen[..., None], points, math.nan)
    blank = torch.full_like(held, math.nan)

    def at(shift: int) -> Tensor:
        if abs(shift) >= frames:
            return blank
        return torch.cat([held[shift:], blank[:shift]]) if shift > 0 else torch.cat([blank[shift:], held[:shift]])

    near = torch.stack([at(k) for k in shifts], -1)  # (T, N, 2, K)
    time = torch.tensor(shifts, dtype=points.dtype, device=points.device)
    apart = time[:, None] - time
    apart.fill_diagonal_(math.nan)
    slope = nanmedian(nanmedian((near[..., :, None] - near[..., None, :]) / apart, -1), -1, keepdim=True)
    place = nanmedian(near - slope * time, -1)
    enough = near.isfinite().sum(-1) >= _LEAST
    return torch.where(enough, place, math.nan)
