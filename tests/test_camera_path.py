"""Paths of constant angular velocity: recovered from exact, noisy and spoiled rotations."""

import math

import pytest
import roma
import torch
from numerics import DEVICES, FLOATS, leaves_arguments_alone, normal, rotations
from torch.testing import assert_close

from kcs_torch.errors import OptionError, ShapeError
from kcs_torch.functional import nearest_rotation
from kcs_torch.solvers import constant_path
from kcs_torch.solvers.camera_path import _left_jacobian, choose_path, settle_path, view_energy


def path(frames, degrees, axis=(0.2, 1.0, -0.1), seed=0):
    """R_t = exp(t w) R_0 that turns by so many degrees in all."""
    axis = torch.tensor(axis, dtype=torch.float64)
    angle = torch.linspace(0, math.radians(degrees), frames, dtype=torch.float64)
    return roma.rotvec_to_rotmat(angle[:, None] * axis / axis.norm()) @ rotations(seed=seed)


def error(found, true):
    return torch.rad2deg(roma.rotmat_geodesic_distance(found, true)).max().item()


@pytest.mark.parametrize("frames", [2, 3, 10, 120])
@pytest.mark.parametrize("degrees", [0.0, 1.0, 90.0, 170.0])
def test_exact_paths(frames, degrees):
    true = path(frames, degrees)
    found, angle = constant_path(true)
    assert error(found, true) < 1e-4
    assert angle.shape == (frames,) and angle.max() < 1e-5


def test_paths_together_as_one_by_one():
    noisy = torch.stack([path(20, degrees, seed=i) for i, degrees in enumerate((0.0, 60.0, 170.0, 700.0))])
    noisy = roma.rotvec_to_rotmat(0.02 * normal(4, 20, 3)) @ noisy
    together, angles = constant_path(noisy.view(2, 2, 20, 3, 3))
    assert together.shape == (2, 2, 20, 3, 3) and angles.shape == (2, 2, 20)
    for one, found, angle in zip(noisy, together.flatten(0, 1), angles.flatten(0, 1), strict=True):
        for value, expected in zip((found, angle), constant_path(one), strict=True):
            assert_close(value, expected, rtol=0, atol=1e-7)


@pytest.mark.parametrize("degrees", [400.0, 1500.0])
def test_several_turns(degrees):
    true = path(200, degrees)
    assert error(constant_path(true)[0], true) < 1e-4


def test_noise_averages_out():
    true = path(150, 120)
    noisy = roma.rotvec_to_rotmat(0.02 * normal(150, 3)) @ true  # about 2 degrees
    found, angle = constant_path(noisy)
    assert error(found, true) < 0.8
    assert_close(angle, roma.rotmat_geodesic_distance(found, noisy))


@pytest.mark.parametrize("degrees", [0.0, 150.0])
def test_outliers_do_not_count(degrees):
    true = path(150, degrees)
    spoiled = roma.rotvec_to_rotmat(0.01 * normal(150, 3)) @ true
    wrong = torch.arange(150) % 5 == 0
    spoiled[wrong] = rotations(30, seed=4)  # a fifth of the frames, anywhere
    found, _ = constant_path(spoiled)
    assert error(found, true) < 1.0


def test_noisy_static_cameras_stay():
    true = path(100, 0.0)
    noisy = roma.rotvec_to_rotmat(0.01 * normal(100, 3)) @ true
    assert error(constant_path(noisy)[0], true) < 0.5


def test_found_paths_have_constant_angular_velocity():
    found, _ = constant_path(roma.rotvec_to_rotmat(0.3 * normal(40, 3)) @ path(40, 200))
    step = found[1:] @ found[:-1].mT
    assert_close(step, step[:1].expand_as(step))
    assert_close(found @ found.mT, torch.eye(3).double().expand(40, 3, 3))


def test_single_precision():
    true = path(60, 100)
    found, _ = constant_path(true.float())
    assert error(found.double(), true) < 0.05


def test_world_frame_is_free():
    """Another world frame turns the path along."""
    noisy, world = roma.rotvec_to_rotmat(0.05 * normal(50, 3)) @ path(50, 100), rotations(seed=5)
    assert error(constant_path(noisy @ world)[0], constant_path(noisy)[0] @ world) < 1e-4


def test_left_jacobian_is_the_derivative_of_the_exponential():
    vectors = torch.cat([normal(4, 3), torch.zeros(1, 3).double(), 1e-8 * normal(1, 3)])
    jacobian = _left_jacobian(vectors)
    for vector, matrix in zip(vectors, jacobian, strict=True):
        base = roma.rotvec_to_rotmat(vector)
        for axis in range(3):
            moved = vector + 1e-6 * torch.eye(3).double()[axis]
            difference = roma.rotmat_to_rotvec(roma.rotvec_to_rotmat(moved) @ base.mT) / 1e-6
            assert_close(matrix[:, axis], difference, rtol=0, atol=1e-5)


@pytest.mark.parametrize("shape", [(1, 3, 3), (5, 2, 3), (3, 3), (2, 1, 3, 3)])
def test_shapes_that_do_not_fit(shape):
    with pytest.raises(ShapeError, match="constant_path: expected"):
        constant_path(torch.zeros(shape))


def test_paths_of_several_clips_or_of_no_kind_are_told():
    """Batches ended in sizes at dimensions; a name that is none was taken for auto."""
    with pytest.raises(ShapeError, match=r"choose_path: expected rotations \(T, 3, 3\)"):
        choose_path(torch.eye(3).expand(2, 12, 3, 3))
    with pytest.raises(OptionError, match="unknown camera path 'constnat': did you mean 'constant'"):
        choose_path(torch.eye(3).expand(12, 3, 3), "constnat")
    with pytest.raises(ShapeError, match=r"settle_path: expected vectors \(T, B, 3\)"):
        settle_path(torch.ones(4, 5, 3), torch.eye(3))


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("dtype", FLOATS)
def test_results_follow_dtype_and_device(dtype, device):
    values = leaves_arguments_alone(constant_path, path(10, 50).to(device, dtype))
    assert {(v.dtype, v.device.type) for v in values} == {(dtype, device)}


def test_a_smooth_path_follows_a_swaying_camera_through_noise():
    time = torch.linspace(0, 1, 200, dtype=torch.float64)
    vector = torch.zeros(200, 3, dtype=torch.float64)
    vector[:, 1] = 0.35 * (2 * torch.pi * time).sin()
    truth = roma.rotvec_to_rotmat(vector)
    jolt = 0.05 * torch.randn(200, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    path, _, angle = choose_path(roma.rotvec_to_rotmat(jolt) @ truth, "smooth")
    assert roma.rotmat_geodesic_distance(path, truth).median() < 0.03
    assert angle.shape == (200,)
    assert torch.allclose(path @ path.mT, torch.eye(3, dtype=torch.float64).expand_as(path), atol=1e-9)


def test_choose_path_takes_the_simplest_that_explains():
    time = torch.linspace(0, 1, 200, dtype=torch.float64)[:, None]
    axis = torch.tensor([0.1, 1.0, 0.0], dtype=torch.float64)
    jolt = 0.02 * torch.randn(200, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    even = roma.rotvec_to_rotmat(jolt) @ roma.rotvec_to_rotmat(3 * time * axis)
    sway = roma.rotvec_to_rotmat(0.6 * (2 * torch.pi * time).sin() * axis)
    wild = roma.random_rotmat(200, dtype=torch.float64)
    assert choose_path(even)[1] == "constant"
    assert choose_path(sway)[1] == "smooth"
    path, kind, _ = choose_path(wild)
    assert kind == "free" and torch.equal(path, wild)
    assert choose_path(even, "free")[1] == "free" and choose_path(even, "smooth")[1] == "smooth"
    assert choose_path(even[:5])[1] == "free"


def test_settle_path_finds_axis_and_speed():
    """A path off in axis and speed comes back to where the world poses vary least."""
    frames = 150
    time = (torch.arange(frames, dtype=torch.float64) - (frames - 1) / 2)[:, None]
    speed = torch.tensor([0.0, 0.1, 0.0], dtype=torch.float64)
    truth = roma.rotvec_to_rotmat(time * speed)
    generator = torch.Generator().manual_seed(0)
    rest = torch.randn(1, 6, 3, generator=generator, dtype=torch.float64)
    moves = 0.1 * torch.randn(1, 6, 3, generator=generator, dtype=torch.float64)
    world = rest + moves * (0.05 * time)[..., None].sin()
    off = roma.rotvec_to_rotmat(time * (speed + torch.tensor([0.003, 0.0005, 0.0])))
    found = settle_path(world @ truth.mT, off)
    gauge = lambda p: roma.rotmat_geodesic_distance(p, truth @ nearest_rotation((truth.mT @ p).sum(0))).max()  # noqa: E731
    assert gauge(off) > 0.03
    assert gauge(found) < 0.005
    assert settle_path(world[:2], off[:2]).shape == (2, 3, 3)


def test_view_energy_tells_mirror_images_apart():
    """A rigid body seen from all sides: whatever its size and place, the mirror image varies more."""
    true = path(40, 30)
    points = normal(5, 3)[None] @ true.mT
    both = torch.stack([points, points * torch.tensor([1.0, 1.0, -1.0])])
    right, wrong = view_energy(both, true)
    assert wrong > right + 5
    for other in (1e-4 * both, 1e6 * both, both + normal(40, 1, 3)):
        assert_close(view_energy(other, true), torch.stack([right, wrong]))
    assert view_energy(0 * both, true).isfinite().all()


def test_more_frames_of_the_same_turn_tell_no_more_of_mirror_images():
    points = normal(5, 3)[None]
    told = []
    for frames in (40, 160):
        true = path(frames, 30)
        both = torch.stack([points @ true.mT, points @ true.mT * torch.tensor([1.0, 1.0, -1.0])])
        right, wrong = view_energy(both, true)
        told.append(wrong - right)
    assert told[1] == pytest.approx(float(told[0]), rel=0.1)


def test_view_energy_of_cameras_that_stand_still():
    still = rotations()[None].expand(20, 3, 3)
    points = normal(20, 5, 3)
    right, wrong = view_energy(torch.stack([points, points * torch.tensor([1.0, 1.0, -1.0])]), still)
    assert_close(right, wrong)


def test_a_clip_of_one_frame_among_others_stands_still():
    """Its speed was the median of none, NaN."""
    clip = rotations(1, seed=3).expand(2, 12, 3, 3).clone()
    path, angle = constant_path(clip, counts=torch.tensor([1, 12]))
    assert_close(path, clip)
    assert angle[0, 1:].isnan().all() and (angle[0, 0] < 1e-6) and (angle[1] < 1e-6).all()
