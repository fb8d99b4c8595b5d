"""The loop and its two textbook uses: against closed forms and optimality conditions."""

import numpy as np
import pytest
import torch
from numerics import BATCHES, DEVICES, FLOATS, gradcheck, leaves_arguments_alone, normal, same_as_loop
from torch.testing import assert_close

from kcs_torch.errors import OptionError
from kcs_torch.functional import svt as shrink
from kcs_torch.solvers import fpc, iterate, svt
from kcs_torch.solvers.iterate import relative_change


def difference(old, new):
    return (new - old).abs().amax()


def halve(state, _):
    return state / 2


# ---------------------------------------------------------------------- iterate


def test_steps_are_numbered_and_counted():
    numbers = []

    def step(state, k):
        numbers.append(k)
        return state + 1

    solution = iterate(step, torch.tensor(0.0), num_steps=4)
    assert numbers == [0, 1, 2, 3]
    assert (solution.value, solution.iterations, solution.converged) == (4.0, 4, True)


def test_no_steps():
    start = torch.tensor(1.0)
    solution = iterate(halve, start, num_steps=0, change=difference)
    assert solution.value is start
    assert (solution.iterations, solution.converged) == (0, False)


def test_state_may_be_a_tuple():
    a, b = iterate(lambda s, _: (s[1], s[0] + s[1]), (torch.tensor(0), torch.tensor(1)), num_steps=10).value
    assert (a, b) == (55, 89)


@pytest.mark.parametrize(("every", "expected"), [(1, 7), (5, 10), (4, 8)])
def test_stops_where_the_change_is_small(every, expected):
    """1 / 2^7 is the first change at or below 0.01."""
    options = {"change": difference, "tolerance": 0.01, "check_every": every}
    solution = iterate(halve, torch.tensor(1.0), num_steps=100, **options)
    assert (solution.converged, solution.iterations) == (True, expected)
    assert solution.value == 0.5**expected


def test_the_last_step_is_measured():
    """Three steps with a measurement at every fifth: settled all the same."""
    solution = iterate(lambda s, _: s, torch.tensor(1.0), num_steps=3, change=difference)
    assert solution.converged


def test_not_settling_is_a_result():
    """Who calls tells the user: the project's tests make an error of any warning."""
    assert not iterate(halve, torch.tensor(1.0), num_steps=3, change=difference).converged


@pytest.mark.parametrize(
    "options", [{"num_steps": -1}, {"num_steps": 1, "grad_steps": -1}, {"num_steps": 1, "check_every": 0}]
)
def test_counts_out_of_range(options):
    with pytest.raises(OptionError, match="expected num_steps"):
        iterate(halve, torch.tensor(1.0), **options)


@pytest.mark.parametrize("grad_steps", [None, 0, 1, 3, 10, 20])
def test_gradients_of_the_last_steps_only(grad_steps):
    """x <- x/2 + p: each recorded step adds 2^-k to dx/dp, and all of them pass the start's derivative on."""
    start, p = torch.tensor(1.0, requires_grad=True), torch.tensor(1.0, requires_grad=True)
    solution = iterate(lambda x, _: x / 2 + p, start, num_steps=10, grad_steps=grad_steps)
    recorded = 10 if grad_steps is None else min(grad_steps, 10)
    assert solution.value.requires_grad == (recorded > 0)
    if recorded:
        by_start, by_p = torch.autograd.grad(solution.value, [start, p], allow_unused=True)
        assert_close(by_p, torch.tensor(sum(0.5**k for k in range(recorded))))
        assert (by_start is None) == (recorded < 10)
    with torch.no_grad():
        assert not iterate(lambda x, _: x / 2 + p, start, num_steps=10, grad_steps=grad_steps).value.requires_grad


@pytest.mark.parametrize(("grad_steps", "iterations"), [(3, 23), (185, 200), (0, 20), (None, 20), (200, 20)])
def test_an_early_stop_still_records(grad_steps, iterations):
    p = torch.tensor(1.0, requires_grad=True)
    solution = iterate(
        lambda x, _: x / 2 + p,
        torch.tensor(0.0),
        num_steps=200,
        change=difference,
        tolerance=1e-5,
        grad_steps=grad_steps,
    )
    assert (solution.converged, solution.iterations) == (True, iterations)
    if grad_steps == 0:
        assert not solution.value.requires_grad
    else:
        (by_p,) = torch.autograd.grad(solution.value, p)
        recorded = {3: 3, 185: 185}.get(grad_steps, 20)
        assert_close(by_p, torch.tensor(sum(0.5**k for k in range(recorded))))


# ---------------------------------------------------------------------- fpc


def test_fpc_with_the_identity_is_one_shrinkage():
    target = normal(6, 4)
    solution = fpc(torch.zeros(6, 4).double(), lambda x: x - target, step=1.0, weights=[3.0, 0.5], steps_per_weight=2)
    assert_close(solution.value, shrink(target, 0.5))
    assert solution.iterations == 4


@pytest.mark.parametrize("as_tensor", [False, True])
def test_fpc_is_optimal_for_matrix_completion(as_tensor):
    """At the optimum -grad f / weight is a subgradient of the nuclear norm."""
    target = normal(10, 2) @ normal(2, 8, seed=1)
    seen = (normal(10, 8, seed=2) > -0.8).double()
    weights = torch.tensor([5.0, 1.0, 0.1], dtype=torch.float64) if as_tensor else [5.0, 1.0, 0.1]
    grad = lambda x: seen * (x - target)  # noqa: E731
    solution = fpc(torch.zeros_like(target), grad, step=1.0, weights=weights, steps_per_weight=2000, tolerance=1e-12)
    dual = -grad(solution.value) / 0.1
    assert solution.converged
    assert torch.linalg.matrix_norm(dual, 2) < 1 + 1e-6
    assert_close((dual * solution.value).sum(), torch.linalg.svdvals(solution.value).sum(), rtol=1e-6, atol=0)


def test_fpc_takes_another_prox():
    """Soft thresholding of numbers: the lasso with an orthonormal design."""
    target = normal(30)[:, None]
    soft = lambda x, t: x.sign() * (x.abs() - t).clamp_min(0)  # noqa: E731
    found = fpc(torch.zeros(30, 1).double(), lambda x: x - target, soft, step=0.5, weights=[0.3], steps_per_weight=100)
    assert_close(found.value, soft(target, 0.3))


def test_fpc_counts_the_steps_it_makes():
    target = normal(6, 4)
    options = {"step": 1.0, "weights": [2.0, 1.0], "steps_per_weight": 50}
    solution = fpc(torch.zeros(6, 4).double(), lambda x: x - target, tolerance=1e-8, **options)
    assert (solution.converged, solution.iterations) == (True, 10)  # measured at each fifth step
    slow = {"step": 0.01, "weights": [0.1], "steps_per_weight": 5, "tolerance": 1e-8}
    short = fpc(target / 2, lambda x: x - target, **slow)
    assert not short.converged


@pytest.mark.parametrize("grad_steps", [0, 1, 3, 4, 5, None])
def test_fpc_records_the_last_steps_over_all_weights(grad_steps):
    target = normal(6, 4).requires_grad_()

    def run(start, **more):
        return fpc(start, lambda x: x - target, step=0.5, weights=[1.0, 0.3], steps_per_weight=3, **more).value

    value = run(torch.zeros(6, 4).double(), grad_steps=grad_steps)
    assert_close(value, run(torch.zeros(6, 4).double()))
    if grad_steps == 0:
        assert not value.requires_grad
        return
    # The same by hand: run the first steps without autograd.
    recorded = 6 if grad_steps is None else grad_steps
    x = torch.zeros(6, 4).double()
    for k, weight in enumerate([1.0] * 3 + [0.3] * 3):
        with torch.set_grad_enabled(k >= 6 - recorded):
            x = shrink(x - 0.5 * (x - target), 0.5 * weight)
    cotangent = normal(6, 4, seed=3)
    assert_close(torch.autograd.grad(value, target, cotangent), torch.autograd.grad(x, target, cotangent))


def test_fpc_gradient_and_batches():
    target, start = normal(5, 4), normal(5, 4, seed=1)
    run = lambda t, s, w: fpc(s, lambda x: x - t, step=0.7, weights=w, steps_per_weight=2).value  # noqa: E731
    assert gradcheck(run, target, start, torch.tensor([1.0, 0.4]).double())
    same_as_loop(lambda t, s: run(t, s, [1.0, 0.4]), (5, 4), (5, 4))
    each = torch.tensor([[1.0, 0.2], [0.5, 0.1]]).double()  # (L, batch): a weight for each matrix
    batch = normal(2, 5, 4, seed=3)
    parts = [run(t, torch.zeros(5, 4).double(), each[:, i]) for i, t in enumerate(batch)]
    assert_close(run(batch, torch.zeros(2, 5, 4).double(), each), torch.stack(parts))


# ---------------------------------------------------------------------- svt


def completion(batch=()):
    target = normal(*batch, 12, 2) @ normal(*batch, 2, 9, seed=1)
    seen = (normal(12, 9, seed=2) > -1.1).double()
    return target, lambda x: x * seen


def test_svt_meets_the_data_and_is_optimal():
    target, mask = completion()
    solution = svt(mask, mask, mask(target), threshold=0.1, num_steps=5000, tolerance=1e-9)
    assert solution.converged and solution.iterations < 5000
    x = solution.value
    assert_close(mask(x), mask(target), rtol=0, atol=1e-7)
    # X is the shrinkage of a dual that lives on the data alone. As X has full rank there is one such dual only.
    u, s, vt = torch.linalg.svd(x, full_matrices=False)
    assert s[-1] > 1e-3
    dual = (u * (s + 0.1)) @ vt
    assert (dual - mask(dual)).abs().max() < 1e-6


def test_svt_completes_a_matrix_of_low_rank():
    target, mask = completion()
    solution = svt(mask, mask, mask(target), threshold=60.0, num_steps=3000, tolerance=1e-6)
    assert_close(solution.value, target, rtol=0, atol=0.02)


def test_svt_says_where_it_did_not_settle():
    target, mask = completion()
    solution = svt(mask, mask, mask(target), threshold=50.0, num_steps=7)
    assert (solution.converged, solution.iterations) == (False, 7)


def test_svt_of_no_data():
    solution = svt(lambda x: x, lambda y: y, torch.zeros(4, 3), threshold=1.0)
    assert solution.converged and torch.equal(solution.value, torch.zeros(4, 3))


def test_svt_settles_each_problem_of_a_batch():
    """The residual was measured over the batch, in which a small problem counts for nothing."""
    target, mask = completion()
    both = torch.stack([1000 * target, target])
    solution = svt(mask, mask, mask(both), threshold=1.0, num_steps=2000)
    assert solution.converged
    off = torch.linalg.matrix_norm(mask(solution.value - both)) / torch.linalg.matrix_norm(mask(both))
    assert off.max() < 2e-4


def test_svt_gradient_and_batches():
    _, mask = completion()
    run = lambda t, level: svt(mask, mask, mask(t), threshold=level, num_steps=4, tolerance=0.0).value  # noqa: E731
    assert gradcheck(run, normal(12, 9), torch.tensor(0.8).double(), fast=True)
    same_as_loop(lambda t: run(t, 0.8), (12, 9))
    target = normal(12, 9).requires_grad_()
    cut = svt(mask, mask, mask(target), threshold=0.8, num_steps=4, tolerance=0.0, grad_steps=0)
    assert not cut.value.requires_grad


# ---------------------------------------------------------------------- all of them


@pytest.mark.parametrize("batch", BATCHES)
def test_relative_change_of_each_matrix(batch):
    old, new = normal(*batch, 5, 4), normal(*batch, 5, 4, seed=1)
    share = (new - old).flatten(-2).norm(dim=-1) / new.flatten(-2).norm(dim=-1)
    assert_close(relative_change(old, new), share)
    assert relative_change(torch.zeros(2, 2), torch.zeros(2, 2)) == 0


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("dtype", FLOATS)
def test_results_follow_dtype_and_device(dtype, device):
    target = normal(6, 4, dtype=dtype, device=device)
    run = lambda t: fpc(t, lambda x: x - t, step=1.0, weights=[0.3]).value  # noqa: E731
    lift = lambda t: svt(lambda x: x, lambda y: y, t, threshold=1.0).value  # noqa: E731
    values = [leaves_arguments_alone(run, target), leaves_arguments_alone(lift, target)]
    assert {(v.dtype, v.device.type) for v in values} == {(dtype, device)}


def test_counts_may_be_those_of_numpy():
    start = torch.tensor(8.0, requires_grad=True)
    found = iterate(lambda x, _: x / 2, start, num_steps=np.int64(6), grad_steps=np.int64(3))
    assert found.value == 0.125 and found.iterations == 6
