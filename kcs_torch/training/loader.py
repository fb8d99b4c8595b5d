"""An endless order of batches that anybody can enter anywhere."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import lru_cache
from typing import Any

import torch
from torch import Tensor

from kcs_torch.training.batch import Batch
from kcs_torch.training.seeds import generator_of

__all__ = ["BatchLoader", "Deck"]


class Deck:
    """Items in random order, again and again; every item comes once before any comes twice.

    Args:
        items: (M,) what is drawn from.
        key: of the order (:func:`generator_of`).

    >>> deck = Deck(torch.tensor([5, 6, 7]), 0)
    >>> sorted(deck.draw(3, 3).tolist()), len(set(deck.draw(0, 9).tolist()))
    ([5, 6, 7], 3)
    """

    def __init__(self, items: Tensor, *key: object) -> None:
        self.items = items
        self._shuffled = lru_cache(maxsize=4)(
            lambda turn: items[torch.randperm(len(items), generator=generator_of(*key, turn))]
        )

    def __len__(self) -> int:
        return len(self.items)

    def draw(self, start: int, count: int) -> Tensor:
        """Items ``start`` to ``start + count`` of the endless order."""
        parts = []
        while count > 0:
            turn, place = divmod(start, len(self.items))
            parts.append(self._shuffled(turn)[place : place + count])
            start, count = start + len(parts[-1]), count - len(parts[-1])
        return torch.cat(parts) if parts else self.items[:0]


class BatchLoader:
    """Yields the batches of one epoch after another; batch k of epoch e is always the same.

    Lightning tells it the epoch and keeps its place in checkpoints; a loop of one's own just iterates over it, and each
    time is another epoch.

    Args:
        make: the batch of an epoch and a step.
        steps: batches of an epoch; processes that train together deal them out, each the same number.
        fixed: whether all epochs are the first one, and all processes get every batch: for validation.
    """

    def __init__(self, make: Callable[[int, int], Batch], steps: int, *, fixed: bool = False) -> None:
        self.make, self.steps, self.fixed = make, steps, fixed
        self.epoch = self._first = self._place = 0
        if not fixed:
            self.sampler, self.batch_sampler = self, None  # where Lightning looks for set_epoch

    def __len__(self) -> int:
        return self.steps if self.fixed else max(1, self.steps // _rank()[1])

    def set_epoch(self, epoch: int) -> None:
        """Go to the first batch of an epoch, unless it is this one."""
        if epoch != self.epoch:
            self.epoch, self._first, self._place = epoch, 0, 0

    def __iter__(self) -> Iterator[Batch]:
        first, self._first = self._first, 0
        epoch = self.epoch
        rank, ranks = (0, 1) if self.fixed else _rank()
        steps = len(self)
        for step in range(first, steps):
            batch = self.make(0 if self.fixed else epoch, step * ranks + rank)
            if step + 1 < steps:
                self._place = step + 1
            elif self.epoch == epoch:
                self.epoch, self._place = epoch + 1, 0
            yield batch

    def state_dict(self) -> dict[str, Any]:
        """Where it is: the next batch."""
        return {"epoch": self.epoch, "step": self._place}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Go on from there."""
        self.epoch, self._first = int(state["epoch"]), int(state["step"])
        self._place = self._first


def _rank() -> tuple[int, int]:
    """This process's number among those that train together, and how many these are."""
    if torch.distributed.is_available() and torch.distributed.is_initialized():
        return torch.distributed.get_rank(), torch.distributed.get_world_size()
    return 0, 1
