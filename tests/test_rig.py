"""Rotations found from joints: forward kinematics meets every joint of bones that keep their length."""

import math

import pytest
import torch
from numerics import gradcheck, normal, rotations
from samples import walking_motion

import kcs_torch as kt
from kcs_torch.errors import OutputError
from kcs_torch.functional import bone_lengths, minimal_turn
from kcs_torch.io.contents.rig import fit_rig


def off(points, rig):
    return float((rig.positions() - points).norm(dim=-1).max())


def proper(turns):
    eye = torch.eye(3, dtype=turns.dtype)
    return torch.allclose(turns @ turns.mT, eye.expand_as(turns)) and bool((torch.linalg.det(turns) > 0.99).all())


def test_minimal_turn_takes_one_direction_to_the_other():
    generator = torch.Generator().manual_seed(0)
    a, b = torch.randn(2, 50, 3, generator=generator, dtype=torch.float64)
    turn = minimal_turn(a, b)
    assert proper(turn)
    unit = lambda x: torch.nn.functional.normalize(x, dim=-1)  # noqa: E731
    assert torch.allclose((turn @ unit(a)[..., None])[..., 0], unit(b))
    angle = torch.arccos((unit(a) * unit(b)).sum(-1))
    trace = turn.diagonal(dim1=-2, dim2=-1).sum(-1)
    assert torch.allclose(torch.arccos((trace - 1) / 2), angle)  # and by no more


def test_minimal_turn_of_the_odd_cases():
    eye = torch.eye(3, dtype=torch.float64)
    assert torch.equal(minimal_turn(eye, torch.zeros_like(eye)), eye.expand(3, 3, 3))
    assert torch.allclose(minimal_turn(eye, 2 * eye), eye.expand(3, 3, 3))
    back = minimal_turn(eye, -3 * eye)
    assert proper(back)
    assert torch.allclose((back @ eye[..., None])[..., 0], -eye)
    nearly = eye + 1e-9
    assert proper(minimal_turn(eye, -nearly))


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_minimal_turn_near_a_half_turn_is_as_exact_as_elsewhere(dtype):
    """1 + cosine cancels there: matrices were no rotations, and half turns missed the target."""
    generator, few = torch.Generator().manual_seed(0), 16 * torch.finfo(dtype).eps
    a, aside = torch.nn.functional.normalize(torch.randn(2, 50, 3, generator=generator, dtype=torch.float64), dim=-1)
    across = torch.nn.functional.normalize(torch.linalg.cross(a, aside), dim=-1)
    for degrees in (89, 91, 120, 179, 179.9, 179.99, 179.9999, 179.999999, 180):
        b = kt.functional.rotation_matrix(math.radians(degrees) * across) @ a[..., None]
        turn = minimal_turn(3 * a.to(dtype), b[..., 0].to(dtype)).double()
        assert (turn @ turn.mT - torch.eye(3, dtype=torch.float64)).abs().max() < few, degrees
        assert (turn @ a[..., None] - b).abs().max() < few, degrees
        turned = kt.functional.rotation_angle(turn, torch.eye(3, dtype=torch.float64)).rad2deg()
        assert torch.allclose(turned, torch.full_like(turned, degrees), atol=1e3 * few, rtol=0), degrees


def test_minimal_turn_gradient():
    a, b = normal(2, 20, 3)
    for target in (b, -b, -a + 0.1 * b, a.clone()):
        assert gradcheck(minimal_turn, a, target)


@pytest.mark.parametrize("skeleton", ["coco17", "h36m17", "body25", "halpe26", "cmu31", "mediapipe33", "smpl24"])
@pytest.mark.parametrize("up", ["y", "z"])
def test_a_walk_is_met_exactly(skeleton, up):
    motion = walking_motion(20, skeleton)
    points = kt.types.axes.from_y_up(motion.points, up)
    rig = fit_rig(points, motion.skeleton, up=up)
    assert off(points, rig) < 1e-9  # metres
    assert proper(rig.turns)
    assert rig.parents[0] == -1
    assert all(parent < node for node, parent in enumerate(rig.parents))
    assert [rig.names[node] for node in rig.joints] == list(motion.skeleton.joints)
    assert torch.equal(rig.offsets[0], torch.zeros(3, dtype=torch.float64))


def test_it_rests_as_the_template():
    motion = walking_motion(20, "h36m17")
    rig = fit_rig(motion.points, motion.skeleton)
    at = {name: rig.joints[i] for i, name in enumerate(motion.skeleton.joints)}
    down = torch.tensor([0.0, -1.0, 0.0], dtype=torch.float64)
    for side in ("left", "right"):
        shank = torch.nn.functional.normalize(rig.offsets[at[f"{side}_ankle"]], dim=0)
        assert float(shank @ down) > 0.98
    assert float(rig.offsets[at["left_hip"]][0]) > 0 > float(rig.offsets[at["right_hip"]][0])  # it faces +z


@pytest.mark.parametrize("seed", range(6))
def test_any_tree_in_any_motion_is_met(seed):
    generator = torch.Generator().manual_seed(seed)
    edges = [(int(torch.randint(0, child, (), generator=generator)), child) for child in range(1, 12)]
    edges = [(b, a) if seed % 2 and i % 3 == 0 else (a, b) for i, (a, b) in enumerate(edges)]  # bones may point inwards
    body = kt.Skeleton.from_edges(edges, 12)
    clip = kt.data.random_motion(body, 30, swing=90, size=5, generator=generator)
    rig = fit_rig(clip.points, body)
    assert off(clip.points, rig) < 1e-9
    assert proper(rig.turns)


def test_rigid_children_need_no_more_nodes():
    body = kt.Skeleton.from_edges([(0, 1), (0, 2), (0, 3), (3, 4)], 5)
    rest = torch.randn(5, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    points = rest @ rotations(15, seed=2) + torch.randn(15, 1, 3, dtype=torch.float64)
    rig = fit_rig(points, body)
    assert len(rig.names) == 5
    assert off(points, rig) < 1e-9
    free = points.clone()
    free[:, 3:] = points[:, :1] + (points[:, 3:] - points[:, :1]) @ rotations(15, seed=3)
    rig = fit_rig(free, body)
    assert rig.names == ["joint0", "joint1", "joint2", "joint0_joint3", "joint3", "joint4"]
    assert off(free, rig) < 1e-9
    assert torch.equal(rig.offsets[3], torch.zeros(3, dtype=torch.float64))


def test_still_joints_do_not_spin():
    """Hips on one line with the pelvis leave the turn about it open; the spine settles it."""
    motion = walking_motion(40)
    rig = fit_rig(motion.points, motion.skeleton)
    steps = rig.turns[1:] @ rig.turns[:-1].mT
    trace = steps.diagonal(dim1=-2, dim2=-1).sum(-1)
    degrees = torch.rad2deg(torch.arccos(((trace - 1) / 2).clamp(-1, 1)))
    assert float(degrees.max()) < 30  # a frame, at 25 a second


def test_bones_that_change_have_their_mean_length():
    motion = walking_motion(20)
    points = motion.points.clone()
    knee, ankle = motion.skeleton.index("left_knee"), motion.skeleton.index("left_ankle")
    stretch = torch.linspace(0.9, 1.1, 20, dtype=torch.float64)[:, None]
    points[:, ankle] = points[:, knee] + stretch * (points[:, ankle] - points[:, knee])
    rig = fit_rig(points, motion.skeleton)
    shank = float(bone_lengths(motion.points, [(knee, ankle)]).mean())
    assert off(points, rig) == pytest.approx(0.1 * shank, rel=1e-6)
    others = [i for i in range(19) if i != ankle]
    assert float((rig.positions() - points)[:, others].norm(dim=-1).max()) < 1e-9


@pytest.mark.parametrize(
    ("edges", "reason"),
    [
        ([], "has no bones"),
        ([(0, 1), (1, 2), (2, 0)], "closes a chain"),
        ([(0, 1)], "falls into 2 pieces, one of them joint2"),
    ],
)
def test_what_is_no_tree_is_refused(edges, reason):
    body = kt.Skeleton.from_edges(edges, 3, tree=False)
    with pytest.raises(OutputError, match=reason):
        fit_rig(torch.randn(4, 3, 3), body)
