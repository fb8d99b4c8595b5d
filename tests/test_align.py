"""Procrustes alignment: against scipy, by optimality, and in degenerate cases."""

import pytest
import torch
from numerics import DEVICES, FLOATS, HALVES, leaves_arguments_alone, normal, rotations, same_as_loop
from scipy.spatial.transform import Rotation
from torch.testing import assert_close

from kcs_torch.errors import OptionError, ShapeError
from kcs_torch.functional import (
    centre,
    distance_spread,
    minimal_turn,
    nearest_rotation,
    pinhole_translation,
    procrustes,
    superpose,
)
from kcs_torch.metrics import ALIGNMENTS

MIRROR = torch.diag(torch.tensor([1.0, 1.0, -1.0], dtype=torch.float64))


def centred(*shape, seed=0):
    return centre(normal(*shape, seed=seed))[0]


def test_centre():
    points, weights = normal(4, 6, 3), normal(4, 6, seed=1).abs()
    moved, mean = centre(points, weights)
    assert_close((moved * weights[..., None]).sum(-2), torch.zeros(4, 3).double())
    assert_close(moved + mean, points)
    assert_close(centre(points)[1], points.mean(-2, keepdim=True))
    assert_close(centre(points, torch.ones(4, 6).double())[0], centre(points)[0])


def test_centre_ignores_what_has_no_weight():
    points, weights = normal(6, 2), torch.tensor([1.0, 1, 0, 1, 1, 0], dtype=torch.float64)
    other = points.clone()
    other[2], other[5] = 1e6, -3.0
    assert_close(centre(other, weights)[1], centre(points, weights)[1])
    moved, mean = centre(points, torch.zeros(6).double())
    assert torch.equal(moved, points) and torch.equal(mean, torch.zeros(1, 2))


def test_weights_below_zero_count_as_zero():
    points, other, weights = normal(4, 6, 3), normal(4, 6, 3, seed=1), torch.tensor([1.0, 2, 0, 1, 1, 0]).double()
    less = weights - (weights == 0).double()
    for function in (
        lambda w: centre(points, w),
        lambda w: procrustes(points, other, w),
        *(lambda w, how=how: superpose(points, other, how, w.expand(4, 6)) for how in ALIGNMENTS),
        lambda w: distance_spread(points, w.expand(4, 6)),
        lambda w: pinhole_translation(points, other[..., :2], w),
    ):
        assert_close(function(less), function(weights))


@pytest.mark.parametrize("dtype", FLOATS)
def test_minimal_turn_is_a_rotation_however_nearly_opposite(dtype):
    """Below 1e-12 the middle between both was not brought to length 1: reflections came out."""
    source = normal(20, 3, dtype=dtype)
    for power in range(3, 22):
        target = -source + 10.0**-power * normal(20, 3, seed=power, dtype=dtype)
        turn = minimal_turn(source, target)
        assert_close(turn @ turn.mT, torch.eye(3, dtype=dtype).expand(20, 3, 3), atol=2e-6, rtol=0)
        assert_close(torch.linalg.det(turn), torch.ones(20, dtype=dtype), atol=2e-6, rtol=0)
        unit = [x / x.norm(dim=-1, keepdim=True) for x in (source, target)]
        assert_close((turn @ unit[0][..., None])[..., 0], unit[1], atol=40 * torch.finfo(dtype).eps, rtol=0)


def test_minimal_turn_has_derivatives_under_vmap():
    source, target = normal(4, 3), normal(4, 3, seed=1)
    slope = torch.func.grad(lambda a, b: minimal_turn(a, b).square()[0].sum())
    each = torch.stack([slope(*pair) for pair in zip(source, target, strict=True)])
    assert_close(torch.func.vmap(slope)(source, target), each)


def test_superpose_tells_of_a_root_that_is_none():
    with pytest.raises(OptionError, match="root: expected a joint index below 5, got 5"):
        superpose(normal(4, 5, 3), normal(4, 5, 3), "root", root=5)


@pytest.mark.parametrize("reflect", [False, True])
def test_nearest_rotation_maximises_the_trace(reflect):
    matrix = normal(4, 3, 3)
    best = nearest_rotation(matrix, reflect=reflect)
    assert_close(best @ best.mT, torch.eye(3).double().expand(4, 3, 3))
    others = rotations(1000, seed=1)[:, None]
    if reflect:
        others = torch.cat([others, others @ MIRROR])
    else:
        assert_close(torch.linalg.det(best), torch.ones(4).double())
    assert ((others * matrix).sum((-2, -1)) <= (best * matrix).sum((-2, -1))).all()


def test_nearest_rotation_of_degenerate_matrices():
    row = normal(3)
    for matrix in (torch.zeros(3, 3).double(), torch.outer(row, row), -torch.eye(3).double(), MIRROR):
        found = nearest_rotation(matrix)
        assert_close(found @ found.mT, torch.eye(3).double())
        assert_close(torch.linalg.det(found), torch.ones(()).double())


def test_procrustes_finds_rotation_and_scale():
    source, turn = centred(5, 7, 3), rotations(5)
    found, scale = procrustes(source, 2.5 * source @ turn)
    assert_close(found, turn)
    assert_close(scale, torch.full((5,), 2.5).double())


def test_procrustes_is_that_of_scipy():
    source, target, weights = centred(7, 3), centred(7, 3, seed=1), normal(7, seed=2).abs()
    found, scale = procrustes(source, target, weights)
    expected, _ = Rotation.align_vectors(target.numpy(), source.numpy(), weights=weights.numpy())
    assert_close(found.mT, torch.from_numpy(expected.as_matrix()))
    cost = lambda s: (weights[:, None] * (s * source @ found - target).square()).sum()  # noqa: E731
    assert cost(scale) < min(cost(1.01 * scale), cost(0.99 * scale))


def test_procrustes_admits_reflections_on_request():
    source = centred(7, 3)
    target = source @ MIRROR
    assert_close(procrustes(source, target, reflect=True)[0], MIRROR)
    assert torch.linalg.det(procrustes(source, target)[0]) > 0


def test_procrustes_leaves_out_what_has_no_weight():
    source, turn = centred(7, 3), rotations()
    weights = torch.tensor([1.0, 1, 1, 1, 1, 1, 0], dtype=torch.float64)
    target = source @ turn
    target[6] += 50
    assert_close(procrustes(source, target, weights)[0], turn)


def test_procrustes_of_nothing():
    nothing = torch.zeros(7, 3).double()
    turn, scale = procrustes(nothing, centred(7, 3))
    assert_close(turn @ turn.mT, torch.eye(3).double())
    assert scale == 0


def test_procrustes_refuses_different_shapes():
    with pytest.raises(ShapeError, match=r"\(7, 3\) and \(6, 3\)"):
        procrustes(normal(7, 3), normal(6, 3))


@pytest.mark.parametrize("how", ["similarity", "sequence"])
def test_similarity_undoes_a_similarity(how):
    target = normal(5, 7, 3)
    turn = rotations() if how == "sequence" else rotations(5)
    source = 0.3 * target @ turn + normal(5, 1, 3, seed=3)
    assert_close(superpose(source, target, how), target)


def test_similarity_of_a_sequence_has_one_rotation_and_one_scale():
    target = normal(5, 7, 3)
    source = target @ rotations(5)  # another rotation in each frame
    assert_close(superpose(source, target, "similarity"), target)
    assert not torch.allclose(superpose(source, target, "sequence"), target, atol=0.1)


def test_similarity_keeps_the_size_on_request():
    target = normal(5, 7, 3)
    moved = superpose(2 * target, target, "rigid")
    assert_close(moved - moved.mean(-2, keepdim=True), 2 * (target - target.mean(-2, keepdim=True)))
    assert_close(moved.mean(-2), target.mean(-2))


def test_similarity_is_optimal():
    source, target = normal(1, 7, 3), normal(1, 7, 3, seed=1)
    best = (superpose(source, target, "similarity") - target).square().sum()
    for k in range(100):
        other = (1 + 0.1 * normal(seed=k)) * source @ rotations(seed=k) + normal(1, 1, 3, seed=k)
        assert (other - target).square().sum() >= best


def test_batches_equal_loops():
    same_as_loop(centre, (7, 3))
    same_as_loop(lambda x, w: centre(x, w.abs()), (7, 3), (7,))
    same_as_loop(nearest_rotation, (3, 3))
    same_as_loop(procrustes, (7, 3), (7, 3))
    for how in ALIGNMENTS:
        same_as_loop(lambda a, b, how=how: superpose(a, b, how), (4, 7, 3), (4, 7, 3))


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("dtype", FLOATS)
def test_results_follow_dtype_and_device(dtype, device):
    a, b = (normal(4, 7, 3, seed=s, dtype=dtype, device=device) for s in (0, 1))
    values = [
        *leaves_arguments_alone(centre, a),
        *leaves_arguments_alone(procrustes, a, b),
        leaves_arguments_alone(lambda a, b: superpose(a, b, "similarity"), a, b),
    ]
    assert {(v.dtype, v.device.type) for v in values} == {(dtype, device)}


@pytest.mark.parametrize("dtype", HALVES)
def test_half_precision(dtype):
    source, turn = centred(8, 3), rotations(seed=1)
    found, scale = procrustes(source.to(dtype), (2 * source @ turn).to(dtype))
    assert found.dtype == scale.dtype == dtype
    assert_close(found.double(), turn, rtol=0, atol=0.02)
    moved = superpose(source[None].to(dtype), 3 * source[None].to(dtype), "similarity")
    assert_close(moved.double(), 3 * source[None], rtol=0, atol=0.1)


def test_random_rotations_are_rotations():
    """The test's own tool."""
    turn = rotations(10)
    assert_close(turn @ turn.mT, torch.eye(3).double().expand(10, 3, 3))
    assert_close(torch.linalg.det(turn), torch.ones(10).double())


@pytest.mark.parametrize("kind", HALVES)
def test_half_precision_of_large_points(kind):
    """Sums of pixels or millimetres leave the range of half precision, and so do their squares."""
    points, weights = (torch.full((1, 17, 3), 4000.0)).to(kind), torch.ones(1, 17).to(kind)
    assert centre(points, weights)[1].unique().tolist() == [4000.0]
    body = (300 * normal(5, 17, 3)).to(kind)
    turned = (body.double() @ rotations(5)).to(kind)
    for how in ALIGNMENTS:
        moved = superpose(body, turned, how)
        assert moved.dtype == kind and moved.isfinite().all()
    moved = superpose(body, turned, "similarity")
    assert (moved.double() - turned.double()).norm(dim=-1).mean() < 8 * torch.finfo(kind).eps * 300
    rotation, scale = procrustes(centre(body)[0], centre(turned)[0])
    assert rotation.dtype == scale.dtype == kind and (scale - 1).abs().max() < 8 * torch.finfo(kind).eps


def test_minimal_turn_of_short_vectors():
    quarter = minimal_turn(torch.tensor([1.0, 0, 0]), torch.tensor([0.0, 1, 0]))
    for size in (1e-13, 1e-30, 1e20):
        assert_close(minimal_turn(torch.tensor([size, 0, 0]), torch.tensor([0.0, size, 0])), quarter)
