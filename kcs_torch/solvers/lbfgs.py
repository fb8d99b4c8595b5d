"""Limited-memory BFGS for many problems at once."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from kcs_torch.solvers.iterate import Solution

__all__ = ["History", "lbfgs"]


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
        The minimisers (H, D); whether all settled within ``num_steps``; where they were ``memory`` steps
        earlier; and their energies (H,).

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
    history = History(x, memory)
    scale = steepest
    resting = torch.zeros_like(value, dtype=torch.bool)
    past = [value]
    least = torch.where(value.isfinite(), torch.finfo(x.dtype).eps * value.abs(), 0).clamp_min(tiny)  # if it falls to 0
    failed = resting
    settled, rest, made = False, False, 0
    for made in range(1, num_steps + 1):
        down = history.turned(gradient, scale)
        slope = dot(down, gradient)
        sound = (slope > 0) & ~failed[:, None]
        if not bool(sound.all()):
            down = torch.where(sound, down, steepest * gradient)
            slope = dot(down, gradient)
        slope = slope[:, 0]
        length = torch.ones_like(value)
        done = resting
        new_x, new_value, new_gradient = x, value, gradient
        some, every = rest, False
        for _ in range(max_trials):
            trial = torch.addcmul(x, down, length[:, None], value=-1)
            if some:
                trial = torch.where(done[:, None], new_x, trial)
            v, g = evaluate(trial)
            good = (v <= torch.addcmul(value, length, slope, value=-1e-4)) & g.sum(-1).isfinite() & ~done
            every = bool(good.all())
            if every:  # most often
                new_x, new_value, new_gradient = trial, v, g
                break
            done = done | good
            some, every = torch.stack([done.any(), done.all()]).tolist()
            new_x = torch.where(good[:, None], trial, new_x)
            new_value = torch.where(good, v, new_value)
            new_gradient = torch.where(good[:, None], g, new_gradient)
            if every:
                break
            # the parabola through value, slope and trial, kept within a tenth and a half
            bend = 2 * (v - value + length * slope)
            guess = torch.where(torch.isfinite(v) & (bend > 0), slope * length.square() / bend, 0.1 * length)
            length = torch.where(done, length, torch.maximum(torch.minimum(guess, 0.5 * length), 0.1 * length))
        if every:
            failed = torch.zeros_like(resting)
        else:
            resting, failed = resting | (failed & ~done), ~done
        scale = history.add((new_x, new_gradient), (x, gradient), scale)
        x, value, gradient = new_x, new_value, new_gradient
        past.append(value)
        if made >= 10:
            resting = resting | (past[-11] - value <= (tolerance * value.abs()).maximum(least))
        if made >= 10 or not every:
            rest, settled = torch.stack([resting.any(), resting.all()]).tolist()
            if settled:
                break
    return Solution(x, settled, made, x - history.travelled(), value)


class History:
    """The last steps s and changes y of the gradient, and the inverse Hessian H that they tell.

    With the pairs as rows of S and Y, R the part of S Y^T where s is no newer than y, D its diagonal and c the scale
    of what no pair tells (Byrd, Nocedal and Schnabel 1994),

        H g = c q + S^T b,    q = g - Y^T a,    a = R^-1 S g,    b = R^-T (D a - c Y q).

    Pairs lie in a ring, and R^-1 changes by a row and a column with each: products with all pairs take the place of
    loops over them.

    Args:
        like: (H, D), the unknowns.
        memory: pairs kept.
    """

    def __init__(self, like: Tensor, memory: int) -> None:
        count, size = like.shape
        self.steps, self.changes = like.new_empty(2, count, memory, size)
        self.inverse, self.curves = like.new_zeros(count, memory, memory), like.new_zeros(count, 1, memory)  # R^-1, D
        parts = self.steps.unbind(1), self.changes.unbind(1), *map(self.inverse.unbind, (1, 2)), self.curves.unbind(2)
        self.slots = list(zip(*parts, strict=True))
        self.made = 0

    def add(self, after: tuple[Tensor, Tensor], before: tuple[Tensor, Tensor], scale: Tensor) -> Tensor:
        """Take in the pair between two places and their gradients, (H, D) each; returns the new scales (H, 1).

        A pair that tells no curvature counts for nothing.
        """
        slot = self.made % len(self.slots)
        self.made += 1
        steps, _, known, _ = self._used()
        step, change, row, column, curves = self.slots[slot]
        torch.sub(after[0], before[0], out=step)
        torch.sub(after[1], before[1], out=change)
        products = change[:, None] @ steps.mT  # (H, 1, used)
        curve, square = products[..., slot], change.square().sum(-1, keepdim=True)  # (H, 1)
        tiny = torch.finfo(scale.dtype).tiny ** 0.5
        kept = curve > 1e-10 * square * scale.clamp_min(tiny)
        inverse = torch.where(kept, 1 / curve, 0)
        row.zero_()  # the oldest; its column is 0 below, as R is triangular
        column[:, : known.shape[-1]] = (products @ known.mT)[:, 0] * -inverse
        row[:, slot] = inverse[:, 0]
        curves.copy_(curve)
        return torch.where(kept, curve / square.clamp_min(tiny), scale)

    def turned(self, gradient: Tensor, scale: Tensor) -> Tensor:
        """H g (H, D) of gradients (H, D), at scales (H, 1)."""
        steps, changes, inverse, curves = self._used()
        scale, gradient = scale[..., None], gradient[:, None]
        a = gradient @ steps.mT @ inverse.mT  # (H, 1, used)
        q = torch.baddbmm(gradient, a, changes, alpha=-1)  # (H, 1, D)
        b = torch.addcmul(curves * a, scale, q @ changes.mT, value=-1) @ inverse
        return torch.baddbmm(scale * q, b, steps)[:, 0]

    def travelled(self) -> Tensor:
        """The way (H, D) of all steps that are kept."""
        return self._used()[0].sum(1)

    def _used(self) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Steps and changes (H, used, D), the inverse (H, used, used) and curves (H, 1, used)."""
        used = min(self.made, len(self.slots))
        if used == len(self.slots):
            return self.steps, self.changes, self.inverse, self.curves
        return self.steps[:, :used], self.changes[:, :used], self.inverse[:, :used, :used], self.curves[..., :used]
