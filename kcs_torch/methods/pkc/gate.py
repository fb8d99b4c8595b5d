"""Detections that no body of usual proportions, or not this body, could make."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from kcs_torch.clean.common import rebuilt, share
from kcs_torch.errors import listed
from kcs_torch.functional.chain import bone_vectors, chain_inverse, incidence
from kcs_torch.functional.ranks import nanmedian
from kcs_torch.skeleton import Skeleton
from kcs_torch.types import Tracks

__all__ = [
    "at_border", "doubled", "plausible", "repeats", "without_border", "without_doubled", "without_repeats",
]  # fmt: skip

LONG = 2.0
"""An image longer than so many usual lengths is no bone's."""

SHORTER, AROUND = 2.5, 8
"""The longest images of bones are no more than so many times the median of these frames about each, or of the clip."""

ROUNDS = 4
"""Times that what is left is looked at again."""

COMPARED, MOSTLY, COARSE, APART = 32, 0.9, 30.0, 0.1
"""Frames of which all pairs of joints are compared at first, those that show most; joints that repeat another do so in
this share of the frames that show them; and they would be apart by so many steps of the image's grid, and by this share
of the body's size."""

SELDOM = 3
"""Joints that are seen in fewer frames tell nothing of their bones' lengths."""

OFTEN, HELD, MOVED = 0.12, 6, 0.002
"""Frames that repeat the one before are a slower camera's if this share of all does, no more than so many on end, and
if most joints move by this share of the body's size where they move: those of somebody who stands still are not. More
on end are a detector's that has lost the body if this moved by as much just before: somebody who stops slows down."""

PADDED = 0.15
"""A clip that shows its last pose on for less than this share of its frames only goes on for longer than its motion:
that the body stands there is as good a guess as any, and the other frames still tell what noise there is."""

JUST, SLOWS = 3, 0.5
"""The last step is less than this share of the median of so many before it."""

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


def doubled(points: Tensor, seen: Tensor, skeleton: Skeleton) -> list[int]:
    """Joints that lie exactly where another lies whenever both are seen, as where a format has none of its own.

    Of two that are well apart in a template, and not joined by a bone that changes its length, the one that more bones
    lead to is no joint. Of a left and a right one, or others as far out, either may be, so that both are left out; but
    none that is often seen without the other. Nothing is said where half of the joints are such, of a point, say, nor
    where the image's grid is coarse for the body: there joints meet.

    Args:
        points: (T, N, 2).
        seen: (T, N) bool.
        skeleton: whose first joints they are.
    """
    if skeleton.template is None or not skeleton.is_tree or not bool(seen.any()):
        return []
    some = seen.sum(1).argsort(descending=True)[:COMPARED]
    place, shown = points[some], seen[some]
    both = shown[:, :, None] & shown[:, None]
    same = (place[:, :, None] == place[:, None]).all(-1)
    pairs = (both & same).any(0) & ~(both & ~same).any(0)
    rest = skeleton.template_points(dtype=points.dtype, device=points.device)[: points.shape[1]]
    known = torch.where(seen[..., None], points, torch.nan)
    size = (known - nanmedian(known, 1, keepdim=True)).norm(dim=-1).nanmedian()
    apart = (rest[:, None] - rest).norm(dim=-1) / (rest - rest.median(0).values).norm(dim=-1).median() * size
    pairs &= (apart > COARSE * _grid(points[seen])) & (apart > APART * size)
    loose = skeleton.bone_index(device=points.device)[~skeleton.rigid_mask(device=points.device)]
    loose = loose[(loose < len(rest)).all(1)]  # as those to wrists that hands have of their own
    pairs[loose[:, 0], loose[:, 1]] = pairs[loose[:, 1], loose[:, 0]] = False
    out = torch.zeros_like(seen[0])
    ends = incidence(skeleton.bone_index(device=points.device), skeleton.num_joints, dtype=points.dtype)
    far = chain_inverse(ends).abs().sum(1)  # in bones, from the middle of all joints
    for a, b in pairs.triu(1).nonzero().tolist():
        both = seen[:, a] & seen[:, b]
        if int(both.sum()) < SELDOM or bool((points[both, a] != points[both, b]).any()):
            continue
        for one, other in ((a, b), (b, a)):
            alone = int(both.sum()) < MOSTLY * int(seen[:, one].sum())
            rarer = int(both.sum()) < MOSTLY * int(seen[:, other].sum())
            out[one] |= not alone and (rarer or bool(far[one] > far[other] - 0.1))
    return out.nonzero().flatten().tolist() if 2 * int(out.sum()) < len(out) else []


def _grid(places: Tensor) -> float:
    """The finest power of ten, from 1 down to .001, of which all numbers are multiples; 0 if there is none."""
    for grid in (1.0, 0.1, 0.01, 0.001):
        if bool(((places / grid).round() * grid - places).abs().amax() < 1e-3 * grid):
            return grid
    return 0.0


def without_doubled(tracks: Tracks) -> Tracks:
    """Tracks in which joints that only repeat others (:func:`doubled`) are unseen; a note says which."""
    count, names = tracks.skeleton.num_observed, tracks.skeleton.joints
    out = doubled(tracks.points[:, :count], tracks.seen[:, :count], tracks.skeleton)
    if not out:
        return tracks
    weights = tracks.weights[:, :count].clone()
    weights[:, out] = 0
    which = f"{listed([names[joint] for joint in out], 6)}: exactly where another joint is wherever both are seen"
    return rebuilt(tracks, tracks.points[:, :count], weights, f"{which}: taken as unseen")


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
    """Frames (T,) in which a slower camera, or a detector at a loss, only shows what the frame before did.

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
    if not bool(same.any()) or not bool(new.any()):
        return none
    known = torch.where(seen[..., None], points, torch.nan)
    size = (known - nanmedian(known, 1, keepdim=True)).norm(dim=-1).nanmedian()
    step = nanmedian((known[1:] - known[:-1]).norm(dim=-1), 1)
    before = torch.nn.functional.pad(step, (JUST, 0), value=torch.nan)[:-1].unfold(0, JUST, 1)
    moves = torch.cat([none[:1], new & (step > MOVED * size) & ~(step < SLOWS * nanmedian(before, -1))])
    start = torch.where(same, 0, torch.arange(1, len(same) + 1, device=same.device)).cummax(0).values - 1
    ends = torch.cat([~same[1:], ~none[:1]]) & same
    long = torch.zeros_like(same)
    long[start[ends & (length > HELD)]] = True
    long = same & long[start]
    frozen = long & moves[start]
    slow = same & ~long
    padding = frozen & (start == start[-1])
    if int(padding.sum()) < PADDED * int(shown.sum()):
        frozen = frozen & ~padding
    often = int(slow.sum()) >= OFTEN * int(shown.sum()) and not bool((long & ~frozen).any())
    return frozen | slow if often and bool(step[new].nanmedian() > MOVED * size) else frozen


def without_repeats(tracks: Tracks) -> Tracks:
    """Tracks in which frames that only :func:`repeats` the one before show nothing; a note says how many."""
    count = tracks.skeleton.num_observed
    same = repeats(tracks.points[:, :count], tracks.seen[:, :count])
    if not bool(same.any()):
        return tracks
    weights = torch.where(same[:, None], 0, tracks.weights)[:, :count]
    which = f"{share(int(same.sum()), len(same))} frames repeat the one before"
    note = f"{which}, as of a slower camera, or a detector that has lost the body: taken as unseen"
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
