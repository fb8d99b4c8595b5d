"""What leaps away and back is somebody's, or something, else: what is left out, and what is kept."""

from dataclasses import replace

import pytest
import torch

import kcs_torch as kt
from kcs_torch.data import walking_person
from kcs_torch.methods.pkc.elsewhere import elsewhere, limbs_elsewhere, without_others, without_strange_limbs
from kcs_torch.skeleton import SKELETONS

BODY = SKELETONS["h36m17"]
ARM, LEG, OTHER_LEG = (
    [BODY.joints.index(f"{side}_{name}") for name in names]
    for side, *names in (
        ("left", "elbow", "wrist"),
        ("left", "knee", "ankle"),
        ("right", "knee", "ankle"),
    )
)


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


# ------------------------------------------------------------------------------ limbs of somebody else


def strayed(joints, frames=slice(20, 35), by=(220.0, -150.0), turn=0.0):
    """A walk during which a detector puts some joints elsewhere."""
    clip = walking_person(60, turn=turn, yaw=40.0)
    points = clip.tracks.points.clone()
    away = torch.zeros(points.shape[:2], dtype=torch.bool)
    for joint in joints:
        away[frames, joint] = True
    points[away] += torch.tensor(by).double()
    return clip, points, away


@pytest.mark.parametrize("joints", [ARM, LEG, ARM[1:]], ids=["arm", "leg", "wrist"])
@pytest.mark.parametrize("frames", [slice(20, 23), slice(10, 33)], ids=["three frames", "a long time"])
def test_joints_that_leap_away_and_back_are_found(joints, frames):
    clip, points, away = strayed(joints, frames)
    seen = torch.ones_like(away)
    assert torch.equal(limbs_elsewhere(points, seen, 30.0), away)
    assert torch.equal(limbs_elsewhere(1e-3 * points + 7, seen, 30.0), away)
    assert not limbs_elsewhere(clip.tracks.points, seen, 30.0).any()
    twice = points.clone()
    twice[45:50, joints] += 200.0
    away[45:50, joints] = True
    assert torch.equal(limbs_elsewhere(twice, seen, 30.0), away)  # and not what lies between


@pytest.mark.parametrize("frames", [slice(0, 3), slice(0, 12), slice(48, 60), slice(57, 60)])
def test_of_a_leap_near_an_end_the_shorter_side_is_away(frames):
    _, points, away = strayed(LEG, frames)
    assert torch.equal(limbs_elsewhere(points, torch.ones_like(away), 30.0), away)


@pytest.mark.parametrize("case", ["one frame unseen at the leap", "a slow detector"])
def test_steps_are_those_between_frames_that_show_a_joint(case):
    _, points, away = strayed(ARM, slice(20, 36), by=(400.0, -300.0))
    points = points + 20.0 * torch.arange(60)[:, None, None]  # who walks through the image
    seen = torch.ones_like(away)
    if case == "a slow detector":
        seen[1::2] = False
    else:
        seen[20, ARM] = False
    assert torch.equal(limbs_elsewhere(points, seen, 30.0), away & seen)


@pytest.mark.parametrize("fps", [15.0, 30.0])
@pytest.mark.parametrize("unseen", [0.0, 0.2, 0.4])
def test_quick_arms_of_which_frames_are_missing(fps, unseen):
    """A step to a frame behind missing ones is no leap, nor are frames that show nothing still ones."""
    clip = walking_person(80, turn=0.0, yaw=40.0)
    time = torch.arange(80).double() / fps
    swing = 1.2 * torch.sin(2 * torch.pi * 1.2 * time)
    swung = clip.tracks.points.clone()
    shoulder, reach = swung[:, BODY.joints.index("left_shoulder")], 550.0
    swung[:, ARM[1]] = shoulder + reach * torch.stack([swing.sin(), swing.cos()], -1)
    swung[:, ARM[0]] = shoulder + 0.5 * reach * torch.stack([swing.sin(), swing.cos()], -1)
    for seed in range(5):
        seen = torch.ones(80, 17, dtype=torch.bool)
        seen[:, ARM] = torch.rand(80, 2, generator=torch.Generator().manual_seed(seed)) >= unseen
        assert not limbs_elsewhere(swung, seen, fps).any()


@pytest.mark.parametrize(("by", "found"), [(0.25, False), (0.8, True)])
def test_single_hands_are_quick_for_their_size(by, found):
    clip = kt.data.random_motion(SKELETONS["hand21"], 30, turn=30, swing=10).tracks
    points = clip.points.clone()
    points[10:16, 8] += by * (points - points.mean(1, keepdim=True)).norm(dim=-1).mean()
    tracks = replace(clip, points=points)
    assert limbs_elsewhere(points, tracks.seen, 30.0).any()
    without = without_strange_limbs(tracks)
    assert torch.equal(~without.seen, limbs_elsewhere(points, tracks.seen, 30.0)) if found else without is tracks


def test_where_frames_are_lost_all_joints_leap():
    clip = walking_person(90, turn=0.0, yaw=80.0)
    for first in range(5, 75, 7):  # eight frames, a third of a stride
        points = torch.cat([clip.tracks.points[:first], clip.tracks.points[first + 8 :]])
        assert not limbs_elsewhere(points, torch.ones(points.shape[:2], dtype=torch.bool), 30.0).any()


def test_what_stays_where_something_else_is_is_found():
    _, points, away = strayed(ARM, by=(700.0, -500.0))
    points[20:35, ARM] = points[20, ARM]
    assert torch.equal(limbs_elsewhere(points, torch.ones_like(away), 30.0), away)


def test_what_is_no_leap_of_a_limb():
    clip, points, away = strayed(ARM)
    seen = torch.ones_like(away)
    assert not limbs_elsewhere(points, seen, 8.0).any()  # in so long a time an arm goes so far
    for case in ("brief", "most of the clip", "not back", "slowly", "the whole body", "half of the body"):
        some = clip.tracks.points.clone()
        if case == "brief":  # the model of the clip tells these
            some[20:22, ARM] += 220
        if case == "most of the clip":
            some[15:42, ARM] += 220
        if case == "not back":
            some[20:, ARM] += 220
        if case == "slowly":
            way = (1 - (torch.arange(60).double() - 30).abs() / 6).clamp_min(0)
            some[:, ARM] += 900 * way[:, None, None]
        if case == "the whole body":
            some[20:35] += 220
        if case == "half of the body":
            some[20:35, ::2] += 220
        assert not limbs_elsewhere(some, seen, 30.0).any(), case
    for degenerate in (0 * points, points[:3], points[:0]):
        assert not limbs_elsewhere(degenerate, seen[: len(degenerate)], 30.0).any()
    assert not limbs_elsewhere(points, ~seen, 30.0).any()


def test_legs_that_change_places_are_not_left_out():
    clip = walking_person(60, turn=0.0, yaw=80.0)
    points = clip.tracks.points.clone()
    both = LEG + OTHER_LEG
    points[14:20, both] = points[14:20, OTHER_LEG + LEG]  # while they are far apart
    tracks = replace(clip.tracks, points=points)
    assert without_strange_limbs(tracks) is not tracks
    assert without_strange_limbs(tracks, swapped=True) is tracks
    assert not any("leap" in note for note in kt.reconstruct(tracks).tracks.notes)


@pytest.mark.parametrize("joints", [ARM, LEG], ids=["arm", "leg"])
@pytest.mark.parametrize("noise", [0.0, 4.0], ids=["exact", "noisy"])
def test_a_limb_elsewhere_does_not_spoil_a_clip(joints, noise):
    clip, points, away = strayed(joints)
    points = points + noise * torch.randn(points.shape, generator=torch.Generator().manual_seed(1)).double()
    tracks = replace(clip.tracks, points=points)
    assert without_strange_limbs(clip.tracks) is clip.tracks
    result = kt.reconstruct(tracks)
    assert torch.equal(result.tracks.seen, ~away)
    which = f"30 of 1020 (2.9 %) detections, of {', '.join(BODY.joints[joint] for joint in joints)}"
    assert f"joints leap away, or back, by themselves: taken as unseen meanwhile: {which}" in result.tracks.notes
    own = ~away.any(1)
    assert float(kt.metrics.mpjpe(result.points[own], clip.points[own], align="rigid")) < 12 + 4 * noise
