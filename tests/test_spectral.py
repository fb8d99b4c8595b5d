"""Functions of singular values: against plain SVDs, as proximal maps, and their derivatives where the SVD has none."""

import math

import pytest
import scipy.fft
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from numerics import (
    DEVICES,
    FLOATS,
    HALVES,
    finite,
    gradcheck,
    leaves_arguments_alone,
    normal,
    same_as_loop,
)
from torch.testing import assert_close

from kcs_torch.errors import NotFiniteError, OptionError, ShapeError
from kcs_torch.functional import (
    dct_basis,
    log_det,
    nearest_rotation,
    nuclear_norm,
    procrustes,
    psd_shrink,
    scatter_log_det,
    singular_values,
    spectral_norm,
    svt,
)


def plain_svt(matrix, threshold, corner=math.inf):
    """The textbook, through torch.linalg.svd and its derivative."""
    u, s, vt = torch.linalg.svd(matrix, full_matrices=False)
    return (u * (s - threshold / (1 + s / corner)).clamp_min(0)[..., None, :]) @ vt


def nuclear(matrix):
    return torch.linalg.svdvals(matrix).sum(-1)


def orthonormal(rows, columns, seed=0):
    return torch.linalg.qr(normal(rows, columns, seed=seed))[0]


def static(frames, columns, seed=0):
    """The same pose in all frames: rank 1."""
    return normal(1, columns, seed=seed).expand(frames, columns).clone()


def tied(frames, columns):
    """Singular values 3, 3, 1, 1, 1, 0, ..."""
    s = torch.zeros(min(frames, columns), dtype=torch.float64)
    s[:2], s[2:5] = 3, 1
    return (orthonormal(frames, len(s)) * s) @ orthonormal(columns, len(s), seed=1).mT


# Where a plain SVD has no derivative, and where it has one.
MATRICES = {
    "tall": normal(7, 4),
    "wide": normal(4, 7),
    "square": normal(5, 5),
    "static tall": static(8, 5),
    "static wide": static(4, 6),
    "tied tall": tied(8, 6),
    "tied wide": tied(6, 9),
    "tied square": 1.7 * orthonormal(5, 5),
    "one frame": normal(1, 6),
    "two frames": normal(2, 6),
    "two equal frames": static(2, 6),
    "one column": normal(6, 1),
    "unseen joints": torch.cat([normal(6, 3), torch.zeros(6, 3, dtype=torch.float64)], -1),
    "unseen frames": torch.cat([normal(4, 5), torch.zeros(3, 5, dtype=torch.float64)], -2),
    "static, unseen joints": torch.cat([static(6, 3), torch.zeros(6, 3, dtype=torch.float64)], -1),
    "zero": torch.zeros(5, 4, dtype=torch.float64),
}
each_matrix = pytest.mark.parametrize("matrix", MATRICES.values(), ids=MATRICES.keys())


# ---------------------------------------------------------------------- svt


each_corner = pytest.mark.parametrize("corner", [math.inf, 3.0, 0.2])


@each_matrix
@each_corner
@pytest.mark.parametrize("threshold", [0.0, 0.4, 2.0, 50.0])
def test_svt_is_the_textbook(matrix, threshold, corner):
    assert_close(svt(matrix, threshold, corner), plain_svt(matrix, threshold, corner))


@each_matrix
@each_corner
@pytest.mark.parametrize("threshold", [0.4, 2.0, 50.0])
def test_svt_gradient(matrix, threshold, corner):
    rest = [torch.tensor(x, dtype=torch.float64) for x in (threshold, corner) if x < math.inf]
    assert gradcheck(svt, matrix, *rest)


def test_svt_takes_a_corner_of_nothing_for_none():
    """The size of a matrix of zeros, of which a corner is a share, is 0."""
    matrix = torch.stack([normal(5, 4), torch.zeros(5, 4, dtype=torch.float64)])
    corner = 0.1 * spectral_norm(matrix)
    assert_close(svt(matrix, 0.3, corner)[0], plain_svt(matrix[0], 0.3, corner[0]))
    assert_close(svt(matrix, 0.3, corner)[1], matrix[1])
    assert_close(svt(matrix, 0.3, 0.0), svt(matrix, 0.3))


@each_matrix
@pytest.mark.parametrize("threshold", [0.4, 2.0])
def test_svt_gradient_in_an_infinite_corner_is_0(matrix, threshold):
    corner = torch.tensor(math.inf, dtype=torch.float64, requires_grad=True)
    svt(matrix, threshold, corner).sum().backward()
    assert corner.grad == 0


@each_matrix
@pytest.mark.parametrize("corner", [5e-324, 1e-310, 1e-200, 1e300])
def test_svt_corners_without_measure(matrix, corner):
    """What is no longer a normal number has an infinite inverse, and infinity times 0 is NaN."""
    corner = torch.tensor(corner, dtype=torch.float64)
    for level in (0.4, 1e-200):
        finite(svt, matrix, torch.tensor(level, dtype=torch.float64), corner)
    assert_close(svt(matrix, 0.4, corner), svt(matrix, 0.0 if corner < 1 else 0.4))


@pytest.mark.parametrize("name", ["tall", "wide", "tied tall", "static wide", "unseen joints"])
@pytest.mark.parametrize("corner", [0.2, 3.0])
def test_reweighted_svt_does_not_raise_the_logarithmic_penalty(name, corner):
    """It minimises a majoriser of t c sum log(1 + s / c) that touches it at the matrix itself."""
    target, threshold = MATRICES[name], 0.4
    best = svt(target, threshold, corner)

    def objective(x):
        penalty = corner * (torch.linalg.svdvals(x) / corner).log1p().sum(-1)
        return 0.5 * (x - target).square().sum((-2, -1)) + threshold * penalty

    assert objective(best) < objective(target)
    slope = threshold / (1 + torch.linalg.svdvals(target) / corner)
    assert_close(torch.linalg.svdvals(best), (torch.linalg.svdvals(target) - slope).clamp_min(0))


@each_matrix
def test_svt_without_threshold_passes_gradients_through(matrix):
    cotangent = normal(*matrix.shape, seed=5)
    leaf = matrix.clone().requires_grad_()
    svt(leaf, 0.0).backward(cotangent)
    assert_close(leaf.grad, cotangent)


@pytest.mark.parametrize("name", ["tall", "wide", "square"])
def test_svt_gradient_is_that_of_autograd_where_it_has_one(name):
    grads = []
    for function in (svt, plain_svt):
        matrix = MATRICES[name].clone().requires_grad_()
        level, corner = (torch.tensor(x, dtype=torch.float64).requires_grad_() for x in (0.7, 1.5))
        function(matrix, level, corner).backward(normal(*matrix.shape, seed=2))
        grads.append((matrix.grad, level.grad, corner.grad))
    assert_close(grads[0], grads[1])


@pytest.mark.parametrize("name", ["unseen joints", "unseen frames", "static, unseen joints", "zero"])
@pytest.mark.parametrize("dtype", FLOATS)
def test_autograd_through_a_plain_svd_gives_nan_where_svt_does_not(name, dtype):
    """Why these functions own their derivatives: where singular values are equal, autograd divides by zero."""
    matrix = MATRICES[name].to(dtype)
    plain = matrix.clone().requires_grad_()
    plain_svt(plain, 0.4).sum().backward()
    assert plain.grad.isnan().any()
    finite(lambda x: svt(x, 0.4), matrix)


@pytest.mark.parametrize("name", ["tall", "wide", "tied tall", "static wide", "unseen joints"])
@pytest.mark.parametrize("threshold", [0.3, 1.5])
def test_svt_is_the_proximal_map_of_the_nuclear_norm(name, threshold):
    target = MATRICES[name]
    best = svt(target, threshold)

    def objective(x):
        return 0.5 * (x - target).square().sum((-2, -1)) + threshold * nuclear(x)

    others = best + normal(200, *target.shape, seed=4) * torch.logspace(-4, 0, 200, dtype=torch.float64)[:, None, None]
    assert (objective(others) >= objective(best)).all()
    dual = (target - best) / threshold  # a subgradient of the nuclear norm at the solution
    assert torch.linalg.matrix_norm(dual, 2) <= 1 + 1e-12
    assert_close((dual * best).sum(), nuclear(best))


def test_svt_does_not_expand():
    a, b = normal(50, 6, 4), normal(50, 6, 4, seed=1)
    moved = torch.linalg.matrix_norm(svt(a, 0.8) - svt(b, 0.8))
    assert (moved <= torch.linalg.matrix_norm(a - b) + 1e-12).all()


def test_svt_turns_with_the_matrix():
    matrix, left, right = normal(6, 4), orthonormal(6, 6), orthonormal(4, 4, seed=1)
    assert_close(svt(left @ matrix @ right, 0.5), left @ svt(matrix, 0.5) @ right)


def test_svt_takes_a_threshold_for_each_matrix():
    matrices, levels = normal(3, 6, 4), torch.tensor([0.1, 1.0, 3.0], dtype=torch.float64)
    parts = [svt(m, t) for m, t in zip(matrices, levels, strict=True)]
    assert_close(svt(matrices, levels), torch.stack(parts))
    one = torch.stack([svt(matrices[0], t) for t in levels])
    assert_close(svt(matrices[0], levels), one)  # broadcast the other way
    assert gradcheck(svt, matrices, levels)
    assert gradcheck(svt, matrices[0], levels)
    assert gradcheck(svt, matrices, levels[:1])


def decaying(frames=60, columns=30):
    """Singular values from 1 down to 1e-6, as trajectories of bodies have."""
    s = torch.logspace(0, -6, columns, dtype=torch.float64)
    return (orthonormal(frames, columns) * s) @ orthonormal(columns, columns, seed=1).mT


@pytest.mark.parametrize("threshold", [1e-1, 1e-3, 1e-4, 3e-5])
@pytest.mark.parametrize("transpose", [False, True])
def test_svt_in_single_precision_is_as_good_as_its_numbers(threshold, transpose):
    """A Gram matrix in single precision would lose what lies below 3e-4: a third of this gradient."""
    values, grads = [], []
    for dtype in (torch.float64, torch.float32):
        matrix = (decaying().mT if transpose else decaying()).to(dtype, copy=True).requires_grad_()
        value = svt(matrix, threshold)
        value.backward(normal(*matrix.shape, seed=6, dtype=dtype))
        values.append(value.detach().double())
        grads.append(matrix.grad.double())
    assert (values[0] - values[1]).norm() < 1e-6
    assert (grads[0] - grads[1]).norm() < 5e-3 * grads[0].norm()


def test_svt_tells_small_singular_values():
    assert_close(svt(decaying(), 1e-5), plain_svt(decaying(), 1e-5), rtol=0, atol=1e-12)


# ---------------------------------------------------------------------- psd_shrink

SYMMETRIC = {
    "any": normal(5, 5) + normal(5, 5).mT,
    "tied": (orthonormal(5, 5) * torch.tensor([2.0, 2, 2, -1, -1])) @ orthonormal(5, 5).mT,
    "rank 1": normal(5, 1) @ normal(5, 1).mT,
    "identity": torch.eye(4, dtype=torch.float64),
    "negative": -torch.eye(4, dtype=torch.float64) - normal(4, 1) @ normal(4, 1).mT,
    "zero": torch.zeros(4, 4, dtype=torch.float64),
    "1 x 1": torch.tensor([[3.0]], dtype=torch.float64),
}
each_symmetric = pytest.mark.parametrize("matrix", SYMMETRIC.values(), ids=SYMMETRIC.keys())


@each_symmetric
@pytest.mark.parametrize("threshold", [0.0, 0.5, 4.0])
def test_psd_shrink_is_the_textbook(matrix, threshold):
    value, vector = torch.linalg.eigh(matrix)
    expected = (vector * (value - threshold).clamp_min(0)) @ vector.mT
    got = psd_shrink(matrix, threshold)
    assert_close(got, expected)
    assert (torch.linalg.eigvalsh(got) > -1e-12).all()


@each_symmetric
@pytest.mark.parametrize("threshold", [0.3, 1.5])
def test_psd_shrink_gradient(matrix, threshold):
    assert gradcheck(psd_shrink, matrix, torch.tensor(threshold, dtype=torch.float64))


@each_symmetric
@pytest.mark.parametrize("threshold", [0.2, 1.5])
def test_psd_shrink_is_the_proximal_map_of_the_trace(matrix, threshold):
    best = psd_shrink(matrix, threshold)

    def objective(x):
        return 0.5 * (x - matrix).square().sum((-2, -1)) + threshold * x.diagonal(dim1=-2, dim2=-1).sum(-1)

    steps = normal(200, *matrix.shape, seed=4) * torch.logspace(-4, 0, 200, dtype=torch.float64)[:, None, None]
    root = torch.linalg.cholesky(best + 1e-14 * torch.eye(len(matrix), dtype=torch.float64))
    others = (root + steps) @ (root + steps).mT  # positive semi-definite again
    assert (objective(others) >= objective(best) - 1e-10).all()


def test_psd_shrink_takes_the_symmetric_part():
    matrix = normal(4, 4)
    assert_close(psd_shrink(matrix, 0.1), psd_shrink((matrix + matrix.mT) / 2, 0.1))
    assert gradcheck(psd_shrink, matrix, torch.tensor(0.1, dtype=torch.float64))
    levels = torch.tensor([0.1, 1.0], dtype=torch.float64)
    assert gradcheck(psd_shrink, matrix, levels)


# ---------------------------------------------------------------------- norms


@each_matrix
def test_norms_are_those_of_singular_values(matrix):
    expected = torch.linalg.svdvals(matrix)
    least = 3e-8 * float(expected.max())  # what a Gram matrix tells from 0
    assert_close(singular_values(matrix), expected, rtol=1e-7, atol=least)
    assert_close(nuclear_norm(matrix), expected.sum(), rtol=1e-7, atol=len(expected) * least)
    assert_close(spectral_norm(matrix), expected[0])
    assert not singular_values(matrix.clone().requires_grad_()).requires_grad


@pytest.mark.parametrize("name", ["tall", "wide", "square", "tied square", "one frame", "two frames", "one column"])
def test_nuclear_norm_gradient(name):
    assert gradcheck(nuclear_norm, MATRICES[name])


@pytest.mark.parametrize("name", ["tall", "wide", "static tall", "static wide", "one frame", "unseen joints"])
def test_spectral_norm_gradient(name):
    assert gradcheck(spectral_norm, MATRICES[name])


@each_matrix
def test_nuclear_norm_gradient_is_a_subgradient(matrix):
    (grad,) = torch.autograd.grad(nuclear_norm(leaf := matrix.clone().requires_grad_()), leaf)
    assert torch.linalg.matrix_norm(grad, 2) <= 1 + 1e-9
    others = matrix + normal(100, *matrix.shape, seed=7)
    assert (nuclear(others) >= nuclear(matrix) + (grad * (others - matrix)).sum((-2, -1)) - 1e-9).all()


@each_matrix
def test_spectral_norm_gradient_is_a_subgradient(matrix):
    (grad,) = torch.autograd.grad(spectral_norm(leaf := matrix.clone().requires_grad_()), leaf)
    assert nuclear(grad) <= 1 + 1e-9
    others = matrix + normal(100, *matrix.shape, seed=7)
    lower = spectral_norm(matrix) + (grad * (others - matrix)).sum((-2, -1))
    assert (torch.linalg.matrix_norm(others, 2) >= lower - 1e-9).all()


def test_nuclear_norm_is_free_of_rotation():
    matrix, left, right = normal(6, 4), orthonormal(6, 6), orthonormal(4, 4, seed=1)
    assert_close(nuclear_norm(left @ matrix @ right), nuclear_norm(matrix))


# ---------------------------------------------------------------------- log_det


def covariance(*shape, seed=0):
    factor = normal(*shape, shape[-1] + 2, seed=seed)
    return factor @ factor.mT


def test_log_det_is_that_of_slogdet():
    matrix = covariance(3, 5)
    eps = torch.tensor([0.1, 1.0, 3.0], dtype=torch.float64)
    eye = torch.eye(5, dtype=torch.float64)
    assert_close(log_det(matrix, eps), torch.linalg.slogdet(matrix + eps[:, None, None] * eye).logabsdet)
    turn = orthonormal(5, 5)
    assert_close(log_det(turn @ matrix @ turn.mT, 0.1), log_det(matrix, 0.1))


@pytest.mark.parametrize("matrix", [covariance(4), torch.zeros(4, 4).double(), 2 * torch.eye(4).double()])
def test_log_det_gradient(matrix):
    symmetric = lambda x, eps: log_det((x + x.mT) / 2, eps)  # noqa: E731
    eps = torch.tensor(0.5, dtype=torch.float64)
    assert gradcheck(symmetric, matrix, eps)
    leaves = (matrix.clone().requires_grad_(), eps.clone().requires_grad_())
    assert torch.autograd.gradgradcheck(symmetric, leaves, fast_mode=True)  # this one may be differentiated twice


def test_log_det_refuses_what_is_no_covariance():
    with pytest.raises(ShapeError, match="square"):
        log_det(normal(4, 5), 1.0)
    with pytest.raises(ShapeError, match="positive definite"):
        log_det(-torch.eye(3), 0.5)
    with pytest.raises(ShapeError, match="positive definite"):
        log_det(torch.zeros(3, 3), 0.0)


# ---------------------------------------------------------------------- all of them


@pytest.mark.parametrize(
    "function",
    [lambda x: svt(x, 0.3), lambda x: psd_shrink(x, 0.3), nuclear_norm, spectral_norm],
    ids=["svt", "psd_shrink", "nuclear_norm", "spectral_norm"],
)
@pytest.mark.parametrize("constant", [True, False])
def test_second_derivatives_raise(function, constant):
    """Also where the cotangent is a constant, for which ``once_differentiable`` would be silent."""
    matrix = normal(4, 4).requires_grad_()
    value = function(matrix)
    value = value.sum() if constant else value.square().sum()
    (grad,) = torch.autograd.grad(value, matrix, create_graph=True)
    with pytest.raises(RuntimeError, match="second derivatives"):
        grad.square().sum().backward()


def test_second_derivatives_in_the_threshold_raise():
    level = torch.tensor(0.3, dtype=torch.float64, requires_grad=True)
    for function in (svt, psd_shrink):
        (grad,) = torch.autograd.grad(function(normal(4, 4), level).sum(), level, create_graph=True)
        with pytest.raises(RuntimeError, match="second derivatives"):
            grad.backward()


SIZES = st.integers(1, 6)
POWERS = st.floats(-6, 6)


@given(st.integers(0, 999), SIZES, SIZES, POWERS, POWERS, st.sampled_from(FLOATS))
@settings(max_examples=60, deadline=None)
def test_nothing_is_nan_at_any_scale(seed, rows, columns, size, level, dtype):
    matrix = normal(rows, columns, seed=seed, dtype=dtype) * 10.0**size
    if seed % 3 == 0:
        matrix[..., seed % columns] = 0
    if seed % 5 == 0:
        matrix = matrix[:1].expand(rows, columns)
    threshold = torch.tensor(10.0**level, dtype=dtype)
    finite(svt, matrix, threshold)
    finite(nuclear_norm, matrix)
    finite(spectral_norm, matrix)
    finite(psd_shrink, matrix @ matrix.mT, threshold)
    gram = matrix @ matrix.mT
    finite(log_det, gram, 1e-3 * gram.diagonal().mean() + torch.finfo(dtype).tiny ** 0.5)


def test_batches_equal_loops():
    for shape in [(6, 4), (4, 6)]:
        same_as_loop(lambda x: svt(x, 0.7), shape)
        same_as_loop(lambda x, t: svt(x, t.abs()), shape, ())
        same_as_loop(nuclear_norm, shape)
        same_as_loop(spectral_norm, shape)
        same_as_loop(singular_values, shape)
    same_as_loop(lambda x: psd_shrink(x, 0.2), (5, 5))
    same_as_loop(lambda x: log_det(x @ x.mT, 0.2), (5, 5))


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("dtype", FLOATS + HALVES)
def test_results_follow_dtype_and_device(dtype, device):
    matrix = normal(2, 4, 4, dtype=dtype, device=device)
    gram = matrix @ matrix.mT
    values = [
        leaves_arguments_alone(lambda x: svt(x, 0.3), matrix),
        leaves_arguments_alone(lambda x: psd_shrink(x, 0.3), matrix),
        leaves_arguments_alone(nuclear_norm, matrix),
        leaves_arguments_alone(spectral_norm, matrix),
        leaves_arguments_alone(singular_values, matrix),
        leaves_arguments_alone(lambda x: log_det(x, 1.0), gram),
        dct_basis(4, 2, dtype=dtype, device=torch.device(device)),
        *finite(lambda x: svt(x, 0.3), matrix),
        *finite(nuclear_norm, matrix),
    ]
    assert {(v.dtype, v.device.type) for v in values} == {(dtype, device)}
    if dtype in HALVES:
        assert_close(values[0].double(), svt(matrix.double(), 0.3), rtol=2e-2, atol=2e-2)


@pytest.mark.parametrize("function", [lambda x: svt(x, 1.0), lambda x: psd_shrink(x, 1.0), nuclear_norm, spectral_norm])
def test_vectors_are_refused(function):
    with pytest.raises(ShapeError, match=r"\(5,\)"):
        function(normal(5))


@pytest.mark.parametrize(
    "function",
    [lambda x: svt(x, 1.0), lambda x: psd_shrink(x, 1.0), nuclear_norm, spectral_norm, singular_values],
)
@pytest.mark.parametrize("recorded", [True, False])
def test_nan_is_refused_in_our_words(function, recorded):
    matrix = normal(2, 5, 5)
    matrix[1, 2, 3] = torch.nan
    with pytest.raises(NotFiniteError, match=r"finite numbers, got NaN.*\(2, 5, 5\).*weights of 0"):
        function(matrix.requires_grad_(recorded))


@pytest.mark.parametrize(
    "function",
    [
        *(lambda x: svt(x, 0.5), lambda x: psd_shrink(x, 0.5), nuclear_norm, spectral_norm, singular_values),
        *(lambda x: log_det(x @ x.mT, 0.5), nearest_rotation),
    ],
)
def test_whole_numbers_are_refused(function):
    """They came back cut off to whole numbers."""
    with pytest.raises(ShapeError, match=r"floating point, got .*torch\.int64"):
        function(torch.tensor([[2, 1], [0, 3]]))


@pytest.mark.parametrize("options", [{"threshold": -0.1}, {"threshold": 1.0, "corner": -1.0}])
def test_svt_refuses_negative_numbers(options):
    with pytest.raises(OptionError, match=r"svt: (threshold|corner): expected a number that is not negative, got -"):
        svt(normal(4, 3), **options)


@pytest.mark.parametrize(
    "function",
    [
        *(lambda x: svt(x, 0.5), lambda x: psd_shrink(x, 0.5), nuclear_norm, singular_values),
        *(lambda x: scatter_log_det(x, 0.5), nearest_rotation),
    ],
    ids=["svt", "psd_shrink", "nuclear_norm", "singular_values", "scatter_log_det", "nearest_rotation"],
)
def test_autocast_takes_no_digits(function):
    """Rotations failed, as no determinant takes half precision; others lost what their products rounded."""
    matrix = normal(2, 5, 5, dtype=torch.float32).requires_grad_()
    with torch.autocast("cpu", torch.bfloat16):
        found = function(matrix)
        assert procrustes(matrix, matrix)[0].isfinite().all()
    plain = function(matrix)
    assert torch.equal(found, plain)
    if plain.requires_grad:
        assert_close(*(torch.autograd.grad(x.square().sum(), matrix)[0] for x in (found, plain)))


@pytest.mark.parametrize("dtype", HALVES)
def test_scatter_in_half_precision(dtype):
    values = normal(6, 4, dtype=dtype)
    (grad,) = finite(lambda x: scatter_log_det(x, 0.5), values)
    found = scatter_log_det(values, 0.5)
    assert found.dtype == grad.dtype == dtype
    assert_close(found.double(), scatter_log_det(values.double(), 0.5), rtol=1e-2, atol=0)


def test_psd_shrink_refuses_what_is_not_square():
    with pytest.raises(ShapeError, match="square"):
        psd_shrink(normal(4, 5), 1.0)


def test_matrices_without_rows_or_columns():
    for shape in [(0, 3), (3, 0)]:
        assert svt(torch.zeros(shape), 1.0).shape == shape
        assert nuclear_norm(torch.zeros(shape)) == 0


# ---------------------------------------------------------------------- cosines


@pytest.mark.parametrize("length", [1, 2, 7, 30])
def test_dct_basis_is_that_of_scipy(length):
    expected = scipy.fft.dct(torch.eye(length).double().numpy(), norm="ortho", axis=0)  # row k: cosine k
    assert_close(dct_basis(length, length, dtype=torch.float64), torch.from_numpy(expected).mT)
    assert dct_basis(length, 1).dtype == torch.get_default_dtype()


@pytest.mark.parametrize("count", [0, 6])
def test_dct_basis_out_of_range(count):
    with pytest.raises(ShapeError, match=r"1\.\.5"):
        dct_basis(5, count)


def test_a_threshold_below_zero_counts_as_zero():
    matrix = normal(2, 5, 3)
    assert_close(svt(matrix, torch.tensor([-1.0, 0.0])), matrix)
