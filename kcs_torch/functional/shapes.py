"""Batch dimensions of several tensors."""

from __future__ import annotations

from collections.abc import Sequence

from kcs_torch.errors import ShapeError

__all__ = ["broadcast_shapes", "fit_together"]


def broadcast_shapes(*shapes: Sequence[int]) -> tuple[int, ...]:
    """Return the shape that all broadcast to; ``torch.broadcast_shapes``, whose first call takes a third of a second.

    Raises:
        ShapeError: they do not.

    >>> broadcast_shapes((4, 1), (3,), ())
    (4, 3)
    """
    common: list[int] = []
    for shape in shapes:
        common = [1] * (len(shape) - len(common)) + common
        for k in range(1, len(shape) + 1):
            if shape[-k] != 1:
                if common[-k] != 1 and common[-k] != shape[-k]:
                    told = ", ".join(str(tuple(each)) for each in shapes)
                    raise ShapeError(f"batch dimensions: expected sizes that are equal or 1, got {told}")
                common[-k] = shape[-k]
    return tuple(common)


def fit_together(one: Sequence[int], other: Sequence[int]) -> bool:
    """Whether two shapes broadcast.

    >>> fit_together((4, 1), (3,)), fit_together((4,), (3,))
    (True, False)
    """
    return all(a == b or 1 in (a, b) for a, b in zip(one[::-1], other[::-1], strict=False))
