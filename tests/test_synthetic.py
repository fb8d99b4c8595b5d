"""The generator of walking people and random motion keeps what it promises."""

import math
from dataclasses import replace

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from kcs_torch.data import random_motion, walking_person
from kcs_torch.data.gait import STRIDE_METRES, STRIDE_SECONDS
from kcs_torch.errors import OptionError, SkeletonError
from kcs_torch.functional import bone_lengths, bone_vectors, complete_rotation
from kcs_torch.skeleton import SKELETONS, Skeleton, person_by_names

HUMANS = sorted(set(SKELETONS) - {"ap10k", "hand21"})
FRONT = {"yaw": 0.0, "pitch": 0.0, "turn": 0.0}  # the camera frame is the world: the person walks towards -z


def seeded(seed=0):
    return torch.Generator().manual_seed(seed)


def world(clip):
    """Points back in the world frame."""
    return clip.points @ complete_rotation(clip.cameras)


@pytest.mark.parametrize("name", HUMANS)
def test_lengths_are_constant(name):
    clip = walking_person(70, skeleton=name)
    lengths = bone_lengths(clip.points, clip.skeleton.bones)
    assert (lengths - lengths[0]).abs().max() < 1e-9
    assert lengths.min() > 10  # mm
    assert clip.points.shape == (70, clip.skeleton.num_joints, 3) and clip.cameras.shape == (70, 2, 3)
    # proportions of the template, at the stature that was asked for
    ratio = lengths[0] / lengths.mean() / clip.skeleton.relative_lengths(dtype=torch.float64)
    assert (ratio - 1).abs().max() < 1e-9
    tall = walking_person(2, skeleton=name, height=3.5)
    assert torch.allclose(bone_lengths(tall.points, clip.skeleton.bones)[0], 2 * lengths[0])


def test_stature():
    clip = walking_person(2, skeleton="cmu17", height=1.75)
    shank = clip.skeleton.bone_names.index("l_knee-l_ankle")
    assert bone_lengths(clip.points, clip.skeleton.bones)[0, shank] == pytest.approx(436, abs=1)


def test_tracks_are_the_first_two_coordinates():
    for name in ("h36m17", "coco17"):
        clip = walking_person(30, skeleton=name)
        assert torch.allclose(clip.tracks.points, clip.points[..., :2], atol=1e-9)
        assert (clip.tracks.weights == 1).all()
        assert clip.tracks.units == "mm" and clip.tracks.fps == 30


def test_virtual_joints_are_means_of_their_sources():
    clip = random_motion("mediapipe33", 20, generator=seeded())
    for joint, sources in clip.skeleton.virtual:
        assert torch.allclose(clip.points[:, joint], clip.points[:, list(sources)].mean(1), atol=1e-9)


def test_cameras_are_those_that_filmed():
    front = walking_person(50, **FRONT)
    orbit = walking_person(50, yaw=30.0, pitch=20.0, turn=140.0)
    eye = torch.eye(2, dtype=torch.float64).expand(50, 2, 2)
    assert torch.allclose(orbit.cameras @ orbit.cameras.mT, eye)
    assert torch.allclose(world(orbit), front.points, atol=1e-9)
    first, last = complete_rotation(orbit.cameras)[[0, -1]]
    cosine = ((first @ last.mT).trace() - 1) / 2
    assert math.degrees(math.acos(float(cosine))) == pytest.approx(140)
    assert orbit.cameras[0, 1, 1] == pytest.approx(math.cos(math.radians(20)))
    # from above: what is farther away is seen higher up, that is at a smaller y
    away = complete_rotation(orbit.cameras)[0, 2] * torch.tensor([1.0, 0.0, 1.0])
    assert orbit.cameras[0, 1] @ away < 0
    # 90 degrees: to the right
    side = walking_person(30, yaw=90.0, pitch=0.0, turn=0.0)
    assert side.points[-1, 0, 0] - side.points[0, 0, 0] > 500


def test_it_walks():
    seconds, fps = 5, 30
    clip = walking_person(seconds * fps, skeleton="body25", fps=fps, **FRONT)
    at = {j: clip.points[:, i] for i, j in enumerate(clip.skeleton.joints)}
    strides = (seconds - 1 / fps) / STRIDE_SECONDS
    assert at["MidHip"][0, 2] - at["MidHip"][-1, 2] == pytest.approx(1000 * STRIDE_METRES * strides)
    for side in "LR":
        hip, knee, ankle = (at[f"{side}{j}"] for j in ("Hip", "Knee", "Ankle"))
        assert ((hip + ankle)[:, 2] / 2 - knee[:, 2]).min() > 5  # mm: knees bend forwards, and never through
        shoulder, elbow, wrist = (at[f"{side}{j}"] for j in ("Shoulder", "Elbow", "Wrist"))
        along = torch.nn.functional.normalize(wrist - shoulder, dim=-1)
        bend = elbow - shoulder - ((elbow - shoulder) * along).sum(-1, keepdim=True) * along
        assert bend[:, 2].min() > 5  # elbows bend backwards
    # feet alternate, and arms go against them
    ahead = at["RAnkle"][:, 2] - at["LAnkle"][:, 2]
    assert ahead.max() > 400 and ahead.min() < -400
    changes = int((ahead[1:].sign() != ahead[:-1].sign()).sum())
    assert changes == pytest.approx(2 * strides, abs=1)
    arms = at["RWrist"][:, 2] - at["LWrist"][:, 2]
    assert torch.corrcoef(torch.stack([ahead, arms]))[0, 1] < -0.9
    # one foot stands on the floor at any time; it does not slide
    feet = torch.stack([at[f"{s}{j}"] for s in "LR" for j in ("Heel", "BigToe")], 1)
    floor = feet[..., 1].amax(1)
    assert floor.max() - floor.min() < 50
    slowest = feet.diff(dim=0).norm(dim=-1).amin(1) * fps
    assert slowest.max() < 400  # mm/s, a third of the walking speed at most, where feet change
    assert slowest.median() < 100
    # the head stays above the feet
    assert (at["Nose"][:, 1] < at["MidHip"][:, 1]).all() and (at["MidHip"][:, 1] + 600 < floor).all()


def test_noise_and_gaps():
    plain = walking_person(2000)
    clip = walking_person(2000, noise=7.0, missing=0.3, generator=seeded())
    assert torch.equal(clip.points, plain.points)
    seen = clip.tracks.seen
    assert clip.tracks.unseen_share == pytest.approx(0.3, abs=0.02)
    assert torch.isfinite(clip.tracks.points).all() and (clip.tracks.points[~seen] == 0).all()
    error = (clip.tracks.points - clip.points[..., :2])[seen]
    assert error.std() == pytest.approx(7, rel=0.03) and abs(float(error.mean())) < 0.2
    # gaps last at least 5 frames, but at the ends of the clip
    hidden = (~seen).int().T
    begins = torch.nn.functional.pad(hidden.diff(dim=1), (1, 0)) == 1
    for joint, frame in begins.nonzero().tolist():
        assert hidden[joint, frame : frame + 5].all()


def test_randomness_comes_from_the_generator_alone():
    before = torch.random.get_rng_state()
    make = [
        lambda seed: walking_person(20, noise=1.0, missing=0.2, generator=seeded(seed)),
        lambda seed: random_motion("ap10k", 20, noise=1.0, missing=0.2, generator=seeded(seed)),
    ]
    for clip in make:
        one, same, other = clip(1), clip(1), clip(2)
        assert torch.equal(one.tracks.points, same.tracks.points) and torch.equal(one.points, same.points)
        assert not torch.equal(one.tracks.points, other.tracks.points)
    assert torch.equal(torch.random.get_rng_state(), before)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_dtype(dtype):
    for clip in (walking_person(3, dtype=dtype), random_motion("hand21", 3, dtype=dtype)):
        assert clip.points.dtype == clip.cameras.dtype == clip.tracks.points.dtype == clip.tracks.weights.dtype == dtype


def test_one_frame():
    assert walking_person(1).points.shape == (1, 17, 3)
    assert random_motion("ap10k", 1).points.shape == (1, 17, 3)


@pytest.mark.parametrize("name", sorted(SKELETONS))
def test_random_motion_of_built_in(name):
    clip = random_motion(name, 50, generator=seeded())
    body = clip.skeleton
    lengths = bone_lengths(clip.points, body.bones)
    assert (lengths - lengths[0]).abs().max() < 1e-9
    # every bone turns, and smoothly
    unit = bone_vectors(clip.points, body.bones) / lengths[..., None]
    step = unit.diff(dim=0).norm(dim=-1)
    assert (step.sum(0) > 0.3).all() and step.max() < 0.5


@st.composite
def forests(draw):
    count = draw(st.integers(2, 9))
    bones = [(draw(st.integers(0, i - 1)), i) for i in range(1, count) if i == 1 or draw(st.integers(0, 4))]
    return Skeleton.from_edges(draw(st.permutations(bones)), count, tree=False)


@settings(deadline=None, max_examples=40)
@given(forests(), st.integers(1, 12), st.integers(0, 1000))
def test_random_motion_of_any_forest(body, num_frames, seed):
    clip = random_motion(body, num_frames, size=500.0, generator=seeded(seed))
    assert clip.skeleton == body
    lengths = bone_lengths(clip.points, body.bones)
    assert (lengths - lengths[0]).abs().max() < 1e-9
    assert 0 < lengths[0].sum() <= 500 + 1e-9


def test_bones_on_the_way_from_a_virtual_joint_to_its_sources_are_rigid():
    """A neck, the middle of shoulders that hang on collar bones."""
    parts = ("clavicle", "shoulder", "elbow")
    body = person_by_names([f"{side}_{part}" for part in parts for side in ("left", "right")])
    clip = random_motion(body, 40, generator=seeded())
    lengths = bone_lengths(clip.points, body.bones)
    assert (lengths - lengths[0]).abs().max() < 1e-9
    ((neck, shoulders),) = body.virtual
    assert torch.allclose(clip.points[:, neck], clip.points[:, list(shoulders)].mean(1))


def test_random_motion_keeps_given_proportions():
    body = Skeleton.from_names(["a", "b", "c"], [("a", "b"), ("b", "c")], proportions={"a-b": 1, "b-c": 3})
    clip = random_motion(body, 5, size=100.0, generator=seeded())
    assert bone_lengths(clip.points, body.bones)[0].tolist() == pytest.approx([25, 75])


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"num_frames": 0}, "num_frames: expected a whole number, at least 1, got 0"),
        ({"num_frames": 2.5}, "num_frames"),
        ({"fps": 0}, "fps: expected a positive number"),
        ({"fps": math.nan}, "fps"),
        ({"height": -1}, "height"),
        ({"noise": -1}, "noise"),
        ({"noise": "x"}, "noise: expected a number not below 0, got 'x'"),
        ({"yaw": math.nan}, "yaw: expected a finite number of degrees, got nan"),
        ({"turn": None}, "turn: expected a finite number of degrees, got None"),
        ({"missing": 1}, "missing: expected a share"),
        ({"missing": -0.1}, "missing"),
    ],
)
def test_numbers_out_of_range(options, message):
    with pytest.raises(OptionError, match=message):
        walking_person(**options)


def test_skeletons_that_do_not_fit():
    with pytest.raises(SkeletonError, match=r"'root_of_tail'.*random_motion takes any skeleton"):
        walking_person(skeleton="ap10k")
    with pytest.raises(SkeletonError, match="closed chain"):
        walking_person(skeleton=SKELETONS["coco17"].with_links([("left_wrist", "right_wrist")]))
    with pytest.raises(SkeletonError, match="without closed chains"):
        random_motion(SKELETONS["coco17"].with_links([("left_wrist", "right_wrist")]))
    with pytest.raises(SkeletonError, match="has no bones"):
        random_motion(Skeleton.from_edges([], 3, tree=False))


def test_a_template_in_another_unit_or_elsewhere_gives_the_same_person():
    names, bones = ["LHip", "LKnee", "LAnkle"], [("LHip", "LKnee"), ("LKnee", "LAnkle")]
    metres = Skeleton.from_names(names, bones, template="human")
    inches = Skeleton.from_names(
        names, bones, template={j: [39.37 * c for c in p] for j, p in zip(names, metres.template, strict=True)}
    )
    bare = Skeleton.from_names(names, bones)
    shifted = replace(metres, template=[(x, y - 0.9, z + 3) for x, y, z in metres.template])
    for body in (inches, bare, shifted):
        assert torch.allclose(walking_person(9, skeleton=body).points, walking_person(9, skeleton=metres).points)
