"""How fast a body moves towards the camera, told by feet that stand still."""

from __future__ import annotations

import torch
from torch import Tensor

from kcs_torch.functional.precision import widened
from kcs_torch.functional.shapes import check_core
from kcs_torch.functional.tridiagonal import solve_tridiagonal

__all__ = ["RIDGE", "root_velocity"]

RIDGE = 1e-3
"""Weight by which velocities that no foot tells are drawn to 0, over that of a foot that surely stands."""


@widened
def root_velocity(
    move: Tensor, weight: Tensor, slip: float, change: float, *, num_steps: int = 10, inside: Tensor | None = None
) -> Tensor:
    """Return the body's velocity in depth at which standing feet stand still.

    min over v of 1/2 sum_tc w_tc log(1 + ((m_tc + v_t)/s)^2) + 1/2 sum_t ((v_t - v_t-1)/a)^2 + RIDGE/2 sum_t (v_t/s)^2,
    by iteratively reweighted least squares.

    Args:
        move: m (..., T, C), change of the feet's depth from a frame to the next, relative to the body.
        weight: w (..., T, C), how surely each foot stands, 0 to 1.
        slip: s, standard deviation of a standing foot's velocity.
        change: a, standard deviation of the change of the body's velocity.
        num_steps: reweightings.
        inside: (..., T), False in changes to frames that pad a shorter clip; their velocity is 0.

    Returns:
        v (..., T), the body's change of depth from a frame to the next.

    Raises:
        ShapeError: they are not of these shapes.

    >>> move = torch.tensor([[-0.1], [-0.1], [-0.1], [0.3]])  # the foot stands, and then swings
    >>> root_velocity(move, torch.tensor([[1.0], [1.0], [1.0], [0.0]]), 0.006, 0.004).round(decimals=2).tolist()
    [0.1, 0.1, 0.1, 0.1]
    """
    check_core(move, "root_velocity: move", "T", "C")
    check_core(weight, "root_velocity: weight", *move.shape[-2:])
    if inside is not None:
        check_core(inside, "root_velocity: inside", move.shape[-2])
    velocity = torch.zeros_like(move[..., 0])
    tie = torch.full_like(velocity[..., 1:], -((slip / change) ** 2))  # of each to the next, over a standing foot's
    if inside is not None:
        tie = tie * inside[..., 1:]
    own = RIDGE + torch.nn.functional.pad(-tie, (0, 1)) + torch.nn.functional.pad(-tie, (1, 0))
    for _ in range(num_steps):
        pull = weight / (1 + ((move + velocity[..., None]) / slip).square())
        velocity = solve_tridiagonal(own + pull.sum(-1), tie, -(pull * move).sum(-1))
    return velocity
