"""kcs_torch/skeleton/stature.py: the stature of a person from bone lengths, whatever joints the skeleton has."""

import pytest
import torch

from kcs_torch.skeleton import SKELETONS, Skeleton, get_skeleton, stature_weights

PEOPLE = [name for name in SKELETONS if name not in ("ap10k", "hand21")]


def template_lengths(body):
    ends = body.template_points(dtype=torch.float64)[body.bone_index()]
    return (ends[:, 1] - ends[:, 0]).norm(dim=-1)


@pytest.mark.parametrize("name", PEOPLE)
def test_the_template_of_every_built_in_person_is_175_tall(name):
    body = get_skeleton(name)
    weights = stature_weights(body).double()
    assert weights.shape == (2, body.num_bones)
    found = weights @ template_lengths(body)
    assert found.tolist() == pytest.approx([1.75, 1.75], rel=0.001)


@pytest.mark.parametrize("name", ["halpe26", "mpi15"])
def test_what_these_detectors_call_head_is_its_top(name):
    body, other = get_skeleton(name), get_skeleton("mpii16")
    assert body.template[body.index("Head")] == other.template[other.index("head_top")]


def test_nothing_above_the_neck_counts_twice():
    body = get_skeleton("body25b")  # UpperNeck - HeadTop - Nose - LEye - LEar
    left = dict(zip(body.bone_names, stature_weights(body)[0].tolist(), strict=True))
    assert left["UpperNeck-HeadTop"] == pytest.approx(1.023, abs=0.01)
    for bone in ("HeadTop-Nose", "Nose-LEye", "LEye-LEar", "MidHip-LHip", "RHip-RKnee"):
        assert left[bone] == pytest.approx(0, abs=1e-6)


def test_long_legs_make_tall_people_and_wide_hips_do_not():
    body = get_skeleton("h36m17")
    lengths = template_lengths(body)
    index = {name: i for i, name in enumerate(body.bone_names)}
    wide, tall = lengths.clone(), lengths.clone()
    for side in ("left", "right"):
        wide[index[f"pelvis-{side}_hip"]] += 0.1
        tall[index[f"{side}_knee-{side}_ankle"]] += 0.1
    weights = stature_weights(body).double()
    assert (weights @ wide).mean().item() == pytest.approx(1.75)
    assert (weights @ tall).mean().item() == pytest.approx(1.85, abs=0.02)


def test_motion_capture_puts_the_head_where_the_skull_turns():
    body = get_skeleton("smpl24")
    lengths = dict(zip(body.bone_names, template_lengths(body).tolist(), strict=True))
    assert lengths["neck-head"] == pytest.approx(0.08, abs=0.01)  # 0.07 in SMPL's own mean body


def test_of_an_unknown_body_bones_count_in_full():
    joints = ["Bip Head", "b_hip", "Bip L Foot"]
    body = Skeleton.from_names(joints, [("b_hip", "Bip Head"), ("b_hip", "Bip L Foot")], template=None)
    assert body.template is None
    weights = stature_weights(body)
    assert weights[0].tolist() == pytest.approx([1.75 / 1.59] * 2)  # a head at 1.66, an ankle at 0.07


@pytest.mark.parametrize(
    "bones", [[("head", "left_hip")], [("left_ankle", "left_hip")], [("head", "left_hip"), ("left_ankle", "b")]]
)
def test_without_a_head_or_a_foot_that_bones_join_to_it_there_is_none(bones):
    names = list(dict.fromkeys(n for bone in bones for n in bone))
    assert stature_weights(Skeleton.from_names(names, bones, tree=False)) is None


@pytest.mark.parametrize("name", ["ap10k", "hand21"])
def test_animals_and_hands_have_none(name):
    assert stature_weights(get_skeleton(name)) is None


def test_an_animal_named_as_people_are_has_none():
    bones = [("Hips", "Head"), ("Hips", "LeftFoot"), ("Hips", "LeftHand"), ("Hips", "Tail")]
    names = list(dict.fromkeys(n for bone in bones for n in bone))
    assert stature_weights(Skeleton.from_names(names[:4], bones[:3])) is not None
    assert stature_weights(Skeleton.from_names(names, bones)) is None
