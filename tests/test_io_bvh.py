"""BVH files: real ones and ours, both against an independent reader; by hand; and damaged ones."""

import random
import re
import warnings
from dataclasses import replace

import numpy as np
import pybvh
import pytest
import torch
from samples import walk_result, walking_motion

import kcs_torch as kt
from kcs_torch.errors import FormatError, OutputError
from kcs_torch.io import load_motion, save
from kcs_torch.types import Motion

TEXT = """HIERARCHY
ROOT Hips
{
  OFFSET 0 0 0
  CHANNELS 6 Xposition Yposition Zposition Zrotation Xrotation Yrotation
  JOINT Leg
  {
    OFFSET 0 -2 0
    CHANNELS 3 Zrotation Xrotation Yrotation
    End Site
    {
      OFFSET 0 -1 0
    }
  }
}
MOTION
Frames: 2
Frame Time: 0.04
1 2 3 0 0 0 0 0 0
0 0 0 90 0 0 0 90 0
"""


def write(folder, text):
    path = folder / "x.bvh"
    path.write_text(text)
    return path


def theirs(path, joints):
    """Joints (T, N, 3) by the independent reader."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # it guesses which way is up, which is not asked here
        file = pybvh.read_bvh_file(path)
    names = [node.name for node in file.nodes]
    return file.node_positions()[:, [names.index(j.removesuffix("_end")) + j.endswith("_end") for j in joints]]


# ---------------------------------------------------------------------- reading


def test_units_that_the_user_says_may_be_written_out(tmp_path):
    motion = load_motion(write(tmp_path, TEXT), units="centimeters")
    assert motion.units == "cm"


def test_by_hand(tmp_path):
    motion = load_motion(write(tmp_path, TEXT), units="cm")
    assert motion.skeleton.joints == ("Hips", "Leg", "Leg_end")
    assert motion.skeleton.bones == ((0, 1), (1, 2))
    assert (motion.fps, motion.units) == (25, "cm")
    # Then the hips turn by 90 degrees about z: the leg lies along +x. Its own turn about x (now y) takes it to -z.
    expected = torch.tensor([[[1, 2, 3], [1, 0, 3], [1, -1, 3]], [[0, 0, 0], [2, 0, 0], [2, 0, -1]]]).double()
    assert torch.allclose(motion.points, expected, atol=1e-12)
    assert torch.allclose(load_motion(tmp_path / "x.bvh", up="z").points[0, 0], torch.tensor([1.0, 3, -2]).double())


def test_spellings_of_others(tmp_path):
    expected = load_motion(write(tmp_path, TEXT)).points
    for text in (
        TEXT.replace("\n  {", " {").replace("\n{", "{"),
        TEXT.replace("\n", "\r\n").replace("  ", "\t"),
        TEXT.replace("Frames:", "frames:").replace("rotation", "ROTATION"),
        "\ufeff" + TEXT + "\n\n",
        TEXT.replace("0 0 0 90", "0 0 0 9e1"),
    ):
        assert torch.equal(load_motion(write(tmp_path, text)).points, expected)


def test_positions_of_inner_joints(tmp_path):
    text = TEXT.replace("CHANNELS 3 Z", "CHANNELS 6 Xposition Yposition Zposition Z")
    text = text.replace("0 0 0 0 0 0\n", "0 0 0 5 -2 0 0 0 0\n").replace("0 90 0\n", "0 -2 0 0 90 0\n")
    points = load_motion(write(tmp_path, text)).points
    assert torch.allclose(points[0, 1] - points[0, 0], torch.tensor([5.0, -2, 0]).double())
    assert torch.allclose(points[1, 1] - points[1, 0], torch.tensor([2.0, 0, 0]).double())


def test_joints_on_their_parents_are_left_out(tmp_path):
    inner = "JOINT Leg\n{\nOFFSET 0 -2 0\nCHANNELS 3 Zrotation Xrotation Yrotation\nEnd Site\n{\nOFFSET 0 -1 0\n}\n}"
    text = TEXT[: TEXT.index("JOINT")] + "JOINT Extra\n{\nOFFSET 0 0 0\nCHANNELS 3 Zrotation Xrotation Yrotation\n"
    text += (
        inner + "\n}\n" + TEXT[TEXT.rindex("}") :].replace("1 2 3 ", "1 2 3 0 0 0 ").replace("90 0 0 ", "0 0 0 90 0 0 ")
    )
    motion = load_motion(write(tmp_path, text))
    assert motion.skeleton.joints == ("Hips", "Leg", "Leg_end")
    assert torch.allclose(motion.points, load_motion(write(tmp_path, TEXT)).points)
    assert "left out because they lie on their parent: Extra" in motion.notes


def test_a_frame_that_takes_no_time_is_told(tmp_path):
    for seconds in ("0", "-1", "1e+30"):
        motion = load_motion(write(tmp_path, TEXT.replace("Frame Time: 0.04", f"Frame Time: {seconds}")))
        assert motion.fps is None and f"Frame Time is {seconds} seconds: the frame rate is unknown" in motion.notes


def test_names_are_made_to_differ(tmp_path):
    assert load_motion(write(tmp_path, TEXT.replace("Leg", "Hips"))).skeleton.joints == ("Hips", "Hips_2", "Hips_end")


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("OFFSET 0 -2 0", "OFFSET 0 -2", "line 8: OFFSET: expected 3 numbers, got 2"),
        ("OFFSET 0 -2 0", "OFFSET 0 two 0", "line 8: expected numbers, got 'two'"),
        ("    OFFSET 0 -2 0\n", "", "line 6: 'Leg': expected an OFFSET"),
        ("CHANNELS 3", "CHANNELS 4", "line 9: CHANNELS: expected their count"),
        ("CHANNELS 3 Zrotation", "CHANNELS 3 Wrotation", "line 9: CHANNELS: expected Xposition"),
        ("CHANNELS 3 Zrotation", "CHANNELS 3 Xrotation", "line 9: CHANNELS: expected different ones"),
        ("JOINT Leg", "ROOT Leg", "line 6: expected joints in braces"),
        ("JOINT Leg", "BONE Leg", "line 6: expected joints in braces"),
        ("MOTION", "ROOT Second\n{\n}\nMOTION", "line 16: expected one ROOT"),
        ("MOTION", "", "line 17: expected joints in braces"),
        ("Frame Time: 0.04", "", "line 19: expected Frames: and Frame Time:"),
        ("0 0 0 90 0 0 0 90 0", "0 0 0 90 0 0 0 90", "line 20: expected 9 numbers, one a channel, got 8"),
        ("0 0 0 90 0 0 0 90 0", "0 0 0 90 0 0 0 nan 0", "line 20: expected numbers, got 'nan'"),
        (TEXT[TEXT.index("1 2 3") :], "", "expected a line a frame below Frame Time"),
        (TEXT[TEXT.index("MOTION") :], "", "expected MOTION after the joints"),
    ],
)
def test_damage_is_named(tmp_path, old, new, message):
    with pytest.raises(FormatError, match=f"x.bvh: .*{message}"):
        load_motion(write(tmp_path, TEXT.replace(old, new)))


def test_the_header_is_not_believed(tmp_path):
    motion = load_motion(write(tmp_path, TEXT.replace("Frames: 2", "Frames: 999999999")))
    assert motion.num_frames == 2
    assert "the header tells 999999999 frames, the file has 2" in motion.notes
    assert load_motion(write(tmp_path, TEXT.replace("0.04", "0"))).fps is None


def test_deep_chains_are_no_trouble(tmp_path):
    deep = 3000
    text = "HIERARCHY\nROOT a\n{\nOFFSET 0 0 0\nCHANNELS 3 Xposition Yposition Zposition\n"
    text += "".join(f"JOINT j{i}\n{{\nOFFSET 0 1 0\nCHANNELS 1 Xrotation\n" for i in range(deep)) + "}\n" * (deep + 1)
    text += "MOTION\nFrames: 1\nFrame Time: 0.1\n" + " ".join(["0"] * (deep + 3))
    assert float(load_motion(write(tmp_path, text)).points[0, -1, 1]) == deep
    with pytest.raises(FormatError, match="expected up to 10000 joints"):
        load_motion(write(tmp_path, "HIERARCHY\nROOT a\n{\n" + "JOINT b\n{\n" * 10_001))


@pytest.mark.parametrize("name", ["fair1_dab", "test_freebvh", "test_mocapbank"])
def test_real_files_as_an_independent_reader_has_them(shared, name):
    path = shared / "data" / "raw_formats" / "bvh" / f"{name}.bvh"
    motion = load_motion(path)
    spelt = [f"EndSite{j}" if j.endswith("_end") else j for j in motion.skeleton.joints]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        file = pybvh.read_bvh_file(path)
    names = [node.name for node in file.nodes]
    expected = file.node_positions()[:, [names.index(j.removesuffix("_end")) for j in spelt]]
    assert np.abs(motion.points.numpy() - expected).max() < 1e-9
    assert motion.fps == pytest.approx(30, abs=0.01)
    assert any("longest along z" in note for note in motion.notes) == (name == "fair1_dab")


def test_mutated_files_end_in_our_errors(tmp_path):
    read = 0
    for seed in range(300):
        pick = random.Random(seed)
        letters = list(TEXT)
        for _ in range(pick.choice([1, 2, 8])):
            at = pick.randrange(len(letters))
            junk = ["", "\n", "x", "nan", "1e999", "-", "{", "}", "JOINT a", "End Site", "9"]
            letters[at : at + pick.choice([0, 1, 30])] = pick.choice(junk)
        try:
            assert load_motion(write(tmp_path, "".join(letters)), format="bvh").points.isfinite().all()
            read += 1
        except kt.KcsError as error:
            assert "x.bvh" in str(error)
    assert 0 < read < 300


# ---------------------------------------------------------------------- writing


@pytest.mark.parametrize("skeleton", ["coco17", "h36m17", "body25", "cmu31"])
@pytest.mark.parametrize("up", ["y", "z"])
def test_ours_is_within_a_millimetre_as_an_independent_reader_has_it(tmp_path, skeleton, up):
    motion = walking_motion(30, skeleton)
    notes: list[str] = []
    path = save(motion, tmp_path / "w.bvh", up=up, notes=notes)
    found = theirs(path, motion.skeleton.joints) / 100  # it is in centimetres
    expected = kt.types.axes.from_y_up(motion.points, up).numpy()
    assert np.linalg.norm(found - expected, axis=-1).max() < 1e-5  # metres
    assert any("cm from ours" in note for note in notes)
    back = load_motion(path, up=up, units="cm")
    assert back.skeleton == motion.skeleton  # by its names and bones
    assert torch.allclose(back.points / 100, motion.points, atol=1e-6)
    assert back.fps == 25


@pytest.mark.parametrize(
    "source", ["cmu/cmu_35_01", "cmu/cmu_pirouette", "dog/dog_run00", "robot/ur5e_fk", "hand/manipnet_mug1_rightHand"]
)
def test_real_motion_of_constant_bones_is_within_a_millimetre(shared, tmp_path, source):
    motion = load_motion(shared / "data" / f"{source}.npz", up="y")
    motion = replace(motion, units="mm").frames(0, 240, 4)
    path = save(motion, tmp_path / "w.bvh", notes=[])
    found = 10 * theirs(path, motion.skeleton.joints)
    assert np.linalg.norm(found - motion.points.numpy(), axis=-1).max() < 1


def test_rounding_is_no_residual(tmp_path):
    notes: list[str] = []
    save(walking_motion(1), tmp_path / "w.bvh", notes=notes)
    assert any(re.match(r"the file's joints agree: less than 0\.000\d cm from ours\Z", note) for note in notes)


def test_the_residual_is_the_one_that_is_told(tmp_path):
    motion = walking_motion(30)
    noise = torch.randn(motion.points.shape, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    shaken = replace(motion, points=motion.points + 0.02 * noise)
    with pytest.warns(kt.KcsWarning, match="w.bvh: the file's joints are up to .* BVH has one length for each bone"):
        save(shaken, tmp_path / "w.bvh")
    notes: list[str] = []
    path = save(shaken, tmp_path / "w.bvh", notes=notes)
    told = next(note for note in notes if "from ours" in note)
    off = 100 * np.linalg.norm(theirs(path, shaken.skeleton.joints) / 100 - shaken.points.numpy(), axis=-1)
    words = told.split()
    assert float(words[words.index("to") + 1]) == pytest.approx(off.max(), rel=0.01)
    assert float(told.split("(")[1].split()[0]) == pytest.approx(off.mean(), rel=0.01)


def test_a_result_walks_in_its_file(tmp_path):
    result = walk_result(30).scaled(units="m", factor=1e-3)
    result = replace(result, root_depth=torch.linspace(0, 2, 30, dtype=torch.float64))
    path = save(result, tmp_path / "w.bvh", notes=[])
    back = load_motion(path, units="cm")
    assert torch.allclose(back.points / 100, Motion.of(result).points, atol=1e-5)
    pelvis = back.points[:, back.skeleton.index("pelvis")] / 100
    true = result.points[:, result.skeleton.index("pelvis")]
    assert float(pelvis[-1, 2] - pelvis[0, 2]) == pytest.approx(float(true[0, 2] - true[-1, 2]) - 2, abs=1e-3)


def test_metres_for_blender(tmp_path):
    motion = walking_motion()
    found = theirs(save(motion, tmp_path / "w.bvh", units="m", notes=[]), motion.skeleton.joints)
    assert np.abs(found - motion.points.numpy()).max() < 1e-4


@pytest.mark.parametrize(("units", "factor"), [("m", 1e-3), ("m", 1e-6), ("", 1e-9)])
def test_small_animals_are_written_as_exactly(tmp_path, units, factor):
    """A fly is two millimetres long: six decimals of a metre resolve its feet to a few hundredths of its leg."""
    motion = walking_motion()
    small = replace(motion, points=factor * motion.points, units=units)
    found = theirs(save(small, tmp_path / "w.bvh", units=units or None, notes=[]), motion.skeleton.joints) / factor
    assert np.abs(found - motion.points.numpy()).max() < 1e-5


@pytest.mark.parametrize("fps", [29.97, 3000.0, 7000.0])
def test_rates_of_fast_cameras_come_back(tmp_path, fps):
    motion = replace(walking_motion(3), fps=fps)
    assert load_motion(save(motion, tmp_path / "w.bvh", notes=[])).fps == fps


def test_gaps_are_filled_and_told(tmp_path):
    motion = walking_motion()
    weights = motion.weights.clone()
    weights[4:6, 7] = 0
    gappy = replace(motion, weights=weights, points=motion.points * weights[..., None])
    notes: list[str] = []
    back = load_motion(save(gappy, tmp_path / "w.bvh", notes=notes))
    assert any("1.0 % of the joints are filled in between frames" in note for note in notes)
    assert torch.allclose(back.points[8] / 100, motion.points[8], atol=0.01)


def test_a_joint_that_is_never_seen_stretches_no_bone(tmp_path):
    motion = walking_motion()
    weights, ankle = motion.weights.clone(), motion.skeleton.index("left_ankle")
    weights[:, ankle] = 0
    gappy = replace(motion, weights=weights, points=motion.points * weights[..., None])
    notes: list[str] = []
    back = load_motion(save(gappy, tmp_path / "w.bvh", notes=notes))
    assert "never seen, so laid on the joints beside them: left_ankle" in notes
    assert any("left out because they lie on their parent: left_ankle" in note for note in back.notes)


def test_odd_names_are_written(tmp_path):
    body = kt.Skeleton.from_names(["a b", "a_b", "{x}", "naïve"], [("a b", "a_b"), ("a_b", "{x}"), ("{x}", "naïve")])
    clip = kt.data.random_motion(body, 5, generator=torch.Generator().manual_seed(0))
    motion = Motion.from_arrays(clip.points, up="-y", skeleton=body, fps=30, units="mm")
    told = "joints are named otherwise in the file: 'a b' is 'a_b', 'a_b' is 'a_b_2', '{x}' is '_x_'"
    back = load_motion(save(motion, tmp_path / "w.bvh", notes=(notes := [])))
    assert back.skeleton.joints == ("a_b", "a_b_2", "_x_", "naïve") and told in notes


def test_markers_have_no_bones(tmp_path):
    motion = Motion.from_arrays(torch.randn(4, 5, 3), fps=30, units="m")
    with pytest.raises(
        OutputError, match=r"w.bvh: expected a skeleton whose bones are one tree, got 'points', which has"
    ):
        save(motion, tmp_path / "w.bvh")
    assert not list(tmp_path.iterdir())


def test_one_frame_is_enough(tmp_path):
    motion = walking_motion(1)
    back = load_motion(save(motion, tmp_path / "w.bvh", notes=[]))
    assert torch.allclose(back.points / 100, motion.points, atol=1e-6)


@pytest.mark.parametrize("factor", [1e-28, 1e24])
def test_bodies_of_any_size_keep_their_joints(tmp_path, factor):
    motion = walking_motion(3).scaled(units="u", factor=factor)
    back = load_motion(save(motion, tmp_path / "w.bvh", notes=[]))
    assert back.skeleton.joints == motion.skeleton.joints
    assert torch.allclose(back.points / factor, motion.points / factor, atol=1e-6)


@pytest.mark.parametrize("fps", [1 / 30, 1 / 3600, 29.97, 120.0])
def test_slow_rates_come_back(tmp_path, fps):
    """Three decimals of one frame an hour are none."""
    points = torch.rand(1, 17, 3).double().expand(5, 17, 3)
    motion = kt.Motion.from_arrays(points, skeleton="h36m17", units="m", fps=fps)
    for suffix in (".bvh", ".csv"):
        kt.save(motion, tmp_path / f"slow{suffix}")
        assert load_motion(tmp_path / f"slow{suffix}").fps == pytest.approx(fps, rel=1e-5)
