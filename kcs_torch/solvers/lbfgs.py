"""Limited-memory BFGS for many problems at once."""

from __future__ import annotations

from collections.abc import Callable
from copy import copy
from typing import Any

import torch
from torch import Tensor

from kcs_torch.errors import OptionError, ShapeError
from kcs_torch.functional.guarded import or_one
from kcs_torch.solvers.iterate import Solution

__all__ = ["History", "lbfgs"]

PATIENCE = 10
"""Steps over which the energy has to fall."""

LEAVE = 0.25
"""Share of the problems that have to be done before the others go on without them."""


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
    part: Callable[[Tensor], Callable[[Tensor], Any]] | None = None,
    enough: Callable[[Tensor, Tensor, Tensor], bool] | None = None,
) -> Solution[Tensor]:
    """Minimise ``energy`` of each row of ``start`` by L-BFGS with a backtracking line search (Nocedal 1980).

    All problems are evaluated together, so that many starts of one problem cost little more than one; each is at its
    own step, and none waits for the line search of another. A step is taken only where it lowers the energy enough
    (Armijo) and is finite.

    Args:
        energy: maps (H, D) to (H,), differentiable; row h depends on row h alone.
        start: (H, D).
        num_steps: steps, at most.
        memory: pairs of differences kept.
        tolerance: a problem rests once ten steps lower its energy by less than this share of its size.
        max_trials: halvings of a step; a problem whose step fails restarts from steepest descent, then rests.
        first_step: length of the first step, a share of the start's root mean square (of 1 where that is 0).
        slopes: ``energy`` returns its gradient, too: (H,) and (H, D). Else autograd tells it.
        part: makes the energy of some rows, whose indices (K,) it gets: problems that are done are then left out.
        enough: asked after each trial with the steps made (K,), values (K, D) and energies (K,) of the problems not
            left out: true ends the search.

    Returns:
        The minimisers (H, D); whether all settled within ``num_steps``; where they were ``memory`` steps
        earlier; and their energies (H,).

    Raises:
        ShapeError: ``start`` is not (H, D), or ``energy`` gives no value of each row.
        OptionError: ``memory`` is below 1.

    >>> goal = torch.tensor([[1.0, 2.0], [3.0, -1.0]], dtype=torch.float64)
    >>> lbfgs(lambda x: ((x - goal) ** 2).sum(-1), torch.zeros_like(goal)).value.round(decimals=4).tolist()
    [[1.0, 2.0], [3.0, -1.0]]
    """
    if start.ndim != 2:
        raise ShapeError(f"lbfgs: start: expected problems in rows (H, D), got {tuple(start.shape)}")
    if memory < 1:
        raise OptionError(f"lbfgs: memory: expected at least 1 pair, got {memory}")

    def evaluate(x: Tensor) -> tuple[Tensor, Tensor]:
        if slopes:
            with torch.no_grad():
                pair: tuple[Tensor, Tensor] = energy(x)
            return pair
        with torch.enable_grad():
            x = x.detach().requires_grad_()
            value = energy(x)
            if value.shape != x.shape[:1]:
                got = f"shape {tuple(value.shape)} of {len(x)}"
                raise ShapeError(f"lbfgs: energy: expected a value of each row, (H,), got {got}")
            (gradient,) = torch.autograd.grad(value.sum(), x)
        return value.detach(), gradient

    x = start.detach()
    rows = _Rows(x, *evaluate(x), first_step, memory)
    found: list[tuple[Tensor, ...]] = []
    while num_steps > 0:
        down, slope = rows.direction()
        trial = torch.addcmul(rows.x, down, rows.length[:, None], value=-1)
        del down  # of very long problems every vector tells
        rows.judge(trial, *evaluate(trial), slope, max_trials)
        done = rows.settle(tolerance, num_steps)
        count = int(done.sum())
        if count == len(done) or (enough is not None and enough(rows.made, rows.x, rows.value)):
            break
        if part is not None and count >= LEAVE * len(done):
            found.append(rows[done.nonzero().flatten()].found())
            rows = rows[(~done).nonzero().flatten()]
            energy = part(rows.index)
    index, *last = rows.found()
    if found:
        index, *last = (torch.cat(column) for column in zip(*found, (index, *last), strict=True))
        last = [column[index.argsort()] for column in last]
    x, before, value, made, resting = last
    return Solution(x, num_steps > 0 and bool(resting.all()), max(made.tolist(), default=0), before, value)


class _Rows:
    """Problems that are under way, and how far each is.

    Attributes:
        index: (H,) which they are.
        x: (H, D), the best so far; its ``value`` (H,) and ``gradient`` (H, D).
        history: of steps, at ``scale`` (H, 1).
        steepest: (H, 1) step down the gradient where the history tells none that leads down.
        length: (H,) of the step that is tried now, of ``trials`` (H,) tries before.
        made: (H,) steps.
        failed: (H,) whether the last step found nothing lower.
        resting: (H,) whether there is nothing to be gained any more.
        past: (H, PATIENCE + 1) values after the last steps, in a ring.
    """

    def __init__(self, x: Tensor, value: Tensor, gradient: Tensor, first_step: float, memory: int) -> None:
        tiny = torch.finfo(x.dtype).tiny ** 0.5
        count = (gradient != 0).sum(-1, keepdim=True).clamp_min(1)  # what the energy does not depend on is padding
        size = (x.square().sum(-1, keepdim=True) / count).sqrt()
        size = or_one(size)
        self.index = torch.arange(len(x), device=x.device)
        self.x, self.value, self.gradient = x, value, gradient
        self.history = History(x, memory)
        self.steepest = first_step * size / (gradient.square().sum(-1, keepdim=True) / count).sqrt().clamp_min(tiny)
        self.scale = self.steepest
        self.length, self.trials, self.made = torch.ones_like(value), torch.zeros_like(self.index), self.index * 0
        self.failed = self.resting = torch.zeros_like(value, dtype=torch.bool)
        self.past = value[:, None].repeat(1, PATIENCE + 1)
        # the least fall that counts, where the value itself falls to 0
        self.least = torch.where(value.isfinite(), torch.finfo(x.dtype).eps * value.abs(), 0).clamp_min(tiny)
        self.done = self.resting

    def __getitem__(self, index: Tensor) -> _Rows:
        """Some of the problems."""
        some = copy(self)
        for name, value in vars(self).items():
            setattr(some, name, value[index])
        return some

    def direction(self) -> tuple[Tensor, Tensor]:
        """The step to be taken back (H, D), at full length, and its slope (H,)."""
        down = self.history.turned(self.gradient, self.scale)
        slope = (down * self.gradient).sum(-1, keepdim=True)
        sound = (slope > 0) & ~self.failed[:, None]
        if not bool(sound.all()):
            down = torch.where(sound, down, self.steepest * self.gradient)
            slope = (down * self.gradient).sum(-1, keepdim=True)
        return down, slope[:, 0]

    def judge(self, trial: Tensor, value: Tensor, gradient: Tensor, slope: Tensor, max_trials: int) -> None:
        """Take the steps to trials (H, D) that lower the energy enough, and shorten the others."""
        length = self.length
        most = torch.addcmul(self.value, length, slope, value=-1e-4)
        good = (value <= most) & gradient.sum(-1).isfinite() & ~self.done
        if bool(good.all()):
            self.scale = self.history.add(trial - self.x, gradient - self.gradient, self.scale)
            self.x, self.value, self.gradient = trial, value, gradient
            self.length, self.trials, self.failed = torch.ones_like(length), self.trials * 0, ~good
            self.made = self.made + 1
            return
        # the parabola through value, slope and trial, kept within a tenth and a half
        bend = 2 * (value - self.value + length * slope)
        guess = torch.where(torch.isfinite(value) & (bend > 0), slope * length.square() / bend, 0.1 * length)
        less = torch.maximum(torch.minimum(guess, 0.5 * length), 0.1 * length)
        failed = (self.trials == max_trials - 1) & ~good & ~self.done
        moved = good | failed
        x, change = torch.where(good[:, None], trial, self.x), torch.where(good[:, None], gradient, self.gradient)
        self.scale = self.history.add(x - self.x, change - self.gradient, self.scale, moved)
        self.x, self.value, self.gradient = x, torch.where(good, value, self.value), change
        self.length, self.trials = torch.where(moved, 1, less), torch.where(moved, 0, self.trials + 1)
        self.resting = self.resting | (failed & self.failed)
        self.failed = torch.where(moved, failed, self.failed)
        self.made = self.made + moved

    def settle(self, tolerance: float, num_steps: int) -> Tensor:
        """Which problems (H,) are done, as they rest or have made all their steps."""
        now, ago = (((self.made + k) % (PATIENCE + 1))[:, None] for k in (0, 1))
        self.past.scatter_(1, now, self.value[:, None])
        fallen = self.past.gather(1, ago)[:, 0] - self.value
        few = fallen <= (tolerance * self.value.abs()).maximum(self.least)
        self.resting = self.resting | (few & (self.made >= PATIENCE))
        self.done = self.resting | (self.made >= num_steps)
        return self.done

    def found(self) -> tuple[Tensor, ...]:
        """Which problems they are, where they are, where they were, values, steps made, and whether they rest."""
        return self.index, self.x, self.x - self.history.travelled(), self.value, self.made, self.resting


class History:
    """The last steps s and changes y of the gradient, and the inverse Hessian H that they tell.

    With the pairs as rows of S and Y, R the part of S Y^T where s is no newer than y, D its diagonal and c the scale
    of what no pair tells (Byrd, Nocedal and Schnabel 1994),

        H g = c q + S^T b,    q = g - Y^T a,    a = R^-1 S g,    b = R^-T (D a - c Y q).

    Pairs lie in a ring, of each problem its own, and R^-1 changes by a row and a column with each: products with all
    pairs take the place of loops over them.

    Args:
        like: (H, D), the unknowns.
        memory: pairs kept.
    """

    def __init__(self, like: Tensor, memory: int) -> None:
        count, size = like.shape
        self.steps, self.changes = like.new_empty(2, count, memory, size)
        self.inverse, self.curves = like.new_zeros(count, memory, memory), like.new_zeros(count, memory)  # R^-1, D
        self.made = torch.zeros(count, dtype=torch.long, device=like.device)
        self.used, self.even = 0, True  # slots, at most; whether all problems have as many pairs

    def __getitem__(self, index: Tensor) -> History:
        """Those of some of the problems."""
        some = copy(self)
        for name in ("steps", "changes", "inverse", "curves", "made"):
            setattr(some, name, getattr(self, name)[index])
        return some

    def add(self, step: Tensor, change: Tensor, scale: Tensor, rows: Tensor | None = None) -> Tensor:
        """Take in steps (H, D) and changes of the gradient (H, D), of all problems or of some rows, (H,) bool.

        Returns the new scales (H, 1). A pair that tells no curvature counts for nothing.
        """
        memory = self.steps.shape[1]
        self.even &= rows is None
        if self.used < memory:
            self.used += 1
            if not self.even:  # not all problems write there
                self.steps[:, self.used - 1] = self.changes[:, self.used - 1] = 0
        at = torch.arange(len(step), device=step.device) if rows is None else rows.nonzero().flatten()
        slot = self.made[at] % memory
        pick = lambda values: values if rows is None else values[at]  # noqa: E731
        self.made[at] += 1
        self.steps[at, slot], self.changes[at, slot] = pick(step), pick(change)
        steps, _, known, _ = self._used()
        products = pick(change[:, None] @ steps.mT)  # (K, 1, used)
        square = pick(change.square().sum(-1, keepdim=True))
        curve = products[:, 0].gather(1, slot[:, None])  # (K, 1)
        old = pick(scale)
        tiny = torch.finfo(scale.dtype).tiny ** 0.5
        kept = curve > 1e-10 * square * old.clamp_min(tiny)
        inverse = torch.where(kept, 1 / curve, 0)
        column = (products @ pick(known).mT)[:, 0] * -inverse
        self.inverse[at, slot] = 0  # the oldest; its column is 0 below, as R is triangular
        self.inverse[at, : self.used, slot] = column
        self.inverse[at, slot, slot] = inverse[:, 0]
        self.curves[at, slot] = curve[:, 0]
        new = torch.where(kept, curve / square.clamp_min(tiny), old)
        return new if rows is None else scale.index_copy(0, at, new)

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
        used = self.used
        return self.steps[:, :used], self.changes[:, :used], self.inverse[:, :used, :used], self.curves[:, None, :used]
