"""Hypotheses refined: the unknowns, that few steps do and the true motion is best, and several clips at once."""

from dataclasses import replace

import pytest
import torch
from numerics import gradcheck, normal
from objective_walks import lengths_of, objective, of_length, walk
from torch.testing import assert_close

from kcs_torch.functional import bone_lengths, bone_vectors
from kcs_torch.methods.clips.lockstep import run, together
from kcs_torch.methods.pkc import refinement
from kcs_torch.methods.pkc.objective import Objective
from kcs_torch.methods.pkc.refinement import Task, minimise, minimise_all
from kcs_torch.methods.pkc.unknowns import Unknowns
from kcs_torch.methods.pkc.weights import Weights
from kcs_torch.skeleton import SKELETONS
from kcs_torch.solvers import lbfgs


@pytest.mark.parametrize("noise", [0.0, 0.01])
@pytest.mark.parametrize("skeleton", ["h36m17", "coco17", "mediapipe33"])
def test_unknowns_start_where_they_are_told_to(skeleton, noise):
    points = walk(5, skeleton)
    found = objective(points, skeleton, noise=noise)
    depth = torch.stack([points[..., 2], -0.5 * points[..., 2]])
    lengths = lengths_of(found, points) * torch.tensor([[1.0], [1.1]])
    unknowns = Unknowns(found, depth, lengths)
    bones = found.skeleton.num_bones
    assert unknowns.scale.shape == (2, 6 * bones) and (unknowns.scale > 0).all()
    again, same = unknowns(torch.zeros(2, 6 * bones).double())
    assert_close(again, depth, rtol=0, atol=1e-12)
    assert torch.equal(same, lengths)


@pytest.mark.parametrize("skeleton", ["h36m17", "coco17", "mediapipe33"])
def test_unknowns_give_bodies_wherever_they_are(skeleton):
    """Centred, with virtual joints at their sources and lengths above 0."""
    points = walk(5, skeleton)
    found = objective(points, skeleton)
    body = SKELETONS[skeleton]
    unknowns = Unknowns(found, points[None, ..., 2], lengths_of(found, points)[None])
    depth, lengths = unknowns(30 * normal(1, 6 * body.num_bones))
    assert (depth - points[..., 2]).abs().max() > 0.1
    assert depth.mean(-1).abs().max() < 1e-12 and (lengths > 0).all()
    seen = torch.cat([normal(5, body.num_observed, 2), depth[0, :, : body.num_observed, None]], -1)
    assert_close(body.complete(seen)[0][..., 2], depth[0])


def test_a_length_takes_its_bone_s_depths_along():
    """Where a bone points at the camera, four fifths of what it grows by."""
    points = walk(5)
    found = objective(points)
    lengths = lengths_of(found, points)[None]
    unknowns = Unknowns(found, points[None, ..., 2], lengths)
    state = torch.zeros(1, 6 * 16).double()
    state[:, -16:] = 1e-4 / unknowns.scale[:, -16:]
    depth, grown = unknowns(state)
    misfit = lambda z, size: found.flat + bone_vectors(z[0, ..., None], found.bones)[..., 0] ** 2 - size**2  # noqa: E731
    alone = misfit(points[None, ..., 2], grown) - misfit(points[None, ..., 2], lengths)
    along = misfit(depth, grown) - misfit(points[None, ..., 2], lengths)
    share = (bone_vectors(points, found.bones)[..., 2] / lengths) ** 2
    assert_close(along / alone, 0.25 / (share + 0.25), rtol=0, atol=1e-3)
    assert share.max() > 0.5


@pytest.mark.parametrize("noise", [0.0, 0.01])
@pytest.mark.parametrize("frames", [1, 2, 5])
def test_gradient_over_unknowns(frames, noise):
    points = walk(5)[:frames]
    found = objective(points, noise=noise)
    unknowns = Unknowns(found, *of_length(found, points, 1.05))
    start = torch.zeros_like(unknowns.scale)
    for state in (start, 2 * normal(*start.shape)):
        assert gradcheck(lambda s: found(*unknowns(s)), state, fast=True)


@pytest.mark.parametrize("noise", [0.0, 0.003, 0.01])
def test_unknowns_make_the_objective_round(noise):
    """The Hessian's condition at a minimum, without the shifts of whole frames, which cost nothing."""
    points = walk(9, yaw=20.0)
    found = objective(points, noise=noise)
    z, sizes, *_ = minimise(found, points[None, ..., 2], lengths_of(found, points)[None], 100)
    unknowns = Unknowns(found, z, sizes)
    plain = torch.cat([z.flatten(), sizes.flatten().log()])
    curves = []
    for energy, state in (
        (lambda s: found(*unknowns(s[None]))[0], torch.zeros(10 * 16).double()),
        (lambda s: found(s[: 9 * 17].view(1, 9, 17), s[None, 9 * 17 :].exp())[0], plain),
    ):
        hessian = torch.autograd.functional.hessian(energy, state)
        curves.append(torch.linalg.eigvalsh(hessian)[-10 * 16 :])
    white, plain = (float(curve[-1] / curve[0]) for curve in curves)
    assert 1 < white < 0.2 * plain
    assert 0.05 < curves[0].median() < 10 and curves[0][-1] < 10


@pytest.mark.parametrize("factor", [1.03, 1.1])
@pytest.mark.parametrize("noise", [0.0, 0.01])
def test_few_steps_do(noise, factor):
    """Twenty steps lead further than forty on depths and lengths themselves."""
    points = walk()
    found = objective(points, noise=noise)
    depth, lengths = of_length(found, points, factor)

    def plain(state):
        z, sizes = state.split([40 * 17, 16], 1)
        z = z.unflatten(1, (40, 17))
        return found(z - z.mean(-1, keepdim=True), sizes.exp())

    start = torch.cat([depth.flatten(1), lengths.log()], 1)
    far = plain(lbfgs(plain, start, num_steps=40, tolerance=1e-9).value)
    energy = minimise(found, depth, lengths, 20)[2]
    assert energy < far < found(depth, lengths)


def test_loose_lengths_first():
    """As if lengths were known less; the objective itself is left as it is."""
    points = walk(20)
    found = objective(points)
    start = of_length(found, points, 1.1)
    loose = objective(points, weights=replace(Weights(), length=7 * Weights().length))
    for one, other in zip(minimise(found, *start, 8, 7.0)[:3], minimise(loose, *start, 8)[:3], strict=True):
        assert_close(one, other)
    assert found.weights == objective(points).weights


def test_where_nothing_is_seen_it_stays_finite():
    for points in (torch.zeros(4, 17, 3).double(), walk(4) * torch.tensor([0.0, 1.0, 1.0])):
        found = objective(points)
        depth, lengths, energy, *_ = minimise(found, 0 * points[None, ..., 2], found.posture.rest_lengths[None], 5)
        assert all(torch.isfinite(x).all() for x in (depth, lengths, energy))


@pytest.mark.parametrize("yaw", [0.0, 45.0, 90.0, 200.0])
def test_the_true_motion_is_best(yaw):
    """Better than its mirror image, than flat, than each limb flipped, than other lengths, than a wooden walk."""
    points = walk(yaw=yaw)
    found = objective(points)
    depth, lengths = points[..., 2], bone_lengths(points, found.bones).mean(0)
    dz = depth[:, found.bones[:, 1]] - depth[:, found.bones[:, 0]]
    others = [depth.mean(0, keepdim=True).expand_as(depth)]
    for name in ("left_knee-left_ankle", "right_hip-right_knee", "left_elbow-left_wrist"):
        flipped = dz.clone()
        flipped[:, found.skeleton.bone_names.index(name)] *= -1
        other = flipped @ found.tree.mT
        if (other - other.mean(-1, keepdim=True) - depth).abs().max() > 0.1:  # else the bone lies in the image plane
            others.append(other - other.mean(-1, keepdim=True))
    with torch.no_grad():
        true = found(depth[None], lengths[None])
        for other in others:
            assert found(other[None], lengths[None]) > true
        for other in (-depth, 0 * depth):
            assert found(other[None], lengths[None]) > true + 100
        assert found(depth[None], 1.1 * lengths[None]) > true + 5


def test_minimise_lowers_sorts_and_keeps_good_starts():
    points = walk()
    found = objective(points)
    lengths = bone_lengths(points, found.bones).mean(0)
    depth = torch.stack([-points[..., 2], points[..., 2] + 0.02 * normal(40, 17)])
    before = found(depth, lengths.expand(2, -1))
    z, sizes, energy, _, steps = minimise(found, depth, lengths.expand(2, -1), 25)
    assert (energy.diff() >= 0).all() and (energy < before.flip(0)).all()
    assert_close(energy, found(z, sizes))
    assert steps >= 1
    assert (z[0] - points[..., 2]).square().mean().sqrt() < 0.05
    alone = minimise(found, depth[1:], lengths[None], 25)
    assert_close(alone[2][0], energy[0], rtol=1e-3, atol=0)


def several():
    """Tasks of three clips that differ in length, frame rate, noise and anchor."""
    tasks = []
    for i, (frames, rate, noise, anchored) in enumerate(
        ((20, 30.0, 0.0, False), (33, 60.0, 0.01, True), (26, 20.0, 0.0, False))
    ):
        points = walk(frames, fps=rate)
        usual = bone_lengths(points, objective(points).bones).mean(0)
        found = objective(points, rate=rate, noise=noise, anchor=usual if anchored else None)
        depth = points[..., 2] + 0.05 * normal(2 + i, frames, 17, seed=i)
        tasks.append(Task(found, depth - depth.mean(-1, keepdim=True), usual.expand(2 + i, -1), 3))
    return tasks


def test_clips_together_have_the_energies_of_each():
    tasks = several()
    counts = [len(task.depth) for task in tasks]
    joined = Objective.joined([task.objective for task in tasks], counts)
    pad = lambda z: torch.nn.functional.pad(z, (0, 0, 0, 33 - z.shape[1]), value=0.7)  # noqa: E731
    depth, lengths = torch.cat([pad(task.depth) for task in tasks]), torch.cat([task.lengths for task in tasks])
    assert joined.standing is None
    together = joined.terms(depth, lengths)
    for task, *rows in zip(tasks, *(term.split(counts) for term in together.values()), strict=True):
        alone = task.objective.terms(task.depth, task.lengths)
        for name, row in zip(together, rows, strict=True):
            assert_close(row, alone.get(name, torch.zeros_like(row)), rtol=1e-8, atol=1e-6)


def test_clips_are_refined_together_as_alone():
    tasks = several()
    for task, found in zip(tasks, minimise_all(tasks), strict=True):
        alone = minimise(task.objective, task.depth, task.lengths, task.num_steps, task.loose)
        assert_close(found.energy, alone.energy, rtol=1e-6, atol=1e-6)
        assert_close(found.depth, alone.depth, rtol=0, atol=1e-5)
        assert_close(found.moved, alone.moved, rtol=1e-3, atol=1e-6)


def test_runs_are_not_too_large(monkeypatch):
    tasks = several()
    monkeypatch.setattr(refinement, "TOGETHER", 100)
    runs = refinement._runs(list(range(3)), tasks)
    assert sorted(i for run in runs for i in run) == [0, 1, 2] and len(runs) == 3


def test_hypotheses_of_long_clips_are_refined_a_few_at_a_time(monkeypatch):
    task = several()[-1]
    whole = minimise(task.objective, task.depth, task.lengths, 12)
    sizes = []
    refine = refinement._refined
    monkeypatch.setattr(refinement, "_refined", lambda goal, z, *rest: sizes.append(len(z)) or refine(goal, z, *rest))
    monkeypatch.setattr(refinement, "MOST", 2 * task.depth.shape[1])
    found = minimise(task.objective, task.depth, task.lengths, 12)
    assert max(sizes) <= 2 and sum(sizes) == len(task.depth)
    assert_close(found.energy, whole.energy, rtol=1e-6, atol=1e-6)
    assert_close(found.depth, whole.depth, rtol=0, atol=1e-5)


def test_searches_in_lockstep():
    """Each search gets the answers to its own tasks, however many it asks for and however long it goes on."""

    def search(task, rounds):
        energies = []
        for k in range(rounds):
            answers = yield [replace(task, num_steps=1 + k)] * (1 + k % 2)
            assert len(answers) == 1 + k % 2
            energies.append(float(answers[0].energy[0]))
        return energies

    tasks = several()
    searches = [search(task, rounds) for task, rounds in zip(tasks, (2, 0, 3), strict=True)]
    found = run(together(searches), minimise_all)
    for task, rounds, energies in zip(tasks, (2, 0, 3), found, strict=True):
        assert_close(energies, run(search(task, rounds), minimise_all), rtol=1e-6, atol=1e-6)
    assert run(together([]), minimise_all) == []


def test_what_is_late_waits_for_all_others():
    """Searches of different lengths ask for something together in the end, whatever they asked for before."""

    def search(rounds):
        asked = []
        for k in range(rounds):
            asked += yield [k]
        return asked + (yield [1.5, rounds]) + (yield [0])

    served = []

    def serve(requests):
        served.append(list(requests))
        return [-request for request in requests]

    found = run(together([search(n) for n in (2, 0, 1)], late=lambda request: request == 1.5), serve)
    assert found == [[0, -1, -1.5, -2, 0], [-1.5, 0, 0], [0, -1.5, -1, 0]]
    assert served == [[0, 0], [1], [1.5, 2, 1.5, 0, 1.5, 1], [0, 0, 0]]
