"""What the searches of several clips ask for, answered as one batch each."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

from kcs_torch.methods.clips.size import weak_perspectives
from kcs_torch.methods.pkc.descents import TOGETHER, Descent, descend_all
from kcs_torch.methods.pkc.placing import Placing, limb_paths
from kcs_torch.methods.pkc.refinement import Task, minimise_all
from kcs_torch.methods.pkc.trunk import Facing, facings
from kcs_torch.methods.sfam import SfAM
from kcs_torch.solvers.denoise import Denoised, denoise_tracks
from kcs_torch.types import Tracks

__all__ = ["Noisy", "Sized", "clean_all", "is_descent", "serve"]


class Noisy(NamedTuple):
    """Tracks (T, N, 2) of weights (T, N), at times (T,), to be cleaned by :func:`denoise_tracks`; and its settings."""

    points: Tensor
    weights: Tensor
    time: Tensor
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
        Tracks: lambda asked: SfAM().solve_all(asked),  # made where it is asked for: checks of its fields take time
    }
    out: dict[int, Any] = {}
    for kind, answer in answers.items():
        asked = [i for i, one in enumerate(requests) if isinstance(one, kind)]
        if asked:
            out |= zip(asked, answer([requests[i] for i in asked]), strict=True)
    return [out[i] for i in range(len(requests))]


def is_descent(request: object) -> bool:
    """Whether this is a descent: clips come to theirs after searches of different lengths."""
    return isinstance(request, Descent)


def clean_all(tasks: Sequence[Noisy]) -> list[Denoised]:
    """:func:`denoise_tracks` of each task; those of equal size together."""
    groups: dict[object, list[int]] = {}
    for i, (points, _, _, *settings) in enumerate(tasks):
        groups.setdefault((points.shape, points.dtype, points.device, *settings), []).append(i)
    out: dict[int, Denoised] = {}
    for group in groups.values():
        few = max(1, TOGETHER // tasks[group[0]].points.shape[0])
        for run in (group[begin : begin + few] for begin in range(0, len(group), few)):
            points, weights, time = (torch.stack(part) for part in zip(*(tasks[i][:3] for i in run), strict=True))
            first = tasks[run[0]]
            found = denoise_tracks(points, weights, time=time, window=first.window, quick=first.quick)
            out |= {i: Denoised(*row) for i, row in zip(run, zip(*found, strict=True), strict=True)}
    return [out[i] for i in range(len(tasks))]
