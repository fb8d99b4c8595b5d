"""Limbs: the chains of every skeleton, and lengths and signs of a limb that are known."""

import itertools
from dataclasses import replace

import pytest
import torch
from numerics import CHAIN, count_operations
from samples import walk_in_template_units
from torch.testing import assert_close

from kcs_torch.functional import bone_vectors
from kcs_torch.methods.pkc import placing as module
from kcs_torch.methods.pkc.limbs import SignCosts, limbs_of, outward, waves
from kcs_torch.methods.pkc.placing import limb_paths, placing
from kcs_torch.methods.pkc.trunk import mirror, trunk_turns
from kcs_torch.nn import PostureEnergy
from kcs_torch.nn.lengths import free_bones
from kcs_torch.nn.posture import trunk_joints
from kcs_torch.skeleton import SKELETONS

MAN = SKELETONS["h36m17"]
LIMBS = limbs_of(MAN, trunk_joints(MAN))
ARMS_LEGS = [limb for limb in LIMBS if limb.inner is not None]
each_skeleton = pytest.mark.parametrize("body", SKELETONS.values(), ids=SKELETONS)


@each_skeleton
def test_limbs_hold_every_bone_beyond_the_trunk_once(body):
    trunk = trunk_joints(body)
    limbs = limbs_of(body, trunk)
    bones = list(itertools.chain(*(limb.bones for limb in limbs)))
    beyond = {i for i, (_, b) in enumerate(body.bones) if b not in trunk}
    assert len(bones) == len(set(bones)) and beyond <= set(bones)
    for limb in limbs:
        assert len(limb.bones) == (1 if limb.inner is None else 2)
        if limb.inner is not None:
            first, second = (body.bones[i] for i in limb.bones)
            assert first[1] == second[0] == limb.inner.joint
        if limb.entry is not None:
            assert body.bones[limb.before][1] == body.bones[limb.bones[0]][0] == limb.entry.joint
    assert {h for limb in limbs for h in (limb.inner, limb.entry)} - {None} == set(body.hinges)


def turned(body, bones):
    """The skeleton with some of its bones written (child, parent)."""
    return replace(body, bones=tuple(b[::-1] if i in bones else b for i, b in enumerate(body.bones)))


@each_skeleton
def test_bones_are_directed_away_from_the_trunk_however_they_are_written(body):
    assert outward(body) is body
    assert outward(turned(body, range(body.num_bones))) == body
    trunk = trunk_joints(body)
    for i in range(body.num_bones):
        other = turned(body, {i})
        assert trunk_joints(other) == trunk
        assert outward(other) == body or set(body.bones[i]) <= set(trunk)
        found = limbs_of(outward(other), trunk)
        assert {limb.bones for limb in found} == {limb.bones for limb in limbs_of(body, trunk)}
    assert outward(CHAIN) is CHAIN


def test_arms_and_legs_of_a_person():
    names = {tuple(MAN.bone_names[i] for i in limb.bones) for limb in ARMS_LEGS}
    assert ("left_hip-left_knee", "left_knee-left_ankle") in names and len(names) == 4
    assert limbs_of(CHAIN, [0, 1, 2, 3]) == []


@each_skeleton
def test_waves_go_outwards(body):
    limbs = limbs_of(body, trunk_joints(body))
    found = waves(limbs)
    assert sorted(limb.bones for wave in found for limb in wave) == sorted(limb.bones for limb in limbs)
    done = set(range(body.num_bones)) - {b for limb in limbs for b in limb.bones}
    for wave in found:
        assert len({len(limb.bones) for limb in wave}) == 1
        assert all(limb.before in done | {-1} for limb in wave)
        done |= {b for limb in wave for b in limb.bones}


# ---------------------------------------------------------------------- lengths and signs


def walk(frames=60, dtype=torch.float64, **options):
    """A walk in the template's units, (T, 17, 3), and the arguments of limb_paths that follow from it."""
    points = walk_in_template_units(frames, dtype=dtype, **options)
    posture = PostureEnergy(MAN).to(dtype)
    vectors = bone_vectors(points, posture.bones)
    return vectors, posture, posture.frame(points)


def solve(*given, **options):
    return limb_paths([task(*given, **options)])[0]


def task(vectors, posture, frame, limbs, candidates, **options):
    return placing(
        vectors[..., :2], limbs, frame if frame.ndim == 4 else frame[None], posture, free_bones(MAN), SignCosts(),
        noise=torch.zeros_like(vectors[..., 0]), candidates=candidates, **options,
    )  # fmt: skip


def known(vectors, limbs):
    """Candidates (J, 1, M): the true lengths."""
    return torch.stack([vectors.norm(dim=-1).mean(0)[list(limb.bones)] for limb in limbs])[:, None]


def wrong_share(found, vectors, limbs):
    """Share of frames in which a bone that points well out of the image has the wrong sign."""
    true = torch.stack([vectors[..., 2][:, list(limb.bones)] for limb in limbs])
    clear = true.abs() > 0.3 * known(vectors, limbs)
    return float((found.depths.sign() != true.sign())[clear].double().mean())


@pytest.mark.parametrize("yaw", [0.0, 45.0, 90.0, 200.0])
def test_signs_of_a_walk_whose_trunk_and_lengths_are_known(yaw):
    vectors, posture, frame = walk(yaw=yaw)
    found = solve(vectors, posture, frame, ARMS_LEGS, known(vectors, ARMS_LEGS))
    assert found.lengths.shape == (4, 2) and found.depths.shape == (4, 60, 2) and found.margins is None
    assert wrong_share(found, vectors, ARMS_LEGS) < 0.06
    deep = torch.stack([vectors[..., 2][:, list(limb.bones)] for limb in ARMS_LEGS])
    assert_close(found.depths.abs(), deep.abs(), rtol=0, atol=1e-3)


def test_lengths_are_chosen():
    vectors, posture, frame = walk(90, yaw=90.0)
    true = known(vectors, ARMS_LEGS)
    steps = torch.cartesian_prod(*[torch.tensor([0.9, 1.0, 1.15, 1.4]).double()] * 2)
    found = solve(vectors, posture, frame, ARMS_LEGS, true * steps)
    assert ((found.lengths / true[:, 0] - 1).abs() < 0.16).all()
    assert ((found.lengths / true[:, 0] - 1).abs() < 1e-6).double().mean() > 0.6


def test_together_as_one_by_one():
    vectors, posture, frame = walk(30)
    grid = known(vectors, ARMS_LEGS) * torch.tensor([1.0, 1.1])[:, None]
    together = solve(vectors, posture, frame, ARMS_LEGS, grid)
    for j, limb in enumerate(ARMS_LEGS):
        one = solve(vectors, posture, frame, [limb], grid[j : j + 1])
        assert torch.equal(one.lengths[0], together.lengths[j]) and torch.equal(one.depths[0], together.depths[j])


@pytest.mark.parametrize("most", [1, 5000, 10**9])
def test_clips_and_limbs_together_as_alone(most, monkeypatch):
    """Clips of two lengths, limbs of one bone and of two, with their own weights, in parts however small."""
    tasks, alone = [], []
    for frames, yaw in ((30, 0.0), (30, 50.0), (21, 90.0)):
        vectors, posture, frame = walk(frames, yaw=yaw)
        for limbs in (ARMS_LEGS, [limb for limb in LIMBS if limb.inner is None]):
            made = task(vectors, posture, frame, limbs, known(vectors, limbs) * torch.tensor([1.0, 1.1])[:, None])
            tasks.append(replace(made, costs=made.costs * (1 + yaw / 90)))
            tasks[-1].costs[:, 1] = made.costs[:, 1]  # the cap
            alone += limb_paths(tasks[-1:])
    monkeypatch.setattr(module, "TOGETHER", most)
    for found, one in zip(limb_paths(tasks), alone, strict=True):
        assert torch.equal(found.lengths, one.lengths) and torch.equal(found.depths, one.depths)


def test_padded_clips_and_their_trunks_paths_as_alone():
    """Clips of many lengths, whose frames choose between two paths of the trunk; what pads them tells nothing."""
    tasks, alone = [], []
    for frames in (24, 25, 31, 36, 50, 3, 2, 210, 220):
        vectors, posture, frame = walk(frames, yaw=3.0 * frames)
        both = torch.stack([frame, mirror(frame)])
        grid = known(vectors, ARMS_LEGS) * torch.tensor([1.0, 1.1])[:, None]
        moves = trunk_turns(both, 0.15, 8.0)
        tasks.append(
            placing(
                vectors[..., :2], ARMS_LEGS, both, posture, free_bones(MAN), SignCosts(), 0 * vectors[..., 0],
                candidates=grid, transition=moves, margins=True,
            )
        )  # fmt: skip
        alone += limb_paths(tasks[-1:])
    for found, one in zip(limb_paths(tasks), alone, strict=True):
        assert torch.equal(found.lengths, one.lengths) and torch.equal(found.depths, one.depths)
        assert_close(found.margins, one.margins, rtol=1e-4, atol=1e-3)
    calls = [count_operations(lambda t=some: limb_paths(t)).total for some in (tasks[:1], tasks[:3], tasks[1:4])]
    assert max(calls) < 1.7 * calls[0]


def test_more_limbs_take_no_more_operations():
    vectors, posture, frame = walk(20)
    grid = known(vectors, ARMS_LEGS) * torch.tensor([1.0, 1.1])[:, None]
    few, many = (task(vectors, posture, frame, ARMS_LEGS[:n], grid[:n]) for n in (1, 4))
    counts = [count_operations(lambda t=tasks: limb_paths(t)).total for tasks in ([few], [many], [many] * 5)]
    assert max(counts) < min(counts) + 40  # those that join and cut


def test_long_clips_in_windows():
    vectors, posture, frame = walk(450)
    found = solve(vectors, posture, frame, ARMS_LEGS, known(vectors, ARMS_LEGS))
    assert found.depths.shape == (4, 450, 2)
    assert wrong_share(found, vectors, ARMS_LEGS) < 0.06
    short = solve(vectors[:150], posture, frame[:150], ARMS_LEGS, known(vectors, ARMS_LEGS))
    assert (found.depths[:, :150] * short.depths >= 0).double().mean() > 0.95


def test_limbs_vote_for_the_true_path_of_the_trunk():
    """The mirror image of the trunk costs more, the more frames take it."""
    vectors, posture, frame = walk(yaw=20.0)
    flip = torch.tensor([1.0, 1.0, -1.0]).double()
    both = torch.stack([frame, frame * flip[:, None] * flip])
    free = torch.zeros(59, 2, 2).double()
    found = solve(vectors, posture, both, ARMS_LEGS, known(vectors, ARMS_LEGS), transition=free, margins=True)
    assert found.margins.shape == (4, 60, 2) and found.margins.min() > -1e-4  # rounding of single precision
    vote = found.margins.sum((0, 1))
    assert vote[0] < vote[1]


def test_entry_hinges_see_the_bone_before():
    """Feet: the ankle's hinge joins the shank, already placed, to the foot."""
    body = SKELETONS["body25"]
    feet = [limb for limb in limbs_of(body, trunk_joints(body)) if limb.entry is not None][:2]
    assert len(feet) == 2
    posture = PostureEnergy(body)
    rest = bone_vectors(posture.rest, posture.bones).expand(10, -1, 3)
    grid = torch.stack([posture.rest_lengths[list(limb.bones)] for limb in feet])[:, None]
    near = [rest[:, limb.before] / posture.rest_lengths[limb.before] for limb in feet]
    found = placing(
        rest[..., :2], feet, torch.eye(3).double().expand(1, 10, 3, 3), posture, free_bones(body), SignCosts(),
        noise=torch.zeros_like(rest[..., 0]), candidates=grid, before=near,
    )  # fmt: skip
    (found,) = limb_paths([found])
    true = torch.stack([rest[..., 2][:, list(limb.bones)] for limb in feet])
    assert_close(found.depths, true, rtol=0, atol=1e-5)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("frames", [1, 2, 3])
def test_few_frames_and_images_of_nothing(frames, dtype):
    vectors, posture, frame = walk(frames, dtype)
    for image in (vectors, 0 * vectors, 5 * vectors):  # as seen, gone, longer than the bones
        found = solve(image, posture, frame, ARMS_LEGS, known(vectors, ARMS_LEGS))
        assert found.depths.shape == (4, frames, 2) and found.depths.dtype == dtype
        assert torch.isfinite(found.depths).all()
    assert (found.depths == 0).all()


def test_one_bone_limbs():
    head = [limb for limb in LIMBS if limb.inner is None]
    assert head
    vectors, posture, frame = walk()
    found = solve(vectors, posture, frame, head, known(vectors, head))
    assert found.depths.shape == (len(head), 60, 1)
    true = torch.stack([vectors[..., 2][:, list(limb.bones)] for limb in head])
    assert_close(found.depths.abs(), true.abs(), rtol=0, atol=1e-3)
    assert (found.depths * true > 0).double().mean() > 0.8
