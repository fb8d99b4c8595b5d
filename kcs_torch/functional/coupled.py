"""Systems in which bones that meet at a joint are coupled: solved bone after bone, over all frames at once."""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import torch
from torch import Tensor

from kcs_torch.functional.chain import kcs_matrix

__all__ = ["solve_coupled"]

CALL, EACH, FACTOR = 5000, 6, 1500
"""What one operation over all frames costs, what it costs in each frame, and a dense solution in each frame beside its
B^3 / 3: in multiplications of the latter, as measured on one thread."""


class _Step(NamedTuple):
    """One bone that is eliminated: what it is coupled with by then.

    Attributes:
        bone: its number.
        others: the bones.
        slots: where the couplings stand.
        among: (slot, i, j) of the couplings that the others i and j of ``others`` have with each other.
    """

    bone: int
    others: tuple[int, ...]
    slots: tuple[int, ...]
    among: tuple[tuple[int, int, int], ...]


class _Order(NamedTuple):
    """The order in which bones are eliminated.

    Attributes:
        first: (E,) bones that are coupled, each with the one of ``second``.
        second: (E,).
        slots: of couplings in all, those included that elimination makes; they come last.
        steps: one for each bone.
    """

    first: Tensor
    second: Tensor
    slots: int
    steps: tuple[_Step, ...]

    @property
    def work(self) -> int:
        """Operations, each over all frames."""
        return sum(2 * len(step.others) + len(step.among) for step in self.steps)


def solve_coupled(vectors: Tensor, right: Tensor, bones: Tensor, overlap: Tensor) -> Tensor:
    """Solve (I + (C^T C) o Psi) y = r, C being the incidence matrix and Psi the KCS matrix of bone vectors.

    C^T C couples bones that meet at a joint. There all are coupled with all, so that in a tree, eliminated from its
    leaves, zeros stay zeros: a few operations a bone, over all frames at once, where a dense factorisation takes some
    B^3 / 3 in each frame. That is what is left where there are few frames or many cycles, on a GPU, where derivatives
    are wanted, and where torch.func.vmap maps over bones.

    Args:
        vectors: (..., B, D).
        right: r (..., B).
        bones: (B, 2) integer (parent, child) pairs.
        overlap: C^T C (B, B): 2 on its diagonal; where two bones meet, 1 if both come from that joint or both go to it,
            else -1.

    Returns:
        y (..., B). Differentiable any number of times.

    >>> x = torch.tensor([[1.0, 0.0], [1.0, 0.0]])
    >>> overlap = torch.tensor([[2.0, -1.0], [-1.0, 2.0]])
    >>> solve_coupled(x, torch.tensor([2.0, 2.0]), torch.tensor([[0, 1], [1, 2]]), overlap)
    tensor([1., 1.])
    """
    plain = not (torch.is_grad_enabled() and (vectors.requires_grad or right.requires_grad))
    here = vectors.device.type == bones.device.type == "cpu" and not torch.compiler.is_compiling()
    frames = vectors.shape[:-2].numel()
    dense = frames * (len(bones) ** 3 / 3 + FACTOR)
    if plain and here and dense > CALL:
        order = _readable(bones)
        if order and 0 < order.work * (CALL + EACH * frames) < dense:
            return _eliminated(vectors, right, order, overlap)
    eye = torch.eye(len(bones), dtype=vectors.dtype, device=vectors.device)
    factor, _ = torch.linalg.cholesky_ex(torch.addcmul(eye, overlap, kcs_matrix(vectors)))
    return torch.cholesky_solve(right[..., None], factor)[..., 0]


def _readable(bones: Tensor) -> _Order | None:
    """The order of elimination, or None if the bones cannot be read: several bodies' under torch.func.vmap."""
    try:
        pairs = bones.tolist()
    except RuntimeError:
        return None
    return _order(tuple(map(tuple, pairs)))


def _eliminated(vectors: Tensor, right: Tensor, order: _Order, weight: Tensor) -> Tensor:
    """The solution, of couplings that weigh (B, B)."""
    rows = vectors.movedim((-2, -1), (0, 1)).contiguous()  # (B, D, ...)
    own = list(torch.addcmul(rows.new_ones(()), _along(weight.diagonal(), rows), rows.square().sum(1)).unbind())
    product = (rows[order.first] * rows[order.second]).sum(1)
    between = list((_along(weight[order.first, order.second], rows) * product).unbind())
    between += [rows.new_zeros(())] * (order.slots - len(between))
    y = list(right.movedim(-1, 0).contiguous().unbind())
    shares: list[list[Tensor]] = []
    for bone, others, slots, among in order.steps:
        inverse = own[bone].reciprocal()
        part = [between[slot] * inverse for slot in slots]
        for other, slot, some in zip(others, slots, part, strict=True):
            own[other] = torch.addcmul(own[other], some, between[slot], value=-1)
            y[other] = torch.addcmul(y[other], some, y[bone], value=-1)
        for slot, i, j in among:
            between[slot] = torch.addcmul(between[slot], part[i], between[slots[j]], value=-1)
        y[bone] = y[bone] * inverse
        shares.append(part)
    for step, part in zip(reversed(order.steps), reversed(shares), strict=True):
        for other, some in zip(step.others, part, strict=True):
            y[step.bone] = torch.addcmul(y[step.bone], some, y[other], value=-1)
    return torch.stack(y, -1)


def _along(values: Tensor, rows: Tensor) -> Tensor:
    """Values (K,) as (K, 1, ...), to go with rows (K, D, ...) that were summed over D."""
    return values.view(-1, *[1] * (rows.ndim - 2))


@lru_cache(maxsize=64)
def _order(bones: tuple[tuple[int, ...], ...]) -> _Order:
    """Eliminate the bone with the fewest neighbours first."""
    near = [{j for j, other in enumerate(bones) if j != i and set(bone) & set(other)} for i, bone in enumerate(bones)]
    pairs = [(i, j) for i, some in enumerate(near) for j in sorted(some) if i < j]
    slot = {pair: k for k, pair in enumerate(pairs)}
    left, steps = set(range(len(bones))), []
    while left:
        bone = min(left, key=lambda i: (len(near[i]), i))
        left.remove(bone)
        others = sorted(near[bone])
        among = []
        for i, one in enumerate(others):
            near[one].remove(bone)
            for j, other in enumerate(others[i + 1 :], i + 1):
                among.append((slot.setdefault((one, other), len(slot)), i, j))
                near[one].add(other)
                near[other].add(one)
        slots = tuple(slot[min(bone, other), max(bone, other)] for other in others)
        steps.append(_Step(bone, tuple(others), slots, tuple(among)))
    first, second = torch.tensor(pairs, dtype=torch.long, device="cpu").reshape(-1, 2).unbind(1)
    return _Order(first, second, len(slot), tuple(steps))
