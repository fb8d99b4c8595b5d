"""The trunk's orientation: its scale, its path and what looks like it, from images of a rigid template."""

import math

import pytest
import torch
from numerics import count_operations, normal, rotations, turning
from torch.testing import assert_close

from kcs_torch.data import walking_person
from kcs_torch.functional import best_path, bone_lengths
from kcs_torch.methods.clips.lockstep import run
from kcs_torch.methods.pkc.trunk import (
    FIT,
    Facing,
    Trunk,
    facings,
    image_scale,
    longest_image,
    mirror,
    trunk_misfit,
    trunk_path,
    trunk_turns,
)
from kcs_torch.nn import PostureEnergy

POSTURE = PostureEnergy("h36m17")
TRUNK = Trunk(POSTURE.rest, POSTURE.rest_lengths)
RIGID = torch.ones(16, dtype=torch.bool)


def paths_of(points):
    """The path that is found, and its mirror image."""
    path = run(trunk_path(points[..., :2], TRUNK, POSTURE, 15.0, 0.15), facings)
    return torch.stack([path, mirror(path)])


def angle(a, b):
    """Degrees between rotations."""
    trace = (a * b).sum((-2, -1))
    return torch.rad2deg(torch.arccos(((trace - 1) / 2).clamp(-1, 1)))


def scale_of(image, noise=0.0, rigid=RIGID):
    noise = torch.full((len(image), 16), noise).to(image)
    return image_scale(image, POSTURE.rest_lengths, POSTURE.bones, rigid, noise)


def test_scale_of_bones_that_lie_in_the_image_plane_now_and_then():
    points = 3.0 * POSTURE.rest @ turning(90, 360.0, tilt=0.0).mT  # turns once about the vertical
    assert scale_of(points[..., :2]).item() == pytest.approx(3.0, rel=0.02)
    clip = walking_person(100, turn=120.0)
    size = (bone_lengths(clip.points, POSTURE.bones).mean(0) / POSTURE.rest_lengths).median()
    assert scale_of(clip.points[..., :2]) / size == pytest.approx(1, abs=0.1)


def test_scale_follows_units_and_ignores_what_noise_adds():
    image = walking_person(60).points[..., :2]
    assert_close(scale_of(2.5 * image), 2.5 * scale_of(image))
    noisy = image + 40 * normal(60, 17, 2)
    plain, rough, told = scale_of(image), scale_of(noisy), scale_of(noisy, 40 * 2**0.5)
    assert rough > 1.05 * plain and abs(told - plain) < 0.6 * abs(rough - plain)


def test_all_frames_that_show_a_bone_tell_its_longest_image():
    """Not those alone of which a detector is surest; what fills gaps does not."""
    flat = torch.zeros(60, 1, 2).double()
    flat[:, 0, 0] = torch.linspace(1, 2, 60).double()
    noise = torch.linspace(0.01, 0.02, 60).double()[:, None]
    assert longest_image(flat, noise).item() == pytest.approx(2, rel=0.03)
    noise[40:] = 0.1
    assert longest_image(flat, noise).item() == pytest.approx(1.66, rel=0.03)


def test_scale_of_nothing():
    image = walking_person(5).points[..., :2]
    assert scale_of(image, rigid=~RIGID) == 1
    assert scale_of(0 * image) == 0
    assert torch.isfinite(scale_of(image[:1]))


def test_mirror():
    turn = rotations(20)
    other = mirror(turn)
    assert_close(mirror(other), turn)
    assert_close(torch.linalg.det(other), torch.ones(20).double())
    flat = normal(20, 8, 3) * torch.tensor([1.0, 1.0, 0.0])  # a flat body looks the same
    assert_close((flat @ other.mT)[..., :2], (flat @ turn.mT)[..., :2])
    assert_close((flat @ other.mT)[..., 2], -(flat @ turn.mT)[..., 2])


def test_misfit_by_hand():
    points = 1.1 * POSTURE.rest @ rotations(3).mT + normal(3, 1, 3)
    image = points[..., :2].clone()
    turns = rotations(3).expand(2, 3, 3, 3)
    joints = POSTURE.trunk
    assert_close(trunk_misfit(image, TRUNK, joints, turns, 1.1), torch.zeros(2, 3).double(), rtol=0, atol=1e-12)
    image[1, joints[0], 0] += 0.06
    count = len(joints)
    expected = 0.06**2 * (1 - 1 / count) / (2 * FIT**2)  # less what the centre takes up
    assert_close(trunk_misfit(image, TRUNK, joints, turns, 1.1)[0], torch.tensor([0, expected, 0]).double())
    sizes = torch.tensor([1.1, 1.0]).double()[:, None, None, None]
    exact, small = trunk_misfit(points[..., :2], TRUNK, joints, turns, sizes)
    assert (small > 1e-3).all() and (exact < 1e-12).all()


def test_turns_by_hand():
    turn = turning(4, 90.0, tilt=0.0)  # 30 degrees a frame
    both = torch.stack([turn, turn[:1].expand(4, 3, 3)])
    cost = trunk_turns(both, 0.5)
    step = math.radians(30)
    assert cost.shape == (3, 2, 2)
    assert_close(cost[:, 0, 0], torch.full((3,), step**2 / 0.5).double())
    assert_close(cost[:, 1, 1], torch.zeros(3).double(), rtol=0, atol=1e-12)
    assert_close(cost[1], torch.tensor([[step**2, step**2], [(2 * step) ** 2, 0]]).double() / 0.5)
    assert_close(trunk_turns(both, 0.5, cap=1.0), cost.clamp_max(1.0))
    assert cost.max() > 1


@pytest.mark.parametrize("degrees", [20.0, 90.0, 300.0])
def test_a_rigid_trunk_is_followed(degrees):
    """One of the two paths is the true one, the other its mirror image."""
    true = turning(60, degrees, tilt=0.3) @ turning(60, 30.0)[10]
    found = paths_of(POSTURE.rest @ true.mT + normal(60, 1, 3))
    assert found.shape == (2, 60, 3, 3)
    assert_close(found[1], mirror(found[0]))
    assert_close(found.mT @ found, torch.eye(3).double().expand_as(found), rtol=0, atol=1e-6)
    off = torch.stack([angle(path, true) for path in found])  # (2, T)
    assert off.amin(0).median() < 3
    side = best_path(off.mT, trunk_turns(found, 0.15))
    assert off[side, torch.arange(60)].max() < 20


def test_a_walk_is_followed():
    points = walking_person(60, turn=0.0, yaw=30.0).points / 1000
    points = points - points.mean(1, keepdim=True)
    points = points * (POSTURE.rest_lengths / bone_lengths(points, POSTURE.bones).mean(0)).median()
    off = torch.stack([angle(path, POSTURE.frame(points)) for path in paths_of(points)])
    assert off.amin(0).median() < 15


def test_clips_together_as_alone():
    """Trunks of other numbers of joints among them, and as many operations as for one."""
    rest = TRUNK.rest - TRUNK.rest.mean(0)
    tasks = [
        Facing(image - image.mean(1, keepdim=True), rest[: image.shape[1]] - rest[: image.shape[1]].mean(0))
        for image in (normal(9, 17, 2), normal(4, 17, 2, seed=1), normal(6, 5, 2, seed=2), normal(1, 17, 2, seed=3))
    ]
    for task, found in zip(tasks, facings(tasks), strict=True):
        for one, other in zip(found, facings([task])[0], strict=True):
            assert_close(one, other)
    one, many = (count_operations(lambda n=n: facings(tasks[:1] * n)).total for n in (1, 20))
    assert many < one + 10


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("frames", [1, 2, 9])
def test_paths_are_rotations_whatever_is_seen(frames, dtype):
    still = walking_person(1).points[..., :2].expand(frames, -1, -1) / 1000
    posture = PostureEnergy("h36m17").to(dtype)
    trunk = Trunk(posture.rest, posture.rest_lengths)
    for image in (still, 0 * still, still * torch.tensor([0.0, 1.0])):
        path = run(trunk_path(image.to(dtype), trunk, posture, 15.0, 0.15), facings)
        assert path.shape == (frames, 3, 3) and path.dtype == dtype
        found = torch.stack([path, mirror(path)])
        assert_close(found.mT @ found, torch.eye(3).expand_as(found).to(found), rtol=0, atol=1e-4)
        assert_close(found, found[:, :1].expand_as(found), rtol=0, atol=1e-3)  # what does not move does not turn
