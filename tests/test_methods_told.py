"""What every method does with joints that are not seen, and what it tells the user: warnings, errors, notes."""

import math
import re
import warnings
from dataclasses import dataclass, replace

import pytest
import torch
from method_clips import BODY, CLIP, NAN, WALK, check, hidden, notes, quiet, tracks_of

from kcs_torch import (
    METHODS,
    ConvergenceWarning,
    KcsWarning,
    OptionError,
    ShapeError,
    Skeleton,
    Tracks,
    reconstruct,
)
from kcs_torch.data import random_motion, walking_person
from kcs_torch.methods.base import Estimate, Method

"""What rounding may change, a share of the body: PKC's quasi-Newton steps, cut off at a number, make 1e-3 of 1e-14."""


# ---------------------------------------------------------------------- unseen joints and frames


@pytest.mark.parametrize("method", METHODS)
def test_blank_frames_lie_between_their_neighbours(method):
    clip = random_motion("h36m17", 60, turn=120.0, generator=torch.Generator().manual_seed(0))
    points = clip.tracks.points.clone()
    points[25:35] = NAN
    plain, gap = (reconstruct(tracks_of(p), method=method).points for p in (clip.tracks.points, points))
    size = (gap - gap.mean(1, keepdim=True)).norm(dim=(1, 2))
    assert size[25:35].min() > 0.85 * size.median()  # the body does not shrink
    step = (gap[1:] - gap[:-1]).norm(dim=-1).mean(-1)
    assert step[24:36].max() < 3 * (plain[1:] - plain[:-1]).norm(dim=-1).mean(-1).max()  # nor does it jump


@pytest.mark.parametrize("method", METHODS)
def test_a_joint_never_seen_is_placed_and_told_of(method):
    tracks = hidden(slice(None), 6)  # the left ankle
    with pytest.warns(KcsWarning, match=f"never seen.*{BODY.joints[6]}") as told:
        result = reconstruct(tracks, method=method)
    assert sum("never seen" in str(w.message) for w in told) == 1
    left = BODY.bone_names.index(f"{BODY.joints[5]}-{BODY.joints[6]}")
    right = BODY.bone_names.index(f"{BODY.joints[2]}-{BODY.joints[3]}")
    assert result.lengths[left] / result.lengths[right] == pytest.approx(1, abs=0.35)
    # below the knee, as the template has it
    assert (result.points[:, 6, 1] > result.points[:, 5, 1]).all()


def test_where_nothing_tells_a_joints_place_its_depth_is_as_unsure_as_the_body_is_large():
    """Without a template a joint that no frame shows takes its neighbour's place."""
    body = Skeleton.from_edges([((i - 1) // 2, i) for i in range(1, 13)], 13, name="twig")
    points = random_motion(body, 40, turn=180.0).tracks.points.clone()
    points[:, 12] = torch.nan
    with pytest.warns(KcsWarning, match="never seen, so placed beside their neighbours, as there is no template"):
        result = reconstruct(points, skeleton=body)
    size = (result.points - result.points.mean(1, keepdim=True))[..., :2].square().sum(-1).mean().sqrt()
    assert result.uncertainty[:, 12].min() > 0.8 * size
    assert result.uncertainty[:, :12].median() < 0.5 * size


# A walk is quicker than the camera: cosines and rigid windows cannot tell its depth with all joints seen either.
@pytest.mark.parametrize("method", [name for name in METHODS if name not in ("pta", "local_rigidity")])
def test_half_of_the_joints_suffice(method):
    clip = walking_person(80, turn=180.0, yaw=0.0, generator=torch.Generator().manual_seed(1))
    gone = torch.rand(80, 17, generator=torch.Generator().manual_seed(4)) < 0.5
    tracks = tracks_of(torch.where(gone[..., None], NAN, clip.tracks.points))
    found = reconstruct(tracks, method=method, cameras=clip.cameras).points
    centre = lambda x: x - x.mean(1, keepdim=True)  # noqa: E731
    error = (centre(found) - centre(clip.points)).norm(dim=-1).mean()
    flat = centre(clip.points)[..., 2].abs().mean()
    assert error < 0.7 * flat


# ---------------------------------------------------------------------- warnings and errors


@pytest.mark.parametrize(
    ("method", "fields"),
    [("kcs", {"num_weights": 1, "steps_per_weight": 1, "rounds": 2, "tolerance": 0.0}), ("sfam", {"num_steps": 2})],
)
def test_not_converging_is_a_result_and_one_warning(method, fields):
    with pytest.warns(ConvergenceWarning, match="did not settle within") as told:
        result = reconstruct(CLIP.tracks, method=method, **fields)
    assert len(told) == 1
    assert not result.diagnostics.converged
    assert any("did not settle" in n for n in result.diagnostics.notes)
    check(result, CLIP.tracks)


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize(
    ("cameras", "words"),
    [
        (torch.eye(3)[:2], "3 dimensions"),
        (torch.eye(3).expand(12, 3, 3), "expected finite (12, 2, 3), got (12, 3, 3)"),
        (torch.eye(3)[:2].expand(11, 2, 3), "expected finite (12, 2, 3), got (11, 2, 3)"),
        (torch.eye(3)[:2].expand(12, 2, 3) * NAN, "got NaN or infinity in 12 frames, the first of which is 0"),
        (torch.eye(3)[:2].expand(12, 2, 3) * 2, "not orthonormal in 12 frames, the first of which is 0;"),
        (torch.zeros(12, 2, 3), "not orthonormal in 12 frames"),
        ("turning", "array of numbers"),
        ([[[1, 0, 0], [0, 1]]], "array of numbers"),
    ],
)
def test_bad_cameras(method, cameras, words):
    with pytest.raises(ShapeError) as caught:
        reconstruct(CLIP.tracks, method=method, cameras=cameras)
    assert str(caught.value).startswith("cameras") and words in str(caught.value)


@pytest.mark.parametrize(
    ("method", "field", "value"),
    [
        ("kcs", "rounds", 0),
        ("kcs", "rounds", 2.5),
        ("kcs", "rounds", "three"),
        ("kcs", "rounds", True),
        ("kcs", "rounds", None),
        ("kcs", "tolerance", -1.0),
        ("kcs", "tolerance", NAN),
        ("kcs", "mu", 0.0),
        ("kcs", "mu", NAN),
        ("kcs", "mu", math.inf),
        ("kcs", "rho", 1.0),
        ("kcs", "rho", 0),
        ("kcs", "rho", 1e-300),
        ("kcs", "num_weights", 0),
        ("kcs", "steps_per_weight", 0),
        ("kcs", "scale_range", 0.9),
        ("kcs", "robust", 0.0),
        ("kcs", "continuity", -1),
        ("kcs", "bone_steps", -1),
        ("kcs", "arrangement", "columns"),
        ("kcs", "arrangement", 3),
        ("kcs", "links", "left_wrist"),
        ("kcs", "links", [("left_wrist",)]),
        ("kcs", "template", "human"),
        ("sfam", "beta", -0.1),
        ("sfam", "beta", "stiff"),
        ("sfam", "num_steps", 0),
        ("sfam", "num_steps", 10.5),
        ("sfam", "mu", math.inf),
        ("sfam", "final", 0.0),
        ("sfam", "final", 0.6),
        ("sfam", "tau", 1.0),
        ("sfam", "momentum", 1.0),
        ("sfam", "articulate_from", 1.1),
        ("sfam", "lengths", "template"),
        ("sfam", "lengths", 3.0),
        ("sfam", "lengths", ()),
        ("sfam", "lengths", [1.0, -1.0]),
        ("sfam", "lengths", [1.0, math.inf]),
        ("sfam", "lengths", ["a"]),
        ("sfam", "rank", 0),
        ("sfam", "rank", 1.5),
        ("sfam", "rank", "all"),
        ("sfam", "camera_path", "wild"),
        ("sfam", "trajectories", 0),
        ("sfam", "trajectories", 2.5),
        ("sfam", "window", 1),
        ("sfam", "window", 20.5),
        ("sfam", "overlap", 0),
        ("sfam", "overlap", 200),
    ],
)
def test_fields_out_of_range(method, field, value):
    with pytest.raises(OptionError, match=f"{method}: {field}: expected"):
        METHODS[method](**{field: value})


@pytest.mark.parametrize("method", METHODS)
def test_methods_are_values(method):
    kind = METHODS[method]
    assert kind() == kind() and hash(kind()) == hash(kind()) and kind.name == method
    assert kind.from_options() == kind()
    with pytest.raises(OptionError, match="unknown option of method"):
        kind.from_options(nothing=1)


def test_skeleton_without_template_or_bones_still_names_itself():
    body = Skeleton.from_edges([], 17, name="dots", tree=False)
    result = reconstruct(tracks_of(WALK, skeleton=body), method="kcs")
    assert any("'dots' has no template" in n for n in result.diagnostics.notes)


# ---------------------------------------------------------------------- what the user is told


@quiet
@pytest.mark.parametrize(("method", "told"), [("kcs", False), ("sfam", False), ("pkc", True)])
def test_an_assumed_frame_rate_is_told_where_it_matters(method, told):
    assert ("30 frames a second assumed" in notes(tracks_of(WALK), method)) is told
    assert "assumed" not in notes(tracks_of(WALK, fps=30), method)


@quiet
@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("place", [0.0, 1e6])
def test_joints_that_coincide_are_told(method, place):
    drift = place + torch.linspace(0, 100, 12)[:, None, None].expand(12, 17, 2)
    with pytest.warns(KcsWarning, match="there is no pose to find"):
        result = reconstruct(tracks_of(drift), method=method)
    told = " | ".join(result.diagnostics.notes)
    assert "all joints lie at one point in every frame" in told
    assert result.root_depth is None and "root depth" not in told
    if place:
        assert "one point" not in notes(tracks_of(WALK), method)
        return
    drift = drift.clone()
    drift[0] = math.nan
    assert "all joints lie at one point in every frame" in notes(tracks_of(drift), method)


@quiet
@pytest.mark.parametrize("method", METHODS)
def test_a_body_without_rigid_bones_is_told(method):
    none = Tracks.from_arrays(WALK[:, :5])
    assert none.skeleton.num_bones == 0
    assert "the skeleton has no bones" in notes(none, method)
    names = ["a", "b", "c"]
    bending = Skeleton.from_names(names, [("a", "b"), ("b", "c")], flexible=[("a", "b"), ("b", "c")])
    assert "the skeleton has no rigid bones" in notes(tracks_of(WALK[:, :3], skeleton=bending), method)
    assert "the skeleton has no" not in notes(tracks_of(WALK), method)


@dataclass(frozen=True)
class Breathing(Method):
    """Gives the walk back, growing and shrinking by a share."""

    name = "breathing"
    share: float = 0.2
    settled: bool = True

    def solve(self, tracks, cameras):
        size = 1 + self.share * torch.tensor([1.0, -1.0]).double().repeat(6)
        points = CLIP.points / 1000 * size[:, None, None]
        return Estimate(points, CLIP.cameras, torch.ones(12).double(), self.settled, 3)


def caught_from(method):
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        found = method(CLIP.tracks).diagnostics
    return found, [str(w.message) for w in caught if "bone lengths vary" in str(w.message)]


def test_bones_that_do_not_keep_their_length_are_warned_of():
    found, told = caught_from(Breathing())
    assert found.bone_variation == pytest.approx(20, rel=1e-3)
    assert len(told) == 1 and "walking_person: bone lengths vary by 20.0 %: joints may be wrong" in told[0]
    assert any("bone lengths vary by 20.0 %" in note for note in found.notes)


def test_a_rigid_bone_that_changes_its_length_is_named():
    """The median over bones would not tell: all others keep theirs."""

    class Stretching(Breathing):
        def solve(self, tracks, cameras):
            points = CLIP.points / 1000
            wrist = points[:, 16] + 0.4 * torch.tensor([1.0, -1.0]).double().repeat(6)[:, None] * (
                points[:, 16] - points[:, 15]
            )
            points = torch.cat([points[:, :16], wrist[:, None]], 1)
            return Estimate(points, CLIP.cameras, torch.ones(12).double(), True, 3)

    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        found = Stretching()(CLIP.tracks).diagnostics
    assert found.bone_variation < 0.1
    (told,) = [str(w.message) for w in caught if "rigid bones vary" in str(w.message)]
    assert "walking_person: lengths of rigid bones vary: right_elbow-right_wrist by 40 %: joints may" in told
    assert any("right_elbow-right_wrist by 40 %" in note for note in found.notes)
    weights = CLIP.tracks.weights.clone()
    weights[:, 16] = 0
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        found = Stretching()(replace(CLIP.tracks, weights=weights)).diagnostics
    assert any("never seen" in str(w.message) for w in caught)
    assert not any("rigid bones vary" in told for told in (*found.notes, *(str(w.message) for w in caught)))


def test_joints_in_another_order_are_warned_of():
    """As many joints, but those of another skeleton: no body of this one looks like it."""
    points = walking_person(60, skeleton="coco17", turn=0.0).tracks.points[:, :17]
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")  # that it does not settle may be told as well
        result = METHODS["pkc"]()(Tracks.from_arrays(points, skeleton="h36m17", fps=30))
    told = [str(w.message) for w in caught if "hardly a body of skeleton 'h36m17': bones are" in str(w.message)]
    assert len(told) == 1 and "joints may be wrong, swapped" in told[0]
    assert any("hardly a body of skeleton 'h36m17'" in note for note in result.diagnostics.notes)


def test_a_bone_far_longer_than_its_twin_is_warned_of():
    """One place of a template is mistyped: its bone follows, and the tracks of one view do not object."""
    tracks = walking_person(30, skeleton="h36m17", yaw=30.0, turn=60.0).tracks
    right = tracks.skeleton
    places = dict(zip(right.joints, right.template, strict=True))
    knee, ankle = torch.tensor(places["left_knee"]), torch.tensor(places["left_ankle"])
    bones = [(right.joints[a], right.joints[b]) for a, b in right.bones]
    for times, told in ((1, False), (3, True)):
        places["left_ankle"] = (knee + times * (ankle - knee)).tolist()
        body = Skeleton.from_names(right.joints, bones, template=places)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            found = reconstruct(tracks.points, skeleton=body, fps=30).diagnostics.notes
        words = r"left_knee-left_ankle is [23]\.\d times as long as right_knee-right_ankle \(where the template says so"
        assert any(re.match(words, note) for note in found) == told


@pytest.mark.parametrize(
    ("body", "joints", "told"),
    [
        ("h36m17", {9: 7, 7: 9}, "away from their tracks in most frames that show them, head by"),
        ("coco17", {joint: (joint - 1) % 17 for joint in range(17)}, "hardly a body of skeleton 'coco17'"),
    ],
    ids=["two swapped", "one place on"],
)
def test_so_are_joints_that_other_joints_explain(body, joints, told):
    """PKC keeps bones constant whatever is tracked: lengths that do not vary are no sign of a right order."""
    points = walking_person(60, skeleton=body, yaw=40.0, noise=3.0).tracks.points[:, :17]
    order = [joints.get(joint, joint) for joint in range(17)]
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        result = METHODS["pkc"]()(Tracks.from_arrays(points[:, order], skeleton=body, fps=30))
    heard = [str(w.message) for w in caught]
    assert any(told in message and "in another order" in message for message in heard), heard
    assert any(told in note for note in result.diagnostics.notes)


def test_frames_that_show_nobody_are_warned_of():
    tracks = walking_person(60, turn=0.0, yaw=40.0).tracks
    points = tracks.points.clone()
    draw = torch.Generator().manual_seed(0)
    points[20:28] = 1500 * torch.randn(8, 17, 2, generator=draw, dtype=points.dtype)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        METHODS["pkc"]()(replace(tracks, points=points))
    told = "in 8 of 60 frames, from frame 20 on, most joints are away from their tracks, by up to"
    assert any(told in str(one.message) for one in caught)


@pytest.mark.parametrize(("method", "rests"), [("pkc", ["the template and lengths"]), ("sfam", [])])
def test_what_depth_rests_on_before_a_camera_that_stands_still(method, rests):
    """SfAM knows no template: the user is warned, and told of methods that do, in place of what depth rests on."""
    clip = walking_person(40, turn=0.0)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        found = METHODS[method]()(clip.tracks).diagnostics
    assert [note.partition(": depth rests on ")[2] for note in found.notes if "turned by only" in note] == (
        rests or [""]
    )
    assert not found.doubt or found.notes.count(found.doubt) == 1
    told = [str(w.message) for w in caught if "has nothing else that tells depth" in str(w.message)]
    assert len(told) == (method == "sfam") and all("'pkc' and 'kcs' use the skeleton's template" in t for t in told)
    assert bool(found.doubt) == bool(told) and all(t.endswith(found.doubt) for t in told)
    assert found.brief_doubt == ("depth is little more than a guess" if told else "")  # in the titles of pictures


def test_bones_that_nearly_keep_it_or_are_not_held_or_not_found_yet_are_not():
    found, told = caught_from(Breathing(share=0.04))
    assert found.bone_variation < 5 and not told and "vary" not in " ".join(found.notes)
    assert not caught_from(Breathing(settled=False))[1]  # that it did not converge says why

    class Free(Breathing):
        keeps_lengths = False

    found, told = caught_from(Free())
    assert found.bone_variation > 5 and not told
    said = [note for note in found.notes if "vary" in note]
    assert len(said) == 1 and "does not hold them constant" in said[0] and "swapped" not in said[0]
    assert not METHODS["kcs"].keeps_lengths and METHODS["sfam"].keeps_lengths and METHODS["pkc"].keeps_lengths
