"""Strides: the dynamic programme over runs, and a walk from the front whose thighs bounce off the image plane."""

from __future__ import annotations

from itertools import product

import pytest
import torch
from torch.testing import assert_close

from kcs_torch.data import walking_person
from kcs_torch.functional import bone_lengths, bone_vectors
from kcs_torch.methods.answer.root import standing_feet
from kcs_torch.methods.pkc.body import Body
from kcs_torch.methods.pkc.flips import FIRST, flipped, parts_of
from kcs_torch.methods.pkc.hypotheses import Hypotheses
from kcs_torch.methods.pkc.limbs import limbs_of
from kcs_torch.methods.pkc.strides import cheapest_runs, strides


def brute_force(steps: torch.Tensor, places: list[int], bend: torch.Tensor) -> float:
    """The least cost of one part (2, 2, T - 1) over all signs of its runs."""
    frames = len(bend)
    inner = [p for p in places if 0 < p < frames]
    least = float("inf")
    for signs in product((0, 1), repeat=len(inner) + 1):
        path = torch.tensor([signs[sum(t >= p for p in inner)] for t in range(frames)])
        cost = steps[path[:-1], path[1:], torch.arange(frames - 1)].sum()
        cost = cost + sum(bend[p] for p in inner if path[p] != path[p - 1])
        least = min(least, float(cost))
    return least


@pytest.mark.parametrize("seed", range(5))
def test_runs_are_the_cheapest_of_all(seed: int) -> None:
    make = torch.Generator().manual_seed(seed)
    rand = lambda *shape: torch.rand(*shape, generator=make, dtype=torch.float64)  # noqa: E731
    frames, speeds = 14, 3
    places = torch.tensor([[0, 2, 5, 9, 14], [0, 7, 14, 14, 14], [0, 14, 14, 14, 14], [0, 1, 12, 13, 14]])
    steps, bend = rand(2, 2, speeds, 4, frames - 1), rand(4, frames)
    least, flips = cheapest_runs(steps, places, bend)
    for v, p in product(range(speeds), range(4)):
        assert_close(float(least[v, p]), brute_force(steps[:, :, v, p], places[p].tolist(), bend[p]))
        path = flips[v, p]
        cost = steps[path[:-1], path[1:], v, p, torch.arange(frames - 1)].sum()
        turns = path.diff().nonzero().flatten() + 1
        assert set(turns.tolist()) <= set(places[p].tolist())
        assert_close(cost + bend[p, turns].sum(), least[v, p])


def test_feet_move_with_the_bones_that_lead_to_them():
    clip = walking_person(8, turn=0.0)
    image = clip.points[..., :2] - clip.points[..., :2].mean(1, keepdim=True)
    goal = Body(clip.tracks.skeleton, image, 30.0, torch.zeros_like(image[..., 0])).objective
    own = torch.randn(8, len(goal.bones), generator=torch.Generator().manual_seed(0), dtype=image.dtype)
    depth = goal.joints(own)
    feet = depth[:, list(goal.skeleton.contacts)] - depth[:, goal.posture.trunk].mean(-1, keepdim=True)
    moved = goal.feet_moved()
    assert_close(own @ moved, feet)
    names = clip.tracks.skeleton.bone_names
    assert not moved[names.index("left_shoulder-left_elbow")].any() and moved[names.index("left_hip-left_knee")].any()


def thighs_that_bounce(noise: float = 0.005):
    """A noisy walk from the front, its flips, and its true depths once all of a thigh's are behind the plane."""
    clip = walking_person(80, turn=0.0, yaw=0.0)
    image = clip.points[..., :2] - clip.points[..., :2].mean(1, keepdim=True)
    blur = torch.full_like(image[..., 0], noise)
    scale = Body(clip.tracks.skeleton, image, 30.0, 0 * blur).factor
    body = Body(clip.tracks.skeleton, image, 30.0, blur / scale, standing_feet(clip.tracks))
    objective, names = body.objective, clip.tracks.skeleton.bone_names
    true = bone_vectors((clip.points[..., 2:] * body.factor), objective.bones)[..., 0]
    own = true.clone()
    for name in ("right_hip-right_knee", "left_hip-left_knee"):
        own[:, names.index(name)] = own[:, names.index(name)].abs()
    return objective, true, own


def test_feet_tell_that_thighs_do_not_bounce() -> None:
    objective, true, own = thighs_that_bounce()
    trunk = objective.posture.trunk.tolist()
    parts = parts_of(objective.skeleton, limbs_of(objective.skeleton, trunk))
    lengths = (
        bone_lengths(torch.cat([objective.image, objective.joints(true)[..., None]], -1), objective.bones)
        .median(0)
        .values
    )
    start = Hypotheses(objective.joints(own)[None], lengths[None], torch.zeros(1, dtype=own.dtype))
    wrong = (objective.joints(own) - objective.joints(true)).square().mean().sqrt()
    with_feet = flipped(objective, parts, start)
    left = (with_feet.depth - objective.joints(true)).square().mean((1, 2)).sqrt()
    assert left.min() < 0.3 * wrong
    best = with_feet[:3]
    assert_close(best.energy, objective(best.depth, best.lengths) + objective.ranking(best.depth, best.lengths))
    assert (with_feet.energy.diff() >= 0).all()
    objective.standing = None
    without = flipped(objective, parts, start)
    left = (without.depth - objective.joints(true)).square().mean((1, 2)).sqrt()
    assert left.min() > 0.5 * wrong


def test_flips_of_legs_in_noise_cost_what_their_feet_do() -> None:
    """The room that noise leaves counts on both sides, or feet would be looked at of no flip."""
    objective, true, _ = thighs_that_bounce()
    parts = parts_of(objective.skeleton, limbs_of(objective.skeleton, objective.posture.trunk.tolist()))
    depth = objective.joints(true)[None]
    lengths = bone_lengths(torch.cat([objective.image.expand(1, -1, -1, 2), depth[..., None]], -1), objective.bones)
    lengths = lengths.median(1).values
    best = Hypotheses(depth, lengths, objective(depth, lengths) + objective.ranking(depth, lengths))
    flips = flipped(objective, parts, best)
    flips = flips[flips.energy < best.energy + FIRST[0][0]]
    feet = objective.contact(flips.depth) - objective.contact(depth)
    assert len(feet) and bool((feet.abs() > 0.5).any())
    assert_close(flips.energy, objective(flips.depth, flips.lengths) + objective.ranking(flips.depth, flips.lengths))


def test_feet_that_never_stand_tell_nothing() -> None:
    objective, _, own = thighs_that_bounce()
    member = torch.eye(own.shape[1], dtype=own.dtype)
    places = torch.tensor([[0, 20, 40, 80]]).expand(len(member), -1)
    objective.standing = torch.zeros_like(objective.standing)
    assert not len(strides(objective, own, member, places, torch.zeros_like(own).mT))
    objective.standing = torch.ones_like(objective.standing)
    arms = [i for i, name in enumerate(objective.skeleton.bone_names) if "wrist" in name]
    assert not len(strides(objective, own, member[arms], places[arms], torch.zeros_like(own).mT[arms]))
