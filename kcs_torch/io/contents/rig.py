"""From joints' positions to a chain with offsets and rotations, as animators' files hold it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from kcs_torch.errors import OutputError
from kcs_torch.functional import bone_lengths, minimal_turn, nearest_rotation
from kcs_torch.functional.rotation import skew
from kcs_torch.skeleton import Skeleton
from kcs_torch.types.axes import from_y_up, to_y_up

__all__ = ["Rig", "check_tree", "fit_rig"]

_RIGID = 1e-4  # of the sum of all lengths: half a millimetre of a person


@dataclass(frozen=True, eq=False)
class Rig:
    """A tree of M nodes, parents first: the N joints, and nodes without length that turn single bones.

    Attributes:
        names: of the nodes.
        parents: their indices; -1 for the root, which is the first.
        offsets: (M, 3) from the parent, in the parent's axes; 0 for the root.
        turns: (T, M, 3, 3) against the parent's axes.
        root: (T, 3) positions of the root.
        joints: the node of each joint.
    """

    names: list[str]
    parents: list[int]
    offsets: Tensor
    turns: Tensor
    root: Tensor
    joints: list[int]

    def positions(self) -> Tensor:
        """The joints (T, N, 3) by forward kinematics."""
        worlds, points = [self.turns[:, 0]], [self.root]
        for node, parent in enumerate(self.parents[1:], 1):
            points.append(points[parent] + worlds[parent] @ self.offsets[node])
            worlds.append(worlds[parent] @ self.turns[:, node])
        return torch.stack([points[node] for node in self.joints], 1)


def check_tree(body: Skeleton) -> None:
    """Make sure that a skeleton can be written as a chain.

    Raises:
        OutputError: it is no tree.
    """
    if body.is_tree:
        return
    if not body.bones:
        reason = "has no bones"
    elif len(pieces := body.pieces()) > 1:
        reason = f"falls into {len(pieces)} pieces, one of them {body.joints[pieces[-1][0]]}"
    else:
        reason = "closes a chain"
    raise OutputError(
        f"expected a skeleton whose bones are one tree, got '{body.name}', which {reason}: "
        "give one with skeleton=... (kcs-torch: --skeleton)"
    )


def fit_rig(points: Tensor, body: Skeleton, *, up: str = "y") -> Rig:
    """Find offsets and rotations whose forward kinematics is nearest to the joints, bone by bone.

    Bones have their mean length and rest in the directions of the skeleton's template (of the first frame where it has
    none). A joint with one child turns by the least angle, one with several by Procrustes on those that keep their
    angles to each other; each of the others gets a node without length that turns it alone. So the directions of all
    bones are met, and what remains is due to bones that change their length.

    Args:
        points: (T, N, 3), finite.
        body: a tree.
        up: the axis of ``points`` that points up.

    Raises:
        OutputError: the skeleton is no tree.
    """
    check_tree(body)
    lengths = bone_lengths(points, body.bones).mean(0)
    scale = 2.0 ** math.frexp(float(lengths.sum()))[1]  # a power of two, which rounds nothing
    points, lengths = points / scale, lengths / scale
    rest = points[0]
    if body.template is not None:
        rest = from_y_up(to_y_up(body.template_points(dtype=points.dtype, device=points.device), "-y"), up)
    grain = _RIGID * float(lengths.sum())
    length = {frozenset(bone): size for bone, size in zip(body.bones, lengths, strict=True)}

    order, children, start = _walk(body)
    eye = torch.eye(3, dtype=points.dtype, device=points.device).expand(len(points), 3, 3)
    names, parents, offsets, turns = [body.joints[start]], [-1], [points.new_zeros(3)], [eye]
    node, worlds = {start: 0}, {0: eye}
    unit = lambda x: torch.nn.functional.normalize(x, dim=-1)  # noqa: E731
    for joint in order:
        below = children[joint]
        if not below:
            continue
        size = torch.stack([length[frozenset((joint, child))] for child in below])
        arms = size[:, None] * unit(rest[below] - rest[joint])  # (C, 3) at rest
        local = worlds[node[joint]].mT  # into the axes of the joint's parent
        seen = size[:, None] * unit((points[:, below] - points[:, joint, None]) @ local.mT)  # (T, C, 3)
        firm = _firm_group(seen, grain)
        arms[firm] = _mean_shape(arms[firm], seen[:, firm])
        turn = _turn(arms, seen, firm)
        here = node[joint]
        turns[here] = turn
        worlds[here] = worlds[here] @ turn
        off = ((turn @ arms.mT).mT - seen).norm(dim=-1).amax(0)  # (C,)
        for i, child in enumerate(below):
            parent = here
            if float(off[i]) > grain:
                own = minimal_turn(arms[i].expand(len(points), 3), (turn.mT @ seen[:, i, :, None])[..., 0])
                parent = len(names)
                names.append(f"{body.joints[joint]}_{body.joints[child]}")
                parents.append(here)
                offsets.append(points.new_zeros(3))
                turns.append(own)
                worlds[parent] = worlds[here] @ own
            node[child] = len(names)
            names.append(body.joints[child])
            parents.append(parent)
            offsets.append(arms[i])
            turns.append(eye)
            worlds[node[child]] = worlds[parent]
    joints = [node[i] for i in range(body.num_joints)]
    place = points[:, start] * scale
    return Rig(names, parents, torch.stack(offsets) * scale, torch.stack(turns, 1), place, joints)


def _walk(body: Skeleton) -> tuple[list[int], dict[int, list[int]], int]:
    """The joints from the root outwards, their children, and the root."""
    neighbours: dict[int, list[int]] = {i: [] for i in range(body.num_joints)}
    for a, b in body.bones:
        neighbours[a].append(b)
        neighbours[b].append(a)
    below = {b for _, b in body.bones}
    start = next((i for i in range(body.num_joints) if i not in below), 0)
    order, children, done = [start], {}, {start}
    for joint in order:  # which grows
        children[joint] = [i for i in neighbours[joint] if i not in done]
        done.update(children[joint])
        order.extend(children[joint])
    return order, children, start


def _firm_group(seen: Tensor, grain: float) -> list[int]:
    """The largest group of arms (T, C, 3) that keep their angles to each other; all if no two do."""
    count = seen.shape[1]
    apart = (seen[:, :, None] - seen[:, None]).norm(dim=-1)  # (T, C, C)
    firm = ((apart.amax(0) - apart.amin(0)) < grain).tolist()
    best: list[int] = []
    for first in range(count):
        group = [first]
        group += [i for i in range(count) if i != first and all(firm[i][j] for j in group if j != i)]
        group = [i for k, i in enumerate(group) if all(firm[i][j] for j in group[:k])]
        best = max(best, sorted(group), key=len)
    return best if len(best) > 1 else list(range(count))


def _mean_shape(arms: Tensor, seen: Tensor) -> Tensor:
    """The shape (C, 3) that the arms keep, of the lengths and, as far as may be, in the directions of ``arms``."""
    if len(arms) < 2:
        return arms
    size = arms.norm(dim=-1, keepdim=True)
    shape = seen[0]
    for _ in range(5):
        turns = nearest_rotation(seen.mT @ shape)
        shape = size * torch.nn.functional.normalize((seen @ turns).mean(0), dim=-1)
    return shape @ nearest_rotation(shape.mT @ arms)


def _turn(arms: Tensor, seen: Tensor, firm: Sequence[int]) -> Tensor:
    """Rotations (T, 3, 3) from the arms at rest (C, 3) to those seen (T, C, 3); the firm ones count."""
    spans = torch.linalg.svdvals(arms[list(firm)])
    if len(spans) > 1 and float(spans[1]) > 0.05 * float(spans[0]):
        return nearest_rotation(arms[list(firm)].mT @ seen[:, list(firm)]).mT
    # All along one line: it is met, and the turn about it is the best for the others.
    main = max(firm, key=lambda i: float(arms[i].norm()))
    axis = torch.nn.functional.normalize(seen[:, main], dim=-1)
    turn = minimal_turn(arms[main].expand(len(seen), 3), axis)
    arms_now = (turn @ arms.mT).mT  # (T, C, 3)
    flat = lambda x: x - (x * axis[:, None]).sum(-1, keepdim=True) * axis[:, None]  # noqa: E731
    a, b = flat(arms_now), flat(seen)
    sine = (torch.linalg.cross(a, b) * axis[:, None]).sum((-2, -1))
    cosine = (a * b).sum((-2, -1))
    little = 1e-4 * arms.square().sum()
    known = torch.hypot(sine, cosine) > little
    angle = torch.where(known, torch.atan2(sine, cosine), torch.zeros_like(sine))
    return torch.linalg.matrix_exp(skew(angle[:, None] * axis)) @ turn
