"""Gaps in which nobody is seen for long are solved as short ones."""

from dataclasses import replace

import pytest
import torch
from near_cameras import LENS, filmed
from torch.testing import assert_close

import kcs_torch as kt
from kcs_torch.data import walking_person
from kcs_torch.functional import superpose
from kcs_torch.methods.perspective.scene import Scene
from kcs_torch.methods.pkc.long_gaps import shortened


def hidden(tracks, *gaps):
    weights = tracks.weights.clone()
    for gap in gaps:
        weights[gap] = 0
    return replace(tracks, weights=weights)


@pytest.fixture(scope="module")
def walk():
    return walking_person(90, turn=0.0, yaw=40.0)


def test_frames_that_are_solved(walk):
    tracks = replace(walk.tracks, fps=30.0)
    assert shortened(tracks) is None
    assert shortened(hidden(tracks, slice(0, 1), slice(82, 90))).tolist() == list(range(1, 82))
    assert shortened(hidden(tracks, slice(0, 90))) is None  # nobody is there at all
    assert shortened(hidden(tracks, slice(0, 5), slice(60, 90))).tolist() == list(range(5, 60))
    assert shortened(hidden(tracks, slice(0, 30), slice(31, 90))).tolist() == [30]
    assert shortened(hidden(tracks, slice(20, 28))) is None  # as long as a gap may be
    kept = shortened(hidden(tracks, slice(20, 60), slice(70, 73)))
    assert kept.tolist()[:20] == list(range(20)) and kept.tolist()[-30:] == list(range(60, 90))
    assert len(kept) == 58 and bool((kept.diff() > 0).all()) and int(kept.diff().amax()) <= 5
    assert len(shortened(replace(hidden(tracks, slice(20, 60)), fps=60.0))) == 65


def test_long_gap_of_a_synthetic_walk(walk):
    """Frames beside it are right, and nothing is sure in its middle."""
    tracks = hidden(walk.tracks, slice(25, 65))
    result = kt.reconstruct(tracks, intrinsics="parallel")
    assert result.points.shape == walk.points.shape and bool(torch.isfinite(result.points).all())
    seen = tracks.seen.any(-1)
    there, truth = result.points[seen], walk.points[seen] - walk.points[seen].mean(1, keepdim=True)
    off = (superpose(there, truth, "rigid") - truth).norm(dim=-1).mean()
    assert off < 0.05 * truth.square().mean().sqrt()
    assert result.uncertainty[45].amin() > 2 * result.uncertainty[seen].median()
    assert len(result.cameras) == 90
    assert_close(result.cameras @ result.cameras.mT, torch.eye(2).double().expand(90, 2, 2), rtol=0, atol=1e-8)


@pytest.mark.parametrize("intrinsics", ["parallel", None])
def test_who_comes_and_goes_is_solved_while_seen(walk, intrinsics):
    """Each frame in which nobody is seen took as long as another, of dozens of people in a long film."""
    some = walk.tracks.frames(30, 60)
    alone = kt.reconstruct(some, intrinsics=intrinsics)
    result = kt.reconstruct(hidden(walk.tracks, slice(0, 30), slice(60, 90)), intrinsics=intrinsics)
    assert_close(result.points[30:60], alone.points, rtol=1e-4, atol=0.5)  # mm
    assert_close(result.points[:30], result.points[30:31].expand(30, -1, -1), rtol=0, atol=1e-6)
    assert_close(result.points[60:], result.points[59:60].expand(30, -1, -1), rtol=0, atol=1e-6)
    assert result.uncertainty[:30].median() > result.uncertainty[30:60].median()
    assert "60 frames at the clip's ends show nobody: nearest pose held" in result.diagnostics.notes


def test_few_frames_without_the_body_at_the_ends_change_nothing(walk):
    """They were taken for frames in which it stands still."""
    some = walk.tracks.frames(30, 60)
    result = kt.reconstruct(hidden(walk.tracks.frames(28, 63), slice(0, 2), slice(32, 35)), intrinsics="parallel")
    alone = kt.reconstruct(some, intrinsics="parallel")
    assert_close(result.points[2:32], alone.points, rtol=1e-4, atol=0.5)  # mm


@pytest.mark.filterwarnings("ignore::kcs_torch.KcsWarning")
def test_who_is_seen_in_one_frame_is_an_image(walk):
    result = kt.reconstruct(hidden(walk.tracks, slice(0, 40), slice(41, 90)), intrinsics="parallel")
    alone = kt.reconstruct(walk.tracks.frames(40, 41), intrinsics="parallel")
    assert_close(result.points[40:41], alone.points, rtol=1e-4, atol=0.5)
    assert bool(result.points.isfinite().all()) and result.points.shape == walk.points.shape


def test_no_detection_beside_a_long_gap_is_an_outlier(walk):
    """Tracks are cleaned by their own time: in a gap made shorter all joints leap."""
    tracks = hidden(walk.tracks, slice(40, 60))
    result = kt.reconstruct(tracks, intrinsics="parallel")
    assert not any("outlier" in note for note in result.diagnostics.notes)


def test_cameras_that_are_known_go_with_their_frames():
    clip = walking_person(80, turn=120.0)
    tracks = hidden(clip.tracks, slice(25, 55))
    result = kt.reconstruct(tracks, cameras=clip.cameras)
    assert_close(result.cameras.abs(), clip.cameras[:, :2].abs(), rtol=0, atol=1e-12)


@pytest.mark.filterwarnings("ignore::kcs_torch.errors.KcsWarning", "ignore::kcs_torch.errors.ConvergenceWarning")
def test_frames_beside_a_long_gap_are_not_led_astray(shared):
    """Two walks, a near camera and noise of two pixels: 74 and 81 mm where all of the gap is solved, 17 and 25 so."""
    motion = kt.load_motion(shared / "data" / "cmu" / "cmu_07_02.npz", up="y")
    motion = motion.frames(0, 150 * max(1, round(motion.fps / 30)), max(1, round(motion.fps / 30)))
    for yaw in (30, 120):
        film = {"yaw": yaw, "pitch": 10, "intrinsics": (1000, 1000, 640, 360), "distance": 4500.0, "noise": 2.0}
        middle = (motion.num_frames - 40) // 2
        tracks = motion.tracks(**film, generator=torch.Generator().manual_seed(1))
        tracks = hidden(tracks, slice(middle, middle + 40))
        seen, truth = tracks.seen.any(-1), motion.in_camera(yaw=yaw, pitch=10)
        found = kt.reconstruct(tracks).points[seen, : truth.shape[1]]
        assert (superpose(found, truth[seen], "similarity") - truth[seen]).norm(dim=-1).mean() < 40


@pytest.mark.parametrize("cameras", [None, torch.eye(3)[None, :2].double()])
def test_a_single_image_is_solved_as_two_of_the_same(cameras):
    clip = kt.data.walking_person(40, yaw=40.0, noise=8.0, generator=torch.Generator().manual_seed(0)).tracks
    one = clip.frames(20, 21)
    two = replace(one, points=one.points.repeat(2, 1, 1), weights=one.weights.repeat(2, 1))
    ours, theirs = (
        kt.reconstruct(
            t,
            method="pkc",
            intrinsics="parallel",
            cameras=None if cameras is None else cameras.repeat(t.num_frames, 1, 1),
        )
        for t in (one, two)
    )
    torch.testing.assert_close(ours.points, theirs.points[:1])
    torch.testing.assert_close(ours.uncertainty, theirs.uncertainty[:1])
    assert len(ours.alternatives) == len(theirs.alternatives) > 0
    assert all(other.points.shape == (1, 17, 3) and other.cameras.shape == (1, 2, 3) for other in ours.alternatives)


@pytest.mark.filterwarnings("ignore::kcs_torch.KcsWarning")
@pytest.mark.parametrize("gaps", [(slice(0, 40), slice(80, 120)), (slice(40, 90),)], ids=["ends", "between"])
def test_the_lens_is_found_by_what_is_seen(monkeypatch, gaps):
    """A body that is held while nobody is seen would make the focal length a quarter too short; in gaps it walks on."""
    tracks = replace(filmed(frames=120)[0], image_size=(1920, 1080))
    refined, lengths = Scene.refined, set()

    def counted(scene, *arguments, **options):
        lengths.add(len(scene.rays))
        return refined(scene, *arguments, **options)

    monkeypatch.setattr(Scene, "refined", counted)
    result = kt.reconstruct(hidden(tracks, *gaps))
    assert lengths == {40 if len(gaps) > 1 else 120}
    assert 0.85 < result.intrinsics.fx / LENS[0] < 1.1
    if len(gaps) > 1:
        alone = kt.reconstruct(tracks.frames(40, 80))
        assert result.intrinsics.fx == pytest.approx(alone.intrinsics.fx, rel=0.05)
        place, known = result.in_space() / result.intrinsics.fx, alone.in_space() / alone.intrinsics.fx
        assert_close(place[40:80], known, rtol=0, atol=0.02)  # of a body of .8 or so
        assert_close(place[:40] - place[40], place.new_zeros(40, 17, 3), rtol=0, atol=0.05)
