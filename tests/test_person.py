"""A person's bones by the joints' names: the built-in trees again, other spellings and orders, and what is none."""

import numpy as np
import pytest
import torch

import kcs_torch as kt
from kcs_torch.data import walking_person
from kcs_torch.methods.pkc.hands import parts_of
from kcs_torch.skeleton import SKELETONS, has_middle, person_by_names

LIMBS = ["shoulder", "elbow", "wrist", "hip", "knee", "ankle"]
TWELVE = [f"{side}_{part}" for part in LIMBS for side in ("left", "right")]  # COCO's, without the face
TORSO = [(0, 1), (0, 6), (1, 7), (6, 7)]
LINKS = [(0, 2), (2, 4), (1, 3), (3, 5), (6, 8), (8, 10), (7, 9), (9, 11)]


def named(body):
    return {frozenset((body.joints[a], body.joints[b])) for a, b in body.bones}


@pytest.mark.parametrize("name", ["coco17", "mediapipe33", "cmu17", "cmu21", "cmu31", "h36m17", "mpii16"])
def test_names_alone_give_the_built_in_tree(name):
    body = SKELETONS[name]
    found = person_by_names(body.joints[: body.num_observed])
    assert named(found) == named(body)
    assert found.is_tree and found.template is not None and len(found.hinges) == len(body.hinges)
    assert {found.bone_names[i] for i in found.flexible} == {body.bone_names[i] for i in body.flexible}


@pytest.mark.parametrize("name", [n for n in SKELETONS if n not in ("ap10k", "hand21")])
def test_every_person_is_one_tree(name):
    found = person_by_names(SKELETONS[name].joints[: SKELETONS[name].num_observed])
    assert found is not None and found.is_tree


@pytest.mark.parametrize(
    "names",
    [
        ["left_hip", "right_hip", "tail", "left_knee"],  # a name that is no person's
        ["left_hip", "hip_left", "right_hip", "left_knee"],  # two names of one place
        ["left_elbow", "left_wrist", "right_elbow", "right_wrist"],  # two pieces
        ["left_hip", "left_knee", "pelvis", "left_shoulder"],  # a shoulder that nothing links
        ["neck", "nose", "left_eye", "right_eye"],  # a head alone
        ["pelvis", "spine", "neck", "head"],  # a trunk alone
        SKELETONS["ap10k"].joints,
        SKELETONS["hand21"].joints,
        ["joint0", "joint1", "joint2"],
    ],
)
def test_others_are_none(names):
    assert person_by_names(list(names)) is None


@pytest.mark.parametrize(
    ("names", "edges"),
    [
        (["neck", "nose", "left_eye", "right_eye"], [(0, 1), (1, 2), (1, 3)]),
        (["pelvis", "spine", "neck", "head"], [(0, 1), (1, 2), (2, 3)]),
    ],
)
def test_a_head_or_a_trunk_alone_keeps_its_edges(names, edges):
    body = kt.Tracks.from_arrays(torch.rand(20, 4, 2), joint_names=names, edges=edges).skeleton
    assert body.bones == tuple(edges) and body.is_tree and body.template is None
    assert not kt.Tracks.from_arrays(torch.rand(20, 4, 2), joint_names=names).skeleton.bones


def test_fingers_hang_on_an_arm_of_bones_named_by_their_far_ends():
    body = person_by_names(["l_humerus", "l_radius", "l_wrist", "l_thumb2", "l_thumb3"])
    assert body.bone_names[-2:] == ("l_wrist-l_thumb2", "l_thumb2-l_thumb3") and body.template is not None


MIXAMO = (
    "Hips Spine Spine1 Spine2 Neck Head HeadTop_End LeftShoulder LeftArm LeftForeArm LeftHand RightShoulder RightArm "
    "RightForeArm RightHand LeftUpLeg LeftLeg LeftFoot RightUpLeg RightLeg RightFoot"
)
UNREAL = (
    "pelvis spine_01 spine_02 spine_03 neck_01 head clavicle_l upperarm_l lowerarm_l hand_l clavicle_r upperarm_r "
    "lowerarm_r hand_r thigh_l calf_l foot_l ball_l thigh_r calf_r foot_r ball_r"
)


@pytest.mark.parametrize(
    ("names", "bones"),
    [
        (MIXAMO.split(), {"Head-HeadTop_End", "Spine2-Neck", "LeftForeArm-LeftHand"}),
        (UNREAL.split(), {"pelvis-spine_01", "spine_03-neck_01", "neck_01-head", "foot_l-ball_l"}),
    ],
    ids=["Mixamo", "Unreal"],
)
def test_names_of_animation_software(names, bones):
    body = person_by_names(names)
    assert bones <= set(body.bone_names) and body.is_tree and body.template is not None


def test_an_arm_needs_no_middle():
    arm = person_by_names(["LShoulder", "LElbow", "LWrist"])
    assert arm.bone_names == ("LShoulder-LElbow", "LElbow-LWrist") and not arm.virtual
    assert not has_middle(arm.joints)


SIDES, HAND = ("left", "right"), SKELETONS["hand21"].joints
FINGERS = ["Thumb", "Index", "Middle", "Ring", "Pinky"]
MOCAP = ["Hips", "Spine", "Neck", "Head", *(f"{s}{p}" for s in ("Left", "Right") for p in ("Arm", "ForeArm", "Hand"))]


@pytest.mark.parametrize(
    ("names", "tip"),
    [
        ([*SKELETONS["coco17"].joints[:17], *(f"{s}_{j}" for s in SIDES for j in HAND[1:])], "index_finger"),
        ([*SKELETONS["mediapipe33"].joints[:33], *(f"{s}_{j}" for s in SIDES for j in HAND[1:])], "index_finger"),
        ([*SKELETONS["mediapipe33"].joints[:33], *(f"{s}_hand_{j}" for s in SIDES for j in HAND)], "hand_index_finger"),
        (
            [*SKELETONS["coco17"].joints[:17], *(f"{s}_{f}{k}" for s in SIDES for f in FINGERS for k in (1, 2, 3))],
            "Index",
        ),
        ([*MOCAP, *(f"{s}Hand{f}{k}" for s in ("Left", "Right") for f in FINGERS for k in (1, 2, 3, 4))], "HandIndex"),
    ],
    ids=[
        "mediapipe's hands on COCO's body",
        "mediapipe's hands on its own body",
        "with wrists of their own",
        "numbered",
        "motion capture",
    ],
)
def test_fingers_hang_on_hands(names, tip):
    """These had no bones at all."""
    body = person_by_names(names)
    assert body is not None and body.is_tree and body.template is not None
    upper = {body.joints[b]: body.joints[a] for a, b in body.bones}
    chain = [name for name in names if tip.lower() in name.lower() and name.lower().startswith("left")]
    assert [upper[name] for name in chain[1:]] == chain[:-1] and len(chain) >= 3
    assert "wrist" in upper[chain[0]].lower() or "hand" in upper[chain[0]].lower()
    tracks = kt.Tracks.from_arrays(torch.rand(20, len(names), 2), joint_names=names, fps=30)
    assert [part.skeleton.joints[0] for part in parts_of(tracks)[1:]] == ["left_wrist", "right_wrist"]


def test_a_hands_own_wrist_is_where_the_bodys_is():
    """Two names of nearly one place: which of them is right, or how far they are apart, nobody knows."""
    names = [*SKELETONS["coco17"].joints[:17], *(f"{s}_hand_{j}" for s in SIDES for j in HAND)]
    body = person_by_names(names)
    bone = body.bone_names.index("left_wrist-left_hand_wrist")
    assert bone in body.flexible and "left_hand_wrist-left_hand_pinky_mcp" in body.bone_names
    assert 0 < float(body.relative_lengths()[bone]) < 0.2
    alone = person_by_names([name for name in names if name not in ("left_wrist", "right_wrist")])
    assert "left_elbow-left_hand_wrist" in alone.bone_names  # it is the body's where that has none


def clip(names):
    """A walk of the library, its joints among COCO's names."""
    made = walking_person(60, yaw=60, turn=0, skeleton="coco17")
    at = [made.skeleton.joints.index(n) for n in names]
    return made.points[:, at], made.tracks.fps


def test_edges_that_close_the_torso_are_a_person():
    points, fps = clip(TWELVE)
    tracks = kt.Tracks.from_arrays(points[..., :2], joint_names=TWELVE, edges=TORSO + LINKS, fps=fps)
    body = tracks.skeleton
    assert body.joints == (*TWELVE, "pelvis", "neck") and body.is_tree
    assert "close a chain" in tracks.notes[-1] and "virtual pelvis between left_hip and right_hip" in tracks.notes[-1]
    found = kt.reconstruct(tracks).observed
    assert found.shape == points.shape


def test_a_tree_past_the_middle_gives_way():
    points, fps = clip(TWELVE)
    flat = points[..., :2]
    tracks = kt.Tracks.from_arrays(flat, joint_names=TWELVE, edges=TORSO[:2] + TORSO[3:] + LINKS, fps=fps)
    assert [tracks.skeleton.joints[v] for v, _ in tracks.skeleton.virtual] == ["pelvis", "neck"]
    assert "past the middle of the trunk" in tracks.notes[-1]
    assert torch.equal(tracks.points[:, :12], flat)


def test_a_tree_past_the_middle_gives_way_to_a_built_in_one():
    names = SKELETONS["coco17"].joints[:17]
    face, torso = [(0, 1), (0, 2), (1, 3), (2, 4), (0, 5)], [(5, 6), (5, 11), (11, 12)]
    limbs = [(5, 7), (7, 9), (6, 8), (8, 10), (11, 13), (13, 15), (12, 14), (14, 16)]
    tracks = kt.Tracks.from_arrays(clip(names)[0][..., :2], joint_names=names, edges=face + torso + limbs)
    assert tracks.skeleton is SKELETONS["coco17"] and "past the middle" in tracks.notes[0]


def test_a_tree_through_the_middle_is_kept():
    names = ["MidHip", "LHip", "RHip", "LKnee"]
    edges = [(0, 1), (1, 2), (1, 3)]  # whatever its links are
    tracks = kt.Tracks.from_arrays(np.random.default_rng(0).normal(size=(5, 4, 2)), joint_names=names, edges=edges)
    assert tracks.skeleton.bones == tuple(edges) and not tracks.notes


@pytest.mark.parametrize("spell", [str.title, lambda n: "_".join(n.split("_")[::-1]), str.upper])
def test_other_spellings_without_edges(spell):
    body = SKELETONS["coco17"]
    names = [spell(n) for n in body.joints[:17]]
    order = np.random.default_rng(1).permutation(17)
    points, fps = clip(list(body.joints[:17]))
    tracks = kt.Tracks.from_arrays(points[:, order, :2], joint_names=[names[i] for i in order], fps=fps)
    assert tracks.skeleton.joints[:17] == tuple(names[i] for i in order) and tracks.skeleton.template is not None
    assert tracks.skeleton.num_bones == body.num_bones


COCO = [(15, 13), (13, 11), (16, 14), (14, 12), (11, 12), (5, 11), (6, 12), (5, 6), (5, 7), (6, 8), (7, 9), (8, 10)]
COCO += [(1, 2), (0, 1), (0, 2), (1, 3), (2, 4), (3, 5), (4, 6)]


def test_published_links_tell_whose_joints_these_are():
    points, fps = clip(list(SKELETONS["coco17"].joints[:17]))
    for names in (None, [f"kp{i}" for i in range(17)]):
        tracks = kt.Tracks.from_arrays(points[..., :2], edges=COCO, joint_names=names, fps=fps)
        assert tracks.skeleton is SKELETONS["coco17"]
        assert "the edges are those of skeleton 'coco17'" in tracks.notes[0]
    other = kt.Tracks.from_arrays(points[..., :2], edges=COCO[:-9], fps=fps)
    assert other.skeleton.name == "tracks" and other.skeleton.template is None


def test_links_of_two_skeletons_are_told():
    body = SKELETONS["h36m17"]
    points = np.random.default_rng(0).normal(size=(5, 17, 2))
    tracks = kt.Tracks.from_arrays(points, edges=body.bones)
    assert tracks.skeleton.bones == body.bones and tracks.skeleton.template is None
    assert "skeletons cmu17 and h36m17: skeleton='h36m17'" in tracks.notes[0]
    assert not kt.Tracks.from_arrays(points, edges=body.bones, joint_names=list("abcdefghijklmnopq")).notes
