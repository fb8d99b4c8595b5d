"""Angles that chains of bones keep tell which of the paths that each bone can take go together."""

import math

import pytest
import torch

import kcs_torch as kt
from kcs_torch.functional import bone_vectors
from kcs_torch.solvers.bone_paths import BonePaths, bone_paths
from kcs_torch.solvers.corners import agreeing_paths, corners_of
from kcs_torch.solvers.lifts import rotations_over_time, turning_cameras

CHAIN = [(i, i + 1) for i in range(7)]


@pytest.fixture(scope="module")
def robot():
    """Points (T, N, 3), centred, of an arm of seven links, each about a fixed axis, before a camera that goes round."""
    draw = torch.Generator().manual_seed(0)
    time, frames = torch.linspace(0, 1, 160, dtype=torch.float64), 160
    offset = torch.tensor([[0, 0.4], [0.35, 0], [0, 0.3], [0.3, 0], [0.3, 0.15], [0.2, 0], [0, 0.2]])
    twist = torch.tensor([90, 0, 90, -90, 90, 0, 90], dtype=torch.float64).deg2rad()
    pose, places = torch.eye(4, dtype=torch.float64).expand(frames, 4, 4), [torch.zeros(frames, 3, dtype=torch.float64)]
    for (along, up), tilt in zip(offset.tolist(), twist.tolist(), strict=True):  # Denavit and Hartenberg's parameters
        rate, phase = torch.rand(2, generator=draw, dtype=torch.float64) * torch.tensor([1.5, 6.0])
        angle = phase + 0.9 * torch.sin(2 * math.pi * (0.3 + rate) * time + phase)
        c, s, zero, one = angle.cos(), angle.sin(), torch.zeros_like(time), torch.ones_like(time)
        rows = [
            [c, -s * math.cos(tilt), s * math.sin(tilt), along * c],
            [s, c * math.cos(tilt), -c * math.sin(tilt), along * s],
            [zero, math.sin(tilt) * one, math.cos(tilt) * one, up * one],
            [zero, zero, zero, one],
        ]
        pose = pose @ torch.stack([torch.stack(row, -1) for row in rows], -2)
        places.append(pose[:, :3, 3])
    points = torch.stack(places, 1) @ turning_cameras([180], frames, dtype=torch.float64)[0].mT
    points = points - points.mean(1, keepdim=True)
    return points / points[..., :2].square().sum(-1).mean().sqrt()


def test_pairs_of_bones_that_meet():
    chain = corners_of(torch.tensor([(0, 1), (1, 2), (2, 3)]))
    assert chain.bones.tolist() == [[0, 1], [1, 2]] and chain.sense.tolist() == [1, 1]
    assert chain.ends.tolist() == [[0, 2], [1, 3]]
    star = corners_of(torch.tensor([(0, 1), (0, 2), (3, 0)]))
    assert star.bones.tolist() == [[0, 1], [0, 2], [1, 2]] and star.sense.tolist() == [-1, 1, 1]
    assert star.ends.tolist() == [[1, 2], [1, 3], [2, 3]]
    assert corners_of(torch.tensor([(0, 1), (2, 3)])).ends.shape == (0, 2)


def test_senses_are_those_of_the_distance_between_the_ends(robot):
    turned = torch.tensor([(0, 1), (2, 1), (2, 3), (4, 3), (3, 5)])  # some bones point the other way
    corners = corners_of(turned)
    vectors = bone_vectors(robot, turned)
    one, other = vectors[:, corners.bones[:, 0]], vectors[:, corners.bones[:, 1]]
    across = (one + corners.sense[:, None] * other).norm(dim=-1)
    torch.testing.assert_close(across, bone_vectors(robot, corners.ends).norm(dim=-1))


def test_only_the_right_paths_keep_the_angles(robot):
    bones = torch.tensor(CHAIN)
    flat = bone_vectors(robot[..., :2], bones).movedim(-2, 0)
    true = bone_vectors(robot, bones)[..., 2].mT
    found = agreeing_paths(
        bone_paths(robot[..., :2], bones), flat, corners_of(bones), 200, worth=20.0, stiffness=10.0, slack=0.003
    )
    assert found.shape[1:] == true.shape and 100 < len(found) <= 200
    off = torch.stack([(found - s * true).square().mean(-1).sqrt() for s in (1, -1)])  # (2, H, B)
    assert float(off[:, :5].amax(-1).amin()) < 0.05  # all bones, with signs that go together, in one of the first five
    alone = corners_of(bones[:0])
    by_cost = agreeing_paths(bone_paths(robot[..., :2], bones), flat, alone, 5, worth=20.0, stiffness=10.0, slack=0.003)
    off = torch.stack([(by_cost - s * true).square().mean(-1).sqrt() for s in (1, -1)])
    assert float(off.amax(-1).amin()) > 0.2  # likelihood alone does not tell their signs


def test_bones_with_fewer_paths_leave_no_combination_out():
    depth = torch.stack([torch.ones(4), 2 * torch.ones(4)])[:, None].repeat(1, 3, 1).double()
    cost = torch.tensor([[0, torch.inf, torch.inf], [0, 1, torch.inf]], dtype=torch.float64)
    flat = torch.ones(2, 4, 2, dtype=torch.float64)
    made = agreeing_paths(
        BonePaths(depth, cost), flat, corners_of(torch.tensor([(0, 1), (1, 2)])), 9, worth=1.0, stiffness=1.0, slack=0.1
    )
    assert len(made) == 4 and made.isfinite().all()  # one of the first bone's, two of the second's with two signs each


def test_rotations_over_time_align_a_body_that_does_not_change():
    generator = torch.Generator().manual_seed(1)
    body = torch.randn(1, 6, 3, generator=generator, dtype=torch.float64)
    views = turning_cameras([300], 90, dtype=torch.float64)[0]
    rotations = rotations_over_time(body @ views.mT)
    identity = torch.eye(3, dtype=torch.float64).expand_as(rotations)
    torch.testing.assert_close(rotations @ rotations.mT, identity, rtol=0, atol=1e-9)
    aligned = (body @ views.mT) @ rotations
    torch.testing.assert_close(aligned, aligned[:1].expand_as(aligned), rtol=0, atol=1e-8)
    assert rotations_over_time(body).shape == (1, 3, 3)


def test_a_robot_whose_links_keep_their_angles_is_exact(robot):
    skeleton = kt.Skeleton.from_edges(CHAIN, 8)
    found = kt.reconstruct(robot[..., :2], skeleton=skeleton, fps=30)
    depth, true = found.points[..., 2], robot[..., 2]
    off = min(float((depth - sign * true).square().mean().sqrt()) for sign in (1, -1))
    assert off < 0.01 * float(true.square().mean().sqrt())
