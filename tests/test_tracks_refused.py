"""Tracks: every bad input is refused in words."""

import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from samples import grid, with_value

from kcs_torch import KcsError, Motion, OptionError, ShapeError, SkeletonError, Tracks
from kcs_torch.data import walking_person
from kcs_torch.errors import FormatError
from kcs_torch.skeleton import SKELETONS

NAN, INF = math.nan, math.inf


# ---------------------------------------------------------------------- what is refused


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
        (ONES[..., None], "confidence[..., 0] puts it right"),
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


@pytest.mark.parametrize("count", [16, 20])
def test_confidences_fit_the_points_before_joints_are_put_in_order(count):
    names = SKELETONS["coco17"].joints[16::-1]
    with pytest.raises(ShapeError, match=rf"confidence: expected shape \(4, 17\), got \(4, {count}\)"):
        Tracks.from_arrays(grid(), torch.ones(4, count), joint_names=names)


def test_a_list_of_tensors_with_gradients_is_told():
    with pytest.raises(ShapeError, match="got list of tensors: torch.stack makes one of them"):
        Tracks.from_arrays([frame.requires_grad_() for frame in torch.rand(3, 17, 2)])


def test_confidence_of_what_is_nan_does_not_count():
    with pytest.raises(ShapeError, match="no joint is seen"):
        seen = torch.eye(4, 17)
        Tracks.from_arrays(torch.where(seen[..., None] > 0, grid(), NAN), 1 - seen)


@pytest.mark.parametrize("fps", [0, -25.0, -INF, "25", [25], 10**400, True])
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
    with pytest.raises(ShapeError, match="fps: expected a positive number, got .*frames a second, 1e-06 to 1e\\+06"):
        Tracks.from_arrays(grid(), fps=fps)


@pytest.mark.parametrize("threshold", [-0.1, 1.5, NAN, "low", None])
def test_bad_threshold(threshold):
    with pytest.raises(OptionError, match="threshold: expected a confidence within 0..1"):
        Tracks.from_arrays(grid(), ONES, threshold=threshold)


@pytest.mark.parametrize(
    "size", [(0, 1080), (-1920, 1080), (1920.5, 1080), (True, True), "1920x1080", (1920,), (1, 2, 3), (NAN, INF), 1920]
)
def test_bad_image_size(size):
    with pytest.raises(OptionError, match=r"image_size: expected width and height .*such as \(1920, 1080\), got"):
        Tracks.from_arrays(grid(), image_size=size)


def test_millimetres_are_of_no_image():
    with pytest.raises(OptionError, match=r"image_size: expected tracks in pixels of the image, got units 'mm'"):
        Tracks.from_arrays(grid(), units="mm", image_size=(1920, 1080))


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


# ---------------------------------------------------------------------- whatever comes in


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
