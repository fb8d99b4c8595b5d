"""Joints at a body's ends that no frame shows: solved without, placed afterwards."""

from dataclasses import replace

import pytest
import torch
from torch.testing import assert_close

import kcs_torch as kt
from kcs_torch.data import walking_person
from kcs_torch.methods.pkc.ends import _least_turn, ends_of, estimate_with_ends, without_ends
from kcs_torch.methods.pkc.hands import without_joints

BODY = kt.SKELETONS["wholebody63"]
FINGERS = list(range(23, 63))

pytestmark = pytest.mark.filterwarnings(
    "ignore::kcs_torch.errors.KcsWarning", "ignore::kcs_torch.errors.ConvergenceWarning"
)


def tracks_of(skeleton, unseen, frames=20, **options):
    """A walk whose joints of these names, or numbers, no frame shows; and its points."""
    clip = walking_person(frames, skeleton=skeleton, **options)
    body = clip.skeleton
    points = clip.tracks.points[:, : body.num_observed].clone()
    points[:, [body.index(j) if isinstance(j, str) else j for j in unseen]] = torch.nan
    return kt.Tracks.from_arrays(points, skeleton=body, fps=30, units="mm"), clip.points


def joint_names(tracks):
    return [tracks.skeleton.joints[joint] for joint in ends_of(tracks)]


@pytest.mark.parametrize(
    "unseen, ends",
    [
        ([], []),
        (["left_ankle", "right_ankle"], ["left_ankle", "right_ankle"]),
        (["left_wrist", "right_wrist", "left_elbow", "right_elbow"],
         ["left_elbow", "right_elbow", "left_wrist", "right_wrist"]),
        (["left_elbow", "right_elbow"], []),  # wrists hang on them
        (["left_ankle"], []),  # the other one tells of it
        (["left_ankle", "right_ankle", "left_knee"], ["left_ankle", "right_ankle"]),
        (["left_hip", "right_hip"], []),  # the trunk's, and the pelvis is their middle
    ],
)  # fmt: skip
def test_ends_of_a_person(unseen, ends):
    assert joint_names(tracks_of("coco17", unseen)[0]) == ends


def test_ends_of_a_person_with_hands():
    tracks, _ = tracks_of("wholebody63", FINGERS)
    assert ends_of(tracks) == FINGERS
    one_hand, _ = tracks_of("wholebody63", FINGERS[:20])
    assert ends_of(one_hand) == FINGERS[:20]  # though fingers have twins
    finger, _ = tracks_of("wholebody63", FINGERS[:4])
    assert not ends_of(finger)  # the hand is shown


def test_a_hand_that_few_frames_show_is_told_of():
    tracks, points = tracks_of("wholebody63", FINGERS)
    shown, weights = tracks.points.clone(), tracks.weights.clone()
    shown[3:6, FINGERS[:20]], weights[3:6, FINGERS[:20]] = points[3:6, FINGERS[:20], :2], 1.0
    tracks = replace(tracks, points=shown, weights=weights)
    some = without_ends(tracks)
    assert some.num_joints == BODY.num_joints - 40
    side = next(s for s in ("left", "right") if BODY.joints[FINGERS[0]].startswith(s))
    told = [note for note in some.notes if "show the hand" in note]
    assert told == [f"{side}_wrist: 3 of 20 frames show the hand: its fingers are taken as unseen"]
    result = kt.reconstruct(tracks, intrinsics="parallel", steps=2, rounds=0)
    assert not result.tracks.seen[:, FINGERS].any()
    assert told[0] in result.tracks.notes
    assert told[0] in kt.PKC(steps=2, rounds=0)(tracks).diagnostics.notes


def test_a_hand_of_which_a_few_joints_are_seen_all_along_is_kept():
    tips = [j for j in FINGERS if BODY.joints[j].endswith("4")]
    tracks, _ = tracks_of("wholebody63", [j for j in FINGERS if j not in tips])
    assert not {*ends_of(tracks)} & {*tips}
    hidden = replace(tracks_of("wholebody63", [], frames=10)[0])
    weights = hidden.weights.clone()
    weights[4, FINGERS] = 0
    assert not ends_of(replace(hidden, weights=weights))  # all but one frame of a short clip


def test_what_the_caller_does_is_left_alone():
    tracks, _ = tracks_of("coco17", ["left_ankle", "right_ankle"], frames=8)
    call = lambda: kt.reconstruct(tracks, intrinsics="parallel", steps=2, rounds=0)  # noqa: E731
    plain = call()
    with torch.autocast("cpu", torch.bfloat16):
        assert torch.equal(call().points, plain.points)
    with torch.inference_mode():
        result = call()
    scale = torch.ones((), dtype=torch.float64, requires_grad=True)
    (result.points * scale).sum().backward()
    assert bool(scale.grad.isfinite())


@pytest.mark.parametrize(
    "start, end", [([1.0, 2, 3], [-1.0, -2, -3]), ([0.0, 0, 0], [1.0, 0, 0]), ([0.0, 0, 2], [0.0, 3, 0])]
)
def test_least_turns_are_rotations(start, end):
    a, b = torch.tensor(start).double(), torch.tensor(end).double()
    turn = _least_turn(a, b)
    assert_close(torch.linalg.det(turn), torch.ones(()).double())
    assert_close(turn @ turn.mT, torch.eye(3).double())
    if bool(a.any()):
        assert_close(turn @ a / a.norm(), b / b.norm())


def test_bodies_without_a_template_and_tracks_that_show_nothing_are_whole():
    tracks, _ = tracks_of("coco17", ["left_ankle", "right_ankle"])
    bare = replace(tracks, skeleton=replace(tracks.skeleton, template=None, proportions=None, hinges=(), spread=None))
    assert without_ends(bare) is bare
    nothing = replace(tracks, weights=0 * tracks.weights)
    assert without_ends(nothing) is nothing


@pytest.mark.parametrize(
    "call", [kt.reconstruct, lambda t, **k: kt.PKC()(t), lambda t, **k: kt.reconstruct_all([t])[0]]
)
def test_the_body_is_as_without_them(call):
    tracks, truth = tracks_of("wholebody63", FINGERS, yaw=80.0)
    alone = without_ends(tracks)
    assert alone.skeleton == without_joints(BODY, [j for j in range(BODY.num_joints) if j not in FINGERS])
    result, expected = call(tracks, intrinsics="parallel"), call(alone, intrinsics="parallel")
    kept = [j for j in range(BODY.num_joints) if j not in FINGERS]
    assert float(result.points[..., 2].mean(1).abs().amax()) < 1e-6
    middle = lambda x: x - x[:, :1]  # noqa: E731
    assert_close(middle(result.points[:, kept]), middle(expected.points), rtol=1e-6, atol=1e-3)
    assert result.skeleton == BODY
    assert result.points.shape == truth.shape
    wrists = [BODY.index("left_wrist"), BODY.index("right_wrist")]
    assert bool((result.uncertainty[:, FINGERS] > result.uncertainty[:, wrists].amin(1, keepdim=True)).all())
    assert all(one.points.shape == truth.shape and one.skeleton == BODY for one in result.alternatives)


def test_before_a_camera_they_project_as_before():
    tracks, _ = tracks_of("coco17", ["left_ankle", "right_ankle"], frames=8)
    alone = without_ends(tracks)
    result, expected = (kt.reconstruct(t, intrinsics=(9000, 9000, 0, 0), steps=2, rounds=0) for t in (tracks, alone))
    kept = [tracks.skeleton.index(joint) for joint in alone.skeleton.joints]
    assert_close(result.in_space()[:, kept], expected.in_space())
    assert float(result.points[..., 2].mean(1).abs().amax()) < 1e-6
    assert_close(result.root_depth, result.distance - result.distance[0])
    assert_close(result.scales, 9000 / result.distance, rtol=1e-2, atol=0)


def test_notes_and_warnings_name_them():
    tracks, _ = tracks_of("coco17", ["left_ankle", "right_ankle"])
    with pytest.warns(
        kt.errors.KcsWarning, match="never seen, so placed by the skeleton alone: left_ankle, right_ankle"
    ):
        result = kt.reconstruct(tracks, steps=2)
    said = [note for note in result.tracks.notes if "never seen" in note]
    assert said == ["never seen, so placed by the skeleton alone: left_ankle, right_ankle"]
    assert any(
        "no frame shows what touches the ground (left_ankle, right_ankle)" in n for n in result.diagnostics.notes
    )
    assert result.diagnostics.unseen_share == tracks.unseen_share


def test_a_hand_follows_the_forearm():
    """The template is placed exactly, however it is turned; and what hangs on a bone that is turned goes with it."""
    generator = torch.Generator().manual_seed(0)
    turn = torch.linalg.qr(torch.randn(4, 3, 3, generator=generator, dtype=torch.float64))[0]
    turn = turn * torch.linalg.det(turn)[:, None, None]
    rest = 3 * BODY.template_points(dtype=torch.float64) @ turn
    tracks, _ = tracks_of("wholebody63", FINGERS, frames=4)
    some = without_ends(tracks)
    kept = [j for j in range(BODY.num_joints) if j not in FINGERS]

    def completed(points):
        made = kt.methods.base.Estimate(points[:, kept], turn[:, :2], turn[:, 0, 0], True, 1)
        full = estimate_with_ends(made, some, tracks).points
        return full - full[:, :1] + points[:, :1]

    assert_close(completed(rest), rest)
    bent = rest.clone()
    elbow, wrist = BODY.index("left_elbow"), BODY.index("left_wrist")
    hand = [wrist, *(j for j in FINGERS if BODY.joints[j].startswith("left"))]
    forearm = rest[:, wrist] - rest[:, elbow]
    aside = torch.linalg.cross(forearm, torch.randn(4, 3, generator=generator, dtype=torch.float64), dim=-1)
    swing = kt.functional.rotation_matrix(1.2 * aside / aside.norm(dim=-1, keepdim=True))
    bent[:, hand] = (rest[:, hand] - rest[:, elbow, None]) @ swing.mT + rest[:, elbow, None]
    assert_close(completed(bent), bent)


def test_standing_feet_keep_their_columns():
    tracks, _ = tracks_of("halpe26", ["LSmallToe", "RSmallToe"], frames=8)
    some = without_ends(tracks)
    body = tracks.skeleton
    count = len(some.skeleton.contacts)
    assert 0 < count < len(body.contacts)
    points = torch.randn(8, some.num_joints, 3, dtype=torch.float64)
    rows = torch.eye(3, dtype=torch.float64)[:2].expand(8, 2, 3)
    found = kt.methods.base.Estimate(
        points, rows, torch.ones(8).double(), True, 1, standing=torch.rand(8, count).double()
    )
    standing = estimate_with_ends(found, some, tracks).standing
    for k, joint in enumerate(body.contacts):
        name = body.joints[joint]
        there = [some.skeleton.joints[j] for j in some.skeleton.contacts]
        expected = found.standing[:, there.index(name)] if name in there else torch.zeros(8).double()
        assert_close(standing[:, k], expected)


def test_what_is_whole_stays():
    tracks, _ = tracks_of("coco17", [])
    assert without_ends(tracks) is tracks
    result = kt.reconstruct(tracks, method="kcs")
    assert kt.KCS().with_ends(result, tracks) is result
