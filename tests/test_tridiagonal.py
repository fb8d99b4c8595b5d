"""Tridiagonal systems: against dense solves, derivatives, batches, and how the work grows."""

import pytest
import torch
from numerics import FLOATS, count_operations, gradcheck, leaves_arguments_alone, normal
from torch.testing import assert_close

from kcs_torch.functional.tridiagonal import DENSE, solve_tridiagonal


def system(*shape, dtype=torch.float64, weak=0.01):
    """A positive definite system, of which some unknowns hang on others alone."""
    beside = -1 - normal(*shape[:-1], shape[-1] - 1, seed=1).abs()
    own = weak + normal(*shape, seed=2).abs()
    own[..., ::3] = 1e-3 * weak
    row = torch.nn.functional.pad(-beside, (0, 1)) + torch.nn.functional.pad(-beside, (1, 0))
    return tuple(x.to(dtype) for x in (own + row, beside, normal(*shape)))


def dense(diagonal, beside, right):
    matrix = diagonal.diag_embed() + beside.diag_embed(1) + beside.diag_embed(-1)
    return torch.linalg.solve(matrix, right)


@pytest.mark.parametrize("shape", [(), (2,), (2, 3)])
@pytest.mark.parametrize("size", [1, 2, 3, DENSE, DENSE + 1, DENSE + 2, 2 * DENSE + 1, 2 * DENSE + 2, 101, 400])
def test_as_dense(size, shape):
    given = system(*shape, size)
    assert_close(leaves_arguments_alone(solve_tridiagonal, *given), dense(*given))


@pytest.mark.parametrize("dtype", FLOATS)
def test_follows_dtype(dtype):
    given = system(101, dtype=dtype, weak=1.0)
    found = solve_tridiagonal(*given)
    assert found.dtype == dtype
    assert_close(found, dense(*given), rtol=1e-3, atol=1e-3)


def test_gradient():
    assert gradcheck(solve_tridiagonal, *system(2, 2 * DENSE + 3, weak=1.0), fast=True)


def test_work_grows_with_the_size_and_operations_with_its_logarithm():
    short, long = (count_operations(lambda n=n: solve_tridiagonal(*system(n))) for n in (1000, 16000))
    assert long.elements < 17 * short.elements and long.total < 2 * short.total
