"""ASF/AMC files: a real one against the CMU joints, one by hand, and damaged ones."""

import math
import random

import numpy as np
import pytest
import torch
from command_line import run

import kcs_torch as kt
from kcs_torch.errors import FormatError
from kcs_torch.io import load_motion

ASF = """# comment
:version 1.10
:name test
:units
  mass 1.0
  length 0.45
  angle deg
:root
  order TX TY TZ RX RY RZ
  axis XYZ
  position 0 0 0
  orientation 0 0 0
:bonedata
  begin
    id 1
    name thigh
    direction 0 -1 0
    length 2
    axis 0 0 0 XYZ
    dof rx rz
  end
  begin
    id 2
    name shank
    direction 0 -1 0
    length 1
    axis 0 0 90 XYZ
    dof rx
  end
  begin
    id 3
    name fixed
    direction 1 0 0
    length 1
    axis 0 0 0 XYZ
  end
:hierarchy
  begin
    root fixed thigh
    thigh shank
  end
"""
AMC = """#!OML:ASF test
:FULLY-SPECIFIED
:DEGREES
1
root 1 2 3 0 0 0
thigh 0 0
shank 0
2
root 0 0 0 0 90 0
thigh 90 0
shank 90
"""
UNIT = 25.4 / 0.45  # mm


@pytest.fixture
def files(tmp_path):
    (tmp_path / "s.asf").write_text(ASF)
    (tmp_path / "s_01.amc").write_text(AMC)
    return tmp_path


def test_a_rate_that_the_file_does_not_tell_is_asked_for(files):
    motion = load_motion(files / "s_01.amc")
    assert motion.fps is None and any("give fps=... (kcs-torch: --fps)" in note for note in motion.notes)
    told = run("score", files / "s_01.amc", files / "s_01.amc").output
    assert "(kcs-torch: --truth-fps)" in told and "(kcs-torch: --pred-up)" in told and "--fps" not in told
    told = run("angles", files / "s_01.amc", "--joint", "root,thigh,shank").output
    assert "(kcs-torch: --fps)" in told and "point up" not in told  # which angles do not depend on


def test_by_hand(files):
    motion = load_motion(files / "s_01.amc", fps=120)
    assert motion.skeleton.joints == ("root", "thigh", "shank", "fixed")
    assert set(motion.skeleton.bones) == {(0, 1), (1, 2), (0, 3)}
    assert (motion.units, motion.fps) == ("mm", 120)
    rest = torch.tensor([[1, 2, 3], [1, 0, 3], [1, -1, 3], [2, 2, 3]]).double()
    assert torch.allclose(motion.points[0] / UNIT, rest)
    # The root turns by 90 degrees about y: x goes to -z, z to x. The thigh's rx takes -y to -z, so in the world to -x.
    # The shank's own x axis is y of its parent: -y stays.
    turned = torch.tensor([[0, 0, 0], [-2, 0, 0], [-3, 0, 0], [0, 0, -1]]).double()
    assert torch.allclose(motion.points[1] / UNIT, turned, atol=1e-9)


def test_frames_are_placed_by_their_numbers(files):
    pose = "\nroot 1 2 3 0 0 0\nthigh 0 0\nshank 0\n"
    head = AMC[: AMC.index("\n1\n") + 1]
    (files / "s_01.amc").write_text(head + "".join(f"{number}{pose}" for number in (5, 6, 9)))
    motion = load_motion(files / "s_01.amc")
    assert motion.seen.all(1).tolist() == [True, True, False, False, True]
    assert "frame 0 is the file's frame 5" in motion.notes
    assert "2 of 5 frames have no pose (numbers 7, 8): unseen" in motion.notes
    (files / "s_01.amc").write_text(head + "".join(f"{number}{pose}" for number in (1, 2, 1)))
    again = load_motion(files / "s_01.amc")
    assert again.num_frames == 3 and again.seen.all()
    assert any(note.startswith("the numbers of the frames do not ascend") for note in again.notes)


def test_bones_may_stand_in_any_order(files):
    expected = load_motion(files / "s_01.amc")
    first, *bones = ASF.partition(":bonedata")[2].partition(":hierarchy")[0].split("  begin\n")
    turned = first + "".join("  begin\n" + bone for bone in reversed(bones))
    (files / "s.asf").write_text(
        ASF.partition(":bonedata")[0] + ":bonedata" + turned + ":hierarchy" + ASF.partition(":hierarchy")[2]
    )
    found = load_motion(files / "s_01.amc")
    at = [found.skeleton.index(name) for name in expected.skeleton.joints]
    assert torch.equal(found.points[:, at], expected.points)


def test_radians_and_other_orders(files):
    (files / "s_01.amc").write_text(AMC.replace("DEGREES", "RADIANS").replace("90", str(math.pi / 2)))
    (files / "s.asf").write_text(ASF.replace("axis 0 0 90 XYZ", f"axis 0 0 {math.pi / 2} XYZ"))
    turned = torch.tensor([[0, 0, 0], [-2, 0, 0], [-3, 0, 0], [0, 0, -1]]).double()
    assert torch.allclose(load_motion(files / "s_01.amc").points[1] / UNIT, turned, atol=1e-9)
    (files / "s.asf").write_text(ASF.replace("axis XYZ", "axis ZYX"))
    (files / "s_01.amc").write_text(AMC.replace("0 0 0 0 90 0", "0 0 0 90 90 0"))
    points = load_motion(files / "s_01.amc").points[1] / UNIT  # about y first, then about x: Rx Ry
    assert torch.allclose(points[3], torch.tensor([0.0, 1.0, 0.0]).double(), atol=1e-9)


def test_its_skeleton_is_found_or_named(files, tmp_path_factory):
    expected = load_motion(files / "s_01.amc").points
    (files / "other.asf").write_text("nothing")
    assert torch.equal(load_motion(files / "s_01.amc").points, expected)  # s before other
    lonely = tmp_path_factory.mktemp("lonely")
    (lonely / "s_01.amc").write_text(AMC)
    with pytest.raises(FormatError, match=r"skeleton beside it, such as s_01.asf, got none: name it by skeleton="):
        load_motion(lonely / "s_01.amc")
    assert torch.equal(load_motion(lonely / "s_01.amc", skeleton=files / "s.asf").points, expected)
    (lonely / "any.asf").write_text(ASF)
    assert torch.equal(load_motion(lonely / "s_01.amc").points, expected)
    with pytest.raises(FormatError, match=r"got a skeleton \(.asf\): give the .amc"):
        load_motion(files / "s.asf")


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("shank 90", "shank", "line 11: 'shank': expected 1 numbers, got 0"),
        ("shank 90", "shank ninety", "line 11: expected numbers, got 'ninety'"),
        ("shank 90", "", "frame 2: expected all bones, got none for shank"),
        ("shank 90", "shank 90\nshank 90", "line 12: frame 2: 'shank' comes twice"),
        ("shank 90", "toe 90", "line 11: expected one of root, thigh, shank, ..., got 'toe'"),
        ("\n1\n", "\n", "expected a frame's number, got 'root'"),
    ],
)
def test_damaged_motion_is_named(files, old, new, message):
    (files / "s_01.amc").write_text(AMC.replace(old, new))
    with pytest.raises(FormatError, match=message):
        load_motion(files / "s_01.amc")


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("thigh shank\n", "thigh foot\n", r"s.asf: line \d+: expected names of bones, got 'thigh foot'"),
        ("thigh shank\n", "root shank\n  shank thigh\n", "bone 'thigh' hangs on two others"),
        ("    thigh shank\n", "", "bone 'shank' hangs on nothing"),
        ("root fixed thigh", "root fixed\nshank thigh", "hangs on nothing"),
        ("name shank", "name thigh", "bones of different names"),
        ("direction 1 0 0", "direction 1 0", "line 33: expected 3 numbers, got 2"),
        ("dof rx rz", "dof rx rw", "expected TX, RZ and the like"),
        ("dof rx rz", "dof tx", "expected rx, ry and rz"),
        ("axis 0 0 0 XYZ", "axis 0 0 0 XXZ", "an order such as XYZ"),
        ("length 0.45", "length -1", "expected a skeleton with"),
        (":hierarchy", ":nothing", "expected a skeleton with"),
    ],
)
def test_damaged_skeletons_are_named(files, old, new, message):
    (files / "s.asf").write_text(ASF.replace(old, new))
    with pytest.raises(FormatError, match=message):
        load_motion(files / "s_01.amc")


def test_real_file_has_the_joints_of_cmu(shared):
    motion = load_motion(shared / "data" / "raw_formats" / "asf_amc" / "35_01.amc", fps=120)
    with np.load(shared / "data" / "cmu" / "cmu_35_01.npz") as file:
        truth, names = file["points3d"], file["joint_names"].tolist()
    known = "pelvis=root r_hip=rhipjoint r_knee=rfemur r_ankle=rtibia l_toe_base=lfoot head_top=head l_wrist=lradius"
    for pair in known.split():
        name, own = pair.split("=")
        off = motion.points[:, motion.skeleton.index(own)].numpy() - truth[:, names.index(name)]
        assert np.linalg.norm(off, axis=-1).max() < 0.01, name  # mm; the truth is in single precision
    assert motion.num_joints == 31
    assert motion.skeleton.joints == kt.SKELETONS["cmu31"].joints


def test_mutated_files_end_in_our_errors(files):
    read = 0
    for seed in range(200):
        pick = random.Random(seed)
        name, text = (("s.asf", ASF), ("s_01.amc", AMC))[seed % 2]
        letters = list(text)
        for _ in range(pick.choice([1, 2, 8])):
            at = pick.randrange(len(letters))
            letters[at : at + pick.choice([0, 1, 30])] = pick.choice(["", "\n", "x", "nan", "1e999", "-", ":", "root"])
        (files / "s.asf").write_text(ASF)
        (files / "s_01.amc").write_text(AMC)
        (files / name).write_text("".join(letters))
        try:
            assert load_motion(files / "s_01.amc", format="amc").points.isfinite().all()
            read += 1
        except kt.KcsError as error:
            assert str(files) in str(error)
    assert 0 < read < 200
