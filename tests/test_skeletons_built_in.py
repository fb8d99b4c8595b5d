"""The built-in skeletons: their lists, templates, and where they come from."""

from pathlib import Path

import numpy as np
import pytest
import torch

from kcs_torch.anatomy import mirror_name, side_of
from kcs_torch.skeleton import SKELETONS, guess_skeleton

DATA = Path(__file__).parents[2] / "shared" / "data"

BUILT_IN = sorted(SKELETONS)

COCO = (
    "nose l_eye r_eye l_ear r_ear l_shoulder r_shoulder l_elbow r_elbow l_wrist r_wrist l_hip r_hip "
    "l_knee r_knee l_ankle r_ankle"
)

PUBLISHED = {
    "coco17": COCO,
    "coco18": (
        "nose neck r_shoulder r_elbow r_wrist l_shoulder l_elbow l_wrist r_hip r_knee r_ankle l_hip l_knee "
        "l_ankle r_eye l_eye r_ear l_ear"
    ),
    "body25": (
        "nose neck r_shoulder r_elbow r_wrist l_shoulder l_elbow l_wrist midhip r_hip r_knee r_ankle l_hip "
        "l_knee l_ankle r_eye l_eye r_ear l_ear l_bigtoe l_smalltoe l_heel r_bigtoe r_smalltoe r_heel"
    ),
    "body25b": COCO + " upperneck headtop l_bigtoe l_smalltoe l_heel r_bigtoe r_smalltoe r_heel",
    "wholebody63": COCO
    + " l_bigtoe l_smalltoe l_heel r_bigtoe r_smalltoe r_heel "
    + " ".join(
        f"{side}_{finger}{i}"
        for side in "lr"
        for finger in ("thumb", "forefinger", "middlefinger", "ringfinger", "pinkyfinger")
        for i in range(1, 5)
    ),
    "halpe26": COCO + " head neck hip l_bigtoe r_bigtoe l_smalltoe r_smalltoe l_heel r_heel",
    "mpi15": (
        "head neck r_shoulder r_elbow r_wrist l_shoulder l_elbow l_wrist r_hip r_knee r_ankle l_hip l_knee "
        "l_ankle chest"
    ),
    "mpii16": (
        "r_ankle r_knee r_hip l_hip l_knee l_ankle pelvis thorax upperneck headtop r_wrist r_elbow r_shoulder "
        "l_shoulder l_elbow l_wrist"
    ),
    "h36m17": (
        "pelvis r_hip r_knee r_ankle l_hip l_knee l_ankle spine thorax neck head l_shoulder l_elbow l_wrist "
        "r_shoulder r_elbow r_wrist"
    ),
    "smpl24": (
        "pelvis l_hip r_hip spine1 l_knee r_knee spine2 l_ankle r_ankle spine3 l_foot r_foot neck l_collar "
        "r_collar head l_shoulder r_shoulder l_elbow r_elbow l_wrist r_wrist l_hand r_hand"
    ),
    "ap10k": (
        "l_eye r_eye nose neck rootoftail l_shoulder l_elbow l_frontpaw r_shoulder r_elbow r_frontpaw l_hip "
        "l_knee l_backpaw r_hip r_knee r_backpaw"
    ),
    "mediapipe33": (
        "nose l_eyeinner l_eye l_eyeouter r_eyeinner r_eye r_eyeouter l_ear r_ear l_mouth r_mouth l_shoulder "
        "r_shoulder l_elbow r_elbow l_wrist r_wrist l_pinky r_pinky l_index r_index l_thumb r_thumb l_hip "
        "r_hip l_knee r_knee l_ankle r_ankle l_heel r_heel l_footindex r_footindex"
    ),
}


def plain(name):
    """'LBigToe' and 'left_big_toe' as 'l_bigtoe'."""
    side = side_of(name)
    bare = name.lower().replace("_", "").replace("left", "").replace("right", "")
    if side == "centre":
        return bare
    return f"{side[0]}_{bare if 'left' in name or 'right' in name else bare[1:]}"


def test_the_list_of_built_in_skeletons():
    expected = {
        "h36m17",
        "coco17",
        "coco18",
        "body25",
        "body25b",
        "mpi15",
        "mpii16",
        "halpe26",
        "mediapipe33",
        "hand21",
    }
    assert expected | {"wholebody63", "cmu31", "cmu21", "cmu17", "ap10k", "smpl24"} <= set(SKELETONS)
    assert "nothing" not in SKELETONS and SKELETONS.get("nothing") is None and 3 not in SKELETONS
    assert SKELETONS["coco17"] is SKELETONS["coco17"]
    assert [SKELETONS[n].num_joints for n in ("cmu31", "cmu21", "cmu17", "hand21")] == [31, 21, 17, 21]


@pytest.mark.parametrize("name", BUILT_IN)
def test_built_in(name):
    body = SKELETONS[name]
    assert body.name == name
    assert body.is_tree
    # every sided joint has its twin, and pairs follow the names
    pairs = {(body.joints[a], body.joints[b]) for a, b in body.mirror}
    assert pairs == {(j, mirror_name(j)) for j in body.joints if side_of(j) == "left"}
    assert {j for j in body.joints if side_of(j) == "right"} == {b for _, b in pairs}
    # twin bones too
    sided = [i for i, (a, b) in enumerate(body.bones) if {body.side(a), body.side(b)} != {"centre"}]
    assert sorted(i for pair in body.mirror_bones for i in pair) == sided
    # the template is symmetrical, and no bone is a point
    points = body.template_points(dtype=torch.float64)
    flip = torch.tensor([-1.0, 1.0, 1.0], dtype=torch.float64)
    for a, b in body.mirror:
        assert torch.equal(points[a], points[b] * flip)
        assert points[a, 0] > 0
    index = body.bone_index()
    lengths = (points[index[:, 1]] - points[index[:, 0]]).norm(dim=-1)
    assert lengths.min() > 0.01
    assert body.relative_lengths(dtype=torch.float64).mean() == pytest.approx(1)
    # virtual joints sit where their sources put them
    for joint, sources in body.virtual:
        assert torch.allclose(points[joint], points[list(sources)].mean(0), atol=1e-12)


@pytest.mark.parametrize("name", sorted(PUBLISHED))
def test_published_order(name):
    body = SKELETONS[name]
    assert [plain(j) for j in body.joints[: body.num_observed]] == PUBLISHED[name].split()


def test_hand_order():
    hand = SKELETONS["hand21"]
    fingers = [j.split("_")[0] for j in hand.joints]
    assert fingers == ["wrist", *(f for f in ("thumb", "index", "middle", "ring", "pinky") for _ in range(4))]
    assert {b: a for a, b in hand.bones} == {i: 0 if i % 4 == 1 else i - 1 for i in range(1, 21)}


def test_each_file_names_its_source():
    for file in (Path(__file__).parents[1] / "kcs_torch" / "skeletons").glob("*.yaml"):
        assert file.read_text(encoding="utf-8").startswith("# "), file.name


@pytest.mark.skipif(not DATA.is_dir(), reason="needs the data sets beside the checkout")
@pytest.mark.parametrize(
    ("name", "file"),
    [
        ("cmu21", "cmu/cmu_35_01"),
        ("body25b", "human_2d3d/pose2sim_balancing_openpose"),
        ("mediapipe33", "human_2d3d/pose2sim_balancing_mediapipe"),
    ],
)
def test_order_of_real_files(name, file):
    with np.load(DATA / f"{file}.npz") as data:
        assert guess_skeleton(data["joint_names"]) is SKELETONS[name]


def test_guess_skeleton():
    for body in SKELETONS.values():
        assert guess_skeleton(body.joints[: body.num_observed]) is body
    assert guess_skeleton(["a", "b"]) is None
    assert guess_skeleton(SKELETONS["h36m17"].joints[::-1]) is None
