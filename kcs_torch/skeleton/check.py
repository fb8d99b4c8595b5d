"""What a skeleton must satisfy, and what it is given."""

from __future__ import annotations

import math
import statistics
from collections import Counter
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from torch import Tensor

from kcs_torch.anatomy import Hinge
from kcs_torch.errors import ShapeError, SkeletonError
from kcs_torch.skeleton.parse import index_pairs

if TYPE_CHECKING:
    from kcs_torch.skeleton.core import Skeleton

__all__ = ["as_tuples", "check_facts", "check_observed", "check_tree"]

SAME, HUGE = 1e-6, 100.0
"""Length of a template's bone, over that of the median bone, up to which its ends are one place, and from which on it
is none of this body's: a thigh is 20 times as long as a finger's bones."""


def as_tuples(body: Skeleton) -> dict[str, Any]:
    """The fields of a skeleton that may come as lists, as tuples of plain numbers: so it can be hashed."""
    return {
        "joints": tuple(body.joints),
        "bones": tuple(index_pairs(body.bones, body.name, "bones")),
        "mirror": tuple(index_pairs(body.mirror, body.name, "mirror")),
        "virtual": tuple((int(v), tuple(sources)) for v, sources in body.virtual),
        "flexible": tuple(body.flexible),
        "hinges": tuple(body.hinges),
        "contacts": tuple(body.contacts),
        "template": None if body.template is None else tuple(tuple(map(float, place)) for place in body.template),
        "proportions": None if body.proportions is None else tuple(map(float, body.proportions)),
        "spread": None if body.spread is None else tuple(map(float, body.spread)),
    }


def check_facts(body: Skeleton) -> None:
    """Raise SkeletonError where names, indices or numbers of a skeleton are inconsistent."""
    n, where = body.num_joints, f"skeleton '{body.name}'"
    if n < 2:
        raise SkeletonError(f"{where}: expected at least 2 joints, got {n}")
    doubled = sorted({j for j in body.joints if body.joints.count(j) > 1})
    if doubled:
        raise SkeletonError(f"{where}: joint names must differ; given twice: {', '.join(doubled)}")
    seen: set[frozenset[int]] = set()
    for a, b in body.bones:
        if not (0 <= a < n and 0 <= b < n):
            raise SkeletonError(f"{where}: bone ({a}, {b}): expected joint indices 0..{n - 1}")
        if a == b:
            raise SkeletonError(f"{where}: bone {body.joints[a]}-{body.joints[b]} joins a joint to itself")
        if frozenset((a, b)) in seen:
            raise SkeletonError(f"{where}: bone {body.joints[a]}-{body.joints[b]} is given twice")
        seen.add(frozenset((a, b)))
    if body.virtual and [v for v, _ in body.virtual] != list(range(body.num_observed, n)):
        raise SkeletonError(f"{where}: virtual joints must follow the observed ones")
    for v, sources in body.virtual:
        if not sources or any(not 0 <= s < v for s in sources):
            raise SkeletonError(f"{where}: virtual joint '{body.joints[v]}' needs sources that come before it")
    for a, b in body.mirror:
        if not (0 <= a < n and 0 <= b < n) or a == b:
            raise SkeletonError(f"{where}: mirror ({a}, {b}): expected two different joint indices in 0..{n - 1}")
    twice = sorted(i for i, count in Counter(i for pair in body.mirror for i in pair).items() if count > 1)
    if twice:
        raise SkeletonError(
            f"{where}: mirror: '{body.joints[twice[0]]}' has two twins: expected each joint in one pair"
        )
    for i in body.flexible:
        if not 0 <= i < body.num_bones:
            raise SkeletonError(f"{where}: flexible {i}: expected bone indices 0..{body.num_bones - 1}")
    _check_motion(body, where)
    if body.template is not None:
        if len(body.template) != n:
            raise SkeletonError(f"{where}: template: expected {n} positions, got {len(body.template)}")
        for joint, p in zip(body.joints, body.template, strict=True):
            if len(p) != 3 or not all(map(math.isfinite, p)):
                raise SkeletonError(f"{where}: template: '{joint}': expected 3 finite numbers, got {p}")
        _check_places(body, body.template, where)
    if body.proportions is not None:
        if len(body.proportions) != body.num_bones:
            raise SkeletonError(f"{where}: proportions: expected {body.num_bones} lengths, got {len(body.proportions)}")
        for bone, length in zip(body.bone_names, body.proportions, strict=True):
            if not 0 < length < math.inf:
                raise SkeletonError(f"{where}: proportions: bone {bone}: expected a positive number, got {length}")


def _check_places(body: Skeleton, template: Sequence[Sequence[float]], where: str) -> None:
    """What the lengths of a template's bones tell of its places."""
    if not body.bones:
        return
    lengths = [math.dist(template[a], template[b]) for a, b in body.bones]
    usual = statistics.median(lengths)
    shortest, longest = (lengths.index(pick(lengths)) for pick in (min, max))
    if lengths[shortest] <= SAME * usual:
        raise SkeletonError(
            f"{where}: template: both ends of bone {body.bone_names[shortest]} lie in one place: expected two places, "
            "or no template"
        )
    if lengths[longest] > HUGE * usual:
        raise SkeletonError(
            f"{where}: template: bone {body.bone_names[longest]} is {lengths[longest] / usual:.0f} times as long as "
            "the median bone: is it in another unit?"
        )


def _check_motion(body: Skeleton, where: str) -> None:
    """What is said of hinges, contacts and spread."""
    n = body.num_joints
    joined = {frozenset(b) for b in body.bones}
    ways: dict[tuple[int, ...], float] = {}
    for hinge in body.hinges:
        if not isinstance(hinge, Hinge):
            raise SkeletonError(
                f"{where}: hinges: expected kcs_torch.skeleton.Hinge, got {hinge!r}; Skeleton.from_names takes mappings"
            )
        used = (hinge.parent, hinge.joint, hinge.child, hinge.left, hinge.right)
        if not all(0 <= i < n for i in used) or hinge.left == hinge.right:
            raise SkeletonError(f"{where}: {hinge}: expected joint indices in 0..{n - 1}, left and right different")
        what = f"{where}: hinge at '{body.joints[hinge.joint]}'"
        for a, b in hinge.bones:
            if frozenset((a, b)) not in joined or hinge.parent == hinge.child:
                raise SkeletonError(
                    f"{what}: expected the joint between two bones, got '{body.joints[hinge.parent]}' - "
                    f"'{body.joints[hinge.joint]}' - '{body.joints[hinge.child]}'. Add the bone "
                    f"{body.joints[a]}-{body.joints[b]}, or choose other ends (parent, child)."
                )
        if hinge.sign not in (1, -1):
            raise SkeletonError(f"{what}: sign: expected 1 (backward) or -1 (forward), got {hinge.sign}")
        if ways.setdefault(used, hinge.sign) != hinge.sign:
            raise SkeletonError(f"{what} bends both ways: expected one of them")
        if not 0 <= hinge.firm <= 1:
            raise SkeletonError(f"{what}: weight: expected a number within 0..1, got {hinge.firm}")
    for i in body.contacts:
        if not 0 <= i < n:
            raise SkeletonError(f"{where}: contact {i}: expected joint indices 0..{n - 1}")
        if body.contacts.count(i) > 1:
            raise SkeletonError(f"{where}: contact '{body.joints[i]}' is given twice")
    if body.spread is not None:
        if len(body.spread) != body.num_bones:
            raise SkeletonError(f"{where}: spread: expected {body.num_bones} angles, got {len(body.spread)}")
        for bone, angle in zip(body.bone_names, body.spread, strict=True):
            if not 0 < angle <= 180:
                raise SkeletonError(f"{where}: spread: bone {bone}: expected degrees above 0, up to 180, got {angle}")


def check_tree(body: Skeleton) -> None:
    """Raise SkeletonError, naming the cycle or the loose joints, where the bones are not one tree."""
    cycle = body.cycle()
    if cycle is not None:
        loop = " - ".join(body.joints[i] for i in [*cycle, cycle[0]])
        raise SkeletonError(
            f"skeleton '{body.name}': expected a tree, got a closed chain {loop}. "
            "Remove one of its bones, or pass tree=False to keep it as a graph of rigid links."
        )
    pieces = body.pieces()
    if len(pieces) > 1:
        main = max(pieces, key=len)
        loose = [body.joints[i] for p in pieces if p is not main for i in p]
        raise SkeletonError(
            f"skeleton '{body.name}': expected one connected tree, got {len(pieces)} pieces; not joined to "
            f"'{body.joints[main[0]]}': {', '.join(loose)}. Add a bone to each piece, drop those joints, "
            "or pass tree=False."
        )


def check_observed(body: Skeleton, points: Tensor, weights: Tensor | None) -> None:
    """Raise a ShapeError unless points (..., num_observed, D) and weights of them are what ``complete`` takes."""
    given: dict[str, Any] = {"points": points, "weights": weights}
    for name, value in given.items():
        if value is not None and not isinstance(value, Tensor):
            raise ShapeError(
                f"complete: expected a tensor of {name}, got {type(value).__name__}: use torch.as_tensor({name})"
            )
    if points.ndim < 2 or points.shape[-2] != body.num_observed:
        message = f"complete: expected points (..., {body.num_observed}, D) for skeleton '{body.name}', "
        message += f"got {tuple(points.shape)}"
        if points.ndim >= 2 and body.virtual and points.shape[-2] == body.num_joints:
            message += ", which have its virtual joints already"
        elif points.ndim >= 2 and points.shape[-1] == body.num_observed:
            message += ": swap their last two axes, points.mT"
        raise ShapeError(message)
    if not points.is_floating_point():
        raise ShapeError(f"complete: points: expected floating point, got {points.dtype}: use points.float()")
    if weights is not None and weights.shape[-1:] != (body.num_observed,):
        raise ShapeError(
            f"complete: expected weights (..., {body.num_observed}) for points {tuple(points.shape)}, "
            f"got {tuple(weights.shape)}"
        )
