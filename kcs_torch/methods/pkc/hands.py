"""A person's hands, solved as clips of their own and joined to the body at the wrists.

Seen from the trunk, forty bones of fingers would be forty witnesses of how the body stands, though all that they tell
goes by the forearm; and seen from the palm they are told much better.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache
from itertools import chain
from typing import NamedTuple

import torch
from torch import Tensor

from kcs_torch.anatomy import side_of
from kcs_torch.clean.detector import detected
from kcs_torch.errors import SkeletonError
from kcs_torch.methods.base import Estimate
from kcs_torch.nn.posture import has_trunk
from kcs_torch.skeleton import Skeleton
from kcs_torch.skeleton.graph import find_branches
from kcs_torch.types import Tracks

__all__ = ["Part", "hands_of", "is_shown", "joined", "part_of", "parts_of", "without_joints"]

FINGERS, JOINTS = 4, 2
"""A wrist has so many branches at least, of so many joints each."""

SHOWN, FRAMES = 6, 12
"""Joints that a frame has to show of a part, and such frames (all of a shorter clip), at least: hands that are hardly
seen are told by the body."""


class Part(NamedTuple):
    """Joints of a skeleton, the wrist first if it is a hand, and what is known of these alone."""

    joints: tuple[int, ...]
    skeleton: Skeleton


def parts_of(tracks: Tracks) -> list[Part]:
    """The body without its hands, and these; nothing where there are none to be solved by themselves."""
    hands = [hand for hand in hands_of(tracks.skeleton) if is_shown(tracks, hand.joints)]
    fingers = {joint for hand in hands for joint in hand.joints[1:]}
    body = [joint for joint in range(tracks.num_joints) if joint not in fingers]
    if not hands or not is_shown(tracks, body):
        return []
    return [Part(tuple(body), without_joints(tracks.skeleton, body)), *hands]


def part_of(tracks: Tracks, part: Part) -> Tracks:
    """The tracks of one part."""
    joints = list(part.joints)
    points, weights = tracks.points[:, joints], tracks.weights[:, joints]
    return replace(tracks, points=points, weights=weights, skeleton=part.skeleton, detector=detected(tracks))


def joined(parts: Sequence[Part], found: Sequence[Estimate], sizes: Sequence[Tensor], count: int) -> Estimate:
    """One estimate of so many joints by those of its parts, the body's first.

    Hands are put to the body's wrists, and as unsure as these and they together. The alternatives are those of each
    part, with the best of the others.

    Args:
        parts: as of :func:`parts_of`.
        found: of each, in units of which each has its size.
        sizes: by which the parts' tracks were divided.
        count: joints of the whole.
    """
    best = _whole(parts, found, sizes, count)
    others = [
        _whole(parts, [*found[:k], other, *found[k + 1 :]], sizes, count)
        for k, one in enumerate(found)
        for other in one.alternatives
    ]
    return replace(best, alternatives=tuple(sorted(others, key=lambda one: one.objective)))


def _whole(parts: Sequence[Part], found: Sequence[Estimate], sizes: Sequence[Tensor], count: int) -> Estimate:
    """One solution of each part as one of all, without alternatives."""
    body = found[0]
    points = body.points.new_zeros(len(body.points), count, 3)
    variance = points.new_zeros(points.shape[:2])
    for k, (part, one, size) in enumerate(zip(parts, found, sizes, strict=True)):
        joints, wrist = list(part.joints), part.joints[0]
        place = one.points * size
        spread = place.new_zeros(place.shape[:2]) if one.deviation is None else (one.deviation * size).square()
        if k:
            place = place - place[:, :1] + points[:, wrist, None]
            spread = torch.cat([0 * spread[:, :1], spread[:, 1:]], 1) + variance[:, wrist, None]
        points[:, joints], variance[:, joints] = place, spread
    notes = chain(body.notes, *(_of_hand(part, one, body) for part, one in zip(parts[1:], found[1:], strict=True)))
    return replace(
        body,
        points=points - points.mean(1, keepdim=True),
        deviation=None if body.deviation is None else variance.sqrt(),
        converged=all(one.converged for one in found),
        iterations=max(one.iterations for one in found),
        objective=sum(one.objective for one in found),
        notes=tuple(notes),
        alternatives=(),
    )


def _of_hand(part: Part, one: Estimate, body: Estimate) -> list[str]:
    """What is said of a hand, under the wrist's name, and not of the body as well."""
    said = [note.replace("the body's", "its") for note in (*one.notes, one.doubt) if note and note not in body.notes]
    return [f"{part.skeleton.joints[0]}: {note}" for note in said]


def is_shown(tracks: Tracks, joints: Sequence[int]) -> bool:
    """Whether enough frames show enough of some joints for a clip of their own."""
    frames = (tracks.seen[:, list(joints)].sum(1) >= SHOWN).sum()
    return int(frames) >= min(FRAMES, tracks.num_frames)


@lru_cache(maxsize=64)
def hands_of(skeleton: Skeleton) -> tuple[Part, ...]:
    """Hands that hang on a body with a template, by the joints' names."""
    if not skeleton.is_tree or not has_trunk(skeleton):
        return ()
    hands = []
    for wrist, branches in find_branches(skeleton.bones).items():
        fingers = [finger for finger in branches if len(finger) >= JOINTS]
        joints = [wrist, *sorted(chain.from_iterable(fingers))]
        if len(fingers) < FINGERS or joints[-1] >= skeleton.num_observed:
            continue
        side = side_of(skeleton.joints[wrist])
        name = "wrist" if side == "centre" else f"{side}_wrist"  # the skeleton may call it a hand
        names = [name, *(skeleton.joints[joint] for joint in joints[1:])]
        new = {joint: k for k, joint in enumerate(joints)}
        bones = [(names[new[a]], names[new[b]]) for a, b in skeleton.bones if a in new and b in new]
        try:
            hand = Skeleton.from_names(names, bones, name=f"{skeleton.name}: {name}", template="hand")
        except SkeletonError:  # something else that branches
            continue
        if has_trunk(hand) and len(joints) < skeleton.num_joints:
            hands.append(Part(tuple(joints), hand))
    return tuple(hands)


def without_joints(skeleton: Skeleton, joints: Sequence[int]) -> Skeleton:
    """The skeleton of some joints alone, and of the bones between them."""
    new = {joint: k for k, joint in enumerate(joints)}
    bones = [k for k, bone in enumerate(skeleton.bones) if new.keys() >= set(bone)]

    def of_bones(values: tuple[float, ...] | None) -> tuple[float, ...] | None:
        return None if values is None else tuple(values[k] for k in bones)

    hinges = [h for h in skeleton.hinges if new.keys() >= {h.parent, h.joint, h.child, h.left, h.right}]
    named = ("parent", "joint", "child", "left", "right")
    return replace(
        skeleton,
        joints=tuple(skeleton.joints[joint] for joint in joints),
        bones=tuple((new[a], new[b]) for a, b in (skeleton.bones[k] for k in bones)),
        mirror=tuple((new[a], new[b]) for a, b in skeleton.mirror if a in new and b in new),
        virtual=tuple((new[v], tuple(new[s] for s in of)) for v, of in skeleton.virtual if v in new),
        template=None if skeleton.template is None else tuple(skeleton.template[joint] for joint in joints),
        proportions=of_bones(skeleton.proportions),
        spread=of_bones(skeleton.spread),
        flexible=tuple(bones.index(k) for k in skeleton.flexible if k in bones),
        hinges=tuple(replace(h, **{key: new[getattr(h, key)] for key in named}) for h in hinges),
        contacts=tuple(new[joint] for joint in skeleton.contacts if joint in new),
    )
