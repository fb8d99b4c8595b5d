"""Derivatives at a fixed point: the adjoint solver against dense ones, the fixed point against finite differences."""

import pytest
import torch
from numerics import FLOATS, gradcheck, normal
from torch.testing import assert_close

from kcs_torch.errors import ConvergenceWarning, OptionError
from kcs_torch.solvers import Implicit, fixed_point, gmres


@pytest.mark.parametrize("dtype", FLOATS)
def test_gmres_solves_each_system_of_a_batch(dtype):
    matrix, rhs = torch.eye(6) + 0.3 * normal(2, 3, 6, 6), normal(2, 3, 6, seed=1)
    matrix, rhs = matrix.to(dtype), rhs.to(dtype)
    tolerance = 1e-5 if dtype == torch.float32 else 1e-12
    found, residual = gmres(lambda x: (matrix @ x[..., None]).squeeze(-1), rhs, tolerance=tolerance)
    assert (residual <= tolerance).all()
    assert_close(found, torch.linalg.solve(matrix, rhs), rtol=100 * tolerance, atol=100 * tolerance)


def test_gmres_takes_unknowns_of_several_dimensions():
    matrix, rhs = torch.eye(6) + 0.3 * normal(6, 6), normal(4, 2, 3)
    found, _ = gmres(lambda x: (x.flatten(1) @ matrix.mT).view_as(x), rhs, inner=2, tolerance=1e-12)
    assert_close(found, torch.linalg.solve(matrix, rhs.flatten(1).mT).mT.view_as(rhs))
    whole, _ = gmres(lambda x: (x.flatten(1) @ matrix.mT).view_as(x), rhs, inner=3, tolerance=1e-12)
    assert_close(whole, found)


def test_gmres_stops_early_where_few_products_do():
    asked = []
    gmres(lambda x: asked.append(1) or 2 * x, normal(40), tolerance=1e-10)
    assert len(asked) == 5  # the residual is looked at after every fifth


def test_gmres_tells_what_it_did_not_reach():
    matrix = torch.diag(torch.logspace(-4, 0, 30, dtype=torch.float64))
    _, residual = gmres(lambda x: matrix @ x, normal(30), num_steps=5, tolerance=1e-12)
    assert residual > 1e-3


@pytest.mark.parametrize("dtype", FLOATS)
def test_singular_systems_and_far_cotangents_are_finite(dtype):
    matrix = torch.diag(torch.tensor([1.0, 0.5, 0.0, 0.0], dtype=dtype))
    for size in (0.0, 1e-30, 1e30):
        found, residual = gmres(lambda x: matrix @ x, size * torch.ones(4, dtype=dtype))
        assert torch.isfinite(found).all() and torch.isfinite(residual).all()
    consistent = torch.tensor([1.0, 1.0, 0.0, 0.0], dtype=dtype)
    found, residual = gmres(lambda x: matrix @ x, consistent)
    assert residual < 1e-5
    assert_close(found[:2], torch.tensor([1.0, 2.0], dtype=dtype), rtol=1e-4, atol=1e-4)


def test_a_cotangent_that_is_not_finite_is_passed_on_and_spoils_no_other():
    """So that a scaler of gradients sees it, and takes no step."""
    rhs = torch.tensor([[1.0, 2.0], [torch.inf, 1.0], [torch.nan, 0.0]], dtype=torch.float64)
    found, residual = gmres(lambda x: 2 * x, rhs)
    assert_close(found[0], rhs[0] / 2)
    assert found[1:].isnan().all() and residual.isfinite().all()


def settled(step, start):
    with torch.no_grad():
        for _ in range(400):
            start = step(start)
    return start


def test_linear_fixed_point_in_closed_form():
    matrix, rhs = 0.2 * normal(5, 5), normal(5, seed=1)
    matrix, rhs = matrix.requires_grad_(), rhs.requires_grad_()
    step = lambda x: matrix @ x + rhs  # noqa: E731
    value = fixed_point(step, settled(step, torch.zeros(5).double()), tolerance=1e-12)
    expected = torch.linalg.solve(torch.eye(5) - matrix, rhs)
    assert_close(value, expected)
    cotangent = normal(5, seed=2)
    assert_close(
        torch.autograd.grad(value, (matrix, rhs), cotangent), torch.autograd.grad(expected, (matrix, rhs), cotangent)
    )


def test_fixed_point_of_a_batch_against_finite_differences():
    def function(weight, bias):
        step = lambda x: torch.tanh(x @ weight + bias)  # noqa: E731
        return fixed_point(step, settled(step, torch.zeros_like(bias)), tolerance=1e-12)

    assert gradcheck(function, 0.3 * normal(4, 4), normal(3, 4, seed=1))


def test_one_step_is_made_where_nothing_is_recorded():
    scale = torch.tensor(0.5, requires_grad=True)
    with torch.no_grad():
        value = fixed_point(lambda x: scale * x, torch.ones(3))
    assert not value.requires_grad and torch.equal(value, torch.full((3,), 0.5))


def test_what_nothing_holds_is_told():
    """x = x + a - a: any x is a fixed point."""
    a = torch.ones(3, dtype=torch.float64, requires_grad=True)
    value = fixed_point(lambda x: x + a - a.detach(), torch.zeros(3, dtype=torch.float64), name="nothing")
    with pytest.warns(ConvergenceWarning, match="nothing: the derivative at the fixed point"):
        (grad,) = torch.autograd.grad(value.sum(), a)
    assert torch.isfinite(grad).all()


@pytest.mark.parametrize("step", [lambda a, x: a * x.cos(), lambda a, x: (x + a / x) / 2 + 0.1 * (a.sqrt() - x)])
def test_second_derivatives_raise(step):
    """Of a cotangent that is constant they lacked what the solution of the adjoint equation adds."""
    a = torch.tensor([0.3], requires_grad=True)
    value = fixed_point(lambda x: step(a, x), settled(lambda x: step(a.detach(), x), torch.ones(1)))
    (grad,) = torch.autograd.grad(value.sum(), a, create_graph=True)
    with pytest.raises(RuntimeError, match="second derivatives of a fixed point are not supported"):
        torch.autograd.grad(grad.square().sum(), a)


@pytest.mark.parametrize("options", [{"settle": -1}, {"adjoint_steps": 0}, {"tolerance": -1.0}])
def test_options_out_of_range(options):
    with pytest.raises(OptionError, match="expected settle"):
        Implicit(**options)
