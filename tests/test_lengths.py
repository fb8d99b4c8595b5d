"""Energies of foreshortening and proportions: closed forms, and gradients at the edges."""

import math

import pytest
import scipy.integrate
import torch
from numerics import BODY, CHAIN, HALVES, finite, gradcheck, normal, same_as_loop
from test_posture import BONES, KINDS, MAN, POSTURE, WALK, degenerate
from torch.testing import assert_close

from kcs_torch.errors import OptionError, ShapeError, SkeletonError
from kcs_torch.functional import bone_lengths
from kcs_torch.nn import ForeshorteningEnergy, PostureEnergy, ProportionEnergy
from kcs_torch.nn.lengths import foreshortening, free_bones
from kcs_torch.nn.posture import trunk_joints

# ---------------------------------------------------------------------- foreshortening


def test_foreshortening_is_a_density_of_images():
    """Over the disc of all images, exp(-energy) integrates to 2 pi: that of the half sphere."""
    for length in (0.3, 2.0):
        at = lambda r: math.exp(  # noqa: E731
            -foreshortening(torch.tensor(math.sqrt(length**2 - r**2)).double(), torch.tensor(length).double(), 0.0)  # noqa: B023
        )
        total = scipy.integrate.quad(lambda r: 2 * math.pi * r * at(r), 0, length)[0]  # noqa: B023
        assert total == pytest.approx(2 * math.pi, rel=1e-6)


@pytest.mark.parametrize("noise", [0.005, 0.02, 0.08])
def test_foreshortening_of_noisy_images_is_the_density_blurred(noise):
    """Depths up to L are equally likely; the image is sqrt(L^2 - dz^2) and noise, its density over its length."""
    length = torch.tensor(2.0, dtype=torch.float64)
    bone = lambda dz: math.sqrt(4.0 - dz * dz)  # noqa: E731
    for seen, within in ((2.0, 0.02), (1.99, 0.3), (1.9, 0.3), (1.6, 0.3), (1.2, 0.3)):
        gauss = lambda dz: math.exp(-(((seen - bone(dz)) / noise) ** 2) / 2) / (noise * math.sqrt(2 * math.pi))  # noqa: B023, E731
        near = math.sqrt(4.0 - seen**2)
        density = scipy.integrate.quad(gauss, 0, 2.0, points=[near], limit=500)[0] / (2.0 * seen)
        dz = torch.tensor(near, dtype=torch.float64)
        ours = foreshortening(dz, length, 0.0, torch.tensor(noise).double())
        assert float(ours) == pytest.approx(-math.log(density), abs=within)
    assert float(foreshortening(dz, length, 0.1, torch.tensor(0.0))) == pytest.approx(
        float(foreshortening(dz, length, 0.1))
    )


def test_foreshortening_of_noisy_images_gradient_and_shapes():
    energy, noise = ForeshorteningEnergy(MAN), normal(len(WALK), 16, seed=3).abs() * 0.02
    lengths = bone_lengths(WALK, BONES).mean(0)
    assert gradcheck(lambda p, size: energy(p, size, bone_noise=noise), WALK, lengths, fast=True)
    for still in (noise, 0 * noise):
        finite(lambda p, size: energy(p, size, bone_noise=still.to(p)), WALK.float() * 0, lengths.float())  # noqa: B023
    with pytest.raises(ShapeError, match=r"expected bone_noise .*16"):
        energy(WALK, lengths, bone_noise=noise[:, :5])


def test_foreshortening_by_hand():
    energy = ForeshorteningEnergy(BODY, correlation=4.0, eps=0.2)
    points, lengths = normal(5, 7, 3), normal(6, seed=1).abs() + 0.1
    dz = (points[:, BODY.bone_index()[:, 1]] - points[:, BODY.bone_index()[:, 0]])[..., 2]
    by_hand = (lengths.log() + 0.5 * (dz**2 + (0.2 * lengths) ** 2).log()).sum() / 4
    assert_close(energy(points, lengths), by_hand)


def test_foreshortening_counts_limbs_only_and_keeps_lengths_down():
    energy = ForeshorteningEnergy(MAN)
    lengths = bone_lengths(WALK, BONES).mean(0)
    trunk = torch.tensor([set(b) <= set(trunk_joints(MAN)) for b in MAN.bones])
    assert_close(energy(WALK, torch.where(trunk, 2 * lengths, lengths)), energy(WALK, lengths))
    flat = lengths[None].square() - (WALK[:, BONES[:, 1]] - WALK[:, BONES[:, 0]])[..., :2].square().sum(-1)
    values = [  # the same images, of ever longer bones
        foreshortening((flat + (s**2 - 1) * lengths**2).clamp_min(0).sqrt(), s * lengths, 0.1).sum()
        for s in (1, 1.2, 1.5)
    ]
    assert values[0] < values[1] < values[2]


@pytest.mark.parametrize("kind", KINDS)
def test_foreshortening_gradient(kind):
    energy = ForeshorteningEnergy(MAN)
    points = degenerate(kind)
    lengths = POSTURE.rest_lengths
    assert gradcheck(energy, points, lengths, fast=True)
    finite(energy, points.float(), lengths.float())
    finite(energy, points.float(), torch.zeros(16))


@pytest.mark.parametrize("energy", [ForeshorteningEnergy("h36m17"), PostureEnergy("h36m17")])
def test_the_gradient_knows_that_lengths_are_the_points_own(energy):
    noisy = WALK / 1000 + 0.02 * normal(*WALK.shape, seed=4)
    assert gradcheck(energy.double(), noisy, fast=True, rtol=1e-6, atol=1e-7)


def test_bones_of_no_weight_may_be_anything():
    energy, lengths = ForeshorteningEnergy(MAN), bone_lengths(WALK[:6], BONES).mean(0)
    weights = torch.ones(6, 16).double()
    weights[:, [b for b, ends in enumerate(MAN.bones) if 6 in ends]] = 0
    gone = WALK[:6].clone()
    gone[:, 6] = math.nan
    gone.requires_grad_()
    value = energy(gone, lengths, bone_weights=weights)
    assert_close(value, energy(WALK[:6], lengths, bone_weights=weights))
    (grad,) = torch.autograd.grad(value, gone)
    assert torch.isfinite(grad).all() and not grad[:, 6].any() and grad.any()


def test_noise_of_bones_of_no_weight_may_be_anything():
    energy, weights = ForeshorteningEnergy(MAN), torch.ones(6, 17).double()
    weights[2, 6] = 0
    gone = torch.minimum(weights[:, BONES[:, 0]], weights[:, BONES[:, 1]]) == 0
    noise = torch.full((6, 16), 0.01).double()
    expected = energy(WALK[:6], None, weights, bone_noise=noise)
    points = WALK[:6].clone().requires_grad_()
    value = energy(points, None, weights, bone_noise=torch.where(gone, torch.nan, noise))
    assert_close(value, expected)
    assert torch.autograd.grad(value, points)[0].isfinite().all()


def test_weights_of_joints_and_of_bones_are_not_given_together():
    with pytest.raises(OptionError, match="ForeshorteningEnergy: expected weights or bone_weights, got both"):
        ForeshorteningEnergy(MAN)(WALK[:6], None, torch.ones(6, 17), bone_weights=torch.ones(6, 16))


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16])
def test_half_precision_in_millimetres(dtype):
    points = (1000 * WALK[:6]).to(dtype)
    lengths = bone_lengths(points, BONES).mean(0)
    energy = ForeshorteningEnergy(MAN)
    finite(energy, points, lengths)
    exact = energy(points.double(), lengths.double())
    assert_close(energy(points, lengths).double(), exact, rtol=0.02, atol=0.02)


def test_limbs_are_free_and_the_trunk_is_not():
    free = dict(zip(MAN.bone_names, free_bones(MAN).tolist(), strict=True))
    trunk = trunk_joints(MAN)
    assert all(not free[name] for name, (a, b) in zip(MAN.bone_names, MAN.bones, strict=True) if {a, b} <= set(trunk))
    assert all(free[n] for n in free if n.endswith(("knee", "ankle", "elbow", "wrist")))
    assert free_bones(CHAIN).tolist() == [1, 1, 1]


# ---------------------------------------------------------------------- proportions


def test_usual_proportions_cost_nothing_in_any_unit():
    energy = ProportionEnergy(MAN)
    usual = MAN.relative_lengths(dtype=torch.float64)
    for size in (1e-3, 1.0, 1e4):
        assert_close(energy(size * usual), torch.zeros(()).double(), rtol=0, atol=1e-12)
    odd = usual * torch.linspace(0.8, 1.25, 16).double()
    assert_close(energy(7.5 * odd), energy(odd))
    assert energy(odd) > 0.1


def test_proportions_by_hand():
    usual = MAN.relative_lengths(dtype=torch.float64)
    lengths = usual * (0.1 * normal(16)).exp()
    log = (lengths / usual).log()
    value = (1 + ((log - log.mean()) / 0.05).square() / 2).log().sum()
    value = value + ((log - log.mean()).clamp_min(0) / 0.3).square().sum() / 2
    value = value + sum(((log[a] - log[b]) / 0.02) ** 2 for a, b in MAN.mirror_bones) / 2
    assert_close(ProportionEnergy(MAN, spread=0.05, twins=0.02, excess=0.3)(lengths), value)


def test_odd_bones_are_borne_but_not_odd_twins():
    usual = MAN.relative_lengths(dtype=torch.float64)
    energy = ProportionEnergy(MAN)
    neck = usual.clone()
    neck[MAN.bone_names.index("spine-thorax")] *= 1.6
    assert energy(neck) < 20
    short, long = usual.clone(), usual.clone()
    for pair in MAN.mirror_bones[:2]:  # joints may be defined in such a way that bones are short, but not this long
        short[list(pair)] *= 0.4
        long[list(pair)] *= 2.5
    plain = ProportionEnergy(MAN, excess=1e9)
    assert energy(short) - plain(short) < 2 < 4 < energy(long) - plain(long)
    arm = usual.clone()
    arm[MAN.mirror_bones[0][0]] *= 1.6
    assert energy(arm) > 100


@pytest.mark.parametrize("dtype", HALVES)
@pytest.mark.parametrize("weighted", [True, False])
def test_proportions_in_half_precision(dtype, weighted):
    """Of what is squared most digits were lost, and what was large was infinite."""
    energy, weights = ProportionEnergy(MAN), torch.rand(16, generator=torch.Generator().manual_seed(0))
    for spread in (0.02, 0.2, 2.5):
        lengths = (POSTURE.rest_lengths * (spread * normal(4, 16)).exp()).to(dtype)
        exact = energy(lengths.double(), weights if weighted else None).clamp_max(torch.finfo(dtype).max)
        value = energy(lengths, weights.to(dtype) if weighted else None)
        assert value.dtype == dtype
        assert_close(value.double(), exact, rtol=2e-2, atol=0)


def test_proportion_gradient_batches_and_errors():
    energy = ProportionEnergy(MAN)
    assert gradcheck(energy, POSTURE.rest_lengths * (0.2 * normal(16)).exp())
    same_as_loop(lambda x: energy(x.exp()), (16,))
    finite(energy, torch.cat([torch.zeros(1), POSTURE.rest_lengths[1:].float()]))
    with pytest.raises(ShapeError, match="ProportionEnergy"):
        energy(torch.ones(15))
    with pytest.raises(SkeletonError, match="neither proportions nor a template"):
        ProportionEnergy(CHAIN)
