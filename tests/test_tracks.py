"""Tracks: which arrays are accepted, and which skeleton they get."""

import math
import re

import numpy as np
import pytest
import torch
import yaml
from samples import grid, with_value
from torch.testing import assert_close

from kcs_torch import Motion, OptionError, ShapeError, SkeletonError, Tracks
from kcs_torch.data import walking_person
from kcs_torch.skeleton import SKELETONS
from kcs_torch.types.size import check_size, size_factor

NAN, INF = math.nan, math.inf


# ---------------------------------------------------------------------- what is accepted


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


def test_the_image_has_a_size_where_somebody_says_it():
    assert Tracks.from_arrays(grid(), skeleton="h36m17").image_size is None
    for size in ((1920, 1080), [1920.0, 1080], np.array([1920, 1080]), torch.tensor([1920, 1080])):
        tracks = Tracks.from_arrays(grid(), skeleton="h36m17", image_size=size)
        assert tracks.image_size == (1920, 1080) == tracks.frames(1, 3).to(torch.float32).image_size
        assert all(type(side) is int for side in tracks.image_size)


def test_an_image_that_most_joints_lie_outside_is_none():
    points = torch.rand(4, 17, 2, generator=torch.manual_seed(1)) * torch.tensor([1000, 500])
    for shift, size in ((0, (1000, 500)), (-200, (1000, 500)), (-800, None), (800, None)):
        moved = points + torch.tensor([shift, 0])
        tracks = Tracks.from_arrays(moved, skeleton="h36m17", image_size=(1000, 500))
        assert tracks.image_size == size
        assert any("most joints lie outside an image of 1000 x 500" in note for note in tracks.notes) == (size is None)
    far = torch.where(torch.arange(17)[:, None] < 5, points, 4000.0)
    unseen = (torch.arange(17) < 5).float().expand(4, 17)  # and so they do not count
    assert Tracks.from_arrays(far, unseen, skeleton="h36m17", image_size=(1000, 500)).image_size == (1000, 500)


def test_shares_of_an_image_of_known_size_become_pixels():
    size = torch.tensor([1920.0, 1080.0])
    points = 100 + 10 * torch.rand(5, 17, 2, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    points[2, 3] = float("nan")
    pixels = Tracks.from_arrays(points, skeleton="h36m17", image_size=(1920, 1080))
    shares = Tracks.from_arrays(points / size, skeleton="h36m17", image_size=(1920, 1080))
    assert_close(shares.points, pixels.points)
    assert shares.image_size == (1920, 1080) and not any("shares" in note for note in pixels.notes)
    assert "coordinates are shares of the image: multiplied by its 1920 x 1080 pixels" in shares.notes


def test_confidences_beside_the_places_are_told_where_to_go():
    with pytest.raises(ShapeError, match=r"points\[..., :2\], confidence=points\[..., 2\]"):
        Tracks.from_arrays(torch.rand(5, 17, 3), skeleton="h36m17")
    with pytest.raises(ShapeError, match=r"expected shape \(5, 17\), got \(5, 17, 1\): confidence\[..., 0\] puts"):
        Tracks.from_arrays(torch.rand(5, 17, 2), torch.rand(5, 17, 1), skeleton="h36m17")


@pytest.mark.parametrize(
    ("size", "low", "high", "word", "kept"),
    [
        ((1080, 1920), (20, 20), (1900, 1000), "many joints lie far outside an image of 1080 x 1920", True),
        ((1080, 1920), (800, 20), (1900, 1000), "most joints lie outside an image of 1080 x 1920", False),
        ((1920, 1080), (20, 20), (1900, 1000), "", True),
        ((1920, 1080), (20, 20), (1000, 1170), "", True),  # cut by the image's edge
        ((1080, 1920), (20, 20), (1140, 1000), "", True),  # few far outside
        ((1080, 1920), (20, 20), (2100, 1000), "", True),  # the other way round they are outside, too
        ((1200, 1200), (20, 20), (1900, 1000), "", True),
    ],
)
def test_sides_of_an_image_that_are_swapped_are_told(size, low, high, word, kept):
    low, high = torch.tensor(low), torch.tensor(high)
    points = low + torch.rand(40, 17, 2, generator=torch.manual_seed(1)) * (high - low)
    tracks = Tracks.from_arrays(points, skeleton="h36m17", image_size=size)
    told = [note for note in tracks.notes if "image_size" in note]
    fix = "If width and height are swapped, give image_size=(1920, 1080) (kcs-torch: --image-size 1920x1080)"
    assert [note.startswith(word) and note.endswith(fix) for note in told] == [True] * bool(word)
    assert tracks.image_size == (size if kept else None)


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


@pytest.mark.parametrize(("make", "dims"), [(Tracks.from_arrays, 2), (Motion.from_arrays, 3)])
def test_frames_whose_joints_all_lie_at_one_point_are_unseen(make, dims):
    """Wherever that point is, and whatever confidences say; where no frame shows more there is nothing to choose."""
    points = torch.randn(6, 17, dims, generator=torch.Generator().manual_seed(2))
    points[1], points[4] = 0.0, torch.randn(dims)
    points[4, 3] = math.nan
    for sure in (None, torch.ones(6, 17)):
        told = make(points, sure, skeleton="h36m17")
        assert told.seen.any(1).tolist() == [True, False, True, True, False, True]
        assert told.seen[[0, 2, 3, 5]].all() and (told.points[[1, 4]] == 0).all()
        assert "2 frames whose joints all lie at one point are taken as unseen" in told.notes
    alike = points[:1, :1].expand(6, 17, dims)
    few = points.clone()
    few[2:4, 2:], few[2:4, 1] = math.nan, few[2:4, 0]  # a bone that points at the camera
    assert make(alike, skeleton="h36m17").seen.all()
    assert make(few, skeleton="h36m17").seen[2:4, :2].all()


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


def test_a_note_alone_is_one_note():
    assert Tracks.from_arrays(torch.rand(3, 17, 2), skeleton="coco17", notes="seen twice").notes == ("seen twice",)


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


# ---------------------------------------------------------------------- which skeleton


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


# ---------------------------------------------------------------------- joints by name


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


COCO = SKELETONS["coco17"].joints[:17]


@pytest.mark.parametrize(
    ("names", "told"),
    [
        ((*COCO[:16], "rigth_ankle"), "16 .* 'rigth_ankle' is not: rename it (right_ankle is missing) or leave it out"),
        ((*COCO[:0:-1], "snout"), "16 of 17 names .* 'snout' is not: rename it (nose is missing) or leave it out"),
        ((*COCO, "a", "b"), "17 of 19 names .* 'a', 'b' are not: skeleton='coco17' leaves them out"),
        ((*COCO, "Nose"), "17 of 18 names .* 'Nose' is not: skeleton='coco17' leaves it out"),
        ((*COCO[5:], "tail"), "12 of 13 names .* 'tail' is not: rename it or leave it out"),
        ((*COCO[:7], *(f"paw{i}" for i in range(7))), ""),
    ],
)
def test_names_that_keep_others_from_being_a_skeletons_are_told(names, told):
    (note,) = (n for n in Tracks.from_arrays(grid(joints=len(names)), joint_names=names).notes if "no bones" in n)
    if told:
        assert re.search(told.replace("(", r"\(").replace(")", r"\)") + r"\Z", note)
    else:
        assert note.endswith("find the bones")


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


def test_bones_are_named_in_any_spelling():
    """Detectors and people spell joints in their own ways, and name a bone from either end."""
    body = SKELETONS["body25b"]
    lengths = torch.arange(1.0, body.num_bones + 1)
    own = float(lengths[body.bone_names.index("LKnee-LAnkle")])
    for name in ("LKnee-LAnkle", "left_knee-left_ankle", "left_ankle-left_knee", "l_knee-LAnkle"):
        assert size_factor(body, lengths, None, {name: 430.0}, units="mm") == pytest.approx(430 / own)
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
