"""Coordinates that are shares of the image, 0 to 1, rather than pixels."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

__all__ = ["ASK", "SIZE_HINT", "are_shares", "in_pixels"]

SIZE_HINT = "image_size=(width, height) (kcs-torch: --image-size 1920x1080)"
ASK = f"coordinates are taken as they are: if they are shares of the image, give {SIZE_HINT}"
_SHARES = 2.0  # coordinates whose median is above this are no shares of the image


def are_shares(places: NDArray[np.float64]) -> bool:
    """Whether places (..., 2) in an image, some of which may be NaN, are shares of it rather than pixels."""
    known = places[np.isfinite(places)]
    return len(known) > 0 and bool(np.median(np.abs(known)) <= _SHARES)


def in_pixels(points: NDArray[np.float64], size: tuple[int, int] | None, notes: list[str]) -> NDArray[np.float64]:
    """Shares (..., 2) of an image of this size in pixels; where the size is not known a note asks for it."""
    if size is not None:
        return points * np.array(size)
    if ASK not in notes:  # as they are in a file that was saved with it
        notes.append(ASK)
    return points
