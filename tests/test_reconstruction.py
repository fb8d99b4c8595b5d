"""Reconstructions change as they should: mirrored, moved, scaled."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from samples import grid, walk_result
from torch.testing import assert_close

from kcs_torch import Motion, OptionError, Tracks
from kcs_torch.errors import KcsWarning
from kcs_torch.functional import bone_lengths
from kcs_torch.skeleton import Skeleton

NAN, INF = math.nan, math.inf


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


def test_before_a_camera_every_solution_gets_the_size():
    result = walk_result()
    other = replace(result, lengths=2 * result.lengths)
    bone = result.skeleton.index("left_knee"), result.skeleton.index("left_ankle")
    at = [set(pair) for pair in result.skeleton.bones].index(set(bone))
    for distance, lengths in ((torch.ones(12), [0.4, 0.4]), (None, [0.4, 0.8])):
        both = [replace(one, distance=distance) for one in (result, other)]
        found = replace(both[0], alternatives=(both[1],)).scaled(units="m", **{"left_knee-left_ankle": 0.4})
        assert [float(one.lengths[at]) for one in (found, *found.alternatives)] == pytest.approx(lengths)


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


def test_a_mirror_image_has_the_mirrored_alternatives():
    """Of which no objective is known."""
    result = walk_result()
    other = replace(result, points=result.points + 1.0, objective=3.0)
    turned = replace(result, objective=2.0, alternatives=(other,)).mirrored()
    assert math.isnan(turned.objective) and math.isnan(turned.alternatives[0].objective)
    assert_close(turned.alternatives[0].points, other.mirrored().points)
    assert replace(result, alternatives=(other,)).solution(np.int64(2)) is not None
