"""Detections that no body could make: what is dropped, and what is kept."""

from dataclasses import replace

import pytest
import torch

from kcs_torch.data import walking_person
from kcs_torch.methods.pkc.gate import SELDOM, plausible
from kcs_torch.skeleton import SKELETONS

BODY = SKELETONS["h36m17"]
WRIST, HIP, KNEE, ANKLE = (BODY.joints.index(f"left_{name}") for name in ("wrist", "hip", "knee", "ankle"))


def walk(frames=30):
    points = walking_person(frames, yaw=60.0).tracks.points
    return points, torch.ones(frames, 17, dtype=torch.bool)


def dropped(points, seen, body=BODY):
    return [tuple(at) for at in (seen & ~plausible(points, seen, body)).nonzero().tolist()]


@pytest.mark.parametrize("skeleton", ["h36m17", "coco17", "body25", "mediapipe33"])
@pytest.mark.parametrize("yaw", [0.0, 90.0])
def test_a_walk_is_plausible(skeleton, yaw):
    points = walking_person(30, skeleton=skeleton, yaw=yaw, turn=0.0).tracks.points
    seen = torch.ones(points.shape[:2], dtype=torch.bool)
    assert plausible(points, seen, SKELETONS[skeleton]).all()


@pytest.mark.parametrize("factor", [1e-3, 1.0, 1e3])
def test_joints_far_away_are_dropped(factor):
    """Not the elbow or the hip that they pull at; but a wrong knee's ankle, for which nothing else vouches."""
    points, seen = walk()
    points[4, WRIST] += 3000
    points[9, KNEE] -= 3000
    before = points.clone()
    assert dropped(factor * points, seen) == [(4, WRIST), (9, KNEE), (9, ANKLE)]
    assert torch.equal(points, before) and seen.all()


def test_only_what_is_far_too_long_is_dropped():
    points, seen = walk()
    points[4, WRIST] += 150  # mm
    assert dropped(points, seen) == []


def test_without_a_bone_that_is_right():
    """A joint is dropped where all bones to seen joints are wrong: unseen ones say nothing."""
    points, seen = walk()
    points[4, KNEE] += 3000
    points[4, ANKLE] += 3000  # now the knee has a bone that is as long as it should be
    assert (4, KNEE) not in dropped(points, seen)
    seen[4, ANKLE] = False
    assert (4, KNEE) in dropped(points, seen)
    seen[4, HIP] = False  # nothing is left that contradicts
    assert dropped(points, seen) == []


def test_unseen_joints_stay_unseen_whatever_stands_there():
    points, seen = walk()
    seen[3:8, WRIST] = False
    points[3:8, WRIST] = torch.nan
    kept = plausible(points, seen, BODY)
    assert torch.equal(kept, seen)


def test_joints_seen_in_hardly_any_frame_are_dropped_altogether():
    points, seen = walk()
    seen[SELDOM - 1 :, WRIST] = False
    assert dropped(points, seen) == [(t, WRIST) for t in range(SELDOM - 1)]
    seen[SELDOM - 1, WRIST] = True
    assert dropped(points, seen) == []
    short, all_seen = walk(SELDOM - 1)  # nothing is seen more often here
    assert plausible(short, all_seen, BODY).all()


def test_without_usual_lengths_nothing_is_too_long():
    points, seen = walk()
    points[4, WRIST] += 3000
    bare = replace(BODY, template=None, proportions=None)
    assert dropped(points, seen, bare) == []


@pytest.mark.parametrize("case", ["nothing seen", "one joint", "one place", "one frame"])
def test_clips_that_tell_nothing(case):
    points, seen = walk(8)
    if case == "nothing seen":
        seen = torch.zeros_like(seen)
    if case == "one joint":
        seen[:, 1:] = False
    if case == "one place":
        points = torch.zeros_like(points)
    if case == "one frame":
        points, seen = points[:1], seen[:1]
    assert torch.equal(plausible(points, seen, BODY), seen)
