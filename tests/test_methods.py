"""What every method keeps to, on ordinary clips and at the edges: finite numbers, invariances, no side effects."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from method_clips import BODY, CASES, CLIP, NAN, WALK, check, half, hidden, image_of, quiet, tracks_of
from torch.testing import assert_close

from kcs_torch import METHODS, Tracks, reconstruct
from kcs_torch.data import walking_person


@quiet
@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("case", CASES)
def test_every_case(case, method):
    tracks = CASES[case]()
    before = tracks.points.clone(), tracks.weights.clone()
    result = reconstruct(tracks, method=method)
    check(result, tracks)
    assert torch.equal(tracks.points, before[0]) and torch.equal(tracks.weights, before[1])
    assert result.method == method


@quiet
@pytest.mark.parametrize("method", METHODS)
def test_known_cameras_hold_at_the_edges(method):
    for tracks in (hidden(0), hidden([2, 3]), half(), tracks_of(WALK.float())):
        cameras = CLIP.cameras.to(tracks.points)
        result = reconstruct(tracks, method=method, cameras=cameras.tolist())
        check(result, tracks)
        assert_close(result.cameras, cameras)


@st.composite
def wild_tracks(draw):
    """Few frames and joints, values that repeat or lie far apart, gaps, weights, and any graph of bones."""
    frames, joints = draw(st.integers(1, 6)), draw(st.integers(2, 6))
    numbers = st.one_of(st.sampled_from([0.0, 1.0, 100.0]), st.floats(-1e4, 1e4), st.floats(-1e-3, 1e-3))
    shape = (frames, joints, 2)
    points = np.array(draw(st.lists(numbers, min_size=frames * joints * 2, max_size=frames * joints * 2))).reshape(
        shape
    )
    weights = st.sampled_from([0.0, 0.31, 0.7, 1.0, 1.0])
    confidence = np.array(draw(st.lists(weights, min_size=frames * joints, max_size=frames * joints)))
    confidence[draw(st.integers(0, frames * joints - 1))] = 1.0
    pairs = [(a, b) for b in range(joints) for a in range(b)]
    edges = draw(st.lists(st.sampled_from(pairs), unique=True, max_size=joints))
    dtype = draw(st.sampled_from([torch.float32, torch.float64]))
    return Tracks.from_arrays(torch.tensor(points, dtype=dtype), confidence.reshape(frames, joints), edges=edges)


@quiet
@pytest.mark.parametrize("method", METHODS)
@settings(max_examples=25, deadline=None, derandomize=True)
@given(tracks=wild_tracks())
def test_wild_tracks(method, tracks):
    check(reconstruct(tracks, method=method), tracks)


# ---------------------------------------------------------------------- side effects


@quiet
@pytest.mark.parametrize("method", METHODS)
def test_no_global_is_changed_and_numbers_repeat(method):
    tracks = hidden([2, 3], [4, 5])
    torch.manual_seed(5)
    np.random.seed(5)  # noqa: NPY002
    state = lambda: (  # noqa: E731
        torch.get_num_threads(),
        torch.get_default_dtype(),
        torch.is_grad_enabled(),
        torch.get_rng_state().tolist(),
        np.random.get_state()[1].tolist(),  # noqa: NPY002
        torch.get_default_device(),
    )
    before = state()
    first = reconstruct(tracks, method=method)
    assert state() == before
    torch.manual_seed(6)
    second = reconstruct(tracks, method=method)
    for field in ("points", "cameras", "scales", "lengths"):
        assert torch.equal(getattr(first, field), getattr(second, field)), field


def test_gradients_are_neither_needed_nor_kept():
    tracks = replace(CLIP.tracks, points=WALK.clone().requires_grad_())
    for method in METHODS:
        with torch.enable_grad():
            assert not reconstruct(tracks, method=method).points.requires_grad
        with torch.inference_mode():
            made = replace(CLIP.tracks, points=1.0 * WALK, weights=1.0 * CLIP.tracks.weights)  # within, and so frozen
            assert made.points.is_inference() and made.weights.is_inference()
            result = reconstruct(made, method=method, cameras=1.0 * CLIP.cameras)
        check(result, made)
        assert not result.points.is_inference()


@quiet
@pytest.mark.parametrize("method", METHODS)
def test_autocast_is_for_networks(method):
    tracks = CLIP.tracks.to(torch.float32)
    expected = reconstruct(tracks, method=method)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        found = reconstruct(tracks, method=method)
    assert torch.equal(found.points, expected.points)


ROUNDING = dict.fromkeys(METHODS, 1e-3) | {"pkc": 5e-3}


"""What rounding may change, a share of the body: PKC's quasi-Newton steps, cut off at a number, make 1e-3 of 1e-14."""


def relative(a, b):
    return float((a - b).abs().max() / b.std())


# ---------------------------------------------------------------------- invariances


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("factor", [1e-3, 1e3])
def test_scaled_tracks_scale_the_result(method, factor):
    plain = reconstruct(CLIP.tracks, method=method)
    scaled = reconstruct(tracks_of(WALK * factor), method=method)
    assert relative(scaled.points / factor, plain.points) < ROUNDING[method]
    assert_close(scaled.cameras, plain.cameras, rtol=0, atol=ROUNDING[method])
    assert_close(scaled.lengths, factor * plain.lengths, rtol=ROUNDING[method], atol=0)


@pytest.mark.parametrize("method", METHODS)
def test_shifted_tracks_shift_the_result(method):
    shift = torch.tensor([2000.0, -700.0, 0.0]).double()
    plain = reconstruct(CLIP.tracks, method=method)
    shifted = reconstruct(tracks_of(WALK + shift[:2]), method=method)
    assert relative(shifted.points - shift, plain.points) < ROUNDING[method]
    drift = torch.linspace(0, 900, 12)[:, None, None] * shift.double() / 2000  # another shift in each frame
    method = METHODS[method]().following()  # feet do not stand still in such an image
    plain, moving = method(CLIP.tracks), method(tracks_of(WALK + drift[..., :2]))
    assert relative(moving.points - drift, plain.points) < ROUNDING[method.name]


ORDER = torch.randperm(17, generator=torch.Generator().manual_seed(3)).tolist()


def reordered(body):
    """The same body with its joints in ORDER."""
    where = {old: new for new, old in enumerate(ORDER)}
    ends = ("parent", "joint", "child", "left", "right")
    return replace(
        body,
        joints=tuple(body.joints[i] for i in ORDER),
        bones=tuple((where[a], where[b]) for a, b in body.bones),
        mirror=tuple((where[a], where[b]) for a, b in body.mirror),
        template=tuple(body.template[i] for i in ORDER),
        hinges=tuple(replace(h, **{end: where[getattr(h, end)] for end in ends}) for h in body.hinges),
        contacts=tuple(where[i] for i in body.contacts),
    )


@pytest.mark.parametrize("known", [False, True])
@pytest.mark.parametrize("method", METHODS)
def test_the_order_of_joints_does_not_matter(method, known):
    clip = walking_person(60, turn=120.0, yaw=0.0)
    cameras = clip.cameras if known else None
    plain = reconstruct(clip.tracks, method=method, cameras=cameras)
    other = reconstruct(
        tracks_of(clip.tracks.points[:, ORDER], skeleton=reordered(BODY)), method=method, cameras=cameras
    )
    assert other.method == plain.method
    assert relative(other.points, plain.points[:, ORDER]) < ROUNDING[method]


@quiet
@pytest.mark.parametrize("method", METHODS)
def test_confidence_zero_is_the_same_as_nan(method):
    gone = torch.rand(12, 17, generator=torch.Generator().manual_seed(2)) < 0.3
    by_nan = reconstruct(torch.where(gone[..., None], NAN, WALK), method=method, skeleton=BODY)
    spoiled = torch.where(gone[..., None], WALK + 1e4, WALK)
    by_zero = reconstruct(spoiled, method=method, skeleton=BODY, confidence=(~gone).double())
    assert torch.equal(by_nan.points, by_zero.points)
    assert torch.equal(by_nan.cameras, by_zero.cameras)


@quiet
@pytest.mark.parametrize("method", METHODS)
def test_weights_are_soft(method):
    """The image follows a wrong joint the more, the more it is trusted."""
    spoiled = WALK.clone()
    spoiled[:, 16] += 150.0  # not so far that PKC drops it, whatever the trust
    away = []
    for trust in (0.0, 0.35, 1.0):
        confidence = torch.ones(12, 17, dtype=torch.float64)
        confidence[:, 16] = trust
        found = reconstruct(spoiled, method=method, skeleton=BODY, confidence=confidence, cameras=CLIP.cameras)
        away.append(float((image_of(found)[:, 16] - spoiled[:, 16]).norm(dim=-1).mean()))
    assert away[0] > 250 and away[1] < 0.2 * away[0] and away[2] < away[1] + 1e-9
