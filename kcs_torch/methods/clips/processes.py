"""Several processes for one call: bodies are solved by many small operations, which threads do not speed up."""

from __future__ import annotations

import io
import pickle
import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from itertools import starmap
from typing import Any, TypeVar

import torch
from torch import Tensor

from kcs_torch.errors import KcsWarning, OptionError, users_level
from kcs_torch.types import Tracks
from kcs_torch.types.hints import is_a

__all__ = ["check_workers", "spread", "spread_batch"]

Found = TypeVar("Found")


def check_workers(workers: int, people: Sequence[Tracks]) -> None:
    """Make sure that these bodies can be solved in so many processes.

    Raises:
        OptionError: the number is none; tracks are on a GPU, which takes all as one batch; or joblib is missing.
    """
    if not is_a(workers, int) or workers < 1:
        raise OptionError(f"workers: expected a whole number of processes >= 1, got {workers!r}")
    if workers > 1:
        if devices := sorted({str(one.points.device) for one in people if one.points.device.type != "cpu"}):
            raise OptionError(
                f"workers: expected 1 for tracks on {devices[0]}, which takes many clips as one batch, got {workers}"
            )
        try:
            import joblib  # noqa: F401
        except ImportError as reason:
            raise OptionError(f"workers: needs the package joblib ({reason}): pip install joblib") from None


def spread(solve: Callable[..., Found], *columns: Iterable[Any], workers: int = 1) -> Iterator[Found]:
    """What ``map(solve, *columns)`` gives, from several processes where there is work for them.

    Args:
        solve: can be pickled, by cloudpickle if need be.
        columns: of arguments: tracks, lists of them, and what this library makes of them.
        workers: processes, at most. With 1 all is solved in this one, each when it is asked for.

    Returns:
        Results in order; they hold the tracks that were given, not copies. Warnings are given in order, too.

    Raises:
        OptionError: a process died.
    """
    rows = list(zip(*columns, strict=True))
    if min(workers, len(rows)) < 2:
        yield from starmap(solve, rows)
        return
    for found, said in _answers(solve, rows, workers):
        for warning in said:
            warning.give()
        yield found


def spread_batch(
    solve: Callable[[Sequence[Tracks]], list[Found]], tracks: Sequence[Tracks], workers: int = 1
) -> list[Found]:
    """What ``solve(tracks)`` gives, of a function that solves clips together, from several processes.

    Each process gets about the same number of frames, in clips of similar lengths. Warnings are given in the order of
    the clips whose sources they begin with.

    Args:
        solve: as of :func:`spread`.
        tracks: of any lengths.
        workers: processes, at most.
    """
    parts = _shares([one.num_frames for one in tracks], workers)
    if len(parts) < 2:
        return solve(tracks)
    found: dict[int, Found] = {}
    told: list[tuple[int, _Said]] = []
    rows = [([tracks[i] for i in part],) for part in parts]
    for part, (results, said) in zip(parts, _answers(solve, rows, workers), strict=True):
        found |= zip(part, results, strict=True)
        for one in said:
            whose = (i for i in part if one.text.startswith(f"{tracks[i].source}: "))
            told.append((next(whose, part[0]), one))
    for _, one in sorted(told, key=lambda pair: pair[0]):
        one.give()
    return [found[i] for i in range(len(tracks))]


def _shares(frames: Sequence[int], count: int) -> list[list[int]]:
    """The numbers of clips, divided into parts of about the same number of frames and of similar lengths.

    >>> _shares([30, 100, 29, 41], 2)
    [[0, 2, 3], [1]]
    """
    parts: list[list[int]] = [[] for _ in range(min(count, len(frames)))]
    before, total = 0, sum(frames)
    for i in sorted(range(len(frames)), key=lambda i: frames[i]):
        middle = before + frames[i] / 2
        parts[int(middle * len(parts) / total)].append(i)
        before += frames[i]
    return [sorted(part) for part in parts if part]


@dataclass(frozen=True)
class _Said:
    """A warning of another process."""

    text: str
    category: type[Warning]
    file: str
    line: int

    def give(self) -> None:
        """Warn here, where the user's filters are; of this library's, at the user's own line."""
        if issubclass(self.category, KcsWarning):
            warnings.warn(self.text, self.category, stacklevel=users_level())
        else:
            warnings.warn_explicit(self.text, self.category, self.file, self.line)


def _answers(
    solve: Callable[..., Found], rows: Sequence[tuple[Any, ...]], workers: int
) -> Iterator[tuple[Found, list[_Said]]]:
    """What a function gives for each row of arguments, and what it warns of, in other processes."""
    from joblib import Parallel, delayed, parallel_config

    count = min(workers, len(rows))
    # One thread each: more hardly help, and by their number, which would depend on the count, new pools would start.
    with warnings.catch_warnings(), parallel_config("loky", n_jobs=count, inner_max_num_threads=1):
        warnings.filterwarnings("ignore", "A worker stopped", UserWarning)  # another goes on with its work
        try:
            answers = Parallel(max_nbytes=None)(delayed(_answer)(solve, _packed(row)) for row in rows)
        except BrokenProcessPool as error:
            if error.__cause__ is not None:  # something did not go through; it tells what
                raise
            raise OptionError(
                f"workers: one of {count} processes ended before its work was done, most likely as there was no more "
                "memory: use fewer workers"
            ) from error
    for row, (found, said) in zip(rows, answers, strict=True):
        yield _unpacked(found, _held(row)), said


def _answer(solve: Callable[..., Any], packed: bytes) -> tuple[bytes, list[_Said]]:
    """In another process: solve, and keep what is warned of."""
    row = _unpacked(packed)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("default")
        warnings.simplefilter("always", KcsWarning)
        found = solve(*row)
    said = [_Said(str(one.message), one.category, one.filename, one.lineno) for one in caught]
    return _packed(found, _held(row)), said


def _held(row: Iterable[Any]) -> list[object]:
    """What both processes hold: the tracks of a row of arguments, alone or in lists, and their skeletons."""
    each = (one for part in row for one in (part if isinstance(part, list) else [part]))
    return [held for one in each if isinstance(one, Tracks) for held in (one, one.skeleton)]


def _packed(value: object, held: Sequence[object] = ()) -> bytes:
    file = io.BytesIO()
    _Packer(file, held).dump(value)
    return file.getvalue()


def _unpacked(packed: bytes, held: Sequence[object] = ()) -> Any:
    with torch.inference_mode(False):  # as results are that are made here
        return _Unpacker(packed, held).load()


class _Packer(pickle.Pickler):
    """Pickles all but what the other process holds, and of a tensor that is a part of another only this part."""

    def __init__(self, file: io.BytesIO, held: Sequence[object]) -> None:
        super().__init__(file, pickle.HIGHEST_PROTOCOL)
        self._held = {id(one): i for i, one in enumerate(held)}

    def persistent_id(self, value: object) -> int | None:
        return self._held.get(id(value))

    def reducer_override(self, value: object) -> Any:
        return (torch.from_numpy, (value.detach().numpy(),)) if isinstance(value, Tensor) else NotImplemented


class _Unpacker(pickle.Unpickler):
    def __init__(self, packed: bytes, held: Sequence[object]) -> None:
        super().__init__(io.BytesIO(packed))
        self._held = held

    def persistent_load(self, number: int) -> object:
        return self._held[number]
