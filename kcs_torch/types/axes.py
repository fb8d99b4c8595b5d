"""Which way is up: a camera's pitch; from and to the axes of :class:`Motion`, by turns that keep left and right."""

from __future__ import annotations

from typing import Any

from torch import Tensor

from kcs_torch.errors import OptionError, unknown
from kcs_torch.types.intake import as_number

__all__ = ["AXES", "check_pitch", "from_y_up", "to_y_up"]

# Rows: what x, y (up) and z of a Motion are in the other axes.
AXES = {
    "y": ((1, 0, 0), (0, 1, 0), (0, 0, 1)),
    "z": ((1, 0, 0), (0, 0, 1), (0, -1, 0)),
    "x": ((0, -1, 0), (1, 0, 0), (0, 0, 1)),
    "-y": ((1, 0, 0), (0, -1, 0), (0, 0, -1)),  # the camera's axes
    "-z": ((1, 0, 0), (0, 0, -1), (0, 1, 0)),
}


def check_pitch(pitch: Any) -> float:
    """The degrees by which a camera looked down.

    Raises:
        OptionError: it is no number, or not within -90 to 90.
    """
    degrees = as_number(pitch)
    if degrees is None or not abs(degrees) <= 90:
        raise OptionError(f"pitch: expected the degrees by which the camera looked down, -90 to 90, got {pitch!r}")
    return degrees


def to_y_up(points: Tensor, up: str) -> Tensor:
    """Turn points (..., 3) of axes in which ``up`` is up so that y is.

    Raises:
        OptionError: there are no such axes.

    >>> import torch
    >>> to_y_up(torch.tensor([1.0, 2, 3]), "z").tolist()
    [1.0, 3.0, -2.0]
    """
    return points @ _rows(points, up).mT


def from_y_up(points: Tensor, up: str) -> Tensor:
    """Undo :func:`to_y_up`."""
    return points @ _rows(points, up)


def _rows(points: Tensor, up: str) -> Tensor:
    if up not in AXES:
        raise unknown("axis for up", up, AXES)
    return points.new_tensor(AXES[up])
