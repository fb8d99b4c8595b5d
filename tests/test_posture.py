"""Energies of posture, lengths, foreshortening and contact: closed forms, invariances, gradients at the edges."""

import itertools
import math

import pytest
import scipy.integrate
import scipy.stats
import torch
from numerics import BODY, CHAIN, FLOATS, finite, gradcheck, normal, rotations, same_as_loop
from torch.testing import assert_close

from kcs_torch.data import walking_person
from kcs_torch.errors import ShapeError, SkeletonError
from kcs_torch.functional import bone_lengths, standing
from kcs_torch.nn import ContactEnergy, ForeshorteningEnergy, PostureEnergy, ProportionEnergy
from kcs_torch.nn.posture import foreshortening, free_bones, trunk_joints
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
    assert trunk_joints(CHAIN) == []
    assert {MAN.joints[i] for i in trunk_joints(MAN)} >= {"pelvis", "left_hip", "right_hip", "thorax"}


def test_limbs_are_free_and_the_trunk_is_not():
    free = dict(zip(MAN.bone_names, free_bones(MAN).tolist(), strict=True))
    trunk = trunk_joints(MAN)
    assert all(not free[name] for name, (a, b) in zip(MAN.bone_names, MAN.bones, strict=True) if {a, b} <= set(trunk))
    assert all(free[n] for n in free if n.endswith(("knee", "ankle", "elbow", "wrist")))
    assert free_bones(CHAIN).tolist() == [1, 1, 1]


def test_frame_of_the_template_in_any_turn():
    turn = rotations(7, seed=2)
    found = POSTURE.frame(2.5 * REST @ turn.mT + normal(7, 1, 3, seed=1))
    assert_close(found, turn, rtol=0, atol=1e-8)


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
    assert_close(POSTURE(sideways), POSTURE(WALK), rtol=0.02, atol=0)
    assert POSTURE(WALK * FLIP) > 1.5 * POSTURE(WALK)  # someone who faces away and bends knees and elbows forward
    assert POSTURE(normal(40, 17, 3)) > 5 * POSTURE(WALK)


def test_directions_are_unit_vectors_seen_from_the_trunk():
    seen = POSTURE.directions(WALK, bone_lengths(WALK, BONES).mean(0))
    assert_close(seen.norm(dim=-1), torch.ones(40, 16).double(), rtol=0, atol=1e-6)
    rest = POSTURE.directions(REST[None])[0]
    usual = (rest * POSTURE.mean).sum(-1)
    assert (usual > 0.85).all()  # the mean directions are those of the template, but for the hinges' bends


def test_marginal_likelihood_is_that_of_a_chain_of_t_densities():
    """Energies of two clips differ as the log densities of their frames, each given all before it, do."""
    strength, kappa = 80.0, 2.5
    lengths = bone_lengths(WALK, BONES).mean(0)
    energy = PostureEnergy(MAN, strength=strength, kappa=kappa, correlation=1.0)
    size = 3 * MAN.num_bones

    def log_density(points):
        y = ((energy.directions(points, lengths) - energy.mean) / energy.deviation).flatten(-2)
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
    weights = torch.tensor([1 / 15] * 6 + [0.0] * 3).double()
    value = POSTURE(padded, lengths, weights)
    assert_close(value, POSTURE(WALK[:6], lengths))
    (grad,) = torch.autograd.grad(value, padded)
    assert torch.isfinite(grad).all() and not grad[6:].any() and grad[:6].any()
    assert POSTURE(padded, lengths, 0 * weights).item() == 0


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


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16])
def test_half_precision_in_millimetres(dtype):
    points = (1000 * WALK[:6]).to(dtype)
    lengths = bone_lengths(points, BONES).mean(0)
    cases = {"posture": POSTURE, "foreshortening": ForeshorteningEnergy(MAN)}
    for name, energy in cases.items():
        finite(energy, points, lengths)
        exact = energy(points.double(), lengths.double())
        assert_close(energy(points, lengths).double(), exact, rtol=0.02, atol=0.02, msg=name)


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


# ---------------------------------------------------------------------- foreshortening


def test_foreshortening_is_a_density_of_images():
    """Over the disc of all images, exp(-energy) integrates to 2 pi: that of the half sphere."""
    for length in (0.3, 2.0):
        at = lambda r: math.exp(  # noqa: E731
            -foreshortening(torch.tensor(math.sqrt(length**2 - r**2)).double(), torch.tensor(length).double(), 0.0)  # noqa: B023
        )
        total = scipy.integrate.quad(lambda r: 2 * math.pi * r * at(r), 0, length)[0]  # noqa: B023
        assert total == pytest.approx(2 * math.pi, rel=1e-6)


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
    value = value + sum(((log[a] - log[b]) / 0.02) ** 2 for a, b in MAN.mirror_bones) / 2
    assert_close(ProportionEnergy(MAN, spread=0.05, twins=0.02)(lengths), value)


def test_odd_bones_are_borne_but_not_odd_twins():
    usual = MAN.relative_lengths(dtype=torch.float64)
    energy = ProportionEnergy(MAN)
    neck = usual.clone()
    neck[MAN.bone_names.index("spine-thorax")] *= 1.6
    assert energy(neck) < 20
    arm = usual.clone()
    arm[MAN.mirror_bones[0][0]] *= 1.6
    assert energy(arm) > 100


def test_proportion_gradient_batches_and_errors():
    energy = ProportionEnergy(MAN)
    assert gradcheck(energy, POSTURE.rest_lengths * (0.2 * normal(16)).exp())
    same_as_loop(lambda x: energy(x.exp()), (16,))
    finite(energy, torch.cat([torch.zeros(1), POSTURE.rest_lengths[1:].float()]))
    with pytest.raises(ShapeError, match="ProportionEnergy"):
        energy(torch.ones(15))
    with pytest.raises(SkeletonError, match="neither proportions nor a template"):
        ProportionEnergy(CHAIN)


# ---------------------------------------------------------------------- contact


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


def test_feet_of_a_walk_stand_by_turns():
    clip = walking_person(90, turn=0.0)
    feet = list(MAN.contacts)
    sure = standing(clip.tracks.points[:, feet], clip.tracks.weights[:, feet])
    moves = clip.points[:, feet].diff(dim=0).norm(dim=-1)
    moves = torch.cat([moves, moves[-1:]])
    assert moves[sure > 0.5].max() < 0.3 * moves.max()
    assert 0.25 < (sure > 0.5).double().mean() < 0.75
    assert ((sure > 0.5).any(-1)).double().mean() > 0.8  # one of the two nearly always does
