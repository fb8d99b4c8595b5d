"""PKC on clips that tell little: few frames and joints, one pose, nobody seen."""

from dataclasses import replace

import pytest
import torch
from pkc_walks import FLIP, NAN, QUICK, centred, error, of
from torch.testing import assert_close

import kcs_torch as kt
from kcs_torch import PKC, KcsWarning, Skeleton
from kcs_torch.cli.report import describe, summary
from kcs_torch.data import random_motion, walking_person
from kcs_torch.functional import bone_lengths
from kcs_torch.metrics import difference

# Many tests take few steps, after which nothing has settled.
pytestmark = pytest.mark.filterwarnings("ignore::kcs_torch.ConvergenceWarning")


def check(result):
    frames, joints = result.tracks.num_frames, result.tracks.num_joints
    for one in (result, *result.alternatives):
        assert one.points.shape == (frames, joints, 3)
        assert one.uncertainty is None or one.uncertainty.shape == (frames, joints)
        for value in (one.points, one.cameras, one.scales, one.lengths, one.uncertainty, one.root_depth):
            assert value is None or torch.isfinite(value).all()


WALK = walking_person(16, turn=60.0).tracks.points
LITTLE = {
    "one frame": lambda: WALK[:1],
    "static": lambda: WALK[:1].expand(16, -1, -1),
    "one place": lambda: torch.zeros(16, 17, 2),
    "on a line": lambda: WALK * torch.tensor([0.0, 1.0]),
    "a frame unseen": lambda: WALK.index_fill(0, torch.tensor([4]), NAN),
    "a leg unseen": lambda: WALK.index_fill(1, torch.tensor([4, 5, 6]), NAN),
    "the trunk unseen": lambda: WALK.index_fill(1, torch.tensor([0, 7, 8]), NAN),
    "all but two joints unseen": lambda: WALK.index_fill(1, torch.arange(2, 17), NAN),
    "all but one joint unseen": lambda: WALK.index_fill(1, torch.arange(1, 17), NAN),
}


# ---------------------------------------------------------------------- clips that tell little


@pytest.mark.parametrize("viewpoint", ["auto", "fixed", "moving"])
@pytest.mark.parametrize("case", LITTLE)
@pytest.mark.filterwarnings(
    "ignore:.*never seen", "ignore:.*this is hardly a body of skeleton 'h36m17'", "ignore:.*there is no pose to find"
)
def test_clips_that_tell_little(case, viewpoint):
    check(PKC(viewpoint=viewpoint, rounds=1, steps=3)(of(LITTLE[case]())))


def test_one_pose_gives_one_pose():
    result = PKC(viewpoint="fixed", rounds=0)(of(LITTLE["static"]()))
    assert (result.points - result.points[:1]).abs().max() < 20  # mm
    assert result.points[0, :, 2].std() > 30  # and not flat


def test_a_leg_never_seen_is_told_and_uncertain():
    tracks = of(LITTLE["a leg unseen"]())
    with pytest.warns(KcsWarning, match="never seen.*left_knee"):
        result = PKC(**QUICK)(tracks)
    legs = {
        name: [result.skeleton.joints.index(f"{side}_{name}") for side in ("left", "right")]
        for name in ("knee", "ankle")
    }
    for left, right in legs.values():  # as long as the other one
        up = lambda joint: (result.points[:, joint] - result.points[:, 0]).norm(dim=-1).mean()  # noqa: E731
        assert up(left) / up(right) == pytest.approx(1, abs=0.35)


# ---------------------------------------------------------------------- what is held or told


def test_depth_that_is_a_guess_is_told():
    """Without a template nothing tells depth before a camera that stands still."""
    body = replace(walking_person(2).tracks.skeleton, template=None, proportions=None, spread=None, hinges=())
    for turn, told in ((0.0, True), (180.0, False)):
        clip = walking_person(60, turn=turn, yaw=30.0)
        tracks = replace(clip.tracks, skeleton=body)
        if told:
            with pytest.warns(KcsWarning, match="little more than a guess"):
                found = PKC()(tracks)
            assert error(found.points, clip.points) > 0.3
            assert found.uncertainty.mean() > 0.3 * centred(clip.points)[..., 2].square().mean().sqrt()
        else:
            found = PKC()(tracks)
            assert error(found.points, clip.points) < 0.1 or error(found.points * FLIP, clip.points) < 0.1
        assert any("guess" in note for note in found.diagnostics.notes) == told
        assert not any("template and lengths" in note for note in found.diagnostics.notes)


def test_poses_are_held_where_nobody_is_seen():
    """A model of motion would run off beyond the clip's ends."""
    clip = walking_person(60, turn=0.0, yaw=40.0)
    weights = clip.tracks.weights.clone()
    weights[:12], weights[-9:] = 0, 0
    noise = 0.01 * centred(clip.points).square().sum(-1).mean().sqrt()
    points = clip.tracks.points + noise * torch.randn(
        clip.tracks.points.shape, generator=torch.Generator().manual_seed(0)
    )
    found = PKC()(replace(clip.tracks, points=torch.where(weights[..., None] > 0, points, 0), weights=weights))
    size = bone_lengths(found.points, clip.tracks.skeleton.bone_index())
    assert (size[:12] < 1.3 * size.median(0).values).all() and (size[-9:] < 1.3 * size.median(0).values).all()
    assert any("21 frames at the clip's ends show nobody" in note for note in found.diagnostics.notes)
    weights[:-1] = clip.tracks.weights[:-1]
    one = PKC(rounds=0, steps=3)(replace(clip.tracks, weights=weights))
    assert any("1 frame at the clip's ends shows nobody" in note for note in one.diagnostics.notes)


@pytest.mark.filterwarnings("ignore::kcs_torch.KcsWarning")
def test_too_little_for_the_moving_viewpoint_is_told():
    clip = random_motion(Skeleton.from_names(list("abc"), [("a", "b"), ("b", "c")]), turn=180)
    assert any("solved by sfam" in note for note in PKC()(clip.tracks).diagnostics.notes)


@pytest.mark.filterwarnings("ignore::kcs_torch.KcsWarning")
@pytest.mark.parametrize("joints", ["ab", "abc"])
@pytest.mark.parametrize("frames", [1, 24])
def test_bodies_of_two_or_three_joints_keep_their_lengths(joints, frames):
    body = Skeleton(joints, [(i, i + 1) for i in range(len(joints) - 1)])
    tracks = random_motion(body, frames, turn=90.0, generator=torch.Generator().manual_seed(0)).tracks
    found = PKC()(tracks)
    lengths = bone_lengths(found.points, body.bone_index())
    assert_close(lengths, lengths.mean(0).expand_as(lengths), rtol=1e-6, atol=0)
    assert_close(found.points[..., :2], tracks.points, rtol=0, atol=1e-6 * float(tracks.points.abs().max()))


@pytest.mark.parametrize("lens", ["parallel", (1500.0, 1500.0, 960.0, 540.0)])
def test_of_a_single_image_nothing_is_told_of_time(lens):
    points = random_motion("coco17", 1, generator=torch.Generator().manual_seed(0)).tracks.points[:, :17] / 5 + 500
    found = kt.reconstruct(
        points, confidence=0.7 * torch.ones(1, 17), skeleton="coco17", intrinsics=lens, detections=True
    )
    told = " | ".join(found.diagnostics.notes)
    assert "a single image shows one viewpoint" in told and "taken for a detector's joints" in told
    for wrong in ("turned by", "frames", "root depth", "varies by a factor"):
        assert wrong not in told
    words = " | ".join(describe(summary(found)).splitlines())
    assert "1 frame, 17 joints" in words and "100 %" not in words
    assert "viewpoint turn" not in words and "bone variation" not in words
    assert all("%" not in str(difference(found, other)) for other in found.alternatives)
