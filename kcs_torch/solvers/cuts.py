"""Cuts of a film: frames from which on the body is seen from another side, or another one is seen."""

from __future__ import annotations

import torch
from torch import Tensor

from kcs_torch.functional.ranks import nanmedian
from kcs_torch.functional.temporal import interpolate
from kcs_torch.solvers.stray import from_beside

__all__ = ["cut_frames", "find_cuts"]

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
    return cut_frames(points[None], seen[None], pairs, leaps=leaps)[0].nonzero().flatten().tolist()


def cut_frames(points: Tensor, seen: Tensor, pairs: Tensor, *, leaps: bool = True) -> Tensor:
    """:func:`find_cuts` in each of K clips (K, T, N, 2), in which padding is unseen: (K, T), True at cuts."""
    joints = seen.shape[2]
    shown = 2 * seen.sum(-1) >= joints
    none = torch.zeros_like(shown)
    count = shown.sum(1, keepdim=True)
    if joints < JOINTS or not bool((count >= 2 * LEAST).any()):
        return none
    time = (~shown).byte().argsort(dim=1, stable=True)[:, : int(count.max())]  # the frames that are shown, then others
    step = torch.arange(1, time.shape[1], device=points.device)
    at = lambda values: values[torch.arange(len(seen), device=points.device)[:, None], time]  # noqa: E731
    held = torch.where((seen & shown[..., None])[..., None], points, torch.nan)
    whole = held if bool(seen.all()) else interpolate(points, seen)  # of those seen in a frame the middle would leap
    whole = at(torch.where((shown[..., None] & seen.any(1, keepdim=True))[..., None], whole, torch.nan))
    middle = nanmedian(whole, 2, keepdim=True)
    size = nanmedian((whole - middle).norm(dim=-1), 2)
    held = at(held)
    known = held - middle  # (K, S, N, 2)
    known = torch.where((_from_beside(known) > FAR * size[..., None])[..., None], torch.nan, known)
    gap, least = time.diff(dim=1), torch.minimum(size[:, 1:], size[:, :-1])
    sized = lambda steps: (steps / least).nan_to_num(0.0, 0.0)  # noqa: E731  # 0 / 0: a point
    before, after = known[:, :-1], known[:, 1:]
    own = _moved(before, after)
    jumps = sized(own) > AWAY
    if bool(jumps.any()):
        twins = torch.arange(joints, device=points.device)
        twins[pairs[:, 0]], twins[pairs[:, 1]] = pairs[:, 1], pairs[:, 0]
        swapped = _moved(before, after[:, :, twins])
        jumps = _sudden(sized(torch.minimum(own, swapped.nan_to_num(torch.inf))), AWAY) & (gap == 1)
    if leaps:
        leap = _sudden(sized(nanmedian(held.diff(dim=1), 2).norm(dim=-1) / gap), LEAP)
        if bool(leap.any()):
            lost = (_from_beside(middle) > LEAP * size[..., None])[..., 0]  # frames that are at a wrong place
            jumps |= leap & ~lost[:, 1:] & ~lost[:, :-1]
    jumps &= (step >= LEAST) & (step <= count - LEAST)
    return none.scatter(1, time[:, 1:], jumps)


def _from_beside(values: Tensor) -> Tensor:
    """:func:`from_beside` of clips (K, T, N, D): (K, T, N)."""
    return from_beside(values.transpose(0, 1).flatten(1, 2)).unflatten(1, (-1, values.shape[2])).transpose(0, 1)


def _sudden(steps: Tensor, least: float) -> Tensor:
    """Which steps (K, S) are larger than ``least``, and than those beside by far."""
    around = torch.nn.functional.pad(steps, (BESIDE, BESIDE)).unfold(1, 2 * BESIDE + 1, 1)
    beside = torch.maximum(around[..., :BESIDE].amax(-1), around[..., BESIDE + 1 :].amax(-1))
    return (steps > least) & (steps > SUDDEN * beside)


def _moved(before: Tensor, after: Tensor) -> Tensor:
    """How far the middle joint moves against all, (...), from pose to pose (..., N, 2); NaN where few are in both."""
    way = after - before
    enough = (~way.isnan().any(-1)).sum(-1) >= JOINTS
    return torch.where(enough, nanmedian((way - nanmedian(way, -2, keepdim=True)).norm(dim=-1), -1), torch.nan)
