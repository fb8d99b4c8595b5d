"""Whose joints tracks are: the skeleton that fits them, by its name, their names or their links."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from kcs_torch.errors import ShapeError, SkeletonError, listed
from kcs_torch.skeleton import (
    SKELETONS,
    Skeleton,
    fitting_links,
    get_skeleton,
    guess_skeleton,
    has_middle,
    known_by_names,
    map_joints,
    person_by_names,
)

__all__ = ["IN_ORDER", "MOST_LACKING", "choose_skeleton", "joint_order", "no_bones", "numbered"]

MOST_LACKING = 3
"""One joint in so many may be missing where those of another body are matched by name."""

_TELLING = 8  # names of a skeleton's joints, from which on the others may be slips

IN_ORDER = "joints taken in their order as those of skeleton"
"""How the note begins where as many joints as the skeleton has go by other names."""


def fitting(num_joints: int) -> list[str]:
    """Names of the built-in skeletons that have so many observed joints."""
    return [body.name for body in SKELETONS.values() if body.num_observed == num_joints]


def no_bones(body: Skeleton) -> str:
    """What to say of tracks whose skeleton has no bones."""
    fits = [name for name in fitting(body.num_joints) if _may_be(body.joints, SKELETONS[name])]
    choice = f" ({body.num_joints} joints fit {', '.join(fits)})" if fits else ""
    return (
        "no bones are given, so joints are taken as points that move freely: give a skeleton"
        f"{choice}, or skeleton='auto' (--skeleton auto) to find the bones{_strangers(body.joints)}"
    )


def _strangers(names: Sequence[str]) -> str:
    """Which names keep the others from being those of a built-in skeleton, for a note; nothing where most do."""
    best = max(SKELETONS.values(), key=lambda known: (_common(names, known), -known.num_observed))
    found = map_joints(names, own := best.joints[: best.num_observed])
    count = len(found) - found.count(None)
    if count < max(_TELLING, len(names) * (1 - 1 / MOST_LACKING)) or count == len(names):
        return ""
    others = [f"'{name}'" for i, name in enumerate(names) if i not in found]
    missing = [name for name, i in zip(own, found, strict=True) if i is None]
    are, them = ("is", "it") if len(others) == 1 else ("are", "them")
    if not missing:
        cure = f"skeleton='{best.name}' leaves {them} out"
    else:
        of = f" ({listed(missing, 4)} {'is' if len(missing) == 1 else 'are'} missing)"
        cure = f"rename {them}{of if len(missing) <= len(others) else ''} or leave {them} out"
    return f"; {count} of {len(names)} names are those of {best.name}, {listed(others, 4)} {are} not: {cure}"


def _common(names: Sequence[str], body: Skeleton) -> int:
    """How many of the names are those of observed joints of the body."""
    return sum(i is not None for i in map_joints(names, body.joints[: body.num_observed]))


def numbered(names: Sequence[str]) -> bool:
    """Whether names differ by numbers at their ends alone, so that their order is all that they tell."""
    return len({re.sub(r"[0-9]+\Z", "", name) for name in names}) == 1


def _may_be(names: Sequence[str], body: Skeleton) -> bool:
    """Whether joints may be those of a body of as many: by their names, unless these are but numbers."""
    if numbered(names):
        return True
    found = map_joints(names, body.joints[: body.num_observed])
    if None not in found:
        return True  # whatever their order, as a skeleton matches joints by name
    return all(i in (None, j) for j, i in enumerate(found)) and MOST_LACKING * found.count(None) <= len(found)


def choose_skeleton(
    skeleton: str | Path | Skeleton | None,
    names: Sequence[str] | None,
    edges: Any,
    num_joints: int,
    source: str,
    notes: list[str],
) -> Skeleton:
    """The skeleton that fits what the user gave; says so in ``notes`` where it had to choose."""
    if skeleton is not None:
        return _given(get_skeleton(skeleton), num_joints, source)
    try:
        if edges is None:
            return _by_names(names, num_joints, source, notes)
        graph = Skeleton.from_edges(_pairs(edges, source), names or num_joints, name=Path(source).stem, tree=False)
    except SkeletonError as error:
        raise SkeletonError(f"{source}: {'' if edges is None else 'edges: '}{error}") from None
    return _by_links(graph, names, notes)


def _given(body: Skeleton, num_joints: int, source: str) -> Skeleton:
    """The skeleton that was named, which must have so many observed joints."""
    if body.num_observed != num_joints:
        fits = fitting(num_joints)
        hint = f"; {num_joints} joints fit {', '.join(fits)}" if fits else ""
        if num_joints == body.num_joints:
            virtual = ", ".join(body.joints[body.num_observed :])
            hint = f": take off the virtual ones, {virtual}, points[:, :{body.num_observed}], which are found anew"
        raise SkeletonError(
            f"{source}: expected the {body.num_observed} joints of skeleton '{body.name}', got {num_joints}{hint}"
        )
    return body


def _by_names(names: Sequence[str] | None, num_joints: int, source: str, notes: list[str]) -> Skeleton:
    """The skeleton of joints without links, as far as their names tell."""
    known = None if names is None else guess_skeleton(names)
    person = None if names is None or known is not None else person_by_names(names, Path(source).stem)
    if person is not None:
        notes.append(f"a person's bones are taken, by the joints' names{_between(person)}")
    return known or person or Skeleton.from_edges([], names or num_joints, name="points", tree=False)


def _by_links(graph: Skeleton, names: Sequence[str] | None, notes: list[str]) -> Skeleton:
    """The skeleton of joints that are linked as in the graph, or as a person's or a detector's are known to be."""
    told = names is not None and not numbered(names)
    fits = [] if told else fitting_links(graph.bones, graph.num_joints)
    if len(fits) == 1:
        notes.append(f"the edges are those of skeleton '{fits[0].name}', so the joints are taken for its")
        return fits[0]
    if fits:
        which = " and ".join(fit.name for fit in fits)
        notes.append(f"the edges are those of skeletons {which}: skeleton='{fits[-1].name}' would tell much more")
    known = known_by_names(graph.joints)
    body = known or person_by_names(graph.joints, graph.name)
    if graph.is_tree and (body is None or not body.virtual or has_middle(graph.joints)):
        return replace(graph, tree=True)
    cut = f"fall into {len(graph.pieces())} pieces" if len(graph.pieces()) > 1 else "lead past the middle of the trunk"
    reason = "close a chain" if graph.cycle() else cut
    if body is None:
        notes.append(f"the edges {reason}: used as a graph of rigid links, not as a tree")
        return graph
    if known is None:
        notes.append(f"the edges {reason}: a person's bones are taken, by the joints' names{_between(body)}")
    else:
        notes.append(f"the edges {reason}: used the built-in skeleton '{known.name}', whose joint names these are")
    return body


def _pairs(edges: Any, source: str) -> list[list[int]]:
    """Edges as pairs of joint indices."""
    try:
        pairs = np.asarray(edges)
    except ValueError:
        raise ShapeError(f"{source}: edges: expected pairs of joint indices, got rows of unequal length") from None
    if pairs.size == 0:
        pairs = pairs.reshape(0, 2)
    if pairs.ndim != 2 or pairs.shape[1] != 2 or not np.issubdtype(pairs.dtype, np.number):
        raise ShapeError(
            f"{source}: edges: expected shape (bones, 2) of joint indices, got {pairs.shape} of {pairs.dtype}"
        )
    found: list[list[int]] = pairs.tolist()
    return found


def _between(person: Skeleton) -> str:
    """Which joints a person has beside those seen, for a note."""
    made = [f"{person.joints[v]} between {' and '.join(person.joints[i] for i in ends)}" for v, ends in person.virtual]
    return f", with a virtual {', and a virtual '.join(made)}" if made else ""


def joint_order(names: Sequence[str], body: Skeleton, source: str, notes: list[str]) -> list[int] | None:
    """Return where each joint of ``body`` stands among ``names``, in any spelling; None: take them in their order.

    Of another body's joints those in common are taken, and -1 stands for those that it lacks, a third at most.

    Raises:
        SkeletonError: too many joints are not among the names, or equally many names stand in another order.
    """
    wanted = body.joints[: body.num_observed]
    if tuple(names) == wanted:
        return None
    exact = {n: i for i, n in enumerate(names)}
    found = [exact.get(n) for n in wanted] if exact.keys() >= set(wanted) else map_joints(names, wanted)
    ordered = numbered(names) and found == list(range(len(names)))
    missing = [n for n, i in zip(wanted, found, strict=True) if i is None or ordered]
    if not missing:
        spare = [name for i, name in enumerate(names) if i not in found]
        told = f"; {len(spare)} left out: {listed(spare, 4)}" if spare else ""
        notes.append(f"joints matched by name with skeleton '{body.name}'{told}")
        return [i for i in found if i is not None]
    if len(names) == len(wanted) and all(i in (None, j) for j, i in enumerate(found)):
        pairs = [f"{names[wanted.index(n)]} for {n}" for n in missing]
        said = f"{', '.join(pairs[:4])}{', ...' if len(pairs) > 4 else ''}"
        notes.append(f"{IN_ORDER} '{body.name}', where names differ: {said}")
        return None
    if len(names) != len(wanted) and MOST_LACKING * len(missing) <= len(wanted):
        notes.append(
            f"joints matched by name with skeleton '{body.name}'; not among them, so unseen: {', '.join(missing)}"
        )
        return [-1 if i is None else i for i in found]
    there = ", ".join(names)
    raise SkeletonError(
        f"{source}: expected the {len(wanted)} joints of skeleton '{body.name}', got {len(names)} joints, none of them "
        f"named {', '.join(missing[:6])}{', ...' if len(missing) > 6 else ''}; they are {there[:1000]}"
        + (" ..." if len(there) > 1000 else "")
    )
