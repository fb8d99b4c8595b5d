"""Joints of one body found among those of another: by name, whatever the spelling and the order."""

import itertools
import math

import pytest

from kcs_torch.anatomy import side_of
from kcs_torch.skeleton import SKELETONS, map_joints

HUMANS = sorted(set(SKELETONS) - {"ap10k", "hand21"})
LIMBS = [(side, part) for side in ("left", "right") for part in ("shoulder", "elbow", "wrist", "hip", "knee", "ankle")]


@pytest.mark.parametrize(
    "spelt",
    [
        "LShoulder RShoulder LWrist Nose MidHip",
        "left_shoulder right_shoulder left_wrist nose pelvis",
        "shoulder_l shoulder_r wrist_l nose mid_hip",
        "L_SHOULDER R_SHOULDER L_WRIST NOSE MID_HIP",
        "mixamorig:LeftArm mixamorig:RightArm mixamorig:LeftHand nose mixamorig:Hips",
    ],
)
def test_spellings(spelt):
    names = spelt.split()
    wanted = ["pelvis", "left_wrist", "right_shoulder", "left_shoulder", "nose", "left_knee"]
    assert map_joints(names, wanted) == [4, 2, 1, 0, 3, None]


def test_names_with_blanks_and_names_of_no_body():
    assert map_joints(["L Shoulder", "Tail Base", "tail tip"], ["tail_tip", "left_shoulder", "TailBase"]) == [2, 0, 1]
    assert map_joints([], ["nose"]) == [None]
    assert map_joints(["nose"], []) == []


def test_what_is_there_twice_has_no_counterpart():
    assert map_joints(["left_toe", "left_ball", "left_heel"], ["LToeBase", "LHeel"]) == [None, 2]
    assert map_joints(["a_1", "a1"], ["A 1", "a1"]) == [None, 1]


def test_a_word_means_what_it_means_beside_its_neighbours():
    """Human3.6M's neck is above its thorax, which is what others call the neck."""
    found = SKELETONS["h36m17"].mapping_to(SKELETONS["body25"])
    assert found["Neck"] == "thorax"
    assert SKELETONS["h36m17"].mapping_to(SKELETONS["mpii16"])["upper_neck"] == "neck"


@pytest.mark.parametrize(("first", "second"), list(itertools.product(HUMANS, HUMANS)))
def test_any_two_built_in_humans(first, second):
    a, b = SKELETONS[first], SKELETONS[second]
    found = a.mapping_to(b)
    assert b.mapping_to(a) == {ours: theirs for theirs, ours in found.items()}
    if first == second:
        assert found == {j: j for j in a.joints}
    # all limbs are found, on their own sides
    assert len([j for j in found if side_of(j) != "centre"]) >= len(LIMBS)
    assert all(side_of(theirs) == side_of(ours) for theirs, ours in found.items())
    # and lie in the same places, metres; motion capture has wrists, pelvis and upper neck a little off, and what SMPL
    # names its head is where the skull turns
    for theirs, ours in found.items():
        limit = 0.21 if "smpl24" in (first, second) and ours.lower() == theirs.lower() == "head" else 0.101
        assert math.dist(a.template[a.index(ours)], b.template[b.index(theirs)]) < limit, (theirs, ours)


def test_joints_that_only_one_has_are_left_out():
    found = SKELETONS["coco17"].mapping_to(SKELETONS["body25"])
    assert set(SKELETONS["body25"].joints) - set(found) == {
        *("LBigToe", "LSmallToe", "LHeel", "RBigToe", "RSmallToe", "RHeel")
    }
    assert SKELETONS["hand21"].mapping_to(SKELETONS["coco17"]) == {}
