"""PKC with known cameras: depth that they tell, and which mirror image."""

import math
from dataclasses import replace

import pytest
import torch
from pkc_walks import FLIP, error, robot

import kcs_torch as kt
from kcs_torch import PKC, KcsWarning, Skeleton
from kcs_torch.data import random_motion, walking_person
from kcs_torch.functional import complete_rotation, orbit
from kcs_torch.functional.rotation import rotation_matrix

# Many tests take few steps, after which nothing has settled.
pytestmark = pytest.mark.filterwarnings("ignore::kcs_torch.ConvergenceWarning")


def test_known_cameras_tell_the_mirror_images_apart(turning):
    clip, _ = turning
    result = PKC(viewpoint="moving")(clip.tracks, clip.cameras)
    assert error(result.points, clip.points) < 0.1
    assert torch.equal(result.cameras, clip.cameras) and result.alternatives == ()


def test_known_cameras_are_those_of_every_solution(turning):
    clip, _ = turning
    result = PKC()(clip.tracks, clip.cameras)
    assert result.root_depth is None  # feet that stand still do not do so in the image
    assert error(result.points, clip.points) < 0.1
    for one in (result, *result.alternatives):
        assert torch.equal(one.cameras, clip.cameras)
        assert error(one.points * FLIP, clip.points) > 1  # none is the mirror image


@pytest.mark.parametrize("turn", [15.0, 60.0])
def test_known_cameras_make_nothing_worse(turn):
    """A little turn tells the sign of depth, but hardly depth: that still comes from the template."""
    clip = walking_person(50, turn=turn, yaw=40.0)
    plain, known = PKC()(clip.tracks), PKC()(clip.tracks, clip.cameras)
    assert error(known.points, clip.points) < 0.05
    assert error(known.points, clip.points) < 1.1 * error(plain.points, clip.points)


def test_known_cameras_rank_what_the_turn_tells_of_a_body_unlike_its_template():
    """That is a rival of what the template tells, and goes better with the cameras: without them it wins, too."""
    clip = walking_person(60, turn=120.0)
    body = clip.tracks.skeleton
    other = torch.tensor(body.template) * torch.tensor([1.0, 0.6, 1.0])
    other[[body.index(name) for name in ("left_wrist", "right_wrist", "left_knee", "right_knee")]] *= 1.3
    tracks = replace(clip.tracks, skeleton=replace(body, template=tuple(map(tuple, other.tolist()))))
    for cameras in (None, clip.cameras):
        assert error(PKC()(tracks, cameras).points, clip.points) < 0.05


def test_cameras_that_are_known_to_stand_still_tell_nothing(still):
    clip, plain = still
    known = PKC()(clip.tracks, clip.cameras)
    assert torch.equal(known.points, plain.points) and torch.equal(known.cameras, clip.cameras)


@pytest.mark.filterwarnings("ignore::kcs_torch.KcsWarning")
@pytest.mark.parametrize("side", [1.0, -1.0])
@pytest.mark.parametrize("body", ["hand21", "robot"])
def test_known_cameras_tell_which_of_two_mirror_images(body, side):
    """Of a hand that may be the other one, and of a body without a template: the same tracks, cameras the other way."""
    if body == "robot":
        clip = robot()
    else:
        clip = random_motion(body, 90, turn=120.0, swing=15.0, generator=torch.Generator().manual_seed(3))
    flip = torch.tensor([1.0, 1.0, side]).double()
    rotations = flip[:, None] * complete_rotation(clip.cameras) * flip
    result = PKC(lifts=2)(clip.tracks, rotations[:, :2])
    assert error(result.points, clip.points * flip) < 0.3
    assert error(result.points * FLIP, clip.points * flip) > 1
    if body == "robot":
        assert result.alternatives == ()


def swinging_hand(frames=60):
    """A hand that itself turns farther than the cameras, by more than 30 degrees: its skeleton, points and cameras."""
    time = torch.linspace(0, 1, frames).double()[:, None]
    swings = math.radians(50) * (5 * time + 2).sin() * torch.tensor([0.3, 1.0, 0.0]).double()
    cameras = orbit(30 * time[:, 0])
    clip = random_motion("hand21", frames, turn=0.0, swing=15.0, generator=torch.Generator().manual_seed(3))
    points = clip.points @ rotation_matrix(swings).mT @ cameras.mT
    return clip.tracks, points - points.mean(1, keepdim=True), cameras[:, :2]


def test_a_hand_that_itself_turns_farther_than_known_cameras_is_the_templates():
    """By chance its swings look like a camera's turn, here as its mirror image has it, which is offered beside it."""
    tracks, points, cameras = swinging_hand()
    with pytest.warns(KcsWarning, match="depth may be mirrored: the known cameras turn too little"):
        result = PKC()(replace(tracks, points=points[..., :2]), cameras)
    assert error(result.points, points) < error(result.points * FLIP, points) / 2
    assert min(error(one.points * FLIP, result.points) for one in result.alternatives) < 0.01


def test_lengths_along_rays_tell_such_a_hand_from_its_mirror_image(recwarn):
    tracks, points, cameras = swinging_hand()
    rays = points + torch.tensor([0.0, 0.0, 1500.0]).double()
    image = 1000 * rays[..., :2] / rays[..., 2:]
    result = kt.reconstruct(replace(tracks, points=image), cameras=cameras, intrinsics=(1000, 1000, 0, 0))
    assert not [w for w in recwarn if "mirrored" in str(w.message)] and "mirrored" not in result.diagnostics.doubt
    assert not any("mirrored" in note for note in result.diagnostics.notes)
    found = 1.5 * result.points  # a pixel at the hand's distance is 1.5 mm
    assert error(found, points) < error(found * FLIP, points) / 2


@pytest.mark.filterwarnings("ignore::kcs_torch.KcsWarning")  # links that are no tree are pulled on but weakly
def test_known_cameras_and_markers():
    clip = robot()
    arm = clip.tracks.skeleton
    body = Skeleton(arm.joints, (*arm.bones, (0, 2), (1, 3)), flexible=(4, 5), tree=False)
    tracks = replace(clip.tracks, skeleton=body)
    plain, known = PKC()(tracks), PKC()(tracks, clip.cameras)
    best = min(error(points, clip.points) for points in (plain.points, plain.points * FLIP))
    assert error(known.points, clip.points) == pytest.approx(best)
