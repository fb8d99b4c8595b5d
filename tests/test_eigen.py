"""functional/eigen.py and jacobi.py: eigenvectors of many matrices, in Triton's interpreter where there is no GPU."""

from importlib import import_module

import pytest
import torch
from numerics import DEVICES, FLOATS, normal
from torch.testing import assert_close

from kcs_torch.functional import eigen, svt
from kcs_torch.functional.eigen import eigh, eigvalsh

GPU = DEVICES[-1]
gpu_only = pytest.mark.skipif(GPU == "cpu", reason="no GPU here")


@pytest.fixture(scope="module")
def jacobi():
    """The function; where there is no GPU, tests/conftest.py asks Triton to interpret its kernel."""
    pytest.importorskip("triton", reason="needs Triton, which comes with PyTorch for GPUs")
    return import_module("kcs_torch.functional.jacobi").jacobi


def spectra(*eigenvalues, seed=0, dtype=torch.float64):
    """Matrices (K, n, n) with these eigenvalues, and random eigenvectors."""
    size = len(eigenvalues[0])
    turn, _ = torch.linalg.qr(normal(len(eigenvalues), size, size, seed=seed))
    values = torch.stack([torch.as_tensor(v, dtype=torch.float64) for v in eigenvalues])
    full = (turn * values[:, None]) @ turn.mT
    return ((full + full.mT) / 2).to(dtype)


def check(matrix, values, vectors, tolerance):
    """Rising eigenvalues, orthonormal vectors, and their product the matrix, in double precision."""
    matrix, values, vectors = (x.cpu().double() for x in (matrix, values, vectors))
    size = torch.linalg.matrix_norm(matrix)[:, None]
    eye = torch.eye(matrix.shape[-1], dtype=torch.float64).expand_as(matrix)
    assert (values.diff(dim=-1) >= 0).all()
    assert_close(values / size, torch.linalg.eigvalsh(matrix) / size, rtol=0, atol=tolerance)
    assert_close(vectors.mT @ vectors, eye, rtol=0, atol=10 * tolerance)
    again = (vectors * values[:, None]) @ vectors.mT
    assert_close(again / size[..., None], matrix / size[..., None], rtol=0, atol=tolerance)


@pytest.mark.parametrize("dtype", FLOATS)
@pytest.mark.parametrize("size", [2, 3, 10, 35])
def test_kernel(jacobi, size, dtype):
    """Random ones, and ones whose eigenvalues are of many orders; of an even and an odd number of rows."""
    matrix = spectra(torch.linspace(-1, 2, size), 10 ** torch.linspace(3, -12, size), dtype=dtype).to(GPU)
    check(matrix, *jacobi(matrix), 1e-13 if dtype == torch.float64 else 3e-6)


def test_kernel_of_repeated_eigenvalues(jacobi):
    matrix = spectra([3.0] * 5 + [1.0] * 4 + [0.0] * 3, [1.0] * 6 + [-1.0] * 6, [1.0] + [0.0] * 11, [1.0] * 12).to(GPU)
    check(matrix, *jacobi(matrix), 1e-12)


@pytest.mark.parametrize("scale", [1e-200, 1e200])
def test_kernel_at_any_size(jacobi, scale):
    """No square overflows, and none vanishes."""
    matrix = spectra(torch.linspace(0.1, 2, 8)).to(GPU)
    values, vectors = jacobi(scale * matrix)
    check(matrix, values / scale, vectors, 1e-13)


def test_kernel_of_diagonal_and_zero_matrices(jacobi):
    values = torch.tensor([3.0, 0.0, 2.0, -1.0], dtype=torch.float64)
    matrix = torch.stack([torch.diag(values), torch.zeros(4, 4, dtype=torch.float64)]).to(GPU)
    found, vectors = jacobi(matrix)
    assert_close(found.cpu(), torch.stack([values.sort().values, 0 * values]))
    assert_close((vectors.mT @ vectors).cpu(), torch.eye(4, dtype=torch.float64).expand(2, 4, 4))


def test_kernel_passes_nan_on_and_keeps_it_apart(jacobi):
    matrix = spectra([1.0, 2, 3, 4], [1.0, 2, 3, 4]).to(GPU)
    matrix[0, 1, 2] = torch.nan
    values, _ = jacobi(matrix)
    assert values[0].isnan().any() and values[1].isfinite().all()


def test_on_a_processor_it_is_the_library(monkeypatch):
    monkeypatch.setattr(eigen, "_has_triton", lambda: pytest.fail("looked for Triton"))
    matrix = spectra(*torch.linspace(1, 2, 40)[None].expand(50, -1))
    library = (*torch.linalg.eigh(matrix), torch.linalg.eigvalsh(matrix))
    for ours, theirs in zip((*eigh(matrix), eigvalsh(matrix)), library, strict=True):
        assert torch.equal(ours, theirs)


@gpu_only
@pytest.mark.parametrize("dtype", FLOATS)
@pytest.mark.parametrize("size", [33, 51, 99, 128])
@pytest.mark.parametrize("batch", [(1,), (3,), (70,), (4, 50)])
def test_on_a_gpu(size, batch, dtype):
    spread = 10 ** torch.linspace(0, -10, size)
    matrix = spectra(*spread[None].expand(torch.Size(batch).numel(), -1), dtype=dtype).to(GPU)
    values, vectors = eigh(matrix.unflatten(0, batch))
    check(matrix, values.flatten(0, -2), vectors.flatten(0, -3), 1e-13 if dtype == torch.float64 else 1e-4)
    assert_close(eigvalsh(matrix.unflatten(0, batch)), values, rtol=0, atol=1e-4)


@gpu_only
def test_many_take_the_kernel_and_nan_is_refused(monkeypatch):
    matrix = spectra(*torch.linspace(1, 2, 51)[None].expand(64, -1)).to(GPU)
    matrix[5, 3, 3] = torch.nan
    with pytest.raises(torch.linalg.LinAlgError, match="expected finite numbers"):
        eigh(matrix)
    assert not eigen._are_many(matrix[..., :32, :32]) and not eigen._are_many(matrix[:2])


@gpu_only
def test_shrinkage_on_a_gpu_is_that_of_a_processor():
    matrix = normal(40, 100, 51) * torch.logspace(0, -8, 51, dtype=torch.float64)
    level = torch.linspace(1e-4, 1, 40, dtype=torch.float64)
    assert_close(svt(matrix.to(GPU), level.to(GPU)).cpu(), svt(matrix, level), rtol=0, atol=1e-12)
