"""Cuts of a film: frames from which on the body is seen from another side, or another one is seen."""

from __future__ import annotations

import torch
from torch import Tensor

from kcs_torch.functional.ranks import nanmedian
from kcs_torch.functional.temporal import interpolate
from kcs_torch.solvers.stray import from_beside

__all__ = ["find_cuts"]

AWAY = 0.12
"""From the frame before to that after a cut half of the joints move, against the body's middle, by more than this share
of its size, the median distance of joints from there."""

LEAP = 1.0
"""Or else the body as a whole moves by more than so many times its size in a frame."""

SUDDEN, BESIDE = 5.0, 8
"""Either way by more than so many times what they move between any two of so many frames before and after."""

FAR = 0.5
"""A joint that lies farther from where it was just before, and from where it is just after, is at a wrong place."""

LEAST, JOINTS = 4, 6
"""Frames that there must be on either side, and joints that both frames of a jump show."""


def find_cuts(points: Tensor, seen: Tensor, pairs: Tensor, *, leaps: bool = True) -> list[int]:
    """Find the first frame of each shot but the first: there the pose jumps, or the body, as it does nowhere near.

    Frames in which half of the joints are seen are compared with the next such one, if that follows at once. Sides that
    a detector takes for each other are no cut, nor is a single wrong frame, which jumps back; nor are joints at wrong
    places, however many, or all of them, as these are not where their joint is before or after. Over frames that show
    less only the body's own leap tells: nobody knows how its pose changes meanwhile.

    Args:
        points: (T, N, 2).
        seen: (T, N) bool.
        pairs: (P, 2) joints that are each other's twins.
        leaps: whether a body that moves as a whole counts, or only another pose.

    >>> time = torch.arange(30.0)[:, None, None] / 30
    >>> pose = torch.randn(8, 2, generator=torch.Generator().manual_seed(0)) + time
    >>> pose[18:] = pose[18:] * torch.tensor([-1.0, 1.0])  # from behind
    >>> find_cuts(pose, torch.ones(30, 8, dtype=torch.bool), torch.zeros(0, 2, dtype=torch.long))
    [18]
    """
    joints = points.shape[1]
    shown = (2 * seen.sum(-1) >= joints).nonzero().flatten()
    if joints < JOINTS or len(shown) < 2 * LEAST:
        return []
    some = seen.any(0)
    whole = interpolate(points, seen)[shown][:, some]  # with those that are seen in a frame its middle would leap
    middle = nanmedian(whole, 1, keepdim=True)
    size = nanmedian((whole - middle).norm(dim=-1), 1)
    known = torch.where(seen[..., None], points, torch.nan)[shown] - middle  # (K, N, 2)
    known = torch.where((from_beside(known) > FAR * size[:, None])[..., None], torch.nan, known)
    twins = torch.arange(joints, device=points.device)
    twins[pairs[:, 0]], twins[pairs[:, 1]] = pairs[:, 1], pairs[:, 0]
    before, after = known[:-1], known[1:]
    own, swapped = _moved(before, after), _moved(before, after[:, twins])
    step = torch.minimum(own, swapped.nan_to_num(torch.inf))
    pace = torch.where(seen[..., None], points, torch.nan)[shown].diff(dim=0)
    pace = nanmedian(pace, 1).norm(dim=-1) / shown.diff()
    lost = (from_beside(middle) > LEAP * size[:, None])[:, 0]  # frames that are at a wrong place
    step, pace = ((x / torch.minimum(size[1:], size[:-1])).nan_to_num(0.0, 0.0) for x in (step, pace))  # 0 / 0: a point
    jumps = _sudden(step, AWAY) & (shown.diff() == 1)
    if leaps:
        jumps |= _sudden(pace, LEAP) & ~lost[1:] & ~lost[:-1]
    jumps[: LEAST - 1] = jumps[len(jumps) - LEAST + 1 :] = False
    return (shown[1:][jumps]).tolist()


def _sudden(steps: Tensor, least: float) -> Tensor:
    """Which steps (K,) are larger than ``least``, and than those beside by far."""
    beside = torch.nn.functional.pad(steps, (BESIDE, BESIDE)).unfold(0, 2 * BESIDE + 1, 1).clone()
    beside[:, BESIDE] = 0
    return (steps > least) & (steps > SUDDEN * beside.amax(1))


def _moved(before: Tensor, after: Tensor) -> Tensor:
    """How far the middle one of the joints moves against all, (K,), by poses (K, N, 2); NaN where few are in both."""
    way = after - before
    enough = (~way.isnan().any(-1)).sum(1) >= JOINTS
    return torch.where(enough, nanmedian((way - nanmedian(way, 1, keepdim=True)).norm(dim=-1), 1), torch.nan)
