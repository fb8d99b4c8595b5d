"""Energy of contact with the ground: by hand, gradients, and the feet of a walk."""

import itertools
import math

import pytest
import torch
from numerics import finite, gradcheck, normal, same_as_loop
from torch.testing import assert_close

from kcs_torch.data import walking_person
from kcs_torch.errors import ShapeError
from kcs_torch.functional import standing
from kcs_torch.nn import ContactEnergy
from kcs_torch.skeleton import SKELETONS
from kcs_torch.solvers import root_velocity

MAN = SKELETONS["h36m17"]


def test_a_root_that_moves_against_standing_feet_costs_nothing():
    energy = ContactEnergy(MAN, slip=0.01, change=0.01)
    points = normal(1, 17, 3).repeat(6, 1, 1)
    drift = 0.3 * torch.arange(6).double()
    points[..., 2] -= drift[:, None]  # all joints go -0.3 a frame, seen from the root
    stands = torch.ones(6, len(MAN.contacts)).double()
    right = energy(points, torch.full((6,), 0.3).double(), stands)
    still = 5 * 5e-4 * (0.3 / 0.01) ** 2
    assert right.item() == pytest.approx(still)
    assert energy(points, torch.zeros(6).double(), stands) > 10 * right
    assert energy(points, torch.zeros(6).double(), 0 * stands) == 0


def test_contact_by_hand():
    energy = ContactEnergy(MAN, slip=0.2, change=0.5)
    points, velocity, stands = normal(4, 17, 3), normal(4, seed=1), normal(4, 2, seed=2).sigmoid()
    feet = points[:, list(MAN.contacts), 2]
    value = torch.zeros(()).double()
    for t, c in itertools.product(range(1, 4), range(2)):
        move = feet[t, c] - feet[t - 1, c] + velocity[t]
        value = value + 0.5 * min(stands[t, c], stands[t - 1, c]) * (1 + (move / 0.2) ** 2).log()
    value = value + sum((velocity[t] - velocity[t - 1]) ** 2 for t in (2, 3)) / (2 * 0.25)
    value = value + 5e-4 * velocity[1:].square().sum() / 0.04
    assert_close(energy(points, velocity, stands), value)
    other = velocity.clone()
    other[0] = 9.0  # nothing came before the first frame
    assert_close(energy(points, other, stands), value)


def test_contact_gradient_batches_and_no_contacts():
    energy = ContactEnergy(MAN)
    stands = normal(4, 2, seed=2).sigmoid()
    assert gradcheck(energy, 0.01 * normal(4, 17, 3), 0.01 * normal(4, seed=1), stands, fast=True)
    for frames in (1, 2):
        finite(energy, normal(frames, 17, 3), normal(frames), stands[:frames])
    same_as_loop(lambda p, v, s: energy(p, v, s.sigmoid()), (4, 17, 3), (4,), (4, 2))
    assert ContactEnergy("hand21")(normal(4, 21, 3), torch.zeros(4).double(), torch.zeros(4, 0).double()) == 0


def test_frames_that_pad_a_clip_and_shapes_that_do_not_fit():
    """Weights of frames are those, and not of the joints that have the contacts' numbers."""
    energy = ContactEnergy(MAN)
    points, stands = 0.01 * normal(9, 17, 3), normal(9, 2, seed=2).sigmoid()
    padded = torch.cat([points, torch.full((3, 17, 3), math.nan).double()])
    share, more = torch.tensor([1.0] * 9 + [0.0] * 3).double(), torch.cat([stands, torch.ones(3, 2).double()])
    for weights in (share, share[:, None].expand(12, 17)):
        assert_close(energy(padded, None, more, weights), energy(points, None, stands), rtol=1e-12, atol=0)
    for bad, named in (
        ((points[..., :2], None, stands), r"points: expected \(..., N, 3\)"),
        ((points, None, stands[:, :1]), r"standing: expected \(..., T, C\) = \(..., 9, 2\), got \(9, 1\)"),
        ((points, normal(8), stands), r"velocity: expected \(..., T\)"),
        ((points, None, stands, torch.ones(5).double()), "expected weights"),
    ):
        with pytest.raises(ShapeError, match=named):
            energy(*bad)


def test_a_velocity_in_frames_that_pad_a_clip_counts_for_nothing():
    energy = ContactEnergy(MAN)
    points, stands, speed = 0.01 * normal(9, 17, 3), normal(9, 2, seed=2).sigmoid(), 0.01 * normal(9, seed=3)
    share = torch.tensor([1.0] * 9 + [0.0] * 3).double()
    add = lambda x, value: torch.cat([x, torch.full_like(x[:3], value)])  # noqa: E731
    for value in (0.0, 0.5, math.nan):
        given = [add(x, value).requires_grad_() for x in (points, speed, stands)]
        found = energy(*given, share)
        assert_close(found, energy(points, speed, stands))
        assert all(slope.isfinite().all() and not slope[9:].any() for slope in torch.autograd.grad(found, given))
    gap = share.flip(0)  # nobody is seen at first: that pads no clip, and the root moves steadily there as elsewhere
    assert energy(add(points, 0.0), add(speed, 0.5), add(stands, 0.0), gap) > energy(points, speed, stands)


def test_the_best_velocity_is_found():
    """No other costs less, and the energy has the slope in the points that it has at this velocity."""
    clip = walking_person(40, turn=0.0)
    points = clip.points / 1000
    points = points - points.mean(1, keepdim=True)
    feet = list(MAN.contacts)
    sure = standing(clip.tracks.points[:, feet], clip.tracks.weights[:, feet])
    energy = ContactEnergy(MAN)
    least = energy(points, None, sure)
    velocity = torch.zeros(40).double().requires_grad_()
    search = torch.optim.LBFGS([velocity], max_iter=500, tolerance_grad=1e-9, line_search_fn="strong_wolfe")

    def closure():
        search.zero_grad()
        value = energy(points, velocity, sure)
        value.backward()
        return value

    search.step(closure)
    assert least.item() == pytest.approx(float(energy(points, velocity.detach(), sure)), rel=1e-3)
    leaf = points.clone().requires_grad_()
    slopes = [torch.autograd.grad(energy(leaf, v, sure), leaf)[0] for v in (None, velocity.detach())]
    assert_close(slopes[0], slopes[1], rtol=0, atol=0.02 * float(slopes[1].abs().amax()))


@pytest.mark.parametrize("num_steps", [1, 10])
def test_derivatives_run_through_the_reweightings(num_steps):
    """Of noisy points they have not converged, and a velocity that was a constant left a third of a slope out."""
    energy = ContactEnergy(MAN, num_steps=num_steps)
    walk = walking_person(26, yaw=30.0, dtype=torch.float64).points / 1000 + 0.01 * normal(26, 17, 3)
    stands = normal(26, 2, seed=2).sigmoid()
    run = lambda p, s: energy(p, None, s)  # noqa: E731
    assert gradcheck(run, walk, stands, fast=True)
    assert torch.autograd.gradgradcheck(lambda p: run(p, stands[:4]), walk[:4].requires_grad_(), fast_mode=True)
    gone = walk.clone()
    gone[5] = torch.nan
    stands[5] = 0
    gone.requires_grad_()
    (grad,) = torch.autograd.grad(run(gone, stands), gone)
    assert grad.isfinite().all() and grad.any()


def test_the_best_velocity_in_batches_and_where_nothing_tells():
    energy = ContactEnergy(MAN)
    same_as_loop(lambda p, s: energy(0.01 * p, None, s.sigmoid()), (4, 17, 3), (4, 2))
    for frames in (1, 2, 5):
        nothing = torch.zeros(frames, 2).double()
        assert energy(normal(frames, 17, 3), None, nothing) == 0
        finite(lambda p, none=nothing: energy(p, None, none + 0.5), 0 * normal(frames, 17, 3))
    assert ContactEnergy("hand21")(normal(4, 21, 3), None, torch.zeros(4, 0).double()) == 0


def test_feet_of_a_walk_stand_by_turns():
    clip = walking_person(90, turn=0.0)
    feet = list(MAN.contacts)
    sure = standing(clip.tracks.points[:, feet], clip.tracks.weights[:, feet])
    moves = clip.points[:, feet].diff(dim=0).norm(dim=-1)
    moves = torch.cat([moves, moves[-1:]])
    assert moves[sure > 0.5].max() < 0.3 * moves.max()
    assert 0.25 < (sure > 0.5).double().mean() < 0.75
    assert ((sure > 0.5).any(-1)).double().mean() > 0.8  # one of the two nearly always does


def test_feet_that_do_not_stand_may_be_anything():
    body = SKELETONS["body25"]
    energy, first = ContactEnergy(body), body.contacts[0]
    points, velocity = normal(5, 25, 3), normal(5, seed=1)
    stand = torch.ones(5, len(body.contacts)).double()
    stand[2, 0] = 0
    gone = points.clone()
    gone[2, first] = math.nan
    gone.requires_grad_()
    value = energy(gone, velocity, stand)
    assert_close(value, energy(points, velocity, stand))
    (grad,) = torch.autograd.grad(value, gone)
    assert torch.isfinite(grad).all() and not grad[2, first].any()


def test_changes_of_depth_that_do_not_fit():
    move = normal(9, 2)
    for arguments, named in (((move[0, 0], move), "move"), ((move, move[:, :1]), "weight")):
        with pytest.raises(ShapeError, match=f"root_velocity: {named}: expected"):
            root_velocity(*arguments, 0.006, 0.004)
