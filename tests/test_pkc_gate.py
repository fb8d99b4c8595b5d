"""Detections that no body could make: what is dropped, and what is kept."""

from dataclasses import replace

import pytest
import torch

import kcs_torch as kt
from kcs_torch.data import walking_person
from kcs_torch.methods.pkc.gate import SELDOM, elsewhere, plausible, without_others
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


# ------------------------------------------------------------------------------ frames of somebody else


def visited(frames=60, first=25, count=8, scale=1.5, aside=1500.0):
    """A walk during which the tracker takes somebody else for some frames; and which frames are the walker's."""
    clip, other = walking_person(frames, turn=0.0), walking_person(frames, turn=0.0, yaw=130.0)
    points, own = clip.tracks.points.clone(), torch.ones(frames, dtype=torch.bool)
    points[first : first + count] = (
        scale * other.tracks.points[first : first + count] + torch.tensor([aside, 0.0]).double()
    )
    own[first : first + count] = False
    return clip, points, own


@pytest.mark.parametrize(("count", "scale", "aside"), [(8, 1.5, 1500.0), (1, 1.0, -900.0), (12, 0.7, 2000.0)])
def test_frames_of_somebody_else_are_found(count, scale, aside):
    clip, points, own = visited(count=count, scale=scale, aside=aside)
    seen = torch.ones(points.shape[:2], dtype=torch.bool)
    assert torch.equal(elsewhere(points, seen), ~own)
    assert torch.equal(elsewhere(1e-3 * points + 7, seen), ~own)
    seen[20:40, ::2] = False
    seen[30] = False
    assert torch.equal(elsewhere(points, seen), ~own)
    assert not elsewhere(clip.tracks.points, seen).any()


def test_what_is_no_visit():
    clip, points, _ = visited()
    everywhere = torch.ones(points.shape[:2], dtype=torch.bool)
    points[33:] += torch.tensor([5000.0, 0.0]).double()  # it never comes back: a cut, and nobody knows to whom
    assert not elsewhere(points, everywhere).any()
    shaken = clip.tracks.points + 2000 * (torch.arange(60) % 2).double()[:, None, None]
    assert not elsewhere(shaken, everywhere).any()
    for frames in (2, 3):  # a snap aside and back that takes so many frames
        snap = clip.tracks.points.clone()
        way = torch.ones(60).double()
        way[:25] = way[38:] = 0
        for k in range(1, frames):
            way[24 + k] = way[38 - k] = k / frames
        snap[..., 0] += 3000 * way[:, None]
        assert not elsewhere(snap, everywhere).any()
    _, long, _ = visited(count=20)  # a third of the clip
    assert not elsewhere(long, everywhere).any()
    for degenerate in (0 * points, points[:3], points[:0]):
        assert not elsewhere(degenerate, everywhere[: len(degenerate)]).any()
    assert not elsewhere(points, 0 * everywhere > 0).any()


def test_somebody_elses_frames_do_not_spoil_a_clip():
    clip, points, own = visited()
    tracks = replace(clip.tracks, points=points)
    assert without_others(clip.tracks) is clip.tracks
    left = without_others(tracks)
    assert torch.equal(left.seen.any(-1), own)
    assert left.notes[-1].endswith("left out as somebody else's: 8 of 60 (13 %) frames, from frame 25 on")
    result = kt.reconstruct(tracks)
    assert left.notes[-1] in result.tracks.notes
    assert float(kt.metrics.mpjpe(result.points[own], clip.points[own], align="rigid")) < 10
