"""Noise, gaps and outliers of 2D tracks."""

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from numerics import BATCHES, DEVICES, FLOATS, leaves_arguments_alone, normal
from torch.testing import assert_close

from kcs_torch.data.synthetic import walking_person
from kcs_torch.errors import ShapeError
from kcs_torch.functional import interpolate
from kcs_torch.solvers import complete_tracks, denoise_tracks
from kcs_torch.solvers.denoise import _Model
from kcs_torch.solvers.spectrum import spectrum_floor, temporal_modes
from kcs_torch.solvers.stray import in_motion


def walk(frames=90, **fields):
    """Tracks (T, N, 2) of a walk in mm, without noise."""
    tracks = walking_person(num_frames=frames, fps=30.0, yaw=45.0, **fields).tracks
    return tracks.points.double()


def rms(error):
    return float(error.square().mean().sqrt())


def gaps(*shape, share=0.3, seed=0):
    """Which are seen (T, N): half of what is not are runs of ten frames."""
    number = torch.rand(shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    starts = torch.rand(shape, generator=torch.Generator().manual_seed(seed + 1), dtype=torch.float64) < share / 20
    gone = number < share / 2
    for k in range(10):
        gone[k:] |= starts[: shape[0] - k]
    return ~gone


def test_clean_tracks_stay():
    tracks = walk()
    weights = torch.ones(tracks.shape[:2], dtype=torch.float64)
    found = leaves_arguments_alone(denoise_tracks, tracks, weights)
    size = rms(tracks - tracks.mean(1, keepdim=True))
    assert rms(found.points - tracks) < 1e-3 * size
    assert not found.outliers.any()
    assert torch.equal(found.weights, weights)
    assert found.noise.shape == (tracks.shape[1],)


@pytest.mark.parametrize("share", [0.01, 0.03, 0.1])
def test_noise_is_measured_and_taken_away(share):
    tracks = walk()
    noise = share * rms(tracks - tracks.mean(1, keepdim=True))
    found = denoise_tracks(tracks + noise * normal(*tracks.shape), torch.ones(tracks.shape[:2]))
    assert_close(found.noise.mean(), torch.tensor(noise, dtype=torch.float64), rtol=0.1, atol=0)
    assert rms(found.points - tracks) < 0.6 * noise
    assert_close(float(found.left[0]), rms(found.points - tracks), rtol=0.25, atol=0)
    assert not found.outliers.any()


def test_what_is_not_known_is_unseen():
    tracks = walk()
    seen = gaps(*tracks.shape[:2])
    found = denoise_tracks(torch.where(seen[..., None], tracks, 0), seen.double())
    for other in (-1.0, math.nan):
        weights = torch.where(seen, 1, other)
        for points in (tracks, torch.where(seen[..., None], tracks, math.nan)):
            assert torch.equal(denoise_tracks(points, weights).points, found.points)
    assert torch.equal(denoise_tracks(points, torch.ones_like(weights)).points, found.points)


def test_noise_does_not_depend_on_how_sure_all_joints_are():
    tracks = walk()
    noisy = tracks + 10 * normal(*tracks.shape)
    sure, unsure = (denoise_tracks(noisy, torch.full(tracks.shape[:2], weight)) for weight in (1.0, 0.25))
    assert_close(unsure.noise, sure.noise, rtol=0.1, atol=0)


@pytest.mark.parametrize("kind", ["averaged", "interpolated", "persistent"])
def test_noise_that_lasts_is_told(kind):
    """Filters, interpolation and detectors leave noise that is not white, and spectra without a floor."""
    tracks = walk(200)
    size = rms(tracks - tracks.mean(1, keepdim=True))
    white = normal(*tracks.shape)
    if kind == "averaged":
        noise = (white[2:] + white[1:-1] + white[:-2]) / 3
        noise = torch.cat([noise[:1], noise, noise[-1:]])
    elif kind == "interpolated":
        noise = white.clone()
        noise[1:-1:2] = (noise[:-2:2] + noise[2::2]) / 2
    else:
        noise = white.clone()
        for k in range(1, len(noise)):
            noise[k] = 0.6 * noise[k - 1] + 0.8 * white[k]
    level = 0.02 * size
    found = denoise_tracks(tracks + level * noise / rms(noise), torch.ones(tracks.shape[:2]))
    assert 0.5 * level < float(found.noise[0]) < 1.5 * level
    error = rms(found.points - tracks)
    assert error < 0.95 * level
    assert 0.4 * error < float(found.left[0]) < 1.3 * error


@pytest.mark.parametrize("shown", [0, 30])
def test_joints_that_are_hardly_seen_do_not_hide_the_noise_of_others(shown):
    """What is filled has no noise of its own."""
    tracks = walk()
    noise = 0.02 * rms(tracks - tracks.mean(1, keepdim=True))
    spoiled = tracks + noise * normal(*tracks.shape)
    weights = torch.ones(tracks.shape[:2], dtype=torch.float64)
    weights[shown:, : tracks.shape[1] // 2] = 0
    found = denoise_tracks(spoiled, weights)
    assert_close(found.noise.mean(), torch.tensor(noise, dtype=torch.float64), rtol=0.2, atol=0)
    assert rms((found.points - tracks)[weights > 0]) < 0.6 * noise


def test_gaps_are_filled_better_than_by_time_or_rank_alone():
    tracks = walk()
    seen = gaps(*tracks.shape[:2])
    spoiled = torch.where(seen[..., None], tracks, torch.full_like(tracks, 1e4))
    found = denoise_tracks(spoiled, seen.double())
    error = rms((found.points - tracks)[~seen])
    assert error < 0.65 * rms((interpolate(spoiled, seen) - tracks)[~seen])
    assert error < 0.65 * rms((complete_tracks(spoiled, seen) - tracks)[~seen])
    assert not (found.outliers & ~seen).any()
    assert torch.equal(found.points, denoise_tracks(torch.where(seen[..., None], tracks, 0), seen.double()).points)


@pytest.mark.parametrize("share", [0.02, 0.1])
def test_outliers_are_found(share):
    tracks = walk()
    size = rms(tracks - tracks.mean(1, keepdim=True))
    hit = torch.rand(tracks.shape[:2], generator=torch.Generator().manual_seed(1)) < share
    off = torch.where(hit[..., None], size * normal(*tracks.shape), torch.zeros_like(tracks))
    found = denoise_tracks(tracks + off, torch.ones(tracks.shape[:2]))
    gross = off.norm(dim=-1) > 0.2 * size
    assert found.outliers[gross].double().mean() > 0.98
    assert found.outliers[~hit].double().mean() < 0.01
    assert torch.equal(found.weights == 0, found.outliers)
    assert rms(found.points - tracks) < 0.05 * rms(off)


def test_swapped_sides_are_outliers():
    tracks = walk()
    swapped = tracks.clone()
    distance = (tracks[:, :, None] - tracks[:, None]).norm(dim=-1)[40:42].amin(0)
    first, second = divmod(int(distance.argmax()), tracks.shape[1])
    swapped[40:42, [first, second]] = tracks[40:42, [second, first]]
    found = denoise_tracks(swapped, torch.ones(tracks.shape[:2]))
    assert found.outliers[40:42, [first, second]].all()
    assert found.outliers.sum() <= 6
    assert (found.points - tracks)[40:42].norm(dim=-1).amax() < 0.1 * (swapped - tracks)[40:42].norm(dim=-1).amax()


def test_confidence_counts():
    """What is measured badly, and says so, spoils less."""
    tracks = walk()
    size = rms(tracks - tracks.mean(1, keepdim=True))
    sure = torch.where(normal(*tracks.shape[:2], seed=3) > 0, 1.0, 0.04).double()
    noisy = tracks + 0.02 * size * normal(*tracks.shape) / sure[..., None].sqrt()
    with_weights, without = (denoise_tracks(noisy, w).points - tracks for w in (sure, torch.ones_like(sure)))
    assert rms(with_weights) < 0.8 * rms(without)


@pytest.mark.parametrize("frames", [40, 64, 65, 200])
def test_units_place_and_order_of_joints_do_not_matter(frames):
    tracks = walk(frames) + 5 * normal(frames, 1, 1)
    weights = gaps(*tracks.shape[:2], share=0.1).double()
    found = denoise_tracks(tracks, weights)
    order = torch.arange(tracks.shape[1]).flip(0)
    other = denoise_tracks(tracks[:, order] * 1e-3 + 2, weights[:, order])
    assert_close((other.points - 2) * 1e3, found.points[:, order], rtol=1e-4, atol=1e-1)
    assert_close(other.noise * 1e3, found.noise, rtol=1e-3, atol=1e-6)


@pytest.mark.parametrize("batch", BATCHES)
def test_batches_equal_loops(batch):
    clean = walk(70)
    tracks = clean + 10 * normal(*batch, *clean.shape)
    weights = gaps(*clean.shape[:2], share=0.1).double().expand(tracks.shape[:-1])
    found = denoise_tracks(tracks, weights)
    pairs = zip(tracks.reshape(-1, *clean.shape), weights.reshape(-1, *clean.shape[:2]), strict=True)
    alone = [denoise_tracks(*pair) for pair in pairs]
    for k, whole in enumerate(found):
        parts = torch.stack([a[k] for a in alone]).reshape(whole.shape)
        # Conjugate gradients stop before they have converged everywhere: rounding shows, far below the noise of 10.
        assert_close(whole, parts, rtol=0, atol=0.05)


@pytest.mark.parametrize("frames", [1, 2, 3, 4, 5, 11, 12, 13, 65])
@pytest.mark.parametrize("joints", [1, 2, 5])
def test_degenerate_clips_are_finite(frames, joints):
    some = normal(frames, joints) > 0
    for tracks in (normal(frames, joints, 2), torch.zeros(frames, joints, 2), torch.full((frames, joints, 2), 1e4)):
        for seen in (torch.ones_like(some), torch.zeros_like(some), some, some & (torch.arange(joints) > 0)):
            found = denoise_tracks(tracks, seen.to(tracks))
            assert torch.isfinite(found.points).all() and torch.isfinite(found.noise).all()
            if seen.all() and tracks.std(correction=0) == 0:
                assert_close(found.points, tracks)


@settings(max_examples=30, deadline=None)
@given(st.integers(1, 40), st.integers(1, 4), st.integers(0, 2**31), st.sampled_from([1e-12, 1.0, 1e12]))
def test_wild_tracks_are_finite(frames, joints, seed, scale):
    heavy = normal(frames, joints, 2, seed=seed).pow(9) * scale
    weights = normal(frames, joints, seed=seed + 1).clamp(0, 1)
    found = denoise_tracks(heavy, weights)
    assert torch.isfinite(found.points).all() and torch.isfinite(found.noise).all()


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("dtype", FLOATS)
def test_results_follow_dtype_and_device(dtype, device):
    tracks = walk(30).to(device, dtype)
    found = denoise_tracks(tracks, torch.ones(tracks.shape[:2], dtype=dtype, device=device))
    for value in (found.points, found.weights, found.noise):
        assert (value.dtype, value.device.type) == (dtype, device)


@pytest.mark.parametrize("length", [1, 2, 3, 4, 12, 64])
def test_temporal_modes_are_orthonormal_and_begin_with_parabolas(length):
    modes = temporal_modes(length)
    assert_close(modes.mT @ modes, torch.eye(length, dtype=torch.float64))
    if length > 3:
        assert_close(modes[:, :3].diff(n=3, dim=0), torch.zeros(length - 3, 3, dtype=torch.float64))


def test_spectrum_floor_is_the_level_at_the_end():
    order = torch.arange(64, dtype=torch.float64).clamp_min(1)
    power = torch.stack([1e6 * order**-5 + 7, 1e6 * order**-5, torch.full_like(order, 3.0)])
    floor = spectrum_floor(power)
    assert_close(floor[[0, 2]], torch.tensor([7.0, 3.0], dtype=torch.float64), rtol=0.05, atol=0)
    assert floor[1] < 1e-2 * power[1, -1]


def test_solution_is_that_of_the_normal_equations():
    length, size = 16, 4
    y, x = normal(1, 2, length, size).cumsum(2), torch.zeros(1, 2, length, size, dtype=torch.float64)
    w = normal(1, 2, length, size, seed=1).clamp(0, 1)
    model = _Model(length, y)
    model.fit(y, x, w)
    found = model.solve(y, x, w, 500, tolerance=1e-24)
    rows = torch.eye(length * size, dtype=torch.float64).reshape(1, -1, length, size)
    prior = model._from_modes(model.ratio * model._to_modes(rows)).reshape(length * size, -1)
    assert_close(prior, prior.mT)
    for h in range(2):
        exact = torch.linalg.solve(torch.diag(w[0, h].flatten()) + prior, (w * y)[0, h].flatten())
        assert_close(found[0, h].flatten(), exact, rtol=1e-6, atol=1e-6 * math.sqrt(length))


def strides(frames=120):
    """Tracks (T, N, 2) of a walk whose feet stand still two frames in three and then go far at once."""
    tracks = walk(frames)
    time = torch.arange(frames) % 12
    swing = torch.where(time < 8, 0.0, ((time - 8) / 4 * math.pi).sin()).double()
    tracks[:, [3, 6]] += 400 * swing[:, None, None] * torch.tensor([1.0, -0.3], dtype=torch.float64)
    return tracks


def test_quick_strides_are_no_outliers():
    tracks = strides()
    found = denoise_tracks(tracks, torch.ones(tracks.shape[:2]))
    assert not found.outliers.any()
    tracks[40, 2] += 500
    tracks[77, 10] -= 500
    assert denoise_tracks(tracks, torch.ones(tracks.shape[:2])).outliers.nonzero().tolist() == [[40, 2], [77, 10]]


def test_what_joints_do_together_is_no_noise():
    """A camera that shakes moves all joints; white noise moves each for itself."""
    tracks = walk(120)
    size = rms(tracks - tracks.mean(1, keepdim=True))
    shaken = tracks + 0.02 * size * normal(120, 1, 2)
    ones = torch.ones(tracks.shape[:2])
    assert float(denoise_tracks(shaken, ones).noise.mean()) < 0.004 * size
    assert rms(denoise_tracks(shaken, ones).points - shaken) < 0.003 * size
    both = denoise_tracks(shaken + 0.02 * size * normal(120, 17, 2, seed=1), ones)
    assert float(both.noise.mean()) > 0.016 * size


def test_what_is_left_counts_weights():
    """Tracks of weight w have noise of variance s^2 / w, of which as much is left as of the same noise at weight 1."""
    tracks = walk(120)
    noisy = tracks + 5 * normal(*tracks.shape)
    one, other = (denoise_tracks(noisy, torch.full(tracks.shape[:2], w, dtype=torch.float64)).left for w in (1.0, 0.3))
    assert_close(other, one, rtol=0.1, atol=0)
    assert float(denoise_tracks(tracks, torch.ones(tracks.shape[:2])).left.max()) < 1e-3


def test_slow_modes_tell_noise_only_where_they_may():
    """Of a motion that joints share little of, in a clip of few frames a second."""
    time = torch.arange(100, dtype=torch.float64)[:, None, None]
    own = torch.rand(3, 1, 12, 2, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    tracks = 100 * torch.sin(2 * math.pi * (0.1 + 0.12 * own[0]) * time + 6 * own[1]) + 1000 * own[2]  # 6 to 14 periods
    told = [float(denoise_tracks(tracks, torch.ones(tracks.shape[:2]), quick=quick).noise.mean()) for quick in (12, 24)]
    assert told[0] > 10 and told[1] < 1


def test_what_does_not_fit_is_refused():
    """Transposed weights were those of other joints."""
    tracks, weights = normal(20, 20, 2), torch.ones(20, 20).double().requires_grad_()
    assert not any(part.requires_grad for part in denoise_tracks(tracks.requires_grad_(), weights))
    with pytest.raises(ShapeError, match=r"weights: expected a tensor of shape \(20, 8\), got shape \(8, 20\)"):
        denoise_tracks(tracks[:, :8], weights[:8])
    with pytest.raises(ShapeError, match=r"weights: expected a tensor of shape \(20, 20\), got float"):
        denoise_tracks(tracks, 1.0)
    with pytest.raises(ShapeError, match="denoise_tracks: tracks: expected floating point, got torch.int64"):
        denoise_tracks(tracks.long(), weights)
    with pytest.raises(ShapeError, match=r"time: expected shape \(20,\), got \(19,\)"):
        denoise_tracks(tracks, weights, time=torch.arange(19))


def test_frames_that_were_left_out_make_no_leap():
    """Joints that move on by ten frames' way from one frame to the next are no outliers where ten frames passed."""
    time = torch.cat([torch.arange(20), torch.arange(30, 50)])
    tracks = 10.0 * time[:, None, None].double() + normal(1, 8, 2)
    weights = torch.ones(40, 8)
    assert bool(denoise_tracks(tracks, weights).outliers.any())
    assert not bool(denoise_tracks(tracks, weights, time=time).outliers.any())


def test_where_a_joint_may_be_in_motion():
    """As far from the middle line as others, and half as much more; not where one line leads alone, as at an end."""
    at = torch.tensor([0.0, 0, 0, 1, 3, 6, 10, 15, 21], dtype=torch.float64)
    places = torch.stack([at, 0 * at], -1)[None, :, None]
    seen = torch.ones(1, 9, 1) > 0
    assert in_motion(places, seen)[0, :, 0].tolist() == [True] * 8 + [False]  # one line says nothing of others
    places[0, 4, 0, 1] = 6.0
    assert not bool(in_motion(places, seen)[0, 4, 0])
    places[0, 4, 0, 1] = 0.5
    assert bool(in_motion(places, seen)[0, 4, 0])
    assert not bool(in_motion(places[:, :1], seen[:, :1]).any())  # nothing is around


@pytest.mark.parametrize("shape", [(0, 20, 4, 2), (0, 4, 2), (3, 0, 4, 2), (20, 0, 2)])
def test_nothing_to_denoise(shape):
    found = denoise_tracks(torch.zeros(shape), torch.ones(shape[:-1]))
    assert found.points.shape == shape and found.weights.shape == found.outliers.shape == shape[:-1]
    assert found.noise.shape == found.left.shape == (*shape[:-3], shape[-2])
