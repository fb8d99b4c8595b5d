"""Energies: values by hand, gradients with degenerate inputs, and the prox and gradient that solvers use."""

import math
import warnings
from copy import deepcopy

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from numerics import (
    BODY,
    CHAIN,
    DEVICES,
    FLOATS,
    HALVES,
    RING,
    finite,
    gradcheck,
    leaves_arguments_alone,
    normal,
    rotations,
    same_as_loop,
)
from torch.testing import assert_close

import kcs_torch as kt
from kcs_torch.errors import OptionError, ShapeError, SkeletonError
from kcs_torch.functional import bone_lengths, project
from kcs_torch.nn import (
    AdductionEnergy,
    BoneLengthEnergy,
    ContactEnergy,
    ForeshorteningEnergy,
    HingeEnergy,
    JointDistance,
    KCSDistance,
    LowRankEnergy,
    PerspectiveEnergy,
    PostureEnergy,
    ProcrusteanEnergy,
    ProportionEnergy,
    ReprojectionEnergy,
    SmoothnessEnergy,
    StanceEnergy,
    SymmetryEnergy,
)
from kcs_torch.skeleton import SKELETONS

BONES = BODY.bone_index()
RIGID = torch.tensor([0.0, 1, 1, 1, 1, 1]).double()  # the spine is flexible


def clip(kind: str = "any", *batch, dtype=torch.float64, joints: int = 7):
    """Points (..., T, N, 3), ordinary or degenerate."""
    points = {
        "any": lambda: normal(*batch, 5, joints, 3),
        "static": lambda: normal(*batch, 1, joints, 3).expand(*batch, 5, joints, 3).clone(),
        "one frame": lambda: normal(*batch, 1, joints, 3),
        "two frames": lambda: normal(*batch, 2, joints, 3),
        "zero": lambda: torch.zeros(*batch, 5, joints, 3),
        "short bones": lambda: torch.cat([normal(*batch, 5, 2, 3), torch.ones(*batch, 5, joints - 2, 3)], -2),
    }[kind]()
    return points.to(dtype)


KINDS = ["any", "static", "one frame", "two frames", "zero", "short bones"]
SMOOTH = ["any", "static", "one frame", "two frames"]  # no bone of length zero


def confidences(points, seed=3):
    """Weights (..., T, N): some joints unseen, one never, one frame empty where there are several."""
    weights = normal(*points.shape[:-1], seed=seed).abs().clamp_max(1).to(points.dtype)
    weights = weights * (normal(*points.shape[:-1], seed=seed + 1) > -1)
    weights[..., 4] = 0
    if points.shape[-3] > 1:
        weights[..., 1, :] = 0
    return weights


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


def scene(kind="any", *batch, dtype=torch.float64):
    points = clip(kind, *batch, dtype=dtype)
    frames = points.shape[-3]
    return points, normal(*points.shape[:-1], 2, seed=5, dtype=dtype), normal(*batch, frames, 2, 3, seed=6, dtype=dtype)


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


# ---------------------------------------------------------------------- all of them

ENERGIES = {
    "bone length": BoneLengthEnergy(BODY),
    "nuclear": LowRankEnergy(),
    "log_det": LowRankEnergy("log_det"),
    "smoothness": SmoothnessEnergy(),
    "symmetry": SymmetryEnergy(BODY),
}
each_energy = pytest.mark.parametrize("energy", ENERGIES.values(), ids=ENERGIES.keys())


@each_energy
def test_batches_equal_loops(energy):
    same_as_loop(energy, (5, 7, 3))


def test_batches_of_several_arguments_equal_loops():
    energy = ReprojectionEnergy()
    same_as_loop(energy, (5, 7, 3), (5, 7, 2), (5, 2, 3))
    same_as_loop(lambda x, y, r, w: energy(x, y, r, w.abs()), (5, 7, 3), (5, 7, 2), (5, 2, 3), (5, 7))
    same_as_loop(energy.grad, (5, 7, 3), (5, 7, 2), (5, 2, 3))
    bone = BoneLengthEnergy(BODY)
    same_as_loop(lambda x, ell, w: bone(x, ell.abs(), w.abs()), (5, 7, 3), (6,), (5, 7))
    same_as_loop(lambda x, ell: bone.prox(x, ell.abs()), (5, 7, 3), (6,))
    same_as_loop(lambda x: LowRankEnergy().prox(x, 0.5), (5, 7, 3))
    same_as_loop(lambda x, w: SmoothnessEnergy()(x, w.abs()), (5, 7, 3), (5, 7))


@each_energy
@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("dtype", FLOATS)
def test_results_follow_dtype_and_device(energy, dtype, device):
    value = leaves_arguments_alone(energy.to(device), clip(dtype=dtype).to(device))
    energy.to("cpu")
    assert (value.dtype, value.device.type) == (dtype, device)


@each_energy
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("dtype", FLOATS)
def test_degenerate_clips_are_finite(energy, kind, dtype):
    finite(energy, clip(kind, dtype=dtype))


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("dtype", FLOATS)
def test_nothing_seen_is_no_energy(kind, dtype):
    points, tracks, cameras = scene(kind, dtype=dtype)
    none = torch.zeros(points.shape[:-1], dtype=dtype)
    for run in (
        lambda x: BoneLengthEnergy(BODY)(x, None, none),
        lambda x: BoneLengthEnergy(BODY)(x, torch.ones(6, dtype=dtype), none),
        lambda x: ReprojectionEnergy()(x, tracks, cameras, none),
        lambda x: ReprojectionEnergy(huber=1.0)(x, tracks, cameras, none),
        lambda x: SmoothnessEnergy()(x, none),
    ):
        (grad,) = finite(run, points)
        assert torch.equal(run(points), torch.zeros_like(run(points)))
        assert torch.equal(grad, torch.zeros_like(grad))


WEIGHTED = {
    "bone length": lambda x, y, r, w: BoneLengthEnergy(BODY)(x, None, w),
    "bone length, given": lambda x, y, r, w: BoneLengthEnergy(BODY)(x, torch.ones(6, dtype=x.dtype), w),
    "reprojection": lambda x, y, r, w: ReprojectionEnergy()(x, y, r, w),
    "reprojection, no shift": lambda x, y, r, w: ReprojectionEnergy(translation=False)(x, y, r, w),
    "reprojection, huber": lambda x, y, r, w: ReprojectionEnergy(huber=0.5)(x, y, r, w),
    "smoothness": lambda x, y, r, w: SmoothnessEnergy()(x, w),
}


@pytest.mark.parametrize("name", WEIGHTED)
def test_what_weighs_nothing_may_be_nan(name):
    """Unseen joints are NaN in tracks, and in the poses of others: neither value nor gradient may know."""
    energy = WEIGHTED[name]
    points, tracks, cameras = scene()
    weights = torch.ones(points.shape[:-1]).double()
    weights[1, 2] = weights[3, 5] = 0
    weights[4] = 0  # and a frame without anybody
    expected = energy(points, tracks, cameras, weights)
    gone = [torch.where(weights[..., None] > 0, a, torch.nan).requires_grad_() for a in (points, tracks)]
    cameras = cameras.clone().requires_grad_()
    value = energy(*gone, cameras, weights)
    assert_close(value, expected)
    grads = torch.autograd.grad(value.sum(), [*gone, cameras], allow_unused=True)
    for grad in filter(lambda g: g is not None, grads):
        assert torch.isfinite(grad).all()
    assert not grads[0][weights == 0].any() and grads[0].any()
    assert gradcheck(
        lambda x: energy(torch.where(weights[..., None] > 0, x, torch.nan), gone[1], cameras, weights), points
    )


def test_the_plain_gradient_knows_no_nan_either():
    points, tracks, cameras = scene()
    weights = torch.ones(points.shape[:-1]).double()
    weights[1, 2] = 0
    expected = ReprojectionEnergy().grad(points, tracks, cameras, weights)
    tracks[1, 2] = torch.nan
    assert_close(ReprojectionEnergy().grad(points, tracks, cameras, weights), expected)
    assert_close(ReprojectionEnergy().grad(points, tracks, cameras), expected)


@pytest.mark.parametrize("name", [name for name in WEIGHTED if name.startswith("reprojection")])
def test_tracks_that_are_nan_are_unseen(name):
    """Without weights, too."""
    points, tracks, cameras = scene()
    weights = torch.ones(points.shape[:-1]).double()
    weights[1, 2] = weights[3, 5] = 0
    weights[4] = 0
    hidden = torch.where(weights[..., None] > 0, tracks, torch.nan)
    energy = lambda x: WEIGHTED[name](x, hidden, cameras, None)  # noqa: E731
    assert_close(energy(points), WEIGHTED[name](points, tracks, cameras, weights))
    (grad,) = finite(energy, points)
    assert grad.any() and not grad[weights == 0].any()
    assert gradcheck(energy, points)


@pytest.mark.parametrize("kind", ["nuclear", "log_det"])
def test_points_that_are_nan_are_an_error_where_a_matrix_is_factorised(kind):
    points = clip()
    points[1, 2] = torch.nan
    with pytest.raises(ShapeError, match="finite"):
        LowRankEnergy(kind)(points)


@pytest.mark.parametrize("dtype", HALVES)
@pytest.mark.parametrize("name", ["bone length", "symmetry", "smoothness"])
def test_half_precision_in_millimetres(name, dtype):
    energy = ENERGIES[name]
    body = 300 * clip(joints=7)[:1] + 5 * normal(300, 7, 3)  # longer than a sum of lengths in half precision could be
    points = body.to(dtype)
    finite(lambda x: energy(x) / 1000, points)
    assert_close(
        energy(points).double(), energy(points.double()).clamp_max(torch.finfo(dtype).max), rtol=0.02, atol=1.0
    )
    finite(lambda x: ReprojectionEnergy()(x, points[..., :2] + 40, None), points)
    far = 20 * points  # singular values add up to some 130 000
    assert_close(
        LowRankEnergy()(far).double(),
        LowRankEnergy()(far.double()).clamp_max(torch.finfo(dtype).max),
        rtol=0.02,
        atol=0,
    )
    huge = ReprojectionEnergy(translation=False)(points, points[..., :2] + 400)  # 7 joints times 160 000
    assert_close(
        huge.double(), torch.full_like(huge, 1).double() * min(1.12e6, torch.finfo(dtype).max), rtol=0.02, atol=0
    )


@pytest.mark.parametrize("dtype", HALVES)
@pytest.mark.parametrize("huber", [None, 30.0])
def test_tracks_far_from_the_origin_in_half_precision(huber, dtype):
    """The sum that makes the mean of 25 joints at x = 4000 is more than half precision can hold."""
    points = (300 * normal(2, 25, 3)).to(dtype).requires_grad_()
    tracks = (4000 + points.detach()[..., :2] + 40 * normal(2, 25, 2, seed=1)).to(dtype)
    energy = ReprojectionEnergy(huber=huber)
    value, exact = energy(points, tracks), energy(points.double(), tracks.double())
    assert value.dtype == energy.residual(points, tracks).dtype == dtype
    assert_close(value.double(), exact, rtol=0.01, atol=0)
    (grad,) = torch.autograd.grad(value.sum() / 1000, points)
    assert torch.isfinite(grad).all()


@given(st.integers(0, 10**6), st.floats(-6, 6), st.sampled_from(FLOATS), st.sampled_from(KINDS))
@settings(max_examples=60, deadline=None)
def test_nothing_is_nan_at_any_scale(seed, power, dtype, kind):
    scale = 10.0**power
    points = scale * (clip(kind, dtype=dtype) + 0.1 * normal(7, 3, seed=seed, dtype=dtype))
    weights = confidences(points, seed=seed)
    for energy in ENERGIES.values():
        finite(energy, points)
    finite(lambda x, ell: BoneLengthEnergy(BODY)(x, ell, weights), points, scale * normal(6, dtype=dtype).abs())
    finite(lambda x, ell: BoneLengthEnergy(BODY).prox(x, ell), points, scale * normal(6, dtype=dtype).abs())
    tracks, cameras = scale * scene(kind, dtype=dtype)[1], scene(kind, dtype=dtype)[2]
    for huber in (None, 0.1 * scale):
        energy = ReprojectionEnergy(huber=huber)
        finite(lambda x, y, r, e=energy: e(x, y, r, weights), points, tracks, cameras)


@each_energy
def test_energies_are_losses(energy):
    """A few steps of gradient descent lower them."""
    points = clip().requires_grad_()
    before = energy(points).sum()
    for _ in range(20):
        (grad,) = torch.autograd.grad(energy(points).sum(), points)
        points = (points - 1e-3 * grad).detach().requires_grad_()
    assert energy(points).sum() < before


@pytest.mark.parametrize("device", DEVICES)
def test_autocast_does_not_coarsen(device):
    """Pixels need more than three digits; a covariance in half precision is not even definite."""
    points, tracks, cameras = (x.to(device) for x in scene(dtype=torch.float32))
    lengths = torch.ones(6, device=device)
    runs = [lambda e=e: e(points) for e in ENERGIES.values()]
    runs += [
        lambda: ReprojectionEnergy()(points, tracks, cameras),
        lambda: ENERGIES["bone length"].prox(points, lengths),
    ]
    for energy in ENERGIES.values():
        energy.to(device)
    for run in runs:
        expected = run()
        with torch.autocast(device, dtype=torch.bfloat16):
            assert torch.equal(run(), expected)
    with torch.autocast(device, dtype=torch.bfloat16):  # points as a network under autocast gives them
        assert ReprojectionEnergy()(points.bfloat16(), tracks, cameras).dtype == torch.float32
    for energy in ENERGIES.values():
        energy.to("cpu")


@pytest.mark.parametrize("energy", [PostureEnergy, StanceEnergy, HingeEnergy, AdductionEnergy, ProcrusteanEnergy])
def test_autocast_does_not_coarsen_what_a_skeleton_knows(energy):
    """Under autocast the posture's scatter had three digits, and the energy was off by a third."""
    points, module = normal(2, 6, 17, 3, dtype=torch.float32), energy(TRUNK)
    expected = module(points)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        assert torch.equal(module(points), expected)


@pytest.mark.parametrize("deterministic", [False, True])
@each_energy
def test_shapes_are_known_without_data(energy, deterministic):
    """The meta device has no autocast to suspend, and as few deterministic operations as a GPU."""
    torch.use_deterministic_algorithms(deterministic)
    points = clip(dtype=torch.float32)
    assert deepcopy(energy).to("meta")(points.to("meta")).shape == energy(points).shape


@pytest.mark.parametrize("dtype", HALVES)
@each_energy
def test_half_precision(energy, dtype):
    points = clip(dtype=dtype)
    value = energy(points)
    assert value.dtype == dtype
    assert_close(value.double(), energy(points.double()), rtol=0.05, atol=0.1)


def test_energies_of_long_clips_stay_in_the_range_of_half_precision():
    """A thousand frames of ProcrusteanEnergy were infinite."""
    points = (400 * normal(1000, 17, 3, dtype=torch.float32)).half().requires_grad_()
    for energy in (ProcrusteanEnergy(TRUNK), PostureEnergy(TRUNK), LowRankEnergy(), LowRankEnergy("log_det")):
        value = energy(points)
        (grad,) = torch.autograd.grad(value, points)
        assert value.isfinite() and grad.isfinite().all()


def test_modules_move_their_buffers_and_save_no_state():
    energy = BoneLengthEnergy(BODY).to(torch.float32)
    assert energy(clip(dtype=torch.float32)).dtype == torch.float32
    assert energy.bones.dtype == torch.long
    assert not energy.state_dict() and not list(energy.parameters())
    assert "body7" in repr(energy)


@pytest.mark.parametrize("energy", [BoneLengthEnergy(BODY), SymmetryEnergy(BODY)])
@pytest.mark.parametrize("shape", [(5, 6, 3), (7, 3), (7,), (5, 8, 3)])
def test_wrong_points_are_refused_with_the_skeletons_name(energy, shape):
    with pytest.raises(ShapeError, match=r"\(\.\.\., T, 7, 3\) for skeleton 'body7'"):
        energy(torch.zeros(shape))


@pytest.mark.parametrize("energy", [LowRankEnergy(), LowRankEnergy("log_det"), SmoothnessEnergy()])
def test_a_single_pose_is_no_clip(energy):
    with pytest.raises(ShapeError, match=r"\(\.\.\., T, N, D\), got \(7, 3\)"):
        energy(torch.zeros(7, 3))


def test_other_shapes_that_do_not_fit():
    points, tracks, cameras = scene()
    with pytest.raises(ShapeError, match=r"lengths \(\.\.\., 6\)"):
        BoneLengthEnergy(BODY)(points, torch.ones(5))
    for run in (
        lambda w: BoneLengthEnergy(BODY)(points, None, w),
        lambda w: SmoothnessEnergy()(points, w),
        lambda w: ReprojectionEnergy()(points, tracks, cameras, w),
    ):
        with pytest.raises(ShapeError, match=r"weights \(\.\.\., 5, 7\) for points \(5, 7, 3\), got \(5, 6\)"):
            run(torch.ones(5, 6))
    for wrong in (tracks[:1], tracks[:, :6], points):
        with pytest.raises(ShapeError, match=r"tracks \(\.\.\., 5, 7, 2\)"):
            ReprojectionEnergy()(points, wrong, cameras)
    for wrong in ((points, cameras[:1]), (points[..., :2], cameras)):
        with pytest.raises(ShapeError, match=r"points \(\.\.\., T, N, 3\) and cameras \(\.\.\., 5, 2, 3\)"):
            ReprojectionEnergy()(wrong[0], tracks, wrong[1])


TRUNK = SKELETONS["h36m17"]
SEEN = 1000 * normal(4, 5, 17, 3)[..., :2] / (10 + normal(4, 5, 17, 3)[..., 2:])
STANCE, POSTURE = StanceEnergy(TRUNK), PostureEnergy(TRUNK)
CALLS = {
    "bone length": lambda p, w: BoneLengthEnergy(TRUNK)(p, None, w),
    "symmetry": lambda p, w: SymmetryEnergy(TRUNK)(p, w),
    "smoothness": lambda p, w: SmoothnessEnergy()(p, w),
    "low rank": lambda p, w: LowRankEnergy()(p, w),
    "reprojection": lambda p, w: ReprojectionEnergy()(p, torch.zeros(4, 5, 17, 2), None, w),
    "perspective": lambda p, w: PerspectiveEnergy()(p, SEEN, (1000, 1000, 0, 0), w),
    "joints": lambda p, w: JointDistance()(p, torch.zeros(4, 5, 17, 3), w),
    "kcs": lambda p, w: KCSDistance(TRUNK)(p, torch.zeros(4, 5, 17, 3), w),
    "foreshortening": lambda p, w: ForeshorteningEnergy(TRUNK)(p, None, w),
    "procrustean": lambda p, w: ProcrusteanEnergy(TRUNK)(p, None, w),
    "hinge": lambda p, w: HingeEnergy(TRUNK)(p, None, w),
    "stance": lambda p, w: STANCE(p, None, w),
    "posture": lambda p, w: POSTURE(p, None, w),
}


@pytest.mark.parametrize("name", CALLS)
def test_what_is_no_batch_of_weighted_points_is_refused_in_our_words(name):
    """Without these checks torch tells of sizes at dimensions, or of attributes that arrays do not have."""
    call, points, weights = CALLS[name], torch.randn(4, 5, 17, 3), torch.ones(4, 5, 17)
    assert call(points, weights).isfinite().all()
    with pytest.raises(ShapeError, match="expected a tensor of points, got ndarray"):
        call(points.numpy(), weights)
    with pytest.raises(ShapeError, match="expected points in floating point, got torch.int64"):
        call(points.long(), weights)
    with pytest.raises(ShapeError, match="expected a tensor of weights, got ndarray"):
        call(points, weights.numpy())
    with pytest.raises(ShapeError, match=r"expected weights .*got \(3, 5, 17\)"):
        call(points, weights[:3])
    with pytest.raises(ShapeError, match=r"expected weights .*got \(4, 5, 17, 1\)"):
        call(points, weights[..., None])


@pytest.mark.parametrize("name", CALLS)
def test_second_derivatives_are_right_or_refused(name):
    points, weights = 1.1 * normal(4, 5, 17, 3), torch.ones(4, 5, 17, dtype=torch.float64)
    leaf, direction = points.clone().requires_grad_(), normal(*points.shape, seed=4)
    first = lambda x: torch.autograd.grad(CALLS[name](x, weights).sum(), x, create_graph=True)[0]  # noqa: E731
    if name in ("low rank", "procrustean"):
        with pytest.raises(RuntimeError, match="second derivatives of .* not supported"):
            first(leaf).square().sum().backward()
        return
    (found,) = torch.autograd.grad((first(leaf) * direction).sum(), leaf)
    near = [first((points + s * 1e-6 * direction).requires_grad_()).detach() for s in (-1, 1)]
    assert_close(found, (near[1] - near[0]) / 2e-6, rtol=1e-4, atol=1e-4 * float(found.abs().max()))


@pytest.mark.parametrize("name", CALLS)
def test_losses_compile_without_a_break_and_map(name):
    points, weights = normal(4, 5, 17, 3, dtype=torch.float32), torch.ones(4, 5, 17)
    plain = CALLS[name](points, weights)
    torch._dynamo.reset()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # what Dynamo says of itself
        found = torch.compile(CALLS[name], backend="aot_eager", fullgraph=True)(points, weights)
    torch._dynamo.reset()
    assert_close(found, plain)
    if name in ("bone length", "symmetry", "smoothness", "low rank", "foreshortening", "procrustean"):
        points, weights = points.double(), weights.double()  # in single precision rounding alone is .1 % of a slope
        slope = torch.func.vmap(torch.func.grad(lambda x, w: CALLS[name](x, w).sum()))(points, weights)
        leaf = points.clone().requires_grad_()
        CALLS[name](leaf, weights).sum().backward()
        assert_close(slope, leaf.grad)


@pytest.mark.parametrize(
    "energy", [AdductionEnergy, BoneLengthEnergy, HingeEnergy, PostureEnergy, ForeshorteningEnergy]
)
def test_lengths_that_do_not_fit(energy):
    """Weights given in their place, most of all."""
    energy, points = energy(TRUNK), torch.randn(4, 5, 17, 3)
    assert energy(points, torch.ones(4, 16)).isfinite().all()
    assert_close(energy(points, torch.ones(16)), energy(points, torch.ones(4, 16)))
    for wrong in (torch.ones(15), torch.ones(4, 5, 17), torch.ones(3, 16), torch.ones(4, 5, 16), torch.ones(())):
        with pytest.raises(ShapeError, match=r"expected lengths \(\.\.\., 16\), the same in all frames"):
            energy(points, wrong)
    with pytest.raises(ShapeError, match="expected a tensor of lengths, got list"):
        energy(points, [1.0] * 16)


def test_other_arguments_that_do_not_fit():
    points = torch.randn(4, 5, 17, 3)
    for wrong in (torch.eye(3), torch.ones(4, 5, 17)):
        with pytest.raises(ShapeError, match=r"rotations \(\.\.\., 5, 3, 3\)"):
            ProcrusteanEnergy(TRUNK)(points, wrong)
    with pytest.raises(ShapeError, match=r"points \(\.\.\., T, 17, 3\) and rotations"):
        ProcrusteanEnergy(TRUNK)(points[..., :2])
    with pytest.raises(ShapeError, match=r"expected points \(\.\.\., T, N, 3\)"):
        ForeshorteningEnergy(TRUNK)(points[..., :2])
    with pytest.raises(ShapeError, match=r"expected bone_weights \(\.\.\., 5, 16\)"):
        ForeshorteningEnergy(TRUNK)(points, bone_weights=torch.ones(4, 5, 17))
    with pytest.raises(ShapeError, match=r"expected tracks .*for points \(4, 5, 17, 3\), got \(3, 5, 17, 2\)"):
        ReprojectionEnergy()(points, torch.zeros(3, 5, 17, 2))
    with pytest.raises(ShapeError, match=r"got \(4, 5, 17, 3\) and \(3, 5, 17, 2\)"):
        PerspectiveEnergy()(points, torch.zeros(3, 5, 17, 2), (1000, 1000, 0, 0))


BESIDE = {
    "cameras": (lambda x, given: ReprojectionEnergy()(x, x[..., :2], given), (5, 2, 3)),
    "rotations": (lambda x, given: ProcrusteanEnergy(TRUNK)(x, given), (5, 3, 3)),
    "bone_weights": (lambda x, given: ForeshorteningEnergy(TRUNK)(x, bone_weights=given), (5, 16)),
    "bone_noise": (lambda x, given: ForeshorteningEnergy(TRUNK)(x, bone_noise=given), (5, 16)),
    "independent": (lambda x, given: PostureEnergy(TRUNK)(x, independent=given), (5,)),
    "velocity": (lambda x, given: ContactEnergy(TRUNK)(x, given, torch.ones(5, len(TRUNK.contacts))), (5,)),
    "standing": (lambda x, given: ContactEnergy(TRUNK)(x, None, given), (5, len(TRUNK.contacts))),
    "size": (lambda x, given: StanceEnergy(TRUNK)(x, given), ()),
}


@pytest.mark.parametrize("name", BESIDE)
def test_what_stands_beside_points_is_of_their_batch(name):
    """These ended in errors of torch about sizes at some dimension, or lists without shapes."""
    energy, shape = BESIDE[name]
    points = normal(4, 5, 17, 3)
    assert energy(points, torch.ones(4, *shape, dtype=torch.float64)).isfinite().all()
    assert energy(points, torch.ones(shape)).isfinite().all()  # of all clips, in single precision
    with pytest.raises(ShapeError, match=rf"{name}:? .*\(\.\.\..*got .*\(3,"):
        energy(points, torch.ones(3, *shape))
    if shape:
        with pytest.raises(ShapeError, match=rf"expected a tensor of {name}, got list"):
            energy(points, torch.ones(4, *shape).tolist())
    with pytest.raises(ShapeError, match=r"expected points|expected a tensor of points"):
        energy(points[0, 0], torch.ones(4, *shape))


def test_lengths_and_weights_of_proportions_fit():
    energy = ProportionEnergy(TRUNK)
    for wrong in (torch.tensor(1.0), torch.ones(15)):
        with pytest.raises(ShapeError, match=r"expected lengths \(\.\.\., 16\), got"):
            energy(wrong)
    for wrong in (torch.ones(15), torch.ones(3, 16), torch.ones(1)):
        with pytest.raises(ShapeError, match=r"expected weights \(\.\.\., 16\), got .* for lengths \(2, 16\)"):
            energy(torch.ones(2, 16), wrong)
    with pytest.raises(ShapeError, match="expected lengths in floating point, got torch.int64"):
        energy(torch.ones(16).long())
    with pytest.raises(ShapeError, match="expected a tensor of lengths, got list"):
        energy([1.0] * 16)


def test_tracks_may_be_whole_pixels():
    points, tracks = normal(4, 5, 17, 3), (100 * normal(4, 5, 17, 2)).long()
    assert_close(ReprojectionEnergy()(points, tracks), ReprojectionEnergy()(points, tracks.double()))
    assert ReprojectionEnergy()(points.half(), tracks).dtype == torch.float16


@pytest.mark.parametrize(
    ("energy", "options"),
    [
        (ContactEnergy, {"slip": 0.0, "change": -1.0, "num_steps": 1.5}),
        (ForeshorteningEnergy, {"correlation": 0.0, "eps": -0.1}),
        (PostureEnergy, {"strength": 0.0, "kappa": -1.0, "correlation": float("nan")}),
        (ProportionEnergy, {"spread": 0.0, "twins": -0.03, "excess": "wide"}),
        (StanceEnergy, {"sway": 0.0, "fold": -0.1}),
    ],
)
def test_numbers_that_make_no_energy_are_refused(energy, options):
    """They made NaN, infinite or negative ones."""
    for name, value in options.items():
        with pytest.raises(OptionError, match=f"{energy.__name__}: {name}: expected a (positive|whole) number"):
            energy(TRUNK, **{name: value})


def test_parts_of_energies_check_what_they_are_given():
    """Of another skeleton's joints the trunk was found; a negative stiffness gave NaN, whole numbers were cut off."""
    points = normal(5, 17, 3)
    for wrong in (points[:, :16], points[..., :2]):
        with pytest.raises(ShapeError, match=r"PostureEnergy: expected points \(\.\.\., T, (17|N), 3\)"):
            POSTURE.frame(wrong)
    with pytest.raises(ShapeError, match=r"expected lengths \(\.\.\., 16\)"):
        BoneLengthEnergy(TRUNK).prox(points, torch.ones(5, 17))
    with pytest.raises(ShapeError, match="expected a tensor of lengths, got list"):
        BoneLengthEnergy(TRUNK).prox(points, [1.0] * 16)
    with pytest.raises(OptionError, match="stiffness: expected a number that is not negative, got -1"):
        BoneLengthEnergy(TRUNK).prox(points, torch.ones(16).double(), -1.0)
    with pytest.raises(ShapeError, match="LowRankEnergy: expected points in floating point"):
        LowRankEnergy().prox(points.long(), 1.0)
    with pytest.raises(ShapeError, match=r"LowRankEnergy: expected points \(\.\.\., T, N, D\)"):
        LowRankEnergy().prox(points[0], 1.0)
    with pytest.raises(ShapeError, match="expected a tensor of cameras, got NoneType"):
        ReprojectionEnergy().grad(points, points[..., :2], None)


def test_unknown_skeletons_are_named():
    with pytest.raises(SkeletonError, match="h36m17"):
        BoneLengthEnergy("h36m18")


@pytest.mark.parametrize(
    ("make", "told"),
    [
        (lambda: kt.nn.ReprojectionEnergy(huber="a"), "positive huber length or None, got 'a'"),
        (lambda: kt.nn.PerspectiveEnergy(huber="a"), "positive huber length or None, .* got 'a' and 0.15"),
        (lambda: kt.nn.PerspectiveEnergy(nearest=None), "positive nearest depth, got None and None"),
        (lambda: kt.nn.LowRankEnergy(eps="1e-3"), "eps > 0, got 'nuclear' and '1e-3'"),
        (lambda: kt.nn.ProcrusteanEnergy("coco17", num_steps="3"), "num_steps >= 0, got .* and '3'"),
        (lambda: kt.nn.AdductionEnergy("coco17", limit="a"), "limit: expected a sine within 0..1, got 'a'"),
        (lambda: kt.nn.MLPLifter("coco17", dropout=None), "dropout: expected a share .*, got None"),
    ],
)
def test_words_for_numbers_are_refused(make, told):
    with pytest.raises(kt.OptionError, match=told):
        make()


INFINITE = {
    "slip": lambda inf: kt.nn.ContactEnergy("h36m17", slip=inf),
    "eps": lambda inf: kt.nn.ForeshorteningEnergy("h36m17", eps=inf),
    "eps of a log-determinant": lambda inf: kt.nn.LowRankEnergy("log_det", eps=inf),
    "nearest": lambda inf: kt.nn.PerspectiveEnergy(nearest=inf),
    "kappa": lambda inf: kt.nn.PostureEnergy("h36m17", kappa=inf),
    "strength": lambda inf: kt.nn.PostureEnergy("h36m17", strength=inf),
    "eps of bones": lambda inf: kt.nn.ProcrusteanEnergy("h36m17", eps=inf),
    "fold": lambda inf: kt.nn.StanceEnergy("h36m17", fold=inf),
}


@pytest.mark.parametrize("name", INFINITE)
def test_infinite_options_are_refused(name):
    """The energy was NaN."""
    with pytest.raises(kt.OptionError, match="finite.* got .*inf"):
        INFINITE[name](float("inf"))


def test_infinite_options_that_switch_a_term_off():
    points = torch.randn(10, 17, 3)
    assert kt.nn.PostureEnergy("h36m17", correlation=float("inf"))(points) == 0
    assert kt.nn.ForeshorteningEnergy("h36m17", correlation=float("inf"))(points) == 0
    lengths = bone_lengths(points, kt.SKELETONS["h36m17"].bone_index()).mean(0)
    odd = [kt.nn.ProportionEnergy("h36m17", twins=twins)(lengths) for twins in (0.03, float("inf"))]
    assert 0 < odd[1] < odd[0]


def test_lengths_of_each_frame_are_told_apart_from_those_of_clips():
    body = kt.SKELETONS["h36m17"]
    points = torch.randn(10, 17, 3)
    with pytest.raises(ShapeError, match="the same in all frames"):
        kt.nn.BoneLengthEnergy(body)(points, bone_lengths(points, body.bone_index()))
    assert kt.nn.BoneLengthEnergy(body)(points[None], torch.ones(10, 16)).shape == (10, 10)
