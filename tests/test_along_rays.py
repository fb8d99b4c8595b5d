"""Bodies whose bones change their signs of depth along rays."""

import pytest
import torch
from torch.testing import assert_close

from kcs_torch.data import random_motion, walking_person
from kcs_torch.functional import bone_lengths, bone_vectors
from kcs_torch.methods.perspective.along_rays import AlongRays
from kcs_torch.methods.perspective.pinhole import NEAREST
from kcs_torch.methods.pkc.flips import flipped_runs, signs_of
from kcs_torch.methods.pkc.objective import Objective
from kcs_torch.methods.pkc.run_costs import ParallelRays, RunCosts
from kcs_torch.methods.pkc.weights import Weights
from kcs_torch.skeleton import SKELETONS

BODIES = ["h36m17", "coco17", "hand21", "ap10k"]


def seen(name, distance, frames=12):
    """A body at a distance, in units of its template, and its true points (T, N, 3)."""
    body = SKELETONS[name]
    make = torch.Generator().manual_seed(2)
    person = "coco17" in name or "h36m" in name
    clip = walking_person(frames, skeleton=name) if person else random_motion(body, frames, generator=make)
    points = clip.points - clip.points.mean(1, keepdim=True)
    rest = Objective(body, points[..., :2], Weights(), torch.zeros_like(points[..., 0])).posture.rest_lengths
    points = points * (rest / bone_lengths(points, body.bone_index()).median(0).values).median()
    far = torch.full((frames,), distance).double()
    rays = points[..., :2] / (far[:, None] + points[..., 2])[..., None]
    rays, _ = body.complete(rays[:, : body.num_observed])
    image = rays * (far[:, None] + points[..., 2])[..., None]
    image, _ = body.complete(image[:, : body.num_observed])
    image = image - image.mean(1, keepdim=True)
    objective = Objective(body, image, Weights(), torch.zeros_like(points[..., 0]))
    return AlongRays(objective, rays, far, points[..., 2]), objective, points


def placed(along, depth, points):
    """Observed joints (K, T, No, 3) of centred depths (K, T, N): the trunk's first joint is where it was."""
    root, n = int(along.objective.posture.trunk[0]), along.objective.skeleton.num_observed
    far = along.far[:, root] + (depth - depth[..., root, None]).movedim(-1, 0)
    return (along.rays * far.movedim(0, -1)[..., None])[..., :n, :]


@pytest.mark.parametrize("name", BODIES)
def test_without_other_signs_it_is_the_body(name):
    along, objective, points = seen(name, 3.0)
    depth, image, *_ = along.turned(torch.ones(2, 1, objective.skeleton.num_bones).double())
    assert_close(depth, (points[..., 2] - points[..., 2].mean(1, keepdim=True)).expand(2, -1, -1), rtol=0, atol=1e-8)
    assert_close(image, objective.image.expand(2, -1, -1, -1), rtol=0, atol=1e-8)


@pytest.mark.parametrize("name", ["h36m17", "hand21"])
@pytest.mark.parametrize("seed", [0, 1])
def test_bones_keep_their_lengths_and_joints_their_rays(name, seed):
    along, objective, points = seen(name, 2.5)
    body = objective.skeleton
    signs = torch.randint(2, (5, 12, body.num_bones), generator=torch.Generator().manual_seed(seed)).double() * 2 - 1
    depth, image, *_ = along.turned(signs)
    found = placed(along, depth, points)
    old, new = (bone_lengths(x, body.bone_index()) for x in (along.rays * along.far[..., None], found))
    kept = (new - old).abs() < 1e-7
    short = new > old  # rays that a bone no longer reaches
    assert bool((kept | short).all()) and kept.double().mean() > 0.7
    flat = found[..., :2] - found[..., :2].mean(-2, keepdim=True)
    assert_close(image, flat)
    again = AlongRays(objective, along.rays[..., :2], along.far[:, 0] * 0 + 2.5, found[0, ..., 2] - 2.5)
    whole = kept[0].all(-1)
    assert whole.any() and bool(((again.own * along.own * signs[0])[whole] > -1e-9).all())


def test_before_a_far_camera_signs_turn_as_under_parallel_rays():
    along, objective, _ = seen("h36m17", 1e5)
    signs = torch.ones(3, 1, 16).double()
    signs[0, :, 2] = signs[1, :, [1, 2]] = signs[2] = -1
    turned, parallel = along.turned(signs), ParallelRays(objective, along.own).turned(signs)
    assert_close(turned.depth, parallel.depth, rtol=0, atol=2e-3)
    costs = [one.foreshortened(objective, along.lengths[0]) for one in (turned, parallel)]
    assert_close(*costs, rtol=0, atol=0.02)


def test_a_near_camera_sees_another_length_where_a_depth_is_only_turned_over():
    along, objective, points = seen("h36m17", 2.5)
    shin = objective.skeleton.bone_names.index("right_knee-right_ankle")
    signs = torch.ones(1, 1, 16).double()
    signs[..., shin] = -1
    bones = objective.skeleton.bone_index()[shin : shin + 1]
    own = points[..., bones[0, 1], 2] - points[..., bones[0, 0], 2]
    only = along.far.clone()
    only[:, bones[0, 1]] -= 2 * own
    naive, exact = along.rays * only[..., None], placed(along, along.turned(signs).depth, points)[0]
    off = [(bone_lengths(x, bones)[:, 0] / along.lengths[:, shin] - 1).abs() for x in (naive, exact)]
    deep = own.abs() > 0.15
    assert off[0][deep].max() > 0.02 and off[1][deep].max() < 1e-9
    assert bool(((exact[..., bones[0, 1], 2] - exact[..., bones[0, 0], 2]) * own < 0)[deep].all())


def test_a_ray_out_of_reach_is_met_where_it_is_nearest_and_before_the_camera():
    along, objective, points = seen("h36m17", 3.0)
    signs = torch.ones(1, 1, 16).double()
    along.lengths = 0 * along.lengths
    short = placed(along, along.turned(signs).depth, points)
    assert torch.isfinite(short).all()
    near, far = objective.skeleton.bones[0]
    across = ((short[0, :, far] - short[0, :, near]) * along.rays[:, far]).sum(-1)
    assert_close(across, torch.zeros_like(across), rtol=0, atol=1e-9)
    along.lengths = along.lengths + 100
    behind = placed(along, along.turned(signs).depth, points)
    assert bool((behind[..., 2] > 0.99 * NEAREST * 3.0).all())


@pytest.mark.parametrize("noise", [0.0, 0.01])
def test_runs_cost_what_the_objective_says_of_their_own_images(noise):
    along, objective, _ = seen("h36m17", 3.0, 40)
    objective = Objective(objective.skeleton, objective.image, Weights(), torch.full((40, 17), noise).double())
    along.objective = objective
    member = torch.eye(16).double()
    runs = flipped_runs(along.own, member, objective.weights.acceleration)
    lengths = along.lengths.median(0).values
    signs = torch.cat([torch.ones(1, 40, 16).double(), signs_of(runs, member, 40)])
    depth, image, *_ = along.turned(signs)
    size = lengths.expand(len(depth), -1)
    terms = objective.terms(depth, size, image)
    far = depth - depth[..., :1] + along.far[:, :1]  # the trunk's first joint is where it was
    deep = bone_vectors(along.rays * far[..., None], objective.bones)
    deep = (deep * along.rays[:, objective.bones[:, 1]]).sum(-1)
    each = objective.foreshortening.each(deep, size, objective.clear, objective.noise)
    near = 2 * objective.independent * (far[..., objective.bones[:, 1]] / along.far.mean()).log()
    terms["foreshortening"] = (each - near).sum((1, 2))
    expected, costs = torch.stack(list(terms.values())).sum(0), RunCosts(objective, along, lengths)
    assert len(runs.part) > 8
    assert_close(costs(member, runs), expected[1:], rtol=1e-9, atol=1e-8)
    assert_close(costs.unchanged, expected[:1], rtol=1e-9, atol=1e-8)


def test_pieces_of_a_skeleton_are_all_laid():
    along, objective, _ = seen("h36m17", 3.0)
    bones = [link.bone for link in along.links]
    assert sorted(bones) == list(range(16))
    laid = {int(objective.posture.trunk[0])}
    for _, near, far, _ in along.links:
        assert near in laid and far not in laid
        laid.add(far)
