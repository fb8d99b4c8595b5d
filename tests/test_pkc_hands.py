"""Hands of a body, solved by themselves and joined to it at the wrists."""

from dataclasses import replace

import pytest
import torch
from torch.testing import assert_close

import kcs_torch as kt
from kcs_torch.data import random_motion, walking_person
from kcs_torch.methods.pkc.hands import part_of, parts_of

BODY = kt.SKELETONS["wholebody63"]
FINGERS = {
    "thumb": "thumb",
    "index": "forefinger",
    "middle": "middle_finger",
    "ring": "ring_finger",
    "pinky": "pinky_finger",
}

pytestmark = pytest.mark.filterwarnings(
    "ignore::kcs_torch.errors.KcsWarning", "ignore::kcs_torch.errors.ConvergenceWarning"
)


def person_with_hands(frames, seed=0, yaw=200.0, swing=6.0):
    """Points (T, 63, 3) of a walk whose hands swing, and their tracks."""
    generator = torch.Generator().manual_seed(seed)
    walk = walking_person(frames, skeleton="coco17", turn=0, yaw=yaw).points[:, :17]
    points = torch.full((frames, BODY.num_observed, 3), torch.nan, dtype=torch.float64)
    for name, place in zip(kt.SKELETONS["coco17"].joints[:17], walk.unbind(1), strict=True):
        points[:, BODY.index(name)] = place
    hand = kt.SKELETONS["hand21"]
    for side, across in (("left", -1.0), ("right", 1.0)):
        moved = random_motion(hand, frames, turn=0, yaw=yaw, swing=swing, generator=generator).points
        moved = 180 * (moved - moved[:, :1]) / (moved[:, 12] - moved[:, 0]).norm(dim=-1).mean()
        moved = moved * torch.tensor([across, 1.0, 1.0], dtype=torch.float64)
        for k, name in enumerate(hand.joints[1:]):
            joint = BODY.index(f"{side}_{FINGERS[name.split('_')[0]]}{k % 4 + 1}")
            points[:, joint] = points[:, BODY.index(f"{side}_wrist")] + moved[:, k + 1]
    return points, kt.Tracks.from_arrays(points[..., :2], skeleton=BODY, fps=30)


@pytest.fixture(scope="module")
def person():
    return person_with_hands(40)


@pytest.fixture(scope="module")
def solved(person):
    return kt.PKC()(person[1])


def test_parts_of_a_person_with_hands(person):
    body, left, right = parts_of(person[1])
    assert [part.skeleton.joints[0] for part in (left, right)] == ["left_wrist", "right_wrist"]
    assert all(part.skeleton.num_joints == 21 for part in (left, right))
    assert sorted({*body.joints, *left.joints, *right.joints}) == list(range(BODY.num_joints))
    assert len(body.joints) == BODY.num_joints - 40
    for part in (body, left, right):
        own, names = part.skeleton, [BODY.joints[joint] for joint in part.joints]
        assert list(own.joints) == names and own.is_tree
        assert {own.bone_names[k] for k in range(own.num_bones)} <= set(BODY.bone_names)
    facts = body.skeleton
    assert [h.joint for h in facts.hinges] == [h.joint for h in BODY.hinges if h.joint in body.joints]
    assert [facts.joints[i] for i in facts.contacts] == [BODY.joints[i] for i in BODY.contacts]
    assert facts.virtual[-1] == (facts.index("neck"), (facts.index("left_shoulder"), facts.index("right_shoulder")))
    kept = [k for k, bone in enumerate(BODY.bones) if {*bone} <= {*body.joints}]
    assert facts.spread == tuple(BODY.spread[k] for k in kept)
    mirrored = left.skeleton.template_points()[:, 0], right.skeleton.template_points()[:, 0]
    assert_close(mirrored[0], -mirrored[1])


@pytest.mark.parametrize("name", ["coco17", "mediapipe33", "hand21", "ap10k"])
def test_bodies_without_hands_are_whole(name):
    clip = random_motion(kt.SKELETONS[name], 20)
    assert parts_of(clip.tracks) == []


def test_what_branches_like_a_hand_is_none():
    """Four legs that hang on one joint of a body with a template."""
    names = ["hip", "neck", "head", *(f"leg_{i}{k}" for i in range(4) for k in "ab")]
    bones = [("hip", "neck"), ("neck", "head")]
    bones += [pair for i in range(4) for pair in (("neck", f"leg_{i}a"), (f"leg_{i}a", f"leg_{i}b"))]
    spot = torch.randn(len(names), 3, generator=torch.Generator().manual_seed(0)).tolist()
    spread = {f"{a}-{b}": 10.0 for a, b in bones}
    body = kt.Skeleton.from_names(names, bones, template=dict(zip(names, spot, strict=True)), spread=spread)
    assert parts_of(random_motion(body, 20).tracks) == []


def test_each_hand_is_as_if_it_were_alone(person, solved):
    tracks = person[1]
    inner, size = kt.PKC()._normalised(tracks)
    for part in parts_of(tracks)[1:]:
        alone = kt.PKC()(part_of(inner, part)).points * size
        there = solved.points[:, list(part.joints)]
        assert_close(there - there[:, :1], alone - alone[:, :1], rtol=0, atol=1e-3 * float(size))
        wrist, tips = part.joints[0], list(part.joints[1:])
        assert bool((solved.uncertainty[:, tips] >= solved.uncertainty[:, wrist, None]).all())


def test_body_and_hands_are_right(person, solved):
    """13 mm; as one body, from whose trunk fingers are seen, they were off by 17."""
    points = person[0]
    shown = ~points[0, :, 0].isnan()
    off = solved.observed[:, shown] - points[:, shown]
    off = (off - off.mean(1, keepdim=True)).norm(dim=-1)
    assert float(off.mean()) < 15
    assert bool(solved.points.isfinite().all()) and bool(solved.uncertainty.isfinite().all())


def test_alternatives_are_of_one_part_each(solved):
    values = [one.objective for one in solved.alternatives]
    assert 0 < len(values) <= 4 and values == sorted(values) and solved.objective <= values[0]
    for other in solved.alternatives:
        off = (other.points - solved.points).norm(dim=-1).mean(0)
        assert other.points.shape == solved.points.shape and float(off.amax()) > 0


def test_notes_on_a_hand_name_its_wrist_and_are_not_the_bodys():
    tracks = person_with_hands(30)[1]
    noise = 4 * torch.randn(tracks.points.shape, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    found = kt.PKC()(replace(tracks, points=tracks.points + noise * tracks.seen[..., None], detector=True))
    told = [note for note in found.diagnostics.notes if note.startswith(("left_wrist: ", "right_wrist: "))]
    assert any("noise of" in note and "% of its size" in note for note in told)
    assert not any("the body's" in note for note in told)
    assert sum("taken for a detector's" in note for note in found.diagnostics.notes) == 1


def test_clips_together_are_as_alone(solved, person):
    other = person_with_hands(30, seed=1, yaw=30.0)[1]
    first, second = kt.reconstruct_all([person[1], other], method="pkc", intrinsics="parallel")
    assert_close(first.points, solved.points, rtol=0, atol=3.0)  # 1e-13 of the tracks moves it by 1.3 mm
    assert second.points.shape == (30, BODY.num_joints, 3)


def test_hands_may_have_wrists_of_their_own():
    """As right as with the body's wrists alone."""
    points, _ = person_with_hands(30, yaw=60.0)
    shown = [joint for joint in range(BODY.num_observed) if bool(points[0, joint].isfinite().all())]
    names = [BODY.joints[joint] for joint in shown]
    own = points[:, [BODY.index(f"{side}_wrist") for side in ("left", "right")]]
    both = torch.cat([points[:, shown], own], 1)
    tracks = kt.Tracks.from_arrays(both[..., :2], joint_names=[*names, "left_hand_wrist", "right_hand_wrist"], fps=30)
    _, left, right = parts_of(tracks)
    assert [tracks.skeleton.joints[part.joints[0]] for part in (left, right)] == ["left_hand_wrist", "right_hand_wrist"]
    assert len(left.joints) == len(right.joints) == 21
    off = kt.PKC()(tracks).observed - both
    assert float((off - off.mean(1, keepdim=True)).norm(dim=-1).mean()) < 15


def test_a_hand_that_is_hardly_seen_is_the_bodys(person):
    tracks = person[1]
    weights = tracks.weights.clone()
    left = [
        k for k, name in enumerate(BODY.joints) if name.startswith("left_") and ("thumb" in name or "finger" in name)
    ]
    weights[5:, left] = 0
    hidden = replace(tracks, weights=weights)
    body, right = parts_of(hidden)
    assert right.skeleton.joints[0] == "right_wrist" and set(left) <= {*body.joints}
    weights[:, [k for k, name in enumerate(BODY.joints) if "thumb" not in name and "finger" not in name]] = 0
    assert parts_of(replace(tracks, weights=weights)) == []  # a hand without a body


@pytest.mark.parametrize(
    "how", [{"intrinsics": (9000, 9000, 0, 0)}, {"cameras": torch.eye(3).double()[None, :2].expand(14, 2, 3)}]
)
def test_with_a_lens_and_with_cameras(how):
    tracks = person_with_hands(14)[1]
    result = kt.reconstruct(tracks, **how)
    assert result.points.shape == (14, BODY.num_joints, 3) and bool(result.points.isfinite().all())


def test_a_single_image():
    tracks = person_with_hands(3)[1].frames(1, 2)
    assert len(parts_of(tracks)) == 3
    result = kt.reconstruct(tracks, intrinsics="parallel")
    assert result.points.shape == (1, BODY.num_joints, 3) and bool(result.points.isfinite().all())
