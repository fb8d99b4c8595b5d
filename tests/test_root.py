"""The root's depth from standing feet: walks whose path is known, the energy it minimises, and what it says."""

from dataclasses import replace

import pytest
import torch
from numerics import count_operations
from torch.testing import assert_close

from kcs_torch.data import random_motion, walking_person
from kcs_torch.functional import standing
from kcs_torch.methods.answer import root
from kcs_torch.methods.answer.root import root_depth
from kcs_torch.nn import ContactEnergy


def walk(frames=90, **options):
    """A walk before a fixed camera: tracks, points relative to the body's middle in depth, the true path (T,)."""
    clip = walking_person(frames, **{"turn": 0.0, "yaw": 0.0, **options})
    middle = clip.points[..., 2].mean(1)
    points = clip.points.clone()
    points[..., 2] -= middle[:, None]
    return clip.tracks, points, middle - middle[0]


@pytest.mark.parametrize("yaw", [0.0, 45.0, 90.0, 180.0])
@pytest.mark.parametrize("fps", [30.0, 60.0])
def test_walks_go_where_they_went(yaw, fps):
    tracks, points, true = walk(int(3 * fps), yaw=yaw, fps=fps)
    path, remark = root_depth(points, tracks)
    assert path[0] == 0 and "feet that stand still" in remark
    assert (path - true).abs().max() < 0.15 * true.abs().max() + 60  # mm, of some 4 m
    assert true.abs().max() < 300 or (path - true).abs().max() < 0.2 * true.abs().max()


@pytest.mark.parametrize("factor", [1e-150, 1e-3, 1e3, 1e200])
def test_units_scale_the_path(factor):
    tracks, points, _ = walk()
    plain, _ = root_depth(points, tracks)
    scaled, _ = root_depth(points * factor, replace(tracks, points=tracks.points * factor))
    assert_close(scaled / factor, plain)
    shifted, _ = root_depth(points + 500.0, replace(tracks, points=tracks.points - 900.0))
    assert_close(shifted, plain)


def test_mirror_image_walks_the_other_way():
    tracks, points, _ = walk()
    plain, _ = root_depth(points, tracks)
    assert_close(root_depth(points * torch.tensor([1.0, 1.0, -1.0]), tracks)[0], -plain)


def test_is_a_minimum_of_the_contact_energy():
    tracks, points, _ = walk(40)
    path, _ = root_depth(points, tracks)
    feet = list(tracks.skeleton.contacts)
    sure = standing(tracks.points[:, feet], tracks.weights[:, feet])
    radius = (points - points.mean(1, keepdim=True)).square().sum(-1).mean().sqrt()
    energy = ContactEnergy(tracks.skeleton, slip=root.SLIP, change=root.CHANGE)
    velocity = torch.cat([path.new_zeros(1), path.diff()]) / radius
    least = energy(points / radius, velocity, sure)
    for seed in range(20):
        other = velocity + 1e-3 * torch.randn(40, generator=torch.Generator().manual_seed(seed)).double()
        assert energy(points / radius, other, sure) > least
    leaf = velocity.clone().requires_grad_()
    (gradient,) = torch.autograd.grad(energy(points / radius, leaf, sure), leaf)
    zero = torch.zeros_like(velocity).requires_grad_()
    (usual,) = torch.autograd.grad(energy(points / radius, zero, sure), zero)
    assert gradient.norm() < 0.02 * usual.norm()


def test_long_clips():
    """What is far away hardly matters; the work grows with the clip, the number of operations hardly does."""
    tracks, points, true = walk(900)
    path, _ = root_depth(points, tracks)
    assert (path - true).abs().max() < 0.15 * true.abs().max()
    few = replace(tracks, points=tracks.points[:400], weights=tracks.weights[:400])
    part, _ = root_depth(points[:400], few)
    assert_close(path[:300], part[:300], rtol=0.01, atol=1.0)
    long = count_operations(lambda: root_depth(points, tracks))
    short = count_operations(lambda: root_depth(points[:400], few))
    assert long.elements < 2.4 * short.elements and long.total < 1.5 * short.total


def test_gaps_in_the_feet_are_bridged():
    tracks, points, true = walk()
    weights = tracks.weights.clone()
    weights[30:36, list(tracks.skeleton.contacts)] = 0
    path, _ = root_depth(points, replace(tracks, weights=weights))
    assert (path - true).abs().max() < 0.2 * true.abs().max()


def test_someone_who_stands_stays():
    tracks, points, _ = walk(20)
    still = replace(tracks, points=tracks.points[:1].expand(20, -1, -1), weights=tracks.weights[:1].expand(20, -1))
    path, _ = root_depth(points[:1].expand(20, -1, -1), still)
    assert_close(path, torch.zeros(20).double(), rtol=0, atol=1e-6)
    path, _ = root_depth(0 * points, still)  # a body without size
    assert torch.isfinite(path).all()


def test_single_precision():
    tracks, points, _ = walk()
    small = replace(tracks, points=tracks.points.float(), weights=tracks.weights.float())
    path, _ = root_depth(points.float(), small)
    assert path.dtype == torch.float32
    assert_close(path.double(), root_depth(points, tracks)[0], rtol=1e-3, atol=1.0)


@pytest.mark.parametrize("fps", [2000.0, 1e5, 1e7, 1e9])
def test_fast_cameras(fps):
    tracks, points, _ = walk()
    tracks = replace(tracks, fps=fps)
    path, _ = root_depth(points, tracks)
    small = replace(tracks, points=tracks.points.float(), weights=tracks.weights.float())
    short, _ = root_depth(points.float(), small)
    assert torch.isfinite(path).all()
    assert_close(short.double(), path, rtol=1e-3, atol=0.01 * float(path.abs().max()))


def test_says_why_there_is_none():
    tracks, points, _ = walk(20)
    cut = lambda n: replace(tracks, points=tracks.points[:n], weights=tracks.weights[:n])  # noqa: E731
    for n in (1, 2):
        path, remark = root_depth(points[:n], cut(n))
        assert path is None and "too few frames" in remark
    hand = random_motion("hand21", 20)
    path, remark = root_depth(hand.points, hand.tracks)
    assert path is None and "'hand21' has no contact points" in remark
    gone = tracks.weights.clone()
    gone[:, list(tracks.skeleton.contacts)] = 0
    path, remark = root_depth(points, replace(tracks, weights=gone))
    assert path is None and "hardly ever stand still" in remark
    slide = tracks.points + torch.linspace(0, 9e3, 20)[:, None, None].double()  # the camera moves
    path, remark = root_depth(points, replace(tracks, points=slide))
    assert path is None and "hardly ever stand still" in remark
