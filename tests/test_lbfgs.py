"""Batched L-BFGS: against scipy and direct solves, row by row, and where energies are flat, infinite or NaN."""

import pytest
import scipy.optimize
import torch
from numerics import FLOATS, count_operations, leaves_arguments_alone, normal, rotations
from torch.testing import assert_close

from kcs_torch.errors import OptionError, ShapeError
from kcs_torch.solvers import lbfgs
from kcs_torch.solvers.lbfgs import History


def rosenbrock(x):
    return (100 * (x[..., 1:] - x[..., :-1] ** 2) ** 2 + (1 - x[..., :-1]) ** 2).sum(-1)


STARTS = torch.cat([normal(5, 6), torch.zeros(1, 6).double(), torch.ones(1, 6).double(), 3 * normal(1, 6, seed=1)])


def test_as_good_as_scipy():
    found = lbfgs(rosenbrock, STARTS, num_steps=300, tolerance=0.0)
    leaf = lambda x: torch.from_numpy(x).requires_grad_()  # noqa: E731
    for start, value in zip(STARTS, found.value, strict=True):
        other = scipy.optimize.minimize(
            lambda x: rosenbrock(leaf(x)).item(),
            start.numpy(),
            jac=lambda x: torch.autograd.grad(rosenbrock(y := leaf(x)), y)[0].numpy(),
            method="L-BFGS-B",
            options={"maxiter": 300, "ftol": 0, "gtol": 1e-9},
        )
        assert rosenbrock(value) < other.fun + 1e-8
        assert_close(value, torch.from_numpy(other.x), rtol=0, atol=1e-4)  # the same of the two minima


def test_ill_conditioned_quadratics():
    """Ten problems of condition 1e4, each with its own matrix."""
    axes = torch.linalg.qr(normal(10, 12, 12))[0]
    matrix = axes @ torch.diag(torch.logspace(0, 4, 12, dtype=torch.float64)) @ axes.mT
    goal = normal(10, 12, seed=1)
    off = lambda x: ((x - goal)[:, None] @ matrix @ (x - goal)[..., None])[:, 0, 0]  # noqa: E731
    found = lbfgs(off, torch.zeros_like(goal), num_steps=400, tolerance=1e-8)
    assert_close(found.value, goal, rtol=0, atol=1e-4)
    assert found.converged and found.iterations < 400
    steepest = lbfgs(off, torch.zeros_like(goal), num_steps=found.iterations, memory=1, tolerance=0.0)
    assert off(steepest.value).sum() > 10 * off(found.value).sum()  # the memory is of use


def test_rows_do_not_see_each_other():
    together = lbfgs(rosenbrock, STARTS, num_steps=40, tolerance=0.0).value
    others = torch.cat([STARTS[:2], 5 * normal(len(STARTS) - 2, 6, seed=2)])
    assert torch.equal(lbfgs(rosenbrock, others, num_steps=40, tolerance=0.0).value[:2], together[:2])
    alone = torch.cat([lbfgs(rosenbrock, row[None], num_steps=40, tolerance=0.0).value for row in STARTS])
    assert_close(together, alone, rtol=1e-5, atol=1e-5)  # products of other shapes round in another way


def test_no_row_waits_for_another():
    """Row by row the same steps; and of rows that are done, or in another's line search, hardly any is evaluated."""
    starts = torch.cat([STARTS, torch.ones(9, 6).double()])  # at the minimum: nothing to do
    evaluated: list[int] = []

    def energy(rows, x):
        evaluated.append(len(rows))
        return rosenbrock(x)

    def part(rows):
        return lambda x: energy(rows, x)

    options = {"num_steps": 100, "tolerance": 1e-4}
    every = torch.arange(len(starts))
    with_part = lbfgs(part(every), starts, part=part, **options)
    count = sum(evaluated)
    alone = []
    for row in starts:
        evaluated.clear()
        one = lbfgs(part(every[:1]), row[None], **options)
        alone.append((one.value[0], one.before[0], one.energy[0], sum(evaluated), one.iterations))
    value, before, least, needed, steps = zip(*alone, strict=True)
    assert_close(with_part.value, torch.stack(value), rtol=1e-5, atol=1e-5)
    assert_close(with_part.before, torch.stack(before), rtol=1e-5, atol=1e-5)
    assert_close(with_part.energy, torch.stack(least), rtol=1e-5, atol=1e-5)
    assert with_part.iterations == max(steps) and with_part.converged
    assert max(needed) * len(starts) > 2 * sum(needed)  # what waiting would cost
    assert count < 1.3 * sum(needed)
    waiting = lbfgs(rosenbrock, starts, **options)
    assert_close(waiting.value, with_part.value, rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("memory", [1, 3, 10])
def test_as_the_two_loops_over_pairs(memory):
    """Against Nocedal's own recursion, while pairs come and go; a pair without curvature counts for nothing."""
    generator = torch.Generator().manual_seed(0)
    random = lambda *shape: torch.randn(*shape, dtype=torch.float64, generator=generator)  # noqa: E731
    matrix = random(2, 30, 30)
    matrix = matrix @ matrix.mT + torch.eye(30)
    like = random(2, 30)
    history, pairs, scale = History(like, memory), [], torch.full((2, 1), 0.3).double()
    for made in range(25):
        gradient = random(2, 30)
        q, shares = gradient.clone(), []
        for s, y in reversed(pairs):
            shares.append((s * q).sum(-1, keepdim=True) / (s * y).sum(-1, keepdim=True))
            q = q - shares[-1] * y
        q = scale * q
        for (s, y), a in zip(pairs, reversed(shares), strict=True):
            q = q + s * (a - (y * q).sum(-1, keepdim=True) / (s * y).sum(-1, keepdim=True))
        assert_close(history.turned(gradient, scale), q)
        step = random(2, 30) * 10.0 ** -(made % 7)
        change = (matrix @ step[..., None])[..., 0]
        told = history.add(step, change, scale)
        assert_close(told, (step * change).sum(-1, keepdim=True) / change.square().sum(-1, keepdim=True))
        pairs = [*pairs, (step, change)][-memory:]
    assert torch.equal(history.add(like, -like, scale), scale)
    assert torch.isfinite(history.turned(like, scale)).all()
    if memory == 1:
        assert_close(history.turned(like, scale), scale * like)


def test_each_row_has_pairs_of_its_own():
    """Rows that now and then miss a pair, in memory that held something else, are as each alone and as a few."""
    generator = torch.Generator().manual_seed(1)
    random = lambda *shape: torch.randn(*shape, dtype=torch.float64, generator=generator)  # noqa: E731
    histories = [History(torch.zeros(n, 20).double(), 4) for n in (3, 1, 1, 1)]
    for history in histories:
        history.steps.fill_(torch.nan)
        history.changes.fill_(torch.nan)
    scales = [torch.ones(len(history.steps), 1).double() for history in histories]
    missing = [(0,), (), (1,), (), (0, 2), (), (), (1,), (), ()]
    for absent in missing:
        step = random(3, 20)
        change = step * (1 + random(3, 20).abs())
        rows = torch.tensor([i not in absent for i in range(3)])
        scales[0] = histories[0].add(
            step * rows[:, None], change * rows[:, None], scales[0], None if bool(rows.all()) else rows
        )
        for i in set(range(3)) - set(absent):
            scales[i + 1] = histories[i + 1].add(step[i : i + 1], change[i : i + 1], scales[i + 1])
        gradient = random(3, 20)
        known = [i for i in range(3) if histories[i + 1].used]
        together, way = histories[0].turned(gradient, scales[0]), histories[0].travelled()
        some = histories[0][torch.tensor(known)].turned(gradient[known], scales[0][known])
        for k, i in enumerate(known):
            alone = histories[i + 1].turned(gradient[i : i + 1], scales[i + 1])[0]
            assert_close(together[i], alone)
            assert_close(some[k], alone)
            assert_close(way[i], histories[i + 1].travelled()[0])


def test_operations_do_not_grow_with_the_memory():
    counts = []
    for memory in (5, 10, 40):
        history = History(STARTS, memory)
        for k in range(50):
            change = normal(*STARTS.shape, seed=k) - STARTS
            history.add(STARTS, change, torch.ones(len(STARTS), 1).double())
        counts.append(count_operations(lambda h=history: h.turned(STARTS, torch.ones(len(STARTS), 1).double())).total)
    assert len(set(counts)) == 1 and counts[0] < 25


def test_more_steps_are_never_worse():
    before = rosenbrock(STARTS)
    for steps in (1, 2, 3, 5, 8, 13, 21):
        energy = rosenbrock(lbfgs(rosenbrock, STARTS, num_steps=steps, tolerance=0.0).value)
        assert (energy <= before).all()
        before = energy
    assert (before[1:6] < 0.5 * rosenbrock(STARTS)[1:6]).all()


@pytest.mark.parametrize("factor", [1e-6, 1e6])
def test_units_do_not_matter(factor):
    """Neither the energy's nor the unknowns'."""
    start = STARTS[:3]
    plain = lbfgs(rosenbrock, start, num_steps=15, tolerance=0.0).value
    assert_close(lbfgs(lambda x: factor * rosenbrock(x), start, num_steps=15, tolerance=0.0).value, plain)
    scaled = lbfgs(lambda x: rosenbrock(x / factor), factor * start, num_steps=15, tolerance=0.0).value
    assert_close(scaled / factor, plain)


def test_turned_unknowns_give_turned_minimisers():
    turn = rotations(seed=4)
    start = STARTS[:4, :3]
    plain = lbfgs(rosenbrock, start, num_steps=10, tolerance=0.0).value
    assert_close(
        lbfgs(lambda x: rosenbrock(x @ turn), start @ turn.mT, num_steps=10, tolerance=0.0).value @ turn, plain
    )


def test_stays_within_the_domain():
    """x - log x is infinite from 0 down: steps that leave the domain are shortened."""
    start = torch.tensor([[1e-3], [1e3], [1.0]]).double()
    found = lbfgs(lambda x: (x - x.log()).sum(-1), start, num_steps=100, tolerance=1e-12)
    assert_close(found.value, torch.ones(3, 1).double(), rtol=0, atol=1e-4)


def test_nan_of_one_row_stays_there():
    def energy(x):
        return (x - 2).square().sum(-1) * torch.tensor([1.0, torch.nan, 1.0])

    start = normal(3, 4)
    found = lbfgs(energy, start)
    assert torch.equal(found.value[1], start[1]) and not found.converged
    assert_close(found.value[[0, 2]], torch.full((2, 4), 2.0).double(), rtol=0, atol=1e-4)


def test_start_at_the_optimum_and_flat_energies():
    goal = normal(2, 3)
    found = lbfgs(lambda x: (x - goal).square().sum(-1), goal)
    assert torch.equal(found.value, goal) and found.converged
    flat = lbfgs(lambda x: 0 * x.sum(-1), goal)
    assert torch.equal(flat.value, goal) and flat.converged
    none = lbfgs(rosenbrock, STARTS, num_steps=0)
    assert torch.equal(none.value, STARTS) and not none.converged and none.iterations == 0


def test_says_whether_it_settled():
    assert not lbfgs(rosenbrock, STARTS, num_steps=12).converged
    found = lbfgs(rosenbrock, STARTS, num_steps=1000)
    assert found.converged and 12 < found.iterations < 1000
    early = lbfgs(rosenbrock, STARTS, num_steps=1000, tolerance=1e-2)
    assert early.iterations <= found.iterations


def test_ends_where_it_is_told_to():
    told = lbfgs(rosenbrock, STARTS, num_steps=1000, enough=lambda made, x, value: int(made.amax()) == 12)
    assert not told.converged and told.iterations == 12
    assert_close(rosenbrock(told.value), told.energy)


@pytest.mark.parametrize("dtype", FLOATS)
@pytest.mark.parametrize("grad", [True, False])
def test_follows_dtype_and_keeps_no_graph(dtype, grad):
    start = STARTS.to(dtype).requires_grad_()
    with torch.set_grad_enabled(grad):
        found = lbfgs(rosenbrock, start, num_steps=200).value
    assert found.dtype == dtype and not found.requires_grad
    assert (rosenbrock(found) < 10).all()
    leaves_arguments_alone(lambda x: lbfgs(rosenbrock, x, num_steps=5).value, STARTS)


def test_energies_with_corners():
    """Where no step helps any more, the problem rests, finite and not above where it came from."""
    start = normal(6, 4, seed=3)
    found = lbfgs(lambda x: x.abs().sum(-1), start, num_steps=200)
    assert torch.isfinite(found.value).all()
    assert (found.value.abs().sum(-1) < 0.1 * start.abs().sum(-1)).all()


def test_what_is_no_problem_in_rows_is_told():
    square = lambda x: x.square().sum(-1)  # noqa: E731
    with pytest.raises(ShapeError, match=r"lbfgs: start: expected problems in rows \(H, D\), got \(3,\)"):
        lbfgs(square, torch.ones(3))
    with pytest.raises(ShapeError, match=r"lbfgs: energy: expected a value of each row, \(H,\), got shape \(\) of 2"):
        lbfgs(lambda x: x.square().sum(), torch.ones(2, 3))
    with pytest.raises(OptionError, match="lbfgs: memory: expected at least 1 pair, got 0"):
        lbfgs(square, torch.ones(2, 3), memory=0)
    nothing = lbfgs(square, torch.ones(0, 3))
    assert nothing.value.shape == (0, 3) and nothing.iterations == 0


def test_within_inference_mode_there_are_derivatives():
    with torch.inference_mode():
        found = lbfgs(lambda x: (x - 2).square().sum(-1), torch.zeros(2, 3).double())
    assert_close(found.value, torch.full((2, 3), 2.0).double())
