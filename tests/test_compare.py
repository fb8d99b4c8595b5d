"""Comparing motion: joints by name, frames by number or time, units, roots, mirrors."""

import math
from dataclasses import replace

import pytest
import torch
from samples import walk_result, walking_motion

import kcs_torch as kt
from kcs_torch.errors import OptionError, ShapeError, SkeletonError
from kcs_torch.metrics import ALIGNMENTS, compare, e3d, mpjpe, pck
from kcs_torch.types import Motion


def noisy(motion, size=0.05, seed=0):
    noise = torch.randn(motion.points.shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    return replace(motion, points=motion.points + size * noise)


def test_figures_are_those_of_the_functions():
    truth = walking_motion(20)
    pred = noisy(truth)
    found = compare(pred, truth)
    root = truth.skeleton.index("pelvis")
    assert set(found.mpjpe) == set(ALIGNMENTS) - {"none"}
    for how, error in found.mpjpe.items():
        assert error == pytest.approx(float(mpjpe(pred.points, truth.points, align=how, root=root)))
        assert found.pck[how] == pytest.approx(float(pck(pred.points, truth.points, 0.15, align=how, root=root)))
    assert found.e3d == pytest.approx(float(e3d(pred.points, truth.points)))
    assert found.bone_deviation > 0.01 > found.bone_deviation_truth
    assert (found.frames, found.units, found.root, found.pck_within) == (20, "m", "pelvis", 0.15)
    assert found.notes == ()
    for align in (["none"], "none"):
        assert compare(pred, truth, align=align).mpjpe == {
            "none": pytest.approx(float(mpjpe(pred.points, truth.points, align="none")))
        }


def test_a_wrong_unit_is_asked_about():
    truth = walking_motion(20)
    small = replace(truth, points=truth.points / 1000)
    assert compare(small, truth).notes == ("the prediction is 0.001 times as large as the truth: is 'm' its unit?",)
    assert "1e+03 times" in compare(truth, small).notes[0]
    for unit in ("mm", ""):  # as it is, and where no size is known
        assert compare(replace(truth, points=1000 * truth.points, units=unit), truth).notes == ()


def test_joints_are_matched_by_name_and_not_by_order():
    truth = walking_motion(20, "h36m17")
    names = ["LKnee", "r_wrist", "Head Top", "leftElbow", "RAnkle", "tail"]
    same = ["left_knee", "right_wrist", "head", "left_elbow", "right_ankle"]
    theirs = ["left_knee", "right_wrist", "left_elbow", "right_ankle"]
    points = torch.stack([truth.points[:, truth.skeleton.index(n)] for n in [*same, "pelvis"]], 1)
    points[:, 5] = 1e3  # a tail
    found = compare(Motion.from_arrays(points, joint_names=names, fps=25, units="m"), truth, align=["none"])
    pairs = dict(found.joints)
    assert {pairs[n] for n in ("LKnee", "r_wrist", "leftElbow", "RAnkle")} == set(theirs)
    assert "tail" not in pairs
    assert found.mpjpe["none"] == pytest.approx(0, abs=1e-9)
    assert any("only in motion: " in note and "tail" in note for note in found.notes)
    assert found.root is None  # no pelvis is among them


def test_a_result_is_no_motion():
    result = walk_result(12)
    told = r"compare: {}: expected Motion, got Reconstruction; Motion.of\(result\) makes it of a result"
    with pytest.raises(OptionError, match=told.format("pred")):
        compare(result, Motion.of(result))
    with pytest.raises(OptionError, match=told.format("truth")):
        compare(Motion.of(result), result)


def test_fewer_than_three_joints_are_no_comparison():
    other = Motion.from_arrays(torch.randn(12, 4, 3), joint_names=["tail", "fin", "gill", "nose"], units="m")
    with pytest.raises(
        SkeletonError, match="at least 3 joints that mean the same by their names, got 1: motion has tail"
    ):
        compare(other, walking_motion())


def test_units_are_brought_together():
    truth = walking_motion(20)
    large = noisy(truth).scaled(units="mm", factor=1000)
    assert compare(large, truth).mpjpe == pytest.approx(compare(noisy(truth), truth).mpjpe)
    millimetres = compare(noisy(truth), truth.scaled(units="mm", factor=1000))
    assert millimetres.mpjpe["root"] == pytest.approx(1000 * compare(noisy(truth), truth).mpjpe["root"])
    assert millimetres.pck_within == 150


def test_an_unknown_size_leaves_alignments_with_a_scale():
    truth = walking_motion(20)
    pixels = replace(noisy(truth), points=300 * noisy(truth).points, units="px")
    found = compare(pixels, truth)
    assert set(found.mpjpe) == {"scale", "similarity", "sequence"}
    assert found.mpjpe == pytest.approx(
        {k: v for k, v in compare(noisy(truth), truth).mpjpe.items() if k in found.mpjpe}
    )
    assert math.isnan(found.e3d)
    with pytest.raises(
        OptionError, match="alignment 'rigid' keeps sizes, but the prediction is in px and the truth in m"
    ):
        compare(pixels, truth, align=["rigid"])
    both = compare(pixels, replace(truth, units="px"))
    assert "root" in both.mpjpe  # the same unit, whatever it is
    assert both.pck == {}
    assert set(compare(pixels, replace(truth, units="px"), within=2.0).pck) == set(both.mpjpe)


def test_frames_by_time():
    truth = walking_motion(41)
    found = compare(truth.frames(0, 41, 2), truth, align=["none"])
    assert (found.frames, found.mpjpe["none"]) == (21, 0)
    assert any("every 2 frames of walk.npz are compared" in note for note in found.notes)
    assert compare(truth, truth.frames(0, 41, 4), align=["none"]).mpjpe["none"] == 0
    with pytest.raises(ShapeError, match="have the same rate, got 41 in walk.npz and 30 in walk.npz"):
        compare(truth, truth.frames(0, 30))
    with pytest.raises(ShapeError, match="an unknown rate"):
        compare(replace(truth, fps=None), truth.frames(0, 20))
    with pytest.raises(ShapeError, match="multiples of each other"):
        compare(replace(truth, fps=37), truth.frames(0, 28))
    found = compare(replace(truth, fps=50), truth, align=["none"])
    assert any("compared by number, though at 50 and 25" in note for note in found.notes)


def test_mirrors_are_told_and_only_scored_if_asked():
    truth = walking_motion(20)
    flipped = replace(truth, points=truth.points * torch.tensor([1.0, 1.0, -1.0]))
    found = compare(flipped, truth)
    assert found.mpjpe["rigid"] > 0.01
    assert found.mirrored["rigid"] == pytest.approx(0, abs=1e-9)
    assert compare(flipped, truth, mirror=True).mpjpe == found.mirrored
    assert compare(flipped, truth, mirror=True).mirrored == found.mpjpe


def test_what_is_not_seen_does_not_count():
    truth = walking_motion(20)
    pred = noisy(truth)
    weights = truth.weights.clone()
    weights[:, 3] = 0
    weights[5] = 0
    hidden = replace(truth, weights=weights, points=truth.points * weights[..., None])
    expected = float(mpjpe(pred.points, truth.points, align="similarity", weights=weights))
    assert compare(pred, hidden).mpjpe["similarity"] == pytest.approx(expected)
    back = compare(replace(pred, weights=weights, points=pred.points * weights[..., None]), truth)
    assert back.mpjpe["similarity"] == pytest.approx(expected)
    assert any("of the prediction's joints are missing" in note for note in back.notes)
    with pytest.raises(ShapeError, match="a frame in which 3 joints of both are seen"):
        compare(pred, replace(truth, weights=torch.zeros_like(weights)))


def test_frames_of_fewer_than_three_joints_do_not_count():
    """A similarity takes two joints onto any others."""
    truth = walking_motion(20)
    pred = noisy(truth)
    weights = truth.weights.clone()
    weights[:10, 2:] = 0
    few = compare(pred, replace(truth, weights=weights, points=truth.points * weights[..., None]))
    full = compare(pred.frames(10, 20), truth.frames(10, 20))
    assert few.frames == 10 and few.mpjpe == pytest.approx(full.mpjpe) and few.e3d == pytest.approx(full.e3d)
    assert "10 of 20 frames, in which fewer than 3 joints of both are seen: not compared" in few.notes


def without_pelvis(motion, frames=slice(None)):
    weights = motion.weights.clone()
    weights[frames, motion.skeleton.index("pelvis")] = 0
    return replace(motion, weights=weights, points=motion.points * weights[..., None])


def test_a_pelvis_that_is_never_seen_is_no_root():
    truth = walking_motion(20)
    found = compare(noisy(truth), without_pelvis(truth))
    assert found.root is None and all(map(math.isfinite, (*found.mpjpe.values(), *found.pck.values())))
    named = compare(noisy(truth), without_pelvis(truth), root="pelvis")
    assert math.isnan(named.mpjpe["root"]) and math.isfinite(named.mpjpe["rigid"])
    said = "the root pelvis is not seen in 20 of 20 compared frames, which do not count for root and scale"
    assert named.notes == (said,)


def test_frames_without_the_root_are_told():
    truth = walking_motion(20)
    hidden = without_pelvis(truth, slice(0, 5))
    found = compare(noisy(truth), hidden)
    assert found.root == "pelvis" and "pelvis is not seen in 5 of 20 compared frames" in found.notes[0]
    assert found.mpjpe["root"] == pytest.approx(compare(noisy(truth).frames(5, 20), truth.frames(5, 20)).mpjpe["root"])
    assert compare(noisy(truth), hidden, align="rigid").notes == ()


def test_a_pelvis_that_is_seldom_seen_is_no_root():
    truth = walking_motion(20)
    assert compare(noisy(truth), without_pelvis(truth, slice(0, 10))).root == "pelvis"
    assert compare(noisy(truth), without_pelvis(truth, slice(0, 11))).root is None
    weights = truth.weights.clone()
    weights[5:] = 0  # frames that are not compared say nothing of it
    assert compare(noisy(truth), replace(truth, weights=weights)).root == "pelvis"


def test_roots_by_name():
    truth = walking_motion(20)
    found = compare(noisy(truth), truth, align=["root"], root="nose")
    at = truth.skeleton.index("nose")
    assert found.root == "nose"
    assert found.mpjpe["root"] == pytest.approx(float(mpjpe(noisy(truth).points, truth.points, root=at)))
    with pytest.raises(SkeletonError, match="did you mean 'nose'"):
        compare(truth, truth, root="nos")
    with pytest.raises(OptionError, match="did you mean 'sequence'"):
        compare(truth, truth, align=["sequense"])


def test_against_the_protocol_on_a_lifted_walk(protocol, shared):
    """The whole way: a clip of the benchmark, lifted; our figures are those of the protocol."""
    case = {"src": "cmu/cmu_35_01", "yaw": 45, "pitch": 10, "orbit": 90, "max_frames": 30}
    given, truth = protocol.build(shared / "data", case)
    tracks = kt.types.Tracks.from_arrays(
        given["points2d"], edges=given["edges"], joint_names=given["joint_names"], fps=given["fps"], units="mm"
    )
    result = kt.reconstruct(tracks, method="kcs")
    expected = protocol.score(result.observed.numpy(), truth["points3d"], truth["edges"])
    body = tracks.skeleton
    true = Motion.from_arrays(truth["points3d"], up="-y", skeleton=body, fps=given["fps"], units="mm")
    found = compare(Motion.of(result), true)
    if found.mirrored["rigid"] < found.mpjpe["rigid"]:  # the protocol takes the better one
        found = compare(Motion.of(result), true, mirror=True)
    assert found.mpjpe["rigid"] == pytest.approx(expected["rigid"], rel=1e-5)
    assert found.mpjpe["similarity"] == pytest.approx(expected["pa"], rel=1e-5)
    assert found.mpjpe["sequence"] == pytest.approx(expected["seq_pa"], rel=1e-5)
    assert found.e3d == pytest.approx(expected["e3d"], rel=1e-5)


@pytest.mark.parametrize(("align", "what"), [(3, "3"), ([3], "3"), ([["root"]], r"\['root'\]")])
def test_alignments_that_are_no_names_are_told(align, what):
    with pytest.raises(OptionError, match=f"unknown alignment {what}"):
        compare(walking_motion(), walking_motion(), align=align)


def test_alignments_may_come_one_by_one():
    truth = walking_motion()
    assert list(compare(truth, truth, align=iter(("rigid", "root"))).mpjpe) == ["rigid", "root"]
