"""Time: gaps, windows, seams, and the best path."""

import itertools

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from numerics import DEVICES, FLOATS, finite, gradcheck, leaves_arguments_alone, normal, same_as_loop
from torch.testing import assert_close

from kcs_torch.errors import OptionError, ShapeError
from kcs_torch.functional import best_path, blend_windows, interpolate, standing, window_starts

# ---------------------------------------------------------------------- gaps


@given(st.integers(1, 12), st.integers(0, 10**6))
@settings(max_examples=40, deadline=None)
def test_interpolate_is_that_of_numpy(frames, seed):
    values = normal(frames, 3, 2, seed=seed)
    seen = normal(frames, 3, seed=seed + 1) > 0
    seen[seed % frames] = True  # each joint somewhere
    filled = leaves_arguments_alone(interpolate, values, seen)
    time = np.arange(frames)
    for joint, axis in itertools.product(range(3), range(2)):
        known = seen[:, joint].numpy()
        expected = np.interp(time, time[known], values[known, joint, axis].numpy())
        assert_close(filled[:, joint, axis], torch.from_numpy(expected))


def test_interpolate_keeps_what_is_seen():
    values, seen = normal(6, 4, 2), normal(6, 4, seed=1) > 0
    assert torch.equal(interpolate(values, seen)[seen], values[seen])
    assert torch.equal(interpolate(values, torch.ones(6, 4, dtype=torch.bool)), values)


def test_joint_never_seen_takes_the_mean_of_the_others():
    values, seen = normal(5, 4, 2), torch.ones(5, 4, dtype=torch.bool)
    seen[:, 2] = False
    assert_close(interpolate(values, seen)[:, 2], values[:, [0, 1, 3]].mean(1))


def test_nothing_seen_gives_zero():
    assert torch.equal(interpolate(normal(5, 4, 2), torch.zeros(5, 4, dtype=torch.bool)), torch.zeros(5, 4, 2).double())


def test_interpolate_takes_batches_and_frames():
    values, seen = normal(2, 3, 6, 4, 2), normal(2, 3, 6, 4, seed=1) > 0
    parts = [interpolate(v, s) for v, s in zip(values.flatten(0, 1), seen.flatten(0, 1), strict=True)]
    assert_close(interpolate(values, seen), torch.stack(parts).reshape(values.shape))
    frame = torch.tensor([True, False, True, True, False, True])[:, None]  # the same for all joints
    assert_close(interpolate(values, frame), interpolate(values, frame.expand(2, 3, 6, 4)))


def test_interpolate_gradient():
    seen = normal(6, 4, seed=1) > 0
    seen[:, 2] = False
    assert gradcheck(lambda x: interpolate(x, seen), normal(6, 4, 2))
    (grad,) = finite(lambda x: interpolate(x, seen), normal(6, 4, 2))
    assert torch.equal(grad[~seen], torch.zeros_like(grad[~seen]))


# ---------------------------------------------------------------------- windows


@given(st.integers(1, 400), st.integers(1, 60), st.integers(0, 59))
@settings(max_examples=100, deadline=None)
def test_windows_cover_all_frames_and_overlap(length, window, overlap):
    if overlap >= window:
        with pytest.raises(OptionError, match="overlap"):
            window_starts(length, window, overlap)
        return
    starts = window_starts(length, window, overlap)
    size = min(window, length)
    assert starts[0] == 0 and starts[-1] == length - size
    for a, b in itertools.pairwise(starts):
        assert a < b and a + size - b >= overlap
    if length > window:  # no more windows than it takes
        assert (len(starts) - 1) * (window - overlap) + overlap < length


def test_negative_overlap_is_refused():
    with pytest.raises(OptionError, match=r"0\.\.3"):
        window_starts(10, 4, -1)


@given(st.integers(1, 60), st.integers(1, 20), st.integers(0, 19))
@settings(max_examples=40, deadline=None)
def test_blending_windows_of_one_signal_gives_it_back(length, window, overlap):
    starts = window_starts(length, window, min(overlap, window - 1))
    size = min(window, length)
    signal = normal(length, 3, 2)
    parts = torch.stack([signal[s : s + size] for s in starts])
    assert_close(leaves_arguments_alone(lambda p: blend_windows(p, starts, length), parts), signal)


def test_blending_fades_evenly():
    parts = torch.stack([torch.zeros(6), torch.ones(6)]).double()
    blended = blend_windows(parts, [0, 4], 10)
    assert_close(blended, torch.tensor([0, 0, 0, 0, 1 / 3, 2 / 3, 1, 1, 1, 1], dtype=torch.float64))
    assert gradcheck(lambda p: blend_windows(p, [0, 4], 10), parts)


# ---------------------------------------------------------------------- paths


def path_cost(cost, transition, path):
    steps = range(len(cost) - 1)
    return sum(cost[t, s] for t, s in enumerate(path)) + sum(transition[t, path[t], path[t + 1]] for t in steps)


@given(st.integers(1, 6), st.integers(1, 3), st.integers(0, 10**6))
@settings(max_examples=60, deadline=None)
def test_best_path_is_the_best(frames, states, seed):
    cost, transition = normal(frames, states, seed=seed), normal(frames - 1, states, states, seed=seed + 1)
    path = leaves_arguments_alone(best_path, cost, transition)
    brute = min(itertools.product(range(states), repeat=frames), key=lambda p: path_cost(cost, transition, p))
    assert tuple(path.tolist()) == brute


def test_best_path_of_many_frames_is_that_of_viterbi():
    cost, transition = normal(300, 4), normal(299, 4, 4, seed=1)
    total, back = cost[0], []
    for t in range(1, 300):
        best = (total[:, None] + transition[t - 1]).min(0)
        back.append(best.indices)
        total = best.values + cost[t]
    path = [int(total.argmin())]
    for b in reversed(back):
        path.append(int(b[path[-1]]))
    assert best_path(cost, transition).tolist() == path[::-1]


# ---------------------------------------------------------------------- all of them


# ---------------------------------------------------------------------- standing


def steps(frames=60):
    """Two feet that stand and move by turns, fifteen frames each: (T, 2, 2) and whether they move (T, 2)."""
    moves = torch.stack([torch.arange(frames) // 15 % 2 == 0, torch.arange(frames) // 15 % 2 == 1], -1)
    path = (moves * torch.linspace(0.9, 1.1, frames).double()[:, None]).cumsum(0)
    return torch.stack([path, 0 * path], -1), moves


def test_feet_that_stop_stand():
    image, moves = steps()
    sure = leaves_arguments_alone(standing, image, torch.ones(60, 2).double())
    inside = torch.ones(60, dtype=torch.bool)
    inside[14::15] = inside[15::15] = False  # where one starts or stops
    assert (sure[inside & ~moves[:, 0], 0] == 1).all() and (sure[inside & moves[:, 0], 0] < 1e-6).all()
    assert_close(standing(1e-200 * image + 5, torch.ones(60, 2).double()).amax(), torch.ones(()).double())
    for factor in (1e-3, 1e200):
        assert_close(standing(factor * (image + 7), torch.ones(60, 2).double()), sure)


def test_unseen_feet_do_not_stand_nor_tell_the_top_speed():
    image, _ = steps()
    weights = torch.ones(60, 2).double()
    weights[20:30, 0] = 0
    spoiled = image.clone()
    spoiled[20:30, 0] = 1e6
    sure = standing(spoiled, weights)
    assert (sure[19:31, 0] == 0).all() and (sure[32:44, 1] > 0.9).all()
    for frames in (1, 2):
        assert (standing(image[:frames], weights[:frames]) == 0).all()
    assert (standing(image, 0 * weights) == 0).all()
    assert standing(image[:, :0], weights[:, :0]).shape == (60, 0)
    assert (standing(torch.full((9, 2, 2), 3.0), torch.ones(9, 2)) == 1).all()


def test_unseen_feet_may_be_nan_and_numbers_may_be_short():
    image, weights = normal(60, 2, 2).cumsum(0), torch.ones(60, 2).double()
    weights[20, 1] = 0
    spoiled = image.clone()
    spoiled[20, 1] = torch.nan
    assert_close(standing(spoiled, weights), standing(image, weights))
    assert_close(standing(spoiled, torch.ones_like(weights)), standing(image, weights))
    assert_close(standing(spoiled.half(), weights.half()), standing(image, weights).half(), atol=0.05, rtol=0)
    assert standing(image[None][:0], weights[None][:0]).shape == (0, 60, 2)


def test_standing_of_whole_pixels_is_no_whole_number():
    """It was 0 or 1, cut off; and of short clips of the weights' type."""
    image = torch.tensor([0, 0, 0, 0, 10, 30, 60, 90])[:, None, None].expand(-1, 1, 2)
    found = standing(image, torch.ones(8, 1))
    assert_close(found, standing(image.float(), torch.ones(8, 1)))
    assert bool(((found > 0.001) & (found < 0.999)).any())
    short = standing(torch.zeros(2, 2, 1, 2), torch.ones(2, 1, dtype=torch.bool))
    assert (short.dtype, short.shape) == (torch.float32, (2, 2, 1))


def test_standing_takes_batches():
    same_as_loop(lambda p, w: standing(p, (w > -1).double()), (9, 3, 2), (9, 3))


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("dtype", FLOATS)
def test_results_follow_dtype_and_device(dtype, device):
    values = normal(6, 4, 2, dtype=dtype, device=device)
    results = [
        interpolate(values, torch.ones(6, 4, dtype=torch.bool, device=device)),
        blend_windows(torch.stack([values, values]), [0, 4], 10),
    ]
    assert {(v.dtype, v.device.type) for v in results} == {(dtype, device)}
    assert best_path(values[:, :, 0], values.new_zeros(5, 4, 4)).device.type == device


def test_what_does_not_fit_is_told():
    points = normal(9, 5, 2)
    for seen in (torch.ones(7, 5).bool(), torch.ones(9, 5), None):
        with pytest.raises(ShapeError, match="interpolate: seen: expected"):
            interpolate(points, seen)
    with pytest.raises(ShapeError, match="blend_windows: expected parts"):
        blend_windows(torch.zeros(0, 3, 2), [], 5)
    with pytest.raises(ShapeError, match="blend_windows: expected parts"):
        blend_windows(torch.zeros(2, 3, 2), [0], 5)
    assert best_path(torch.zeros(2, 0, 3), torch.zeros(2, 0, 3, 3)).shape == (2, 0)
    for starts in ([0, 5], [0, 4], [0, 6], [-1, 2], [1, 5]):
        with pytest.raises(
            OptionError, match=r"blend_windows: starts: expected starts of windows of 3 frames that cover"
        ):
            blend_windows(torch.zeros(2, 3, 2), starts, 8)
    assert torch.equal(blend_windows(torch.ones(2, 3, 2), [3, 0], 6), torch.ones(6, 2))
