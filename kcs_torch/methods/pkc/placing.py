"""Lengths and signs of depth of limbs whose trunk is known, by dynamic programming, of many limbs and clips at once."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import astuple, dataclass, fields, replace
from typing import Any, NamedTuple

import torch
from torch import Tensor

from kcs_torch.functional.temporal import window_starts
from kcs_torch.methods.clips.batches import SPREAD
from kcs_torch.methods.pkc.limb_costs import limb_costs
from kcs_torch.methods.pkc.limbs import Limb, SignCosts
from kcs_torch.nn.posture import PostureEnergy
from kcs_torch.skeleton import Hinge
from kcs_torch.solvers.signs import sign_costs, smooth_signs

__all__ = ["LimbPaths", "Placing", "limb_paths", "placing"]

WINDOW, OVERLAP = 200, 40
"""Frames whose signs are found together, and by how many neighbouring windows overlap."""

SAMPLE = 4
"""Windows from which the lengths of a long clip's bones are chosen."""

FAR = 1e4
"""Depth where a clip is padded, in accelerations' deviations: what a clip's last frames have to do with it costs the
same whatever their signs are."""

TOGETHER = 100_000
"""Costs that are made together, and signs' problems times frames: more would only fall out of the processor's cache."""


class LimbPaths(NamedTuple):
    """Lengths and signs of J limbs.

    Attributes:
        lengths: (J, M).
        depths: (J, T, M), signed.
        margins: (J, T, C), or None.
    """

    lengths: Tensor
    depths: Tensor
    margins: Tensor | None


@dataclass(frozen=True)
class Placing:
    """J limbs of M bones, of one clip or several, whose lengths and signs are to be found; see :func:`placing`.

    Attributes:
        image: (J, T, M, 2).
        noise: (J, T, M).
        rotations: (J, C, T, 3, 3).
        candidates: (J, K, M).
        usual: (J, M) lengths.
        mean: (J, M, 3) usual directions.
        weight: (J, M, 3) of what strays from them.
        free: (J, M).
        costs: (J, 8), as the fields of :class:`SignCosts`.
        inner: (J, 5) the hinges' axes, signs and firmness; None for limbs of one bone.
        entry: (J, 5) those of the hinges to the bones before, firmness 0 where there is none.
        before: (J, T, 3) directions of the bones before.
        transition: (J, T - 1, C, C), or None.
        inside: (J, T), False where clips of several lengths are padded; None where they are not.
        cap: as of :class:`SignCosts`, one for all.
        margins: whether they are wanted.
    """

    image: Tensor
    noise: Tensor
    rotations: Tensor
    candidates: Tensor
    usual: Tensor
    mean: Tensor
    weight: Tensor
    free: Tensor
    costs: Tensor
    inner: Tensor | None
    entry: Tensor
    before: Tensor
    transition: Tensor | None
    inside: Tensor | None
    cap: float
    margins: bool

    @property
    def frames(self) -> int:
        """T."""
        return self.image.shape[1]

    @property
    def kind(self) -> object:
        """What those share that are placed together, beside their length."""
        shapes = self.rotations.shape[1], self.candidates.shape[1:], self.transition is None, self.margins, self.cap
        return *shapes, self.image.dtype, self.image.device

    def cost(self) -> dict[str, Tensor]:
        """``costs`` by the names of the fields of :class:`SignCosts`, (J,) each."""
        return dict(zip((field.name for field in fields(SignCosts)), self.costs.unbind(1), strict=True))

    def padded(self, frames: int) -> Placing:
        """The same with as many frames."""
        more = frames - self.frames

        def pad(values: Tensor, dims: int) -> Tensor:
            """Zeros behind the frames, which ``dims`` dimensions follow."""
            return torch.nn.functional.pad(values, (0,) * (2 * dims) + (0, more))

        time = torch.arange(frames, device=self.image.device) < self.frames
        return replace(
            self,
            image=pad(self.image, 2),
            noise=pad(self.noise, 1),
            rotations=pad(self.rotations, 2),
            before=pad(self.before, 1),
            transition=None if self.transition is None else pad(self.transition, 2),
            inside=time.expand(len(self.image), -1),
        )

    def __getitem__(self, part: slice) -> Placing:
        """Some of the limbs."""
        values: dict[str, Any] = {f.name: getattr(self, f.name) for f in fields(self)}
        some: dict[str, Any] = {name: value[part] for name, value in values.items() if isinstance(value, Tensor)}
        return replace(self, **some)


def placing(
    image: Tensor,
    limbs: Sequence[Limb],
    rotations: Tensor,
    posture: PostureEnergy,
    free: Tensor,
    costs: SignCosts,
    noise: Tensor,
    *,
    candidates: Tensor,
    transition: Tensor | None = None,
    before: Sequence[Tensor | None] | None = None,
    margins: bool = False,
) -> Placing:
    """Limbs whose lengths are to be chosen among candidates, and their signs of depth, given paths of the trunk.

    Args:
        image: bones' images (T, B, 2), in units of the lengths.
        limbs: J limbs of M bones each.
        rotations: (C, T, 3, 3) of the trunk, or (J, C, T, 3, 3) of the trunk that each limb belongs to.
        posture: mean directions and spreads.
        free: (B,) 1 for bones that point anywhere.
        costs: weights.
        noise: (T, B) standard deviation of bones' images.
        candidates: lengths (J, K, M) to choose from.
        transition: (T - 1, C, C) cost of going from one trunk path to the other.
        before: (T, 3) direction of the bone before each limb, or None.
        margins: True also wants to know how much dearer the clip is if a frame takes the other trunk path.
    """
    count, frames = len(limbs), len(image)
    chains = torch.tensor([limb.bones for limb in limbs], device=image.device)  # (J, M)
    before = [None] * count if before is None else before
    none = image.new_zeros(frames, 3)
    axes = _facts([limb.inner for limb in limbs], posture)
    known = [limb.entry if near is not None else None for limb, near in zip(limbs, before, strict=True)]
    each = rotations if rotations.ndim == 5 else rotations.expand(count, *rotations.shape)
    return Placing(
        image=image[:, chains].movedim(0, 1),
        noise=noise[:, chains].movedim(0, 1),
        rotations=each,
        candidates=candidates,
        usual=posture.rest_lengths.to(image)[chains],
        mean=posture.mean.to(image)[chains],
        weight=posture.deviation.to(image).square().reciprocal()[chains],
        free=free.to(image)[chains],
        costs=image.new_tensor(astuple(costs)).expand(count, -1),
        inner=axes.to(image) if limbs[0].inner is not None else None,
        entry=_facts(known, posture).to(image),
        before=torch.stack([none if near is None else near for near in before]),
        transition=None if transition is None else transition.expand(count, *transition.shape),
        inside=None,
        cap=costs.cap,
        margins=margins,
    )


def limb_paths(tasks: Sequence[Placing]) -> list[LimbPaths]:
    """Place the limbs of all tasks; those of one kind and of nearly one length together."""
    groups: dict[object, list[list[int]]] = {}
    for i in sorted(range(len(tasks)), key=lambda i: tasks[i].frames):
        runs, frames = groups.setdefault(tasks[i].kind, []), tasks[i].frames
        least = tasks[runs[-1][0]].frames if runs else 0
        if frames == least or frames <= min(WINDOW, SPREAD * least):
            runs[-1].append(i)
        else:
            runs.append([i])
    out: dict[int, LimbPaths] = {}
    for run in (run for runs in groups.values() for run in runs):
        joined = _joined([tasks[i] for i in run])
        few = max(1, TOGETHER // (joined.candidates.shape[1] * joined.frames))
        parts = [_place(joined[first : first + few]) for first in range(0, len(joined.image), few)]
        found = [None if column[0] is None else torch.cat(column) for column in zip(*parts, strict=True)]
        counts = [len(tasks[i].image) for i in run]
        split = [[None] * len(run) if column is None else column.split(counts) for column in found]
        for i, (lengths, depths, margins) in zip(run, zip(*split, strict=True), strict=True):
            frames = tasks[i].frames
            out[i] = LimbPaths(lengths, depths[:, :frames], None if margins is None else margins[:, :frames])
    return [out[i] for i in range(len(tasks))]


def _joined(tasks: list[Placing]) -> Placing:
    """All limbs of several clips, those of shorter ones padded."""
    if len(tasks) == 1:
        return tasks[0]
    most = max(task.frames for task in tasks)
    if any(task.frames < most for task in tasks):
        tasks = [task.padded(most) for task in tasks]
    each: dict[str, Any] = {f.name: [getattr(task, f.name) for task in tasks] for f in fields(Placing)}
    whole: dict[str, Any] = {n: torch.cat(x) for n, x in each.items() if isinstance(x[0], Tensor)}
    return replace(tasks[0], **whole)


def _place(task: Placing) -> LimbPaths:
    """Choose lengths by some windows of the clip, then signs in all, which are stitched together."""
    size = min(WINDOW, task.frames)
    starts = window_starts(task.frames, size, min(OVERLAP, size - 1))
    lengths = _likeliest(task, starts, size)
    unary, deep, moves, depth = _problems(task, lengths[:, None], starts, size)
    path = smooth_signs(unary, deep, cap=task.cap, transition=moves, margins=task.margins)
    depth = depth.movedim(-1, 0)  # (J, T, M)
    signs = _stitched(path.signs.to(depth), starts, task.frames)
    margins = None if path.margins is None else _stitched(path.margins.amin(-1).to(depth), starts, task.frames)
    return LimbPaths(lengths, signs * depth, margins)


def _likeliest(task: Placing, starts: list[int], size: int) -> Tensor:
    """The lengths (J, M) among the candidates whose signs cost least in some windows of ``size`` frames."""
    count, tried, _ = task.candidates.shape
    if tried == 1:
        return task.candidates[:, 0]
    sample = starts
    if len(starts) > SAMPLE:
        sample = [starts[round(i * (len(starts) - 1) / (SAMPLE - 1))] for i in range(SAMPLE)]
    unary, deep, moves, _ = _problems(task, task.candidates, sample, size)
    cost = sign_costs(unary, deep, cap=task.cap, transition=moves).view(count, tried, -1).sum(-1)
    usual = task.cost()["proportions"][:, None, None]
    prior = 0.5 * ((task.candidates / task.usual[:, None]).log() / usual).square().sum(-1)
    best = (cost * (task.frames / (len(sample) * size)) + prior).argmin(-1)
    return task.candidates[torch.arange(count, device=best.device), best]


def _problems(
    task: Placing, lengths: Tensor, starts: list[int], size: int
) -> tuple[Tensor, Tensor, Tensor | None, Tensor]:
    """W windows of J limbs of K lengths (J, K, M) as problems of signs; and all depths (T, M, J K).

    Window w of length k of limb j is problem (j K + k) W + w.
    """
    count, frames, tried = len(lengths), task.frames, lengths.shape[1]
    few = max(1, TOGETHER // (tried * frames * task.rotations.shape[1] * 2 ** lengths.shape[2]))
    parts = [limb_costs(task[i : i + few], lengths[i : i + few]) for i in range(0, count, few)]
    unary, depth = (torch.cat([part[k] for part in parts], -2) for k in (0, 1))
    deep = depth / task.cost()["acceleration"][:, None]
    if task.inside is not None:
        outside = ~task.inside.mT[:, None, :, None]  # (T, 1, J, 1)
        unary, deep = unary.masked_fill(outside[:, None], 0), deep.masked_fill(outside, FAR)
    at = torch.tensor(starts, device=unary.device) + torch.arange(size, device=unary.device)[:, None]  # (T_w, W)

    def cut(values: Tensor) -> Tensor:
        """(T, ..., J, K) as (J K W, T_w, ...), in memory with the problems last."""
        return values.flatten(-2)[at].movedim(1, -1).flatten(-2).movedim(-1, 0)

    moves = None
    if task.transition is not None:
        moves = task.transition.float()[:, None, at[:-1].mT].expand(-1, tried, *[-1] * 4).flatten(0, 2)
    # Single precision is plenty to compare costs, and twice as fast.
    return cut(unary.float()), cut(deep.float()), moves, depth.flatten(-2)


def _stitched(windows: Tensor, starts: list[int], frames: int) -> Tensor:
    """Windows (J W, T_w, ...) as runs (J, T, ...), from one to the next in the middle of what they share."""
    windows = windows.unflatten(0, (-1, len(starts)))
    size = windows.shape[2]
    out = windows.new_empty(len(windows), frames, *windows.shape[3:])
    for i, begin in enumerate(starts):
        first = 0 if i == 0 else (starts[i - 1] + size - begin) // 2
        out[:, begin + first : begin + size] = windows[:, i, first:]
    return out


def _facts(hinges: Sequence[Hinge | None], posture: PostureEnergy) -> Tensor:
    """Hinges' axes in rest, signs and firmness, (J, 5); all 0 for none."""
    rest = posture.rest
    ends = [(0, 0) if hinge is None else (hinge.left, hinge.right) for hinge in hinges]
    left, right = rest[torch.tensor(ends, device=rest.device)].unbind(1)
    axis = torch.nn.functional.normalize(left - right, dim=-1)
    told = rest.new_tensor([(0.0, 0.0) if hinge is None else (hinge.sign, hinge.firm) for hinge in hinges])
    return torch.cat([axis, told], -1)
