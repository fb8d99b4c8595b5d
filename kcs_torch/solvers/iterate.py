"""The loop that every iterative solver here shares, and its two textbook uses."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Generic, TypeVar

import torch
from torch import Tensor

from kcs_torch.errors import OptionError
from kcs_torch.functional.guarded import or_one
from kcs_torch.functional.spectral import svt as shrink

__all__ = ["Solution", "fpc", "iterate", "svt"]

State = TypeVar("State")


@dataclass(frozen=True)
class Solution(Generic[State]):
    """Where an iteration ended.

    Attributes:
        value: the last state.
        converged: whether the stopping rule was met (True where there was none).
        iterations: steps made.
        before: the value some steps earlier (``memory`` of L-BFGS), where the solver tells it.
        energy: of the last state, where the solver knows it.
        change: what was measured last, of each problem where the measure tells them apart; None where nothing was.
    """

    value: State
    converged: bool
    iterations: int
    before: State | None = None
    energy: Tensor | None = None
    change: Tensor | None = None


def iterate(
    step: Callable[[State, int], State],
    start: State,
    *,
    num_steps: int,
    change: Callable[[State, State], Tensor] | None = None,
    tolerance: float = 0.0,
    check_every: int = 5,
    grad_steps: int | None = None,
) -> Solution[State]:
    """Apply ``state = step(state, k)`` for k = 0, 1, ... until it settles.

    Args:
        step: one step; gets the state and the step's number.
        start: first state: a tensor or a tuple of tensors.
        num_steps: at most so many steps.
        change: how much a step changed the state, a tensor of one number or one a problem; None makes every step.
        tolerance: stop where ``change`` is at or below it, for all problems.
        check_every: measure the change at every so-manyth step and at the last (each check waits for the device).
        grad_steps: record only the last so many steps for autograd; None records all, 0 none. An iteration that
            settles before it has recorded them goes on for so many steps.

    Returns:
        A :class:`Solution`.

    Raises:
        OptionError: a count is negative.

    >>> iterate(lambda x, k: x / 2, torch.tensor(8.0), num_steps=3).value.item()
    1.0
    """
    if num_steps < 0 or check_every < 1 or (grad_steps is not None and grad_steps < 0):
        raise OptionError(
            f"iterate: expected num_steps, grad_steps >= 0 and check_every >= 1, "
            f"got {num_steps}, {grad_steps} and {check_every}"
        )
    state, recorded, converged = start, torch.is_grad_enabled(), change is None
    partial = recorded and grad_steps is not None and grad_steps < num_steps
    tail = int(grad_steps or 0) if partial else 0  # steps to be recorded after others that are not
    count, end, moved = 0, int(num_steps), None
    while count < end:
        with torch.set_grad_enabled(recorded and (not partial or end - count <= tail)):
            new = step(state, count)
        count += 1
        if change is not None and not converged and (count % check_every == 0 or count == end):
            with torch.no_grad():
                moved = change(state, new)
                converged = bool((moved <= tolerance).all())
            if converged:
                end = min(end, count + tail)
        state = new
    return Solution(state, converged, count, change=moved)


def fpc(
    start: Tensor,
    grad: Callable[[Tensor], Tensor],
    prox: Callable[[Tensor, Tensor | float], Tensor] = shrink,
    *,
    step: Tensor | float,
    weights: Tensor | list[float],
    steps_per_weight: int = 10,
    tolerance: float = 0.0,
    grad_steps: int | None = None,
) -> Solution[Tensor]:
    """Fixed-point continuation: X <- prox(X - step grad(X), step weight), for a falling run of weights.

    Minimises ``f(X) + weight g(X)`` at the last weight, by proximal gradient steps warm-started from the larger ones.

    Args:
        start: first X, any shape that ``prox`` takes (for the nuclear norm (..., M, N)).
        grad: gradient of the smooth term f.
        prox: proximal map ``prox(X, t)`` of g; singular value shrinkage by default.
        step: step size, a number or a tensor of one element, below 2 over the Lipschitz constant of ``grad``.
        weights: (L,) or (L, ...) weights mu in falling order; each row broadcasts against the batch of X.
        steps_per_weight: steps at each weight, at most.
        tolerance: go on to the next weight where a step changes X by less than this share of X.
        grad_steps: as in :func:`iterate`, counted over all steps.

    Returns:
        A :class:`Solution`; converged tells of the last weight (True where ``tolerance`` is 0: nothing is measured).

    Ma, Goldfarb, Chen 2011; Kovalenko et al. 2019, Algorithm 1, lines 8-11.

    >>> Y = torch.diag(torch.tensor([3.0, 1.0]))
    >>> fpc(torch.zeros(2, 2), lambda X: X - Y, step=1.0, weights=[2.0]).value.round(decimals=4).tolist()
    [[1.0, 0.0], [0.0, 0.0]]
    """
    value, converged, made = start, False, 0
    for k, weight in enumerate(weights):
        after = (len(weights) - 1 - k) * steps_per_weight  # steps at the weights to come
        last = None if grad_steps is None else max(0, min(steps_per_weight, grad_steps - after))
        solution = iterate(
            lambda x, _, w=weight: prox(x - step * grad(x), step * w),  # type: ignore[misc]
            value,
            num_steps=steps_per_weight,
            change=relative_change if tolerance > 0 else None,
            tolerance=tolerance,
            grad_steps=last,
        )
        value, converged, made = solution.value, solution.converged, made + solution.iterations
    return Solution(value, converged, made)


def svt(
    forward: Callable[[Tensor], Tensor],
    adjoint: Callable[[Tensor], Tensor],
    target: Tensor,
    *,
    threshold: Tensor | float,
    step: float = 1.2,
    num_steps: int = 200,
    tolerance: float = 1e-4,
    grad_steps: int | None = None,
) -> Solution[Tensor]:
    """Singular value thresholding: min ||X||_* + 1/(2 threshold) |X|^2 subject to forward(X) = target.

    The dual ascent X = shrink(forward^*(Y), threshold), Y <- Y + step (target - forward(X)).

    Args:
        forward: linear map from X (..., M, N) to the shape of ``target``.
        adjoint: its adjoint.
        target: data.
        threshold: the larger, the nearer the solution is to that of the nuclear norm alone.
        step: below 2 over the squared norm of ``forward``.
        num_steps: at most so many steps.
        tolerance: stop where the residual is this share of the target, in each problem of a batch: over the last two
            dimensions of the target (the last one, if it has no other).
        grad_steps: as in :func:`iterate`.

    Returns:
        A :class:`Solution` whose value is X.

    Cai, Candes, Shen 2010, Algorithm 1; Wandt et al. 2018, eq. 21.

    >>> Y = torch.diag(torch.tensor([3.0, 1.0]))
    >>> svt(lambda X: X, lambda Y: Y, Y, threshold=0.5).value.round(decimals=2).tolist()
    [[3.0, 0.0], [0.0, 1.0]]
    """
    norm = lambda x: torch.linalg.vector_norm(x, dim=tuple(range(-min(x.ndim, 2), 0)))  # noqa: E731
    goal = norm(target.detach()) * tolerance

    def ascend(state: tuple[Tensor, Tensor], _: int) -> tuple[Tensor, Tensor]:
        dual = state[0]
        value = shrink(adjoint(dual), threshold)
        return dual + step * (target - forward(value)), value

    solution = iterate(
        ascend,
        (step * target, adjoint(torch.zeros_like(target))),
        num_steps=num_steps,
        change=lambda old, new: norm(new[0] - old[0]) / step - goal,
        tolerance=0.0,
        grad_steps=grad_steps,
    )
    return Solution(solution.value[1], solution.converged, solution.iterations)


def relative_change(old: Tensor, new: Tensor) -> Tensor:
    """How much a step changed matrices (..., M, N), as a share of the new value's size, (...)."""
    size = torch.linalg.vector_norm(new, dim=(-2, -1))
    moved = torch.linalg.vector_norm(new - old, dim=(-2, -1))
    return moved / or_one(size)
