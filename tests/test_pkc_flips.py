"""Runs of signs: which there are, what they cost, and that wrong ones are found."""

import pytest
import torch
from numerics import count_operations, normal
from samples import walk_in_template_units as walk
from torch.testing import assert_close

from kcs_torch.functional import bone_vectors, standing
from kcs_torch.methods.clips.lockstep import run
from kcs_torch.methods.pkc import flips as module
from kcs_torch.methods.pkc.flips import flipped, flipped_runs, parts_of, signs_of, turned_over
from kcs_torch.methods.pkc.hypotheses import Hypotheses, combined
from kcs_torch.methods.pkc.limbs import limbs_of
from kcs_torch.methods.pkc.objective import Objective, usual_posture
from kcs_torch.methods.pkc.refinement import Task, minimise_all
from kcs_torch.methods.pkc.run_costs import ParallelRays, RunCosts, Runs
from kcs_torch.methods.pkc.weights import Weights
from kcs_torch.skeleton import SKELETONS

BODY = SKELETONS["h36m17"]
ACCELERATION = Weights().acceleration


def test_parts_of_a_body():
    weights = Objective(BODY, walk(5)[..., :2], Weights(), torch.zeros(5, 17).double()).posture
    limbs = limbs_of(BODY, weights.trunk.tolist())
    parts = parts_of(BODY, limbs)
    assert len(set(parts)) == len(parts) and all(parts)
    for limb in limbs:
        assert limb.bones in parts and all((b,) in parts for b in limb.bones)
    assert all(tuple(pair) in parts for pair in BODY.mirror_bones)
    outer = {b for limb in limbs for b in limb.bones}
    assert tuple(b for b in range(16) if b not in outer) in [tuple(sorted(part)) for part in parts]
    assert tuple(range(16)) in parts  # all of it: the mirror image, which no ray tells
    both = {tuple(sorted({*one.bones, *other.bones})) for one in limbs for other in limbs if twins(one, other)}
    assert len(both) == 2 and both <= set(parts)  # both arms, both legs


def twins(one, other):
    return set(zip(one.bones, other.bones, strict=False)) <= set(BODY.mirror_bones) and len(one.bones) == 2


def bones_of(frames=40, seed=0):
    """Depths (T, B) of bones that swing through the image plane."""
    time = torch.arange(frames).double()[:, None]
    phase, pace = normal(6, seed=seed), 0.1 + 0.1 * normal(6, seed=seed + 1).abs()
    return 0.3 * torch.sin(time * pace + 3 * phase)


def every_flip(depth, parts):
    """All flips of a solution's runs, as depths (K, T, B), and their parts."""
    member = module.members(parts, depth)
    runs = flipped_runs(depth, member, ACCELERATION)
    return depth * signs_of(runs, member, len(depth)), runs.part


PARTS = [(0,), (1,), (0, 1), (2, 3, 4), (5,)]


@pytest.mark.parametrize("seed", [0, 3, 5])
def test_flips_change_one_run_of_one_part(seed):
    depth = bones_of(seed=seed)
    found, which = every_flip(depth, PARTS)
    assert len(found) == len(which) > 5
    seen = set()
    for one, part in zip(found, which.tolist(), strict=True):
        assert_close(one.abs(), depth.abs())
        own = (one - depth).abs() > 1e-9
        assert set(own.any(0).nonzero().flatten().tolist()) <= set(PARTS[part])
        frames = own.any(1).nonzero().flatten()
        seen.add((part, int(frames[0]), int(frames[-1])))
        assert (own.any(1)[frames[0] : frames[-1] + 1]).float().mean() > 0.9
    assert len(seen) > 0.8 * len(which)  # the same run of a part is not told twice


@pytest.mark.parametrize("first", range(1, 6))
def test_runs_backward_are_the_same(first):
    """A bone that only touches the image plane: also near the clip's end its sign may have been lost there."""
    depth = 0.02 * (torch.arange(40).double() - (first - 0.5)).abs()[:, None]
    runs = [flipped_runs(one, torch.ones(1, 1).double(), ACCELERATION) for one in (depth, depth.flip(0))]
    there, back = ({*zip(one.starts.tolist(), one.ends.tolist(), strict=True)} for one in runs)
    assert there == {(40 - end, 40 - start) for start, end in back}


@pytest.mark.parametrize("frames", [1, 2, 3, 4, 40])
def test_bends_are_counted_where_signs_change(frames, monkeypatch):
    """As a count over all frames says; what bends too much is left out."""
    depth = bones_of(frames, seed=1)
    member = torch.zeros(6, len(PARTS)).double()
    for column, part in zip(member.mT, PARTS, strict=True):
        column[list(part)] = 1
    cost = lambda d: d.diff(n=2, dim=0).square().sum(0)  # noqa: E731
    for k, bend in enumerate(module._bends(depth, member).mT):
        other = torch.cat([depth[:k], -depth[k:]])
        assert_close(bend, (cost(other) - cost(depth)) @ member)
    monkeypatch.setattr(module, "SHARP", 0.5)
    found, _ = every_flip(depth, PARTS)
    grown = (cost(found.movedim(0, 1)) - cost(depth)).sum(-1) / (2 * ACCELERATION**2)
    assert (grown < 0.51).all() and (frames < 40 or len(grown))


def test_signs_that_jump_are_changed_where_they_jump():
    """Also far from the image plane: what jumps there went wrong, and nothing else removes it."""
    depth = bones_of(seed=2)
    depth[:, 5] = 0.1 + 0.05 * torch.sin(torch.arange(40) / 9)
    wrong = depth.clone()
    wrong[17:24, 5] *= -1
    found, _ = every_flip(wrong, PARTS)
    best = found[(found - depth).square().sum((1, 2)).argmin()]
    assert_close(best, depth)


@pytest.mark.parametrize("frames", [1, 2, 4, 5, 6])
@pytest.mark.parametrize("kind", ["moving", "still", "flat"])
def test_clips_that_tell_little(frames, kind):
    depth = bones_of(frames)
    depth = depth[:1].expand_as(depth) if kind == "still" else 0 * depth if kind == "flat" else depth
    found, which = every_flip(depth, PARTS)
    assert found.shape == (len(which), frames, 6) and torch.isfinite(found).all()
    assert kind != "flat" or not len(which)


def test_large_flips_may_cost_more_than_small_ones():
    """They would else wait behind changes of a hand for a moment, which cost little and gain little."""
    flat = torch.zeros(6, 20, 3).double()
    depth = flat + torch.tensor([0.01, 0.01, 0.1, 0.1, 0.1, 0.01])[:, None, None]
    flips = Hypotheses(depth, torch.ones(6, 2).double(), torch.tensor([0.1, 0.5, 3.0, 9.0, 20.0, 8.0]).double())
    best = Hypotheses(flat[:1], torch.ones(1, 2).double(), torch.zeros(1).double())
    assert module.promising(flips, best, ((15.0, 2), (5.0, 1))).tolist() == [2, 3, 0]
    assert module.promising(flips, best, ((1.0, 2), (0.05, 1))).tolist() == []


def odd_body(name, frames, noise=0.0, anchored=False):
    """An objective, and a solution of it that is far from good: depths of bones, lengths, and the body's parts."""
    body = SKELETONS[name]
    usual = usual_posture(body, torch.float64, torch.device("cpu"))
    sway = normal(frames, body.num_joints, 3).cumsum(0) / frames**0.5
    points = body.template_points(dtype=torch.float64) + 0.15 * sway
    points = points - points.mean(1, keepdim=True)
    blur = noise * normal(frames, body.num_joints, seed=1).abs()
    anchor = 1.02 * usual.rest_lengths if anchored else None
    objective = Objective(body, points[..., :2], Weights(), blur, anchor)
    own = bone_vectors(points, objective.bones)[..., 2]
    own = bone_vectors(objective.joints(own)[..., None], objective.bones)[..., 0]
    parts = parts_of(body, limbs_of(body, objective.posture.trunk.tolist()))
    return objective, own, 1.05 * usual.rest_lengths, module.members(parts, own)


@pytest.mark.parametrize("frames", [1, 2, 3, 4, 5, 30])
@pytest.mark.parametrize(("name", "noise"), [("h36m17", 0.0), ("body25", 0.02), ("hand21", 0.0)])
def test_runs_cost_what_the_objective_says(name, noise, frames, monkeypatch):
    """From sums over frames, for every part and run; body25 has virtual joints, hand21 no twins."""
    monkeypatch.setattr(module, "SHARP", 1e3)
    objective, own, lengths, member = odd_body(name, frames, noise, anchored=noise > 0)
    runs = flipped_runs(own, member, ACCELERATION)
    assert len(runs.part) >= len(member) / 2
    depth = objective.joints(own * signs_of(runs, member, len(own)))
    expected = objective(depth, lengths.expand(len(depth), -1))
    costs = RunCosts(objective, ParallelRays(objective, own), lengths)
    assert_close(costs(member, runs), expected, rtol=1e-10, atol=1e-9)


def test_many_runs_take_no_more_operations_than_one():
    """What a part costs in each frame is counted once for all of its runs."""
    objective, own, lengths, member = odd_body("h36m17", 200)
    costs = RunCosts(objective, ParallelRays(objective, own), lengths)

    places = torch.arange(0, 204, 4).expand(len(member), -1)

    def operations(count):
        first, part = torch.arange(count) % 48, torch.arange(count) % len(member)
        return count_operations(lambda: costs(member, Runs(places, part, first, first + 2))).total

    assert operations(400) == operations(1)


@pytest.mark.parametrize("name", ["h36m17", "mediapipe33"])
def test_feet_are_asked_only_of_parts_that_carry_them(name):
    """Arms may swing: the trunk moves as before, and so do the legs."""
    objective, own, _, member = odd_body(name, 30)
    body = objective.skeleton
    objective.standing = torch.ones(30, len(body.contacts)).double()
    part = torch.arange(len(member))
    runs = Runs(torch.tensor([[0, 15]]).expand(len(member), -1), part, 0 * part, 0 * part + 1)
    energy = objective.contact(objective.joints(own * signs_of(runs, member, len(own))))
    same = (energy - objective.contact(objective.joints(own[None]))).abs() < 1e-9
    carries = objective.carries(member)
    assert 0 < carries.sum() < len(member) and same[~carries].all()
    assert (~same[carries]).float().mean() > 0.9


@pytest.mark.parametrize("stands", [False, True])
def test_a_wrong_run_is_turned_over(stands):
    """A part that passes through the image plane, and is mirrored before it does."""
    points = walk(60, yaw=45.0)
    image = points[..., :2] - points[..., :2].mean(1, keepdim=True)
    feet = list(BODY.contacts)
    sure = standing(points[:, feet, :2], torch.ones(60, len(feet)).double()) if stands else None
    objective = Objective(BODY, image, Weights(), torch.zeros(60, 17).double(), standing=sure)
    lengths = bone_vectors(points, objective.bones).norm(dim=-1).mean(0)
    true = points[..., 2] - points[..., 2].mean(1, keepdim=True)
    (best,) = minimise_all([task(objective, true[None], lengths[None])])
    parts = parts_of(BODY, limbs_of(BODY, objective.posture.trunk.tolist()))
    start = Hypotheses(best.depth, best.lengths, best.energy)
    flips = flipped(objective, parts, start)
    assert 0 < len(flips.energy) <= len(parts) and (flips.energy.diff() >= 0).all()
    near = flips.energy < start.energy + 15  # of hopeless ones the contacts are not looked at
    assert near.sum() > 3
    energy = objective(flips.depth, flips.lengths) + objective.contact(flips.depth)
    assert_close(energy[near], flips.energy[near], rtol=1e-6, atol=1e-3)
    own = bone_vectors(start.depth[0, :, :, None], objective.bones)[..., 0]
    runs, _ = every_flip(own, parts)
    depth = (runs @ objective.tree.mT)[:40]
    (tried,) = minimise_all([task(objective, depth, start.lengths.expand(len(depth), -1))])
    stuck = int((tried.energy > start.energy[0] + 1).nonzero()[0])  # the refinement alone does not get out of it
    wrong = Hypotheses(tried.depth[stuck, None], tried.lengths[stuck, None], tried.energy[stuck, None], 20)
    assert wrong.energy[0] > start.energy[0] + 1
    found = run(turned_over(objective, parts, wrong, 20), minimise_all)
    assert found.energy[0] < wrong.energy[0] - 1 and (found.energy.diff() >= 0).all()
    apart = lambda z: float((z - start.depth[0]).square().mean().sqrt())  # noqa: E731
    assert apart(found.depth[0]) < 0.3 * apart(wrong.depth[0])
    assert 20 < found.steps < 20 + 4 * 2 * 30


def exact_walk(frames=60):
    """An objective, its parts, the true bones' depths (T, B) and lengths (1, B) of a walk before a still camera."""
    points = walk(frames, yaw=45.0)
    image = points[..., :2] - points[..., :2].mean(1, keepdim=True)
    objective = Objective(BODY, image, Weights(), torch.zeros(frames, 17).double())
    bones = bone_vectors(points, objective.bones)
    parts = parts_of(BODY, limbs_of(BODY, objective.posture.trunk.tolist()))
    return objective, parts, bones[..., 2], bones.norm(dim=-1).mean(0, keepdim=True)


def hypothesis(objective, own, lengths):
    depth = objective.joints(own)[None]
    return Hypotheses(depth, lengths, objective(depth, lengths))


@pytest.mark.parametrize("which", [None, ("shoulder", "elbow", "wrist"), ("hip", "knee", "ankle")])
def test_what_is_mirrored_for_a_while_is_turned_over_at_once(which):
    """The body, or both arms or legs: one alone would be unlike its twin, and so dearer."""
    objective, parts, own, lengths = exact_walk()
    objective.weights = Weights(acceleration=1.0)  # so that it may start where the body is away from the image plane
    true = hypothesis(objective, own, lengths)
    ends = [BODY.bone_names[b].split("-") for b in range(16)]
    of = [b for b, end in enumerate(ends) if not which or all(name.endswith(which) for name in end)]
    assert len(of) == (4 if which else 16)
    for frames in (slice(None), slice(30, None)):
        wrong = own.clone()
        wrong[frames, of] *= -1
        flips = flipped(objective, parts, hypothesis(objective, wrong, lengths))
        same = (flips.depth - true.depth).abs().amax((1, 2)) < 1e-9
        assert same.sum() == 1


def test_two_changes_that_have_nothing_to_do_with_each_other_are_made_at_once():
    objective, _, own, lengths = exact_walk()
    best = hypothesis(objective, own, lengths)
    changes = own.new_zeros(5, *own.shape)
    changes[0, :20, 2] = changes[1, 10:20, 2] = changes[2, 30:, 2] = changes[3, :, 9] = changes[4, :, 5] = 0.1
    depth = objective.joints(own + changes)
    gains = own.new_tensor([9.0, 8.0, 7.0, 5.0, 0.2])
    longer = lengths * (1 + 0.01 * torch.eye(5, 16).double())
    found = Hypotheses(depth, longer, best.energy - gains, 30)
    both = combined(found, best, 0.3, objective.bones)
    assert_close(both.depth, objective.joints(own + changes[0] + changes[2])[None])
    assert_close(both.lengths[0, :4] / lengths[0, :4], own.new_tensor([1.01, 1.0, 1.01, 1.0]))
    assert_close(both.energy, best.energy - 16)
    assert both.steps == 0
    for few in (found[:0], found[:1], found[:2], found[3:]):  # none, one, two of one run, and one gains too little
        assert combined(few, best, 0.3, objective.bones).depth.shape == (0, *best.depth.shape[1:])


def test_two_wrong_runs_are_turned_over_in_one_round(monkeypatch):
    """Of a thigh and a forearm, up to their first passages; a second round finds that nothing is left to do."""
    objective, parts, own, lengths = exact_walk(90)
    (true,) = minimise_all([task(objective, objective.joints(own)[None], lengths)])
    wrong = own.clone()
    for name in ("right_hip-right_knee", "right_elbow-right_wrist"):
        bone = BODY.bone_names.index(name)
        wrong[: int((own[1:, bone] * own[:-1, bone] < 0).nonzero()[0]) + 1, bone] *= -1
    (start,) = minimise_all([task(objective, objective.joints(wrong)[None], lengths)])
    start = Hypotheses(start.depth, start.lengths, start.energy)
    assert start.energy > true.energy + 5
    rounds = []
    monkeypatch.setattr(module, "flipped", lambda *args: rounds.append(0) or flipped(*args))
    found = run(turned_over(objective, parts, start, 20), minimise_all)
    assert found.energy[0] < true.energy[0] + 0.1
    assert len(rounds) == 2


@pytest.mark.parametrize("between", [0.0, 0.02, -0.02])
def test_a_jump_with_a_frame_in_its_middle_is_a_jump(between):
    """Descent leaves one there, with a bone too short; what follows is turned over all the same, and is whole."""
    objective, parts, own, lengths = exact_walk()
    bone = int(own.abs().amin(0).argmax())  # one that stays away from the image plane
    assert own[:, bone].abs().amin() > 0.03
    wrong = own.clone()
    wrong[31:, bone] *= -1
    wrong[30, bone] = between
    start = hypothesis(objective, wrong, lengths)
    flips = flipped(objective, parts, start)
    true = objective.joints(own)
    off = (flips.depth - true).abs().amax((1, 2))
    assert off.amin() < 1e-6 and flips.energy[off.argmin()] < start.energy[0]


def task(objective, depth, lengths):
    return Task(objective, depth, lengths, 20)
