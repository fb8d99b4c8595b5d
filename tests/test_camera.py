"""Weak-perspective cameras: adjointness, factorisation, the nearest camera, and how far a viewpoint turns."""

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from numerics import (
    DEVICES,
    FLOATS,
    finite,
    gradcheck,
    leaves_arguments_alone,
    normal,
    rotations,
    same_as_loop,
    turning,
)
from torch.testing import assert_close

from kcs_torch.errors import NotFiniteError, ShapeError
from kcs_torch.functional import (
    back_project,
    complete_rotation,
    factorize,
    nearest_rotation,
    orthonormality_defect,
    perspective,
    project,
    rows_to_cameras,
    viewpoint_turn,
)


def test_back_projection_is_the_adjoint_of_projection():
    points, tracks, cameras = normal(2, 5, 7, 3), normal(2, 5, 7, 2, seed=1), normal(2, 5, 2, 3, seed=2)
    assert_close((project(points, cameras) * tracks).sum(), (points * back_project(tracks, cameras)).sum())
    assert gradcheck(project, points[0], cameras[0], fast=True)


def test_projection_undoes_back_projection_by_orthonormal_rows():
    tracks, cameras = normal(5, 7, 2), rotations(5)[:, :2]
    assert_close(project(back_project(tracks, cameras), cameras), tracks)


def test_complete_rotation():
    turn = rotations(6)
    assert_close(complete_rotation(turn[:, :2]), turn)


@pytest.mark.parametrize(("frames", "joints"), [(3, 12), (8, 5), (4, 8)])
@pytest.mark.parametrize("rank", [1, 3, 5])
def test_factorize_is_the_best_of_its_rank(frames, joints, rank):
    tracks = normal(frames, joints, 2)
    motion, shape = factorize(tracks, rank)
    assert motion.shape == (frames, 2, rank) and shape.shape == (rank, joints)
    assert_close(shape @ shape.mT, torch.eye(rank, dtype=torch.float64))
    stacked = tracks.mT.flatten(0, 1)
    u, s, vt = torch.linalg.svd(stacked, full_matrices=False)
    assert_close(motion.flatten(0, 1) @ shape, (u[:, :rank] * s[:rank]) @ vt[:rank])
    assert_close(motion.flatten(0, 1).norm(dim=0), s[:rank])


def test_factorize_keeps_small_singular_values_in_single_precision():
    """The squares of those below 3e-4 of the largest are lost to its rounding."""
    left, right = (torch.linalg.qr(normal(size, 9, seed=seed))[0] for seed, size in enumerate((200, 17)))
    stacked = (left * torch.logspace(0, -4, 9, dtype=torch.float64)) @ right.mT
    tracks = stacked.view(100, 2, 17).mT.float()
    motion, shape = factorize(tracks, 9)
    assert motion.dtype == shape.dtype == torch.float32
    assert ((motion @ shape).mT - tracks).norm() < 1e-6 * tracks.norm()


def test_perspective_of_half_precision_stays_in_range():
    point, lens = torch.tensor([100.0, 200, 5000]), torch.tensor([1500.0, 1500, 960, 540])
    assert_close(perspective(point.half(), lens.half()).float(), perspective(point, lens), rtol=1e-3, atol=0)


@pytest.mark.parametrize("rank", [0, 6])
def test_factorize_refuses_ranks_out_of_range(rank):
    with pytest.raises(ShapeError, match=r"1\.\.5"):
        factorize(normal(4, 5, 2), rank)


def test_orthonormality_defect_is_zero_for_cameras_of_any_scale_only():
    cameras = rotations(6)[:, :2]
    scale = torch.linspace(0.1, 3, 6)[:, None, None]
    assert_close(orthonormality_defect(scale * cameras), torch.zeros(6).double())
    longer = cameras * torch.tensor([[1.0], [1.5]])
    assert_close(orthonormality_defect(longer), torch.full((6,), ((1 - 1.5**2) / 2) ** 2).double())
    skew = torch.stack([cameras[:, 0], cameras[:, 1] + 0.5 * cameras[:, 0]], 1)
    assert (orthonormality_defect(skew) > 0.2).all()
    roll = rotations()[:2, :2]  # any mixing of the rows by a rotation leaves it alone
    roll = torch.linalg.qr(roll)[0]
    assert_close(orthonormality_defect(roll @ skew), orthonormality_defect(skew))
    assert gradcheck(orthonormality_defect, skew)


def test_rows_to_cameras_takes_scaled_cameras_apart():
    cameras, scales = rotations(6)[:, :2], torch.linspace(0.1, 4, 6).double()
    found, size = rows_to_cameras(scales[:, None, None] * cameras)
    assert_close(found, cameras)
    assert_close(size, scales)


def test_rows_to_cameras_finds_the_nearest():
    rows = normal(5, 2, 3)
    found, scales = rows_to_cameras(rows)
    best = (rows - scales[:, None, None] * found).square().sum((-2, -1))
    others = rotations(500, seed=1)[:, None, :2]
    size = (rows * others).sum((-2, -1), keepdim=True) / 2
    assert ((rows - size * others).square().sum((-2, -1)) >= best).all()
    assert (scales >= 0).all()


@pytest.mark.parametrize("apart", [1.0, 1e-3, 1e-5])
def test_rows_to_cameras_is_the_polar_factor(apart):
    """By singular values, for rows that are nearly parallel, too."""
    a, b = normal(50, 3), normal(50, 3, seed=1)
    rows = torch.stack([a, normal(50, 1, seed=2) * a + apart * b], 1)
    square = torch.nn.functional.pad(rows, (0, 0, 0, 1))
    found, scales = rows_to_cameras(rows)
    polar = nearest_rotation(square, reflect=True)[:, :2]
    assert_close(found, polar, rtol=0, atol=1e-13 / apart**1.5)
    assert_close(scales, torch.linalg.svdvals(square).sum(-1) / 2)
    assert_close(found @ found.mT, torch.eye(2, dtype=torch.float64).expand(50, 2, 2))
    assert apart < 1e-4 or gradcheck(rows_to_cameras, rows[:3])  # there no finite difference is small enough


@pytest.mark.parametrize("dtype", FLOATS)
def test_rows_to_cameras_of_degenerate_rows_are_cameras(dtype):
    row = normal(1, 3, dtype=dtype)
    none = torch.zeros(1, 3, dtype=dtype)
    rows = torch.stack([torch.cat(p) for p in [(none, none), (row, none), (none, row), (row, 2 * row), (row, -row)]])
    cameras, scales = rows_to_cameras(rows)
    assert_close(cameras @ cameras.mT, torch.eye(2, dtype=dtype).expand(5, 2, 2))
    assert (scales >= 0).all() and scales[0] == 0


@pytest.mark.parametrize("degrees", [0.0, 10.0, 90.0, 179.0])
def test_viewpoint_turn_of_an_arc(degrees):
    cameras = turning(30, degrees)[:, :2]
    straight = turning(30, degrees, tilt=0.0)[:, :2]
    assert_close(viewpoint_turn(straight).item(), degrees, atol=1e-5, rtol=0)
    assert viewpoint_turn(cameras) <= degrees + 1e-6


def test_viewpoint_turn_of_a_full_circle():
    assert_close(viewpoint_turn(turning(37, 360.0, tilt=0.0)[:, :2]).item(), 180.0, atol=1e-5, rtol=0)


def test_turning_about_the_optical_axis_does_not_count():
    angle = torch.linspace(0, 3, 20, dtype=torch.float64)
    roll = torch.stack([angle.cos(), -angle.sin(), angle.sin(), angle.cos()], -1).reshape(-1, 2, 2)
    assert viewpoint_turn(roll @ rotations()[:2]) < 1e-5
    assert viewpoint_turn(rotations()[None, :2]) < 1e-5  # a single frame


@given(st.integers(0, 10**6), st.floats(0.01, 1.5), st.integers(1, 40))
@settings(max_examples=40, deadline=None)
def test_viewpoint_turn_is_the_largest_angle(seed, spread, frames):
    base = rotations(seed=seed)
    cameras = rows_to_cameras(base[:2] + spread * normal(frames, 2, 3, seed=seed + 1))[0]
    view = complete_rotation(cameras)[:, 2]
    brute = torch.rad2deg(torch.arccos((view @ view.mT).clamp(-1, 1).min())).item()
    found = viewpoint_turn(cameras).item()
    assert 0.75 * brute - 1e-5 <= found <= brute + 1e-5


@pytest.mark.parametrize("dtype", FLOATS)
def test_gradients_are_finite(dtype):
    points, cameras = torch.zeros(2, 5, 3, dtype=dtype), torch.zeros(2, 2, 3, dtype=dtype)
    finite(project, points, cameras)
    finite(orthonormality_defect, cameras)
    finite(complete_rotation, cameras)


@pytest.mark.parametrize("dtype", FLOATS)
def test_angles_have_finite_gradients_where_cameras_are_alike_or_opposite(dtype):
    """The derivative of an arccosine is infinite there."""
    still, path = torch.eye(3, dtype=dtype)[:2].repeat(5, 1, 1), turning(5, 120.0, dtype=dtype)[:, :2]
    back = torch.stack([still[0], still[0] * torch.tensor([[-1.0], [1]], dtype=dtype)])
    for cameras in (still, path, back):
        finite(viewpoint_turn, cameras)


def test_small_angles_keep_their_digits():
    """In single precision an arccosine tells none below 0.02 degrees."""
    cameras = turning(9, 0.01, tilt=0.0, dtype=torch.float32)[:, :2]
    assert viewpoint_turn(cameras).item() == pytest.approx(0.01, rel=1e-2)


def test_gradients_of_angles():
    rows = normal(2, 5, 2, 3)
    assert gradcheck(lambda x: viewpoint_turn(rows_to_cameras(x)[0]), rows)


def test_batches_equal_loops():
    same_as_loop(project, (4, 5, 3), (4, 2, 3))
    same_as_loop(back_project, (4, 5, 2), (4, 2, 3))
    same_as_loop(complete_rotation, (4, 2, 3))
    same_as_loop(orthonormality_defect, (4, 2, 3))
    same_as_loop(rows_to_cameras, (4, 2, 3))
    same_as_loop(lambda x: viewpoint_turn(rows_to_cameras(x)[0]), (4, 2, 3))


@pytest.mark.parametrize("frames", [2, 9])
def test_factorize_refuses_nan_in_our_words(frames):
    tracks = normal(frames, 5, 2)
    tracks[1, 2] = torch.nan
    with pytest.raises(NotFiniteError, match="expected finite numbers, got NaN.*weights of 0"):
        factorize(tracks, 3)


@pytest.mark.parametrize("joints", [5, 12])
def test_factorize_takes_batches(joints):
    def product(tracks):  # the factors are unique up to signs
        motion, shape = factorize(tracks, 3)
        return motion.flatten(-3, -2) @ shape

    same_as_loop(product, (4, joints, 2))


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("dtype", FLOATS)
def test_results_follow_dtype_and_device(dtype, device):
    points = normal(4, 5, 3, dtype=dtype, device=device)
    cameras = rotations(4, dtype=dtype)[:, :2].to(device)
    values = [
        leaves_arguments_alone(project, points, cameras),
        leaves_arguments_alone(back_project, points[..., :2], cameras),
        leaves_arguments_alone(complete_rotation, cameras),
        leaves_arguments_alone(orthonormality_defect, cameras),
        leaves_arguments_alone(viewpoint_turn, cameras),
        *leaves_arguments_alone(rows_to_cameras, cameras),
        *leaves_arguments_alone(lambda x: factorize(x, 3), points[..., :2]),
    ]
    assert {(v.dtype, v.device.type) for v in values} == {(dtype, device)}


def test_quarter_turn_by_hand():
    """Camera frame: x right, y down, z away. Turning left by a quarter brings what was right to the front."""
    point = torch.tensor([[[1.0, 0.0, 0.0]]], dtype=torch.float64)
    camera = turning(2, 90.0, tilt=0.0)
    assert_close(project(point, camera[1:, :2]), torch.zeros(1, 1, 2).double(), atol=1e-12, rtol=0)
    assert math.isclose((point @ camera[1:].mT)[0, 0, 2], -1.0)
