"""Weak-perspective resection: known cameras are found, with gaps, outliers, bounds and free scales."""

import math

import pytest
import roma
import torch
from numerics import DEVICES, FLOATS, leaves_arguments_alone, normal, turning
from torch.testing import assert_close

from kcs_torch.skeleton import SKELETONS
from kcs_torch.solvers.pose import fit_cameras

FRAMES = 12
BODY = SKELETONS["h36m17"].template_points(dtype=torch.float64)
FREE = (torch.zeros(FRAMES).double(), torch.full((FRAMES,), math.inf).double())


def scene(degrees=150.0, *, noise=0.0, joints=17):
    """Tracks (T, N, 2) of a body that turns, changes its distance and moves; points, rotations, scales."""
    points = (BODY - BODY.mean(0))[:joints].expand(FRAMES, -1, 3)
    points = points / points.square().sum(-1).mean().sqrt()
    turn = turning(FRAMES, degrees)
    scales = torch.linspace(0.8, 1.3, FRAMES).double()
    tracks = scales[:, None, None] * (points @ turn[:, :2].mT) + normal(FRAMES, 1, 2, seed=1)
    return tracks + noise * normal(*tracks.shape, seed=2), points, turn, scales


def best(fit):
    """Of each frame the start of least cost."""
    choice = fit.cost.argmin(0)
    frame = torch.arange(FRAMES)
    return fit.rotations[choice, frame], fit.scales[choice, frame]


def degrees(a, b):
    return torch.rad2deg(roma.rotmat_geodesic_distance(a, b))


@pytest.mark.parametrize("robust", [None, 0.4])
@pytest.mark.parametrize("bounds", ["wide", "free"])
def test_known_cameras_are_found(robust, bounds):
    tracks, points, turn, scales = scene()
    low, high = (0.5 * scales, 2 * scales) if bounds == "wide" else FREE
    fit = fit_cameras(tracks, points, torch.ones(FRAMES, 17).double(), low, high, robust=robust)
    found, size = best(fit)
    assert degrees(found, turn).max() < 0.01
    assert_close(size, scales, rtol=1e-4, atol=0)
    assert fit.cost.min(0).values.max() < 1e-6


def test_rotations_are_rotations():
    tracks, points, _, scales = scene(noise=0.3)
    fit = fit_cameras(tracks, points, torch.ones(FRAMES, 17).double(), 0.5 * scales, 2 * scales)
    assert_close(fit.rotations @ fit.rotations.mT, torch.eye(3).double().expand_as(fit.rotations))
    assert_close(torch.linalg.det(fit.rotations), torch.ones(8, FRAMES).double())
    assert ((fit.cost >= 0) & (fit.cost <= 1)).all()


def test_least_squares_is_optimal():
    """No small turn, nor another scale, has less error."""
    tracks, points, _, _ = scene(noise=0.1)
    weights = normal(FRAMES, 17, seed=3).abs()
    found, size = best(fit_cameras(tracks, points, weights, *FREE, robust=None, num_steps=40))

    def error(r, s):
        residual = tracks - s[..., None, None] * (points @ r[..., :2, :].mT)
        mean = (residual * weights[..., None]).sum(-2, keepdim=True) / weights.sum(-1)[:, None, None]
        return ((residual - mean).square().sum(-1) * weights).sum(-1)

    nudge = roma.rotvec_to_rotmat(0.02 * normal(100, 1, 3, seed=4))
    assert (error(nudge @ found, size) >= error(found, size) - 1e-12).all()
    assert (error(found, 1.01 * size) > error(found, size)).all()
    assert (error(found, 0.99 * size) > error(found, size)).all()


@pytest.mark.parametrize("bounds", ["wide", "free"])
def test_unseen_joints_do_not_count(bounds):
    tracks, points, turn, scales = scene()
    weights = (normal(FRAMES, 17, seed=5) > -0.5).double()
    weights[:, 3] = 0  # never seen
    low, high = (0.5 * scales, 2 * scales) if bounds == "wide" else FREE
    tracks = torch.where(weights[..., None] > 0, tracks, 1e3 * normal(*tracks.shape, seed=6))
    found, size = best(fit_cameras(tracks, points, weights, low, high, num_steps=30))
    assert degrees(found, turn).max() < 0.01
    assert_close(size, scales, rtol=1e-4, atol=0)


@pytest.mark.parametrize("dtype", FLOATS)
@pytest.mark.parametrize("bounds", ["wide", "free"])
def test_frames_without_any_joint_cost_nothing(dtype, bounds):
    tracks, points, _, scales = scene()
    weights = torch.ones(FRAMES, 17).double()
    weights[4] = 0
    weights[5, 1:] = 0  # a single joint tells nothing either
    low, high = (0.5 * scales, 2 * scales) if bounds == "wide" else FREE
    fit = fit_cameras(*(x.to(dtype) for x in (tracks, points, weights, low, high)))
    for value in (fit.rotations, fit.scales, fit.cost):
        assert torch.isfinite(value).all()
    assert (fit.cost[:, 4] == 0).all()


def test_outliers_are_outvoted():
    tracks, points, turn, scales = scene()
    tracks[:, 2] += 4.0  # one joint far away in every frame
    weights = torch.ones(FRAMES, 17).double()
    robust, _ = best(fit_cameras(tracks, points, weights, 0.5 * scales, 2 * scales, robust=0.2, num_steps=20))
    plain, _ = best(fit_cameras(tracks, points, weights, 0.5 * scales, 2 * scales, robust=None, num_steps=20))
    assert degrees(robust, turn).median() < 3
    assert degrees(plain, turn).median() > 10


def test_scales_keep_their_bounds():
    tracks, points, _, scales = scene()
    low, high = torch.full_like(scales, 0.9), torch.full_like(scales, 1.1)
    fit = fit_cameras(tracks, points, torch.ones(FRAMES, 17).double(), low, high)
    assert ((fit.scales >= low) & (fit.scales <= high)).all()
    assert (fit.scales == 1.1).any() and (fit.scales == 0.9).any()


def test_costs_of_free_scales_tell_headings_apart():
    """A reach measured by an infinite bound made all costs 0."""
    tracks, points, _, scales = scene(noise=0.02)
    weights = torch.ones(FRAMES, 17).double()
    free = fit_cameras(tracks, points, weights, *FREE)
    bound = fit_cameras(tracks, points, weights, 0.99 * scales, 1.01 * scales)
    assert (free.cost > 0).all()
    assert_close(free.cost.min(0).values, bound.cost.min(0).values, rtol=0.5, atol=0)


def test_a_start_comes_first():
    tracks, points, turn, scales = scene()
    weights = torch.ones(FRAMES, 17).double()
    fit = fit_cameras(tracks, points, weights, 0.5 * scales, 2 * scales, start=turn, num_yaws=3)
    assert fit.rotations.shape == (4, FRAMES, 3, 3)
    assert degrees(fit.rotations[0], turn).max() < 1e-3
    alone = fit_cameras(tracks, points, weights, 0.5 * scales, 2 * scales, num_yaws=1)
    assert alone.rotations.shape == (1, FRAMES, 3, 3)


def test_frames_do_not_depend_on_each_other():
    tracks, points, _, scales = scene(noise=0.1)
    weights = (normal(FRAMES, 17, seed=5) > -0.5).double()
    whole = fit_cameras(tracks, points, weights, 0.5 * scales, 2 * scales)
    for t in (0, 7):
        cut = slice(t, t + 1)
        part = fit_cameras(tracks[cut], points[cut], weights[cut], 0.5 * scales[cut], 2 * scales[cut])
        for a, b in [(whole.rotations, part.rotations), (whole.scales, part.scales), (whole.cost, part.cost)]:
            assert_close(a[:, cut], b)


@pytest.mark.parametrize("dtype", FLOATS)
def test_points_in_one_place(dtype):
    tracks, points = torch.zeros(FRAMES, 17, 2, dtype=dtype), torch.zeros(FRAMES, 17, 3, dtype=dtype)
    weights, one = torch.ones(FRAMES, 17, dtype=dtype), torch.ones(FRAMES, dtype=dtype)
    for low, high in [(one, one), (0 * one, math.inf * one)]:
        fit = fit_cameras(tracks, points, weights, low, high)
        for value in (fit.rotations, fit.scales, fit.cost):
            assert torch.isfinite(value).all()


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("dtype", FLOATS)
def test_results_follow_dtype_and_device(dtype, device):
    tracks, points, turn, scales = (x.to(device, dtype) for x in scene())
    weights = torch.ones(FRAMES, 17, dtype=dtype, device=device)

    def run(*arguments):
        fit = fit_cameras(*arguments[:-1], start=arguments[-1])
        return fit.rotations, fit.scales, fit.cost

    values = leaves_arguments_alone(run, tracks, points, weights, 0.5 * scales, 2 * scales, turn)
    assert {(v.dtype, v.device.type) for v in values} == {(dtype, device)}


def test_frames_are_fitted_by_themselves(monkeypatch):
    """Long clips are fitted some frames at a time."""
    tracks, points, turn, scales = scene(noise=0.2)
    weights = normal(FRAMES, 17, seed=3).abs()
    whole = fit_cameras(tracks, points, weights, 0.5 * scales, 2 * scales, start=turn)
    monkeypatch.setattr("kcs_torch.solvers.pose.RUN", 5)
    runs = fit_cameras(tracks, points, weights, 0.5 * scales, 2 * scales, start=turn)
    assert_close(runs.rotations, whole.rotations)
    assert_close(runs.scales, whole.scales)
    assert_close(runs.cost, whole.cost)
