"""Hypotheses of several clips, refined as one batch."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
from torch import Tensor

from kcs_torch.methods.pkc.descents import TOGETHER, Descent, descend_all
from kcs_torch.methods.pkc.objective import Objective, Refined
from kcs_torch.methods.pkc.placing import Placing, limb_paths
from kcs_torch.methods.pkc.trunk import Facing, facings
from kcs_torch.methods.sfam import SfAM
from kcs_torch.methods.size import weak_perspectives
from kcs_torch.solvers.denoise import Denoised, denoise_tracks
from kcs_torch.types import Tracks

__all__ = ["Noisy", "Sized", "Task", "clean_all", "minimise_all", "serve"]


@dataclass(frozen=True)
class Task:
    """Hypotheses that are to be refined, as :meth:`Objective.minimise` does.

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


class Noisy(NamedTuple):
    """Tracks (T, N, 2) of weights (T, N) that are to be cleaned by :func:`denoise_tracks`, and its settings."""

    points: Tensor
    weights: Tensor
    window: int = 64
    quick: int = 12


class Sized(NamedTuple):
    """Tracks whose points are images, of which the size over time is wanted, see :func:`weak_perspectives`."""

    tracks: Tracks


def serve(requests: Sequence[Task | Placing | Facing | Descent | Noisy | Sized | Tracks]) -> list[Any]:
    """Answer what searches of several clips ask for.

    Hypotheses are refined, limbs placed, trunks fitted, starts descended from; tracks are cleaned, their sizes found,
    and solved by SfAM.
    """
    answers: dict[type, Callable[[list[Any]], list[Any]]] = {
        Task: minimise_all,
        Placing: limb_paths,
        Facing: facings,
        Descent: descend_all,
        Noisy: clean_all,
        Sized: lambda asked: weak_perspectives([one.tracks for one in asked]),
        Tracks: SfAM().solve_all,
    }
    out: dict[int, Any] = {}
    for kind, answer in answers.items():
        asked = [i for i, one in enumerate(requests) if isinstance(one, kind)]
        if asked:
            out |= zip(asked, answer([requests[i] for i in asked]), strict=True)
    return [out[i] for i in range(len(requests))]


def clean_all(tasks: Sequence[Noisy]) -> list[Denoised]:
    """:func:`denoise_tracks` of each task; those of equal size together."""
    groups: dict[object, list[int]] = {}
    for i, (points, _, *settings) in enumerate(tasks):
        groups.setdefault((points.shape, points.dtype, points.device, *settings), []).append(i)
    out: dict[int, Denoised] = {}
    for group in groups.values():
        few = max(1, TOGETHER // tasks[group[0]].points.shape[0])
        for run in (group[begin : begin + few] for begin in range(0, len(group), few)):
            points, weights = (torch.stack(part) for part in zip(*(tasks[i][:2] for i in run), strict=True))
            first = tasks[run[0]]
            found = denoise_tracks(points, weights, window=first.window, quick=first.quick)
            out |= {i: Denoised(*row) for i, row in zip(run, zip(*found, strict=True), strict=True)}
    return [out[i] for i in range(len(tasks))]


def minimise_all(tasks: Sequence[Task]) -> list[Refined]:
    """:meth:`Objective.minimise` of each task; those of one skeleton and equal settings are refined together."""
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
        return [task.objective.minimise(task.depth, task.lengths, task.num_steps, task.loose)]
    counts = [len(task.depth) for task in tasks]
    most = max(task.depth.shape[1] for task in tasks)
    pad = lambda z: torch.nn.functional.pad(z, (0, 0, 0, most - z.shape[1]))  # noqa: E731
    joined = Objective.joined([task.objective for task in tasks], counts)
    depth, lengths = torch.cat([pad(task.depth) for task in tasks]), torch.cat([task.lengths for task in tasks])
    found = joined.refined(depth, lengths, tasks[0].num_steps, tasks[0].loose)
    out = []
    for task, *part in zip(tasks, *(x.split(counts) for x in found[:4]), strict=True):
        z, size, energy, moved = part
        out.append(task.objective.ranked(Refined(z[:, : task.depth.shape[1]], size, energy, moved, found.steps)))
    return out
