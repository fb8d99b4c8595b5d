"""Joints that stay exactly where they were: which are told, and what is none."""

from dataclasses import replace

import pytest
import torch

import kcs_torch as kt
from kcs_torch.data.synthetic import walking_person
from kcs_torch.methods.pkc.stuck import stuck, without_stuck

ARM = [14, 15, 16]


def filled(grid=0.0):
    """The detections of a walk, an arm's 14 of which are the last one before, on a grid, and which these are."""
    clip = walking_person(60, turn=0.0, yaw=60.0, noise=1.0, generator=torch.Generator().manual_seed(0)).tracks
    points = clip.points.clone()
    points[21:35, ARM] = points[20, ARM]
    if grid:
        points = (points / grid).round() * grid
    away = torch.zeros(points.shape[:2], dtype=torch.bool)
    away[21:35, ARM] = True
    return clip, points, away


@pytest.mark.parametrize("grid", [0.0, 1.0])
def test_gaps_filled_with_the_last_place_are_told(grid):
    clip, points, away = filled(grid)
    seen = torch.ones_like(away)
    assert torch.equal(stuck(points, seen), away)
    assert torch.equal(stuck(1e-3 * points + 7, seen) if not grid else stuck(points + 7, seen), away)
    tracks = without_stuck(replace(clip, points=points))
    assert torch.equal(~tracks.seen, away)
    assert "left_wrist" in tracks.notes[-1] or "right_wrist" in tracks.notes[-1]
    assert "joints stay exactly where they were while the body moves" in tracks.notes[-1]
    assert any("stay exactly" in note for note in kt.PKC(steps=2, alternatives=0).prepared(tracks).notes)


def test_what_is_not_stuck():
    clip, points, away = filled()
    seen = torch.ones_like(away)
    still = clip.points[:1].expand_as(points).clone()
    still[21:35, ARM] = points[20, ARM]
    for grid in (0.5, 5.0, 50.0):  # feet that stand, on a coarse grid
        assert not stuck((clip.points / grid).round() * grid, seen).any()
    assert not stuck(clip.points, seen).any()
    assert not stuck(still, seen).any()  # the body stands, too
    assert not stuck(points[:30], seen[:30]).any()  # nothing tells what comes next
    assert not stuck(points, seen & ~away).any()
    brief = clip.points.clone()
    brief[21:26, ARM] = brief[20, ARM]
    assert not stuck(brief, seen).any()
    for case in (points[:0], points[:1], points[:1].expand(30, -1, -1), torch.zeros_like(points)):
        assert not stuck(case, seen[: len(case)]).any()
    tracks = clip
    assert without_stuck(tracks) is tracks


def test_outliers_of_a_joint_that_rests_are_no_leaps():
    """What leaps away and straight back was there all along, as are feet that start and are not seen any more."""
    points = walking_person(60, turn=0.0, yaw=60.0).tracks.points.clone()
    seen = torch.ones(60, 17, dtype=torch.bool)
    points[:, ARM[2]] = points[20, ARM[2]]
    for frames in ([30], [10, 25, 40], [10, 11, 30, 31]):
        some = points.clone()
        some[frames, ARM[2]] += 300.0
        assert not stuck(some, seen).any() and not stuck(some.round(), seen).any()
    for count in (1, 2):
        some = points.clone()
        some[60 - count :, ARM[2]] += 50.0 * torch.arange(1, count + 1).double()[:, None]
        assert not stuck(some, seen).any()


def test_quick_moves_between_rests_are_not_stuck():
    """A robot, or few frames a second: the joint rests before and behind."""
    points = walking_person(60, turn=0.0, yaw=60.0).tracks.points.clone()
    rests = (torch.arange(60) // 12).double()[:, None] * 300
    points[:, ARM[2]] = points[0, ARM[2]] + rests
    points[11::12, ARM[2]] += 120
    assert not stuck(points, torch.ones(60, 17, dtype=torch.bool)).any()
    assert not stuck(points.round(), torch.ones(60, 17, dtype=torch.bool)).any()


def test_who_stops_and_starts_again_is_not_stuck():
    """A hand slows down to rest on something, and leaves it again; whole pixels make both sudden."""
    time = torch.arange(60).double()
    points = walking_person(60, turn=0.0, yaw=60.0).tracks.points.clone()
    away = 0.5 * ((time - 20).clamp_max(0) - (time - 40).clamp_min(0)).square()
    points[:, ARM[2], 0] = points[20, ARM[2], 0] + away
    points[:, ARM[2], 1] = points[20, ARM[2], 1]
    assert not stuck(points, torch.ones(60, 17, dtype=torch.bool)).any()
    assert not stuck(points.round(), torch.ones(60, 17, dtype=torch.bool)).any()
