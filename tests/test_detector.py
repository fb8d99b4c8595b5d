"""Whether a detector found the joints: told by confidences, by the kind of noise, and by the skeleton."""

import warnings
from dataclasses import replace

import pytest
import torch

import kcs_torch as kt
from kcs_torch.clean.detector import FILTERED, LASTING, detected, found_by_detector
from kcs_torch.data.synthetic import walking_person
from kcs_torch.functional import align
from kcs_torch.solvers.noise import measure_noise

WALK = walking_person(200, turn=0.0, yaw=50.0, skeleton="coco17")


def normal(seed: int = 0) -> torch.Tensor:
    return torch.randn(WALK.tracks.points.shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def lasting(seed: int = 0, keep: float = 0.9) -> torch.Tensor:
    """Noise of deviation 1, of which so much is left in the next frame."""
    noise = normal(seed)
    for k in range(1, len(noise)):
        noise[k] = keep * noise[k - 1] + (1 - keep**2) ** 0.5 * noise[k]
    return noise


def spoilt(noise: torch.Tensor, skeleton: kt.Skeleton | None = None) -> kt.Tracks:
    """The walk with noise (T, N, 2) in millimetres, of which nobody knows whence it comes."""
    body = skeleton or WALK.tracks.skeleton
    count = body.num_observed
    points, weights = body.complete((WALK.tracks.points + noise)[:, :count], WALK.tracks.weights[:, :count])
    return replace(WALK.tracks, points=points, weights=weights, skeleton=body, detector=None)


CUSTOM = replace(WALK.tracks.skeleton, name="mine")


def test_exact_tracks_are_no_detector_s():
    assert not found_by_detector(spoilt(0 * normal()))
    assert not found_by_detector(spoilt(0 * normal(), CUSTOM))


def test_noise_of_a_detector_s_skeleton_is_a_detector_s():
    assert found_by_detector(spoilt(4 * normal()))
    assert not found_by_detector(spoilt(4 * normal(), CUSTOM))  # white noise of anybody's skeleton is just noise
    assert not found_by_detector(replace(spoilt(4 * normal()), detector=False))
    plain = replace(WALK.tracks.skeleton, template=None, spread=None)  # nothing was measured of such bodies
    assert not found_by_detector(spoilt(4 * normal(), plain))


def test_noise_that_lasts_is_a_detector_s_of_any_skeleton():
    rate = 60.0  # where quick modes tell it from white noise
    noise = normal()
    noise = 12 * (noise + noise.roll(1, 0) + noise.roll(2, 0)) / 3
    assert found_by_detector(replace(spoilt(noise, CUSTOM), fps=rate))
    assert not found_by_detector(replace(spoilt(8 * normal(), CUSTOM), fps=rate))


@pytest.mark.parametrize("method", ["butterworth", "savgol", "one-euro"])
def test_what_smooth_takes_out_is_remembered(method):
    noisy = spoilt(6 * lasting() + 3 * normal(1))
    smooth = kt.clean.smooth(noisy, method)
    assert smooth.detector and detected(smooth)
    exact = kt.clean.smooth(spoilt(0 * normal()), method)
    assert exact.detector is None and not found_by_detector(exact)


def test_smooth_warns_of_sides_that_it_would_mix_up():
    tracks = spoilt(3 * normal())
    left, right = torch.tensor(tracks.skeleton.mirror).T
    both, other = torch.cat([left, right]), torch.cat([right, left])
    tracks.points[50:60, both] = tracks.points[50:60, other]
    with pytest.warns(kt.KcsWarning, match="swapped back in 10 of 200 .* frames"):
        kt.clean.smooth(tracks)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        kt.clean.smooth(kt.clean.unswap(tracks))


def test_a_filter_of_somebody_else_is_noticed():
    noisy = spoilt(6 * normal(), CUSTOM)
    smooth = kt.clean.smooth(replace(noisy, detector=False), cutoff=8.0)
    assert found_by_detector(replace(smooth, detector=None))
    assert not found_by_detector(replace(smooth, detector=False))


def test_a_clip_too_short_to_tell_a_filter_from_motion_has_to_be_loud():
    """Two seconds of quick motion share no more than filtered noise does: motion capture was taken for a detector's."""
    walk = walking_person(480, turn=0.0, yaw=50.0, skeleton="coco17", fps=120.0).tracks
    noise = torch.randn(walk.points.shape, generator=torch.Generator().manual_seed(0), dtype=torch.float64)

    def filtered(by: float, body: kt.Skeleton) -> kt.Tracks:
        noisy = replace(walk, points=walk.points + by * noise, skeleton=body)
        return replace(kt.clean.smooth(noisy, cutoff=8.0), detector=None)

    for by, body, short in (
        (3, CUSTOM, False),
        (60, CUSTOM, False),
        (3, walk.skeleton, False),
        (60, walk.skeleton, True),
    ):
        long = filtered(by, body)
        assert found_by_detector(long) and measure_noise(*parts(long), window=256).told
        assert found_by_detector(long.frames(0, 240)) == short
        assert not measure_noise(*parts(long.frames(0, 240)), window=256).told


def test_quick_motion_of_short_clips_is_no_detector_s():
    """Every joint's own, nothing of it in single frames: what a filter leaves looks the same."""
    walk = walking_person(240, turn=0.0, yaw=50.0, skeleton="coco17", fps=120.0).tracks
    time = torch.arange(240, dtype=torch.float64)[:, None, None, None] / 120
    pitch, generator = torch.linspace(6, 11, 12, dtype=torch.float64), torch.Generator().manual_seed(0)
    phase = torch.rand(17, 2, 12, generator=generator, dtype=torch.float64)
    size = torch.randn(17, 2, 12, generator=generator, dtype=torch.float64) / 3
    quick = (size * (2 * torch.pi * (pitch * time + phase)).sin()).sum(-1)
    quick = quick * torch.hann_window(240, periodic=False, dtype=torch.float64)[:, None, None]
    for body in (walk.skeleton, CUSTOM):
        points, weights = body.complete(walk.points[:, :17] + quick, walk.weights[:, :17])
        noise = measure_noise(points, weights, window=256)
        assert noise.restless > FILTERED * noise.white and noise.share > 0.1
        assert not found_by_detector(replace(walk, points=points, weights=weights, skeleton=body, detector=None))


def test_kinds_of_noise():
    points = WALK.tracks.points
    size = float((points - points.mean(1, keepdim=True)).norm(dim=-1).median())
    white = measure_noise(*parts(spoilt(8 * normal())))
    assert white is not None and white.restless < LASTING * white.white
    assert 0.8 * 8 / size < white.white < 1.2 * 8 / size
    fast = replace(spoilt(8 * normal()), fps=60.0)
    filtered = measure_noise(*parts(kt.clean.smooth(fast)), window=128)
    assert filtered is not None and filtered.restless > FILTERED * filtered.white
    exact = measure_noise(*parts(spoilt(0 * normal())))
    assert exact is not None and exact.restless < 1e-4


def test_noise_that_cannot_be_measured():
    points, weights = parts(spoilt(8 * normal()))
    for frames in (0, 1, 11):
        assert measure_noise(points[:frames], weights[:frames]) is None
    for wrong in ((torch.tensor(1.0), weights), (points, weights[0]), (points[None], weights[None]), (None, None)):
        with pytest.raises(kt.ShapeError, match="measure_noise: .*expected"):
            measure_noise(*wrong)
    for frames in (12, 20, 30):
        short = measure_noise(points[:frames], weights[:frames])
        assert short is not None and short.white > 0.005 and short.restless == 0
    assert measure_noise(points * 0, weights) is None
    assert measure_noise(points, weights * 0) is None
    few = weights.clone()
    few[::3, 3:] = 0  # three joints are always there
    assert measure_noise(points, few) is None
    some = weights.clone()
    some[::3, 12:] = 0
    assert measure_noise(points, some) is not None
    lost = weights.clone()
    lost[::4] = 0  # nobody is seen
    assert 0.005 < measure_noise(points, lost).white < measure_noise(points, weights).white
    lost[1::4] = lost[2::4] = 0
    assert measure_noise(points, lost) is None


def parts(tracks: kt.Tracks) -> tuple[torch.Tensor, torch.Tensor]:
    return tracks.points, tracks.weights


def test_errors_that_last_do_not_become_depth():
    """Without confidences they were taken for motion, which depth had to explain."""
    clips = [spoilt(8 * lasting() + 4 * normal(seed)).frames(0, 100) for seed in (1, 2, 3)]
    truth = align.centre(WALK.points[:100])[0]

    def errors(some: slice, **fields: object) -> list[float]:
        found = [kt.reconstruct(tracks, intrinsics="parallel", **fields).points for tracks in clips[some]]
        return [float((align.centre(points)[0] - truth).norm(dim=-1).mean()) for points in found]

    told, exact = errors(slice(None)), errors(slice(None), detections=False)
    assert told[:1] == errors(slice(1), detections=True)
    assert sum(told) < 0.75 * sum(exact)


def test_a_result_tells_what_its_tracks_were_taken_for():
    noisy = spoilt(4 * normal()).frames(0, 60)
    found = kt.reconstruct(noisy, intrinsics="parallel", rounds=0)
    assert found.tracks.detector and any("detector's" in note for note in found.diagnostics.notes)
    sure = kt.reconstruct(noisy, intrinsics="parallel", rounds=0, detections=False)
    assert not sure.tracks.detector and not any("detector's" in note for note in sure.diagnostics.notes)
    assert float(found.uncertainty.mean()) > float(sure.uncertainty.mean())
    hint = "detections=True"
    mine = kt.reconstruct(spoilt(4 * normal(), CUSTOM).frames(0, 60), intrinsics="parallel", rounds=0)
    assert any(hint in note for note in mine.diagnostics.notes)
    assert not any(hint in note for one in (found, sure) for note in one.diagnostics.notes)
