"""PKC on tracks with noise, wrong detections and changes of size."""

import warnings
from dataclasses import replace

import pytest
import torch
from numerics import normal
from pkc_walks import NAN, centred, error, of
from torch.testing import assert_close

from kcs_torch import PKC, SKELETONS, KcsWarning, Tracks
from kcs_torch.clean import detector, resample, smooth
from kcs_torch.data import random_motion, walking_person
from kcs_torch.functional import bone_lengths
from kcs_torch.methods.clips.lockstep import run
from kcs_torch.methods.clips.size import Size
from kcs_torch.methods.pkc import batch
from kcs_torch.methods.pkc import method as module
from kcs_torch.methods.pkc.batch import Noisy, clean_all, serve
from kcs_torch.methods.pkc.cleaning import cleaned
from kcs_torch.solvers.stray import in_motion

# Many tests take few steps, after which nothing has settled.
pytestmark = pytest.mark.filterwarnings("ignore::kcs_torch.ConvergenceWarning")


# ---------------------------------------------------------------------- noise, gaps, wrong detections


@pytest.mark.parametrize("turn", [0, 90])
@pytest.mark.parametrize("prepare", [smooth, resample])
def test_noise_that_was_filtered_is_noise_still(prepare, turn):
    """It has no floor in the spectrum; taken for motion it costs 80 mm, and 250 where frames were put between."""
    clip = walking_person(90, turn=turn, noise=5.0, generator=torch.Generator().manual_seed(0))
    if prepare is smooth:
        tracks, truth = smooth(clip.tracks, cutoff=6.0), clip.points
    else:
        tracks, truth = resample(clip.tracks, 60), walking_person(179, fps=60, turn=turn).points
    off = PKC()(tracks).points - truth
    assert (off - off.mean(1, keepdim=True)).norm(dim=-1).mean() < 20


@pytest.mark.parametrize("metres", [30, 120])
def test_small_changes_of_size_are_told(metres):
    """Of a walk towards a distant camera; taken for constant, they cost 95 and 35 mm."""
    clip = walking_person(120, turn=0, yaw=45.0)
    ahead = clip.points + clip.points.new_tensor([0.0, 0, 1000 * metres])
    result = PKC()(replace(clip.tracks, points=ahead[..., :2] / ahead[..., 2:] * 1000 * metres))
    assert any("weak perspective" in note for note in result.diagnostics.notes)
    assert error(result.points, clip.points) < 0.12  # 14 mm
    far = result.scales.log() + ahead[..., 2].mean(-1).log()
    assert (far - far.mean()).abs().max() < 0.01
    assert not any("weak perspective" in note for note in PKC()(clip.tracks).diagnostics.notes)


@pytest.mark.parametrize("yaw", [30.0, 60.0])
@pytest.mark.parametrize("disturb", ["noise", "less noise, more frames", "whole pixels"])
def test_a_little_noise_does_little_harm(disturb, yaw):
    """A millimetre a frame, taken for motion, made bones turn out of the image plane: errors of 33 to 46 mm."""
    frames, rate = (400, 120.0) if "frames" in disturb else (100, 30.0)
    clip = walking_person(frames, turn=0.0, yaw=yaw, fps=rate)
    if "noise" in disturb:
        points = clip.tracks.points + (0.5 if "less" in disturb else 1.3) * normal(frames, 17, 2, seed=1)
    else:
        points = (clip.tracks.points / 4).round() * 4  # of a person who is about 440 pixels tall
    found = PKC()(replace(clip.tracks, points=points))
    off = found.points - clip.points
    error = (off - off.mean(1, keepdim=True)).norm(dim=-1)
    assert float(error.mean()) < 16 and any("tracks smoothed" in note for note in found.diagnostics.notes)


def test_noise_gaps_and_wrong_detections_are_cleaned_first():
    clip = walking_person(60, turn=0.0, noise=20.0, missing=0.05, generator=torch.Generator().manual_seed(1))
    points = clip.tracks.points.clone()
    points[::9, 3] += 600.0
    tracks = of(torch.where(clip.tracks.seen[..., None], points, NAN))
    result, raw = PKC(rounds=0)(tracks), PKC(rounds=0, denoise=False)(tracks)
    notes = " ".join(result.diagnostics.notes)
    assert "rejected as outliers" in notes and "tracks smoothed" in notes
    assert error(result.points, clip.points) < 0.5
    assert error(result.points, clip.points) < error(raw.points, clip.points)
    bones = result.skeleton.bone_index()
    true = bone_lengths(clip.points, bones).mean(0)
    grown = result.lengths / true
    assert grown.median() == pytest.approx(1, abs=0.03)
    assert (grown[true > 200] - 1).abs().max() < 0.1  # mm; a hip of 130 is hardly longer than the noise is large


def kicking(shift=0.0, noise=0.0):
    """A walk of 90 frames in which an ankle swings .3 m aside and back within .2 s; its tracks, normalised."""
    clip = walking_person(90, turn=0.0, yaw=90.0, noise=noise, generator=torch.Generator().manual_seed(0))
    points, time = clip.tracks.points.clone(), torch.arange(90) / 30
    points[:, clip.tracks.skeleton.index("left_ankle"), 0] += 300 * torch.exp(-(((time - 1) / 0.06) ** 2))
    points[60, 3] += shift
    return replace(clip.tracks, points=(points - points.mean(1, keepdim=True)) / 500)


def test_a_kick_is_no_outlier():
    """A few frames of it were rejected, so that all else of exact tracks was solved as that of doubtful ones."""
    tracks = kicking()
    (found,) = clean_all([Noisy(tracks.points, tracks.weights, torch.arange(90))])
    assert bool(found.outliers.any())
    points, noise, notes = run(cleaned(tracks, denoise=True), serve)
    assert_close(points, tracks.points) and not bool(noise.any())
    assert not any("rejected" in note for note in notes)


def test_a_long_clip_is_asked_for_kicks_joint_by_joint(monkeypatch):
    """At once this would take a hundred times the memory of its joints and frames."""
    asked = []
    monkeypatch.setattr("kcs_torch.solvers.stray.NUMBERS", 90)
    ask = lambda values, *rest, **time: asked.append(values.shape[2]) or in_motion(values, *rest, **time)  # noqa: E731
    monkeypatch.setattr("kcs_torch.methods.pkc.cleaning.in_motion", ask)
    tracks = kicking()
    points, _, _ = run(cleaned(tracks, denoise=True), serve)
    assert torch.equal(points, tracks.points) and asked == [1] * 17


@pytest.mark.parametrize("fields", [{"shift": 150.0}, {"noise": 5.0}])
def test_beside_a_wrong_detection_or_in_noise_a_kick_is_left_to_the_model(fields):
    tracks = kicking(**fields)
    (found,) = clean_all([Noisy(tracks.points, tracks.weights, torch.arange(90))])
    points, _, notes = run(cleaned(tracks, denoise=True), serve)
    assert any("rejected as outliers" in note for note in notes)
    assert bool(found.outliers[30].any()) and not bool((points == tracks.points)[found.outliers].any())


@pytest.mark.parametrize("fields", [{"noise": 5.0}, {"missing": 0.2}])
def test_virtual_joints_stay_the_middle_of_their_sources(fields):
    clip = walking_person(60, skeleton="coco17", generator=torch.Generator().manual_seed(0), **fields)
    tracks = replace(clip.tracks, points=clip.tracks.points / 500)
    points, _, _ = run(cleaned(tracks, denoise=True), serve)
    assert_close(points, tracks.skeleton.complete(points[:, :17])[0])


def test_clips_are_cleaned_together_as_alone():
    tasks = []
    for seed, frames in enumerate((30, 41, 30, 30, 5)):
        clip = walking_person(
            frames, noise=5.0 * seed, missing=0.1, generator=torch.Generator().manual_seed(seed)
        ).tracks
        tasks.append(Noisy(clip.points, clip.weights, torch.arange(len(clip.points))))
    for task, found in zip(tasks, clean_all(tasks), strict=True):
        (alone,) = clean_all([task])
        assert torch.equal(found.outliers, alone.outliers) and torch.equal(found.weights, alone.weights)
        assert_close(found.points, alone.points, rtol=1e-6, atol=1e-3)  # mm
        assert_close(found.noise, alone.noise, rtol=1e-6, atol=1e-3)


def test_confidences_that_vary_are_a_detector_s():
    """Its joints stray for long, which no smoothing tells: lengths need not be kept as if the image were exact."""
    clip = walking_person(30, turn=0.0)
    method = PKC(rounds=0)
    weights = torch.rand(clip.tracks.weights.shape, generator=torch.Generator().manual_seed(0)).double() * 0.8 + 0.2
    unsure = replace(clip.tracks, weights=weights, detector=None)
    _, noise, notes = run(cleaned(unsure, denoise=True), serve)
    assert_close(noise, detector.DETECTED / weights.sqrt())
    assert any("detector" in note for note in notes)
    chosen = torch.where(weights > 0.6, 1.0, 0.3)
    for sure in (torch.ones_like(weights), torch.full_like(weights, 0.5), (weights > 0.4).double(), chosen):
        assert not detector.detected(replace(clip.tracks, weights=sure, detector=None))
    assert detector.detected(unsure)
    assert not detector.detected(replace(unsure, weights=torch.zeros_like(weights)))
    spread = method(unsure).uncertainty.mean()
    assert spread > method(clip.tracks).uncertainty.mean()


def test_bones_are_constant_though_the_image_is_not_exact():
    """Where it is exact it stays as it is; otherwise joints move by less than their noise."""
    clip = walking_person(40, turn=0.0, noise=20.0, generator=torch.Generator().manual_seed(2))
    method, bones = PKC(rounds=0), clip.tracks.skeleton.bone_index()
    result = method(clip.tracks)
    lengths = bone_lengths(result.points, bones)
    assert (lengths.std(0) / lengths.mean(0)).median() < 0.004
    moved = centred(result.points)[..., :2] - centred(clip.points)[..., :2]
    assert moved.square().mean().sqrt() < 20.0
    exact = method(walking_person(40, turn=0.0).tracks)
    assert_close(centred(exact.points)[..., :2], centred(exact.tracks.points))


# ---------------------------------------------------------------------- changes of size


@pytest.mark.parametrize("width", [1.0, 3.0])
def test_a_body_unlike_its_template_is_not_searched_again_for_a_change_of_size(width, monkeypatch):
    """Where the viewpoint turns its template hardly counts, and no other search asks for such small changes."""
    tried, real = [], module.resized
    monkeypatch.setattr(module, "resized", lambda *given: tried.append(given) or real(*given))
    body = SKELETONS["coco17"]
    body = replace(body, template=tuple((width * x, y, z) for x, y, z in body.template))
    tracks = random_motion(body, 40, turn=120.0, generator=torch.Generator().manual_seed(0)).tracks
    size = torch.linspace(1, 1.03, 40, dtype=torch.float64)[:, None, None]
    with warnings.catch_warnings(action="ignore", category=KcsWarning):
        PKC(steps=10)(Tracks.from_arrays((tracks.points * size)[:, :17], skeleton="coco17", fps=30.0))
    assert len(tried) == (width == 1.0)


@pytest.mark.parametrize("detections", [False, True])
def test_a_large_change_of_size_that_explains_little_is_tried_of_a_detector_s_tracks_alone(detections, monkeypatch):
    """Whose errors hide what it explains."""
    tried, real = [], module.resized
    monkeypatch.setattr(module, "resized", lambda *given: tried.append(given) or real(*given))
    path = torch.linspace(0.9, 1.1, 40, dtype=torch.float64)
    sizes = lambda tracks: [Size(path, 0.1) for _ in tracks]  # noqa: E731
    monkeypatch.setattr(batch, "weak_perspectives", sizes)
    clip = walking_person(40, turn=0, yaw=40)
    PKC(steps=3, rounds=0, detections=detections)(clip.tracks)
    assert len(tried) == detections
