"""Joints that stay exactly where they were while the body moves on: gaps that somebody filled with the last place."""

from __future__ import annotations

import torch
from torch import Tensor

from kcs_torch.clean.common import rebuilt, share
from kcs_torch.errors import listed
from kcs_torch.functional.ranks import nanmedian
from kcs_torch.methods.pkc.gate import HELD, JUST, MOVED, SLOWS
from kcs_torch.types import Tracks

__all__ = ["stuck", "without_stuck"]

STEPS = 3
"""A joint has to go by so many of the image's grid, the least that any goes, so as to stop, or leap away, at once."""

SLOW = 10.0
"""Frames a second below which a foot may well be moved from one place of rest to another in one or two."""

LEAPS = 3.0
"""A joint leaps from where it was stuck if it goes so many times as far as in the median of the frames behind."""


def stuck(points: Tensor, seen: Tensor) -> Tensor:
    """Detections (T, N) of joints that stop at once, are exactly where they were for a while, and leap; the body moves.

    What really stops slows down (but where a grid is fine no place repeats itself), and what starts again speeds up: a
    joint that was stuck leaps to where it is by then, and moves on. What only darts away from where it rests is an
    outlier, and what rests before and behind a quick move moves so. At the end of a clip nothing tells.

    Args:
        points: (T, N, 2).
        seen: (T, N) bool.
    """
    out = torch.zeros_like(seen)
    same = (points[1:] == points[:-1]).all(-1) & seen[1:] & seen[:-1]
    if not bool((same.sum(0) > HELD).any()):
        return out
    known = torch.where(seen[..., None], points, torch.nan)
    size = (known - nanmedian(known, 1, keepdim=True)).norm(dim=-1).nanmedian()
    step = (known[1:] - known[:-1]).norm(dim=-1)  # NaN where unseen
    if not bool((step > 0).any()):
        return out
    grid = step[step > 0].amin()
    fine, least = bool(STEPS * grid < MOVED * size), (MOVED * size).maximum(STEPS * grid)
    pace = nanmedian(torch.where(same, torch.nan, step), 1)  # of all others
    edge = torch.nn.functional.pad(same.to(torch.int8), (0, 0, 1, 1)).diff(dim=0).mT
    (joint, first), (_, stop) = ((edge == sign).nonzero().unbind(-1) for sign in (1, -1))  # runs of steps that are none
    moves = torch.nn.functional.pad((pace > MOVED * size).cumsum(0), (1, 0))
    kept = (stop - first > HELD) & (2 * (moves[stop] - moves[first]) > stop - first)
    joint, first, stop = joint[kept], first[kept], stop[kept]
    beyond, few = (0, 0, 1 + JUST, 1 + JUST), torch.arange(JUST, device=seen.device)
    step = torch.nn.functional.pad(step, beyond, value=torch.nan)
    place = torch.nn.functional.pad(known, (0, 0, *beyond), value=torch.nan)
    last, away = step[first + JUST, joint], step[stop + 1 + JUST, joint]
    earlier, later = first[:, None] + few, stop[:, None] + 2 + JUST + few
    came, went = (nanmedian(step[rows, joint[:, None]], 1) for rows in (earlier, later))
    rest = place[first + 1 + JUST, joint][:, None]
    near = ((place[rows, joint[:, None]] - rest).norm(dim=-1) for rows in (earlier, later + 1))
    darts = torch.stack([(off < SLOWS * far[:, None]).any(1) for off, far in zip(near, (last, away), strict=True)]).any(
        0
    )
    sudden = (came > 0) & ((last > 0) if fine else (last > least) & (last >= SLOWS * came))
    leaps = (away > least) & (went > 0) & (away >= LEAPS * went)
    joint, first, stop = (x[sudden & leaps & ~darts] for x in (joint, first, stop))
    change = torch.zeros(len(seen) + 1, seen.shape[1], dtype=torch.long, device=seen.device)
    change[first + 1, joint], change[stop + 1, joint] = 1, -1
    return change.cumsum(0)[:-1] > 0


def without_stuck(tracks: Tracks) -> Tracks:
    """Tracks in which joints that are :func:`stuck` are unseen meanwhile; a note says which."""
    if tracks.rate < SLOW:
        return tracks
    count, body = tracks.skeleton.num_observed, tracks.skeleton
    seen = tracks.seen[:, :count]
    out = stuck(tracks.points[:, :count], seen)
    if not bool(out.any()):
        return tracks
    names = listed([body.joints[n] for n in out.any(0).nonzero().flatten().tolist()], 6)
    which = f"{share(int(out.sum()), int(seen.sum()))} detections, of {names}"
    note = f"joints stay exactly where they were while the body moves: taken as unseen meanwhile: {which}"
    return rebuilt(tracks, tracks.points[:, :count], torch.where(out, 0, tracks.weights[:, :count]), note)
