"""The critic of KCS matrices: what it sees and what not, its parts, gaps, slopes, and the game it plays."""

import pytest
import torch
from numerics import BODY, CHAIN, RING, finite, gradcheck, normal, rotations
from torch.testing import assert_close

from kcs_torch.data import walking_person
from kcs_torch.errors import OptionError, ShapeError
from kcs_torch.functional import bone_vectors, kcs_matrix
from kcs_torch.nn import KCSCritic, critic_loss, generator_loss
from kcs_torch.skeleton import SKELETONS, Skeleton
from kcs_torch.skeleton.graph import find_parts

WALK = walking_person(40, turn=90.0).points / 1000
MAN = SKELETONS["h36m17"]


def critic(body=BODY, seed=0, **options):
    with torch.random.fork_rng():
        torch.manual_seed(seed)
        return KCSCritic(body, **options).double()


# ---------------------------------------------------------------------- parts


@pytest.mark.parametrize("name", sorted(SKELETONS))
def test_parts_of_every_skeleton_are_alike_on_both_sides(name):
    body = SKELETONS[name]
    parts = find_parts(body.num_joints, body.bones)
    assert sorted(b for part in parts for b in part) == list(range(body.num_bones))  # each bone in one
    assert 5 <= len(parts) <= 16
    twin = dict(body.mirror_bones) | {b: a for a, b in body.mirror_bones}
    sets = {frozenset(part) for part in parts}
    assert {frozenset(twin.get(b, b) for b in part) for part in parts} == sets
    assert critic(body)(normal(2, body.num_joints, 3)).shape == (2,)


def test_parts_of_a_person_a_hand_a_robot_and_a_chain():
    parts = [{MAN.bone_names[b] for b in part} for part in find_parts(17, MAN.bones)]
    assert {"thorax-left_shoulder", "left_shoulder-left_elbow", "left_elbow-left_wrist"} in parts
    assert {"pelvis-spine", "spine-thorax"} in parts and {"thorax-neck", "neck-head"} in parts
    assert [len(p) for p in find_parts(21, SKELETONS["hand21"].bones)] == [4] * 5
    robot = Skeleton.from_edges([(0, 1), (1, 2), (2, 3), (3, 4), (3, 5)], 6)  # an arm with a gripper of two fingers
    assert find_parts(6, robot.bones) == [[0, 1, 2], [3], [4]]
    assert find_parts(4, CHAIN.bones) == [[0, 1, 2]]
    assert find_parts(4, RING.bones) == [[0, 1, 2, 3]]
    assert find_parts(3, []) == []
    for body, heads in ((CHAIN, 1), (RING, 1), (robot, 4), (BODY, 7)):
        assert len(critic(body).parts) == heads


def test_a_link_between_the_hands_joins_the_arms():
    held = MAN.with_links([("left_wrist", "right_wrist")])
    parts = find_parts(held.num_joints, held.bones)
    assert [len(p) for p in parts] == [3, 3, 2, 2, 7]


def test_parts_by_name_and_number():
    given = critic(parts=[["hip-neck", "neck-head"], [2, 3]], combined=False)
    assert given.parts == ((0, 1, 2, 3, 4, 5), (0, 1), (2, 3)) and given(normal(2, 7, 3)).shape == (2, 3)
    assert critic(parts=None, combined=False)(normal(2, 7, 3)).shape == (2, 1)


# ---------------------------------------------------------------------- scores


def test_features_are_entries_of_the_normalised_matrix():
    points, one = normal(3, 7, 3), critic()
    psi = kcs_matrix(bone_vectors(points, BODY.bone_index()))
    psi = psi / psi.diagonal(dim1=-2, dim2=-1).mean(-1)[:, None, None]
    upper = torch.triu_indices(6, 6)
    assert_close(one.features(points)[:, :21], psi[:, upper[0], upper[1]])
    assert one.features(points).shape[-1] == sum(one.sizes) == 21 + 5 * 1 + 1


def test_scores_do_not_see_turn_place_size_or_mirror():
    points, one = normal(5, 7, 3), critic()
    moved = 3.0 * points @ rotations(5) * torch.tensor([1.0, 1.0, -1.0]) + normal(5, 1, 3, seed=1)
    assert_close(one(moved), one(points))
    stretched = points.clone()
    stretched[:, 3] *= 1.5
    assert (one(stretched) - one(points)).abs().min() > 1e-4


def test_a_part_sees_its_own_bones_and_the_size_of_the_body():
    one, points = critic(MAN, combined=False), WALK[:3].clone()
    names = [{MAN.bone_names[b] for b in part} for part in one.parts]
    arm = next(k for k, part in enumerate(names) if "left_elbow-left_wrist" in part and len(part) == 3)
    before = one(points)
    elbow, wrist = MAN.index("left_elbow"), MAN.index("left_wrist")
    points[:, wrist] = points[:, elbow] + (points[:, wrist] - points[:, elbow]) @ rotations()  # as long as it was
    changed = ((one(points) - before).abs() > 1e-9).all(0)
    assert changed.tolist() == [k in (0, arm) for k in range(7)]
    assert_close(critic(MAN)(points), critic(MAN, combined=False)(points).mean(-1))


def test_gradients_in_points_weights_and_parameters():
    one, points = critic(), normal(2, 7, 3)
    weights = torch.rand(2, 7, generator=torch.Generator().manual_seed(0)).double() + 0.1
    assert gradcheck(one, points, weights, fast=True)
    for still in (torch.zeros(2, 7, 3).double(), normal(1, 3).expand(2, 7, 3)):
        finite(one, still)
        assert gradcheck(lambda x, s=still: one(s) * x, torch.ones(2).double())
    one(points).sum().backward()
    assert all(p.grad is not None and torch.isfinite(p.grad).all() for p in one.parameters())


def test_what_weighs_nothing_may_be_nan():
    one, points = critic(MAN, combined=False), WALK[:4]
    weights = torch.ones(4, 17).double()
    for joint in ("left_elbow", "left_wrist", "left_shoulder"):
        weights[:, MAN.index(joint)] = 0
    weights[2] = 0
    gone = torch.where(weights[..., None] > 0, points, torch.nan).requires_grad_()
    value = one(gone, weights)
    assert_close(value, one(torch.where(weights[..., None] > 0, points, 9.0), weights))
    (grad,) = torch.autograd.grad(value.sum(), gone)
    assert torch.isfinite(grad).all() and not grad[weights == 0].any() and grad.any()
    names = [{MAN.bone_names[b] for b in part} for part in one.parts]
    arm = next(k for k, part in enumerate(names) if "left_elbow-left_wrist" in part and len(part) == 3)
    assert not value[:, arm].any() and not value[2].any() and (value[0] != 0).sum() == 6
    assert_close(critic(MAN)(gone, weights)[0], value[0].sum() / 6)  # what is not seen does not count
    assert_close(one(points, torch.ones(4, 17).double()), one(points))


def test_batches_and_precision():
    one, points = critic(), normal(2, 3, 7, 3)
    assert_close(one(points)[1, 2], one(points[1, 2]))
    single = KCSCritic(BODY)
    assert single(points).dtype == torch.float32  # the parameters'
    assert torch.isfinite(single((500 * points).half())).all()


# ---------------------------------------------------------------------- slopes


def test_gradient_penalty_is_that_of_finite_differences():
    one, real, fake = critic(), normal(3, 7, 3), normal(3, 7, 3, seed=1)
    draw = lambda: torch.Generator().manual_seed(5)  # noqa: E731
    value = one.gradient_penalty(real, fake, generator=draw())
    mix = torch.rand(3, generator=draw(), dtype=torch.float64)[:, None]
    at = (mix * one.features(real) + (1 - mix) * one.features(fake)).detach()
    step = 1e-6
    slopes = torch.stack(
        [
            (one.scores(at + step * e) - one.scores(at - step * e)) / (2 * step) * len(one.parts)
            for e in torch.eye(at.shape[-1]).double()
        ],
        -1,
    )
    expected = torch.stack([(s.norm(dim=-1) - 1).square() for s in slopes.split(one.sizes, -1)], -1).mean(-1)
    assert_close(value, expected, rtol=1e-5, atol=1e-7)
    assert torch.equal(one.gradient_penalty(real, fake, generator=draw()), value)


def test_gradient_penalty_trains_the_critic():
    one, real, fake = critic(), normal(20, 7, 3), normal(20, 7, 3, seed=1)
    optimiser = torch.optim.Adam(one.parameters(), 1e-2)
    draw = torch.Generator().manual_seed(0)
    first = one.gradient_penalty(real, fake, generator=draw).mean().item()
    for _ in range(60):
        optimiser.zero_grad()
        one.gradient_penalty(real, fake, generator=draw).mean().backward()
        optimiser.step()
    assert one.gradient_penalty(real, fake, generator=draw).mean() < 0.2 * first


@pytest.mark.parametrize("context", [torch.no_grad, torch.inference_mode])
def test_gradient_penalty_in_a_validation_step(context):
    one, real, fake = critic(), normal(3, 7, 3), normal(3, 7, 3, seed=1)
    draw = lambda: torch.Generator().manual_seed(5)  # noqa: E731
    expected = one.gradient_penalty(real, fake, generator=draw())
    with context():
        value = one.gradient_penalty(real + 0, fake + 0, generator=draw())
    assert torch.equal(value, expected.detach()) and not value.requires_grad


def test_gradient_penalty_beside_gaps():
    one, real = critic(), normal(3, 7, 3)
    weights = torch.ones(3, 7).double()
    weights[0] = 0
    weights[1, 4] = 0
    gone = torch.where(weights[..., None] > 0, real, torch.nan)
    value = one.gradient_penalty(gone, gone, weights)
    assert torch.isfinite(value).all() and value[0] == 0 and value[1:].all()
    value.sum().backward()
    assert all(torch.isfinite(p.grad).all() for p in one.parameters() if p.grad is not None)  # slopes have no bias
    with pytest.raises(ShapeError, match="as many poses of both kinds"):
        one.gradient_penalty(real, real[:2])


def test_spectral_norm_bounds_the_slope():
    one = critic(MAN, spectral=True, combined=False)
    with torch.no_grad():
        for _ in range(200):  # each call in training is one step of the power iteration
            one(WALK[:1])
    points = WALK[:10]
    features = one.features(points).requires_grad_()
    (slope,) = torch.autograd.grad(one.scores(features).sum(), features)
    for block in slope.split(one.sizes, -1):
        assert block.norm(dim=-1).max() < 1.001
    assert any("original" in name for name in one.state_dict())


# ---------------------------------------------------------------------- the game


def test_losses_by_hand():
    real, fake = torch.tensor([1.0, 0.5, -2.0]), torch.tensor([0.0, 2.0, -3.0])
    assert critic_loss(real, fake).tolist() == [0.0, 2.125, 9.0]
    assert critic_loss(real, fake, game="wasserstein").tolist() == [-1.0, 1.5, -1.0]
    assert critic_loss(real, fake, game="hinge").tolist() == [1.0, 3.5, 3.0]
    assert generator_loss(fake).tolist() == [0.5, 0.5, 8.0]
    assert generator_loss(fake, game="wasserstein").tolist() == generator_loss(fake, game="hinge").tolist()
    assert generator_loss(fake, game="hinge").tolist() == [0.0, -2.0, 3.0]
    for run in (lambda: critic_loss(real, fake, game="chess"), lambda: generator_loss(fake, game="chess")):
        with pytest.raises(OptionError, match="choices are hinge, least_squares, wasserstein"):
            run()


@pytest.mark.parametrize("game", ["least_squares", "wasserstein", "hinge"])
def test_the_critic_tells_bodies_from_others_and_a_pose_learns_from_it(game):
    one = critic(MAN, spectral=game == "hinge")
    optimiser = torch.optim.Adam(one.parameters(), 2e-3)
    draw = torch.Generator().manual_seed(0)
    others = WALK + 0.12 * normal(40, 17, 3, seed=2)
    for _ in range(100):
        optimiser.zero_grad()
        loss = critic_loss(one(WALK), one(others), game=game).mean()
        if game == "wasserstein":
            loss = loss + 10 * one.gradient_penalty(WALK, others, generator=draw).mean()
        loss.backward()
        optimiser.step()
    with torch.no_grad():
        assert (one(WALK).min() > one(others).max()) or (one(WALK).mean() > one(others).mean() + 2 * one(WALK).std())
    bent = others[:10].clone().requires_grad_()
    optimiser = torch.optim.Adam([bent], 3e-3)
    before = generator_loss(one(bent), game=game).mean().item()
    for _ in range(30):
        optimiser.zero_grad()
        generator_loss(one(bent), game=game).mean().backward()
        optimiser.step()
    assert generator_loss(one(bent), game=game).mean() < before


def test_state_is_the_networks_only():
    one, other = critic(seed=0), critic(seed=1)
    points = normal(4, 7, 3)
    assert not torch.allclose(one(points), other(points))
    other.load_state_dict(one.state_dict())
    assert torch.equal(one(points), other(points))
    assert all(name.startswith("networks.") for name in one.state_dict())
    assert "skeleton='body7', parts=7, combined=True" in repr(one)


def test_what_does_not_fit_is_said():
    for options, words in (
        ({"width": 0}, "width and num_layers >= 1"),
        ({"num_layers": 0}, "width and num_layers >= 1"),
        ({"width": 2.5}, "width and num_layers >= 1, got 2.5"),
        ({"parts": 3}, "lists of bones"),
        ({"parts": [3]}, "lists of bones"),
        ({"parts": [[0.5]]}, r"bone indices 0\.\.5, got 0.5"),  # it was bone 0
        ({"parts": "arms"}, "expected 'limbs'"),
        ({"parts": []}, "lists of bones"),
        ({"parts": ["hip-neck"]}, "lists of bones"),
        ({"parts": [[]]}, "lists of bones"),
        ({"parts": [[6]]}, r"bone indices 0\.\.5, got 6"),
        ({"parts": [["hip-nekc"]]}, "did you mean 'hip-neck'"),
    ):
        with pytest.raises(OptionError, match=words):
            KCSCritic(BODY, **options)
    with pytest.raises(OptionError, match="expected a skeleton with bones"):
        KCSCritic(Skeleton.from_edges([], 2, tree=False))
    with pytest.raises(ShapeError, match=r"critic_loss: expected scores of one shape, got \(2, 8\) and \(16,\)"):
        critic_loss(normal(2, 8), normal(16))
    with pytest.raises(ShapeError, match="skeleton 'body7'"):
        critic()(normal(6, 3))
    with pytest.raises(ShapeError, match=r"expected weights \(2, 7\)"):
        critic()(normal(2, 7, 3), torch.ones(3, 7))
