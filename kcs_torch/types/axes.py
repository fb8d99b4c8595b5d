"""Which way is up: from and to the axes of :class:`Motion`, by turns that keep left and right."""

from __future__ import annotations

from torch import Tensor

from kcs_torch.errors import unknown

__all__ = ["AXES", "from_y_up", "to_y_up"]

# Rows: what x, y (up) and z of a Motion are in the other axes.
AXES = {
    "y": ((1, 0, 0), (0, 1, 0), (0, 0, 1)),
    "z": ((1, 0, 0), (0, 0, 1), (0, -1, 0)),
    "x": ((0, -1, 0), (1, 0, 0), (0, 0, 1)),
    "-y": ((1, 0, 0), (0, -1, 0), (0, 0, -1)),  # the camera's axes
    "-z": ((1, 0, 0), (0, 0, -1), (0, 1, 0)),
}


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
