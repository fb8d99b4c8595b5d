"""Limbs: chains of one or two bones beyond the trunk, and what their signs of depth cost."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from kcs_torch.nn.posture import trunk_joints
from kcs_torch.skeleton import Hinge, Skeleton
from kcs_torch.skeleton.graph import direct_bones

__all__ = ["Limb", "SignCosts", "limbs_of", "outward", "waves"]


@dataclass(frozen=True)
class Limb:
    """One or two bones beyond the trunk.

    Attributes:
        bones: their indices, from the trunk outwards.
        inner: the hinge between the two, or None.
        entry: the hinge between the bone before and the first one, or None.
        before: index of the bone before, where ``entry`` is given.
    """

    bones: tuple[int, ...]
    inner: Hinge | None
    entry: Hinge | None
    before: int


@dataclass(frozen=True)
class SignCosts:
    """Weights of the terms that choose lengths and signs; see :class:`kcs_torch.methods.pkc.objective.Objective`.

    Attributes:
        acceleration: standard deviation of a bone's second difference.
        cap: largest squared acceleration that counts, in variances.
        posture: frames that count as one for the posture.
        foreshortening: frames that count as one for the foreshortening.
        hinge: weight of a hinge in a frame.
        sine: sine of a wrong bend that costs half its weight.
        proportions: usual deviation of a length, as a share.
        over: by how much an image may exceed the length.
    """

    acceleration: float = 0.05
    cap: float = 18.0
    posture: float = 15.0
    foreshortening: float = 5.0
    hinge: float = 0.2
    sine: float = 0.05
    proportions: float = 0.08
    over: float = 0.004


def waves(limbs: Sequence[Limb]) -> list[list[Limb]]:
    """Limbs of as many bones each whose neighbours towards the trunk are in earlier waves."""
    level: dict[int, int] = {}
    out: dict[tuple[int, int], list[Limb]] = {}
    for limb in limbs:
        depth = level.get(limb.before, -1) + 1
        level |= dict.fromkeys(limb.bones, depth)
        out.setdefault((depth, len(limb.bones)), []).append(limb)
    return [out[key] for key in sorted(out)]


def outward(skeleton: Skeleton) -> Skeleton:
    """The skeleton with its bones directed away from a joint of its trunk, if it has one, whichever way they were.

    This joint is one of no side, from which hinges' bones lead outwards; of several, that which turns the fewest bones,
    or leaves the fewest: where bones run (parent, child) the skeleton comes back itself.
    """
    trunk = trunk_joints(skeleton)
    if len(trunk) < 3:
        return skeleton
    hinged = {bone for hinge in skeleton.hinges for bone in hinge.bones}
    given = set(skeleton.bones)

    def cost(root: int) -> tuple[int, bool, int]:
        bones = direct_bones(skeleton.bones, root)
        turned = len(given.difference(bones))
        return len(hinged.difference(bones)), skeleton.side(root) != "centre", min(turned, len(given) - turned)

    bones = tuple(direct_bones(skeleton.bones, min(trunk, key=cost)))
    return skeleton if bones == skeleton.bones else replace(skeleton, bones=bones)


def limbs_of(skeleton: Skeleton, trunk: list[int]) -> list[Limb]:
    """Chains of one or two bones that reach every joint beyond the trunk, nearer ones first; hinges join two bones.

    Args:
        skeleton: whose bones are directed outwards.
        trunk: its joints.
    """
    bones = skeleton.bones
    arrives = {b: i for i, (_, b) in enumerate(bones)}
    order, queue = [], list(trunk)
    reached = set(trunk)
    while queue:
        joint = queue.pop(0)
        for i, (a, b) in enumerate(bones):
            if a == joint and b not in reached:
                order.append(i)
                reached.add(b)
                queue.append(b)
    done: set[int] = set()
    limbs = []
    for i in order:
        if i in done:
            continue
        a, b = bones[i]
        inner = next(
            (h for h in skeleton.hinges if (h.parent, h.joint) == (a, b) and arrives[h.child] not in done), None
        )
        entry = next((h for h in skeleton.hinges if (h.joint, h.child) == (a, b)), None)
        chain = (i,) if inner is None else (i, arrives[inner.child])
        done |= set(chain)
        limbs.append(Limb(chain, inner, entry, arrives.get(a, -1)))
    return limbs
