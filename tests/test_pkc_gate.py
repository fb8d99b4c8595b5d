"""Detections that no body could make: what is dropped, and what is kept."""

from dataclasses import replace

import pytest
import torch

import kcs_torch as kt
from kcs_torch.data import walking_person
from kcs_torch.functional.align import superpose
from kcs_torch.methods.pkc.cleaning import MANY
from kcs_torch.methods.pkc.gate import (
    HELD,
    SELDOM,
    at_border,
    doubled,
    plausible,
    repeats,
    without_border,
    without_doubled,
    without_repeats,
)
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
    """And nothing that they pull at."""
    points, seen = walk()
    points[4, WRIST] += 3000
    points[9, KNEE] -= 3000
    before = points.clone()
    assert dropped(factor * points, seen) == [(4, WRIST), (9, KNEE)]
    assert torch.equal(points, before) and seen.all()


def test_only_what_is_far_too_long_is_dropped():
    points, seen = walk()
    points[4, WRIST] += 150  # mm
    assert dropped(points, seen) == []


def test_without_a_bone_that_is_right():
    """Within the body's reach a joint is dropped where all bones to seen joints are wrong: unseen ones say nothing."""
    points, seen = walk()
    aside = torch.tensor([1000.0, 0.0]).double()
    points[4, KNEE] += aside
    assert dropped(points, seen) == [(4, KNEE), (4, ANKLE)]  # nothing else vouches for the ankle
    points[4, ANKLE] += aside  # now the knee has a bone that is as long as it should be
    assert dropped(points, seen) == []
    seen[4, ANKLE] = False
    assert dropped(points, seen) == [(4, KNEE)]
    seen[4, HIP] = False  # nothing is left that contradicts
    assert dropped(points, seen) == []


@pytest.mark.parametrize("share", [0.1, 0.2])
def test_many_wrong_places_do_not_pass_for_long_bones(share):
    points, seen = walk(60)
    wrong = torch.rand(seen.shape, generator=torch.Generator().manual_seed(0)) < share
    points[wrong] = torch.tensor([4000.0, -3000.0]).double()
    kept = plausible(points, seen, BODY)
    assert not (kept & wrong).any() and float(kept[~wrong].double().mean()) > 0.9


@pytest.mark.parametrize(("share", "most"), [(0.1, 18), (0.2, 22)])
def test_a_fifth_of_all_joints_may_be_anywhere(share, most):
    """mm; without wrong joints the walk is 12 mm off."""
    clip = walking_person(60, yaw=60.0, turn=0.0)
    points, chance = clip.tracks.points.clone(), torch.Generator().manual_seed(1)
    wrong = torch.rand(points.shape[:2], generator=chance) < share
    points[wrong] = 6000 * torch.rand(int(wrong.sum()), 2, generator=chance, dtype=points.dtype) - 3000
    found = kt.reconstruct(replace(clip.tracks, points=points))
    assert float((superpose(found.points, clip.points, "rigid") - clip.points).norm(dim=-1).mean()) < most
    assert share > MANY


# ------------------------------------------------------------------------------ frames that only repeat


def held(points, every):
    return points[torch.arange(len(points)) // every * every]


@pytest.mark.parametrize("every", [2, 3, HELD + 1])
def test_frames_of_a_slower_camera_repeat(every):
    points, seen = walk(42)
    same = repeats(held(points, every), seen)
    assert torch.equal(same, torch.arange(42) % every != 0)
    seen[:, 3] = False  # of which there is nothing to compare
    assert torch.equal(repeats(held(points, every), seen), same)


def test_what_does_not_repeat_as_a_slower_camera_does():
    points, seen = walk(42)
    assert not repeats(points, seen).any()
    for frames in (8, 12, 24):  # somebody who stops, by the least jerk
        time = (torch.arange(42).double() / frames).clamp_max(1)[:, None, None]
        stops = points[:1] + (points[20:21] - points[:1]) * time**3 * (10 - 15 * time + 6 * time**2)
        assert not repeats(stops, seen).any()
        assert not repeats(stops.round(), seen).any()
    assert not repeats(torch.cat([points[:1], points[:-1]]), seen).any()  # once
    assert not repeats(points[:1].expand(42, -1, -1), seen).any()  # who stands
    rounded = (points[:1] + 0.2 * torch.arange(42)[:, None, None] / 42).round()  # and hardly moves, in whole pixels
    assert not repeats(rounded, seen).any()
    assert not repeats(points, torch.zeros_like(seen)).any()


@pytest.mark.parametrize("first", [21, 12], ids=["at the end", "amid the clip"])
def test_a_detector_that_has_lost_the_body_repeats(first):
    points, seen = walk(42)
    frozen = (first <= torch.arange(42)) & (torch.arange(42) < first + 21)
    for every in (1, 2):  # it was slow before
        some = held(points, every).clone()
        some[frozen] = some[first - 1].clone()
        slow = ~frozen & (torch.arange(42) % every != 0)
        slow[first + 21 :][:1] = False  # the body is found anew
        assert torch.equal(repeats(some, seen), frozen | slow)


def test_a_clip_padded_with_its_last_pose_stands_there():
    points, seen = walk(84)
    for padded, left_out in ((10, False), (21, True)):
        some = points.clone()
        some[-padded:] = some[-padded - 1].clone()
        same = (torch.arange(84) >= 84 - padded) if left_out else torch.zeros(84, dtype=torch.bool)
        assert torch.equal(repeats(some, seen), same)


def test_frozen_frames_do_not_make_a_noisy_clip_exact():
    clip = walking_person(80, yaw=60.0, turn=0.0)
    points = clip.tracks.points + 8 * torch.randn(80, 17, 2, generator=torch.Generator().manual_seed(0)).double()
    points[40:] = points[39]
    result = kt.reconstruct(replace(clip.tracks, points=points))
    assert any(note.startswith("tracks smoothed") for note in result.diagnostics.notes)


def test_frames_that_repeat_show_nothing():
    clip = walking_person(60, yaw=60.0, turn=0.0)
    stuttering = replace(clip.tracks, points=held(clip.tracks.points, 2))
    assert "30 of 60 (50 %) frames repeat the one before" in without_repeats(stuttering).notes[-1]
    error = {}
    for name, tracks in (("smooth", clip.tracks), ("stuttering", stuttering)):
        found = kt.reconstruct(tracks)
        error[name] = float((superpose(found.points, clip.points, "rigid") - clip.points).norm(dim=-1).mean())
    assert error["stuttering"] < error["smooth"] + 6  # mm
    assert any("repeat the one before" in note for note in found.diagnostics.notes + found.tracks.notes)


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


def cut_off(points, at=0.1):
    """Points below a line put onto it, and which those are; the upper body stays."""
    low = points[..., 1].quantile(1 - at)
    return torch.cat([points[..., :1], points[..., 1:].clamp_max(low)], -1), points[..., 1] >= low


@pytest.mark.parametrize("grid", [0, 1], ids=["fine", "whole pixels"])
@pytest.mark.parametrize("turn", [False, True])
def test_joints_on_the_border_are_found(grid, turn):
    points, seen = walk(60)
    points = points / 3 + 5 * torch.arange(60)[:, None, None]  # who walks through the image
    points, out = cut_off(points.round() if grid else points)
    if turn:
        points = -points.flip(-1)
    assert torch.equal(at_border(points, seen), out)
    seen[:, ANKLE] = False
    assert torch.equal(at_border(points, seen), out & seen)


def test_what_is_no_border():
    points, seen = walk(60)
    for some in (points, (points / 3).round(), (points[:1] / 3).round().expand(60, -1, -1), points * 0, points[:0]):
        assert not at_border(some, seen[: len(some)]).any()
    assert not at_border(torch.stack([points[..., 0], 0 * points[..., 0]], -1), seen).any()  # all on one line
    floor = points.clone()
    floor[10:50, ANKLE, 1] = floor[..., 1].max() + 1  # a foot that slides over it
    assert at_border(floor, seen).any()
    assert not at_border(floor, seen, [ANKLE]).any()
    rail = points.clone()
    rail[:, WRIST, 1] = rail[..., 1].max() + 1  # on which a hand slides
    low, high = points.amin(1, keepdim=True), points.amax(1, keepdim=True)
    boxed = (points - low) / (high - low).amax(-1, keepdim=True)  # each frame scaled to a box
    for some in (rail, boxed):
        assert not at_border(some, seen).any()


def test_joints_on_the_border_are_as_good_as_unseen():
    clip = walking_person(60, yaw=20.0, turn=0.0)
    rising = clip.tracks.points - 600 * torch.linspace(0, 1, 60)[:, None, None] * torch.tensor([0, 1])
    points, out = cut_off(rising, 0.2)
    tracks = replace(clip.tracks, points=points)
    assert without_border(clip.tracks) is clip.tracks
    nobody = replace(tracks, weights=tracks.weights * out)  # then there is nothing else
    assert without_border(nobody) is nobody
    with pytest.warns(kt.KcsWarning, match="never seen.*: right_ankle, left_ankle$"):
        result = kt.reconstruct(tracks)
    said = f"{int(out.sum())} of 1020 (20 %) detections lie on the image's border"
    assert any(note.startswith(said) for note in result.tracks.notes)
    assert float(kt.metrics.mpjpe(result.points, clip.points, align="rigid")) < 60  # mm; 129 where they count


# ------------------------------------------------------------------------------ joints that repeat others


def test_joints_exactly_where_another_is_are_none():
    points, seen = walk()
    assert doubled(points, seen, BODY) == []
    points[:, KNEE] = points[:, HIP]
    assert doubled(points, seen, BODY) == [KNEE]
    points[3, KNEE] += 1
    assert doubled(points, seen, BODY) == []
    seen[3, KNEE] = False  # nobody sees it there
    assert doubled(points, seen, BODY) == [KNEE]
    assert doubled(points, seen, replace(BODY, template=None)) == []
    assert doubled(0 * points, seen, BODY) == doubled(points[:0], seen[:0], BODY) == []
    seen[SELDOM - 1 :, KNEE] = False
    assert doubled(points, seen, BODY) == []


def test_joints_that_meet_in_few_frames_stay():
    points, seen = walk()
    right = BODY.joints.index("right_ankle")
    seen[4:, right] = False
    points[:4, right] = points[:4, ANKLE]
    assert doubled(points, seen, BODY) == [right]  # which shows nothing else
    seen[:, right] = True
    assert doubled(points, seen, BODY) == []
    small = (points / 40).round()  # whole pixels of a body of 40
    small[:, right] = small[:, ANKLE]
    assert doubled(small, seen, BODY) == []


def test_joints_are_compared_in_the_frames_that_show_most():
    points, seen = walk(80)
    points[:, KNEE], seen[:40] = points[:, HIP], False
    assert doubled(points, seen, BODY) == [KNEE]


def test_of_a_left_and_a_right_joint_in_one_place_neither_is_sure():
    points, seen = walk()
    right = BODY.joints.index("right_hip")
    points[:, right] = points[:, HIP]
    assert doubled(points, seen, BODY) == sorted([HIP, right])


def test_a_knee_where_the_hip_is_counts_as_never_seen():
    clip = walking_person(60, yaw=30.0, turn=0.0)
    assert without_doubled(clip.tracks) is clip.tracks
    points = clip.tracks.points.clone()
    points[:, KNEE] = points[:, HIP]
    with pytest.warns(kt.KcsWarning, match="never seen, so placed by the skeleton alone: left_knee"):
        result = kt.reconstruct(replace(clip.tracks, points=points))
    assert any(note.startswith("left_knee: exactly where another joint is") for note in result.tracks.notes)
    others = [joint for joint in range(17) if joint != KNEE]
    assert float(kt.metrics.mpjpe(result.points[:, others], clip.points[:, others], align="rigid")) < 40
