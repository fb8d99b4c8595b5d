"""Energies: values by hand, gradients with degenerate inputs, and the prox and gradient that solvers use."""

import dataclasses
import math

import pytest
import torch
from energy_clips import BONES, KINDS, RIGID, SMOOTH, clip, confidences, scene
from numerics import BODY, CHAIN, FLOATS, HALVES, RING, finite, gradcheck, normal, rotations
from torch.testing import assert_close

from kcs_torch.errors import OptionError, ShapeError
from kcs_torch.functional import bone_lengths, project
from kcs_torch.nn import BoneLengthEnergy, LowRankEnergy, ReprojectionEnergy, SmoothnessEnergy, SymmetryEnergy

# ---------------------------------------------------------------------- bone lengths


def test_bone_length_energy_by_hand():
    points, lengths = clip(), normal(6, seed=1).abs()
    size = bone_lengths(points, BONES)
    energy = BoneLengthEnergy(BODY)
    assert_close(energy(points, lengths), 0.5 * (RIGID * (size - lengths).square()).sum(-1))
    variance = size.var(0, unbiased=False)
    assert_close(energy(points).mean(), 0.5 * (RIGID * variance).sum())


def test_bone_length_energy_is_free_of_motion():
    points = clip("static")
    moved = points @ rotations(5) + normal(5, 1, 3, seed=2)
    assert_close(BoneLengthEnergy(BODY)(moved), torch.zeros(5).double(), atol=1e-25, rtol=0)


def test_bones_weigh_as_their_lesser_end():
    points, lengths, weights = clip(), normal(6, seed=1).abs(), confidences(clip())
    share = torch.minimum(weights[:, BONES[:, 0]], weights[:, BONES[:, 1]]) * RIGID
    size = bone_lengths(points, BONES)
    energy = BoneLengthEnergy(BODY)
    assert_close(energy(points, lengths, weights), 0.5 * (share * (size - lengths).square()).sum(-1))
    mean = (size * share).sum(0) / share.sum(0).clamp_min(1e-30)
    assert_close(energy(points, None, weights), 0.5 * (share * (size - mean).square()).sum(-1))
    elsewhere = torch.where(weights[..., None] > 0, points, 100 + points)  # where nothing is seen, anything may stand
    assert_close(energy(elsewhere, lengths, weights), energy(points, lengths, weights))
    assert_close(energy(elsewhere, None, weights), energy(points, None, weights))


@pytest.mark.parametrize("kind", SMOOTH)
@pytest.mark.parametrize("weighted", [False, True])
def test_bone_length_energy_gradient(kind, weighted):
    points = clip(kind)
    weights = confidences(points) if weighted else None
    energy = BoneLengthEnergy(BODY)
    assert gradcheck(lambda x, ell: energy(x, ell, weights), points, normal(6, seed=1).abs(), fast=True)
    assert gradcheck(lambda x: energy(x, None, weights), points, fast=True)


def test_bone_length_energy_gradient_in_the_weights():
    points = clip()
    energy = BoneLengthEnergy(BODY)
    assert gradcheck(lambda w: energy(points, normal(6, seed=1).abs(), w), normal(5, 7, seed=2).abs() + 0.1, fast=True)
    assert gradcheck(lambda w: energy(points, None, w), normal(5, 7, seed=2).abs() + 0.1, fast=True)


def test_bone_length_prox_is_optimal():
    points, lengths = clip(), bone_lengths(clip(), BONES).mean(0) * 1.1
    energy = BoneLengthEnergy(BODY)
    best = energy.prox(points, lengths, 2.0, num_steps=100)

    def objective(x):
        return 2.0 * energy(x, lengths) + 0.5 * (x - points).square().sum((-2, -1))

    assert (objective(best + 0.01 * normal(100, 5, 7, 3, seed=2)) > objective(best)).all()
    leaf = best.clone().requires_grad_()
    (grad,) = torch.autograd.grad(objective(leaf).sum(), leaf)
    assert grad.abs().max() < 1e-3
    spine = energy.prox(points, lengths * torch.tensor([50.0, 1, 1, 1, 1, 1]), 2.0, num_steps=100)
    assert_close(spine, best, rtol=0, atol=1e-2)  # the flexible bone's length does not matter


def test_prox_and_gradient_take_other_precisions_as_the_energy_does():
    points, lengths = normal(5, 7, 3, dtype=torch.float32), normal(6).abs()
    energy, fit = BoneLengthEnergy(BODY), ReprojectionEnergy()
    assert_close(energy.prox(points, lengths), energy.prox(points, lengths.float()))
    frames = torch.tensor([0.5, 1, 2, 4, 8])
    each = torch.stack([energy.prox(x[None], lengths, float(k))[0] for x, k in zip(points, frames, strict=True)])
    assert_close(energy.prox(points, lengths, frames[:, None]), each)
    with pytest.raises(ShapeError, match=r"stiffness: expected a shape that broadcasts to \(5, 6\), got \(5,\)"):
        energy.prox(points, lengths, frames)
    tracks, cameras = normal(5, 7, 2), normal(5, 2, 3)
    found = fit.grad(points, tracks, cameras)
    assert_close(found, fit.grad(points.double(), tracks, cameras))
    assert_close(fit.grad(points, tracks.float(), cameras), found.float(), rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("none", [math.nan, -0.5, -math.inf])
@pytest.mark.parametrize("weighted", [False, True])
def test_a_bone_without_a_target_length_does_not_count(none, weighted):
    """NaN in a target is not labelled, and no bone has a length below 0."""
    points, lengths = clip("any", 2), normal(2, 6, seed=1).abs()
    weights = confidences(points) if weighted else None
    energy, rest = BoneLengthEnergy(BODY), BoneLengthEnergy(dataclasses.replace(BODY, flexible=(*BODY.flexible, 3)))
    gone = lengths.clone()
    gone[:, 3] = none
    assert_close(energy(points, gone, weights), rest(points, lengths, weights))
    slopes = finite(lambda x, ell: energy(x, ell, weights), points, gone)
    assert_close(slopes[0], finite(lambda x: rest(x, lengths, weights), points)[0])
    assert not slopes[1][:, 3].any() and slopes[1].any()
    assert not energy(points, torch.full_like(lengths, none), weights).any()
    best = energy.prox(points, gone, num_steps=20)
    assert_close(best, rest.prox(points, lengths, num_steps=20), rtol=0, atol=1e-6)
    finite(energy.prox, points, gone)
    finite(energy.prox, points, torch.full_like(lengths, none))


@pytest.mark.parametrize("dtype", FLOATS)
def test_bone_length_prox_has_a_derivative_in_the_stiffness(dtype):
    """With a flexible bone, whose stiffness is 0, this was NaN."""
    points, lengths = clip(dtype=dtype), normal(6, seed=1, dtype=dtype).abs()
    energy = BoneLengthEnergy(BODY)
    grads = finite(lambda x, ell, k: energy.prox(x, ell, k), points, lengths, torch.tensor(1.5, dtype=dtype))
    assert grads[2] != 0
    if dtype == torch.float64:
        assert gradcheck(energy.prox, points, lengths, torch.tensor(1.5).double(), fast=True)


# ---------------------------------------------------------------------- reprojection


def test_reprojection_energy_by_hand():
    points, tracks, cameras = scene()
    weights = confidences(points)
    residual = project(points, cameras) - tracks
    assert_close(ReprojectionEnergy(translation=False)(points, tracks, cameras), 0.5 * residual.square().sum((-2, -1)))
    plain = ReprojectionEnergy(translation=False)(points, tracks, cameras, weights)
    assert_close(plain, 0.5 * (weights[..., None] * residual.square()).sum((-2, -1)))
    front = ReprojectionEnergy(translation=False)(points, tracks)
    assert_close(front, 0.5 * (points[..., :2] - tracks).square().sum((-2, -1)))


@pytest.mark.parametrize("weighted", [False, True])
def test_translation_is_at_its_optimum(weighted):
    points, tracks, cameras = scene()
    weights = confidences(points) if weighted else None
    best = ReprojectionEnergy()(points, tracks, cameras, weights)
    fixed = ReprojectionEnergy(translation=False)
    for k in range(30):
        moved = tracks + normal(5, 1, 2, seed=k)
        assert (fixed(points, moved, cameras, weights) >= best - 1e-12).all()
    shifted = ReprojectionEnergy()(points, tracks + normal(5, 1, 2), cameras, weights)
    assert_close(shifted, best)


@pytest.mark.parametrize("translation", [False, True])
@pytest.mark.parametrize("weighted", [False, True])
def test_reprojection_grad_is_the_gradient(translation, weighted):
    points, tracks, cameras = scene()
    weights = confidences(points) if weighted else None
    energy = ReprojectionEnergy(translation=translation)
    leaf = points.clone().requires_grad_()
    (expected,) = torch.autograd.grad(energy(leaf, tracks, cameras, weights).sum(), leaf)
    assert_close(energy.grad(points, tracks, cameras, weights), expected)


def test_huber_is_quadratic_near_and_linear_far():
    points, tracks, cameras = scene()
    near = ReprojectionEnergy(huber=1e3)(points, tracks, cameras)
    assert_close(near, ReprojectionEnergy()(points, tracks, cameras))
    one = torch.zeros(1, 1, 3).double()
    energy = ReprojectionEnergy(huber=0.5, translation=False)
    far = [energy(one, torch.tensor([[[x, 0.0]]]).double()).item() for x in (0.5, 10.0, 11.0)]
    assert far == pytest.approx([0.125, 0.5 * 10 - 0.125, 0.5 * 11 - 0.125])


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("huber", [None, 0.7])
@pytest.mark.parametrize("weighted", [False, True])
def test_reprojection_gradient(kind, huber, weighted):
    points, tracks, cameras = scene(kind)
    weights = confidences(points) if weighted else None
    energy = ReprojectionEnergy(huber=huber)
    assert gradcheck(lambda x, y, r: energy(x, y, r, weights), points, tracks, cameras, fast=True)
    if weighted:
        assert gradcheck(
            lambda w: energy(points, tracks, cameras, w), normal(*points.shape[:-1]).abs() + 0.1, fast=True
        )


@pytest.mark.parametrize("huber", [0.0, -1.0, float("nan")])
def test_huber_out_of_range(huber):
    with pytest.raises(OptionError, match="huber"):
        ReprojectionEnergy(huber=huber)


# ---------------------------------------------------------------------- low rank


def test_low_rank_energies_by_hand():
    points = clip()
    matrix = points.flatten(-2)
    assert_close(LowRankEnergy()(points), torch.linalg.svdvals(matrix).sum())
    covariance = torch.cov(matrix.mT, correction=0)
    level = 0.01 * covariance.diagonal().mean() * torch.eye(21).double()
    expected = 5 / 2 * torch.linalg.slogdet(covariance + level).logabsdet
    assert_close(LowRankEnergy("log_det", eps=0.01)(points), expected)


@pytest.mark.parametrize("kind", ["nuclear", "log_det"])
def test_low_rank_energies_tell_few_shapes_from_many(kind):
    few = (normal(30, 2) @ normal(2, 21)).unflatten(-1, (7, 3))
    many = normal(30, 7, 3)
    many = many * few.norm() / many.norm()
    energy = LowRankEnergy(kind)
    assert energy(few) < energy(many)
    assert_close(energy(few @ rotations()), energy(few))


@pytest.mark.parametrize("kind", ["any", "one frame", "two frames"])
def test_nuclear_energy_gradient(kind):
    assert gradcheck(LowRankEnergy(), clip(kind))


@pytest.mark.parametrize("kind", ["any", "two frames", "short bones"])
def test_log_det_energy_gradient(kind):
    """Also of the level, which is a share of the variance."""
    assert gradcheck(LowRankEnergy("log_det"), clip(kind))


@pytest.mark.parametrize("size", [1e-30, 1e-17, 1e15])
def test_log_det_energy_of_any_size(size):
    """Squares of small points underflow in single precision; only the level of the energy depends on their size."""
    points = normal(12, 5, 3).float()
    small = (size * points).requires_grad_()
    value = LowRankEnergy("log_det")(small)
    (slope,) = torch.autograd.grad(value, small)
    expected = LowRankEnergy("log_det")(points.double()) + 12 * 15 * math.log(size)
    assert_close(value.double(), expected, rtol=1e-5, atol=1e-5)
    assert_close((slope.double() * size * points).sum(), torch.tensor(12 * 15.0).double(), rtol=1e-4, atol=0)


def test_low_rank_prox_is_optimal():
    points = clip()
    energy = LowRankEnergy()
    best = energy.prox(points, 0.8)
    others = best + 0.1 * normal(100, *best.shape, seed=2)
    objective = lambda x: 0.8 * energy(x) + 0.5 * (x - points).square().sum((-3, -2, -1))  # noqa: E731
    assert (objective(others) > objective(best)).all()
    assert gradcheck(energy.prox, points, torch.tensor(0.8).double(), fast=True)


@pytest.mark.parametrize("dtype", FLOATS)
@pytest.mark.parametrize("weighted", [False, True])
def test_log_det_energy_of_a_clip_at_rest_knows_no_rounding(dtype, weighted):
    energy = LowRankEnergy("log_det")
    points = (1e3 * normal(1, 7, 3, dtype=dtype)).expand(30, -1, -1).clone().requires_grad_()
    weights = normal(30, 7, seed=1, dtype=dtype).abs() + 0.1 if weighted else None
    value = energy(points, weights)
    (grad,) = torch.autograd.grad(value, points)
    assert torch.equal(value, energy(torch.zeros_like(points), weights)) and not grad.any()
    (grad,) = torch.autograd.grad(energy(points + 1e-2 * normal(30, 7, 3, seed=2, dtype=dtype), weights), points)
    assert grad.any()


@pytest.mark.parametrize("options", [{"kind": "rank"}, {"kind": "log_det", "eps": 0.0}])
def test_low_rank_options_out_of_range(options):
    with pytest.raises(OptionError, match="'nuclear' or 'log_det'"):
        LowRankEnergy(**options)


# ---------------------------------------------------------------------- smoothness


@pytest.mark.parametrize("order", [1, 2, 3])
def test_smoothness_energy_by_hand(order):
    points = clip()
    energy = SmoothnessEnergy(order)(points)
    assert_close(energy[order:], 0.5 * points.diff(n=order, dim=0).square().sum((-2, -1)))
    assert torch.equal(energy[:order], torch.zeros(order).double())
    time = torch.arange(5.0).double()[:, None, None]
    polynomial = sum(time**k * normal(7, 3, seed=k) for k in range(order))
    assert SmoothnessEnergy(order)(polynomial).abs().max() < 1e-20


def test_smoothness_weighs_as_its_least_frame():
    points, weights = clip(), confidences(clip())
    least = torch.stack([weights[k : k + 3] for k in range(3)]).amin(1)
    expected = 0.5 * (points.diff(n=2, dim=0).square().sum(-1) * least).sum(-1)
    assert_close(SmoothnessEnergy()(points, weights)[2:], expected)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("order", [1, 2])
def test_smoothness_gradient(kind, order):
    points = clip(kind)
    energy = SmoothnessEnergy(order)
    assert gradcheck(energy, points, fast=True)
    assert gradcheck(lambda x: energy(x, confidences(points)), points, fast=True)


def test_smoothness_of_too_few_frames_is_zero_with_a_gradient():
    (grad,) = finite(SmoothnessEnergy(3), clip("two frames"))
    assert torch.equal(grad, torch.zeros_like(grad))
    far = 0.9 * torch.finfo(torch.float16).max
    for dtype in HALVES:
        finite(SmoothnessEnergy(3), torch.full((2, 7, 3), far, dtype=dtype))  # their sum is infinite, and 0 times that


def test_energies_of_no_skeleton_say_so_in_a_line():
    with pytest.raises(OptionError, match="expected kind 'nuclear' or 'log_det' and finite eps > 0, got a Skeleton"):
        LowRankEnergy(BODY)
    with pytest.raises(OptionError, match="expected a whole order >= 1, got a Skeleton"):
        SmoothnessEnergy(BODY)
    with pytest.raises(OptionError, match=r"got 1\.5"):
        SmoothnessEnergy(1.5)


def test_smoothness_order_out_of_range():
    with pytest.raises(OptionError, match="order"):
        SmoothnessEnergy(0)


# ---------------------------------------------------------------------- symmetry


def test_symmetry_energy_by_hand():
    points = clip()
    size = bone_lengths(points, BONES)
    expected = 0.5 * ((size[:, 2] - size[:, 3]).square() + (size[:, 4] - size[:, 5]).square())
    assert_close(SymmetryEnergy(BODY)(points), expected)
    even = points.clone()  # each right joint the mirror image of the left one, about a plane through the spine
    even[:, :3, 0] = 0
    even[:, 4], even[:, 6] = (even[:, k] * torch.tensor([-1.0, 1, 1]) for k in (3, 5))
    assert SymmetryEnergy(BODY)(even).abs().max() < 1e-20


@pytest.mark.parametrize("body", [CHAIN, RING])
def test_skeleton_without_twins_has_no_asymmetry(body):
    points = normal(5, 4, 3)
    (grad,) = finite(SymmetryEnergy(body), points)
    assert torch.equal(SymmetryEnergy(body)(points), torch.zeros(5).double())
    assert torch.equal(grad, torch.zeros_like(grad))
    assert gradcheck(SymmetryEnergy(body), points)


@pytest.mark.parametrize("kind", SMOOTH)
def test_symmetry_gradient(kind):
    assert gradcheck(SymmetryEnergy(BODY), clip(kind), fast=True)
