"""The energy of a body seen along rays: by hand, its slope, and lengths that another part of the clip told."""

import math

import pytest
import torch
from numerics import CHAIN, gradcheck, normal
from torch.testing import assert_close

from kcs_torch.data import walking_person
from kcs_torch.functional import bone_lengths
from kcs_torch.methods import pinhole
from kcs_torch.methods.pinhole import PinholeEnergy
from kcs_torch.nn import AdductionEnergy
from kcs_torch.solvers.lbfgs import lbfgs


def walk(frames=12, skeleton="h36m17"):
    """Rays, true depths, true distances and lengths of a walk two metres and a half away, in metres."""
    clip = walking_person(frames, skeleton=skeleton, turn=0.0, yaw=60.0)
    points = clip.points / 1000
    points = points - points.mean((0, 1)) + points.new_tensor([0.0, 0.0, 2.5])
    far = points[..., 2].mean(1)
    lengths = bone_lengths(points, clip.skeleton.bones).median(0).values
    return clip.skeleton, points[..., :2] / points[..., 2:], points[..., 2] - far[:, None], far, lengths


@pytest.mark.parametrize("known", [False, True], ids=["free", "known lengths"])
def test_unknowns_there_and_back(known):
    skeleton, rays, depth, far, lengths = walk()
    energy = PinholeEnergy(skeleton, rays, far, depth[None], 30.0, 0.0, lengths[None] if known else None)
    state = energy.pack(depth[None])
    back, size, shares = energy.unpack(state)
    assert_close(back, depth[None])
    assert_close(size, lengths[None])
    assert_close(energy.path(shares), far[None])
    points = energy.points(back, far)
    assert_close(points[..., :2], (rays * (far[:, None] + depth)[..., None])[None])


def test_energy_of_a_chain_by_hand():
    """Without a trunk: lengths, smoothness, the path and the method's depths."""
    frames, rate = 5, 25.0
    rays, depth, near = (
        0.1 * normal(frames, 4, 2),
        0.1 * normal(1, frames, 4, seed=1),
        0.1 * normal(1, frames, 4, seed=2),
    )
    far = 2 + 0.1 * normal(frames, seed=3)
    energy = PinholeEnergy(CHAIN, rays, far, near, rate, 0.01)
    assert not energy.anatomy
    state = energy.pack(depth) + 0.01 * normal(1, frames * 4 + 3 + energy.waves.shape[1], seed=4)
    z, lengths, shares = (x[0] for x in energy.unpack(state))
    path = far * torch.exp(sum(s * w for s, w in zip(shares, energy.waves.T, strict=True)))
    points = torch.cat([rays * (path[:, None] + z)[..., None], z[..., None]], -1)
    slack = math.hypot(pinhole.LENGTH, 0.01)
    total = 0.0
    for b, (i, j) in enumerate(CHAIN.bones):
        off = ((points[:, j] - points[:, i]).square().sum(-1) - lengths[b] ** 2) / (2 * lengths[b])
        total += frames / 2 * torch.log1p((4 * torch.log1p(off**2 / (4 * slack**2))).mean())
        dz = z[:, j] - z[:, i]
        total += (dz[2:] - 2 * dz[1:-1] + dz[:-2]).square().sum() / (2 * (pinhole.ACCELERATION * 1.2**2) ** 2)
        total += (dz - near[0, :, j] + near[0, :, i]).square().sum() / (2 * pinhole.CLOSE**2)
    total += 100 * z.mean(-1).square().sum() + (shares / pinhole.STRAY).square().sum() / 2
    total += (path.diff() * rate / pinhole.SPEED).square().sum() / (2 * pinhole.POSTURE / 1.2)
    assert_close(energy(state), total[None])


@pytest.mark.parametrize("known", [False, True], ids=["free", "known lengths"])
@pytest.mark.parametrize("skeleton", ["h36m17", "coco17", CHAIN])
def test_slope(skeleton, known):
    if skeleton is CHAIN:
        rays, depth, far, lengths = (
            0.1 * normal(6, 4, 2),
            0.1 * normal(6, 4, seed=1),
            2 + 0.1 * normal(6),
            torch.ones(3),
        )
    else:
        skeleton, rays, depth, far, lengths = walk(6, skeleton)
    given = lengths.double().expand(2, -1) if known else None
    start = torch.stack([depth, -depth])
    energy = PinholeEnergy(skeleton, rays, far, start, 30.0, 0.01, given)
    state = energy.pack(start)
    assert gradcheck(energy, state + 0.01 * normal(*state.shape), fast=True)


def test_known_lengths_tell_the_distance():
    """A distance that is wrong by a half comes back, depths with it."""
    skeleton, rays, depth, far, lengths = walk(40)
    wrong = 1.5
    energy = PinholeEnergy(skeleton, rays, wrong * far, wrong * depth[None], 30.0, 0.002, lengths[None])
    start = energy.pack(wrong * depth[None])
    assert_close(energy.path(energy.unpack(start)[2]), far[None], rtol=0.02, atol=0)
    z, own, shares = energy.unpack(lbfgs(energy, start, num_steps=60).value)
    assert torch.equal(own, lengths[None])
    assert_close(energy.path(shares), far[None], rtol=0.05, atol=0)
    assert float((z[0] - depth).square().mean().sqrt()) < 0.03


def test_lengths_count_once_where_they_are_known():
    """What is the same in all blocks of a clip is no reason to prefer a solution in each of them."""
    skeleton, rays, depth, far, lengths = walk()
    for factor in (1.0, 3.0):
        size = lengths * torch.where(torch.arange(len(lengths)) == 2, factor, 1.0).double()
        free, held = (PinholeEnergy(skeleton, rays, far, depth[None], 30.0, 0.01, x) for x in (None, size[None]))
        state = free.pack(depth[None])
        count = depth.numel()
        state[:, count : count + len(size)] = size.log()
        same = torch.cat([state[:, :count], state.new_zeros(1, held.waves.shape[1])], 1)
        assert_close(free(state) - held(same), free.proportions(size[None]))


def test_an_arm_that_reaches_across_the_body_costs(monkeypatch):
    skeleton, rays, depth, far, _ = walk()
    start = 3 * normal(1, *depth.shape)  # limbs anywhere
    energy = PinholeEnergy(skeleton, rays, far, start, 60.0, 0.0)
    state = energy.pack(start)
    z, lengths, shares = energy.unpack(state)
    across = AdductionEnergy(skeleton)(energy.points(z, energy.path(shares)), lengths).sum(-1)
    assert float(across) > 1
    total = energy(state)
    monkeypatch.setattr(pinhole, "ADDUCTION", 0.0)
    assert_close(total - energy(state), 0.03 / 2 / 0.05**2 * across)  # at 60 frames a second each counts half
