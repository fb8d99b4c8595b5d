"""What every energy keeps to: batches, precision, weights of zero, NaN, any scale."""

import math
import warnings
from copy import deepcopy

import pytest
import torch
from energy_clips import CALLS, KINDS, TRUNK, clip, confidences, scene
from hypothesis import given, settings
from hypothesis import strategies as st
from numerics import (
    BODY,
    DEVICES,
    FLOATS,
    HALVES,
    finite,
    gradcheck,
    leaves_arguments_alone,
    normal,
    same_as_loop,
)
from torch.testing import assert_close

from kcs_torch.errors import ShapeError
from kcs_torch.nn import (
    AdductionEnergy,
    BoneLengthEnergy,
    ContactEnergy,
    ForeshorteningEnergy,
    HingeEnergy,
    LowRankEnergy,
    PerspectiveEnergy,
    PostureEnergy,
    ProcrusteanEnergy,
    ReprojectionEnergy,
    SmoothnessEnergy,
    StanceEnergy,
    SymmetryEnergy,
)

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


HINGE, ADDUCTION, STANCE, POSTURE = (
    kind(TRUNK) for kind in (HingeEnergy, AdductionEnergy, StanceEnergy, PostureEnergy)
)
FORESHORTENING, PROCRUSTEAN = ForeshorteningEnergy(TRUNK), ProcrusteanEnergy(TRUNK)
LENS, IMAGE, STANDS = (1000, 1000, 0, 0), 300 * normal(6, 17, 2, dtype=torch.float32), torch.ones(6, 2)
WITHOUT_UNIT = {
    "hinge": lambda x, ell, s, w: HINGE(x, None, w),
    "hinge, lengths": lambda x, ell, s, w: HINGE(x, ell, w),
    "adduction": lambda x, ell, s, w: ADDUCTION(x, None, w),
    "adduction, lengths": lambda x, ell, s, w: ADDUCTION(x, ell, w),
    "stance": lambda x, ell, s, w: STANCE(x, None, w),
    "stance, size": lambda x, ell, s, w: STANCE(x, s, w),
    "posture": lambda x, ell, s, w: POSTURE(x, None, w),
    "posture, lengths": lambda x, ell, s, w: POSTURE(x, ell, w),
    "procrustean": lambda x, ell, s, w: PROCRUSTEAN(x, None, w),
    "perspective": lambda x, ell, s, w: PerspectiveEnergy()(x, IMAGE, LENS, w),
    "perspective, no shift": lambda x, ell, s, w: PerspectiveEnergy(translation=False)(x, IMAGE, LENS, w),
    "contact": lambda x, ell, s, w: ContactEnergy(TRUNK, slip=0.006 * s, change=0.004 * s)(x, None, STANDS, w),
}


@pytest.mark.parametrize("weighted", [False, True])
@pytest.mark.parametrize("name", WITHOUT_UNIT)
def test_what_has_no_unit_is_the_same_at_any_scale(name, weighted):
    """Squares in single precision reach from 1e-19 to 1e19; what is below 1e-9 may count as a point."""
    points, lengths, energy = normal(6, 17, 3).float(), normal(16).float().abs() + 0.3, WITHOUT_UNIT[name]
    weights = confidences(points) if weighted else None
    expected = energy(points, lengths, 1.0, weights)
    for power in (-30, -25, -21, -20, -17, -12, -8, -3, 3, 12, 17, 18, 20, 25, 30):
        scale = 10.0**power
        finite(lambda x, ell, s=scale: energy(x, ell, s, weights), scale * points, scale * lengths)
        if power >= -8:
            assert_close(energy(scale * points, scale * lengths, scale, weights), expected, rtol=1e-3, atol=1e-3)


@pytest.mark.parametrize("noise", [None, 0.1])
@pytest.mark.parametrize("given", [False, True])
def test_foreshortening_of_any_scale_differs_by_its_logarithm(given, noise):
    points, lengths = normal(6, 17, 3).float(), normal(16).float().abs() + 0.3

    def energy(x, ell, scale):
        noises = None if noise is None else torch.full((6, 16), scale * noise)
        return FORESHORTENING(x, ell if given else None, bone_noise=noises)

    expected = energy(points, lengths, 1.0)
    for power in (-30, -20, -15, -8, 8, 17, 20, 30):
        scale = 10.0**power
        finite(lambda x, ell, s=scale: energy(x, ell, s), scale * points, scale * lengths)
        if power >= -15:
            shift = 2 * math.log(scale) * 6 * FORESHORTENING.free.sum() / FORESHORTENING.correlation
            assert_close(energy(scale * points, scale * lengths, scale), expected + shift, rtol=1e-3, atol=1e-2)


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
