"""Limited-memory BFGS for many problems at once."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from kcs_torch.solvers.iterate import Solution

__all__ = ["lbfgs"]


def lbfgs(
    energy: Callable[[Tensor], Any],
    start: Tensor,
    *,
    num_steps: int = 100,
    memory: int = 10,
    tolerance: float = 1e-6,
    max_trials: int = 12,
    first_step: float = 1e-2,
    slopes: bool = False,
) -> Solution[Tensor]:
    """Minimise ``energy`` of each row of ``start`` by L-BFGS with a backtracking line search (Nocedal 1980).

    All problems move in lockstep, each with its own history and step length, so that many starts of one problem cost
    little more than one. A step is taken only where it lowers the energy enough (Armijo) and is finite.

    Args:
        energy: maps (H, D) to (H,), differentiable; row h depends on row h alone.
        start: (H, D).
        num_steps: steps, at most.
        memory: pairs of differences kept.
        tolerance: a problem rests once ten steps lower its energy by less than this share of its size.
        max_trials: halvings of a step; a problem whose step fails restarts from steepest descent, then rests.
        first_step: length of the first step, a share of the start's root mean square (of 1 where that is 0).
        slopes: ``energy`` returns its gradient, too: (H,) and (H, D). Else autograd tells it.

    Returns:
        The minimisers (H, D); whether all settled within ``num_steps``; where they were ten steps earlier.

    >>> goal = torch.tensor([[1.0, 2.0], [3.0, -1.0]], dtype=torch.float64)
    >>> lbfgs(lambda x: ((x - goal) ** 2).sum(-1), torch.zeros_like(goal)).value.round(decimals=4).tolist()
    [[1.0, 2.0], [3.0, -1.0]]
    """

    def evaluate(x: Tensor) -> tuple[Tensor, Tensor]:
        if slopes:
            with torch.no_grad():
                pair: tuple[Tensor, Tensor] = energy(x)
            return pair
        with torch.enable_grad():
            x = x.detach().requires_grad_()
            value = energy(x)
            (gradient,) = torch.autograd.grad(value.sum(), x)
        return value.detach(), gradient

    dot = lambda a, b: (a * b).sum(-1, keepdim=True)  # noqa: E731
    x = start.detach()
    value, gradient = evaluate(x)
    tiny = torch.finfo(x.dtype).tiny ** 0.5
    count = (gradient != 0).sum(-1, keepdim=True).clamp_min(1)  # what the energy does not depend on is padding
    size = (x.square().sum(-1, keepdim=True) / count).sqrt()
    size = torch.where(size > 0, size, torch.ones_like(size))
    steepest = first_step * size / (gradient.square().sum(-1, keepdim=True) / count).sqrt().clamp_min(tiny)
    moves: list[Tensor] = []
    turns: list[Tensor] = []
    inverses: list[Tensor] = []
    scale = steepest
    resting = torch.zeros_like(value, dtype=torch.bool)
    failed = torch.zeros_like(resting)
    past, places = [value], [x]
    least = torch.where(value.isfinite(), torch.finfo(x.dtype).eps * value.abs(), 0).clamp_min(tiny)  # if it falls to 0
    settled, rest, made = False, False, 0
    for made in range(1, num_steps + 1):
        q = gradient.clone()
        shares = []
        for s, y, r in zip(reversed(moves), reversed(turns), reversed(inverses), strict=True):
            shares.append(r * dot(s, q))
            q.addcmul_(y, shares[-1], value=-1)
        q.mul_(scale)
        for (s, y, r), a in zip(zip(moves, turns, inverses, strict=True), reversed(shares), strict=True):
            q.addcmul_(s, a - r * dot(y, q))
        downhill = dot(q, gradient) > 0
        direction = -torch.where(downhill & ~failed[:, None], q, steepest * gradient)
        slope = dot(direction, gradient)[:, 0]
        length = torch.ones_like(value)
        done = resting
        new_x, new_value, new_gradient = x, value, gradient
        some = rest
        for _ in range(max_trials):
            trial = torch.addcmul(x, direction, length[:, None])
            if some:
                trial = torch.where(done[:, None], new_x, trial)
            v, g = evaluate(trial)
            good = ~done & (v <= value + 1e-4 * length * slope) & torch.isfinite(g.sum(-1))
            done = done | good
            straight, some, every = torch.stack([good.all(), done.any(), done.all()]).tolist()
            if straight:  # most often
                new_x, new_value, new_gradient = trial, v, g
            else:
                new_x = torch.where(good[:, None], trial, new_x)
                new_value = torch.where(good, v, new_value)
                new_gradient = torch.where(good[:, None], g, new_gradient)
            if every:
                break
            # the parabola through value, slope and trial, kept within a tenth and a half
            bend = 2 * (v - value - length * slope)
            guess = torch.where(torch.isfinite(v) & (bend > 0), -slope * length.square() / bend, 0.1 * length)
            length = torch.where(done, length, torch.maximum(torch.minimum(guess, 0.5 * length), 0.1 * length))
        resting = resting | (failed & ~done)
        failed = ~done
        s, y = new_x - x, new_gradient - gradient
        curve = dot(s, y)
        square = dot(y, y)
        kept = curve > 1e-10 * square * scale.clamp_min(tiny)
        moves.append(s.masked_fill_(~kept, 0))
        turns.append(y.masked_fill_(~kept, 0))
        inverse = 1 / torch.where(kept, curve, torch.ones_like(curve))
        inverses.append(torch.where(kept, inverse, torch.zeros_like(curve)))
        del moves[:-memory], turns[:-memory], inverses[:-memory]
        scale = torch.where(kept, curve / square.clamp_min(tiny), scale)
        x, value, gradient = new_x, new_value, new_gradient
        past.append(value)
        places = [*places[-10:], x]
        if made >= 10:
            resting = resting | (past[-11] - value <= (tolerance * value.abs()).maximum(least))
        rest, settled = torch.stack([resting.any(), resting.all()]).tolist()
        if settled:
            break
    return Solution(x, settled, made, places[0])
