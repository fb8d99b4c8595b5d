"""Clips of many lengths as few batches: padded to the longest, with a mask."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass
from typing import TypeVar

import torch
from torch import Tensor
from torch.nn.utils.rnn import pad_sequence

from kcs_torch.types import Tracks

__all__ = ["FRAMES", "SPREAD", "Clips", "batches", "in_batches", "padded"]

FRAMES = 2048
"""Frames of a batch, padding included, on a processor: more would leave its cache."""

SHARE = 128 * 1024
"""Bytes of a GPU's memory for each frame of a batch: methods take a third of it in double precision."""

SPREAD = 1.5
"""The longest clip of a batch has at most so many times the frames of the shortest: no more than a third is padding."""

Found = TypeVar("Found")


@dataclass(frozen=True)
class Clips:
    """K clips of one skeleton, padded to T frames.

    Attributes:
        points: (K, T, N, 2), 0 in the padding.
        weights: (K, T, N), 0 in the padding.
        inside: (K, T), False in the padding; None where there is none.
        counts: frames of each clip.
    """

    points: Tensor
    weights: Tensor
    inside: Tensor | None
    counts: tuple[int, ...]

    @classmethod
    def of(cls, tracks: Sequence[Tracks]) -> Clips:
        """Pad tracks of one skeleton."""
        counts = tuple(one.num_frames for one in tracks)
        points, weights = padded([one.points for one in tracks]), padded([one.weights for one in tracks])
        if len(set(counts)) == 1:
            return cls(points, weights, None, counts)
        time = torch.arange(max(counts), device=points.device)
        return cls(points, weights, time < torch.tensor(counts, device=points.device)[:, None], counts)

    @property
    def seen(self) -> Tensor:
        """(K, T, N), True where a joint is seen."""
        return self.weights > 0

    def to(self, device: torch.device | str) -> Clips:
        """The same on a device."""
        inside = None if self.inside is None else self.inside.to(device)
        return Clips(self.points.to(device), self.weights.to(device), inside, self.counts)

    def fill(self, values: Tensor, padding: float) -> Tensor:
        """Values (K, T, ...) with a number in the padding."""
        if self.inside is None:
            return values
        return torch.where(self.inside.view(*self.inside.shape, *[1] * (values.ndim - 2)), values, padding)

    def take(self, index: Tensor) -> Clips:
        """Some of the clips, (k,) of their numbers."""
        inside = None if self.inside is None else self.inside[index]
        return Clips(self.points[index], self.weights[index], inside, tuple(self.counts[i] for i in index.tolist()))

    def mean(self, values: Tensor) -> Tensor:
        """Means (K, ...) over the frames of (K, T, ...), which are 0 in the padding."""
        count = torch.tensor(self.counts, dtype=values.dtype, device=values.device)
        return values.sum(1) / count.view(-1, *[1] * (values.ndim - 2))

    def frames(self, values: Tensor) -> Tensor:
        """All frames (F, ...) of (K, T, ...), one clip after the other."""
        return values.flatten(0, 1) if self.inside is None else values[self.inside]

    def as_clips(self, values: Tensor) -> Tensor:
        """The way back, of (H, F, ...): (H, K, T, ...), 0 in the padding."""
        if self.inside is None:
            return values.unflatten(1, (len(self.counts), -1))
        out = values.new_zeros(len(values), *self.inside.shape, *values.shape[2:])
        out[:, self.inside] = values
        return out

    def cut(self, values: Tensor) -> list[Tensor]:
        """Each clip's own frames of (K, T, ...)."""
        return [one[:count] for one, count in zip(values, self.counts, strict=True)]


def padded(parts: Sequence[Tensor]) -> Tensor:
    """Tensors (T_k, ...) as one (K, T, ...), with zeros behind the shorter ones."""
    return (
        torch.stack(list(parts)) if len({len(x) for x in parts}) == 1 else pad_sequence(list(parts), batch_first=True)
    )


def batch_frames(device: torch.device) -> int:
    """Frames of a batch, at most."""
    if device.type != "cuda":
        return FRAMES
    return max(FRAMES, torch.cuda.get_device_properties(device).total_memory // SHARE)


def in_batches(
    tracks: Sequence[Tracks],
    solve: Callable[[list[Tracks]], list[Found]],
    kind: Callable[[Tracks], Hashable] = lambda _: None,
) -> list[Found]:
    """Solve clips in :func:`batches`; results in the order of the clips.

    Args:
        tracks: of any skeletons and lengths.
        solve: takes clips of one skeleton, dtype, device and kind.
        kind: what else the clips of a batch share.
    """
    found: dict[int, Found] = {}
    for batch in batches(tracks, kind):
        found |= zip(batch, solve([tracks[i] for i in batch]), strict=True)
    return [found[i] for i in range(len(tracks))]


def batches(
    tracks: Sequence[Tracks], kind: Callable[[Tracks], Hashable] = lambda _: None, most: int | None = None
) -> list[list[int]]:
    """Clips, by their numbers, in batches of one skeleton, dtype, device and kind, and of nearly one length.

    Args:
        tracks: of any skeletons and lengths.
        kind: what else the clips of a batch share.
        most: frames of a batch at most, as many as their device has room for if None; a clip by itself may have more.
    """
    order = sorted(range(len(tracks)), key=lambda i: tracks[i].num_frames)
    groups: dict[object, list[list[int]]] = {}
    for i in order:
        one = tracks[i]
        own = groups.setdefault((one.skeleton, one.points.dtype, one.points.device, kind(one)), [])
        last = own[-1] if own else []
        room = batch_frames(one.points.device) if most is None else most
        fits = last and (len(last) + 1) * one.num_frames <= room
        if fits and one.num_frames <= SPREAD * tracks[last[0]].num_frames:
            last.append(i)
        else:
            own.append([i])
    return [batch for own in groups.values() for batch in own]
