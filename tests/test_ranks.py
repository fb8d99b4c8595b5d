"""Medians by sorting are torch's own, in values and in gradients."""

import pytest
import torch
from torch.testing import assert_close

from kcs_torch.functional import ranks


@pytest.fixture
def sorting(monkeypatch):
    monkeypatch.setattr(ranks, "_sorts", lambda values: True)


def values(shape=(4, 5, 6), gaps=0.4):
    generator = torch.Generator().manual_seed(0)
    x = torch.randn(shape, generator=generator, dtype=torch.float64)
    x[torch.rand(shape, generator=generator) < gaps] = torch.nan
    if gaps:
        x[..., 0] = torch.nan
        x[0] = torch.nan
    return x.requires_grad_()


@pytest.mark.parametrize("name", ["median", "nanmedian"])
@pytest.mark.parametrize("gaps", [0.0, 0.1, 0.6])
@pytest.mark.parametrize("dim", [0, 1, -1])
@pytest.mark.parametrize("keepdim", [False, True])
def test_medians(sorting, name, gaps, dim, keepdim):
    x, y = values(gaps=gaps), values(gaps=gaps)
    expected, found = getattr(x, name)(dim, keepdim).values, getattr(ranks, name)(y, dim, keepdim)
    assert_close(found, expected, rtol=0, atol=0, equal_nan=True)
    for z in (expected, found):
        z[z.isfinite()].square().sum().backward()
    assert_close(y.grad, x.grad, rtol=0, atol=0)


@pytest.mark.parametrize("k", [1, 3, 5])
def test_kth_smallest(sorting, k):
    x, y = values(gaps=0), values(gaps=0)
    expected, found = x.kthvalue(k, 1).values, ranks.kth_smallest(y, k, 1)
    assert_close(found, expected, rtol=0, atol=0)
    expected.square().sum().backward(), found.square().sum().backward()
    assert_close(y.grad, x.grad, rtol=0, atol=0)


def test_sorts_where_torch_has_no_deterministic_form():
    x = torch.empty(3, 4, device="meta")
    torch.use_deterministic_algorithms(True)
    with pytest.raises(RuntimeError, match="deterministic"):
        x.nanmedian(-1)
    assert ranks.nanmedian(x, -1).shape == ranks.median(x, -1).shape == (3,)
