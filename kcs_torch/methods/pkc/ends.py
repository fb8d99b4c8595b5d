"""Joints at a body's ends that no frame shows: what others tell is found without them, and they are placed afterwards.

Solved with the rest, they would be so many witnesses of what nobody saw: forty fingers that a whole-body format has,
and that a detector did not find, bend the arms that they hang on.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Iterator, Sequence
from dataclasses import replace

import torch
from torch import Tensor

from kcs_torch.errors import KcsWarning, counted, listed, users_level
from kcs_torch.functional.align import centre, procrustes
from kcs_torch.functional.chain import bone_lengths
from kcs_torch.functional.inference import plain
from kcs_torch.methods.answer.root import ABSENT
from kcs_torch.methods.base import Estimate, apart
from kcs_torch.methods.pkc.hands import Part, hands_of, is_shown, without_joints
from kcs_torch.nn.posture import has_trunk, trunk_joints
from kcs_torch.skeleton import Skeleton
from kcs_torch.skeleton.graph import direct_bones
from kcs_torch.types import Reconstruction, Tracks
from kcs_torch.types.tracks import never_seen, unseen_notes

__all__ = ["ends_of", "estimate_with_ends", "with_ends", "without_ends"]

RARE = 0.15
"""Share of the frames that show anything of a hand, up to which its fingers are taken as unseen."""

TAKEN = "its fingers are taken as unseen"
"""How the note ends that says so."""

ANYWHERE = 3**-0.5
"""Root mean square of the depth of a bone that may point anywhere, over its length."""


def ends_of(tracks: Tracks) -> list[int]:
    """Joints that no frame shows and on which nothing hangs that one does; and fingers of hands that few frames show.

    The trunk's are none, nor is what a virtual joint is the mean of, nor single fingers of a hand that is shown. Nor is
    what has a twin that is none, but for fingers: a limb tells of its twin, whose lengths and postures are alike.
    """
    body = tracks.skeleton
    if not has_trunk(body) or not bool(tracks.seen.any()):
        return []
    gone = ~tracks.seen.any(0)
    fingers: set[int] = set()
    for hand in hands_of(body):
        fingers.update(hand.joints[1:])
        if _is_rare(tracks, hand):
            gone[list(hand.joints[1:])] = True
        elif is_shown(tracks, hand.joints):
            gone[list(hand.joints[1:])] = False
    trunk = trunk_joints(body)
    kept = {joint for _, sources in body.virtual for joint in sources} | set(trunk)
    free = {joint for joint in gone.nonzero().flatten().tolist() if joint < body.num_observed and joint not in kept}
    inward = list(_outward(body, trunk))[::-1] if free else []
    twins = [pair for pair in body.mirror if not fingers.issuperset(pair)]
    while True:
        ends = set(free)
        for _, parent, joint in inward:
            if joint not in ends:
                ends.discard(parent)
        alone = {joint for pair in twins if len(ends.intersection(pair)) == 1 for joint in pair} & ends
        if not alone:
            return sorted(ends)
        free -= alone


def without_ends(tracks: Tracks) -> Tracks:
    """The tracks of all other joints than :func:`ends_of`; the same if there are none."""
    ends = set(ends_of(tracks))
    if not ends:
        return tracks
    body = tracks.skeleton
    joints = [joint for joint in range(tracks.num_joints) if joint not in ends]
    rest = replace(
        tracks,
        points=tracks.points[:, joints],
        weights=tracks.weights[:, joints],
        skeleton=without_joints(body, joints),
        notes=tuple(note for note in tracks.notes if note not in unseen_notes(tracks.weights, body)),
    )
    rare = [
        f"{body.joints[hand.joints[0]]}: {_showing(tracks, hand)} of {counted(tracks.num_frames, 'frame')} "
        f"{'shows' if _showing(tracks, hand) == 1 else 'show'} the hand: {TAKEN}"
        for hand in hands_of(body)
        if hand.joints[1] in ends and _showing(tracks, hand)
    ]
    return replace(rest, notes=(*rest.notes, *unseen_notes(rest.weights, rest.skeleton), *rare))


def _showing(tracks: Tracks, hand: Part) -> int:
    """How many frames show anything of a hand's fingers."""
    return int(tracks.seen[:, list(hand.joints[1:])].any(1).sum())


def _is_rare(tracks: Tracks, hand: Part) -> bool:
    """Whether hardly any frame shows anything of a hand, too few to find it by itself."""
    return _showing(tracks, hand) <= RARE * tracks.num_frames and not is_shown(tracks, hand.joints)


def with_ends(result: Reconstruction, tracks: Tracks) -> Reconstruction:
    """What was found :func:`without_ends`, with these placed as the template has them on what they hang on.

    Args:
        result: of some of the tracks' joints.
        tracks: with all of them.

    Warns:
        KcsWarning: which joints were never seen.
    """
    with apart([tracks], differentiates=False):
        made = _with_ends(result, tracks)
    solved = torch.zeros_like(tracks.weights)  # of others, which no frame shows either, the method has told
    solved[:, _kept(tracks.skeleton, result.skeleton)] = 1
    for gone in never_seen(solved, tracks.skeleton):
        warnings.warn(f"{tracks.source}: {gone}", KcsWarning, stacklevel=users_level())
    return plain(made)


def _with_ends(result: Reconstruction, tracks: Tracks) -> Reconstruction:
    """:func:`with_ends`, of which nobody is told."""
    body, some = tracks.skeleton, result.skeleton
    kept = _kept(body, some)
    points, weights = torch.zeros_like(tracks.points), torch.zeros_like(tracks.weights)
    points[:, kept], weights[:, kept] = result.tracks.points, result.tracks.weights
    notes = [note for note in result.tracks.notes if note not in unseen_notes(result.tracks.weights, some)]
    whole = replace(result.tracks, points=points, weights=weights, skeleton=body)
    whole = replace(whole, notes=(*notes, *unseen_notes(weights, body)))

    def grown(one: Reconstruction) -> Reconstruction:
        points, unsure = _placed(one.points, one.uncertainty, kept, body)
        facts = replace(one.diagnostics, unseen_share=whole.unseen_share, notes=_on_contacts(one, body))
        one = _about_its_middle(replace(one, points=points, uncertainty=unsure, tracks=whole, diagnostics=facts))
        return replace(one, alternatives=tuple(grown(other) for other in one.alternatives)).remeasured()

    return grown(result)


def estimate_with_ends(found: Estimate, shown: Tracks, tracks: Tracks) -> Estimate:
    """As :func:`with_ends`, of an estimate of the tracks that were ``shown`` to the method as one of all joints."""
    some, body = shown.skeleton, tracks.skeleton
    kept = _kept(body, some)
    points, unsure = _placed(found.points, found.deviation, kept, body)
    standing = found.standing
    if standing is not None:
        names = [some.joints[joint] for joint in some.contacts]
        standing = standing.new_zeros(len(standing), len(body.contacts))
        for k, joint in enumerate(body.contacts):
            if body.joints[joint] in names:
                standing[:, k] = found.standing[:, names.index(body.joints[joint])]  # type: ignore[index]
    return replace(
        found,
        points=points - points.mean(1, keepdim=True),
        deviation=unsure,
        standing=standing,
        notes=(*found.notes, *(note for note in shown.notes if note.endswith(TAKEN))),
        alternatives=tuple(estimate_with_ends(other, shown, tracks) for other in found.alternatives),
    )


def _kept(body: Skeleton, some: Skeleton) -> list[int]:
    """Indices in a body of the joints that a part of it has."""
    return [body.joints.index(joint) for joint in some.joints]


def _placed(points: Tensor, unsure: Tensor | None, kept: Sequence[int], body: Skeleton) -> tuple[Tensor, Tensor | None]:
    """All joints (T, N, 3) of a body, of those that are kept (T, K, 3), and their deviations (T, N).

    An end goes on from the joint that it hangs on as the template has it, turned as the trunk is and then, with what it
    hangs on, as little as it takes: a hand follows the forearm.
    """
    full = points.new_zeros(len(points), body.num_joints, 3)
    full[:, kept] = points
    variance = points.new_zeros(full.shape[:2])
    if unsure is not None:
        variance[:, kept] = unsure.square()
    rest = body.template_points(dtype=points.dtype, device=points.device)
    there, trunk = set(kept), trunk_joints(body)
    bones = body.bone_index(device=points.device)[[k for k, b in enumerate(body.bones) if there.issuperset(b)]]
    size = (bone_lengths(full, bones).median(0).values / bone_lengths(rest, bones)).median()
    at_rest, now = centre(rest[trunk])[0], centre(full[:, trunk])[0]
    upright, _ = procrustes(at_rest.expand_as(now), now)  # (T, 3, 3) of rows
    turned = dict.fromkeys(trunk, upright)
    for number, parent, joint in _outward(body, trunk):
        bone = rest[joint] - rest[parent]
        turn = turned[parent]
        if joint in there:
            turned[joint] = turn @ _least_turn((bone @ turn), full[:, joint] - full[:, parent]).mT
            continue
        full[:, joint] = full[:, parent] + size * (bone @ turn)
        turned[joint] = turn
        stray = 1.0 if body.spread is None else math.sin(math.radians(body.spread[number]))
        deep = min(stray * 2**-0.5, ANYWHERE)  # half of its square goes in depth
        variance[:, joint] = variance[:, parent] + (size * bone.norm() * deep).square()
    return full, None if unsure is None else variance.sqrt()


def _outward(body: Skeleton, trunk: Sequence[int]) -> Iterator[tuple[int, int, int]]:
    """Bones outside the trunk, each with its number, and after the one that it hangs on."""
    reached, left = set(trunk), dict(enumerate(direct_bones(body.bones, trunk[0])))
    while left:
        for number, (parent, joint) in list(left.items()):
            if parent in reached:
                del left[number]
                if joint not in reached:
                    reached.add(joint)
                    yield number, parent, joint


def _least_turn(start: Tensor, end: Tensor) -> Tensor:
    """The least rotation (..., 3, 3) that takes the direction of one vector to that of another, by columns."""
    tiny = torch.finfo(start.dtype).tiny
    a, b = (x / x.norm(dim=-1, keepdim=True).clamp_min(tiny) for x in (start, end))
    half = a + b
    beside = torch.nn.functional.one_hot(a.abs().argmin(-1), 3).to(a)
    opposite = half.norm(dim=-1, keepdim=True) < torch.finfo(a.dtype).eps ** 0.5
    half = torch.where(opposite, torch.linalg.cross(a, beside, dim=-1), half)
    half = half / half.norm(dim=-1, keepdim=True).clamp_min(tiny)
    eye = torch.eye(3, dtype=start.dtype, device=start.device)
    turns = [2 * axis[..., :, None] * axis[..., None, :] - eye for axis in (half, a)]  # half a turn about each
    known = (a.norm(dim=-1) > 0) & (b.norm(dim=-1) > 0)
    return torch.where(known[..., None, None], turns[0] @ turns[1], eye)


def _about_its_middle(one: Reconstruction) -> Reconstruction:
    """The same in space, with depths about the middle of all joints, which goes along the root's path."""
    middle = one.points[..., 2].mean(1)
    points = one.points - torch.nn.functional.pad(middle[:, None, None], (2, 0))
    path, away = one.root_depth, one.distance
    scales = one.scales if away is None else one.scales * away / (away + middle)
    path, away = None if path is None else path + middle - middle[0], None if away is None else away + middle
    return replace(one, points=points, scales=scales, root_depth=path, distance=away)


def _on_contacts(one: Reconstruction, body: Skeleton) -> tuple[str, ...]:
    """The notes, which do not say of a body that nothing of it touches the ground where that was never seen."""
    gone = [body.joints[joint] for joint in body.contacts if body.joints[joint] not in one.skeleton.joints]
    if not gone or one.skeleton.contacts:
        return one.diagnostics.notes
    said = f"{ABSENT}no frame shows what touches the ground ({listed(gone, 4)})"
    return tuple(said if note.startswith(ABSENT) else note for note in one.diagnostics.notes)
