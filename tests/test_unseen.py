"""Joints that no frame shows are placed by the skeleton."""

from dataclasses import replace

import pytest
import torch
from numerics import leaves_arguments_alone, normal, turning
from torch.testing import assert_close

from kcs_torch.methods.unseen import place_unseen
from kcs_torch.skeleton import SKELETONS, Skeleton

BODY = SKELETONS["h36m17"]
KNEE, ANKLE = BODY.index("left_knee"), BODY.index("left_ankle")
FLIP = torch.tensor([1.0, 1.0, -1.0]).double()


def turned_template(scale=300.0, frames=8, mirror=False):
    """The template itself, turning, at a place of its own in each frame."""
    points = scale * BODY.template_points(dtype=torch.float64)
    points = points @ turning(frames, 90.0).mT + normal(frames, 1, 3, seed=1) * 50
    return points * FLIP if mirror else points


def known_but(*unseen):
    known = torch.ones(17, dtype=torch.bool)
    known[list(unseen)] = False
    return known


def spoiled(points, known):
    return torch.where(known[:, None], points, torch.full_like(points, 1e4))


@pytest.mark.parametrize("mirror", [False, True])
@pytest.mark.parametrize("unseen", [[ANKLE], [KNEE, ANKLE], [0], [BODY.index("head")], [0, KNEE, ANKLE, 9]])
def test_a_body_like_the_template_is_completed_exactly(unseen, mirror):
    points, known = turned_template(mirror=mirror), known_but(*unseen)
    found = leaves_arguments_alone(lambda p, k: place_unseen(p, k, BODY), spoiled(points, known), known)
    assert_close(found, points)


def test_seen_joints_stay_and_unseen_ones_keep_their_bones():
    points = turned_template() + 30 * normal(8, 17, 3, seed=2)
    known = known_but(KNEE, ANKLE)
    found = place_unseen(spoiled(points, known), known, BODY)
    assert torch.equal(found[:, known], points[:, known])
    rest = BODY.template_points(dtype=torch.float64)
    length = (found[:, KNEE] - found[:, ANKLE]).norm(dim=-1)
    assert_close(length, length[:1].expand(8))  # one scale for the clip
    assert length[0] / (rest[KNEE] - rest[ANKLE]).norm() == pytest.approx(300, rel=0.1)
    assert_close(found, place_unseen(points, known, BODY))  # whatever stood there


def test_nothing_unseen_and_nothing_seen():
    points = turned_template()
    assert place_unseen(points, known_but(), BODY) is points
    assert place_unseen(points, known_but(*range(17)), BODY) is points


def test_without_a_template_a_joint_takes_its_neighbours_place():
    body, points = replace(BODY, template=None), turned_template()
    found = place_unseen(points, known_but(KNEE, ANKLE), body)
    hip = points[:, BODY.index("left_hip")]
    assert_close(found[:, KNEE], hip)
    assert_close(found[:, ANKLE], hip)


def test_without_a_neighbour_a_joint_takes_the_middle():
    dots = Skeleton.from_edges([], 17, tree=False)
    points, known = turned_template(), known_but(ANKLE)
    assert_close(place_unseen(points, known, dots)[:, ANKLE], points[:, known].mean(1))


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("shown", [1, 2, 3])
def test_few_known_joints_and_degenerate_poses_are_finite(shown, dtype):
    for points in (turned_template(), torch.zeros(8, 17, 3).double(), turned_template(frames=1)):
        known = torch.arange(17) < shown
        found = place_unseen(points.to(dtype), known, BODY)
        assert found.dtype == dtype and torch.isfinite(found).all()
