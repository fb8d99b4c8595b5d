"""How far filled gaps may be wrong; joints that no frame shows are placed by the skeleton."""

from dataclasses import replace

import pytest
import torch
from numerics import leaves_arguments_alone, normal, turning
from torch.testing import assert_close

from kcs_torch.functional import bone_lengths
from kcs_torch.methods.clips.unseen import BEND, LEAST, gap_deviation, place_unseen, within_reach
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
    points = turned_template() + 6 * normal(8, 17, 3, seed=2)  # 35 mm for a person of 1.75 m
    known = known_but(KNEE, ANKLE)
    found = place_unseen(spoiled(points, known), known, BODY)
    assert torch.equal(found[:, known], points[:, known])
    rest = BODY.template_points(dtype=torch.float64)
    length = (found[:, KNEE] - found[:, ANKLE]).norm(dim=-1)
    assert_close(length, length[:1].expand(8))  # one scale for the clip
    assert length[0] / (rest[KNEE] - rest[ANKLE]).norm() == pytest.approx(300, rel=0.1)
    assert_close(found, place_unseen(points, known, BODY))  # whatever stood there


def test_a_joint_between_two_that_are_seen_is_told_by_both():
    """Whatever the order of the bones."""
    points, known = turned_template() + 20 * normal(8, 17, 3, seed=2), known_but(KNEE)
    found = place_unseen(points, known, BODY)
    order = list(range(BODY.num_bones))[::-1]
    named = {"bones": BODY.bones, "proportions": BODY.proportions, "spread": BODY.spread}
    other = replace(BODY, flexible=(), **{k: tuple(v[i] for i in order) for k, v in named.items() if v is not None})
    assert_close(found, place_unseen(points, known, other))
    hip = BODY.index("left_hip")
    by_one = [place_unseen(points, known_but(KNEE, end), BODY)[:, KNEE] for end in (ANKLE, hip)]
    far = [(found[:, KNEE] - one).norm(dim=-1).mean() for one in by_one]
    assert abs(far[0] / far[1] - 1) < 0.5  # by the hip alone, or by the ankle


def test_a_pose_unlike_the_templates_does_not_shrink_what_is_unseen():
    points, known = turned_template(), known_but(KNEE, ANKLE)
    bent = points.clone()
    for joint in (BODY.index("left_wrist"), BODY.index("right_wrist"), BODY.index("head")):
        near = next(a for a, b in BODY.bones if b == joint)
        bent[:, joint] = 2 * points[:, near] - points[:, joint]  # turned back, of the same length
    before, after = (place_unseen(p, known, BODY) for p in (points, bent))
    length = [(found[:, KNEE] - found[:, ANKLE]).norm(dim=-1) for found in (before, after)]
    assert_close(length[1], length[0])


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


def swing(frames, rate, radius=0.5):
    """A joint that circles once a second beside one at rest, (T, 2, 2)."""
    angle = 2 * torch.pi * torch.arange(frames).double() / rate
    moving = radius * torch.stack([angle.cos(), angle.sin()], -1)
    return torch.stack([moving, torch.zeros_like(moving)], 1)


def test_gaps_are_uncertain_by_their_middle_and_by_what_moves():
    points = swing(90, 30)
    seen = torch.ones(90, 2).bool()
    seen[40:47] = False
    found = gap_deviation(points, seen, 30.0, most=1.0)
    assert (found[seen] == 0).all()
    assert_close(found[40:47, 1], torch.full((7,), LEAST).double())
    bend = 0.5 * (2 * torch.pi / 30) ** 2
    away = torch.tensor([1, 2, 3, 4, 3, 2, 1]).double()
    assert_close(found[40:47, 0], LEAST + BEND * bend * away.square(), rtol=0.01, atol=0)
    assert (gap_deviation(points, seen, 30.0, most=0.01) <= 0.01).all()


def test_gaps_at_the_ends_and_joints_never_seen():
    points = swing(60, 30)
    seen = torch.ones(60, 2).bool()
    seen[:3, 0] = False
    seen[:, 1] = False
    found = gap_deviation(points, seen, 30.0, most=0.2)
    assert found[0, 0] > found[1, 0] > found[2, 0] > 0
    assert (found[:, 1] == 0.2).all()
    for frames in (1, 2, 3):
        short = gap_deviation(points[:frames], seen[:frames], 30.0)
        assert short.shape == (frames, 2) and torch.isfinite(short).all() and (short[:, 1] > 0).all()


def test_gaps_of_one_duration_are_as_uncertain_at_any_frame_rate():
    """The middle of a fifth of a second without a joint."""
    slow, fast = (int(rate) for rate in (30, 120))
    middle = []
    for rate in (slow, fast):
        seen = torch.ones(3 * rate, 2).bool()
        seen[rate + 1 : rate + rate // 5] = False
        middle.append(gap_deviation(swing(3 * rate, rate), seen, float(rate))[rate + rate // 10, 0] - LEAST)
    assert_close(middle[0], middle[1], rtol=0.02, atol=0)


def test_only_the_second_about_a_gap_counts():
    points = swing(300, 30)
    points[150:] = points[150]  # at rest from here on
    seen = torch.ones(300, 2).bool()
    seen[[50, 250]] = False
    found = gap_deviation(points, seen, 30.0)
    assert found[50, 0] > 2 * LEAST and found[250, 0] == LEAST


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_what_was_filled_comes_back_to_where_bones_reach(dtype):
    """An arm that ran off while only its shoulder was seen; what is seen stays, and so does what is near enough."""
    points = turned_template(frames=20)[..., :2].to(dtype)
    seen = torch.ones(20, 17, dtype=torch.bool)
    shoulder, elbow, wrist = (BODY.index(f"left_{part}") for part in ("shoulder", "elbow", "wrist"))
    seen[15:, [elbow, wrist]] = seen[3, KNEE] = False
    spoilt = points.clone()
    spoilt[15:, wrist] += torch.linspace(0, 3000, 5).to(dtype)[:, None]
    found = leaves_arguments_alone(lambda p, s: within_reach(p, s, BODY), spoilt, seen)
    assert torch.equal(found[seen], points[seen]) and torch.equal(found[3], points[3])
    arm = torch.tensor([[shoulder, elbow], [elbow, wrist]])
    longest, images = bone_lengths(turned_template(frames=20).to(dtype), arm)[0], bone_lengths(found, arm)
    assert found.dtype == dtype and (images <= 1.01 * longest).all(), images / longest
    assert (bone_lengths(spoilt, arm)[-1] > 5 * longest).any()


def test_nothing_is_said_of_bones_that_nobody_knows():
    """Without usual lengths a bone that no frame shows, and one of no length, may be of any."""
    dots = Skeleton(["a", "b", "c"], [(0, 1), (1, 2)])
    points = normal(6, 3, 2)
    seen = torch.tensor([True, True, False]).expand(6, 3)
    assert torch.equal(within_reach(points, seen, dots), points)
    points[:, 1] = points[:, 0]
    assert torch.equal(within_reach(points, torch.tensor([True, False, False]).expand(6, 3), dots), points)


def test_virtual_joints_follow_what_was_pulled_back():
    body = SKELETONS["coco17"]
    points = body.complete(normal(5, body.num_observed, 2))[0]
    seen = torch.ones(5, body.num_joints, dtype=torch.bool)
    hip = body.index("left_hip")
    seen[4, hip] = False
    points[4, hip] += 1e3
    found = within_reach(points, seen, body)
    assert (found[4, hip] - points[4, hip]).norm() > 100
    assert_close(found, body.complete(found[:, : body.num_observed])[0])
