"""Sides, twins and templates are read from joint names in any usual spelling."""

import math
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from kcs_torch.anatomy import (
    hinges_by_names,
    mirror_name,
    quadruped_places,
    side_of,
    spread_by_names,
    template_by_names,
)
from kcs_torch.anatomy.names import part_of
from kcs_torch.errors import SkeletonError

DATA = Path(__file__).parents[2] / "shared" / "data"

# name, side, part, twin
SPELLINGS = [
    ("left_hip", "left", "hip", "right_hip"),
    ("l_hip", "left", "hip", "r_hip"),
    ("hip_l", "left", "hip", "hip_r"),
    ("LHip", "left", "hip", "RHip"),
    ("LeftHip", "left", "hip", "RightHip"),
    ("lhip", "left", "hip", "rhip"),
    ("LEFTHIP", "left", "hip", "RIGHTHIP"),
    ("hip.R", "right", "hip", "hip.L"),
    ("left_hip_joint", "left", "hipjoint", "right_hip_joint"),
    ("mixamorig:LeftUpLeg", "left", "hip", "mixamorig:RightUpLeg"),
    ("LeftLeg", "left", "knee", "RightLeg"),
    ("LeftFoot", "left", "foot", "RightFoot"),
    ("RightForeArm", "right", "elbow", "LeftForeArm"),
    ("lefthand", "left", "hand", "righthand"),
    ("L_WRIST", "left", "wrist", "R_WRIST"),
    ("Left_wrist", "left", "wrist", "Right_wrist"),
    ("mouth_left", "left", "mouth", "mouth_right"),
    ("left_eye_inner", "left", "eyeinner", "right_eye_inner"),
    ("LBigToe", "left", "bigtoe", "RBigToe"),
    ("left_foot_index", "left", "bigtoe", "right_foot_index"),
    ("l_toe_base", "left", "toebase", "r_toe_base"),
    ("lfemur", "left", "femur", "rfemur"),
    ("REar", "right", "ear", "LEar"),
    ("leftear", "left", "ear", "rightear"),
    ("L_INDEX_MCP", "left", "index_mcp", "R_INDEX_MCP"),
    ("INDEX_FINGER_TIP", "centre", "index_tip", "INDEX_FINGER_TIP"),
    ("UpperNeck", "centre", "upperneck", "UpperNeck"),
    ("HeadTop", "centre", "headtop", "HeadTop"),
    ("head_top", "centre", "headtop", "head_top"),
    ("HeadTop_End", "centre", "headtop", "HeadTop_End"),
    ("spine_01", "centre", "spine1", "spine_01"),
    ("tail00", "centre", None, "tail00"),
    ("MidHip", "centre", "midhip", "MidHip"),
    ("Hip", "centre", "midhip", "Hip"),
    ("Hips", "centre", "pelvis", "Hips"),
    ("root", "centre", "pelvis", "root"),
    ("spine1", "centre", "spine1", "spine1"),
    ("lower_back", "centre", "lowerback", "lower_back"),
    # no part of a person, but sided
    ("r_forepaw", "right", None, "l_forepaw"),
    ("wingL", "left", None, "wingR"),
    ("forelegR4", "right", None, "forelegL4"),
    ("LF_body_coxa", "left", None, "RF_body_coxa"),
    ("RH_tarsus_tip", "right", None, "LH_tarsus_tip"),
    ("FL_paw", "left", None, "FR_paw"),
    ("LASI", "left", None, "RASI"),
    # false friends
    ("rear", "centre", None, "rear"),
    ("lip", "centre", None, "lip"),
    ("elbow", "centre", None, "elbow"),
    ("leg", "centre", None, "leg"),
    ("upright", "centre", None, "upright"),
    ("leftover", "centre", None, "leftover"),
    ("righthanded", "centre", None, "righthanded"),
    ("L5", "centre", None, "L5"),
    ("joint_l_r", "centre", None, "joint_l_r"),
    ("tail1", "centre", None, "tail1"),
    ("", "centre", None, ""),
]


@pytest.mark.parametrize(("name", "side", "part", "twin"), SPELLINGS)
def test_names(name, side, part, twin):
    assert side_of(name) == side
    assert mirror_name(name) == twin
    assert (part_of(name, "human") or part_of(name, "hand")) == part


@given(
    st.text(max_size=20)
    | st.from_regex(r"[LRlr]?[_. ]?(Left|right|Toe|hip|[A-Z]){0,3}[0-9]?[_.]?[LRlr]?", fullmatch=True)
)
def test_mirror_is_its_own_inverse(name):
    twin = mirror_name(name)
    assert mirror_name(twin) == name
    opposite = {"left": "right", "right": "left", "centre": "centre"}
    assert side_of(twin) == opposite[side_of(name)]
    assert (twin == name) == (side_of(name) == "centre")


def place(*names, kind="human"):
    return dict(zip(names, template_by_names(kind, names), strict=True))


def test_person_faces_the_viewer():
    body = place(
        "LHip", "LKnee", "LAnkle", "LHeel", "LBigToe", "LSmallToe", "LElbow", "LShoulder", "LWrist", "Nose", "Head"
    )
    assert body["LHip"][0] > 0  # the person's left is at the viewer's right
    assert body["LHip"][1] < body["LKnee"][1] < body["LAnkle"][1] < body["LHeel"][1]  # y down
    assert body["Nose"][2] < body["Head"][2] < body["LHeel"][2]  # z away from the viewer
    assert body["LBigToe"][2] < body["LAnkle"][2] < body["LHeel"][2]
    assert body["LBigToe"][0] < body["LSmallToe"][0]
    # a knee bends forwards, an elbow backwards: before and behind the line between its neighbours
    assert body["LKnee"][2] < min(body["LHip"][2], body["LAnkle"][2])
    assert body["LElbow"][2] > max(body["LShoulder"][2], body["LWrist"][2])


def test_stature_and_twins():
    body = place("head_top", "left_heel", "right_heel", "left_wrist", "right_wrist")
    assert 1.65 < body["left_heel"][1] - body["head_top"][1] < 1.75
    for part in ("heel", "wrist"):
        x, y, z = body[f"left_{part}"]
        assert body[f"right_{part}"] == (-x, y, z)


def test_words_depend_on_their_neighbours():
    hips = place("pelvis", "left_hip")
    assert hips["pelvis"][1] == hips["left_hip"][1]
    capture = place("pelvis", "left_hip", "spine1")
    assert capture["spine1"][1] < capture["pelvis"][1] < capture["left_hip"][1]  # a root above the hips
    assert place("left_foot", "left_knee")["left_foot"] == place("left_ankle")["left_ankle"]
    smpl = place("left_ankle", "left_foot")
    assert smpl["left_foot"][2] < smpl["left_ankle"][2]
    bvh = place("LeftShoulder", "LeftArm", "LeftForeArm", "LeftHand")
    assert bvh["LeftShoulder"][0] < bvh["LeftArm"][0]
    assert bvh["LeftArm"] == place("left_shoulder")["left_shoulder"]
    assert bvh["LeftHand"] == place("left_wrist")["left_wrist"]
    assert place("right_wrist", "right_hand")["right_hand"][1] > bvh["LeftHand"][1]


@pytest.mark.parametrize(
    "names",
    [
        [
            "root",
            "spine",
            "chest",
            "neck",
            "head",
            "r_shoulder",
            "r_upperarm",
            "r_elbow",
            "r_wrist",
            "r_forepaw",
            "tail1",
        ],
        ["base", "panda_joint1", "panda_joint3", "panda_grasptarget_hand"],
        ["base", "shoulder_pan_joint", "elbow_joint", "wrist_1_joint"],
        ["left_eye", "right_eye", "nose", "neck", "root_of_tail", "left_shoulder", "left_front_paw"],
        ["head", "thorax", "abdomen", "wingL", "wingR", "forelegL4"],
        ["snout", "leftear", "rightear", "tailbase"],
        ["nose", "left_ear", "right_ear"],  # a head alone may be any animal's
        ["joint0", "joint1"],
    ],
)
def test_no_person_where_there_is_none(names):
    for kind in ("human", "hand"):
        with pytest.raises(SkeletonError):
            template_by_names(kind, names)


def test_unknown_joints_are_named():
    with pytest.raises(SkeletonError, match="'tail1', 'wing'"):
        template_by_names("human", ["left_hip", "tail1", "wing"])
    with pytest.raises(SkeletonError, match="did you mean 'human'"):
        template_by_names("humann", ["left_hip"])


def test_fingers_of_a_whole_person_hang_down():
    names = ["left_elbow", "left_wrist", "left_thumb4", "left_forefinger1", "left_middle_finger4", "left_pinky_finger1"]
    body = dict(zip(names, template_by_names("human", names), strict=True))
    wrist, tip = body["left_wrist"], body["left_middle_finger4"]
    assert tip[1] > body["left_forefinger1"][1] > wrist[1]  # y is down
    assert body["left_thumb4"][2] < body["left_forefinger1"][2] < body["left_pinky_finger1"][2]  # thumbs to the front
    assert tip[0] < wrist[0]  # the palm is to the thigh
    assert math.dist(tip, wrist) == pytest.approx(0.193, abs=0.01)
    twin = template_by_names("human", [n.replace("left", "right") for n in names])
    assert twin == tuple((-x, y, z) for x, y, z in body.values())
    with pytest.raises(SkeletonError, match="left_thumb4"):
        template_by_names("human", ["left_wrist", "left_thumb4"])  # a hand alone is none of a person


def test_hands():
    hand = place("wrist", "thumb_tip", "index_finger_tip", "pinky_tip", kind="hand")
    assert hand["pinky_tip"][0] < hand["index_finger_tip"][0] < hand["thumb_tip"][0]  # a right palm to the viewer
    assert hand["index_finger_tip"][1] < hand["wrist"][1]
    numbered = template_by_names("hand", [f"hand{i}" for i in range(21)])
    assert numbered[0] == hand["wrist"] and numbered[20] == hand["pinky_tip"]
    both = place("L_WRIST", "L_THUMB_TIP", "R_WRIST", "R_THUMB_TIP", kind="hand")
    assert both["R_THUMB_TIP"][0] < both["L_THUMB_TIP"][0]
    assert both["L_THUMB_TIP"][0] == pytest.approx(-both["R_THUMB_TIP"][0])


@pytest.mark.skipif(not (DATA / "cmu").is_dir(), reason="needs the motion capture data beside the checkout")
def test_bones_agree_with_motion_capture():
    """Within 15 per cent of the mean over subjects, each scaled to the same size."""
    from kcs_torch.skeleton import SKELETONS

    body = SKELETONS["cmu21"]
    bones = np.array(body.bones)
    subjects = {}
    for file in sorted((DATA / "cmu").glob("cmu_[0-9]*.npz")):
        with np.load(file) as data:
            frame = data["points3d"][0].astype(float)
            assert tuple(data["joint_names"]) == body.joints
        lengths = np.linalg.norm(frame[bones[:, 0]] - frame[bones[:, 1]], axis=-1)
        subjects[file.stem.split("_")[1]] = lengths / lengths.mean()
    mean = np.mean(list(subjects.values()), axis=0)
    ours = body.relative_lengths().numpy()
    assert len(subjects) >= 10
    assert np.abs(ours / mean - 1).max() < 0.15


@pytest.mark.skipif(not (DATA / "hand").is_dir(), reason="needs the hand motion capture beside the checkout")
def test_two_axis_thumb_has_length():
    with np.load(DATA / "hand" / "manipnet_mug1_rightHand.npz") as data:
        names, edges = [str(n) for n in data["joint_names"]], data["edges"]
    points = template_by_names("hand", names)
    assert min(math.dist(points[a], points[b]) for a, b in edges) > 0.005


FRONT, HIND = ("shoulder", "upperarm", "elbow", "wrist", "forepaw"), ("hip", "knee", "hock", "hindpaw")
DOG = [
    *("root", "spine", "chest", "neck", "head"),
    *(f"{side}_{part}" for side in "rl" for part in (*FRONT, *HIND)),
    *("tail1", "tail2", "tail_tip"),
]


def test_animal_on_four_legs_faces_the_viewer():
    body = place(*DOG, kind="quadruped")
    assert body["head"][2] < body["chest"][2] < body["spine"][2] < body["root"][2] < body["tail_tip"][2]  # z away
    assert body["head"][1] < body["neck"][1] < body["l_elbow"][1] < body["l_wrist"][1] < body["l_forepaw"][1]  # y down
    for part in (*FRONT, *HIND):
        x, y, z = body[f"l_{part}"]
        assert x > 0 and body[f"r_{part}"] == (-x, y, z)
    assert abs(body["l_forepaw"][1] - body["l_hindpaw"][1]) < 0.02  # on one floor
    tail = [np.array(body[n]) for n in ("tail1", "tail2", "tail_tip")]
    assert np.linalg.norm(tail[1] - tail[0]) > 0.05 and np.linalg.norm(tail[2] - tail[1]) > 0.05


def test_template_of_an_animal_bends_as_its_hinges_do():
    chains = [["chest", *(f"{s}_{p}" for p in FRONT)] for s in "rl"]
    chains += [["root", *(f"{s}_{p}" for p in HIND)] for s in "rl"]
    chains += [["root", "spine", "chest", "neck", "head"], ["root", "tail1", "tail2", "tail_tip"]]
    bones = [(DOG.index(a), DOG.index(b)) for chain in chains for a, b in pairwise(chain)]
    points = np.array(template_by_names("quadruped", DOG))
    hinges = hinges_by_names(DOG, bones)
    assert sorted(DOG[h.joint] for h in hinges) == sorted(f"{s}_{p}" for s in "lr" for p in ("elbow", "knee", "hock"))
    for h in hinges:
        bend = np.cross(points[h.joint] - points[h.parent], points[h.child] - points[h.joint])
        assert h.sign * bend @ (points[h.left] - points[h.right]) > 0, DOG[h.joint]
    spread = dict(zip(((DOG[a], DOG[b]) for a, b in bones), spread_by_names(DOG, bones), strict=True))
    assert spread["root", "spine"] < spread["l_hip", "l_knee"] < spread["l_hock", "l_hindpaw"] < spread["root", "tail1"]


def test_animals_of_motion_capture():
    names = ["Hips", "Spine", "Spine1", "Neck", "Head", "Tail", "Tail1"]
    limbs = ["Shoulder", "Arm", "ForeArm", "Hand", "UpLeg", "Leg", "Foot", "Toe"]
    names += [side + part for side in ("Left", "Right") for part in limbs]
    places = dict(zip(names, [place for _, place, _ in quadruped_places(names)], strict=True))
    assert [places[f"Left{part}"] for part in limbs] == [
        *("clavicle", "shoulder", "elbow", "forepaw", "hip", "knee", "hock", "hindpaw")
    ]
    assert len(set(template_by_names("quadruped", names))) == len(names)


@pytest.mark.parametrize(
    "names",
    [
        ["pelvis", "left_hip", "left_knee", "left_ankle", "left_shoulder", "left_elbow"],  # as people have
        ["snout", "leftear", "rightear", "tailbase"],  # no limbs
        ["root", "left_hip", "left_knee", "tail"],  # a bird, say
        ["root", "left_hip", "left_shoulder", "tail", "wing"],
        ["left_hip", "left_shoulder", "left_paw", "tail"],  # of which foot?
    ],
)
def test_no_animal_where_there_is_none(names):
    assert quadruped_places(names) is None
    with pytest.raises(SkeletonError, match="a front and a hind limb"):
        template_by_names("quadruped", names)
