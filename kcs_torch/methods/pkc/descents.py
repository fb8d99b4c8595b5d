"""Descents of the moving viewpoint's objective, those of several clips as one batch."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from kcs_torch.methods.clips.batches import SPREAD
from kcs_torch.solvers.procrustean import Pose, Stage, procrustean

__all__ = ["TOGETHER", "Descent", "descend_all"]

TOGETHER = 4800
"""Frames of starts or hypotheses that are taken as one batch; more gained nothing."""


@dataclass(frozen=True)
class Descent:
    """Starts that are to be descended from, as :func:`procrustean` does; its arguments."""

    tracks: Tensor
    points: Tensor
    rotations: Tensor
    bones: Tensor
    weights: Tensor | None
    rigid: Tensor
    stiffness: float
    noise: float
    stages: tuple[Stage, ...]
    anchor: float = 0.0
    held: Tensor | None = None

    @property
    def kind(self) -> object:
        """What descents must share to be made as one: exact tracks, and all settings but how depths are held."""
        if self.noise > 0 or self.weights is not None:
            return id(self)
        links = tuple(self.bones.flatten().tolist()), tuple(self.rigid.flatten().tolist())
        settings = links, self.stiffness, self.stages, self.anchor > 0
        return self.points.shape[2:], self.points.dtype, self.points.device, settings


def descend_all(tasks: Sequence[Descent]) -> list[Pose]:
    """:func:`procrustean` from each task's starts; those of one kind and of similar length together."""
    groups: dict[object, list[int]] = {}
    for i in sorted(range(len(tasks)), key=lambda i: tasks[i].points.shape[1]):
        groups.setdefault(tasks[i].kind, []).append(i)
    out: dict[int, Pose] = {}
    for group in groups.values():
        run: list[int] = []
        rows = 0
        for i in group:
            count, frames = tasks[i].points.shape[:2]
            shortest = tasks[run[0]].points.shape[1] if run else frames
            if run and ((rows + count) * frames > TOGETHER or frames > SPREAD * shortest):
                out |= zip(run, _descend([tasks[i] for i in run]), strict=True)
                run, rows = [], 0
            run.append(i)
            rows += count
        out |= zip(run, _descend([tasks[i] for i in run]), strict=True)
    return [out[i] for i in range(len(tasks))]


def _descend(tasks: list[Descent]) -> list[Pose]:
    """Tasks of one kind, the longest last, padded to its length."""
    last, counts = tasks[-1], [len(task.points) for task in tasks]
    frames = [task.points.shape[1] for task in tasks]
    within = None
    if frames[0] < frames[-1]:
        within = torch.tensor(frames).repeat_interleave(torch.tensor(counts)).to(last.points)
    anchor = torch.cat([task.points.new_full((len(task.points),), task.anchor) for task in tasks])
    held = torch.arange(frames[-1], device=last.points.device)
    pulled = [task.points[..., 2] if task.held is None else task.held for task in tasks]
    padded = [torch.nn.functional.pad(task.points, (0, 0, 0, 0, 0, frames[-1] - len(task.tracks))) for task in tasks]
    turned = [task.rotations[:, held.clamp_max(len(task.tracks) - 1)] for task in tasks]
    pose = procrustean(
        last.tracks, torch.cat(padded), torch.cat(turned), last.bones, weights=last.weights, rigid=last.rigid,
        stiffness=last.stiffness, noise=last.noise, stages=last.stages, counts=within,
        anchor=anchor if last.anchor > 0 else 0.0,
        held=torch.cat([torch.nn.functional.pad(z, (0, 0, 0, frames[-1] - z.shape[1])) for z in pulled]),
    )  # fmt: skip
    parts = (x.split(counts) for x in (pose.points, pose.rotations, pose.objective, pose.moved))
    return [
        Pose(points[:, :count], rotations[:, :count], objective, moved)
        for count, points, rotations, objective, moved in zip(frames, *parts, strict=True)
    ]
