"""Energies of a body's joints: values by hand, gradients with degenerate inputs, bodies that move as they should."""

import dataclasses
import math
from pathlib import Path

import numpy as np
import pytest
import torch
from numerics import BATCHES, CHAIN, FLOATS, HALVES, finite, gradcheck, leaves_arguments_alone, normal, rotations
from torch.testing import assert_close

from kcs_torch.errors import OptionError, ShapeError
from kcs_torch.nn import AdductionEnergy, HingeEnergy
from kcs_torch.skeleton import SKELETONS, Skeleton

DATA = Path(__file__).parents[2] / "shared" / "data"
LEGS = Skeleton.from_names(
    ["left_hip", "right_hip", "left_knee", "right_knee", "left_ankle", "right_ankle"],
    [
        ("left_hip", "right_hip"),
        *(("left_hip", "left_knee"), ("left_knee", "left_ankle")),
        *(("right_hip", "right_knee"), ("right_knee", "right_ankle")),
    ],
    name="legs",
)


def legs(left: float, right: float, dtype=torch.float64):
    """Someone who faces the viewer, thighs down, shanks bent backward by so many degrees: (1, 6, 3)."""
    points = torch.tensor([[0.1, 0, 0], [-0.1, 0, 0], [0.1, 0.4, 0], [-0.1, 0.4, 0]], dtype=dtype)
    ankles = [
        [x, 0.4 + 0.5 * math.cos(math.radians(d)), 0.5 * math.sin(math.radians(d))]
        for x, d in ((0.1, left), (-0.1, right))
    ]
    return torch.cat([points, torch.tensor(ankles, dtype=dtype)])[None]


def test_values_by_hand():
    energy = HingeEnergy(LEGS)
    assert_close(energy.bend(legs(30, -90)), torch.tensor([[0.5, -1.0]]).double())
    assert_close(energy(legs(30, -90)), torch.tensor([0.5]).double())
    assert_close(energy(legs(-30, -90)), torch.tensor([0.5 * (0.25 + 1)]).double())
    assert energy(legs(1, 120)).item() == 0
    # given lengths take the place of the clip's
    lengths = torch.tensor([0.2, 0.8, 0.5, 0.4, 0.5]).double()
    assert_close(energy.bend(legs(30, -90), lengths), torch.tensor([[0.25, -1.0]]).double())


def test_a_soft_hinge_counts_less():
    soft = Skeleton.from_names(
        LEGS.joints,
        [(LEGS.joints[a], LEGS.joints[b]) for a, b in LEGS.bones],
        hinges=[{"joint": "left_knee", "bends": "forward", "weight": 0.25}],
    )
    assert_close(HingeEnergy(soft)(legs(90, 0)), torch.tensor([0.125]).double())


def test_neither_turn_place_nor_size_matters_but_the_mirror_does():
    points = torch.cat([legs(-20, 50), legs(40, -70), legs(10, 0)])
    energy = HingeEnergy(LEGS)
    moved = 1000 * (points @ rotations(3) + normal(3, 1, 3, seed=2))
    assert_close(energy(moved), energy(points))
    assert_close(energy.bend(points * torch.tensor([1, 1, -1])), -energy.bend(points))


@pytest.mark.parametrize("name", sorted(SKELETONS))
def test_templates_bend_as_they_should(name):
    body = SKELETONS[name]
    energy, points = HingeEnergy(body), body.template_points(dtype=torch.float64)[None]
    assert body.hinges and energy(points).item() == 0
    assert (energy.bend(points) > 0.01).all()
    assert energy(points * torch.tensor([1, 1, -1])).item() > 0


def spread(left: float, right: float):
    """Someone who faces the viewer, thighs to the side by so many degrees: (1, 6, 3)."""
    points = legs(0, 0)
    for knee, side, degrees in ((2, 1, left), (3, -1, right)):
        way = [side * math.sin(math.radians(degrees)), math.cos(math.radians(degrees)), 0]
        points[0, knee] = points[0, knee - 2] + 0.4 * torch.tensor(way).double()
    return points


def test_thighs_that_reach_across_by_hand():
    energy = AdductionEnergy(LEGS)
    assert_close(energy.abduction(spread(30, -45)), torch.tensor([[0.5, -math.sqrt(0.5)]]).double())
    assert_close(energy(spread(30, -45)), torch.tensor([0.5 * (math.sqrt(0.5) - 0.35) ** 2]).double())
    assert energy(spread(90, 80)).item() == energy(spread(-20, -20)).item() == 0
    assert_close(AdductionEnergy(LEGS, limit=0)(spread(-30, -30)), torch.tensor([0.25]).double())
    lengths = torch.tensor([0.2, 0.8, 0.5, 0.4, 0.5]).double()  # in place of the clip's
    assert_close(energy.abduction(spread(30, -30), lengths), torch.tensor([[0.25, -0.5]]).double())


def test_a_limb_with_two_hinges_at_its_end_counts_once():
    """A marker on the shin bends at the knee as the ankle does."""
    man = SKELETONS["cmu21"]
    hinge = next(h for h in man.hinges if h.parent in (h.left, h.right))
    shin = dataclasses.replace(hinge, child=man.num_joints)
    more = dataclasses.replace(
        man,
        joints=(*man.joints, "shin"),
        bones=(*man.bones, (hinge.joint, man.num_joints)),
        hinges=(*man.hinges, shin),
        template=None,
        spread=None,
        proportions=None,
        name="marked",
    )
    assert torch.equal(AdductionEnergy(more).joints, AdductionEnergy(man).joints)
    assert len(HingeEnergy(more).joints) == len(man.hinges) + 1


def test_weights_that_are_tiny_weigh_alike():
    energy, points = AdductionEnergy(LEGS), normal(5, 6, 3)
    assert_close(energy.abduction(points, None, torch.full((5, 6), 1e-12).double()), energy.abduction(points))


def test_only_limbs_from_twins_reach_across():
    assert AdductionEnergy("h36m17").limbs.shape == (4, 1)  # thighs and upper arms
    assert AdductionEnergy("body25").limbs.shape == (4, 1)  # no feet, which have hinges
    assert AdductionEnergy("hand21").limbs.shape == (0, 1)  # no fingers, either
    for limit in (-0.1, 1.5, math.nan):
        with pytest.raises(OptionError, match=r"limit: expected a sine within 0..1"):
            AdductionEnergy(LEGS, limit=limit)


@pytest.mark.parametrize("name", sorted(SKELETONS))
def test_templates_do_not_reach_across(name):
    points = SKELETONS[name].template_points(dtype=torch.float64)[None]
    energy = AdductionEnergy(name)
    assert energy(points).item() == 0
    turned = points @ rotations(1)[0] * 3 + 1
    assert_close(energy.abduction(turned), energy.abduction(points))


@pytest.mark.parametrize("make", [HingeEnergy, lambda body: AdductionEnergy(body, limit=0.1)])
@pytest.mark.parametrize("kind", ["any", "one frame", "zero", "short in a frame", "short", "batch"])
@pytest.mark.parametrize("given", [False, True])
def test_gradients(make, kind, given):
    points = normal(*((2, 3) if kind == "batch" else ()), 1 if kind == "one frame" else 4, 6, 3)
    if kind == "zero":
        points = torch.zeros_like(points)
    if kind == "short in a frame":
        points[1, 2] = points[1, 0]
    if kind == "short":
        points[:, 2] = points[:, 0]
    lengths = normal(*points.shape[:-3], 5, seed=4).abs() + 0.5
    energy = make(LEGS)
    arguments = (points, lengths) if given else (points,)
    finite(energy, *arguments)
    if kind not in ("zero", "short") or (given and kind == "short"):  # a length of 0 has no derivative
        assert gradcheck(energy, *arguments)


def test_a_length_of_zero_is_no_nan():
    energy, lengths = HingeEnergy(LEGS), torch.zeros(5).double()
    finite(energy, legs(-30, -30), lengths)
    assert energy(legs(-30, -30), lengths).item() == 0


@pytest.mark.parametrize("given", [False, True])
def test_frames_of_no_weight_may_be_anything(given):
    energy, points = HingeEnergy("h36m17"), normal(5, 17, 3)
    lengths = torch.ones(16).double() if given else None
    weights = torch.tensor([1.0, 1, 0, 1, 0]).double()
    gone = torch.where(weights[:, None, None] > 0, points, torch.nan).requires_grad_()
    value = energy(gone, lengths, weights)
    assert_close(value, energy(points, lengths, weights))
    (grad,) = torch.autograd.grad(value.sum(), gone)
    assert torch.isfinite(grad).all() and not grad[weights == 0].any() and grad.any()


@pytest.mark.parametrize("batch", BATCHES)
def test_batches(batch):
    points = normal(*batch, 4, 6, 3)
    energy = HingeEnergy(LEGS)
    together = leaves_arguments_alone(energy, points)
    assert together.shape == (*batch, 4)
    alone = [energy(p) for p in points.reshape(-1, 4, 6, 3)]
    assert_close(together, torch.stack(alone).reshape(*batch, 4))


@pytest.mark.parametrize("dtype", [*FLOATS, *HALVES])
def test_dtypes(dtype):
    points = (700 * legs(-30, 40)).to(dtype)  # millimetres
    energy = HingeEnergy(LEGS)(points)
    assert energy.dtype == dtype
    assert_close(energy.double(), torch.tensor([0.125]).double(), rtol=0.02, atol=0)


@pytest.mark.parametrize("make", [HingeEnergy, lambda body: AdductionEnergy(body, limit=0)])
@pytest.mark.parametrize("dtype", HALVES)
def test_unseen_joints_beside_millimetres_in_half_precision(make, dtype):
    """A bone to an unseen joint, whose place is 0, is a hundred times too long."""
    energy, points = make(LEGS), (5000 + 30 * normal(9, 6, 3)).to(dtype)
    weights = torch.ones(9, 6, dtype=dtype)
    weights[::2, 2] = weights[1, 3:] = 0
    leaf = points.clone().requires_grad_()
    value = energy(leaf, None, weights)
    (grad,) = torch.autograd.grad(value.sum(), leaf)
    assert value.dtype == energy(points, None, weights.double()).dtype == dtype and value.any()
    assert_close(value.double(), energy(points.double(), None, weights.double()), rtol=0.02, atol=1e-3)
    assert torch.isfinite(grad).all() and not grad[weights == 0].any()


def test_a_body_without_hinges():
    points = normal(2, 5, 4, 3).requires_grad_()
    energy = HingeEnergy(CHAIN)(points)
    assert energy.shape == (2, 5) and not energy.any()
    assert not torch.autograd.grad(energy.sum(), points)[0].any()


def test_shapes_that_do_not_fit():
    energy = HingeEnergy(LEGS)
    for points in (torch.zeros(5, 7, 3), torch.zeros(6, 3), torch.zeros(5, 6, 2)):
        with pytest.raises(ShapeError, match="expected points"):
            energy(points)
    with pytest.raises(ShapeError, match=r"expected lengths \(..., 5\), .* got \(4,\)"):
        energy(torch.zeros(3, 6, 3), torch.zeros(4))


@pytest.mark.skipif(not DATA.is_dir(), reason="needs the data sets beside the checkout")
@pytest.mark.parametrize("clip", ["cmu_35_01", "cmu_02_01", "cmu_pirouette", "cmu_zombie"])
def test_real_people_bend_their_joints_that_way(clip):
    with np.load(DATA / "cmu" / f"{clip}.npz") as data:
        points = torch.from_numpy(data["points3d"].astype(float))
        body = Skeleton.from_edges(data["edges"].tolist(), data["joint_names"].tolist())
    bend = HingeEnergy(body).bend(points)
    firm = torch.tensor([h.firm for h in body.hinges])
    assert (firm == 1).sum() == 4 and bend[:, firm == 1].min() > -0.1
    assert (bend[:, firm < 1] > -0.05).double().mean() > 0.85
    assert AdductionEnergy(body).abduction(points).min() > -0.5
