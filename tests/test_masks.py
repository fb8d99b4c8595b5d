"""Weights of every energy: what counts nothing is out, NaN beneath it included, in value and in gradient."""

import pytest
import torch
from numerics import BODY, FLOATS, finite, gradcheck, normal
from torch.testing import assert_close

import kcs_torch.nn as modules
from kcs_torch.data import walking_person
from kcs_torch.errors import ShapeError
from kcs_torch.functional import bone_lengths
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
from kcs_torch.nn.masks import weighs_joints
from kcs_torch.skeleton import SKELETONS

MAN = SKELETONS["h36m17"]
BONES = MAN.bone_index()
FRAMES = 7
WALK = walking_person(FRAMES, turn=20.0).points / 1000
LENGTHS = bone_lengths(WALK, BONES).mean(0)
TARGET = WALK + 0.1 * normal(FRAMES, 17, 3, seed=8)
TRACKS = WALK[..., :2] + 0.1 * normal(FRAMES, 17, 2, seed=5)
CAMERAS = normal(FRAMES, 2, 3, seed=6)
LENS = (3.0, 3.1, 0.2, 0.1)
STAND = torch.rand(FRAMES, len(MAN.contacts), generator=torch.Generator().manual_seed(1)).double()


def lengths_of(points, weights):
    """Lengths (B,) of a clip, and the weight of each bone: 0 for those never seen."""
    size = bone_lengths(torch.nan_to_num(points), BONES)
    share = torch.minimum(weights[:, BONES[:, 0]], weights[:, BONES[:, 1]])
    total = share.sum(0)
    return (size * share).sum(0) / total.clamp_min(1e-9), (total > 0).double()


# Each takes points (T, 17, 3), weights (T, 17) or None, and the frames of the clip that there are.
WEIGHTED = {
    "BoneLengthEnergy": lambda x, w, t: BoneLengthEnergy(MAN)(x, None, w),
    "BoneLengthEnergy, given": lambda x, w, t: BoneLengthEnergy(MAN)(x, 1.1 * LENGTHS, w),
    "ContactEnergy": lambda x, w, t: ContactEnergy(MAN)(x, 0.01 * normal(FRAMES)[t], STAND[t], w),
    "ForeshorteningEnergy": lambda x, w, t: ForeshorteningEnergy(MAN)(x, LENGTHS, w),
    "ForeshorteningEnergy, own": lambda x, w, t: ForeshorteningEnergy(MAN)(x, None, w),
    "AdductionEnergy": lambda x, w, t: AdductionEnergy(MAN, limit=0)(x, None, w),
    "HingeEnergy": lambda x, w, t: HingeEnergy(MAN)(-x, None, w),
    "HingeEnergy, given": lambda x, w, t: HingeEnergy(MAN)(-x, LENGTHS, w),
    "JointDistance": lambda x, w, t: JointDistance()(x, TARGET[t], w),
    **{
        f"JointDistance, {how}": lambda x, w, t, how=how: JointDistance(how, root=8)(x, TARGET[t], w)
        for how in ("root", "scale", "rigid", "similarity", "sequence")
    },
    "KCSDistance": lambda x, w, t: KCSDistance(MAN)(x, TARGET[t], w),
    "KCSDistance, absolute": lambda x, w, t: KCSDistance(MAN, squared=False)(x, TARGET[t], w),
    "KCSDistance, free of scale": lambda x, w, t: KCSDistance(MAN, scale_free=True)(x, TARGET[t], w),
    "LowRankEnergy": lambda x, w, t: LowRankEnergy()(x, w),
    "LowRankEnergy, log_det": lambda x, w, t: LowRankEnergy("log_det")(x, w),
    "PerspectiveEnergy": lambda x, w, t: PerspectiveEnergy()(x, TRACKS[t], LENS, w),
    "PerspectiveEnergy, huber": lambda x, w, t: PerspectiveEnergy(huber=0.05)(x, TRACKS[t], LENS, w),
    "PostureEnergy": lambda x, w, t: PostureEnergy(MAN)(x, None, w),
    "PostureEnergy, given": lambda x, w, t: PostureEnergy(MAN)(x, LENGTHS, w),
    "ProcrusteanEnergy": lambda x, w, t: ProcrusteanEnergy(MAN)(x, None, w),
    "ProcrusteanEnergy, changes": lambda x, w, t: ProcrusteanEnergy(MAN, order=1)(x, None, w),
    "ReprojectionEnergy": lambda x, w, t: ReprojectionEnergy()(x, TRACKS[t], CAMERAS[t], w),
    "ReprojectionEnergy, huber": lambda x, w, t: ReprojectionEnergy(huber=0.1)(x, TRACKS[t], None, w),
    "StanceEnergy": lambda x, w, t: StanceEnergy(MAN)(x, None, w),
    "StanceEnergy, given": lambda x, w, t: StanceEnergy(MAN)(x, 1.1, w),
    "SmoothnessEnergy": lambda x, w, t: SmoothnessEnergy()(x, w),
    "SymmetryEnergy": lambda x, w, t: SymmetryEnergy(MAN)(x, w),
}
ALL = slice(0, FRAMES)
OWN = ("ForeshorteningEnergy, own", "PostureEnergy", "StanceEnergy")
each = pytest.mark.parametrize("name", WEIGHTED)
# A contact's other unknown, the root's velocity, is charged also where no foot is seen.
each_of_points = pytest.mark.parametrize("name", [name for name in WEIGHTED if name != "ContactEnergy"])
# Lengths that are not given are those of all frames that count at all.
each_but_lengths = pytest.mark.parametrize("name", [name for name in WEIGHTED if name not in OWN])


def gaps():
    """Some joints unseen, one never, one of the trunk now and then, and a frame that is empty."""
    weights = torch.ones(FRAMES, 17).double()
    weights[1, 2] = weights[3, 5] = weights[2, 16] = 0
    weights[:, MAN.index("left_wrist")] = 0
    weights[0, MAN.index("left_hip")] = 0
    weights[4] = 0
    return weights


def test_every_energy_is_here():
    names = {name for name in modules.__all__ if name.endswith(("Energy", "Distance"))}
    assert {name.partition(",")[0] for name in WEIGHTED} == names - {"ProportionEnergy"}  # which sees lengths only


@each
def test_weights_of_one_change_nothing(name):
    energy = WEIGHTED[name]
    assert_close(energy(WALK, torch.ones(FRAMES, 17).double(), ALL), energy(WALK, None, ALL))


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16])
@each
def test_weights_in_half_precision_lose_no_digits_of_the_sums(name, dtype):
    energy, own = WEIGHTED[name], torch.rand(FRAMES, 17, generator=torch.Generator().manual_seed(2)).to(dtype)
    assert_close(energy(WALK, own, ALL), energy(WALK, own.double(), ALL), rtol=1e-5, atol=1e-6)


@each
def test_what_weighs_nothing_may_be_nan(name):
    energy, weights = WEIGHTED[name], gaps()
    seen = weights[..., None] > 0
    expected = energy(torch.where(seen, WALK, 3 * normal(FRAMES, 17, 3)), weights, ALL)
    gone = torch.where(seen, WALK, torch.nan).requires_grad_()
    value = energy(gone, weights, ALL)
    assert value.any()
    assert_close(value, expected)
    (grad,) = torch.autograd.grad(value.sum(), gone)
    assert torch.isfinite(grad).all() and not grad[weights == 0].any() and grad.any()


@each
def test_weights_below_zero_count_as_zero(name):
    """A detector's -1 says that it has seen nothing."""
    energy, weights = WEIGHTED[name], gaps()
    assert_close(energy(WALK, torch.where(weights > 0, weights, -1), ALL), energy(WALK, weights, ALL))


@pytest.mark.parametrize("name", ["AdductionEnergy", "ContactEnergy", "HingeEnergy", "PostureEnergy", "StanceEnergy"])
def test_weights_of_frames_below_zero_count_as_zero(name):
    energy, weights = WEIGHTED[name], torch.ones(FRAMES).double()
    weights[-2:] = 0
    assert_close(energy(WALK, torch.where(weights > 0, weights, -1), ALL), energy(WALK, weights, ALL))


@each
def test_gradient_beside_gaps_and_in_the_weights(name):
    energy, weights = WEIGHTED[name], gaps()
    seen = weights[..., None] > 0
    assert gradcheck(lambda x: energy(torch.where(seen, x, torch.nan), weights, ALL), WALK, fast=True)
    some = 0.3 + 0.6 * torch.rand(FRAMES, 17, generator=torch.Generator().manual_seed(2)).double()
    assert gradcheck(lambda w: energy(WALK, w, ALL), some, fast=True)
    finite(lambda w: energy(torch.where(seen, WALK, torch.nan), w, ALL), weights)


@each_of_points
def test_empty_frames_at_the_end_are_no_frames(name):
    """As of a shorter clip in a batch."""
    energy, keep = WEIGHTED[name], slice(0, FRAMES - 2)
    weights = gaps()
    weights[keep.stop :] = 0
    value, short = energy(WALK, weights, ALL), energy(WALK[keep], weights[keep], keep)
    assert_close(value[keep] if value.ndim else value, short)
    if value.ndim:
        assert not value[keep.stop :].any()


@each_of_points
@pytest.mark.parametrize("weights", [None, torch.ones(0, 17).double()])
def test_a_clip_without_frames_has_no_energy(name, weights):
    leaf = WALK[:0].clone().requires_grad_()
    value = WEIGHTED[name](leaf, weights, slice(0, 0))
    (grad,) = torch.autograd.grad(value.sum(), leaf)
    assert not value.any() and grad.shape == leaf.shape


@each_of_points
@pytest.mark.parametrize("dtype", FLOATS)
def test_nothing_seen_is_no_energy(name, dtype):
    none = torch.zeros(FRAMES, 17, dtype=dtype)
    for points in (WALK.to(dtype), torch.full((FRAMES, 17, 3), torch.nan, dtype=dtype)):
        leaf = points.requires_grad_()
        value = WEIGHTED[name](leaf, none, ALL)
        (grad,) = torch.autograd.grad(value.sum(), leaf)
        assert not value.any() and not grad.any()


@each_but_lengths
def test_a_joint_that_weighs_less_matters_less(name):
    """Of weight 1e-6 it is nearly out, for weights say how much, not only whether."""
    energy, joint = WEIGHTED[name], MAN.index("left_ankle")
    weights = torch.ones(FRAMES, 17).double()
    weights[3, joint] = 0
    without = energy(WALK, weights, ALL)
    weights[3, joint] = 1e-8
    assert_close(energy(WALK, weights, ALL), without, rtol=1e-3, atol=1e-6)


def test_low_rank_without_a_joint_is_that_of_the_others():
    points, weights = normal(9, 6, 3), torch.ones(9, 6).double()
    weights[:, 2] = weights[4] = 0
    kept = [t for t in range(9) if t != 4], [n for n in range(6) if n != 2]
    for kind in ("nuclear", "log_det"):
        energy = LowRankEnergy(kind)
        assert_close(energy(points, weights), energy(points[kept[0]][:, kept[1]]))
    half = torch.full((9, 6), 0.25).double()
    assert_close(LowRankEnergy()(points, half), 0.5 * LowRankEnergy()(points))
    assert_close(LowRankEnergy("log_det")(points, half), 0.25 * LowRankEnergy("log_det")(points))


def test_proportions_of_bones_never_seen_are_left_out():
    energy = ProportionEnergy(MAN)
    lengths = MAN.relative_lengths(dtype=torch.float64) * (0.1 * normal(16)).exp()
    assert_close(energy(lengths, torch.ones(16).double()), energy(lengths))
    weights = torch.ones(16).double()
    weights[[2, 7]] = 0
    gone = torch.where(weights > 0, lengths, torch.nan).requires_grad_()
    value = energy(gone, weights)
    assert_close(value, energy(torch.where(weights > 0, lengths, 5 * lengths), weights))
    (grad,) = torch.autograd.grad(value, gone)
    assert torch.isfinite(grad).all() and not grad[weights == 0].any() and grad.any()
    assert gradcheck(lambda x, w: energy(x, w), lengths, weights + 0.1)
    assert energy(lengths, 0 * weights).item() == 0


def test_rows_of_weights_are_told_by_their_shape():
    points, module = torch.zeros(2, 5, 7, 3), BoneLengthEnergy(BODY)
    assert weighs_joints(torch.ones(2, 5, 7), points, module)
    assert weighs_joints(torch.ones(5, 7), points, module)
    assert not weighs_joints(torch.ones(2, 5), points, module)
    assert not weighs_joints(torch.ones(5), points, module)
    square = torch.zeros(7, 7, 7, 3)  # as many clips as frames as joints
    assert weighs_joints(torch.ones(7, 7, 7), square, module)
    assert not weighs_joints(torch.ones(7, 7), square, module)
    for wrong in ((2, 7), (5, 6), ()):
        with pytest.raises(ShapeError, match=r"weights \(\.\.\., 5, 7\) of joints or \(\.\.\., 5\) of frames"):
            weighs_joints(torch.ones(wrong), points, module)


def test_weights_that_do_not_fit_are_refused():
    for name, energy in WEIGHTED.items():
        if not name.startswith("ContactEnergy"):
            with pytest.raises(ShapeError, match="weights"):
                energy(WALK, torch.ones(FRAMES - 1, 17).double(), ALL)


def test_weights_of_joints_that_clips_share_where_frames_are_as_many():
    """Of a square all that fits is taken; of weights that fit as both, those for each frame of each clip."""
    points = torch.zeros(8, 17, 17, 3)
    module = modules.PostureEnergy(MAN)
    assert weighs_joints(torch.ones(17, 17), points, module)
    assert weighs_joints(torch.ones(17, 17), points[:1], module)
    assert not weighs_joints(torch.ones(8, 17), points, module)
    assert not weighs_joints(torch.ones(17, 17), torch.zeros(17, 17, 17, 3), module)
