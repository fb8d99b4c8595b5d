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

LEAPS = 3.0
"""A joint leaps from where it was stuck if it goes so many times as far as in each of the frames behind."""


def stuck(points: Tensor, seen: Tensor) -> Tensor:
    """Detections (T, N) of joints that stop at once, are exactly where they were for a while, and leap; the body moves.

    What really stops slows down (but where a grid is fine no place repeats itself), and what starts again speeds up: a
    joint that was stuck leaps to where it is by then. At the end of a clip nothing tells.

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
    edge = torch.nn.functional.pad(same.to(torch.int8), (0, 0, 1, 1)).diff(dim=0)
    step = torch.nn.functional.pad(step, (0, 0, 1 + JUST, 1 + JUST), value=torch.nan)
    for joint in (same.sum(0) > HELD).nonzero().flatten().tolist():
        begins, ends = ((edge[:, joint] == sign).nonzero().flatten().tolist() for sign in (1, -1))
        own = step[:, joint]
        for first, stop in zip(begins, ends, strict=True):  # of steps that are none
            if stop - first <= HELD or not bool(nanmedian(pace[first:stop], 0) > MOVED * size):
                continue
            before, last = own[first : first + JUST], own[first + JUST]
            away, behind = own[stop + 1 + JUST], own[stop + 2 + JUST : stop + 2 + 2 * JUST]
            sudden = fine or (bool(last > least) and not bool(last < SLOWS * before.nanmedian()))
            leaps = bool(away > least) and not bool(away < LEAPS * behind.nanmedian())
            out[first + 1 : stop + 1, joint] = sudden and leaps
    return out


def without_stuck(tracks: Tracks) -> Tracks:
    """Tracks in which joints that are :func:`stuck` are unseen meanwhile; a note says which."""
    count, body = tracks.skeleton.num_observed, tracks.skeleton
    seen = tracks.seen[:, :count]
    out = stuck(tracks.points[:, :count], seen)
    if not bool(out.any()):
        return tracks
    names = listed([body.joints[n] for n in out.any(0).nonzero().flatten().tolist()], 6)
    which = f"{share(int(out.sum()), int(seen.sum()))} detections, of {names}"
    note = f"joints stay exactly where they were while the body moves: taken as unseen meanwhile: {which}"
    return rebuilt(tracks, tracks.points[:, :count], torch.where(out, 0, tracks.weights[:, :count]), note)
