"""The objective of hypotheses: its terms by hand, its gradient, and that the true motion is better than others."""

import itertools
from dataclasses import replace

import pytest
import torch
from numerics import gradcheck, normal
from torch.testing import assert_close

from kcs_torch.data import walking_person
from kcs_torch.functional import bone_lengths, bone_vectors
from kcs_torch.methods.pkc.objective import Objective, Weights, at_rate
from kcs_torch.skeleton import SKELETONS


def walk(frames=40, skeleton="h36m17", fps=30.0, **options):
    """A walk before a fixed camera, centred, a person of about 1.75 (rms distance 0.5): (T, N, 3)."""
    points = walking_person(frames, skeleton=skeleton, fps=fps, **{"turn": 0.0, "yaw": 40.0, **options}).points
    points = points - points.mean(1, keepdim=True)
    return points / points.square().sum(-1).mean().sqrt() * 0.5


def objective(points, skeleton="h36m17", rate=30.0, **options):
    weights = at_rate(options.pop("weights", Weights()), rate)
    noise = options.pop("noise", torch.zeros_like(points[..., 0]))
    return Objective(SKELETONS[skeleton], points[..., :2], weights, noise=noise, **options)


def state_of(found, points):
    lengths = bone_lengths(points, found.bones).mean(-2)
    return found.pack(points[None, ..., 2], lengths[None])


@pytest.mark.parametrize("skeleton", ["h36m17", "coco17", "mediapipe33"])
def test_packing_is_undone(skeleton):
    """Virtual joints are no unknowns: they follow their sources."""
    points = walk(5, skeleton)
    found = objective(points, skeleton)
    body = SKELETONS[skeleton]
    depth, lengths = points[None, ..., 2], bone_lengths(points, found.bones).mean(0)[None]
    state = found.pack(depth, lengths)
    assert state.shape == (1, 5 * body.num_observed + body.num_bones)
    again, same = found.unpack(state)
    assert_close(again, depth)
    assert_close(same, lengths)
    wild = normal(1, 5, body.num_joints)
    once = found.unpack(found.pack(wild, lengths))[0]
    whole = torch.cat([normal(5, body.num_observed, 2), wild[0, :, : body.num_observed, None]], -1)
    assert_close(once[0], body.complete(whole)[0][..., 2])


def test_terms_by_hand():
    points = walk(6)
    found = objective(points)
    lengths = bone_lengths(points, found.bones).mean(0)
    off = points + 0.02 * normal(6, 17, 3) * torch.tensor([0.0, 0.0, 1.0])
    terms = found.terms(found.pack(off[None, ..., 2], 1.05 * lengths[None]))
    bend = bone_vectors(off, found.bones)[..., 2].diff(n=2, dim=0)
    assert_close(terms["smoothness"], (bend.square().sum() / (2 * 0.05**2))[None])
    assert_close(terms["posture"], found.posture(off, 1.05 * lengths)[None])
    assert_close(terms["foreshortening"], found.foreshortening(off, 1.05 * lengths)[None])
    assert_close(terms["proportions"], found.proportions(lengths)[None])
    assert "anchor" not in terms and all(v.shape == (1,) for v in terms.values())
    assert_close(found(found.pack(off[None, ..., 2], 1.05 * lengths[None])), sum(terms.values()))
    anchored = objective(points, anchor=lengths)
    anchor = anchored.terms(anchored.pack(off[None, ..., 2], 1.05 * lengths[None]))["anchor"]
    assert anchor.item() == pytest.approx(16 * (torch.tensor(1.05).log().item() / 0.01) ** 2 / 2, rel=1e-5)


def test_lengths_are_kept_the_less_the_noisier_the_image():
    points = walk(6)
    right = bone_lengths(points, objective(points).bones).mean(0)
    sizes = torch.tensor([1.0, 1.01, 1.02, 1.05, 1.2]).double()[:, None] * right
    values = []
    for noise in (0.0, 0.003, 0.02):
        found = objective(points, noise=torch.full((6, 17), noise).double())
        values.append(found.terms(found.pack(points[None, ..., 2].expand(5, -1, -1), sizes))["length"])
    for stiff, soft in itertools.pairwise(values):
        assert stiff[0] < 1e-6 and (stiff.diff() > 0).all() and (soft[1:] < stiff[1:]).all()


def test_flexible_bones_may_change_their_length():
    points = walk(6)
    right = bone_lengths(points, SKELETONS["h36m17"].bone_index()).mean(0)
    wrong = right * torch.tensor([2.0] + [1.0] * 15)
    for flexible, free in (((0,), True), ((1,), False)):
        body = replace(SKELETONS["h36m17"], flexible=flexible)
        found = Objective(body, points[..., :2], Weights(), noise=torch.zeros(6, 17).double())
        assert (found.terms(found.pack(points[None, ..., 2], wrong[None]))["length"] < 1e-6) == free


@pytest.mark.parametrize("frames", [1, 2, 3, 8])
def test_gradient(frames):
    points = walk(8)[:frames]
    found = objective(points)
    assert gradcheck(found, state_of(found, points) + 0.01 * normal(1, frames * 17 + 16), fast=True)
    still = points[:1].expand(frames, -1, -1)
    found = objective(still)
    assert gradcheck(found, state_of(found, still), fast=True)
    flat = torch.cat([still[..., :2], 0 * still[..., 2:]], -1)
    assert gradcheck(objective(flat), state_of(found, still) * 0, fast=True)


def test_where_nothing_is_seen_it_stays_finite():
    for points in (torch.zeros(4, 17, 3).double(), walk(4) * torch.tensor([0.0, 1.0, 1.0])):
        found = objective(points)
        depth, lengths, energy, _ = found.minimise(0 * points[None, ..., 2], found.posture.rest_lengths[None], 5)
        assert all(torch.isfinite(x).all() for x in (depth, lengths, energy))


@pytest.mark.parametrize("yaw", [0.0, 45.0, 90.0, 200.0])
def test_the_true_motion_is_best(yaw):
    """Better than its mirror image, than flat, than each limb flipped, than other lengths, than a wooden walk."""
    points = walk(yaw=yaw)
    found = objective(points)
    depth, lengths = points[..., 2], bone_lengths(points, found.bones).mean(0)
    dz = depth[:, found.bones[:, 1]] - depth[:, found.bones[:, 0]]
    others = [depth.mean(0, keepdim=True).expand_as(depth)]
    for name in ("left_knee-left_ankle", "right_hip-right_knee", "left_elbow-left_wrist"):
        flipped = dz.clone()
        flipped[:, found.skeleton.bone_names.index(name)] *= -1
        other = flipped @ found.tree.mT
        if (other - other.mean(-1, keepdim=True) - depth).abs().max() > 0.1:  # else the bone lies in the image plane
            others.append(other - other.mean(-1, keepdim=True))
    with torch.no_grad():
        true = found(found.pack(depth[None], lengths[None]))
        for other in others:
            assert found(found.pack(other[None], lengths[None])) > true
        for other in (-depth, 0 * depth):
            assert found(found.pack(other[None], lengths[None])) > true + 100
        assert found(found.pack(depth[None], 1.1 * lengths[None])) > true + 5


def test_minimise_lowers_sorts_and_keeps_good_starts():
    points = walk()
    found = objective(points)
    lengths = bone_lengths(points, found.bones).mean(0)
    depth = torch.stack([-points[..., 2], points[..., 2] + 0.02 * normal(40, 17)])
    before = found(found.pack(depth, lengths.expand(2, -1)))
    z, sizes, energy, solution = found.minimise(depth, lengths.expand(2, -1), 25)
    assert (energy.diff() >= 0).all() and (energy < before.flip(0)).all()
    assert_close(energy, found(found.pack(z, sizes)))
    assert solution.iterations >= 1
    assert (z[0] - points[..., 2]).square().mean().sqrt() < 0.05
    alone = found.minimise(depth[1:], lengths[None], 25)
    assert_close(alone[2][0], energy[0], rtol=1e-3, atol=0)


def test_frame_rates_count_alike():
    """Twice the frames a second: each tells half as much, so that the terms stay about the same."""
    slow, fast = walk(60), walk(120, fps=60.0)
    values = []
    for points, rate in ((slow, 30.0), (fast, 60.0)):
        found = objective(points, rate=rate, weights=replace(Weights(), length=0.05))
        off = points * torch.tensor([1.0, 1.0, 0.8])  # not the best, or all terms were small
        values.append({k: float(v) for k, v in found.terms(state_of(found, off)).items()})
    for name in ("posture", "hinges", "foreshortening", "proportions"):
        assert values[1][name] == pytest.approx(values[0][name], rel=0.15, abs=0.5), name
    assert at_rate(Weights(), 30.0) == Weights()
    assert at_rate(Weights(), 60.0).acceleration == pytest.approx(Weights().acceleration / 4)
