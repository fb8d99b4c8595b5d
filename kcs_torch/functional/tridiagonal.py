"""Symmetric tridiagonal systems, of chains of unknowns that are each tied to the next."""

from __future__ import annotations

import torch
from torch import Tensor

__all__ = ["solve_tridiagonal"]

DENSE = 24
"""Unknowns up to which a dense solve is as fast."""


def solve_tridiagonal(diagonal: Tensor, beside: Tensor, right: Tensor) -> Tensor:
    """Solve A x = r for A symmetric, positive definite and tridiagonal, by cyclic reduction.

    Every second unknown is eliminated, which leaves a system of half the size; so it goes on. All of a size are done
    at once: the work is O(T), in O(log T) operations.

    Args:
        diagonal: of A, (..., T).
        beside: the diagonals beside it, (..., T - 1).
        right: r (..., T).

    Returns:
        x (..., T).

    >>> one = torch.ones(5)
    >>> solve_tridiagonal(2 * one, -one[:4], torch.tensor([1.0, 0.0, 0.0, 0.0, 1.0])).round(decimals=5).tolist()
    [1.0, 1.0, 1.0, 1.0, 1.0]
    """
    size = diagonal.shape[-1]
    if size <= DENSE:
        matrix = diagonal.diag_embed() + beside.diag_embed(1) + beside.diag_embed(-1)
        return torch.linalg.solve(matrix, right)
    pad = torch.nn.functional.pad
    odd, goal = diagonal[..., 1::2], right[..., 1::2]
    before, after = beside[..., ::2], pad(beside[..., 1::2], (0, size % 2 == 0))  # of odd unknowns, to even ones
    low, high = before / odd, after / odd
    ends = (0, size % 2), (1, size % 2 - 1)  # odd unknown k lies between the even unknowns k and k + 1
    spread = lambda x, y: pad(x, ends[0]) + pad(y, ends[1])  # noqa: E731
    rest = solve_tridiagonal(
        diagonal[..., ::2] - spread(before * low, after * high),
        -(before * high)[..., : (size - 1) // 2],
        right[..., ::2] - spread(low * goal, high * goal),
    )
    between = goal / odd - low * rest[..., : size // 2] - high * pad(rest, (0, size % 2 == 0))[..., 1:]
    return torch.stack([rest, pad(between, ends[0])], -1).flatten(-2)[..., :size]
