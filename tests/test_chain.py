"""Bones: incidence, its inverse, lengths, and the KCS matrix."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from numerics import (
    BODY,
    DEVICES,
    FLOATS,
    HALVES,
    RING,
    finite,
    gradcheck,
    leaves_arguments_alone,
    normal,
    rotations,
    same_as_loop,
)
from torch.testing import assert_close

from kcs_torch.errors import ShapeError
from kcs_torch.functional import (
    bone_lengths,
    bone_vectors,
    chain_inverse,
    incidence,
    kcs_matrix,
    points_from_bones,
    pose_matrix,
)
from kcs_torch.functional.guarded import safe_norm, safe_root

BONES = BODY.bone_index()


@st.composite
def trees(draw):
    """Bones of a random tree: each joint but the first is tied to an earlier one; either may come first."""
    count = draw(st.integers(2, 12))
    parents = [draw(st.integers(0, n - 1)) for n in range(1, count)]
    return [(p, n) if draw(st.booleans()) else (n, p) for n, p in enumerate(parents, 1)]


def test_incidence_is_bone_vectors():
    points = normal(7, 3)
    matrix = incidence(BONES, 7, dtype=torch.float64)
    assert_close(matrix.mT @ points, bone_vectors(points, BONES))
    assert_close(matrix, incidence(BODY.bones, 7, dtype=torch.float64))
    assert torch.equal(matrix.sum(0), torch.zeros(6))


def test_bone_vectors_and_incidence_are_adjoint():
    points, vectors = normal(4, 7, 3), normal(4, 6, 3, seed=1)
    back = incidence(BONES, 7, dtype=torch.float64) @ vectors
    assert_close((bone_vectors(points, BONES) * vectors).sum(), (points * back).sum())


def test_incidence_takes_the_default_dtype_and_no_bones():
    assert incidence([(0, 1)], 2).dtype == torch.get_default_dtype()
    empty = incidence([], 3, dtype=torch.float64)
    assert empty.shape == (3, 0)
    assert chain_inverse(empty).shape == (3, 0)
    assert bone_lengths(normal(5, 3, 3), []).shape == (5, 0)


@pytest.mark.parametrize(
    "bones",
    [[(0, 1, 2), (1, 2, 0)], [(0, 1), (1,)], torch.zeros(2, 3, dtype=torch.long), torch.zeros(4, dtype=torch.long)],
)
def test_bones_that_are_not_pairs(bones):
    with pytest.raises(ShapeError, match=r"parent, child"):
        incidence(bones, 3)
    with pytest.raises(ShapeError, match=r"parent, child"):
        bone_vectors(normal(3, 3), bones)


@pytest.mark.parametrize("bones", [[(0, 3)], [(-1, 0)]])
def test_bones_out_of_range(bones):
    with pytest.raises(ShapeError, match=r"0\.\.2"):
        incidence(bones, 3)


@given(trees())
@settings(max_examples=30, deadline=None)
def test_chain_inverse_of_a_tree_is_exact(bones):
    count = len(bones) + 1
    points = normal(count, 3, seed=count)
    inverse = chain_inverse(incidence(bones, count, dtype=torch.float64))
    assert_close(points_from_bones(bone_vectors(points, bones), inverse), points - points.mean(0))
    vectors = normal(len(bones), 3, seed=1)  # any bones make a pose of a tree
    assert_close(bone_vectors(points_from_bones(vectors, inverse), bones), vectors)


def test_chain_inverse_of_a_closed_chain_is_least_squares():
    matrix = incidence(RING.bone_index(), 4, dtype=torch.float64)
    inverse = chain_inverse(matrix)
    points = normal(4, 3)
    assert_close(points_from_bones(bone_vectors(points, RING.bones), inverse), points - points.mean(0))
    vectors = normal(4, 3, seed=2)  # these do not close
    expected = np.linalg.lstsq(matrix.mT.numpy(), vectors.numpy(), rcond=None)[0]
    assert_close(points_from_bones(vectors, inverse), torch.from_numpy(expected))
    assert not torch.allclose(bone_vectors(points_from_bones(vectors, inverse), RING.bones), vectors)


def test_chain_inverse_centres_each_piece():
    bones = [(0, 1), (1, 2), (3, 4)]  # joint 5 is loose
    points = normal(6, 3)
    back = points_from_bones(bone_vectors(points, bones), chain_inverse(incidence(bones, 6, dtype=torch.float64)))
    expected = torch.cat([points[:3] - points[:3].mean(0), points[3:5] - points[3:5].mean(0), torch.zeros(1, 3)])
    assert_close(back, expected)


def test_bone_lengths_are_norms():
    points = normal(5, 7, 3)
    assert_close(bone_lengths(points, BONES), torch.linalg.vector_norm(bone_vectors(points, BONES), dim=-1))


def test_bone_lengths_gradient():
    assert gradcheck(lambda x: bone_lengths(x, BONES), normal(2, 7, 3))
    points = normal(3, 7, 3).requires_grad_()
    assert torch.autograd.gradgradcheck(lambda x: bone_lengths(x, BONES), points, fast_mode=True)


@pytest.mark.parametrize("dtype", FLOATS)
def test_zero_length_bone_has_no_gradient(dtype):
    points = normal(7, 3, dtype=dtype)
    points[2] = points[1]  # neck and head coincide
    (grad,) = finite(lambda x: bone_lengths(x, BONES)[1], points)
    assert torch.equal(grad, torch.zeros_like(grad))
    finite(lambda x: bone_lengths(x, BONES), torch.zeros_like(points))


@given(st.floats(-30, 30), st.floats(-30, 30))
@settings(max_examples=40, deadline=None)
def test_safe_norm_at_any_scale(one, two):
    vectors = torch.tensor([[3.0, 4.0, 0.0], [0.0, 0.0, 0.0], [1.0, 2.0, 2.0]])
    scale = torch.tensor([10.0**one, 1.0, 10.0**two])
    assert_close(safe_norm(vectors * scale[:, None]), torch.tensor([5.0, 0.0, 3.0]) * scale)
    finite(safe_norm, vectors * scale[:, None])


def test_safe_root_of_nothing_is_0_and_of_nan_nan():
    squares = torch.tensor([-1e-12, 0.0, 0.25, 4.0, torch.nan], requires_grad=True)
    root = safe_root(squares)
    assert root[:4].tolist() == [0, 0, 0.5, 2] and root[4].isnan()
    (grad,) = torch.autograd.grad(root[:4].sum(), squares)
    assert grad[:4].tolist() == [0, 0, 1, 0.25]


def test_kcs_matrix_is_free_of_rotation_reflection_and_translation():
    points = normal(4, 7, 3)
    psi = kcs_matrix(bone_vectors(points, BONES))
    turn = rotations(4, seed=3)
    moved = points @ turn + normal(4, 1, 3, seed=4)
    assert_close(kcs_matrix(bone_vectors(moved, BONES)), psi)
    assert_close(kcs_matrix(bone_vectors(points * torch.tensor([1.0, 1.0, -1.0]), BONES)), psi)
    assert_close(psi.diagonal(dim1=-2, dim2=-1).sqrt(), bone_lengths(points, BONES))
    assert_close(psi, psi.mT)
    eigenvalues = torch.linalg.eigvalsh(psi)
    assert (eigenvalues[..., :3].abs() < 1e-12).all() and (eigenvalues[..., 3:] > 1e-6).all()  # rank 3


@pytest.mark.parametrize("shape", [(7, 3), (4, 7, 3), (2, 4, 7, 3), (4, 7, 2), (0, 7, 3)])
def test_matrix_of_points_is_that_of_their_bones(shape):
    points = normal(*shape)
    assert_close(pose_matrix(points, BONES), kcs_matrix(bone_vectors(points, BONES)))
    assert_close(pose_matrix(points, BODY.bones), pose_matrix(points, BONES))
    assert gradcheck(lambda x: pose_matrix(x, BONES), points)
    assert torch.autograd.gradgradcheck(lambda x: pose_matrix(x, BONES), points.requires_grad_())


def test_matrix_of_points_is_exact_far_from_the_origin_and_keeps_nan_to_its_bones():
    points = normal(3, 7, 3, dtype=torch.float32).mul(64).round() / 64  # so that sums with 4096 are exact
    assert torch.equal(pose_matrix(points + 4096, BONES), pose_matrix(points, BONES))
    points[1, 5] = torch.nan
    spoilt = torch.isnan(pose_matrix(points, BONES))
    one = (BONES == 5).any(-1)
    assert torch.equal(spoilt[1], one[:, None] | one[None]) and not spoilt[[0, 2]].any()
    assert_close(torch.vmap(lambda x: pose_matrix(x, BONES))(points[::2]), pose_matrix(points[::2], BONES))


def test_batches_equal_loops():
    same_as_loop(lambda x: pose_matrix(x, BONES), (7, 3))
    same_as_loop(lambda x: bone_vectors(x, BONES), (7, 3))
    same_as_loop(lambda x: bone_lengths(x, BONES), (7, 2))
    same_as_loop(kcs_matrix, (6, 3))
    inverse = chain_inverse(incidence(BONES, 7, dtype=torch.float64))
    same_as_loop(lambda v: points_from_bones(v, inverse), (6, 3))


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("dtype", FLOATS + HALVES)
def test_results_follow_dtype_and_device(dtype, device):
    points = normal(2, 7, 3, dtype=dtype, device=device)
    values = [
        leaves_arguments_alone(lambda x: bone_vectors(x, BONES), points),
        leaves_arguments_alone(lambda x: bone_lengths(x, BODY.bones), points),
        leaves_arguments_alone(kcs_matrix, points),
        leaves_arguments_alone(lambda x: pose_matrix(x, BONES), points),
        incidence(BONES.to(device), 7, dtype=dtype),
    ]
    assert {(v.dtype, v.device.type) for v in values} == {(dtype, device)}


@pytest.mark.parametrize("call", [bone_vectors, bone_lengths, pose_matrix])
def test_bones_of_a_list_are_pairs_of_the_points_joints(call):
    """Fractions were cut off to whole numbers; other joints ended in "index out of range in self"."""
    points = torch.rand(4, 5, 3)
    for wrong in ([(0, 5)], [(-1, 2)]):
        with pytest.raises(ShapeError, match=r"bones: expected joint indices 0..4, got \("):
            call(points, wrong)
    for wrong in ([(0.5, 1)], [("a", "b")], [(0, 1, 2)]):
        with pytest.raises(
            ShapeError, match=r"bones: expected shape \(B, 2\) of indices \(parent, child\), got a row \("
        ):
            call(points, wrong)
    assert torch.equal(call(points, np.array([[0, 4]])), call(points, [(0, 4)]))


def test_points_from_bones_that_do_not_fit():
    with pytest.raises(ShapeError, match="points_from_bones: inverse: expected shape"):
        points_from_bones(torch.randn(4, 3), torch.randn(5, 6))
