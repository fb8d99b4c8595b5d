"""What all of :mod:`kcs_torch.clean` does: rates, runs of seen frames, and new tracks from old."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from kcs_torch.errors import OptionError, ShapeError
from kcs_torch.types import Tracks
from kcs_torch.types.intake import as_number, check_rate

__all__ = [
    "Array",
    "check_rate",
    "check_seen",
    "check_tracks",
    "frame_rate",
    "number",
    "rebuilt",
    "runs",
    "share",
]

Array = NDArray[np.float64]


def check_tracks(given: Any, what: str, kinds: tuple[type, ...] = (Tracks,)) -> None:
    """Raise an OptionError unless tracks, or one of the kinds named, are given."""
    if not isinstance(given, kinds):
        wanted = " or ".join(kind.__name__ for kind in kinds)
        raise OptionError(f"{what}: expected {wanted}, got {type(given).__name__}")


def check_seen(tracks: Tracks, what: str) -> None:
    """Raise a ShapeError unless some frame of the tracks shows a joint."""
    if not bool(tracks.seen.any()):
        raise ShapeError(f"{tracks.source}: {what}: expected joints that are seen in some frame, got none")


def number(value: Any, what: str, expected: str, *, above: float = 0.0, below: float = math.inf) -> float:
    """A finite number within limits, both excluded.

    Raises:
        OptionError: it is something else; the message says what was expected.
    """
    found = as_number(value)
    if found is None:
        raise OptionError(f"{what}: expected {expected}, got {value!r}")
    if not above < found < below:
        raise OptionError(f"{what}: expected {expected}, got {found:g}")
    return found


def frame_rate(own: float | None, given: float | None, what: str, source: str) -> float:
    """Frames a second: as given, or as the tracks have it.

    Raises:
        OptionError: neither is known, or it is no positive number.
    """
    if given is None and own is None:
        raise OptionError(
            f"{what}: {source} does not say how many frames a second it has: give fps=... (kcs-torch: --fps)"
        )
    return check_rate(own if given is None else given, f"{what}: fps")


def runs(seen: NDArray[np.bool_]) -> list[tuple[int, int]]:
    """First frame and end (not included) of each run of True in (T,).

    >>> runs(np.array([True, True, False, True]))
    [(0, 2), (3, 4)]
    """
    steps = np.diff(np.concatenate([[0], seen.astype(np.int8), [0]]))
    return list(zip(np.flatnonzero(steps == 1).tolist(), np.flatnonzero(steps == -1).tolist(), strict=True))


def share(count: int, whole: int) -> str:
    """A count with its per cent, such as "12 of 4000 (0.3 %)"."""
    part = 100 * count / max(whole, 1)
    return f"{count} of {whole} ({part:.0f} %)" if part >= 10 else f"{count} of {whole} ({part:.2g} %)"


def rebuilt(tracks: Tracks, points: Tensor, weights: Tensor, note: str, *, fps: float | None = None) -> Tracks:
    """Tracks with other points (T, N, 2) and weights (T, N) of the observed joints; the virtual ones follow from them.

    Raises:
        ShapeError: no joint is seen.
    """
    weights = weights.to(tracks.weights)
    points = torch.where(weights[..., None] > 0, points.to(tracks.points), 0)
    if not bool((weights > 0).any()):
        raise ShapeError(f"{tracks.source}: {note}: no joint is left seen in any frame")
    points, weights = tracks.skeleton.complete(points, weights)
    rate = tracks.fps if fps is None else fps
    made = replace(tracks, points=points, weights=weights, fps=rate).noted_anew(tracks.weights)
    return replace(made, notes=(*made.notes, note))
