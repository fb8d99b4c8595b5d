"""How joints bend: known angles, their sign, derivatives, and deviations."""

import math
from dataclasses import replace

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from numerics import DEVICES, FLOATS, finite, gradcheck, leaves_arguments_alone, normal, rotations, same_as_loop
from samples import walk_result, walking_motion
from torch.testing import assert_close

import kcs_torch as kt
from kcs_torch.anatomy import Hinge
from kcs_torch.errors import OptionError, ShapeError, SkeletonError
from kcs_torch.functional import angle_between, flexion, joint_angles
from kcs_torch.types.angles import angles_of

LEFT = torch.tensor([1.0, 0, 0], dtype=torch.float64)  # of a person who faces the viewer; y down, z away
DOWN = torch.tensor([0.0, 1, 0], dtype=torch.float64)
BODY = kt.Skeleton.from_names(
    ["l_hip", "r_hip", "l_knee", "r_knee", "l_ankle", "r_ankle", "l_toe", "r_toe"],
    [(f"{s}_{a}", f"{s}_{b}") for s in "lr" for a, b in (("hip", "knee"), ("knee", "ankle"), ("ankle", "toe"))]
    + [("l_hip", "r_hip")],
    hinges=[{"joint": "l_knee", "bends": "backward"}, {"joint": "l_ankle", "bends": "forward"}],
)


def bent(degrees: float) -> torch.Tensor:
    """A shank that bends backward, away from the viewer, by so many degrees."""
    angle = math.radians(degrees)
    return torch.tensor([0.0, math.cos(angle), math.sin(angle)], dtype=torch.float64)


def legs(knee: float, ankle: float = 90.0) -> torch.Tensor:
    """(8, 3): both legs, of a person who faces the viewer."""
    hip = torch.stack([0.1 * LEFT, -0.1 * LEFT])
    middle = hip + 0.4 * DOWN
    low = middle + 0.4 * bent(knee)
    toe = low + 0.2 * bent(knee - ankle)
    return torch.cat([hip, middle, low, toe])[[0, 1, 2, 3, 4, 5, 6, 7]]


# ---------------------------------------------------------------------- the functions


@pytest.mark.parametrize("degrees", [0.0, 1e-6, 0.01, 30.0, 90.0, 135.0, 179.99, 180.0])
def test_known_angles(degrees):
    found = angle_between(3 * DOWN, 7 * bent(degrees))
    assert float(found.rad2deg()) == pytest.approx(degrees, rel=1e-9, abs=1e-12)
    assert float(flexion(DOWN, bent(degrees), LEFT).rad2deg()) == pytest.approx(degrees, rel=1e-9, abs=1e-12)


def test_small_angles_are_exact_in_single_precision():
    assert float(angle_between(DOWN.float(), bent(0.01).float()).rad2deg()) == pytest.approx(0.01, rel=1e-3)


def test_the_angle_of_a_bent_arm():
    arm = torch.tensor([[0.0, 0, 0], [0, 3, 0], [2, 3, 0], [2, 1, 0]])
    assert joint_angles(arm, [(0, 1, 2), (1, 2, 3), (0, 1, 3)]).rad2deg().tolist() == pytest.approx([90, 90, 135])
    assert joint_angles(arm[:, :2], torch.tensor([[0, 1, 2]])).rad2deg().tolist() == pytest.approx([90])  # in the plane
    assert joint_angles(arm, []).shape == (0,)


@pytest.mark.parametrize("joints", [[(0, 1)], torch.zeros(3, dtype=torch.long), torch.zeros(2, 4, dtype=torch.long)])
def test_joints_are_triples(joints):
    with pytest.raises(ShapeError, match=r"joints: expected shape \(J, 3\)"):
        joint_angles(normal(5, 3), joints)


def test_joints_of_a_list_are_those_of_the_points():
    with pytest.raises(ShapeError, match=r"joints: expected joint indices 0..4, got \(0, 1, 5\)"):
        joint_angles(torch.rand(4, 5, 3), [(0, 1, 5)])
    with pytest.raises(ShapeError, match=r"of indices \(parent, joint, child\), got a row \('a', 'b', 'c'\)"):
        joint_angles(torch.rand(4, 5, 3), [("a", "b", "c")])


@pytest.mark.parametrize("degrees", [5.0, 60.0, 150.0])
def test_sign_tells_the_way(degrees):
    assert float(flexion(DOWN, bent(degrees), LEFT)) > 0
    assert float(flexion(DOWN, bent(-degrees), LEFT).rad2deg()) == pytest.approx(-degrees)
    assert float(flexion(DOWN, bent(-degrees), -LEFT)) > 0
    assert float(flexion(DOWN, bent(-degrees)).rad2deg()) == pytest.approx(degrees)
    assert float(flexion(DOWN, bent(-degrees), 0 * LEFT).rad2deg()) == pytest.approx(degrees)


@pytest.mark.parametrize(("turn", "sign"), [(0, 1), (90, 1), (115, 1), (125, -1), (180, -1), (240.5, 1)])
def test_sideways_is_not_the_wrong_way(turn, sign):
    """The axis turned about the limb: only within 60 degrees of its reverse the joint is bent backwards."""
    angle = math.radians(turn)
    axis = torch.tensor([math.cos(angle), 0.0, math.sin(angle)], dtype=torch.float64)
    assert float(flexion(DOWN, bent(70), axis).sign()) == sign


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 10**6), st.floats(1e-3, 1e3))
def test_angles_depend_on_no_view_and_no_size(seed, size):
    upper, lower, axis = normal(3, 3, seed=seed).unbind(0)
    turn = rotations(seed=seed)
    expected = flexion(upper, lower, axis)
    assert_close(flexion(size * upper @ turn.mT, lower @ turn.mT, axis @ turn.mT), expected, rtol=1e-7, atol=1e-7)
    assert_close(flexion(upper, lower, -axis).abs(), expected.abs())
    cosine = (upper @ lower / upper.norm() / lower.norm()).clamp(-1, 1)
    assert_close(expected.abs(), cosine.acos(), rtol=1e-6, atol=1e-6)


def test_batches_are_loops():
    same_as_loop(lambda u, v, a: flexion(u, v, a), (4, 3), (4, 3), (4, 3))
    same_as_loop(lambda p: joint_angles(p, [(0, 1, 2), (3, 2, 1)]), (4, 3))
    leaves_arguments_alone(flexion, normal(4, 3), normal(4, 3, seed=1), normal(4, 3, seed=2))


@pytest.mark.parametrize("dtype", FLOATS)
@pytest.mark.parametrize("device", DEVICES)
def test_dtype_and_device_stay(dtype, device):
    points = normal(2, 4, 3, dtype=dtype, device=device)
    found = joint_angles(points, [(0, 1, 2)])
    assert found.dtype == dtype and found.device.type == device and found.shape == (2, 1)


def test_gradients():
    assert gradcheck(angle_between, normal(5, 3), normal(5, 3, seed=1))
    assert gradcheck(lambda p: joint_angles(p, [(0, 1, 2), (1, 2, 3)]), normal(3, 4, 3))
    assert gradcheck(flexion, normal(8, 3), normal(8, 3, seed=1), normal(8, 3, seed=2))


@pytest.mark.parametrize("dtype", FLOATS)
@pytest.mark.parametrize("size", [0.0, 1e-300, 1e-12])
def test_bones_without_length_have_no_angle_and_no_slope(dtype, size):
    zero = torch.full((3,), size, dtype=dtype)
    zero[1:] = 0
    good = bent(40).to(dtype)
    for upper, lower in ((zero, good), (good, zero), (zero, zero)):
        grads = finite(flexion, upper, lower, LEFT.to(dtype))
        if size == 0:
            assert float(flexion(upper, lower, LEFT.to(dtype))) == 0
            assert all(grad is None or not grad.any() for grad in grads)
    finite(lambda p: joint_angles(p, [(0, 1, 2)]), torch.zeros(3, 3, dtype=dtype))


def test_straight_and_folded_limbs_have_no_slope():
    for lower in (2 * DOWN, -2 * DOWN):
        assert not any(g.any() for g in finite(angle_between, DOWN, lower))


def test_what_is_not_finite_stays_visible():
    assert torch.isnan(angle_between(DOWN, torch.tensor([math.nan, 1.0, 0.0]).double()))


# ---------------------------------------------------------------------- results and motion


def test_hinges_bend_their_way():
    points = torch.stack([legs(knee) for knee in (0.0, 30.0, 90.0, -10.0)])
    found = angles_of(points, torch.ones(4, 8, dtype=torch.bool), BODY, None, fps=10.0)
    assert list(found.degrees) == ["l_knee", "l_ankle"] == list(found.signed)
    assert found.degrees["l_knee"].tolist() == pytest.approx([0, 30, 90, -10])
    assert found.degrees["l_ankle"].tolist() == pytest.approx([90, 90, 90, 90])
    assert found.deviation is None
    pointed = angles_of(legs(0.0, 20.0)[None], torch.ones(1, 8, dtype=torch.bool), BODY, "l_ankle")
    assert pointed.degrees["l_ankle"].tolist() == pytest.approx([20])


def test_a_walk_bends_its_knees_and_elbows():
    result = walk_result(30)
    found = result.angles()
    assert list(found.degrees) == ["left_elbow", "right_elbow", "left_knee", "right_knee"]
    assert found.signed == ("left_knee", "right_knee")  # nothing tells of an elbow which way it bends
    assert all(v.shape == (30,) and float(v.min()) > 0 for v in found.degrees.values())
    assert 50 < float(found.degrees["left_knee"].max()) < 80
    assert all(v.shape == (30,) and bool((v > 0).all()) for v in found.deviation.values())
    assert repr(found) == "JointAngles('walk.npz': 30 frames of left_elbow, right_elbow, left_knee, right_knee)"
    wrong = result.mirrored().angles()
    assert_close(wrong.degrees["left_knee"], -found.degrees["left_knee"])
    assert_close(wrong.degrees["left_elbow"], found.degrees["left_elbow"])


def test_motion_bends_as_its_result_does():
    result = walk_result(9)
    found, motion = result.angles(), kt.Motion.of(result).angles()
    assert motion.deviation is None and motion.signed == found.signed and motion.fps == 25
    for name, values in found.degrees.items():
        assert_close(motion.degrees[name], values)


def test_size_does_not_matter():
    found, scaled = walk_result(5).angles(), walk_result(5).scaled(units="m", factor=1e-3).angles()
    for name, values in found.degrees.items():
        assert_close(scaled.degrees[name], values)
        assert_close(scaled.deviation[name], found.deviation[name])


def test_unseen_joints_have_no_angle_and_axes_never_seen_no_sign():
    motion = walking_motion(6)
    mirrored = replace(motion, points=motion.points * motion.points.new_tensor([1.0, 1.0, -1.0]))
    weights = motion.weights.clone()
    weights[1, motion.skeleton.index("left_knee")] = 0
    weights[2, motion.skeleton.index("right_hip")] = 0
    found = replace(mirrored, weights=weights).angles("left_knee").degrees["left_knee"]
    assert found.isnan().tolist() == [False, True, False, False, False, False]
    assert (found > 0).tolist() == [False] * 6  # the hips in the frames beside tell the sign
    weights[:, motion.skeleton.index("right_hip")] = 0
    found = replace(mirrored, weights=weights).angles("left_knee").degrees["left_knee"]
    assert (found > 0).tolist() == [True, False, True, True, True, True]


def test_one_frame():
    found = walk_result(1).angles()
    assert found.degrees["left_knee"].shape == found.deviation["left_knee"].shape == (1,)


def test_coinciding_joints_are_straight():
    result = walk_result(4)
    points = result.points.clone()
    points[:, result.skeleton.index("left_ankle")] = points[:, result.skeleton.index("left_knee")]
    found = replace(result, points=points).angles("left_knee")
    assert found.degrees["left_knee"].tolist() == [0] * 4
    assert found.deviation["left_knee"].isfinite().all()


def test_any_joint_may_be_named_in_any_spelling():
    result = walk_result(5)
    found = result.angles(["LKnee", ("Neck", "left_hip", "LKnee"), ("left_hip", "left_knee", "left_ankle")])
    assert list(found.degrees) == ["left_knee", "neck-left_hip-left_knee", "left_hip-left_knee-left_ankle"]
    assert found.signed == ("left_knee",)
    assert_close(found.degrees["left_hip-left_knee-left_ankle"], found.degrees["left_knee"])  # which bends its way
    wrong = result.mirrored().angles([("left_hip", "left_knee", "left_ankle")])
    assert float(wrong.degrees["left_hip-left_knee-left_ankle"].min()) > 0
    index = [[result.skeleton.index(j) for j in ("neck", "left_hip", "left_knee")]]
    expected = joint_angles(result.points, index)[:, 0].rad2deg()
    assert_close(found.degrees["neck-left_hip-left_knee"], expected)


def test_two_hinges_at_one_joint_have_names_of_their_own():
    more = (*BODY.hinges, Hinge(4, 2, 0, left=0, right=1, sign=-1.0))
    found = angles_of(legs(30)[None], torch.ones(1, 8, dtype=torch.bool), replace(BODY, hinges=more), "l_knee")
    assert list(found.degrees) == ["l_hip-l_knee-l_ankle", "l_ankle-l_knee-l_hip"]
    assert [float(v) for v in found.degrees.values()] == pytest.approx([30, 30])


@pytest.mark.parametrize(
    ("joints", "error", "match"),
    [
        ("left_hip", OptionError, r"'left_hip' is no hinge of skeleton 'coco17' \(left_elbow, .*left_hip.*--joint "),
        (["left_hp"], SkeletonError, "angles: unknown joint .* 'left_hp': did you mean 'left_hip'"),
        ([("neck", "left_hip")], OptionError, r"three names \(parent, joint, child\), got \('neck', 'left_hip'\)"),
        ([("neck", "left_hip", 3)], OptionError, "three names"),
        ([7], OptionError, "expected the name of a hinge or three names"),
        ([("neck", "left_hip", "neck")], OptionError, "three different joints .* got neck, left_hip, neck"),
        ([], OptionError, "at least one joint"),
    ],
)
def test_wrong_joints_are_told(joints, error, match):
    with pytest.raises(error, match=match):
        walk_result(3).angles(joints)


def test_a_skeleton_without_hinges_needs_names():
    body = kt.Skeleton.from_names(list("abc"), [("a", "b"), ("b", "c")], name="chain")
    motion = kt.Motion.from_arrays(normal(4, 3, 3), skeleton=body)
    told = r"skeleton 'chain' has no hinges: give one that has .* or name three joints, such as .*--joint a,b,c"
    with pytest.raises(OptionError, match=told):
        motion.angles()
    assert list(motion.angles([("a", "b", "c")]).degrees) == ["a-b-c"]


def test_gradients_pass_through_a_result():
    result = walk_result(4)
    points = result.points.clone().requires_grad_()
    replace(result, points=points).angles().degrees["left_knee"].sum().backward()
    assert points.grad.isfinite().all() and bool(points.grad.any())


@pytest.mark.parametrize("yaw", [0.0, 45.0, 90.0])
def test_deviations_are_those_of_random_depths(yaw):
    """Also in a gait seen from the side, where knees bend in the image and the first order tells a tenth of it."""
    clip = kt.data.walking_person(12, skeleton="coco17", turn=0.0, yaw=yaw, dtype=torch.float64)
    points, body = clip.points, clip.tracks.skeleton
    spread = torch.linspace(20.0, 35.0, points[..., 0].numel(), dtype=torch.float64).reshape(points.shape[:2])
    seen = torch.ones_like(spread, dtype=torch.bool)
    asked = [("left_hip", "left_knee", "left_ankle"), ("left_shoulder", "left_elbow", "left_wrist")]
    found = angles_of(points, seen, body, asked, uncertainty=spread)
    draws = 4000
    moved = points.expand(draws, *points.shape).clone()
    moved[..., 2] += spread * normal(draws, *spread.shape, seed=3)
    each = angles_of(moved.flatten(0, 1), seen.repeat(draws, 1), body, asked)
    for name, values in found.degrees.items():
        truth = (each.degrees[name].reshape(draws, -1) - values).square().mean(0).sqrt()
        assert_close(found.deviation[name], truth, rtol=0.1, atol=0.0)


def test_where_depth_matters_little_deviations_are_the_first_order():
    result = walk_result(6)
    points = result.points.clone().requires_grad_()
    name = "left_hip-left_knee-left_ankle"
    asked = [tuple(name.split("-"))]
    spread = torch.full_like(result.points[..., 0], 0.1)
    found = replace(result, points=points, uncertainty=spread).angles(asked)
    (slope,) = torch.autograd.grad(found.degrees[name].sum(), points)
    assert_close(found.deviation[name], 0.1 * slope[..., 2].norm(dim=-1), rtol=1e-3, atol=1e-4)


def test_results_without_uncertainty_have_no_deviations():
    assert walk_result(4, uncertain=False).angles().deviation is None
