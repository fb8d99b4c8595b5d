"""A body, or some of its joints, that leap away and back: detections of somebody, or of something, else."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import partial
from itertools import pairwise

import torch
from torch import Tensor

from kcs_torch.clean.common import rebuilt, share
from kcs_torch.errors import listed
from kcs_torch.functional.ranks import nanmedian
from kcs_torch.types import Tracks

__all__ = ["elsewhere", "limbs_elsewhere", "without_others", "without_strange_limbs"]

LEAP, SUDDEN = 1.0, 4.0
"""From one frame to the next the whole body leaps where it moves by more than so many times its size, the median
distance of joints from their middle, and by so many times what it moves in the frames beside: a hand that snaps aside
takes several frames to do so."""

BACK, PART, MOST = 0.5, 0.25, 0.4
"""What leaps away and back ends where it began, but for this share of its leaps, and is away for this share of the
clip at most; what only leaps away, or back, as well, and a single joint for the last share of the frames in which it is
seen."""

FEW, BRIEF, ALIKE = 0.35, 3, 0.5
"""Of the joints that are seen, so many may leap at once; they are away for so many frames at least, and those that go
together move alike but for this share of a leap."""

AROUND, AHEAD = 3, 1.7
"""Frames were lost where most joints that do not leap go so many times as far as in the median of so many frames before
and after."""

ASIDE, FAST = 0.3, 8.0
"""A joint leaps where it moves by more than so many times the body's size in a frame, and by so many in a second: by
13 cm, and at 3.5 m/s, of a person. In a million places of people's motion capture no joint leaps so, as suddenly."""

QUICK = 2.0
"""How many times as far, and as fast, joints leap of bodies without twins: fingers are quick for a hand's size."""

SLOW = 10.0
"""Frames a second where nobody says how many there are: at few of them all motion is sudden."""


def elsewhere(points: Tensor, seen: Tensor) -> Tensor:
    """Frames (T,) in which the whole body has leapt away and not yet back: most likely those of somebody else.

    A tracker that takes two people for each other, say, shows the other one for some frames. How far the body moves
    is told by the joints that both frames show. A leap without return is left: nobody knows which side is right.

    Args:
        points: (T, N, 2).
        seen: (T, N) bool.
    """
    away = torch.zeros(len(points), dtype=torch.bool, device=points.device)
    shown = (seen.sum(-1) > 1).nonzero().flatten()
    if len(shown) < 4:
        return away
    known = torch.where(seen[..., None], points, torch.nan)[shown]  # (K, N, 2)
    size = (known - nanmedian(known, 1, keepdim=True)).norm(dim=-1).nanmedian()
    step = nanmedian(known[1:] - known[:-1], 1).norm(dim=-1).nan_to_num()
    leaps = (step > LEAP * size).nonzero().flatten().tolist()
    if not size > 0 or len(leaps) > PART * len(shown):  # a camera that shakes, or tracks of no one
        return away

    def gap(first: int, last: int) -> Tensor:
        return nanmedian(known[last + 1] - known[first], 0).norm()

    for first, last in _stays(leaps, step, PART * len(shown), gap):
        away[shown[first] + 1 : shown[last] + 1] = True
    return away


def limbs_elsewhere(
    points: Tensor, seen: Tensor, rate: float, twins: Sequence[tuple[int, int]] = (), *, quick: float = 1.0
) -> Tensor:
    """Detections (T, N) of joints that have leapt away and not yet back while the body stayed: of something else.

    A detector takes another's arm for this one's, or what an arm is hidden by, for some frames. No joint starts and
    stops so suddenly by itself. Joints that go the same way with one that does, there and back, are away with it. Of a
    leap without return, near an end of the clip, the shorter side is away. Where more than a few joints leap it is the
    body that moves, or another view; where most go farther than around, frames were lost; and what is brief is for the
    model of the clip. Steps are those between frames that show a joint, by the time in between.

    Args:
        points: (T, N, 2).
        seen: (T, N) bool.
        rate: frames a second.
        twins: pairs of joints that may have changed places: where both leap nothing is told.
        quick: how many times as far and as fast as a person's joints these have to go.
    """
    away, frames = torch.zeros_like(seen), torch.arange(len(points), device=points.device)
    known = torch.where(seen[..., None], points, torch.nan)
    size = (known - nanmedian(known, 1, keepdim=True)).norm(dim=-1).nanmedian()
    there = seen.any(1).nonzero().flatten()
    if len(there) < 2 + BRIEF or not size > 0:
        return away
    move = known[there].diff(dim=0)
    drift = nanmedian(move, 1)  # of the body, to each frame that shows it
    known[there[1:]] -= drift.nan_to_num().cumsum(0)[:, None]
    last = torch.where(seen, frames[:, None], -1).cummax(0).values[:-1]  # frame that showed a joint last
    gap = frames[1:, None] - last
    move = known[1:] - known.gather(0, last.clamp_min(0)[..., None].expand(-1, -1, 2))  # NaN where unseen
    move = torch.where((last < 0)[..., None], torch.nan, move)
    step = move.norm(dim=-1)
    leaps = step > quick * (FAST * gap / rate).clamp_min(ASIDE) * size  # NaN is not above
    leaps &= leaps.sum(1, keepdim=True) <= FEW * seen.sum(1, keepdim=True)[1:]
    pace = nanmedian(torch.where(leaps, torch.nan, step / gap), 1)  # of the others
    leaps[there[1:][_lost(pace[there[1:] - 1])] - 1] = False
    left, right = (list(side) for side in zip(*twins, strict=True)) if twins else ([], [])
    both = leaps[:, left] & leaps[:, right]
    leaps[:, left], leaps[:, right] = leaps[:, left] & ~both, leaps[:, right] & ~both
    for joint in leaps.any(0).nonzero().flatten().tolist():
        shown = seen[:, joint].nonzero().flatten()
        begins = shown[1:] - 1  # rows of steps to a frame that shows it
        own = (step[begins, joint] / gap[begins, joint]).cpu()
        at, ways = leaps[begins, joint].nonzero().flatten().tolist(), move[begins, joint].cpu()
        stays = _stays(at, own, math.inf, partial(_way_back, ways), around=2)
        used = {i for pair in stays for i in pair}
        lone = [i for i in at if i not in used and 2 <= i < len(own) - 2 and _is_sudden(own, i, i, 2)]
        most, part, count = MOST * len(shown), PART * len(shown), len(shown)
        times = [([*stay], stay[0] + 1, stay[1] + 1) for stay in stays if BRIEF <= stay[1] - stay[0] <= most]
        times += [([i], 0, i + 1) for i in lone if i + 1 <= part][-1:]
        times += [([i], i + 1, count) for i in lone if count - i - 1 <= part][:1]
        for ends, start, stop in times:
            rows = begins[ends]
            alike = (move[rows] - move[rows, joint][:, None]).norm(dim=-1) < ALIKE * step[rows, joint][:, None]
            with_it = (leaps[rows] & alike).all(0)
            away[shown[start] : shown[stop - 1] + 1] |= with_it
    return away & seen


def _lost(step: Tensor) -> Tensor:
    """Before which of (T - 1,) steps of most joints frames were lost: much longer than around, like all motion then."""
    beside = torch.nn.functional.pad(step, (AROUND, AROUND), value=torch.nan).unfold(0, 2 * AROUND + 1, 1)
    return step > AHEAD * nanmedian(beside, -1)


def _way_back(move: Tensor, first: int, last: int) -> Tensor:
    """How far from where it leapt away something comes back, or how far from back by the same way, the less of both.

    A limb moves on meanwhile: behind a leap by as much it is where it would be. What stays where something else is
    leaps back to where the limb was.
    """
    return torch.minimum(move[first : last + 1].nansum(0).norm(), (move[first] + move[last]).norm())


def _stays(
    leaps: Sequence[int], step: Tensor, longest: float, gap: Callable[[int, int], Tensor], around: int = 1
) -> list[tuple[int, int]]:
    """Sudden leaps, of steps (T - 1,), that lead away and, no later than after the longest stay, back again.

    Args:
        leaps: which steps are.
        step: how long each is.
        longest: in frames.
        gap: how far from back two leaps lead.
        around: steps before and after a leap that are much smaller.
    """
    stays: list[tuple[int, int]] = []
    for first, last in pairwise(leaps):
        if stays and stays[-1][1] == first:  # it has led back
            continue
        back = bool(gap(first, last) < BACK * torch.minimum(step[first], step[last]))
        if last - first <= longest and back and _is_sudden(step, first, last, around):
            stays.append((first, last))
    return stays


def _is_sudden(step: Tensor, first: int, last: int, around: int) -> bool:
    """Whether two of (T - 1,) steps are much longer than those around both."""
    beside = {at + by for at in (first, last) for by in range(-around, around + 1)} - {first, last}
    least = torch.minimum(step[first], step[last])
    return all(bool(least > SUDDEN * step[i]) for i in beside if 0 <= i < len(step))


def without_others(tracks: Tracks) -> Tracks:
    """Tracks in which frames of somebody else (:func:`elsewhere`) show nothing; a note says which."""
    away = elsewhere(tracks.points, tracks.seen)
    if not bool(away.any()):
        return tracks
    count = tracks.skeleton.num_observed
    weights = torch.where(away[:, None], 0, tracks.weights)[:, :count]
    which = f"{share(int(away.sum()), len(away))} frames, from frame {int(away.nonzero()[0])} on"
    note = f"the whole body leaps away and back: left out as somebody else's: {which}"
    return rebuilt(tracks, tracks.points[:, :count], weights, note)


def without_strange_limbs(tracks: Tracks, *, swapped: bool = False) -> Tracks:
    """Tracks in which joints that are elsewhere by themselves (:func:`limbs_elsewhere`) are unseen; a note says which.

    Args:
        tracks: of which some may be.
        swapped: whether left and right may have changed places in them, which is another's to mend.
    """
    count = tracks.skeleton.num_observed
    seen = tracks.seen[:, :count]
    twins = [pair for pair in tracks.skeleton.mirror if max(pair) < count] if swapped else []
    away = limbs_elsewhere(
        tracks.points[:, :count], seen, tracks.fps or SLOW, twins, quick=1.0 if tracks.skeleton.mirror else QUICK
    )
    if not bool(away.any()):
        return tracks
    names = listed([tracks.skeleton.joints[n] for n in away.any(0).nonzero().flatten().tolist()], 6)
    which = f"{share(int(away.sum()), int(seen.sum()))} detections, of {names}"
    note = f"joints leap away, or back, by themselves: taken as unseen meanwhile: {which}"
    return rebuilt(tracks, tracks.points[:, :count], torch.where(away, 0, tracks.weights[:, :count]), note)
