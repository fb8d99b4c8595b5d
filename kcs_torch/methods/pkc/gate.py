"""Detections that no body of usual proportions, or not this body, could make."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from kcs_torch.clean.common import rebuilt, share
from kcs_torch.functional.chain import bone_vectors, chain_inverse, incidence
from kcs_torch.functional.ranks import nanmedian
from kcs_torch.skeleton import Skeleton
from kcs_torch.types import Tracks

__all__ = ["at_border", "elsewhere", "plausible", "repeats", "without_border", "without_others", "without_repeats"]

LONG = 2.0
"""An image longer than so many usual lengths is no bone's."""

SHORTER, AROUND = 2.5, 8
"""The longest images of bones are no more than so many times the median of these frames about each, or of the clip."""

ROUNDS = 4
"""Times that what is left is looked at again."""

SELDOM = 3
"""Joints that are seen in fewer frames tell nothing of their bones' lengths."""

LEAP, SUDDEN = 1.0, 4.0
"""From one frame to the next the whole body leaps where it moves by more than so many times its size, the median
distance of joints from their middle, and by so many times what it moves in the frames beside: a hand that snaps aside
takes several frames to do so."""

BACK, PART = 0.5, 0.25
"""What leaps away and back ends where it began, but for this share of its leaps, and is away for this share of the
clip at most."""


OFTEN, HELD, MOVED = 0.12, 6, 0.002
"""Frames that repeat the one before are a slower camera's if this share of all does, no more than so many on end, and
if most joints move by this share of the body's size where they move: those of somebody who stands still are not."""

CROWDED = 5
"""An outermost line of the tracks is the image's border where so many times as many places lie on it as on any other:
of whole pixels some share a line, of finer ones none."""


def at_border(points: Tensor, seen: Tensor, feet: Sequence[int] = ()) -> Tensor:
    """Detections (T, N) that lie on the image's border, where a detector puts joints that are outside.

    The border is not known: it is an outermost row or column on which many places lie that differ. Feet alone may stand
    on a floor; and a line on which one joint lies in every frame is the box around a body that was scaled to it, or a
    rail.

    Args:
        points: (T, N, 2).
        seen: (T, N) bool.
        feet: joints that touch the ground.
    """
    out = torch.zeros_like(seen)
    above = seen.new_ones(seen.shape[1])
    above[list(feet)] = False
    for axis in (0, 1) if bool(seen.any()) else ():
        place = points[seen].roll(axis, -1)  # (K, 2), first across the border
        ends = place[:, 0].aminmax()
        if max(int((place[:, 0] == end).sum()) for end in ends) < CROWDED:
            continue
        lines, crowd = place.unique(dim=0)[:, 0].unique(return_counts=True)
        if len(lines) < 3:
            continue
        for end in (0, -1):
            on = seen & (points[..., axis] == lines[end])
            boxed = bool((on.sum(1) == 1)[seen.any(1)].all())
            if bool(crowd[end] >= CROWDED * crowd[1:-1].amax()) and bool((on & above).any()) and not boxed:
                out |= on
    return out


def without_border(tracks: Tracks) -> Tracks:
    """Tracks in which joints :func:`at_border` are unseen; a note says how many."""
    count = tracks.skeleton.num_observed
    seen = tracks.seen[:, :count]
    on = at_border(tracks.points[:, :count], seen, [joint for joint in tracks.skeleton.contacts if joint < count])
    if not bool(on.any()) or not bool((seen & ~on).any()):
        return tracks
    weights = torch.where(on, 0, tracks.weights[:, :count])
    which = f"{share(int(on.sum()), int(seen.sum()))} detections lie on the image's border"
    return rebuilt(
        tracks, tracks.points[:, :count], weights, f"{which}: taken as unseen, as joints outside are put there"
    )


def repeats(points: Tensor, seen: Tensor) -> Tensor:
    """Frames (T,) in which a slower camera, or detector, only shows what the frame before did.

    Args:
        points: (T, N, 2).
        seen: (T, N) bool.
    """
    none = torch.zeros(len(points), dtype=torch.bool, device=points.device)
    shown = seen.sum(-1) > 1
    equal = ((points[1:] == points[:-1]).all(-1) | ~seen[1:]) & (seen[1:] == seen[:-1])
    same = torch.cat([none[:1], equal.all(-1) & shown[1:]])
    length = torch.zeros_like(points[:, 0, 0])  # of the run of repeats up to each frame
    for _ in range(HELD + 1):
        length = torch.where(same, 1 + torch.cat([length[:1], length[:-1]]), 0)
    new = shown[1:] & shown[:-1] & ~same[1:]
    if int(same.sum()) < OFTEN * int(shown.sum()) or bool((length > HELD).any()) or not bool(new.any()):
        return none
    known = torch.where(seen[..., None], points, torch.nan)
    size = (known - nanmedian(known, 1, keepdim=True)).norm(dim=-1).nanmedian()
    step = nanmedian((known[1:] - known[:-1]).norm(dim=-1), 1)[new].nanmedian()
    return same if bool(step > MOVED * size) else none


def without_repeats(tracks: Tracks) -> Tracks:
    """Tracks in which frames that only :func:`repeats` the one before show nothing; a note says how many."""
    count = tracks.skeleton.num_observed
    same = repeats(tracks.points[:, :count], tracks.seen[:, :count])
    if not bool(same.any()):
        return tracks
    weights = torch.where(same[:, None], 0, tracks.weights)[:, :count]
    which = f"{share(int(same.sum()), len(same))} frames repeat the one before, as of a slower camera or detector"
    return rebuilt(tracks, tracks.points[:, :count], weights, f"{which}: taken as unseen")


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
    k = 0
    while k + 1 < len(leaps):
        first, last = leaps[k], leaps[k + 1]
        gap, least = nanmedian(known[last + 1] - known[first], 0).norm(), torch.minimum(step[first], step[last])
        beside = [step[i] for i in (first - 1, first + 1, last - 1, last + 1) if i not in (first, last, -1, len(step))]
        sudden = all(bool(least > SUDDEN * one) for one in beside)
        if last - first <= PART * len(shown) and sudden and bool(gap < BACK * least):
            away[shown[first] + 1 : shown[last] + 1] = True
            k += 1
        k += 1
    return away


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


def plausible(points: Tensor, seen: Tensor, skeleton: Skeleton) -> Tensor:
    """Which detections to keep, (T, N): joints are dropped out of the body's reach, or where all bones are too long.

    What is too long is told by the skeleton's usual lengths, at the scale at which most bones look as long as they are.
    Joints that are then left in hardly any frame are dropped altogether, as long as others are seen often.

    Args:
        points: (T, N, 2).
        seen: (T, N) bool.
        skeleton: of the N joints.

    Returns:
        (T, N), False where unseen.
    """
    often = seen.sum(0) >= SELDOM
    if bool(often.any()):
        seen = seen & often
    usual = skeleton.relative_lengths(dtype=points.dtype, device=points.device)
    if usual is None:
        return seen
    bones = skeleton.bone_index(device=points.device)
    use = skeleton.rigid_mask(device=points.device) & (usual > 0)
    kept, reach = seen, _reach(skeleton, usual)
    for _ in range(ROUNDS):  # what is dropped no longer spoils the scale
        before, scale = kept, _scale(points, kept, bones[use], usual[use])
        if scale is None:
            break
        if reach is not None:
            middle = nanmedian(torch.where(kept[..., None], points, torch.nan), 1, keepdim=True)
            kept = kept & ~((points - middle).norm(dim=-1) > LONG * scale[:, None] * reach)
        both = kept[:, bones[:, 0]] & kept[:, bones[:, 1]]
        length = bone_vectors(points, bones).norm(dim=-1)
        far = both & use & (length > LONG * scale[:, None] * usual)
        count = torch.zeros_like(points[..., 0])
        wrong = count.clone()
        for end in (0, 1):
            count = count.index_add(1, bones[:, end], both.to(count))
            wrong = wrong.index_add(1, bones[:, end], far.to(count))
        kept = kept & ~((wrong > 0) & (wrong == count))
        if torch.equal(kept, before):
            break
    often = kept.sum(0) >= SELDOM
    return kept & often if bool(often.any()) else kept


def _scale(points: Tensor, seen: Tensor, bones: Tensor, usual: Tensor) -> Tensor | None:
    """Per frame (T,), at which scale most bones (B, 2) look as long as is usual (B,); None where none is seen.

    The longest images of each bone tell, but what is wrong may be most of these.
    """
    both = seen[:, bones[:, 0]] & seen[:, bones[:, 1]]
    if not bool(both.any()):
        return None
    images = torch.where(both, bone_vectors(points, bones).norm(dim=-1) / usual, torch.nan)
    longest = nanmedian(images.nanquantile(0.985, 0), 0)
    here = torch.nn.functional.pad(nanmedian(images, 1), (AROUND, AROUND), value=torch.nan)
    here = nanmedian(here.unfold(0, 2 * AROUND + 1, 1), 1)
    return torch.minimum(longest, SHORTER * torch.fmax(here, nanmedian(here, 0)))


def _reach(skeleton: Skeleton, usual: Tensor) -> Tensor | None:
    """How far from the middle of all joints each may be (N,), by lengths (B,) of bones; None unless these are a tree.

    Half of the joints lie on the other side of the median, whatever the direction.
    """
    if not skeleton.is_tree:
        return None
    ends = incidence(skeleton.bone_index(device=usual.device), skeleton.num_joints, dtype=usual.dtype)
    lines = chain_inverse(ends)  # (N, B) the bones on the way to each joint
    return ((lines[:, None] - lines).abs() @ usual).median(1).values
