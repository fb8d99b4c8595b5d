"""Coordinates that are shares of the image, 0 to 1, rather than pixels."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from kcs_torch.types.image_size import are_shares

__all__ = ["ASK", "SIZE_HINT", "are_shares", "in_pixels"]

SIZE_HINT = "image_size=(width, height) (kcs-torch: --image-size 1920x1080)"
ASK = f"coordinates are taken as they are: if they are shares of the image, give {SIZE_HINT}"


def in_pixels(points: NDArray[np.float64], size: tuple[int, int] | None, notes: list[str]) -> NDArray[np.float64]:
    """Shares (..., 2) of an image of this size in pixels; where the size is not known a note asks for it."""
    if size is not None:
        return points * np.array(size)
    if ASK not in notes:  # as they are in a file that was saved with it
        notes.append(ASK)
    return points
