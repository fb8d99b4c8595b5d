"""Solutions that leap to their mirror image from one frame to the next."""

import pytest
import torch
from numerics import normal, rotations

import kcs_torch as kt
from kcs_torch.methods.pkc.leaps import leaps_of, without_leaps
from kcs_torch.solvers.procrustean import Pose

FLIP = torch.tensor([1.0, 1.0, -1.0]).double()


def flat_body(frames=20, joints=8, thickness=0.0):
    """Poses of a body in a plane, turned evenly; the second of both leaps at two frames."""
    body = normal(joints, 3) * torch.tensor([1.0, 1.0, thickness]).double()
    body = body - body.mean(0)
    first = rotations(1)[0]
    turn = torch.linspace(0, 0.3, frames).double()
    zero, one = torch.zeros_like(turn), torch.ones_like(turn)
    steps = torch.stack([turn.cos(), zero, turn.sin(), zero, one, zero, -turn.sin(), zero, turn.cos()], -1)
    turned = steps.unflatten(-1, (3, 3)) @ first
    points = body @ turned.mT
    leaping = points.clone()
    leaping[7:15] *= FLIP
    none = torch.zeros(2).double()
    return Pose(torch.stack([points, leaping]), torch.stack([turned, turned]), none, none)


def test_leaps_are_found_and_turned_back():
    pose = flat_body()
    assert leaps_of(pose.points[..., 2]).nonzero().tolist() == [[1, 7], [1, 15]]
    even = without_leaps(pose)
    torch.testing.assert_close(even.points[1], pose.points[0])
    assert torch.linalg.det(even.rotations).min() > 0.999
    assert without_leaps(pose[:1]) is None


def test_a_flat_body_stays_aligned():
    """By rotations that follow those of its mirror image, where these align that."""
    pose = flat_body()
    normal_ = torch.linalg.eigh((lambda a: a.mT @ a)((pose.points[0] @ pose.rotations[0]).flatten(0, 1)))[1][:, :1]
    mirror = torch.eye(3).double() - 2 * normal_ @ normal_.mT
    turned = pose.rotations.clone()
    turned[1, 7:15] = FLIP[:, None] * turned[1, 7:15] @ mirror
    even = without_leaps(Pose(pose.points, turned, pose.objective, pose.moved))
    torch.testing.assert_close(even.points[1] @ even.rotations[1], (pose.points @ pose.rotations)[0])


@pytest.mark.parametrize("depth", [torch.zeros(1, 9, 4), torch.ones(1, 1, 4), torch.ones(2, 0, 4), torch.ones(1, 2, 4)])
def test_nothing_leaps_where_nothing_moves(depth):
    assert not leaps_of(depth.double()).any()


@pytest.mark.filterwarnings("ignore:.*little more than a guess")
@pytest.mark.parametrize("noise", [0.3, 3.0])
def test_an_arm_in_noise_does_not_leap(shared, noise):
    """A robot arm that stays nearly in a plane, before a camera at rest: half of it had been its mirror image."""
    arm = kt.load_motion(shared / "data/robot/franka_panda_fk.npz")
    part = kt.Motion.from_arrays(arm.points[158:218], skeleton=arm.skeleton, fps=30, units="mm", up="z")
    result = kt.reconstruct(
        part.tracks(yaw=343, pitch=30, noise=noise, generator=torch.Generator().manual_seed(0)), method="pkc"
    )
    truth = part.in_camera(yaw=343, pitch=30)
    truth = truth - truth.mean(1, keepdim=True)
    error = [
        float(kt.metrics.mpjpe(one.points - one.points.mean(1, keepdim=True), truth, align="none"))
        for one in (result, result.mirrored())
    ]
    assert min(error) < 30
