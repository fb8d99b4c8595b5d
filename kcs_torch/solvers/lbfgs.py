"""Limited-memory BFGS for many problems at once."""

from __future__ import annotations

from collections.abc import Callable
from copy import copy
from typing import Any

import numpy as np
import torch
from torch import Tensor

from kcs_torch.errors import OptionError, ShapeError
from kcs_torch.functional.guarded import or_one
from kcs_torch.solvers.iterate import Solution

__all__ = ["History", "lbfgs"]

PATIENCE = 10
"""Steps over which the energy has to fall."""

TRIALS = 12
"""Halvings of a step; a problem whose step fails restarts from steepest descent, then rests."""

LEAVE = 0.25
"""Share of the problems that have to be done before the others go on without them."""


def lbfgs(
    energy: Callable[[Tensor], Any],
    start: Tensor,
    *,
    num_steps: int = 100,
    memory: int = 10,
    tolerance: float = 1e-6,
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
        first_step: length of the first step, a share of the start's root mean square (of 1 where that is 0).
        slopes: ``energy`` returns its gradient, too: (H,) and (H, D). Else autograd tells it.
        part: makes the energy of some rows, whose indices (K,) it gets: problems that are done are then left out.
        enough: asked after each trial with the steps made (K,), values (K, D) and energies (K,) of the problems not
            left out: true ends the search.

    Returns:
        A :class:`Solution`: the minimisers (H, D); whether all settled within ``num_steps``, at a finite energy; the
        most steps that one made; where they were ``memory`` steps earlier; and their energies (H,).

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
        with torch.inference_mode(False), torch.enable_grad():  # whose tensors have no derivative
            x = (x.clone() if x.is_inference() else x.detach()).requires_grad_()
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
        trial, slope = rows.trial()
        rows.judge(trial, *evaluate(trial), slope)
        done = rows.settle(tolerance, num_steps)
        if done.all() or (enough is not None and enough(*rows.so_far())):
            break
        if part is not None and done.sum() >= LEAVE * len(done):
            found.append(rows[done].found())
            rows = rows[~done]
            energy = part(_tensor(rows.index, x))
    index, *last = rows.found()
    if found:
        index, *last = (torch.cat(column) for column in zip(*found, (index, *last), strict=True))
        last = [column[index.argsort()] for column in last]
    x, before, value, made, resting = last
    settled = num_steps > 0 and bool((resting & value.isfinite()).all())
    return Solution(x, settled, max(made.tolist(), default=0), before, value)


class _Rows:
    """Problems that are under way, and how far each is.

    What is a number of each problem is kept in NumPy arrays: on so few, an operation of PyTorch costs ten times as
    much, and a GPU would be waited for wherever one decides what happens next.

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
        self.x, self.gradient = x, gradient
        self.history = History(x, memory)
        self.steepest = first_step * size / (gradient.square().sum(-1, keepdim=True) / count).sqrt().clamp_min(tiny)
        self.scale = self.steepest
        (self.value,) = _numbers(value)
        self.index = np.arange(len(x))
        self.length, self.trials, self.made = np.ones(len(x)), self.index * 0, self.index * 0
        self.failed = self.resting = self.done = np.zeros(len(x), dtype=bool)
        self.past = np.repeat(self.value[:, None], PATIENCE + 1, 1)
        # the least fall that counts, where the value itself falls to 0
        rounding = torch.finfo(x.dtype).eps * np.abs(self.value)
        self.least = np.where(np.isfinite(self.value), rounding, 0).clip(tiny)

    def __getitem__(self, some: np.ndarray) -> _Rows:
        """Some of the problems, (H,) bool."""
        out, index = copy(self), _tensor(some.nonzero()[0], self.x)
        for name, value in vars(self).items():
            setattr(out, name, value[some] if isinstance(value, np.ndarray) else value[index])
        return out

    def trial(self) -> tuple[Tensor, np.ndarray]:
        """Where the next steps lead, (H, D), and the slopes (H,) along them."""
        down = self.history.turned(self.gradient, self.scale)
        (slope,) = _numbers((down * self.gradient).sum(-1))
        sound = (slope > 0) & ~self.failed
        if not sound.all():
            down = torch.where(_tensor(sound, down)[:, None], down, self.steepest * self.gradient)
            (slope,) = _numbers((down * self.gradient).sum(-1))
        if (self.length == 1).all():
            return self.x - down, slope
        return torch.addcmul(self.x, down, self.x.new_tensor(self.length)[:, None], value=-1), slope

    def judge(self, trial: Tensor, value: Tensor, gradient: Tensor, slope: np.ndarray) -> None:
        """Take the steps to trials (H, D) that lower the energy enough, and shorten the others."""
        length = self.length
        now, whole = _numbers(value, gradient.sum(-1))
        with np.errstate(invalid="ignore", over="ignore", divide="ignore"):
            good = (now <= self.value - 1e-4 * length * slope) & np.isfinite(whole) & ~self.done
            # the parabola through value, slope and trial, kept within a tenth and a half
            bend = 2 * (now - self.value + length * slope)
            guess = np.where(np.isfinite(now) & (bend > 0), slope * length**2 / bend, 0.1 * length)
        failed = (self.trials == TRIALS - 1) & ~good & ~self.done
        moved = good | failed
        if good.all():
            self.scale = self.history.add(trial - self.x, gradient - self.gradient, self.scale)
            self.x, self.gradient = trial, gradient
        else:
            taken = _tensor(good, trial)[:, None]
            x, change = torch.where(taken, trial, self.x), torch.where(taken, gradient, self.gradient)
            self.scale = self.history.add(x - self.x, change - self.gradient, self.scale, _tensor(moved, trial))
            self.x, self.gradient = x, change
        self.value = np.where(good, now, self.value)
        self.length = np.where(moved, 1, guess.clip(0.1 * length, 0.5 * length))
        self.trials = np.where(moved, 0, self.trials + 1)
        self.resting = self.resting | (failed & self.failed)
        self.failed = np.where(moved, failed, self.failed)
        self.made = self.made + moved

    def settle(self, tolerance: float, num_steps: int) -> np.ndarray:
        """Which problems (H,) are done, as they rest or have made all their steps."""
        rows = np.arange(len(self.index))
        self.past[rows, self.made % (PATIENCE + 1)] = self.value
        with np.errstate(invalid="ignore"):
            fallen = self.past[rows, (self.made + 1) % (PATIENCE + 1)] - self.value
            few = fallen <= np.maximum(tolerance * np.abs(self.value), self.least)
        self.resting = self.resting | (few & (self.made >= PATIENCE))
        self.done = self.resting | (self.made >= num_steps)
        return self.done

    def so_far(self) -> tuple[Tensor, Tensor, Tensor]:
        """Steps made (H,), where the problems are (H, D), and their values (H,)."""
        return _tensor(self.made, self.x), self.x, self.x.new_tensor(self.value)

    def found(self) -> tuple[Tensor, ...]:
        """Which problems they are, where they are, where they were, values, steps made, and whether they rest."""
        made, x, value = self.so_far()
        index, resting = _tensor(self.index, x), _tensor(self.resting, x)
        return index, x, x - self.history.travelled(), value, made, resting


def _numbers(*values: Tensor) -> np.ndarray:
    """Tensors (H,) as rows of one array in double precision."""
    return torch.stack(values).cpu().double().numpy()


def _tensor(values: np.ndarray, like: Tensor) -> Tensor:
    """An array of whole numbers or truths where another tensor is."""
    return torch.from_numpy(values).to(like.device)


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
        self.made, self.used = np.zeros(count, dtype=int), 0  # pairs of each problem so far; slots, at most

    def __getitem__(self, index: Tensor) -> History:
        """Those of some of the problems."""
        some = copy(self)
        for name in ("steps", "changes", "inverse", "curves"):
            setattr(some, name, getattr(self, name)[index])
        some.made = self.made[index.cpu().numpy()]
        return some

    def add(self, step: Tensor, change: Tensor, scale: Tensor, rows: Tensor | None = None) -> Tensor:
        """Take in steps (H, D) and changes of the gradient (H, D), of all problems or of some rows, (H,) bool.

        Returns the new scales (H, 1). A pair that tells no curvature counts for nothing.
        """
        memory = self.steps.shape[1]
        some = slice(None) if rows is None else rows.nonzero()[:, 0].cpu().numpy()
        slots = self.made[some] % memory
        self.made[some] += 1
        alike = rows is None and len(slots) > 0 and bool((slots == slots[0]).all())
        if self.used < memory:
            self.used += 1
            if not (alike and slots[0] == self.used - 1):  # not all problems write there
                self.steps[:, self.used - 1] = self.changes[:, self.used - 1] = 0
        # Where each pair goes: a column of all problems, or of each one its own.
        at: Any = slice(None) if alike else _tensor(np.arange(len(step))[some], step)
        row: Any = slice(None) if alike else torch.arange(len(slots), device=step.device)
        slot: Any = int(slots[0]) if alike else _tensor(slots, step)
        pick = lambda values: values if rows is None else values[at]  # noqa: E731
        self.steps[at, slot], self.changes[at, slot] = pick(step), pick(change)
        steps, _, known, _ = self._used()
        products = pick(change[:, None] @ steps.mT)  # (K, 1, used)
        square = pick(change.square().sum(-1, keepdim=True))
        curve = products[row, 0, slot][:, None]  # (K, 1)
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
