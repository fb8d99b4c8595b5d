"""Hypotheses refined on the objective, those of several clips as one batch."""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass, replace
from typing import NamedTuple

import torch
from torch import Tensor

from kcs_torch.methods.pkc.descent import ObjectiveGradient
from kcs_torch.methods.pkc.descents import TOGETHER
from kcs_torch.methods.pkc.objective import MOST, Objective
from kcs_torch.methods.pkc.unknowns import Unknowns
from kcs_torch.solvers.lbfgs import lbfgs
from kcs_torch.solvers.memory import give_back

__all__ = ["Refined", "Task", "minimise", "minimise_all"]


class Refined(NamedTuple):
    """Hypotheses after their refinement.

    Attributes:
        depth: (H, T, N).
        lengths: (H, B).
        energy: (H,).
        moved: (H,) root mean square change of the depths in the last ten steps.
        steps: made.
    """

    depth: Tensor
    lengths: Tensor
    energy: Tensor
    moved: Tensor
    steps: int


@dataclass(frozen=True)
class Task:
    """Hypotheses that are to be refined, as :func:`minimise` does.

    Attributes:
        objective: of the clip.
        depth: (H, T, N).
        lengths: (H, B).
        num_steps: of L-BFGS.
        loose: by how much lengths are less certain.
    """

    objective: Objective
    depth: Tensor
    lengths: Tensor
    num_steps: int
    loose: float = 1.0


def minimise(objective: Objective, depth: Tensor, lengths: Tensor, num_steps: int, loose: float = 1.0) -> Refined:
    """Refine hypotheses (H, T, N) and (H, B) of one clip, and rank them, best first.

    A start whose bones are far from constant is best refined with lengths ``loose`` times less certain first; the
    energies are then those of the loose objective.
    """
    few = max(1, MOST // depth.shape[1])
    parts = zip(depth.split(few), lengths.split(few), strict=True)
    found = [_refined(objective, *part, num_steps, loose) for part in parts]
    z, size, energy, moved, steps = zip(*found, strict=True)
    return _ranked(objective, Refined(torch.cat(z), torch.cat(size), torch.cat(energy), torch.cat(moved), max(steps)))


def minimise_all(tasks: Sequence[Task]) -> list[Refined]:
    """:func:`minimise` of each task; those of one skeleton and equal settings are refined together."""
    groups: dict[object, list[int]] = {}
    for i, task in enumerate(tasks):
        groups.setdefault(_kind(task), []).append(i)
    out: dict[int, Refined] = {}
    for group in groups.values():
        for run in _runs(sorted(group, key=lambda i: tasks[i].depth.shape[1]), tasks):
            out |= zip(run, _minimise_joined([tasks[i] for i in run]), strict=True)
    return [out[i] for i in range(len(tasks))]


def _kind(task: Task) -> object:
    """What tasks must share to be refined together."""
    firm = tuple(task.objective.hinges.firm.tolist())  # hinges of joints never seen are of no use
    return task.objective.skeleton, firm, task.num_steps, task.loose, task.depth.dtype, task.depth.device


def _runs(order: list[int], tasks: Sequence[Task]) -> list[list[int]]:
    """Tasks in order of length, cut into runs that are not too large."""
    runs: list[list[int]] = []
    rows = 0
    for i in order:
        count, frames = tasks[i].depth.shape[:2]
        if not runs or (rows + count) * frames > TOGETHER:
            runs.append([])
            rows = 0
        runs[-1].append(i)
        rows += count
    return runs


def _minimise_joined(tasks: list[Task]) -> list[Refined]:
    """Tasks of one skeleton and equal settings, padded to the longest."""
    if len(tasks) == 1:
        (task,) = tasks
        return [minimise(task.objective, task.depth, task.lengths, task.num_steps, task.loose)]
    counts = [len(task.depth) for task in tasks]
    most = max(task.depth.shape[1] for task in tasks)
    pad = lambda z: torch.nn.functional.pad(z, (0, 0, 0, most - z.shape[1]))  # noqa: E731
    joined = Objective.joined([task.objective for task in tasks], counts)
    depth, lengths = torch.cat([pad(task.depth) for task in tasks]), torch.cat([task.lengths for task in tasks])
    found = _refined(joined, depth, lengths, tasks[0].num_steps, tasks[0].loose)
    out = []
    for task, *part in zip(tasks, *(x.split(counts) for x in found[:4]), strict=True):
        z, size, energy, moved = part
        out.append(_ranked(task.objective, Refined(z[:, : task.depth.shape[1]], size, energy, moved, found.steps)))
    return out


def _refined(objective: Objective, depth: Tensor, lengths: Tensor, num_steps: int, loose: float) -> Refined:
    """As :func:`minimise`, in the order of the hypotheses, and less what :meth:`Objective.ranking` adds."""
    give_back(depth.shape[1])
    goal = copy(objective)
    goal.weights = replace(objective.weights, length=loose * objective.weights.length)
    unknowns = Unknowns(goal, depth, lengths)
    start = depth.new_zeros(len(depth), unknowns.scale.shape[-1])
    descent = ObjectiveGradient(goal, unknowns)
    solution = lbfgs(descent, start, num_steps=num_steps, tolerance=1e-5, slopes=True, part=descent.rows)
    with torch.no_grad():
        depth, lengths = unknowns(solution.value)
        assert solution.before is not None and solution.energy is not None
        shift = (depth - unknowns(solution.before)[0]).square().sum((1, 2))
        moved = (shift / (goal.count * depth.shape[-1])).sqrt()
    return Refined(depth, lengths, solution.energy, moved, solution.iterations)


def _ranked(objective: Objective, found: Refined) -> Refined:
    """Refined hypotheses, best first, with what :meth:`Objective.ranking` adds."""
    energy = found.energy + objective.ranking(found.depth, found.lengths)
    order = energy.argsort()
    return Refined(found.depth[order], found.lengths[order], energy[order], found.moved[order], found.steps)
