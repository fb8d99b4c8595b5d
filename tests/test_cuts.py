"""Cuts of a film: found, told, and what lies between them solved by itself."""

from dataclasses import replace
from functools import partial

import pytest
import torch
from near_cameras import error, filmed, quietly
from samples import walk_result

import kcs_torch as kt
from kcs_torch.clean import split
from kcs_torch.clean.timing import cuts_of
from kcs_torch.data import walking_person
from kcs_torch.solvers.cuts import find_cuts

NONE = torch.zeros(0, 2, dtype=torch.long)


def film(*yaws, frames=24):
    """Shots of one walk from several sides, one after another; the truth of each."""
    clips = [walking_person(frames, yaw=yaw, turn=0.0) for yaw in yaws]
    points, weights = (torch.cat([getattr(c.tracks, name) for c in clips]) for name in ("points", "weights"))
    return replace(clips[0].tracks, points=points, weights=weights), clips


@pytest.mark.parametrize("yaws", [(0.0, 90.0), (0.0, 110.0, 40.0), (45.0, 135.0), (0.0, 0.0)])
def test_shots_from_other_sides_are_found(yaws):
    tracks, _ = film(*yaws)
    cuts = [24 * k for k in range(1, len(yaws)) if yaws[k] != yaws[k - 1]]
    assert cuts_of(tracks) == cuts
    assert [one.num_frames for one in split(tracks)] == [24] * len(yaws) if cuts else [48]


def test_a_clip_without_a_cut_is_left_as_it_is():
    tracks = walking_person(60, turn=360.0).tracks
    assert split(tracks) == [tracks]


@pytest.mark.parametrize("fps", [1.5, 3.0, 10.0])
def test_few_frames_a_second_are_no_cuts(fps):
    assert cuts_of(walking_person(40, fps=fps, turn=180.0).tracks) == []


def test_noise_gaps_and_wrong_frames_are_no_cuts():
    draw = torch.Generator().manual_seed(0)
    clip = walking_person(60, turn=0.0, noise=30.0, missing=0.4, generator=draw).tracks
    assert cuts_of(clip) == []
    points = clip.points.clone()
    points[30] = points[30] * torch.tensor([-1.0, 1.0]) + 300 * torch.randn(17, 2, generator=draw)
    assert cuts_of(replace(clip, points=points)) == []
    assert find_cuts(torch.zeros(30, 8, 2), torch.ones(30, 8, dtype=torch.bool), NONE) == []


@pytest.mark.parametrize("share", [0.1, 0.2, 0.3, 0.4])
def test_joints_that_come_and_go_are_no_cuts(share):
    """Neither moves the body's middle, nor do sides alone tell how far a body moved that few joints show."""
    for seed, yaw in enumerate((0.0, 60.0, 120.0)):
        tracks = walking_person(120, skeleton="coco17", yaw=yaw, turn=0.0).tracks
        draw = torch.Generator().manual_seed(seed)
        gone = torch.rand(tracks.weights.shape, generator=draw) < share
        assert cuts_of(replace(tracks, weights=torch.where(gone, 0, tracks.weights))) == []


def test_cuts_are_found_where_joints_come_and_go():
    tracks, _ = film(0.0, 90.0)
    found = 0
    for seed in range(8):
        gone = torch.rand(tracks.weights.shape, generator=torch.Generator().manual_seed(seed)) < 0.15
        found += cuts_of(replace(tracks, weights=torch.where(gone, 0, tracks.weights))) == [24]
    assert found >= 6


def test_sides_that_a_detector_takes_for_each_other_are_no_cut():
    tracks = walking_person(40, yaw=0.0, turn=0.0).tracks
    points = tracks.points.clone()
    left, right = torch.tensor(tracks.skeleton.mirror).unbind(1)
    points[20:, left], points[20:, right] = tracks.points[20:, right], tracks.points[20:, left]
    seen = torch.ones(40, 17, dtype=torch.bool)
    assert find_cuts(points, seen, torch.tensor(tracks.skeleton.mirror)) == []
    assert find_cuts(points, seen, NONE) == [20]


@pytest.mark.parametrize("frames", [0, 1, 3, 7])
def test_too_few_frames_tell_no_cut(frames):
    assert find_cuts(torch.randn(frames, 8, 2), torch.ones(frames, 8, dtype=torch.bool), NONE) == []


def test_a_cut_near_an_end_may_be_a_wrong_frame():
    tracks, _ = film(0.0, 90.0)
    assert cuts_of(tracks.frames(21, 40)) == []
    assert cuts_of(tracks.frames(20, 40)) == [4]
    assert cuts_of(tracks.frames(0, 28)) == [24]
    assert cuts_of(tracks.frames(0, 27)) == []


def test_a_gap_between_shots_is_left_to_it():
    """Nobody knows how far a body moves while it is not seen."""
    tracks, _ = film(0.0, 90.0)
    weights = tracks.weights.clone()
    weights[24] = 0
    assert cuts_of(replace(tracks, weights=weights)) == []


def leaping(frames=60, away=slice(20, 40), by=(900.0, 300.0)):
    """A walk whose tracks leap, as those of a tracker that takes another person for the same."""
    tracks = walking_person(frames, yaw=30.0, turn=0.0).tracks
    points = tracks.points.clone()
    points[away] += points.new_tensor(by)
    return replace(tracks, points=points)


def test_a_body_that_leaps_is_a_cut():
    assert cuts_of(leaping()) == [20, 40]
    assert cuts_of(leaping(by=(60.0, 0.0))) == []
    assert cuts_of(leaping(away=slice(20, 22), by=(1800.0, 300.0))) == []  # frames of somebody else, and back
    gap = leaping(by=(1800.0, 300.0))
    gap.weights[18:20] = 0  # over a gap it moves as far in three frames
    assert cuts_of(gap) == [20, 40]
    gap.weights[10:20] = 0
    assert cuts_of(gap) == [40]


def test_frames_of_a_body_that_leaps_are_kept_under_perspective():
    """The virtual camera looks after it; what is left out of the image is told of, and nothing but that."""
    flat = leaping().points / 4 + 500
    tracks = kt.Tracks.from_arrays(flat, skeleton="h36m17", fps=30)
    with pytest.warns(kt.KcsWarning, match="the view jumps at frame 20, 40"):
        found = kt.reconstruct(tracks, intrinsics=(1000, 1000, 500, 500))
    assert found.diagnostics.unseen_share == 0 and found.diagnostics.reprojection_rms < 2


def test_a_cut_is_told_and_shots_of_one_body_tell_more_together():
    tracks, clips = film(0.0, 100.0, frames=30)
    with pytest.warns(kt.KcsWarning, match=r"the view jumps at frame 30, as at a cut of a film.*kt\.clean\.split"):
        both = kt.reconstruct(tracks)
    shots = kt.reconstruct_all(split(tracks))
    parts = (both.points[:30], both.points[30:], *(shot.points for shot in shots))
    wrong = [float(kt.metrics.e3d(part, clip.points)) for part, clip in zip(parts, clips * 2, strict=True)]
    assert wrong[0] + wrong[1] < wrong[2] + wrong[3]


def test_a_cut_is_told_under_perspective_too():
    tracks, _ = film(0.0, 100.0, frames=20)
    moved = replace(tracks, points=tracks.points / 4 + 500, units="px")
    unsettled = pytest.warns(kt.ConvergenceWarning, match="kcs did not settle")  # across a cut
    with unsettled, pytest.warns(kt.KcsWarning, match="the view jumps at frame 20"):
        kt.reconstruct(moved, method="kcs", intrinsics=(1000, 1000, 500, 500))


def test_shots_before_a_near_camera_share_its_lens():
    """Each at a distance of its own; under parallel rays, 30 to 60 mm off, no more than a rotation tells them apart."""
    shots = [filmed(nearest, frames=20, yaw=yaw) for nearest, yaw in ((2500.0, 30), (5000.0, 110))]
    points = torch.cat([tracks.points for tracks, _ in shots])
    found = quietly(kt.Tracks.from_arrays(points, skeleton="h36m17", fps=30.0, image_size=(1920, 1080)))
    assert found.intrinsics is not None
    assert sum("the view jumps at frame 20" in note for note in found.diagnostics.notes) == 1
    truth = torch.cat([x for _, x in shots])
    ratio, true = (z[20:].mean() / z[:20].mean() for z in (found.distance, truth[..., 2]))
    assert abs(float(ratio / true) - 1) < 0.1
    assert [error(part, x) < 20 for part, (_, x) in zip(found.points.split(20), shots, strict=True)] == [True, True]


def test_a_lens_that_is_asked_for_is_found_in_several_shots():
    shots = [filmed(2500.0, frames=20, yaw=yaw)[0].points for yaw in (30, 110)]
    tracks = kt.Tracks.from_arrays(torch.cat(shots), skeleton="h36m17", fps=30.0, units="mm")  # no image
    found = quietly(tracks, intrinsics="auto")
    assert found.intrinsics is not None and abs(found.intrinsics.fx / 1500 - 1) < 0.3
    assert quietly(tracks).intrinsics is None


@pytest.mark.parametrize("side", ["left", "right"])
def test_a_cut_is_found_where_one_side_is_hidden(side):
    """Compared with its own mirror image hardly any joint is left there."""
    clip, _ = film(90.0, 30.0)
    weights = clip.weights.clone()
    weights[:, [i for i, name in enumerate(clip.skeleton.joints) if name.startswith(side)]] = 0
    assert cuts_of(replace(clip, weights=weights)) == [24]


def test_a_cut_is_no_swap_of_sides():
    tracks, _ = film(20.0, 120.0, -60.0)
    assert kt.clean.unswap(tracks) is tracks


def gappy(tracks):
    """The same with gaps of two frames within the shots, and before the cut at frame 24."""
    weights = tracks.weights.clone()
    weights[10:12, 9] = weights[30:32, 9] = weights[22:24, 13] = 0
    return replace(tracks, weights=weights, points=torch.where(weights[..., None] > 0, tracks.points, 0))


CLEANED = {
    "gate": kt.clean.gate,
    **{name: partial(kt.clean.smooth, method=name, cutoff=3.0) for name in kt.clean.SMOOTHERS},
    "fill": partial(kt.clean.fill, longest=4),
    "fill linearly": partial(kt.clean.fill, longest=4, kind="linear"),
    "resample": partial(kt.clean.resample, fps=15.0),  # half the frames: both shots begin with one that stays
}


@pytest.mark.parametrize("name", CLEANED)
@pytest.mark.parametrize("larger", [1.0, 4.0])
def test_shots_are_cleaned_as_by_themselves(name, larger):
    tracks, _ = film(0.0, 90.0)
    points = tracks.points.clone()
    points[24:] *= larger
    points[[5, 40], 3] += 300.0
    tracks = gappy(replace(tracks, points=points))
    clean = CLEANED[name]
    parts = [clean(shot) for shot in split(tracks)]
    together = clean(tracks)
    assert cuts_of(together) == [parts[0].num_frames]
    for what in ("points", "weights"):
        torch.testing.assert_close(getattr(together, what), torch.cat([getattr(part, what) for part in parts]))


@pytest.mark.parametrize("fps", [20.0, 24.0, 25.0, 50.0, 60.0, 90.0, 120.0])
@pytest.mark.parametrize("kind", ["cubic", "linear"])
def test_new_frames_between_shots_show_the_nearer_one(fps, kind):
    tracks, _ = film(0.0, 90.0)
    new = kt.clean.resample(tracks, fps, kind=kind)
    place = torch.arange(new.num_frames).double() * 30 / fps
    (cut,) = cuts_of(new)
    assert bool(new.seen.all()) and place[cut - 1] < 23.5 <= place[cut]
    between = (place > 23) & (place < 24)
    nearer = torch.where(place[between] < 23.5, 23, 24)
    torch.testing.assert_close(new.points[between], tracks.points[nearer])


def test_a_smoothed_result_keeps_its_shots_apart():
    tracks, clips = film(0.0, 90.0)
    truth = torch.cat([clip.points for clip in clips])
    body = replace(walk_result(48, skeleton="h36m17"), tracks=tracks, points=truth)
    path = torch.cat([torch.full((24,), 1000.0), torch.full((24,), 2000.0)]).double()
    smoothed = kt.clean.smooth(replace(body, root_depth=path), cutoff=6.0)
    parts = [kt.clean.smooth(shot, cutoff=6.0).points for shot in split(tracks)]
    torch.testing.assert_close(smoothed.points[..., :2], torch.cat(parts))
    torch.testing.assert_close(smoothed.root_depth, path)
    short = kt.clean.smooth(replace(body, root_depth=path), "savgol", cutoff=1.0)
    torch.testing.assert_close(short.points, truth)
    assert "; 816 of 816 (100 %) points, in runs of fewer than" in short.diagnostics.notes[-1]


@pytest.mark.parametrize("larger", [1.0, 10.0])
def test_sides_are_told_by_the_size_of_their_shot(larger):
    """Where a close-up follows, the smaller body's size, or the larger one's steps, told of the other."""
    draw = torch.Generator().manual_seed(0)
    clips = [walking_person(60, yaw=yaw, turn=0.0, noise=20.0, generator=draw).tracks for yaw in (30.0, 90.0)]
    true = torch.cat([clips[0].points, larger * clips[1].points])
    left, right = torch.tensor(clips[0].skeleton.mirror).unbind(1)
    points = true.clone()
    for frames in (slice(20, 24), slice(70, 75)):
        points[frames, left], points[frames, right] = true[frames, right], true[frames, left]
    tracks = replace(clips[0], points=points, weights=torch.ones(120, 17).double())
    torch.testing.assert_close(kt.clean.unswap(tracks).points, true)


def test_shots_of_other_sizes_are_solved_together():
    tracks, clips = film(0.0, 100.0, frames=30)
    points = tracks.points.clone()
    points[30:] *= 1.5
    with pytest.warns(kt.KcsWarning, match="the view jumps at frame 30"):
        both = kt.reconstruct(replace(tracks, points=points))
    ratio = float(both.scales[30:].mean() / both.scales[:30].mean())
    assert 1.44 < ratio < 1.56
    assert both.distance is None
    for part, clip in zip((both.points[:30], both.points[30:]), clips, strict=True):
        assert float(kt.metrics.mpjpe(part, clip.points, align="similarity")) < 40


@pytest.mark.parametrize("share", [0.1, 0.2])
def test_joints_at_wrong_places_are_no_cut(share):
    for seed in range(5):
        chance = torch.Generator().manual_seed(seed)
        points = walking_person(60, yaw=60.0, turn=0.0).tracks.points.clone()
        wrong = torch.rand(points.shape[:2], generator=chance) < share
        points[wrong] = 6000 * torch.rand(int(wrong.sum()), 2, generator=chance, dtype=points.dtype) - 3000
        assert cuts_of(kt.Tracks.from_arrays(points, skeleton="h36m17")) == []
