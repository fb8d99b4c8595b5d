"""How much bones vary: the figure of the median bone hides one that does not keep its length."""

import json
import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from samples import walk_result, walking_motion
from typer.testing import CliRunner

import kcs_torch as kt
from kcs_torch.cli import app
from kcs_torch.cli.report import describe, summary
from kcs_torch.functional import bone_lengths
from kcs_torch.io import load_reconstruction
from kcs_torch.io.formats.pages import as_result
from kcs_torch.types.variation import BoneVariation, bone_shares, bone_variation
from kcs_torch.viewer.summary import summarise

BODY = kt.Skeleton.from_names(
    ["a", "b", "c", "d", "e"], [("a", "b"), ("b", "c"), ("c", "d"), ("d", "e")], flexible=[("d", "e")]
)
WORDS = "0.05 % (median), at most 3.95 % (Neck-UpperNeck)"


def told_of(result):
    """The same result whose diagnostics tell the fresh user's figures."""
    facts = replace(result.diagnostics, bone_variation=0.05, largest_bone_variation=3.95, loosest_bone="Neck-UpperNeck")
    return replace(result, diagnostics=facts)


def test_the_worst_rigid_bone_is_named():
    lengths = torch.tensor([[1.0, 2.0, 9.0, 1.0], [1.0, 2.02, 11.0, 5.0]], dtype=torch.float64)
    found = bone_variation(lengths, BODY)  # d-e may stretch
    assert found.median == pytest.approx(100 * 0.01 / 2.01)
    assert found.largest == pytest.approx(10)
    assert found.bone == "c-d"


def test_unseen_bones_and_bones_of_no_length_are_no_news():
    nan = math.nan
    lengths = torch.tensor([[nan, 0.0, 9.0, 1.0], [nan, 0.0, nan, 1.0], [nan, 0.0, 11.0, 1.0]])
    assert bone_shares(lengths).tolist() == pytest.approx([nan, 0, 0.1, 0], nan_ok=True)
    found = bone_variation(lengths, BODY)
    assert (found.bone, found.median) == ("c-d", 0)
    nothing = bone_variation(torch.full((3, 4), nan), BODY)
    assert math.isnan(nothing.median) and math.isnan(nothing.largest) and nothing.bone == ""
    assert bone_variation(torch.ones(1, 4), BODY) == (0, 0, "a-b")


@pytest.mark.filterwarnings("ignore::kcs_torch.KcsWarning")
def test_bones_between_joints_that_nobody_saw_do_not_count():
    """Their places are made up, and so is how far they are from each other."""
    links = kt.Skeleton.from_names(
        list("abcdefg"), [(p, q) for p, q in zip("abdef", "bcefg", strict=True)], tree=False
    )  # the second piece is never seen
    points = kt.data.random_motion(BODY, 30, turn=120, generator=torch.Generator().manual_seed(0)).tracks.points
    points = torch.cat([points[:, :3], torch.full_like(points[:, :4], math.nan)], 1)
    found = kt.reconstruct(points, skeleton=links, method="pkc")
    lengths = bone_lengths(found.points, links.bone_index())
    expected = bone_variation(lengths[:, :2], kt.Skeleton.from_names(list("abc"), [("a", "b"), ("b", "c")]))
    assert found.diagnostics.variation == expected == found.remeasured().diagnostics.variation


@pytest.mark.parametrize("method", ["pkc", "sfam"])
@pytest.mark.filterwarnings("ignore::kcs_torch.KcsWarning")
def test_a_joint_that_nobody_saw_has_no_bone_that_varies(method):
    """It lies on its neighbour, and rounding is all that the bone's length is."""
    motion = kt.data.random_motion(BODY, 40, turn=120, generator=torch.Generator().manual_seed(0))
    points = motion.tracks.points.clone()
    points[:, 0] = math.nan
    found = kt.reconstruct(points, skeleton=BODY, method=method)
    assert float(found.lengths[0]) < 1e-6 * float(found.lengths.max())
    assert found.diagnostics.loosest_bone != "a-b" and found.diagnostics.largest_bone_variation < 20


def test_a_skeleton_without_rigid_bones_has_none():
    loose = kt.Skeleton.from_names(["a", "b"], [("a", "b")], flexible=[("a", "b")])
    assert bone_variation(torch.ones(3, 1), loose).bone == ""


@pytest.mark.parametrize("options", [{}, {"intrinsics": (1500, 1500, 960, 540)}], ids=["parallel", "pinhole"])
@pytest.mark.filterwarnings("ignore::kcs_torch.KcsWarning")
def test_results_tell_their_worst_bone(options):
    tracks = kt.data.walking_person(20, skeleton="coco17").tracks
    tracks = replace(tracks, points=tracks.points + 900)
    found = kt.reconstruct(tracks, method="kcs", **options)
    expected = bone_variation(bone_lengths(found.points, found.skeleton.bone_index()), found.skeleton)
    assert found.diagnostics.variation == pytest.approx(expected)
    assert found.diagnostics.largest_bone_variation >= found.diagnostics.bone_variation
    late = kt.clean.smooth(found, cutoff=3.0, fps=30)
    expected = bone_variation(bone_lengths(late.points, late.skeleton.bone_index()), late.skeleton)
    assert late.diagnostics.variation == pytest.approx(expected)


def test_motion_tells_it_of_the_frames_that_show_a_bone():
    motion = walking_motion()
    wrist = motion.skeleton.index("left_wrist")
    points = motion.points.clone()
    points[3:, wrist] += 0.1 * torch.arange(9)[:, None]
    moved = replace(motion, points=points)
    assert moved.variation.bone == "left_elbow-left_wrist" and moved.variation.largest > 5
    weights = motion.weights.clone()
    weights[3:, wrist] = 0
    assert replace(moved, weights=weights).variation.largest < 0.1
    assert as_result(moved).diagnostics.variation == moved.variation


def test_wherever_it_is_told_the_worst_bone_is():
    result = told_of(walk_result())
    assert WORDS in repr(result)
    assert f"bone variation {WORDS}" in summarise(result)
    facts = summary(result)
    assert (facts["bone_variation"], facts["largest_bone_variation"]) == (0.05, 3.95)
    assert facts["loosest_bone"] == "Neck-UpperNeck"
    assert f"bone variation  {WORDS}\n" in describe(facts)
    assert "unknown: no bones" in describe(summary(walk_result()))
    told = {**facts, "notes": ["tracks smoothed", "a focal length, a guess", "3 people found"]}
    notes = [line for line in describe(told).splitlines() if "note:" in line]
    assert [note.strip() for note in notes] == [
        "note: a focal length, a guess", "note: tracks smoothed", "note: 3 people found"
    ]  # fmt: skip


def test_score_tells_the_worst_bone(tmp_path):
    motion = walking_motion()
    points = motion.points.clone()
    points[::2, motion.skeleton.index("left_wrist")] += 0.05
    loose = replace(motion, points=points)
    kt.save(loose, tmp_path / "pred.npz")
    kt.save(motion, tmp_path / "truth.npz")
    done = CliRunner().invoke(app, ["score", str(tmp_path / "pred.npz"), str(tmp_path / "truth.npz")])
    variation = loose.variation
    assert variation.largest > 1 and variation.bone == "left_elbow-left_wrist"
    line = next(line for line in done.stdout.splitlines() if line.startswith("bone deviation"))
    assert line.endswith(f"{variation}; truth: 0.00 %")
    found = kt.metrics.compare(loose, motion)
    assert (100 * found.largest_deviation, found.loosest_bone) == (pytest.approx(variation.largest), variation.bone)


def test_files_keep_it_and_older_ones_lack_it(tmp_path):
    path = kt.save(told_of(walk_result()), tmp_path / "new.npz")
    assert str(load_reconstruction(path).diagnostics.variation) == WORDS
    arrays = dict(np.load(path))
    facts = json.loads(str(arrays["diagnostics"]))
    del facts["largest_bone_variation"], facts["loosest_bone"]
    np.savez(tmp_path / "old.npz", **arrays | {"diagnostics": np.array(json.dumps(facts))})
    old = load_reconstruction(tmp_path / "old.npz")
    assert math.isnan(old.diagnostics.largest_bone_variation) and old.diagnostics.loosest_bone == ""
    assert str(old.diagnostics.variation) == "0.05 % (median)" == str(BoneVariation(0.05))
    assert "nan" not in str(BoneVariation())
    assert "bone variation  0.05 % (median)\n" in describe(summary(old))
