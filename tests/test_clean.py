"""Cleaning: what is changed, what is left alone, and what is told of it."""

import math
from dataclasses import replace

import numpy as np
import pytest
import scipy.interpolate
import scipy.signal
import torch
from hypothesis import given, reject, settings
from hypothesis import strategies as st

import kcs_torch as kt
from kcs_torch.clean import gating
from kcs_torch.clean.common import runs
from kcs_torch.clean.detector import detected
from kcs_torch.data.synthetic import walking_person
from kcs_torch.functional import bone_lengths
from kcs_torch.types.tracks import unseen_notes

FPS = 50.0
FRAMES = 400


def tracks_of(points, weights=None, **options):
    """Tracks without bones of an array (T, N, 2)."""
    return kt.Tracks.from_arrays(points, weights, fps=options.pop("fps", FPS), threshold=0.0, **options)


def sine(hertz, frames=FRAMES, fps=FPS, joints=3):
    """Joints that swing at one frequency, each with its own amplitude: (T, N, 2)."""
    time = np.arange(frames) / fps
    wave = np.stack([np.sin(2 * np.pi * hertz * time), np.cos(2 * np.pi * hertz * time)], -1)
    return 100 + wave[:, None] * (10 * np.arange(1, joints + 1))[:, None]


@pytest.fixture(scope="module")
def walk():
    """A walk seen by a detector with virtual joints, with noise."""
    generator = torch.Generator().manual_seed(3)
    return walking_person(90, skeleton="coco17", noise=3.0, generator=generator).tracks


def change(before, after):
    """Root mean square distance between joints that both see."""
    both = before.seen & after.seen
    return float((after.points - before.points).square().sum(-1)[both].mean().sqrt())


# ---------------------------------------------------------------------- smooth


@pytest.mark.parametrize("method", kt.clean.SMOOTHERS)
def test_smooth_leaves_what_stands_still(method):
    still = np.broadcast_to(np.array([[3.0, 4.0], [-5.0, 6.0]]), (60, 2, 2))
    smoothed = kt.clean.smooth(tracks_of(still), method, 5.0)
    np.testing.assert_allclose(smoothed.points, still, atol=1e-10)


@pytest.mark.parametrize(
    ("hertz", "gain"),
    [(0.25, 1.0), (6.0, math.sqrt(0.5)), (20.0, 0.0)],
)
def test_butterworth_has_the_gain_it_promises(hertz, gain):
    tracks = tracks_of(sine(hertz))
    smoothed = kt.clean.smooth(tracks, "butterworth", 6.0)
    inside = slice(80, -80)  # far from the ends
    expected = 100 + gain * (sine(hertz) - 100)
    np.testing.assert_allclose(smoothed.points[inside], expected[inside], atol=0.05)


@pytest.mark.parametrize("method", ["butterworth", "savgol"])
def test_offline_smoothers_do_not_lag(method):
    pulse = np.zeros((101, 2, 2))
    pulse[50] = 1.0
    out = kt.clean.smooth(tracks_of(pulse), method, 6.0).points.numpy()
    assert out[:, 0, 0].argmax() == 50
    np.testing.assert_allclose(out[30:71], out[30:71][::-1], atol=1e-9)


def test_one_euro_lags_and_follows_fast_motion():
    step = np.zeros((80, 2, 2))
    step[40:, 0] = 100.0
    step[:, 1] = np.arange(80)[:, None] * 1e-3
    slow = kt.clean.smooth(tracks_of(step), "one-euro", 1.0).points.numpy()
    assert np.all(slow[:40, 0] == 0)  # causal
    assert np.all(np.diff(slow[40:, 0, 0]) >= 0) and slow[-1, 0, 0] > 99
    plain = 1 - (1 - 1 / (1 + FPS / (2 * np.pi))) ** 5  # the same cut-off without its rise by speed
    assert slow[44, 0, 0] > 1.5 * 100 * plain


def test_even_weights_give_scipys_filter():
    points = np.random.default_rng(0).normal(size=(FRAMES, 3, 2)).cumsum(0)
    # The corner of each pass, so that both together are 3 dB down at 6 Hz, as Winter's textbook corrects it.
    corner = math.atan(math.tan(math.pi * 6 / FPS) / (math.sqrt(2) - 1) ** 0.25) / math.pi * FPS
    b, a = scipy.signal.butter(2, corner, fs=FPS)
    expected = scipy.signal.filtfilt(b, a, points, axis=0, padlen=9)
    for weights in (None, np.full((FRAMES, 3), 0.4)):
        got = kt.clean.smooth(tracks_of(points, weights), "butterworth", 6.0).points
        np.testing.assert_allclose(got, expected, atol=1e-8)


def test_savgol_is_scipys_and_its_gain_at_the_cutoff_is_near_3_db():
    points = np.random.default_rng(1).normal(size=(FRAMES, 3, 2)).cumsum(0)
    smoothed = kt.clean.smooth(tracks_of(points), "savgol", 5.0)
    window = int(smoothed.notes[-1].split("over ")[1].split()[0])
    np.testing.assert_allclose(smoothed.points, scipy.signal.savgol_filter(points, window, 3, axis=0), atol=1e-9)
    _, response = scipy.signal.freqz(scipy.signal.savgol_coeffs(window, 3), worN=[5.0], fs=FPS)
    assert abs(response[0]) == pytest.approx(math.sqrt(0.5), abs=0.12)


@pytest.mark.parametrize("cutoff", [0.05, 0.3, 1.0, 2.0, 5.0, 9.0, 12.0])
def test_savgol_takes_the_window_whose_gain_is_nearest(cutoff):
    note = kt.clean.smooth(tracks_of(sine(1.0)), "savgol", cutoff).notes[-1]
    window = int(note.split("over ")[1].split()[0])
    windows = range(5, 2 * round(3 * FPS / cutoff) + 9, 2 if cutoff > 0.3 else 40)

    def miss(length):
        _, response = scipy.signal.freqz(scipy.signal.savgol_coeffs(length, 3), worN=[cutoff], fs=FPS)
        return abs(abs(response[0]) - math.sqrt(0.5))

    assert miss(window) <= min(miss(length) for length in windows) + 1e-9


@pytest.mark.parametrize("cutoff", [0.004, 1e-6, 1e-300])
def test_savgol_refuses_windows_that_are_no_cubics_or_fill_the_memory(cutoff):
    with pytest.raises(kt.errors.OptionError, match=r"smooth: cutoff: expected at least 0\.0044 Hz for savgol at 50"):
        kt.clean.smooth(tracks_of(sine(1.0)), "savgol", cutoff)


def test_smoothing_nothing_is_told():
    tracks = tracks_of(sine(1.0))
    with pytest.raises(kt.errors.ShapeError, match="smooth: expected joints that are seen in some frame, got none"):
        kt.clean.smooth(replace(tracks, weights=0 * tracks.weights))


def test_savgol_near_half_the_frame_rate_is_the_shortest():
    assert "over 5 frames" in kt.clean.smooth(tracks_of(sine(1.0)), "savgol", 24.9).notes[-1]


def test_smooth_solves_its_weighted_problem():
    """At the end, x = S(x + w (y - x)) with S scipy's filter: less trusted frames give way."""
    rng = np.random.default_rng(2)
    points = rng.normal(size=(200, 2, 2)).cumsum(0)
    weights = rng.uniform(0.3, 1.0, size=(200, 2))
    weights[0] = 1.0
    got = kt.clean.smooth(tracks_of(points, weights), "savgol", 5.0)
    window = int(got.notes[-1].split("over ")[1].split()[0])
    x = got.points.numpy()
    again = scipy.signal.savgol_filter(x + weights[..., None] * (points - x), window, 3, axis=0)
    np.testing.assert_allclose(again, x, atol=1e-4)
    np.testing.assert_array_equal(got.weights, weights)


def test_a_frame_of_little_weight_pulls_less():
    points = sine(0.5)
    points[200] += 50.0
    weights = np.ones(points.shape[:2])
    plain = kt.clean.smooth(tracks_of(points, weights)).points[200]
    weights[200] = 0.05
    doubted = kt.clean.smooth(tracks_of(points, weights)).points[200]
    truth = torch.from_numpy(sine(0.5))[200]
    assert bool(((doubted - truth).norm(dim=-1) < 0.3 * (plain - truth).norm(dim=-1)).all())


def test_a_smoothed_body_before_a_camera_has_the_scale_of_its_distance(walk):
    distance = torch.linspace(900, 1100, walk.num_frames).double() + 50 * (torch.arange(walk.num_frames) % 2)
    result = kt.reconstruct(walk, method="rigid", intrinsics="parallel")
    result = replace(result, distance=distance, scales=1000 / distance)
    smoothed = kt.clean.smooth(result, cutoff=2.0)
    assert not torch.allclose(smoothed.distance, result.distance)
    torch.testing.assert_close(smoothed.scales * smoothed.distance, torch.full_like(smoothed.scales, 1000.0))


def test_smooth_knows_no_bridge_over_gaps():
    """Each run is filtered by itself: what is beyond a gap makes no difference, and unseen stays unseen."""
    points = np.random.default_rng(3).normal(size=(120, 2, 2)).cumsum(0)
    points[60:63, 0] = np.nan
    whole = kt.clean.smooth(tracks_of(points))
    assert not whole.seen[60:63, 0].any() and int((~whole.seen).sum()) == 3
    first = kt.clean.smooth(tracks_of(points[:60]))
    np.testing.assert_allclose(whole.points[:60, 0], first.points[:, 0], atol=1e-12)
    points[63:, 0] += 1000.0
    np.testing.assert_array_equal(kt.clean.smooth(tracks_of(points)).points[:60], whole.points[:60])


def test_short_runs_are_left_and_counted():
    points = np.random.default_rng(4).normal(size=(60, 2, 2))
    points[20:] = np.where(np.arange(40)[:, None, None] % 5 == 0, np.nan, points[20:])  # runs of 4 frames
    smoothed = kt.clean.smooth(tracks_of(points))
    np.testing.assert_array_equal(smoothed.points[21:25], points[21:25])
    assert not np.allclose(smoothed.points[:20], points[:20], atol=0.1)
    assert "64 of 104 (62 %) detections, in runs of fewer than 10 frames, were left" in smoothed.notes[-1]


@pytest.mark.parametrize("method", kt.clean.SMOOTHERS)
def test_a_number_that_is_missing_in_a_result_stays_by_itself(walk, method):
    result = kt.reconstruct(walk, method="rigid", intrinsics="parallel")
    points, path = result.points.clone(), torch.linspace(0, 50, walk.num_frames).double()
    points[40, 4] = path[40] = torch.nan
    smoothed = kt.clean.smooth(replace(result, points=points, root_depth=path), method)
    assert smoothed.points.isnan().nonzero()[:, :2].unique(dim=0).tolist() == [[40, 4]]
    assert smoothed.root_depth.isnan().nonzero().tolist() == [[40]]
    assert "nan" not in smoothed.diagnostics.notes[-1] and bool(smoothed.lengths.isfinite().all())


def test_smooth_brings_noisy_tracks_nearer_to_the_truth(walk):
    truth = walking_person(90, skeleton="coco17", generator=torch.Generator().manual_seed(3)).tracks
    before = change(truth, walk)
    for method, least in (("butterworth", 0.75), ("savgol", 0.75)):
        smoothed = kt.clean.smooth(walk, method, 6.0)
        assert change(truth, smoothed) < least * before
        moved = float(smoothed.notes[-1].split("moved by ")[1].split()[0])
        observed = slice(0, 17)
        rms = (smoothed.points - walk.points)[:, observed].square().sum(-1).mean().sqrt()
        assert moved == pytest.approx(float(rms), rel=0.05)


@pytest.mark.parametrize("clean", [kt.clean.smooth, kt.clean.gate, lambda t: kt.clean.fill(t, 3)])
def test_virtual_joints_follow(walk, clean):
    weights = walk.weights.clone()
    weights[40:42, 11] = 0  # the left hip, of which the pelvis is made
    points, weights = walk.skeleton.complete(walk.points[:, :17], weights[:, :17])
    cleaned = clean(replace(walk, points=points * (weights > 0)[..., None], weights=weights))
    again = cleaned.skeleton.complete(cleaned.points[:, :17], cleaned.weights[:, :17])
    seen = cleaned.seen
    torch.testing.assert_close(cleaned.points[seen], again[0][seen])
    torch.testing.assert_close(cleaned.weights, again[1])
    assert bool((cleaned.points[:, :17][~seen[:, :17]] == 0).all())


def test_nothing_given_is_changed(walk):
    points, weights = walk.points.clone(), walk.weights.clone()
    kt.clean.smooth(kt.clean.gate(kt.clean.fill(walk, 2)), "savgol")
    kt.clean.resample(walk, 25)
    torch.testing.assert_close(walk.points, points, rtol=0, atol=0)
    torch.testing.assert_close(walk.weights, weights, rtol=0, atol=0)
    assert not [n for n in walk.notes if n.startswith(("gate", "smooth", "fill", "resample"))]


def test_the_image_stays(walk):
    filmed = replace(walk, units="px", image_size=(1280, 720))
    clean = kt.clean
    cleaned = [clean.smooth(filmed), clean.gate(filmed), clean.resample(filmed, 20), clean.fill(filmed, 2)]
    for one in (*cleaned, clean.trim(filmed, 10, 60), clean.unswap(filmed), *clean.split(filmed)):
        assert one.image_size == (1280, 720)


def test_single_precision_stays(walk):
    half = walk.to(torch.float32)
    for cleaned in (kt.clean.smooth(half), kt.clean.gate(half), kt.clean.resample(half, 20), kt.clean.fill(half, 2)):
        assert cleaned.points.dtype == cleaned.weights.dtype == torch.float32


# ---------------------------------------------------------------------- smooth of results


def test_smooth_of_a_result(walk):
    result = kt.reconstruct(walk, method="kcs")
    smoothed = kt.clean.smooth(result, cutoff=4.0)
    corner = math.atan(math.tan(math.pi * 4 / walk.fps) / (math.sqrt(2) - 1) ** 0.25) / math.pi * walk.fps
    b, a = scipy.signal.butter(2, corner, fs=walk.fps)
    expected = scipy.signal.filtfilt(b, a, result.points.numpy(), axis=0, padlen=math.ceil(max(9, walk.fps / 4)))
    np.testing.assert_allclose(smoothed.points, expected, atol=1e-6)
    assert smoothed.tracks is result.tracks
    bones = bone_lengths(smoothed.points, walk.skeleton.bone_index())
    torch.testing.assert_close(smoothed.lengths, bones.median(0).values)
    spread = (bones / bones.mean(0)).std(0, correction=0)[list(walk.skeleton.rigid)].median()
    assert smoothed.diagnostics.bone_variation == pytest.approx(100 * float(spread))
    assert "smooth 3D (Butterworth" in smoothed.diagnostics.notes[-1]
    assert len(smoothed.alternatives) == len(result.alternatives)
    assert (smoothed.root_depth is None) == (result.root_depth is None)


@pytest.mark.parametrize("method", sorted(kt.clean.SMOOTHERS))
def test_smooth_of_a_result_smooths_its_path(walk, method):
    result = kt.reconstruct(walk, method="kcs")
    time = torch.arange(len(result.points), dtype=torch.float64)
    path = 3 * time + torch.where(time % 2 > 0, 1.0, -1.0)
    moving = replace(result, root_depth=path, distance=1000 + path)
    smoothed = kt.clean.smooth(moving, method, 1.0)
    for got in (smoothed.root_depth, smoothed.distance - 1000):
        assert got.diff()[20:-20].std() < 0.3 * path.diff()[20:-20].std()
        assert (got - path)[20:-20].abs().max() < 15
    assert smoothed.in_space().isfinite().all()


def test_smooth_of_a_short_result_leaves_it(walk):
    short = kt.reconstruct(walk.frames(0, 6), method="kcs")
    smoothed = kt.clean.smooth(short)
    assert smoothed.points is short.points
    assert "6 frames are fewer than 10" in smoothed.diagnostics.notes[-1]


# ---------------------------------------------------------------------- gate


def planted(walk, joints=(9, 13, 0), frames=(20, 47, 70), by=200.0):
    points = walk.points[:, :17].clone()
    for joint, frame in zip(joints, frames, strict=True):
        points[frame, joint] += by
    return replace(walk, points=walk.skeleton.complete(points)[0])


def test_gate_drops_exactly_what_was_planted(walk):
    cleaned = kt.clean.gate(planted(walk))
    dropped = (~cleaned.seen[:, :17]).nonzero().tolist()
    assert sorted(dropped) == [[20, 9], [47, 13], [70, 0]]
    assert "gate: 3 of 1530 (0.2 %) detections dropped as outliers:" in cleaned.notes[-1]
    for joint in ("left_wrist 1", "left_knee 1", "nose 1"):
        assert joint in cleaned.notes[-1]
    kept = cleaned.seen
    torch.testing.assert_close(cleaned.points[kept], planted(walk).points[kept], rtol=0, atol=0)


def test_gate_drops_runs_shorter_than_its_reach(walk):
    points = walk.points[:, :17].clone()
    points[40:43, 9] += 150.0
    cleaned = kt.clean.gate(replace(walk, points=walk.skeleton.complete(points)[0]))
    assert (~cleaned.seen[:, :17]).nonzero().tolist() == [[40, 9], [41, 9], [42, 9]]


def test_gate_is_the_same_in_any_place_and_size(walk):
    tracks = planted(walk)
    plain = kt.clean.gate(tracks).seen
    moved = kt.clean.gate(replace(tracks, points=1e3 * tracks.points + 5e5)).seen
    assert bool((plain == moved).all())


@pytest.mark.parametrize("fps", [30.0, 120.0])
def test_gate_leaves_motion_alone(fps):
    run = walking_person(round(4 * fps), fps=fps, turn=360.0).tracks
    assert kt.clean.gate(run).notes[-1].startswith("gate: 0 of")


def test_gate_leaves_real_motion_alone_and_finds_what_is_planted(shared):
    """Dance and play of CMU's motion capture, seen from the front: hardly a false alarm, hardly a miss."""
    generator = torch.Generator().manual_seed(0)
    for name in ("cmu/cmu_charleston1", "cmu/cmu_16_15", "cmu_cs2s/train_soccer_2", "cmu_cs2s/train_basketball_1"):
        file = np.load(shared / "data" / f"{name}.npz")
        points = torch.from_numpy(file["points3d"][::4, :, :2]).double()
        tracks = tracks_of(points, fps=30.0)
        assert float(kt.clean.gate(tracks).seen.double().mean()) > 0.998, name
        size = (points - points.mean(1, keepdim=True)).norm(dim=-1).median()
        bad = torch.rand(points.shape[:2], generator=generator) < 0.02
        angle = 2 * math.pi * torch.rand(points.shape[:2], generator=generator)
        jump = torch.stack([angle.cos(), angle.sin()], -1) * size * bad[..., None]
        noise = 0.03 * size * torch.randn(points.shape, generator=generator)
        dropped = ~kt.clean.gate(tracks_of(points + jump + noise, fps=30.0)).seen
        assert float(dropped[bad].double().mean()) > 0.85, name
        assert float(dropped[~bad].double().mean()) < 0.003, name


def test_gate_judges_nothing_without_neighbours():
    points = np.full((50, 2, 2), np.nan)
    points[:, 0] = 1.0
    points[::10, 1] = np.random.default_rng(0).normal(size=(5, 2)) * 100
    assert kt.clean.gate(tracks_of(points)).notes[-1] == "gate: 0 of 55 (0 %) detections dropped as outliers"


@pytest.mark.parametrize("clean", [kt.clean.gate, lambda tracks: kt.clean.resample(tracks, 60)])
def test_tracks_without_frames_are_told(walk, clean):
    with pytest.raises(kt.ShapeError, match="expected joints that are seen in some frame, got none"):
        clean(walk.frames(5, 5))
    assert kt.clean.unswap(empty := walk.frames(5, 5)) is empty


def test_gate_looks_at_long_clips_part_by_part(walk, monkeypatch):
    points = walk.points.clone()
    points[7, 3] += 500
    tracks = replace(walk, points=points)
    whole = kt.clean.gate(tracks)
    monkeypatch.setattr(gating, "_NUMBERS", 10 * tracks.skeleton.num_observed)
    assert torch.equal(kt.clean.gate(tracks).seen, whole.seen) and not whole.seen[7, 3]


@pytest.mark.parametrize("frames", [1, 2, 3])
def test_gate_of_hardly_any_frames(frames):
    tracks = tracks_of(np.random.default_rng(0).normal(size=(frames, 3, 2)))
    assert bool(kt.clean.gate(tracks).seen.all())


# ---------------------------------------------------------------------- fill


def test_fill_is_scipys_and_counts():
    points = sine(0.5, joints=2)
    points[100:104, 0] = np.nan
    points[200:220, 1] = np.nan
    points[:5, 1] = np.nan
    filled = kt.clean.fill(tracks_of(points), 5)
    known = np.isfinite(points[:, 0, 0])
    time = np.arange(FRAMES)
    expected = scipy.interpolate.PchipInterpolator(time[known], points[known, 0])(time)
    np.testing.assert_allclose(filled.points[:, 0], expected, atol=1e-9)
    np.testing.assert_allclose(filled.points[100:104, 0], sine(0.5)[100:104, 0], atol=0.1)
    assert filled.weights[100:104, 0].tolist() == [pytest.approx(0.3)] * 4
    assert not filled.seen[200:220, 1].any() and not filled.seen[:5, 1].any()
    assert (
        filled.notes[-1] == "fill: 4 of 29 (14 %) unseen detections filled (cubic): gaps of up to 5 frames, 1 of them"
    )


def test_fill_linear_and_weight():
    points = sine(0.5, joints=2)
    points[10:13, 0] = np.nan
    weights = np.full(points.shape[:2], 0.8)
    weights[13, 0] = 0.4
    filled = kt.clean.fill(tracks_of(points, weights), 3, kind="linear", weight=0.5)
    part = np.array([0.25, 0.5, 0.75])[:, None]
    expected = (1 - part) * points[9, 0] + part * points[13, 0]
    np.testing.assert_allclose(filled.points[10:13, 0], expected, atol=1e-12)
    np.testing.assert_allclose(filled.weights[10:13, 0], 0.2)


# ---------------------------------------------------------------------- resample, trim


def test_resample_of_a_sine():
    tracks = tracks_of(sine(1.0))
    for fps in (120.0, 29.97, 50.0, 25.0):
        new = kt.clean.resample(tracks, fps)
        assert new.fps == fps and bool(new.seen.all())
        expected = sine(1.0, frames=new.num_frames, fps=fps)
        np.testing.assert_allclose(new.points, expected, atol=0.02)
        assert (new.num_frames - 1) / fps <= (FRAMES - 1) / FPS < new.num_frames / fps
    same = kt.clean.resample(tracks, FPS)
    np.testing.assert_allclose(same.points, tracks.points, atol=1e-9)


def test_resample_linear_is_numpys_and_gaps_stay():
    rng = np.random.default_rng(0)
    points, weights = rng.normal(size=(100, 2, 2)), rng.uniform(0.5, 1, size=(100, 2))
    points[40:50, 0] = np.nan
    new = kt.clean.resample(tracks_of(points, weights), 100.0, kind="linear")
    time = np.arange(new.num_frames) / 2
    np.testing.assert_allclose(new.points[:, 1, 0], np.interp(time, np.arange(100), points[:, 1, 0]), atol=1e-9)
    ends = weights[np.floor(time).astype(int), 1], weights[np.ceil(time).astype(int), 1]
    np.testing.assert_allclose(new.weights[:, 1], np.minimum(*ends), atol=1e-9)
    unseen = (time > 39) & (time < 50)
    np.testing.assert_array_equal(~new.seen[:, 0].numpy(), unseen)


def test_resample_halves_by_taking_every_other_frame():
    points = np.random.default_rng(0).normal(size=(101, 2, 2))
    points[30:33, 1] = np.nan
    points[71, 1] = np.nan
    points[73, 1] = np.nan  # frame 72 stands alone
    new = kt.clean.resample(tracks_of(points), FPS / 2)
    np.testing.assert_allclose(np.where(new.seen[..., None], new.points, np.nan), points[::2], atol=1e-9)


def test_resample_makes_no_detectors_confidences_of_two_weights():
    tracks = walking_person(60, missing=0.1, generator=torch.Generator().manual_seed(0)).tracks
    filled = kt.clean.fill(replace(tracks, detector=None), 10)
    new = kt.clean.resample(filled, 50)
    assert set(new.weights.unique().tolist()) <= set(filled.weights.unique().tolist())
    assert not detected(filled) and not detected(new)


def test_resample_takes_a_rate_where_the_tracks_have_none():
    tracks = tracks_of(sine(1.0), fps=None)
    with pytest.raises(kt.OptionError, match="fps=..."):
        kt.clean.resample(tracks, 25)
    assert kt.clean.resample(tracks, 25, source_fps=50).fps == 25


COUNTED = "; in the result and other notes the first of them is frame 0"


def test_trim():
    tracks = tracks_of(sine(1.0))
    cut = kt.clean.trim(tracks, 10, 60)
    np.testing.assert_array_equal(cut.points, tracks.points[10:60])
    assert cut.notes[-1] == f"trim: frames 10 to 59 of 400{COUNTED}"
    assert kt.clean.trim(tracks, 390, 1000).num_frames == 10  # the end may lie beyond
    assert kt.clean.trim(tracks).num_frames == FRAMES
    assert kt.clean.trim(tracks, stop=9).notes[-1] == "trim: frames 0 to 8 of 400"  # whose numbers are as before


def test_notes_on_what_is_unseen_are_those_of_the_tracks_that_are_left():
    points = sine(1.0)
    points[50:, 0], points[:, 1] = np.nan, np.nan
    points[[20, 390]] = np.nan
    tracks = tracks_of(points)
    joints = tracks.skeleton.joints
    told = "never seen, so placed beside their neighbours, as there is no template: "
    assert tracks.notes[-2:] == (
        f"{told}{joints[1]}",
        "2 frames without any seen joint (frame 20, 390): filled from their neighbours",
    )
    assert kt.clean.trim(tracks, 10, 60).notes[-3:] == (
        f"{told}{joints[1]}",
        "1 frame without any seen joint (frame 10): filled from its neighbours",
        f"trim: frames 10 to 59 of 400{COUNTED}",
    )
    late = kt.clean.trim(tracks, 100, 200)
    assert late.notes[-2:] == (f"{told}{joints[0]}, {joints[1]}", f"trim: frames 100 to 199 of 400{COUNTED}")
    assert not any("without any seen" in note for note in (*late.notes, *kt.clean.fill(tracks, 3).notes))


def test_what_is_no_tracks_is_told():
    """Motion and arrays ended in AttributeErrors about attributes that they have not."""
    motion = kt.Motion.from_arrays(torch.rand(9, 17, 3), skeleton="h36m17", fps=30)
    calls = {
        "fill": lambda one: kt.clean.fill(one, 3),
        "gate": kt.clean.gate,
        "unswap": kt.clean.unswap,
        "trim": kt.clean.trim,
        "resample": lambda one: kt.clean.resample(one, 60),
    }
    for name, call in calls.items():
        with pytest.raises(kt.OptionError, match=f"^{name}: expected Tracks, got Motion"):
            call(motion)
    with pytest.raises(kt.OptionError, match="^smooth: expected Tracks or Reconstruction, got Tensor"):
        kt.clean.smooth(motion.points)


def test_trim_to_nothing_seen_is_an_error():
    points = sine(1.0)
    points[:20] = np.nan
    with pytest.raises(kt.ShapeError, match="frames 0 to 9"):
        kt.clean.trim(tracks_of(points), 0, 10)


# ---------------------------------------------------------------------- mistakes

MISTAKES = {
    "method": (lambda t: kt.clean.smooth(t, "butterwurst"), "did you mean 'butterworth'"),
    "above Nyquist": (lambda t: kt.clean.smooth(t, cutoff=25.0), "25 Hz, got 25"),
    "cutoff 0": (lambda t: kt.clean.smooth(t, cutoff=0), "above 0"),
    "cutoff NaN": (lambda t: kt.clean.smooth(t, cutoff=math.nan), "got nan"),
    "cutoff text": (lambda t: kt.clean.smooth(t, cutoff="6"), "got '6'"),
    "no rate": (lambda t: kt.clean.smooth(replace(t, fps=None)), r"give fps=\.\.\. \(kcs-torch: --fps\)"),
    "bad rate": (lambda t: kt.clean.smooth(t, fps=-1), "smooth: fps: expected a positive number"),
    "endless rate": (lambda t: kt.clean.smooth(t, fps=10**400), "smooth: fps: expected a positive number"),
    "gate": (lambda t: kt.clean.gate(t, threshold=0), "gate: threshold"),
    "gate's floor": (lambda t: kt.clean.gate(t, floor=-1), "gate: floor"),
    "gate's reach": (lambda t: kt.clean.gate(t, reach=0), "gate: reach"),
    "fill": (lambda t: kt.clean.fill(t, 0), "from 1, got 0"),
    "fill half": (lambda t: kt.clean.fill(t, 2.5), "got 2.5"),
    "fill kind": (lambda t: kt.clean.fill(t, 2, kind="quartic"), "choices are cubic, linear"),
    "fill weight": (lambda t: kt.clean.fill(t, 2, weight=1.5), "at most 1"),
    "resample": (lambda t: kt.clean.resample(t, 0), "resample: fps"),
    "resample kind": (lambda t: kt.clean.resample(t, 25, kind="sinc"), "choices are cubic, linear"),
    "resample too much": (lambda t: kt.clean.resample(t, 1e6), "a rate near the 50"),
    "trim": (lambda t: kt.clean.trim(t, 10, 10), "within 0:400"),
    "trim beyond": (lambda t: kt.clean.trim(t, 400), "within 0:400"),
    "trim negative": (lambda t: kt.clean.trim(t, -5), "got -5"),
}


@pytest.mark.parametrize("name", MISTAKES)
def test_mistakes_are_told(name):
    call, message = MISTAKES[name]
    with pytest.raises(kt.OptionError, match=message):
        call(tracks_of(sine(1.0)))


@pytest.mark.parametrize("pattern", ["", "1", "0", "110100111", "0110", "1111"])
def test_runs(pattern):
    seen = np.array([c == "1" for c in pattern], dtype=bool)
    covered = np.zeros_like(seen)
    for start, stop in runs(seen):
        assert stop > start and not covered[start:stop].any()
        assert start == 0 or not seen[start - 1]
        assert stop == len(seen) or not seen[stop]
        covered[start:stop] = True
    np.testing.assert_array_equal(covered, seen)


@st.composite
def wild_tracks(draw):
    """Tracks of any length, with any gaps, weights and sizes."""
    frames, joints = draw(st.integers(1, 40)), draw(st.integers(2, 4))
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    points = rng.normal(size=(frames, joints, 2)) * 10.0 ** draw(st.integers(-30, 29))  # up to what tracks may hold
    if draw(st.booleans()):
        points = np.round(points / np.abs(points).max())  # many equal values
    weights = rng.uniform(size=(frames, joints)) * (rng.uniform(size=(frames, joints)) < draw(st.floats(0.05, 1)))
    weights[rng.integers(frames), rng.integers(joints)] = 1.0
    try:
        return tracks_of(points, weights, fps=draw(st.sampled_from([1.0, 24.0, 30.0, 1000.0])))
    except kt.ShapeError:  # a joint by itself far away from all others
        reject()


@settings(max_examples=80, deadline=None)
@given(
    wild_tracks(), st.sampled_from(kt.clean.SMOOTHERS), st.floats(0.001, 0.499), st.integers(1, 50), st.floats(0.3, 3)
)
def test_wild_tracks_stay_tracks(tracks, method, cutoff, longest, factor):
    """Every step gives finite points, weights that keep their rule, and one more note; or says that nothing is left."""
    told = lambda t: [note for note in t.notes if note not in unseen_notes(t.weights, t.skeleton)]  # noqa: E731
    steps = {
        "gate": kt.clean.gate,
        "smooth": lambda t: kt.clean.smooth(t, method, cutoff * t.fps),
        "fill": lambda t: kt.clean.fill(t, longest),
        "resample": lambda t: kt.clean.resample(t, factor * t.fps),
    }
    for name, step in steps.items():
        try:
            cleaned = step(tracks)
        except kt.ShapeError as error:
            assert "no joint is left seen" in str(error)
            continue
        assert bool(cleaned.points.isfinite().all()) and bool((cleaned.points[~cleaned.seen] == 0).all())
        assert bool((cleaned.weights >= 0).all() and (cleaned.weights <= 1).all())
        assert told(cleaned)[:-1] == told(tracks) and cleaned.notes[-1].startswith(name)
        if name == "smooth":
            torch.testing.assert_close(cleaned.weights, tracks.weights, rtol=0, atol=0)
        if name == "gate":
            assert not bool((cleaned.seen & ~tracks.seen).any())
        if name == "fill":
            assert not bool((tracks.seen & ~cleaned.seen).any())
            torch.testing.assert_close(cleaned.points[tracks.seen], tracks.points[tracks.seen], rtol=0, atol=0)


def test_a_trimmed_clip_is_a_copy():
    tracks = walking_person(30).tracks
    part = kt.clean.trim(tracks, 10, 20)
    part.points[0] = 12345.0
    assert float(tracks.points[10].max()) != 12345.0


def test_one_euro_goes_by_the_size_of_the_body():
    """Not by how far it walks: the same motion filtered as part of a longer walk hardly differs."""
    tracks = walking_person(150, yaw=90, turn=0, noise=5.0, generator=torch.Generator().manual_seed(0)).tracks
    long, short = (kt.clean.smooth(one, "one-euro", 2.0).points[:30] for one in (tracks, tracks.frames(0, 30)))
    assert float((long - short).norm(dim=-1).max()) < 5
