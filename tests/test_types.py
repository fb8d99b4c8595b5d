"""What goes in and what comes out: every bad input is refused in words, and results change as they should."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st
from samples import walk_result
from torch.testing import assert_close

from kcs_torch import KcsError, Motion, OptionError, ShapeError, SkeletonError, Tracks
from kcs_torch.data import walking_person
from kcs_torch.errors import FormatError, KcsWarning
from kcs_torch.functional import bone_lengths
from kcs_torch.skeleton import SKELETONS, Skeleton
from kcs_torch.types.size import check_size, size_factor

NAN, INF = math.nan, math.inf


def grid(frames=4, joints=17, dtype=torch.float64):
    """Tracks of different numbers everywhere."""
    return torch.arange(frames * joints * 2, dtype=dtype).reshape(frames, joints, 2)


def with_value(array, index, value):
    array = array.clone()
    array[index] = value
    return array


# ---------------------------------------------------------------------- Tracks: what is accepted


@pytest.mark.parametrize("kind", [torch.Tensor.numpy, torch.Tensor.clone, torch.Tensor.tolist])
def test_arrays_of_any_kind(kind):
    points = kind(grid())
    tracks = Tracks.from_arrays(points, skeleton="h36m17", fps=25, units="mm", source="walk.csv", notes=["hello"])
    assert_close(tracks.points, grid())
    assert (tracks.num_frames, tracks.num_joints, tracks.unseen_share) == (4, 17, 0.0)
    assert tracks.seen.all() and torch.equal(tracks.weights, torch.ones(4, 17, dtype=torch.float64))
    assert (tracks.fps, tracks.units, tracks.source, tracks.notes) == (25, "mm", "walk.csv", ("hello",))


def test_what_a_masked_array_masks_is_unseen():
    points, sure = np.ma.masked_array(grid().numpy()), np.ma.masked_array(np.ones((4, 17)))
    points[1, 2] = sure[2, 3] = np.ma.masked
    tracks = Tracks.from_arrays(points, sure, skeleton="h36m17")
    assert (~tracks.seen).nonzero().tolist() == [[1, 2], [2, 3]]


@pytest.mark.parametrize(
    ("given", "kept"),
    [
        (torch.float32, torch.float32),
        (torch.float64, torch.float64),
        (torch.float16, torch.float32),  # no factorisation takes half precision
        (torch.bfloat16, torch.float32),
        (torch.int64, torch.float64),
    ],
)
def test_dtypes(given, kept):
    tracks = Tracks.from_arrays(grid(dtype=given), torch.ones(4, 17, dtype=torch.float64))
    assert (tracks.points.dtype, tracks.weights.dtype) == (kept, kept)
    assert tracks.to(torch.float32).points.dtype == tracks.to(torch.float32).weights.dtype == torch.float32


def test_arguments_are_left_alone():
    points, confidence = with_value(grid(), (1, 2), NAN), torch.full((4, 17), 0.2, dtype=torch.float64)
    confidence[0] = 1
    before = points.clone(), confidence.clone()
    Tracks.from_arrays(points, confidence)
    assert_close(points, before[0], equal_nan=True, rtol=0, atol=0)
    assert torch.equal(confidence, before[1])


@pytest.mark.parametrize("half", [(1, 2), (1, 2, 0), (1, 2, 1)])
def test_nan_in_either_coordinate_means_unseen(half):
    tracks = Tracks.from_arrays(with_value(grid(), half, NAN))
    assert tracks.weights[1, 2] == 0 and (tracks.points[1, 2] == 0).all()
    assert int(tracks.seen.sum()) == 4 * 17 - 1
    assert tracks.unseen_share == pytest.approx(1 / 68)


def test_confidence_is_a_weight_above_the_threshold():
    confidence = torch.linspace(0, 1, 17, dtype=torch.float64).expand(4, 17)
    tracks = Tracks.from_arrays(grid(), confidence, threshold=0.5)
    assert_close(tracks.weights, torch.where(confidence >= 0.5, confidence, torch.zeros_like(confidence)))
    assert (tracks.points[:, :8] == 0).all()
    assert_close(tracks.points[:, 8:], grid()[:, 8:])


@pytest.mark.parametrize("place", [0, -1])
def test_joints_at_the_corner_are_unseen(place):
    """Detectors write so where they see nothing; about a body's own middle it is a place like others."""
    points = 100 + 50 * torch.rand(6, 17, 2, generator=torch.Generator().manual_seed(2))
    zeros = points.clone()
    zeros[:, 9], zeros[2, 4] = place, place
    gone = torch.where((zeros == place).all(-1, keepdim=True), torch.nan, zeros)
    told = Tracks.from_arrays(zeros, skeleton="coco17")
    assert_close(told.points, Tracks.from_arrays(gone, skeleton="coco17").points)
    assert (
        not told.seen[:, 9].any()
        and not told.seen[2, 4]
        and told.seen.sum() == Tracks.from_arrays(gone, skeleton="coco17").seen.sum()
    )
    said = f"7 joints that lie exactly at ({place}, {place}) are taken as unseen"
    assert any(note.startswith(said) for note in told.notes)
    centred = points - points[:, :1] + place
    confident = Tracks.from_arrays(zeros, torch.ones(6, 17), skeleton="coco17")
    for kept in (Tracks.from_arrays(centred, skeleton="coco17"), confident):
        assert kept.seen.all() and not any("exactly at" in note for note in kept.notes)


def test_confidence_zero_and_nan_are_the_same_as_nan_points():
    hidden = torch.rand(4, 17, generator=torch.Generator().manual_seed(1)) < 0.4
    by_points = Tracks.from_arrays(torch.where(hidden[..., None], NAN, grid()))
    for nothing in (0.0, NAN):
        by_weight = Tracks.from_arrays(grid(), torch.where(hidden, nothing, 1.0))
        assert torch.equal(by_weight.points, by_points.points)
        assert torch.equal(by_weight.weights, by_points.weights)


@pytest.mark.parametrize("fps", [None, NAN, INF])
def test_unknown_fps(fps):
    tracks = Tracks.from_arrays(grid(), fps=fps)
    assert tracks.fps is None and tracks.rate == 30.0
    assert Tracks.from_arrays(grid(), fps=12.5).rate == 12.5


def test_frames_cuts_a_run():
    part = Tracks.from_arrays(grid(), fps=5, skeleton="h36m17").frames(1, 3)
    assert_close(part.points, grid()[1:3])
    assert (part.num_frames, part.weights.shape, part.fps) == (2, (2, 17), 5)


def test_virtual_joints_are_appended():
    tracks = Tracks.from_arrays(with_value(grid(), (0, 5), NAN), skeleton="coco17")  # its left shoulder
    body = tracks.skeleton
    assert (body.num_observed, tracks.num_joints) == (17, body.num_joints)
    for joint, sources in body.virtual:
        assert_close(tracks.points[1:, joint], tracks.points[1:, list(sources)].mean(1))
        assert (tracks.weights[0, joint] == 0) == (5 in sources)
    assert tracks.unseen_share == pytest.approx(1 / 68)  # of the joints that were given


def test_never_seen_joints_and_blank_frames_are_noted():
    points = with_value(with_value(grid(12), (slice(None), 3), NAN), (slice(2, 12), slice(None)), NAN)
    notes = " ".join(Tracks.from_arrays(points, skeleton="h36m17").notes)
    assert f"never seen, so placed by the skeleton alone: {SKELETONS['h36m17'].joints[3]}" in notes
    assert "10 frames without any seen joint (frame 2, 3, 4, 5, 6, 7, 8, 9, ...): filled from their neighbours" in notes
    (note,) = Tracks.from_arrays(with_value(grid(12), 5, NAN), skeleton="h36m17").notes
    assert note == "1 frame without any seen joint (frame 5): filled from its neighbours"


# ---------------------------------------------------------------------- Tracks: which skeleton


def test_skeleton_by_name_object_and_file(tmp_path):
    file = tmp_path / "mine.yaml"
    file.write_text(yaml.safe_dump(SKELETONS["h36m17"].to_dict()), encoding="utf-8")
    for form in ("h36m17", SKELETONS["h36m17"], file, str(file)):
        assert Tracks.from_arrays(grid(), skeleton=form).skeleton == SKELETONS["h36m17"]


def test_names_of_a_built_in_skeleton_select_it():
    names = SKELETONS["coco17"].joints[:17]
    assert Tracks.from_arrays(grid(), joint_names=names).skeleton is SKELETONS["coco17"]


def test_names_in_another_order_are_put_into_the_skeletons():
    names = SKELETONS["coco17"].joints[:17]
    points, confidence = grid(), torch.linspace(0.5, 1, 68, dtype=torch.float64).reshape(4, 17)
    tracks = Tracks.from_arrays(points, confidence, joint_names=names[::-1])
    assert tracks.skeleton is SKELETONS["coco17"]
    assert torch.equal(tracks.points[:, :17], points.flip(1))
    assert torch.equal(tracks.weights[:, :17], confidence.flip(1))
    assert "joints matched by name with skeleton 'coco17'" in tracks.notes
    chain = [[i, i + 1] for i in range(16)]  # bones are given by the arrays' own order
    assert Tracks.from_arrays(points, joint_names=names[::-1], edges=chain).skeleton.joints[:17] == names[::-1]
    assert Tracks.from_arrays(points, joint_names=["beak", *names[1:]]).skeleton.name == "points"


def test_points_without_any_skeleton():
    body = Tracks.from_arrays(grid()).skeleton
    assert (body.name, body.num_bones, body.num_joints) == ("points", 0, 17)


def test_edges_that_are_a_tree():
    tracks = Tracks.from_arrays(grid(joints=3), edges=[[0, 1], [1, 2]], joint_names=["a", "b", "c"], source="x/arm.npz")
    assert tracks.skeleton.tree and tracks.skeleton.bone_names == ("a-b", "b-c")
    assert (tracks.skeleton.name, tracks.notes) == ("arm", ())


@pytest.mark.parametrize(
    ("edges", "words"),
    [([[0, 1], [1, 2], [2, 0]], "close a chain"), ([[0, 1]], "fall into 2 pieces"), ([], "fall into 3 pieces")],
)
def test_edges_that_are_no_tree_become_a_graph_and_are_noted(edges, words):
    tracks = Tracks.from_arrays(grid(joints=3), edges=edges)
    assert not tracks.skeleton.tree and tracks.skeleton.num_bones == len(edges)
    assert words in tracks.notes[0]


def test_edges_that_are_no_tree_yield_to_known_names():
    names = SKELETONS["h36m17"].joints
    tracks = Tracks.from_arrays(grid(), edges=[[0, 1]], joint_names=names, source="walk.npz")
    assert tracks.skeleton is SKELETONS["h36m17"]
    assert "used the built-in skeleton 'h36m17', whose joint names these are" in tracks.notes[0]


# ---------------------------------------------------------------------- Tracks: what is refused


@pytest.mark.parametrize(
    ("points", "words"),
    [
        (grid()[0], "3 dimensions"),
        (grid()[None], "3 dimensions"),
        (torch.zeros(4, 17, 3), "(frames, joints, 2)"),
        (torch.zeros(4, 2, 17), "(frames, joints, 2)"),
        (torch.zeros(0, 17, 2), "at least 1 frame"),
        (torch.zeros(4, 1, 2), "at least 2 joints"),
        (torch.zeros(4, 0, 2), "at least 2 joints"),
        ([[[1, 2], [3]]], "array of numbers"),
        ("walk.npz", "array of numbers"),
        ({}, "array of numbers"),
        (None, "dimensions"),
        (grid() * 1j, "real numbers"),
        (grid().numpy() * 1j, "real numbers"),
        (torch.full((4, 17, 2), NAN), "no joint is seen"),
        (with_value(grid(), (2, 3, 1), INF), "frame 2, joint 'joint3' is infinite"),
        (with_value(grid(), (0, 16, 0), -INF), "frame 0, joint 'joint16' is infinite"),
        (with_value(grid(), (0, 16, 0), -1e308), "frame 0, joint 'joint16': expected coordinates up to 1e+30"),
    ],
)
def test_bad_points(points, words):
    with pytest.raises(ShapeError, match="(?s)clip") as caught:
        Tracks.from_arrays(points, source="clip")
    assert words in str(caught.value)


ONES = torch.ones(4, 17)


@pytest.mark.parametrize(
    ("confidence", "words"),
    [
        (ONES[:, :5], "confidence: expected shape (4, 17), got (4, 5)"),
        (ONES[..., None], "2 dimensions"),
        (with_value(ONES, (1, 2), -0.5), "frame 1, joint 'joint2' is negative"),
        (with_value(ONES, (1, 2), INF), "frame 1, joint 'joint2' is infinite"),
        (
            with_value(ONES, (3, 0), 100.0),
            "frame 3, joint 'joint0' is 100 at most; expected 0..1: divide by the largest",
        ),
        (ONES * 0.2, "no joint is seen in any frame (confidence threshold 0.3)"),
        (ONES * NAN, "no joint is seen"),
        ("high", "array of numbers"),
    ],
)
def test_bad_confidence(confidence, words):
    with pytest.raises(ShapeError) as caught:
        Tracks.from_arrays(grid(), confidence, source="clip")
    assert str(caught.value).startswith("clip") and words in str(caught.value)


def test_confidence_of_what_is_nan_does_not_count():
    with pytest.raises(ShapeError, match="no joint is seen"):
        seen = torch.eye(4, 17)
        Tracks.from_arrays(torch.where(seen[..., None] > 0, grid(), NAN), 1 - seen)


@pytest.mark.parametrize("fps", [0, -25.0, -INF, "25", [25], 10**400])
def test_bad_fps(fps):
    with pytest.raises(ShapeError, match="fps: expected a positive number, got"):
        Tracks.from_arrays(grid(), fps=fps)


@pytest.mark.parametrize("far", [1e15, -1e28])
def test_a_joint_that_lies_absurdly_far_away_is_told(far):
    points = grid() + 0.0
    points[3, 5, 1] = far
    with pytest.raises(ShapeError, match="frame 3, joint 'joint5' lies .* off the clip's middle"):
        Tracks.from_arrays(points)
    confidence = torch.ones(points.shape[:2])
    confidence[3, 5] = 0
    Tracks.from_arrays(points, confidence)
    assert Tracks.from_arrays(torch.where(torch.arange(17)[:, None] == 5, grid(), 1e-20 * grid())).num_frames == 4


@pytest.mark.parametrize("fps", [1e10, 1e20, 1e-78])
def test_absurd_fps(fps):
    with pytest.raises(ShapeError, match="fps: expected 1e-06 to 1e\\+06 frames a second, got"):
        Tracks.from_arrays(grid(), fps=fps)


@pytest.mark.parametrize("threshold", [-0.1, 1.5, NAN, "low", None])
def test_bad_threshold(threshold):
    with pytest.raises(OptionError, match="threshold: expected a confidence within 0..1"):
        Tracks.from_arrays(grid(), ONES, threshold=threshold)


def test_joint_count_that_fits_another_skeleton_says_which():
    with pytest.raises(SkeletonError) as caught:
        Tracks.from_arrays(grid(), skeleton="body25", source="clip")
    message = str(caught.value)
    assert "clip: expected the 25 joints of skeleton 'body25', got 17; 17 joints fit" in message
    assert all(name in message for name in ("h36m17", "coco17", "ap10k"))


def test_virtual_joints_among_the_points_are_told():
    whole = walking_person(5, skeleton="coco17").points
    words = r"got 19: take off the virtual ones, pelvis, neck, points\[:, :17\], which are found anew"
    with pytest.raises(SkeletonError, match=words):
        Tracks.from_arrays(whole[..., :2], skeleton="coco17")
    with pytest.raises(SkeletonError, match=words):
        Motion.from_arrays(whole, skeleton="coco17")


@pytest.mark.parametrize(
    ("shape", "words"),
    [
        ((5, 2, 17), "the last two axes are swapped, points.swapaxes"),
        ((5, 34), r"of flat rows points.reshape\(5, 17, 2\)"),
        ((17, 2), r"of a single frame points\[None\]"),
        ((3, 5, 17, 2), "one clip at a time, or reconstruct_all"),
    ],
)
def test_shapes_that_are_nearly_right_are_told_how_to_put_right(shape, words):
    with pytest.raises(ShapeError, match=words):
        Tracks.from_arrays(np.zeros(shape), skeleton="coco17")


def test_frames_that_are_none_are_told():
    frames = [None, *np.ones((3, 17, 2))]
    with pytest.raises(ShapeError, match="got list with None in it: a frame that shows nobody is one of NaN"):
        Tracks.from_arrays(frames, skeleton="coco17")


def test_joints_in_another_order_are_told_which_skeleton_they_fit():
    names = [n.title().replace("_", "") for n in SKELETONS["hand21"].joints[::-1]]
    tracks = Tracks.from_arrays(grid(joints=21), joint_names=names)
    assert any("21 joints fit hand21" in note for note in tracks.notes)
    assert Tracks.from_arrays(grid(joints=21), joint_names=names, skeleton="hand21").skeleton.name == "hand21"


def test_joint_count_that_fits_none():
    with pytest.raises(SkeletonError, match="got 3$"):
        Tracks.from_arrays(grid(joints=3), skeleton="body25")


def test_unknown_skeletons():
    with pytest.raises(SkeletonError, match="unknown skeleton 'coco': did you mean 'coco1"):
        Tracks.from_arrays(grid(), skeleton="coco")
    with pytest.raises(SkeletonError, match="unknown skeleton 'COCO17': did you mean 'coco17'"):
        Tracks.from_arrays(grid(), skeleton="COCO17")
    for other, shown in ((17, "17"), ([(0, 1), (1, 2)], r"\[\(0, 1\), \(1, 2\)\]")):
        expected = f"unknown skeleton {shown}: .*got an? {type(other).__name__}: .*Skeleton.from_edges"
        with pytest.raises(SkeletonError, match=expected):
            Tracks.from_arrays(grid(), skeleton=other)
    with pytest.raises(FormatError, match="nowhere.yaml: cannot be read"):
        Tracks.from_arrays(grid(), skeleton="nowhere.yaml")


def test_bad_joint_names():
    with pytest.raises(ShapeError, match="joint_names: expected 17 names, got 2"):
        Tracks.from_arrays(grid(), joint_names=["a", "b"])
    with pytest.raises(SkeletonError, match=r"^walk\.npz: .*given twice: a"):
        Tracks.from_arrays(grid(joints=3), joint_names=["a", "a", "b"], source="walk.npz")


@pytest.mark.parametrize(
    ("edges", "error", "words"),
    [
        ([[0, 3]], SkeletonError, "expected joint indices 0..2"),
        ([[-1, 2]], SkeletonError, "expected joint indices 0..2"),
        ([[1, 1]], SkeletonError, "joins a joint to itself"),
        ([[0, 1], [1, 0]], SkeletonError, "given twice"),
        ([[0.5, 1]], SkeletonError, "pairs of joint indices"),
        ([[NAN, 1]], SkeletonError, "pairs of joint indices"),
        ([[0, 1, 2]], ShapeError, "shape (bones, 2)"),
        ([0, 1], ShapeError, "shape (bones, 2)"),
        ([["a", "b"]], ShapeError, "shape (bones, 2)"),
        ([[0, 1], [2]], ShapeError, "rows of unequal length"),
        ("0-1", ShapeError, "shape (bones, 2)"),
    ],
)
def test_bad_edges(edges, error, words):
    with pytest.raises(error) as caught:
        Tracks.from_arrays(grid(joints=3), edges=edges, source="clip")
    assert str(caught.value).startswith("clip: edges") and words in str(caught.value)


# ---------------------------------------------------------------------- Reconstruction


def test_mirrored_twice_is_itself_and_projects_equally():
    result = walk_result()
    other = result.mirrored()
    assert_close(other.points[..., :2], result.points[..., :2], rtol=0, atol=0)
    assert_close(other.points[..., 2], -result.points[..., 2], rtol=0, atol=0)
    bones = result.skeleton.bone_index()
    assert_close(bone_lengths(other.points, bones), bone_lengths(result.points, bones))
    # its world is mirrored, too: seen by its cameras it is the mirrored pose
    world = result.points @ full(result.cameras)
    mirrored_world = other.points @ full(other.cameras)
    assert_close(mirrored_world, world * torch.tensor([1.0, 1.0, -1.0]).double())
    assert_close(mirrored_world @ other.cameras.mT, other.points[..., :2])
    again = other.mirrored()
    assert torch.equal(again.points, result.points) and torch.equal(again.cameras, result.cameras)
    assert again.diagnostics == result.diagnostics


def test_moved_and_cast_with_tracks_and_alternatives():
    result = replace(walk_result(), alternatives=(walk_result().mirrored(),), root_depth=torch.zeros(40).double())
    single = result.to(torch.float32)
    for one in (single, *single.alternatives):
        held = one.tracks.points, one.points, one.cameras, one.uncertainty
        assert {x.dtype for x in held} == {torch.float32}
    assert single.root_depth.dtype == torch.float32 and result.points.dtype == torch.float64
    assert_close(single.points.double(), result.points, rtol=1e-6, atol=1e-6)
    assert single.diagnostics == result.diagnostics and single.units == result.units
    away = result.to("meta")
    assert {away.points.device.type, away.lengths.device.type, away.tracks.weights.device.type} == {"meta"}


def full(cameras):
    return torch.cat([cameras, torch.linalg.cross(cameras[:, :1], cameras[:, 1:])], 1)


def test_scaled_by_factor():
    result = walk_result()
    big = result.scaled(units="cm", factor=100.0)
    assert (big.units, result.units) == ("cm", "m")
    assert_close(big.points, 100 * result.points)
    assert_close(big.lengths, 100 * result.lengths)
    assert_close(big.uncertainty, 100 * result.uncertainty)
    assert_close(big.scales[:, None, None] * big.points, result.scales[:, None, None] * result.points)
    assert big.tracks is result.tracks and torch.equal(big.cameras, result.cameras)
    assert walk_result(uncertain=False).scaled(units="cm", factor=2).uncertainty is None


def test_scaled_by_a_bone():
    result = walk_result()
    name = "left_knee-left_ankle"
    scaled = result.scaled(units="m", **{name: 0.43})
    index = result.skeleton.bone_names.index(name)
    assert scaled.lengths[index].item() == pytest.approx(0.43)
    assert_close(scaled.points * (result.lengths[index] / 0.43), result.points)


@pytest.mark.parametrize(("units", "height", "metres"), [("m", 175, ""), ("mm", 1.75, " is 0.00175 m")])
def test_a_stature_in_another_unit_is_told(units, height, metres):
    with pytest.warns(KcsWarning, match=f"a height of {height} {units}{metres}: is the unit another") as told:
        walk_result().scaled(units=units, height=height)
    assert told[0].filename == __file__
    walk_result().scaled(units="dragons", height=175)  # a warning would be an error here


def test_scaled_by_height():
    chain = Skeleton.from_names(
        ["head_top", "hip", "left_ankle", "right_foot"],
        [("hip", "head_top"), ("hip", "left_ankle"), ("hip", "right_foot")],
    )
    result = walk_result()
    points = torch.tensor([[0.0, -3, 0], [0, 0, 0], [0, 2, 0], [0, 1, 0]]).double().expand(12, 4, 3)
    tracks = Tracks.from_arrays(points[..., :2], skeleton=chain)
    body = replace(result, points=points, lengths=torch.tensor([3.0, 2, 1]).double(), tracks=tracks)
    # 5 units from the head's top to an ankle, which is 166 cm of 175, and 4 to the ball of a foot, which is 171.5
    own = 1.75 * (5 / 1.66 + 4 / 1.715) / 2
    assert_close(body.scaled(units="m", height=1.75).points, points * 1.75 / own, rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({}, "exactly one size"),
        ({"factor": 2.0, "height": 1.7}, "exactly one size"),
        ({"height": 1.7, "left_knee-left_ankle": 0.4}, "exactly one size"),
        ({"factor": 0.0}, "positive factor"),
        ({"factor": -1.0}, "positive factor"),
        ({"factor": INF}, "positive factor"),
        ({"factor": NAN}, "positive factor"),
        ({"height": -1.75}, "height: expected a positive number, got -1.75"),
        ({"factor": "2"}, "factor: expected a number, got '2'"),
        ({"height": "1.75"}, "height: expected a number, got '1.75'"),
        ({"factor": torch.ones(2)}, "factor: expected a number"),
        ({"width": 1.0}, "unknown size 'width': expected 'height' or a bone"),
    ],
)
def test_scaled_refuses(options, words):
    with pytest.raises(OptionError) as caught:
        walk_result().scaled(units="m", **options)
    assert words in str(caught.value)


def test_units_may_be_spelt_out():
    result = walk_result()
    assert result.scaled(units="Metres", height=1.75).units == "m"
    assert Motion.of(result).scaled(units="centimeters", height=175).units == "cm"
    assert Tracks.from_arrays(grid(12, 2), units="millimetres").units == "mm"
    with pytest.raises(OptionError, match="units: expected a name such as 'm', got None"):
        Tracks.from_arrays(grid(12, 2), units=None)


def test_scaled_by_what_is_not_there():
    result = walk_result()
    with pytest.raises(OptionError, match="is zero or unknown in this motion"):
        replace(result, lengths=0 * result.lengths).scaled(units="m", height=1.75)
    arm = Skeleton.from_names(["a", "b"], [("a", "b")])
    tracks = Tracks.from_arrays(grid(12, 2), skeleton=arm)
    with pytest.raises(OptionError, match="height needs a head and a foot"):
        replace(result, tracks=tracks, lengths=torch.ones(1)).scaled(units="m", height=1.75)


def test_observed_leaves_the_virtual_joints_out():
    result = walk_result()
    assert result.observed.shape == (12, 17, 3) and result.points.shape == (12, 19, 3)
    assert torch.equal(result.observed, result.points[:, :17])
    assert (result.fps, result.skeleton.name) == (25.0, "coco17")


def test_units_are_those_of_the_tracks():
    assert replace(walk_result(), units="").units == "mm"


def test_joints_are_matched_by_name_with_a_given_skeleton():
    body = SKELETONS["h36m17"]
    points = torch.randn(4, 17, 2, dtype=torch.float64)
    shuffled = [5, 3, 16, 0, 1, 2, 4, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15]
    names = [body.joints[i] for i in shuffled]
    confidence = torch.rand(4, 17, dtype=torch.float64) * 0.5 + 0.5
    plain = Tracks.from_arrays(points, confidence, skeleton=body)
    by_name = Tracks.from_arrays(points[:, shuffled], confidence[:, shuffled], skeleton=body, joint_names=names)
    assert torch.equal(by_name.points, plain.points)
    assert torch.equal(by_name.weights, plain.weights)
    assert any("matched by name" in note for note in by_name.notes)
    more = torch.cat([points, torch.zeros(4, 1, 2, dtype=torch.float64)], 1)
    wider = Tracks.from_arrays(more, skeleton=body, joint_names=[*body.joints, "hat"])
    assert torch.equal(wider.points, points)


def test_names_that_are_but_numbers_tell_an_order():
    points, names = grid(joints=21), [f"hand{i}" for i in range(21)]
    tracks = Tracks.from_arrays(points, skeleton="hand21", joint_names=names)
    assert torch.equal(tracks.points, points)
    order = "joints taken in their order as those of skeleton 'hand21', where names differ: hand0 for wrist, hand1 for"
    assert tracks.notes[0].startswith(order)
    mixed = Tracks.from_arrays(points, skeleton="hand21", joint_names=names[::-1])
    assert torch.equal(mixed.points, points.flip(1)) and "matched by name" in mixed.notes[0]


def test_skeletons_are_offered_where_names_may_be_theirs():
    def offered(*names):
        (note,) = (n for n in Tracks.from_arrays(grid(joints=33), joint_names=names).notes if "no bones" in n)
        return "33 joints fit mediapipe33" in note

    names = SKELETONS["mediapipe33"].joints[:33]
    assert offered(*(f"point_{i}" for i in range(33)))
    assert offered("beak", *names[1:])
    assert not offered(*(f"{a}_finger{i}" for i in range(11) for a in ("left", "right", "water")))
    assert not offered(*names[1:], "nose tip")  # another order
    (note,) = (n for n in Tracks.from_arrays(grid(joints=33)).notes if "no bones" in n)
    assert "33 joints fit mediapipe33" in note


def test_joints_of_another_spelling_are_matched_by_name():
    names = SKELETONS["body25"].joints
    points = torch.randn(4, 25, 2, dtype=torch.float64)
    body = SKELETONS["coco18"]
    tracks = Tracks.from_arrays(points, skeleton=body, joint_names=[n.lower() for n in names])
    assert torch.equal(tracks.points[:, :18], points[:, [names.index(j) for j in body.joints[:18]]])


def test_as_many_joints_in_another_order_are_no_other_skeletons():
    points = torch.randn(4, 17, 2, dtype=torch.float64)
    with pytest.raises(SkeletonError, match="17 joints of skeleton 'h36m17'.*none of them named pelvis, spine"):
        Tracks.from_arrays(points, skeleton="h36m17", joint_names=SKELETONS["coco17"].joints[:17])
    tracks = Tracks.from_arrays(points, skeleton="h36m17", joint_names=[f"p{i}" for i in range(17)])
    assert any("in their order" in n for n in tracks.notes)


# ---------------------------------------------------------------------- whatever comes in

anything = st.recursive(
    st.one_of(st.none(), st.booleans(), st.integers(-3, 300), st.floats(), st.text(max_size=3)),
    lambda inner: st.one_of(
        st.lists(inner, max_size=3), st.tuples(inner, inner), st.dictionaries(st.text(max_size=2), inner, max_size=2)
    ),
    max_leaves=8,
)
numbers = st.lists(
    st.lists(st.lists(st.floats(width=32), min_size=2, max_size=2), min_size=3, max_size=3), min_size=1, max_size=3
)


@settings(max_examples=150, deadline=None, derandomize=True)
@given(
    points=st.one_of(numbers, anything),
    confidence=st.one_of(st.none(), st.just([[1.0, 0.5, 0.0]] * 2), anything),
    edges=st.one_of(st.none(), st.lists(st.tuples(st.integers(0, 3), st.integers(0, 3)), max_size=3), anything),
    skeleton=st.one_of(st.none(), st.sampled_from(["h36m17", "none"]), st.integers()),
    fps=st.one_of(st.none(), st.floats(), anything),
    threshold=st.one_of(st.just(0.3), st.floats(), st.text(max_size=2)),
)
def test_anything_gives_tracks_or_an_error_of_our_own(points, confidence, edges, skeleton, fps, threshold):
    try:
        tracks = Tracks.from_arrays(
            points, confidence, edges=edges, skeleton=skeleton, fps=fps, threshold=threshold, source="clip"
        )
    except KcsError:
        return
    assert torch.isfinite(tracks.points).all() and torch.isfinite(tracks.weights).all()
    assert tracks.points.shape == (*tracks.weights.shape, 2) and tracks.seen.any()
    assert ((tracks.weights >= 0) & (tracks.weights <= 1)).all()
    assert (tracks.points[~tracks.seen] == 0).all()
    assert tracks.fps is None or tracks.fps > 0


def test_bones_are_named_in_any_spelling():
    """Detectors and people spell joints in their own ways, and name a bone from either end."""
    body = SKELETONS["body25b"]
    lengths = torch.arange(1.0, body.num_bones + 1)
    own = float(lengths[body.bone_names.index("LKnee-LAnkle")])
    for name in ("LKnee-LAnkle", "left_knee-left_ankle", "left_ankle-left_knee", "l_knee-LAnkle"):
        assert size_factor(body, lengths, None, {name: 430.0}) == pytest.approx(430 / own)
        check_size(body, name)
    for name in ("left_knee-right_ankle", "left_knee", "horn-tail"):
        with pytest.raises(OptionError, match="LKnee-LAnkle"):
            check_size(body, name)


def test_joints_of_another_body_are_those_in_common():
    """What the other body lacks is unseen, and told; where it lacks too much nothing is taken."""
    walk = walking_person(10, skeleton="body25").tracks
    names = list(walk.skeleton.joints)
    tracks = Tracks.from_arrays(walk.points, joint_names=names, skeleton="h36m17")
    there = dict(zip(tracks.skeleton.joints, tracks.weights.gt(0).all(0).tolist(), strict=True))
    assert there["pelvis"] and there["left_knee"] and not there["spine"] and sum(there.values()) >= 14
    knee = tracks.points[:, tracks.skeleton.joints.index("left_knee")]
    assert torch.equal(knee, walk.points[:, names.index("LKnee")])
    assert any("unseen" in note and "spine" in note for note in tracks.notes)
    few = [n for n in names if "Knee" in n or "Hip" in n or "Ankle" in n]
    with pytest.raises(SkeletonError, match="none of them named"):
        Tracks.from_arrays(walk.points[:, [names.index(n) for n in few]], joint_names=few, skeleton="h36m17")


def test_whole_numbers_of_any_kind():
    tracks = walking_person(20).tracks
    assert tracks.frames(np.int64(0), 20, np.int64(2)).num_frames == 10
    for part in ((1.5, 3), (0, "3"), (0, 3, 0), (0, 3, True)):
        with pytest.raises(OptionError, match="expected a whole number"):
            tracks.frames(*part)


def test_a_mirror_image_has_the_mirrored_alternatives():
    """Of which no objective is known."""
    result = walk_result()
    other = replace(result, points=result.points + 1.0, objective=3.0)
    turned = replace(result, objective=2.0, alternatives=(other,)).mirrored()
    assert math.isnan(turned.objective) and math.isnan(turned.alternatives[0].objective)
    assert_close(turned.alternatives[0].points, other.mirrored().points)
    assert replace(result, alternatives=(other,)).solution(np.int64(2)) is not None
