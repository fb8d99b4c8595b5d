"""What is told of a body whose feet are not below it: y may point up, x and y may be swapped, or it lies."""

import math
import warnings

import pytest
import torch
from method_clips import WALK, notes, quiet, tracks_of

from kcs_torch import KcsWarning, Tracker, reconstruct

UP = torch.tensor([1.0, -1.0]).double()
HEADSTAND = "feet are above the rest of the body in nearly all frames. If y points up"
ASIDE = "feet are above the rest of the body and beside it in nearly all frames, as if it bent. If y points up"
SWAPPED = "x and y are swapped in these tracks"


def leaning(degrees):
    """The walk, leaning to the right: its feet are to the left of the rest, and below."""
    way = math.radians(-degrees)
    lean = torch.tensor([[math.cos(way), math.sin(way)], [-math.sin(way), math.cos(way)]]).double()
    return (WALK - WALK.mean((0, 1))) @ lean.mT


@quiet
def test_a_body_on_its_head_is_told():
    """y may point up; a body that lies, or shows its feet now and then, is not meant."""
    with pytest.warns(KcsWarning, match=HEADSTAND):
        result = reconstruct(tracks_of(WALK * UP), method="kcs")
    assert any(HEADSTAND in note for note in result.diagnostics.notes)
    turned = WALK.clone()
    turned[: len(WALK) // 2, :, 1] *= -1
    for right in (WALK, turned, WALK.flip(-1)):
        with warnings.catch_warnings(record=True) as told:
            warnings.simplefilter("always")
            reconstruct(tracks_of(right), method="kcs")
        assert not any("feet are above" in str(one.message) for one in told)


@quiet
def test_a_body_on_its_side_is_told():
    """x and y are easily swapped; one that gets up is not meant."""
    assert SWAPPED in notes(tracks_of(WALK.flip(-1)), "kcs")
    rises = torch.cat([WALK.flip(-1)[: len(WALK) // 2], WALK[len(WALK) // 2 :]])
    for right in (WALK, rises):
        assert SWAPPED not in notes(tracks_of(right), "kcs")


@quiet
def test_a_bending_body_whose_axes_are_others_is_told_of_both_ways():
    """Swapped, it looks as one that bends while y points up: what is right for one is wrong for the other."""
    bent = leaning(40)
    assert "the body" not in notes(tracks_of(bent), "kcs")
    for wrong in (bent.flip(-1), bent * UP):
        with pytest.warns(KcsWarning, match=ASIDE):
            said = notes(tracks_of(wrong), "kcs")
        assert SWAPPED in said


@quiet
def test_where_a_body_hardly_leans_axes_that_are_swapped_are_told_from_y_that_points_up():
    slight = leaning(6)
    assert ASIDE not in (said := notes(tracks_of(slight * UP), "kcs")) and HEADSTAND in said
    assert "feet are above" not in (said := notes(tracks_of(slight.flip(-1)), "kcs")) and SWAPPED in said


def test_live_tracks_whose_y_points_up_are_told_once():
    walk = WALK.repeat(4, 1, 1)
    for points, count in ((walk * UP, 1), (walk, 0)):
        with warnings.catch_warnings(record=True) as told:
            warnings.simplefilter("always")
            with Tracker("h36m17", fps=30, window=24, period=24) as tracker:
                for xy in points:
                    tracker.update(xy)
        said = [one for one in told if "feet are above the rest of the body" in str(one.message)]
        assert len(said) == count
        assert all(one.filename == __file__ for one in said)


@quiet
def test_of_a_single_image_no_frames_are_told():
    said = notes(tracks_of(WALK[:1] * UP), "kcs")
    assert "feet are above the rest of the body. If y points up" in said
    assert "lies on its side. If" in notes(tracks_of(WALK[:1].flip(-1)), "kcs")
