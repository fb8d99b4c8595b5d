"""Left and right that a detector mistakes for each other, swapped back."""

from __future__ import annotations

from itertools import pairwise

import torch
from torch import Tensor

from kcs_torch.clean.common import check_tracks, rebuilt, runs, share
from kcs_torch.clean.timing import shots_of
from kcs_torch.functional.ranks import nanmedian
from kcs_torch.nn.posture import trunk_joints
from kcs_torch.skeleton import Skeleton
from kcs_torch.skeleton.graph import find_branches, find_pieces
from kcs_torch.solvers.stray import body_size, from_beside
from kcs_torch.solvers.swaps import swapped_frames
from kcs_torch.types import Tracks

__all__ = ["unswap"]

_BODY, _LIMB = 16.0, 8.0
"""What a change costs that all pairs of joints make, and those of a limb."""

_FAR, _MANY = 1.0, 0.05
"""A pair that lies so many body sizes from where it is just before and just after, on either side, tells nothing where
there is more than this share of such pairs. What is swapped for a moment may be as far off."""

_FEWEST = 2
"""Pairs of joints of which a limb consists, at least: one pair by itself may be an outlier."""

_BRANCHES = 4
"""Fingers of a hand, at least."""

_LONG, _RATE = 1.0, 30.0
"""A limb that points from right to left as the trunk does, for so many seconds more than it does not, is not swapped;
and the frames a second where tracks do not tell. Legs stay crossed for less."""


_AHEAD, _TIMES, _AROUND, _RARE = 0.05, 5.0, 3, 0.05
"""A longer step of most joints than around, which differs by such a share of the body's size, and so many times as much
as usual, from those of so many frames before and after: frames were dropped, or one was repeated, and legs have moved
on meanwhile. If more than such a share of the frames has one, that is how these tracks move."""


def unswap(tracks: Tracks) -> Tracks:
    """Swap left and right back where a detector mistakes them for each other; a note says in how many frames.

    First all pairs of joints together, of which those of fingers, who would outvote all others, tell nothing; then the
    arms, the legs, the hands and other limbs by themselves, without the joints of the trunk
    (:func:`kcs_torch.solvers.swapped_frames`). A pair that is mistaken jumps to the other side, while legs that
    cross move on evenly. Where a clip is half swapped, the longer part is taken to be right. A limb stays as it is if
    it would be crossed for a second: it jumped as the body did, in a turn, or comes back slowly from a swap. Where the
    whole body leaps ahead, as frames were dropped or one was repeated, what a limb does at this moment tells nothing.

    Args:
        tracks: of a skeleton that has a left and a right; those of others are returned as they are.

    Returns:
        Tracks whose joints have changed places, weights included; the very same tracks if nothing is swapped.

    >>> from kcs_torch.data.synthetic import walking_person
    >>> tracks = walking_person(60, yaw=20).tracks
    >>> left, right = torch.tensor(tracks.skeleton.mirror).T
    >>> both = torch.cat([left, right])
    >>> tracks.points[20:25, both] = tracks.points[20:25, torch.cat([right, left])]
    >>> unswap(tracks).notes[-1]
    'unswap: left and right swapped back in 5 of 60 (8.3 %) frames'
    """
    check_tracks(tracks, "unswap")
    body, count = tracks.skeleton, tracks.skeleton.num_observed
    pairs = [pair for pair in body.mirror if max(pair) < count]
    if len(pairs) < _FEWEST or not tracks.num_frames:
        return tracks
    points, weights = tracks.points[:, :count].clone(), tracks.weights[:, :count].clone()
    shots, views = (  # another view is no swap, and another body's sides are its own
        [(shot, float(body_size(points[None, shot], weights[None, shot] > 0))) for shot in shots_of(tracks, leaps=some)]
        for some in (False, True)
    )
    leaps = [_leaps_ahead(points[shot], weights[shot] > 0, pairs, size) for shot, size in shots]
    fingers = _fingers(body)
    limbs = _limbs(body, pairs, fingers)
    trunk = [pair for pair in pairs if not any(pair in limb for _, limb in limbs)]
    long = _LONG * (tracks.fps or _RATE)
    telling = [pair for pair in pairs if pair[0] not in fingers]
    counts = {}
    for name, some in (("", telling if len(telling) >= _FEWEST else pairs), *limbs):
        left, right = torch.tensor(some, device=points.device).T
        swapped = []
        for k, (shot, size) in enumerate(shots if name else views):
            here, trust = points[shot], weights[shot]
            seen = _comparable(here, trust, left, right, size)
            found = swapped_frames(here[:, left], here[:, right], seen, size, _LIMB if name else _BODY)
            if name and trunk:
                across, straight = (_across(here, trust, these) for these in (some[:1], trunk))
                _keep_straight(found, across, straight, long)
            if name:
                _through_leaps(found, seen.any(1), leaps[k])
            swapped.append(found)
        frames = torch.cat(swapped).nonzero()  # (F, 1)
        left, right = torch.tensor(some if name else pairs, device=points.device).T
        for values in (points, weights):
            values[frames, left], values[frames, right] = values[frames, right], values[frames, left]
        counts[name] = len(frames)
    if not any(counts.values()):
        return tracks
    note = f"unswap: left and right swapped back in {share(counts.pop(''), tracks.num_frames)} frames"
    alone = ", ".join(f"from {name} on in {count}" for name, count in counts.items() if count)
    return rebuilt(tracks, points, weights, note + (f"; of limbs by themselves, {alone}" if alone else ""))


def _comparable(points: Tensor, weights: Tensor, left: Tensor, right: Tensor, size: float) -> Tensor:
    """(T, P), which pairs of joints are seen, less those that jump about in some frames, if there are many."""
    seen = (weights[:, left] > 0) & (weights[:, right] > 0)
    apart = torch.where(seen[..., None], points[:, left] - points[:, right], torch.nan)
    near = seen & ~(from_beside(apart, mirrored=True) > _FAR * size)  # NaN is not above
    if int(near.sum()) >= (1 - _MANY) * int(seen.sum()):
        return seen
    lone = near.sum(1) < torch.minimum(seen.sum(1), seen.new_tensor(_FEWEST, dtype=torch.long))
    return near & ~lone[:, None]


def _leaps_ahead(points: Tensor, seen: Tensor, pairs: list[tuple[int, int]], size: float) -> list[int]:
    """Frames to which most joints (T, N, 2) step farther than around; of twins the middle, which no swap moves."""
    left, right = torch.tensor(pairs, device=points.device).T
    both = seen[:, left] & seen[:, right]
    middle = torch.where(both[..., None], (points[:, left] + points[:, right]) / 2, torch.nan)
    twins = {joint for pair in pairs for joint in pair}
    alone = [n for n in range(points.shape[1]) if n not in twins]
    others = torch.where(seen[:, alone, None], points[:, alone], torch.nan)
    step = nanmedian(torch.cat([middle, others], 1).diff(dim=0), 1)  # (T - 1, 2)
    if not len(step):
        return []
    beside = torch.nn.functional.pad(step, (0, 0, _AROUND, _AROUND), value=torch.nan)
    around = nanmedian(beside.unfold(0, 2 * _AROUND + 1, 1), -1)
    away = (step - around).norm(dim=-1)
    leaps = (away > _AHEAD * size) & (away > _TIMES * nanmedian(away, 0))  # NaN is not above
    leaps &= step.norm(dim=-1) > around.norm(dim=-1)  # who stands still for a frame does not
    return leaps.nonzero().flatten().add(1).tolist() if int(leaps.sum()) <= _RARE * len(points) else []


def _through_leaps(swapped: Tensor, shown: Tensor, leaps: list[int]) -> None:
    """Take back, in (T,), what changes where the whole body leaps ahead: from one to the next most frames are right.

    Frames count that are shown, (T,); a limb that is swapped for a moment is swapped still.
    """
    changes = [leap for leap in leaps if 0 < leap < len(swapped) and bool(swapped[leap] != swapped[leap - 1])]
    for start, end in pairwise([0, *changes, len(swapped)]):
        part = slice(start, end)
        if 2 * int(swapped[part].sum()) > int(shown[part].sum()):
            swapped[part] = ~swapped[part] & shown[part]


def _across(points: Tensor, weights: Tensor, pairs: list[tuple[int, int]]) -> Tensor:
    """(T, 2) from right to left in the image, summed over the pairs that are seen; 0 where none is."""
    left, right = torch.tensor(pairs, device=points.device).T
    seen = (weights[:, left] > 0) & (weights[:, right] > 0)
    return torch.where(seen[..., None], points[:, left] - points[:, right], 0.0).sum(1)


def _keep_straight(swapped: Tensor, across: Tensor, straight: Tensor, long: float) -> None:
    """Unset, in place, the runs of (T,) in which a limb points across the image (T, 2) as the trunk does, in sum."""
    both, most = (across * straight).sum(-1), across.norm(dim=-1) * straight.norm(dim=-1)
    for start, end in runs(swapped.cpu().numpy()):
        run = slice(start, end)
        if bool(both[run].sum() * (end - start) > long * most[run].sum()):  # the mean cosine by the frames
            swapped[run] = False


def _limbs(body: Skeleton, pairs: list[tuple[int, int]], fingers: set[int]) -> list[tuple[str, list[tuple[int, int]]]]:
    """Pairs of joints outside the trunk that are connected, those that hang on it first, by the first joints' names.

    All fingers together are a limb of their own.
    """
    parent = {b: a for a, b in body.bones}
    trunk = set(trunk_joints(body)) or {a for a, _ in pairs if body.side(parent.get(a, a)) != "left"}
    twin = {a: b for a, b in pairs if a not in trunk}
    inner = twin.keys() - fingers
    pieces = find_pieces(body.num_joints, [bone for bone in body.bones if inner >= set(bone)])
    outer = [sorted(piece, key=lambda a: parent.get(a) in twin) for piece in pieces]
    limbs = [[(a, twin[a]) for a in piece if a in inner] for piece in outer]
    limbs.append([(a, b) for a, b in twin.items() if a in fingers])
    return [(body.joints[limb[0][0]], limb) for limb in limbs if len(limb) >= _FEWEST]


def _fingers(body: Skeleton) -> set[int]:
    """The joints of all that branches as a hand does: into so many parts that have joints of their own."""
    fingers: set[int] = set()
    for wrist, branches in find_branches(body.bones).items() if body.is_tree else ():
        long = [branch for branch in branches if len(branch) > 1]
        if len(long) >= _BRANCHES and body.side(wrist) in ("left", "right"):
            fingers.update(joint for branch in long for joint in branch)
    return fingers
