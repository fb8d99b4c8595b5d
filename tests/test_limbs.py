"""Which joints bend one way and which touch the ground is read from names and bones."""

from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from kcs_torch.anatomy import BENDS, Hinge, contacts_by_names, hinges_by_names
from kcs_torch.skeleton import SKELETONS

DATA = Path(__file__).parents[2] / "shared" / "data"
MIXAMO = ["Hips", *(s + part for s in ("Left", "Right") for part in ("UpLeg", "Leg", "Foot", "ToeBase"))]


def told(names, chains):
    """{joint: (bends, parent, child, left, right, firm)} by name."""
    where = {n: i for i, n in enumerate(names)}
    bones = [(where[a], where[b]) for chain in chains for a, b in pairwise(chain)]
    hinges = hinges_by_names(names, bones)
    return {
        names[h.joint]: (h.bends, *(names[i] for i in (h.parent, h.child, h.left, h.right)), h.firm) for h in hinges
    }


def test_a_persons_legs_in_another_spelling():
    names = [f"mixamorig:{n}" for n in MIXAMO]
    root, left, right = names[0], names[1:5], names[5:]
    found = told(names, [(root, *left), (root, *right)])
    hips = (left[0], right[0])
    assert found == {
        left[1]: ("backward", left[0], left[2], *hips, 1.0),
        left[2]: ("forward", left[1], left[3], *hips, 1.0),
        right[1]: ("backward", right[0], right[2], *hips, 1.0),
        right[2]: ("forward", right[1], right[3], *hips, 1.0),
    }


def test_bones_may_run_towards_the_trunk():
    names = ["l_hip", "r_hip", "l_knee", "l_ankle"]
    assert hinges_by_names(names, [(3, 2), (2, 0), (0, 1)]) == (Hinge(0, 2, 3, left=0, right=1, sign=1.0),)


@pytest.mark.parametrize(
    ("names", "chains"),
    [
        (["l_hip", "l_knee", "l_ankle"], [("l_hip", "l_knee", "l_ankle")]),  # no axis
        (["l_hip", "r_hip", "l_knee", "l_ankle"], [("l_hip", "l_ankle"), ("l_hip", "r_hip")]),  # no bones
        (["l_hip", "r_hip", "l_knee"], [("r_hip", "l_hip", "l_knee")]),  # nothing below
        (["base", "shoulder_joint", "elbow_joint", "wrist_joint"], [("base", "shoulder_joint", "elbow_joint")]),
        (["a", "b"], []),
    ],
)
def test_no_hinge_where_a_part_is_missing(names, chains):
    assert told(names, chains) == {}


def test_strange_joints_do_not_matter():
    names = ["l_shoulder", "r_shoulder", "r_elbow", "r_wrist", "club_head"]
    chain = ("l_shoulder", "r_shoulder", "r_elbow", "r_wrist", "club_head")
    assert told(names, [chain]) == {"r_elbow": ("forward", "r_shoulder", "r_wrist", "l_shoulder", "r_shoulder", 0.3)}


def test_animals():
    legs = [[f"{s}_{part}" for part in ("hip", "stifle", "hock", "hindpaw")] for s in "lr"]
    found = told(legs[0] + legs[1], [*legs, ("l_hip", "r_hip")])
    assert {joint: facts[0] for joint, facts in found.items()} == {
        "l_stifle": "backward",
        "l_hock": "forward",
        "r_stifle": "backward",
        "r_hock": "forward",
    }


@pytest.mark.parametrize(("side", "across"), [("", 1), ("R_", 1), ("L_", -1)])
def test_fingers(side, across):
    names = [f"{side}INDEX_{n}" for n in ("MCP", "PIP", "DIP", "TIP")] + [f"{side}PINKY_MCP", f"{side}THUMB_IP"]
    found = told(names, [names[:4], (names[0], names[4], names[5])])
    knuckles = (f"{side}PINKY_MCP", f"{side}INDEX_MCP")[::across]
    assert found == {
        names[1]: ("forward", names[0], names[2], *knuckles, 0.5),
        names[2]: ("forward", names[1], names[3], *knuckles, 0.5),
    }


@pytest.mark.parametrize(
    ("names", "lowest"),
    [
        ("l_knee l_ankle r_knee r_ankle", "l_ankle r_ankle"),
        ("l_ankle r_ankle r_heel", "l_ankle r_heel"),  # each side on its own
        ("LAnkle LHeel LBigToe LSmallToe LWrist", "LHeel LBigToe LSmallToe"),
        (" ".join(MIXAMO), "LeftToeBase RightToeBase"),
        ("LeftLeg LeftFoot", "LeftFoot"),
        ("FL_paw HR_hoof l_wrist tail", "FL_paw HR_hoof"),
        ("wrist index_tip a", ""),
    ],
)
def test_contacts(names, lowest):
    names = names.split()
    assert [names[i] for i in contacts_by_names(names)] == lowest.split()


@pytest.mark.parametrize("name", sorted(SKELETONS))
def test_built_in_skeletons(name):
    body = SKELETONS[name]
    joints = {
        body.joints[h.joint].lower().replace("left", "l").replace("right", "r").replace("_", "") for h in body.hinges
    }
    limbs = {"lfemur", "rfemur", "lhumerus", "rhumerus"} if name == "cmu31" else {"lknee", "rknee", "lelbow", "relbow"}
    feet = {"ltibia", "rtibia"} if name == "cmu31" else {"lankle", "rankle"}
    fingers = {f"{f}{j}" for f in ("indexfinger", "middlefinger", "ringfinger", "pinky") for j in ("pip", "dip")}
    with_feet = {"body25", "body25b", "halpe26", "mediapipe33", "smpl24", "cmu21", "cmu31", "wholebody63"}
    long = ("forefinger", "middlefinger", "ringfinger", "pinkyfinger")
    hands = {f"{side}{finger}{i}" for side in "lr" for finger in long for i in "23"}
    extra = hands if name == "wholebody63" else set()
    assert joints == (fingers if name == "hand21" else limbs | feet | extra if name in with_feet else limbs)
    assert {body.side(i) for i in body.contacts} == (set() if name == "hand21" else {"left", "right"})
    # twins bend alike
    twin = {a: b for pair in body.mirror for a, b in (pair, pair[::-1])}
    kinds = {(h.joint, h.child, h.sign, h.firm) for h in body.hinges}
    assert kinds == {(twin.get(j, j), twin.get(c, c), s, f) for j, c, s, f in kinds}


def test_the_two_ways():
    assert BENDS == {"backward": 1.0, "forward": -1.0}
    assert [Hinge(0, 1, 2, 0, 3, sign).bends for sign in BENDS.values()] == list(BENDS)
    assert Hinge(0, 1, 2, 0, 3, 1.0).bones == ((0, 1), (1, 2))


@pytest.mark.skipif(not DATA.is_dir(), reason="needs the data sets beside the checkout")
@pytest.mark.parametrize(("folder", "clip"), [("dog", "dog_walk01"), ("hand", "manipnet_cup1_bothhands")])
def test_all_of_an_animals_and_a_hands_joints_agree(folder, clip):
    # These files are in left-handed frames: all bends are of the opposite sign, and agree in that.
    with np.load(DATA / folder / f"{clip}.npz") as data:
        points, names, bones = data["points3d"].astype(float), data["joint_names"].tolist(), data["edges"].tolist()
    hinges = hinges_by_names(names, bones)
    assert len(hinges) == {"dog": 6, "hand": 8}[folder]
    for h in hinges:
        upper, lower = points[:, h.joint] - points[:, h.parent], points[:, h.child] - points[:, h.joint]
        bend = h.sign * (np.cross(upper, lower) * (points[:, h.left] - points[:, h.right])).sum(-1)
        assert (bend < 0).mean() > 0.9, names[h.joint]
