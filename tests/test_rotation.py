"""Rotations: against roma and matrix exponentials, there and back, and derivatives at no turn and at half turns."""

import itertools
import math

import pytest
import roma
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from numerics import DEVICES, FLOATS, finite, gradcheck, leaves_arguments_alone, normal, same_as_loop
from torch.testing import assert_close

from kcs_torch.errors import OptionError
from kcs_torch.functional import euler_angles, euler_rotation, rotation_angle, rotation_matrix, rotation_vector
from kcs_torch.functional.rotation import running_products

EYE = torch.eye(3, dtype=torch.float64)
ORDERS = ["".join(order) for order in itertools.permutations("XYZ")]
SIZES = [0.0, 1e-300, 1e-12, 1e-7, 1e-3, 1.0, math.pi - 1e-7, math.pi, 10.0]


def random_rotations(count=40):
    return roma.random_rotmat(count, dtype=torch.float64)


@pytest.mark.parametrize("size", SIZES)
def test_matrix_is_the_exponential(size):
    vectors = size * torch.nn.functional.normalize(normal(20, 3), dim=-1)
    x, y, z = vectors.unbind(-1)
    o = torch.zeros_like(x)
    cross = torch.stack([o, -z, y, z, o, -x, -y, x, o], -1).unflatten(-1, (3, 3))
    made = rotation_matrix(vectors)
    assert_close(made, torch.linalg.matrix_exp(cross), rtol=0, atol=1e-13)
    assert_close(made, roma.rotvec_to_rotmat(vectors), rtol=0, atol=1e-12)
    assert_close(made @ made.mT, EYE.expand(20, 3, 3), rtol=0, atol=1e-14)


@pytest.mark.parametrize("size", [s for s in SIZES if s < math.pi])
def test_vector_undoes_the_matrix(size):
    vectors = size * torch.nn.functional.normalize(normal(20, 3), dim=-1)
    assert_close(rotation_vector(rotation_matrix(vectors)), vectors, rtol=1e-8 if size > 3 else 1e-12, atol=1e-300)


@pytest.mark.parametrize("frames", [1, 2, 7, 16])
def test_running_products(frames):
    turns = random_rotations(2 * frames).view(2, frames, 3, 3)
    expected = list(itertools.accumulate(turns.unbind(1), lambda made, turn: turn @ made))
    assert_close(running_products(turns), torch.stack(expected, 1))


def test_vector_is_that_of_roma_and_the_shorter_way():
    matrices = random_rotations()
    assert_close(rotation_vector(matrices), roma.rotmat_to_rotvec(matrices))
    long = normal(40, 3) * 4
    found = rotation_vector(rotation_matrix(long))
    assert (found.norm(dim=-1) <= math.pi + 1e-12).all()
    assert_close(rotation_matrix(found), rotation_matrix(long))


def test_half_turns_have_a_vector():
    axes = torch.cat([EYE, torch.nn.functional.normalize(normal(20, 3), dim=-1)])
    half = 2 * axes[:, :, None] * axes[:, None] - EYE
    found = rotation_vector(half)
    assert_close(found.norm(dim=-1), torch.full((23,), math.pi, dtype=torch.float64))
    assert_close(rotation_matrix(found), half)
    (grad,) = finite(rotation_vector, half)
    assert grad.any()


@given(st.integers(0, 10**6), st.floats(-320, 3), st.sampled_from([torch.float32, torch.float64]))
@settings(max_examples=60, deadline=None)
def test_nothing_is_nan_at_any_angle(seed, power, dtype):
    vectors = (normal(5, 3, seed=seed) * 10.0**power).to(dtype)
    finite(rotation_matrix, vectors)
    matrices = rotation_matrix(vectors)
    finite(rotation_vector, matrices)
    finite(lambda x: euler_angles("ZXY", x), matrices)
    assert torch.isfinite(rotation_angle(matrices, matrices.flip(0))).all()


def test_gradients():
    vectors = torch.cat([normal(4, 3), 1e-3 * normal(2, 3), torch.zeros(1, 3).double()])
    assert gradcheck(rotation_matrix, vectors)
    matrices = rotation_matrix(vectors)
    assert gradcheck(rotation_vector, matrices)
    assert gradcheck(rotation_angle, matrices[:3], matrices[3:6])
    assert gradcheck(lambda a: euler_rotation("ZXY", a), vectors)
    assert gradcheck(lambda m: euler_angles("YZX", m), random_rotations(4))


@pytest.mark.parametrize("size", [0.0, 1e-9, 1e-3, 3.1e-3, 3.2e-3, 1.0, math.pi])
def test_second_derivatives(size):
    """At 0 they were NaN; on either side of where the series ends they are the same."""
    vectors = size * torch.nn.functional.normalize(normal(3, 3), dim=-1)
    assert torch.autograd.gradgradcheck(rotation_matrix, vectors.requires_grad_())
    assert torch.autograd.gradgradcheck(lambda a: euler_rotation("ZXY", a), vectors)


@pytest.mark.parametrize("dtype", FLOATS)
def test_second_derivatives_by_hand(dtype):
    hessian = torch.autograd.functional.hessian
    for size in (0.0, 1e-6, 1e-3):
        found = hessian(lambda v: rotation_matrix(v)[1, 1], torch.tensor([0, size, 0], dtype=dtype))
        assert_close(found, torch.diag(torch.tensor([-1.0, 0, -1])).to(dtype), rtol=0, atol=1e-6)
    for angle in (0.0, 1e-6, 3e-3, 0.5):
        found = hessian(lambda a: euler_rotation("X", a)[1, 1], torch.tensor([angle], dtype=dtype))
        assert found.item() == pytest.approx(-math.cos(angle), abs=1e-6)


def test_a_turn_and_its_vector_have_derivatives_that_undo_each_other_at_rest():
    there_and_back = lambda v: rotation_vector(rotation_matrix(v))  # noqa: E731
    for vector in (torch.zeros(3).double(), 1e-9 * normal(3), normal(3)):
        assert_close(torch.autograd.functional.jacobian(there_and_back, vector), EYE, rtol=0, atol=1e-7)


def test_angle_is_the_length_of_the_vector_between():
    first, second = random_rotations(), random_rotations()
    expected = rotation_vector(first.mT @ second).norm(dim=-1)
    assert_close(rotation_angle(first, second), expected, rtol=1e-6, atol=1e-6)
    assert_close(rotation_angle(first, second), roma.rotmat_geodesic_distance(first, second))
    assert rotation_angle(first, first).max() == 0
    assert_close(rotation_angle(EYE, torch.diag(torch.tensor([1.0, -1, -1])).double()).item(), math.pi)


def test_angle_is_exact_and_has_a_slope_up_to_a_half_turn():
    """The arcsine of a number near 1 knows half of its digits, and had no finite derivative at 1."""
    axes, first = torch.nn.functional.normalize(normal(20, 3), dim=-1), random_rotations(20)
    for angle in (0.0, 1e-9, 1.0, 1.69, 1.7, 3.0, math.pi - 1e-5, math.pi - 1e-9, math.pi):
        leaf = (angle * axes).requires_grad_()
        found = rotation_angle(first, first @ rotation_matrix(leaf))
        assert_close(found, torch.full_like(found, angle), rtol=0, atol=1e-14)
        (slope,) = torch.autograd.grad(found.sum(), leaf)
        if 1e-6 < angle < math.pi - 1e-6:
            assert_close(slope, axes, rtol=0, atol=1e-9)
        assert (slope.norm(dim=-1) < 1.5).all()
    for half in (EYE, torch.diag(torch.tensor([1.0, -1, -1])).double()):
        (slope,) = finite(rotation_angle, EYE.clone(), half)[:1]
        assert not slope.any()


@pytest.mark.parametrize("order", ORDERS)
def test_euler_angles_are_those_of_roma(order):
    angles = 3 * normal(40, 3)
    made = euler_rotation(order, angles)
    assert_close(made, roma.euler_to_rotmat(order, angles))
    assert_close(euler_rotation(order, euler_angles(order, made)), made)
    matrices = random_rotations()
    assert_close(euler_angles(order, matrices), roma.rotmat_to_euler(order, matrices), rtol=0, atol=1e-9)


@pytest.mark.parametrize("order", ORDERS)
@pytest.mark.parametrize("sign", [1, -1])
def test_locked_axes_have_angles_all_the_same(order, sign):
    angles = torch.tensor([0.4, sign * math.pi / 2, 0.9]).double()
    made = euler_rotation(order, angles)
    found = euler_angles(order, made)
    assert found[2] == 0
    assert_close(euler_rotation(order, found), made)


def test_turns_are_about_axes_that_earlier_ones_have_moved():
    angles = normal(3)
    x, y, z = (rotation_matrix(angle * axis) for angle, axis in zip(angles, EYE, strict=True))
    assert_close(euler_rotation("XYZ", angles), x @ y @ z)
    assert_close(euler_rotation("Z", angles[2:]), z)


@pytest.mark.parametrize("order", ["xyz", "XYA"])
def test_other_axes_are_refused(order):
    with pytest.raises(OptionError, match="X, Y and Z"):
        euler_rotation(order, torch.zeros(3))
    with pytest.raises(OptionError, match="X, Y and Z"):
        euler_angles(order, torch.eye(3))
    with pytest.raises(OptionError, match="in some order"):
        euler_angles("XYX", torch.eye(3))


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("dtype", FLOATS)
def test_batches_dtypes_and_devices(dtype, device):
    vectors = normal(2, 3, 3, dtype=dtype, device=device)
    matrices = leaves_arguments_alone(rotation_matrix, vectors)
    for made in (matrices, leaves_arguments_alone(rotation_vector, matrices)):
        assert made.dtype == dtype and made.device.type == device and made.shape[:2] == (2, 3)
    same_as_loop(rotation_matrix, (3,))
    same_as_loop(rotation_vector, (3,), make=lambda v: (rotation_matrix(v),))
    same_as_loop(lambda a: euler_rotation("XZ", a), (2,))
    assert rotation_matrix(vectors[:0]).shape == (0, 3, 3, 3) and rotation_vector(matrices[:0]).shape == (0, 3, 3)


@pytest.mark.parametrize("order", ORDERS)
@pytest.mark.parametrize("quarter", [-math.pi / 2, math.pi / 2])
def test_euler_angles_have_a_derivative_in_gimbal_lock(order, quarter):
    """It was NaN: of a length and of angles of what is 0."""
    matrices = euler_rotation(order, torch.tensor([[0.3, quarter, 0.2], [0.3, 0.5, 0.2]], dtype=torch.float64))
    angles = euler_angles(order, matrices.requires_grad_())
    assert_close(euler_rotation(order, angles), matrices)
    (grad,) = torch.autograd.grad(angles.sum(), matrices)
    assert grad.isfinite().all() and grad[0].any()
