"""Energy of posture: the closed form, invariances, gradients at the edges."""

import math
from dataclasses import replace

import pytest
import scipy.stats
import torch
from numerics import BODY, CHAIN, FLOATS, finite, gradcheck, normal, rotations, same_as_loop
from torch.testing import assert_close

from kcs_torch.data import walking_person
from kcs_torch.errors import OptionError, ShapeError, SkeletonError
from kcs_torch.functional import bone_lengths
from kcs_torch.nn import PostureEnergy
from kcs_torch.nn.posture import has_trunk, trunk_joints
from kcs_torch.skeleton import SKELETONS

MAN = SKELETONS["h36m17"]
BONES = MAN.bone_index()
POSTURE = PostureEnergy(MAN)
REST = POSTURE.rest
WALK = walking_person(40, turn=0.0).points / 1000
FLIP = torch.tensor([1.0, 1.0, -1.0]).double()


def degenerate(kind):
    """Points (T, 17, 3) of clips that make trouble."""

    def shrink(joint, to):
        points = WALK[:6].clone()
        points[:, joint] = points[:, to]
        return points

    return {
        "walk": lambda: WALK[:6],
        "one frame": lambda: WALK[:1],
        "two frames": lambda: WALK[:2],
        "static": lambda: WALK[:1].expand(6, 17, 3),
        "flat": lambda: WALK[:6] * torch.tensor([1.0, 1.0, 0.0]),
        "straight limbs": lambda: REST.expand(6, 17, 3),
        "zero-length bone": lambda: shrink(5, 4),
        "trunk on a line": lambda: WALK[:6] * torch.tensor([0.0, 1.0, 0.0]),
        "one point": lambda: torch.zeros(6, 17, 3).double(),
    }[kind]().clone()


KINDS = ["walk", "one frame", "two frames", "static", "flat", "straight limbs", "zero-length bone", "trunk on a line",
         "one point"]  # fmt: skip
SOUND = KINDS[:6]


# ---------------------------------------------------------------------- the trunk


def test_trunk_joints_hang_together_and_hold_both_sides():
    for body in SKELETONS.values():
        trunk = trunk_joints(body)
        assert len(trunk) >= 3, body.name
        inside = [b for a, b in body.bones if a in trunk and b in trunk]
        assert len(inside) == len(trunk) - 1, body.name  # one piece
        for left, right in body.mirror:
            assert (left in trunk) == (right in trunk), body.name
    assert trunk_joints(CHAIN) == [] and not has_trunk(CHAIN) and has_trunk(MAN)
    assert {MAN.joints[i] for i in trunk_joints(MAN)} >= {"pelvis", "left_hip", "right_hip", "thorax"}


def test_frame_of_the_template_in_any_turn():
    turn = rotations(7, seed=2)
    found = POSTURE.frame(2.5 * REST @ turn.mT + normal(7, 1, 3, seed=1))
    assert_close(found, turn, rtol=0, atol=1e-8)


def test_frame_is_of_each_frame_by_itself():
    """Whatever the others are, and in half precision as in single, also of a body that is small there."""
    energy = PostureEnergy("h36m17")
    points = walking_person(6, dtype=torch.float32).points
    found = energy.frame(points)
    wrong = points.clone()
    wrong[2] = math.nan
    keep = [0, 1, 3, 4, 5]
    assert torch.equal(energy.frame(wrong)[keep], found[keep])
    half = energy.frame((points / 2e4).half())
    assert half.dtype == torch.float16 and float((half.float() - found).abs().max()) < 0.02


def test_frame_turns_with_the_body():
    turn = rotations(40, seed=3)
    frame = POSTURE.frame(WALK)
    assert_close(POSTURE.frame(WALK @ turn.mT), turn @ frame)
    assert_close(frame.mT @ frame, torch.eye(3).double().expand(40, 3, 3), rtol=0, atol=1e-9)
    assert_close(torch.linalg.det(frame), torch.ones(40).double())


# ---------------------------------------------------------------------- posture


def test_posture_does_not_see_turn_place_or_size():
    turn = rotations(40, seed=5)
    moved = 3.7 * WALK @ turn.mT + normal(40, 1, 3)
    assert_close(POSTURE(moved), POSTURE(WALK))
    lengths = bone_lengths(WALK, BONES).mean(0)
    assert_close(POSTURE(moved, 3.7 * lengths), POSTURE(WALK, lengths))


def test_mirror_image_of_the_body_is_as_usual_that_of_the_depth_is_not():
    swap = list(range(17))
    for a, b in MAN.mirror:
        swap[a], swap[b] = b, a
    sideways = WALK[:, swap] * torch.tensor([-1.0, 1.0, 1.0])
    assert_close(POSTURE(sideways), POSTURE(WALK))
    assert POSTURE(WALK * FLIP) > 1.5 * POSTURE(WALK)  # someone who faces away and bends knees and elbows forward
    assert POSTURE(normal(40, 17, 3)) > 5 * POSTURE(WALK)


def mirrored(y, body):
    """Directions (T, B, 3) of the body's mirror image."""
    twin = torch.arange(body.num_bones)
    for a, b in body.mirror_bones:
        twin[a], twin[b] = b, a
    return y[:, twin] * torch.tensor([-1.0, 1.0, 1.0])


@pytest.mark.parametrize("name", ["h36m17", "coco17", "body25", "ap10k"])
def test_symmetric_is_the_scatter_of_a_clip_and_its_mirror_image(name):
    """Of many frames, whose mean is then known: half the scatter of both is what the log-determinant is taken of."""
    body = SKELETONS[name]
    energy = PostureEnergy(body, kappa=1e9)
    points = energy.rest + 0.03 * normal(50, len(energy.rest), 3)
    y = (energy.directions(points) - energy.mean) / energy.deviation
    flip = mirrored(energy.directions(points), body)
    both = torch.stack([y, (flip - energy.mean) / energy.deviation]).flatten(-2)
    scatter = (both.mT @ both).mean(0) / energy.correlation
    count = 50 / energy.correlation
    expected = (count + energy.strength) / 2 * torch.logdet(torch.eye(len(scatter)) + scatter / energy.strength)
    assert_close(energy(points), expected, rtol=1e-5, atol=0)
    assert not torch.isclose(PostureEnergy(body, kappa=1e9, symmetric=False)(points), expected, rtol=1e-2)


def test_halves_are_those_of_bodies_whose_bones_all_have_mirror_images():
    assert POSTURE.halves.shape == (2, 6 * 3 + 4 * 2, 48)
    rows = POSTURE.halves.flatten(0, 1)
    assert_close(rows.mT @ rows, torch.eye(48).double())
    seen = normal(5, 16, 3)
    shared, apart = (seen.flatten(-2) @ half.mT for half in POSTURE.halves)
    flip = mirrored(seen, MAN).flatten(-2)
    assert_close(flip @ POSTURE.halves[0].mT, shared)
    assert_close(flip @ POSTURE.halves[1].mT, -apart)
    crooked = replace(MAN, mirror=tuple(pair for pair in MAN.mirror if "knee" not in MAN.joints[pair[0]]))
    for body in ("hand21", crooked, replace(MAN, mirror=())):
        (whole,) = PostureEnergy(body).halves
        assert_close(whole, torch.eye(len(whole)).double())
    (whole,) = PostureEnergy(MAN, symmetric=False).halves
    assert_close(whole, torch.eye(48).double())


def test_directions_are_unit_vectors_seen_from_the_trunk():
    seen = POSTURE.directions(WALK, bone_lengths(WALK, BONES).mean(0))
    assert_close(seen.norm(dim=-1), torch.ones(40, 16).double(), rtol=0, atol=1e-6)
    rest = POSTURE.directions(REST[None])[0]
    usual = (rest * POSTURE.mean).sum(-1)
    assert (usual > 0.85).all()  # the mean directions are those of the template, but for the hinges' bends


@pytest.mark.parametrize("symmetric", [True, False])
def test_marginal_likelihood_is_that_of_a_chain_of_t_densities(symmetric):
    """Energies of two clips differ as the log densities of their frames, each given all before it, do."""
    strength, kappa = 80.0, 2.5
    lengths = bone_lengths(WALK, BONES).mean(0)
    energy = PostureEnergy(MAN, strength=strength, kappa=kappa, correlation=1.0, symmetric=symmetric)

    def log_density(points):
        y = ((energy.directions(points, lengths) - energy.mean) / energy.deviation).flatten(-2)
        return sum(chain(y @ half[half.any(-1)].mT) for half in energy.halves)

    def chain(y):
        size = y.shape[1]
        mean, scale, total = torch.zeros(size).double(), strength * torch.eye(size).double(), 0.0
        k, n = kappa, strength
        for row in y:
            free = n - size + 1
            shape = scale * (k + 1) / (k * free)
            total += scipy.stats.multivariate_t.logpdf(row.numpy(), mean.numpy(), shape.numpy(), df=free)
            off = row - mean
            scale = scale + k / (k + 1) * off[:, None] * off
            mean, k, n = mean + off / (k + 1), k + 1, n + 1
        return total

    first, second = WALK[:12], WALK[:12] + 0.05 * normal(12, 17, 3)
    difference = log_density(first) - log_density(second)
    assert (energy(second, lengths) - energy(first, lengths)).item() == pytest.approx(difference, rel=1e-6)


@pytest.mark.parametrize("given", [False, True])
@pytest.mark.parametrize("kind", SOUND)
def test_posture_gradient(kind, given):
    points = degenerate(kind)
    if given:
        assert gradcheck(POSTURE, points, POSTURE.rest_lengths * 1.1, fast=True)
    else:
        assert gradcheck(POSTURE, points, fast=True)


@pytest.mark.parametrize("dtype", FLOATS)
@pytest.mark.parametrize("kind", KINDS)
def test_posture_is_finite(kind, dtype):
    points = degenerate(kind).to(dtype)
    assert POSTURE(points).dtype == dtype
    finite(POSTURE, points)
    finite(POSTURE, points, POSTURE.rest_lengths.to(dtype))


def test_posture_in_batches_and_half_precision():
    same_as_loop(POSTURE, (4, 17, 3))
    same_as_loop(lambda p, n: POSTURE(p, n.abs() + 0.5), (4, 17, 3), (16,))
    assert_close(POSTURE(WALK.bfloat16()).double(), POSTURE(WALK), rtol=0.1, atol=0)


@pytest.mark.parametrize("name", ["right_hip-right_knee", "spine-thorax"])
def test_a_bone_of_length_zero_says_nothing(name):
    """Of a network that begins at zero, or a body part that has never been seen."""
    lengths = bone_lengths(WALK[:6], BONES).mean(0)
    lengths[MAN.bone_names.index(name)] = 0
    finite(POSTURE, WALK[:6], lengths)
    assert gradcheck(lambda x: POSTURE(x, lengths), WALK[:6])
    finite(POSTURE, WALK[:6], torch.zeros(16).double())


@pytest.mark.parametrize("given", [False, True])
def test_frames_of_no_weight_may_be_anything(given):
    """They pad a shorter clip."""
    lengths = bone_lengths(WALK[:6], BONES).mean(0) if given else None
    padded = torch.cat([WALK[:6], torch.full((3, 17, 3), math.nan).double()]).requires_grad_()
    weights = torch.tensor([1.0] * 6 + [0.0] * 3).double()
    value = POSTURE(padded, lengths, weights)
    assert_close(value, POSTURE(WALK[:6], lengths))
    assert_close(value, POSTURE(padded, lengths, independent=weights / POSTURE.correlation))
    (grad,) = torch.autograd.grad(value, padded)
    assert torch.isfinite(grad).all() and not grad[6:].any() and grad[:6].any()
    assert POSTURE(padded, lengths, 0 * weights).item() == 0
    with pytest.raises(OptionError, match="expected weights or independent, got both"):
        POSTURE(padded, lengths, weights, independent=weights)


@pytest.mark.parametrize("weights", [torch.ones(6), torch.ones(6, 17)])
def test_weights_of_one_change_nothing(weights):
    assert_close(POSTURE(WALK[:6], None, weights.double()), POSTURE(WALK[:6]))


@pytest.mark.parametrize("name", ["coco17", "hand21", "ap10k", "mediapipe33"])
@pytest.mark.parametrize("dtype", FLOATS)
def test_joints_that_always_coincide_are_drawn_apart_with_no_great_force(name, dtype):
    """As of a network that begins at zero, and of joints that are never seen: a first step must not be the last."""
    body = SKELETONS[name]
    energy, a, b = PostureEnergy(body), *body.bones[-1]
    points = normal(12, body.num_joints, 3, seed=5).to(dtype)
    usual = torch.autograd.functional.jacobian(energy, points).abs().max()
    for far in (0.0, 1e-9, 1e-4):
        points[:, b] = points[:, a] + far
        assert torch.autograd.functional.jacobian(energy, points).abs().max() < 100 * usual
    assert not torch.autograd.functional.jacobian(energy, 0 * points).any()


def test_lengths_that_are_nan_are_not_hidden():
    """A network's that has diverged, say."""
    lengths = bone_lengths(WALK[:6], BONES).mean(0)
    lengths[3] = math.nan
    assert POSTURE(WALK[:6], lengths).isnan()


def test_no_frames_cost_nothing():
    for weights in (None, torch.ones(2, 0).double(), torch.ones(2, 0, 17).double()):
        assert POSTURE(torch.zeros(2, 0, 17, 3).double(), None, weights).tolist() == [0.0, 0.0]


def test_points_in_other_units_than_lengths_are_finite_in_single_precision():
    """Millimetres against metres: rounding alone would leave scatters without a Cholesky factor."""
    points = 1000 * normal(8, 30, 17, 3, seed=3).float()
    finite(POSTURE, points, POSTURE.rest_lengths.float())
    usual = WALK.float()
    assert POSTURE(usual).item() == pytest.approx(POSTURE(WALK).item(), rel=1e-3)


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16])
def test_half_precision_in_millimetres(dtype):
    points = (1000 * WALK[:6]).to(dtype)
    lengths = bone_lengths(points, BONES).mean(0)
    finite(POSTURE, points, lengths)
    exact = POSTURE(points.double(), lengths.double())
    assert_close(POSTURE(points, lengths).double(), exact, rtol=0.02, atol=0.02)


@pytest.mark.parametrize("name", ["coco17", "mediapipe33", "hand21", "ap10k"])
def test_posture_knows_every_template(name):
    body = SKELETONS[name]
    energy = PostureEnergy(body)
    rest = energy.rest.expand(8, -1, 3)
    order = torch.randperm(len(energy.rest), generator=torch.Generator().manual_seed(0))
    assert energy(rest) < 0.2 * energy(rest[:, order])


def test_posture_needs_a_trunk():
    for body in (CHAIN, BODY):
        with pytest.raises(SkeletonError, match="has no trunk"):
            PostureEnergy(body)
    for points in (WALK[0], WALK[:, :16], WALK[..., :2]):
        with pytest.raises(ShapeError, match="PostureEnergy"):
            POSTURE(points)
