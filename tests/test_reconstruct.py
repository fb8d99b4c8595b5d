"""The entry call: what it accepts, what it refuses in words, and which method it chooses."""

import math

import numpy as np
import pytest
import torch
from torch.testing import assert_close

import kcs_torch as kt
from kcs_torch import KCS, METHODS, OptionError, SfAM, ShapeError, SkeletonError, Tracks, reconstruct
from kcs_torch.data import walking_person
from kcs_torch.skeleton import SKELETONS

CLIP = walking_person(20, turn=90.0)
TRACKS, POINTS = CLIP.tracks, CLIP.tracks.points


def refused(error, *words, **options):
    """Check that a call is refused with all these words."""
    tracks = options.pop("tracks", TRACKS)
    with pytest.raises(error) as caught:
        reconstruct(tracks, **options)
    for word in words:
        assert word in str(caught.value)


# ---------------------------------------------------------------------- ways to call it


@pytest.mark.parametrize("kind", [torch.Tensor.clone, torch.Tensor.numpy, torch.Tensor.tolist])
def test_arrays_with_a_skeletons_name(kind):
    result = reconstruct(kind(POINTS), method="kcs", skeleton="h36m17", fps=30, units="mm")
    assert_close(result.points, reconstruct(TRACKS, method="kcs").points, rtol=0, atol=0)
    assert (result.skeleton, result.fps, result.units) == (SKELETONS["h36m17"], 30, "mm")


def test_arrays_with_nan_and_confidence():
    confidence = torch.ones(20, 17)
    confidence[3, 4] = 0.1  # below the threshold
    points = POINTS.clone()
    points[5, 6] = math.nan
    result = reconstruct(points, method="kcs", skeleton=SKELETONS["h36m17"], confidence=confidence)
    assert result.diagnostics.unseen_share == pytest.approx(2 / 340)
    assert result.tracks.weights[3, 4] == result.tracks.weights[5, 6] == 0


def test_arrays_without_a_skeleton():
    result = reconstruct(POINTS)
    assert (result.method, result.skeleton.name, result.units) == ("sfam", "points", "px")
    assert result.lengths.shape == (0,)


@pytest.mark.parametrize("name", METHODS)
def test_a_methods_name_its_object_and_its_fields_are_one(name):
    fields = {"kcs": {"rounds": 2, "arrangement": "frames"}, "sfam": {"beta": 2.5, "num_steps": 30}}[name]
    method = METHODS[name](**fields)
    by_name = reconstruct(TRACKS, method=name, **fields)
    for other in (reconstruct(TRACKS, method=method), method(TRACKS)):
        assert torch.equal(other.points, by_name.points)
        assert other.method == by_name.method == name
    assert not torch.equal(reconstruct(TRACKS, method=name).points, by_name.points)


def test_results_follow_the_tracks_dtype():
    for dtype in (torch.float32, torch.float64):
        for method in ("auto", *METHODS):
            assert reconstruct(TRACKS.to(dtype), method=method).points.dtype == dtype
    assert reconstruct(POINTS.float().numpy(), skeleton="h36m17").points.dtype == torch.float64  # as readers give it


def test_the_package_exports_it():
    import kcs_torch.reconstruct  # noqa: F401  # the submodule must not hide the function

    assert kt.reconstruct is reconstruct and callable(kt.reconstruct)


# ---------------------------------------------------------------------- what it refuses


def test_unknown_methods():
    refused(OptionError, "unknown method 'sfma': did you mean 'sfam'?", "choices: auto, kcs, sfam", method="sfma")
    refused(OptionError, "unknown method 'KCS'", "kcs", method="KCS")
    for nonsense in (None, 3, ["kcs"], KCS):
        refused(OptionError, "unknown method", "auto, kcs, sfam", method=nonsense)


def test_unknown_fields():
    refused(OptionError, "unknown option of method 'kcs' 'round': did you mean 'rounds'?", method="kcs", round=2)
    refused(OptionError, "unknown option of method 'sfam' 'betas': did you mean 'beta'?", method="sfam", betas=2)
    for attribute in ("name", "solve"):
        refused(OptionError, f"unknown option of method 'sfam' '{attribute}'", method="sfam", **{attribute: 1})


def test_fields_of_the_other_method():
    refused(OptionError, "unknown option of method 'kcs' 'beta'", "rounds", method="kcs", beta=1.0)
    refused(OptionError, "unknown option of method 'sfam' 'rounds'", "num_steps", method="sfam", rounds=1)


@pytest.mark.parametrize(
    ("method", "field", "value", "words"),
    [
        ("kcs", "rounds", 0, "kcs: rounds: expected at least 1, got 0"),
        ("kcs", "rho", 1.5, "kcs: rho: expected a number between 0 and 1, got 1.5"),
        ("sfam", "beta", -1.0, "sfam: beta: expected a number >= 0, got -1.0"),
        ("sfam", "window", 20, "overlap: expected below the window of 20 frames, got 50"),
        ("sfam", "num_steps", "many", "sfam: num_steps: expected int, got 'many'"),
    ],
)
def test_values_out_of_range(method, field, value, words):
    refused(OptionError, words, method=method, **{field: value})


def test_options_of_arrays_with_tracks():
    for option in ({"skeleton": "coco17"}, {"confidence": np.ones((20, 17))}, {"fps": 25}):
        refused(OptionError, "belong to arrays; these tracks already have them", **option)


def test_fields_with_auto():
    refused(OptionError, "fields (beta, rounds) need a method's name: kcs, sfam", beta=1.0, rounds=2)


def test_fields_with_a_method_object():
    refused(
        OptionError, "fields (beta) go with a method's name", "set them on the method itself", method=SfAM(), beta=1
    )


def test_joint_count_that_fits_another_skeleton():
    refused(SkeletonError, "25 joints", "got 17; 17 joints fit", "h36m17", tracks=POINTS, skeleton="body25")
    refused(SkeletonError, "unknown skeleton 'h36m': did you mean 'h36m17'?", tracks=POINTS, skeleton="h36m")


@pytest.mark.parametrize(
    "tracks",
    [POINTS[0], torch.zeros(0, 17, 2), torch.zeros(5, 1, 2), torch.full((5, 17, 2), math.nan), "walk.npz", None],
)
def test_bad_tracks(tracks):
    refused(ShapeError, "tracks", tracks=tracks)


# ---------------------------------------------------------------------- which method auto chooses


@pytest.mark.parametrize(("turn", "method"), [(0.0, "kcs"), (10.0, "kcs"), (180.0, "sfam"), (360.0, "sfam")])
@pytest.mark.parametrize("yaw", [0.0, 40.0])
def test_auto_looks_at_the_turn(turn, yaw, method):
    clip = walking_person(100, turn=turn, yaw=yaw)
    result = reconstruct(clip.tracks)
    assert result.method == method
    if yaw == 0 and method == "kcs":
        return  # seen from the front and still, legs swing in depth alone: a template cannot tell
    flat = clip.points * torch.tensor([1.0, 1.0, 0.0]).double()
    centre = lambda x: x - x.mean(1, keepdim=True)  # noqa: E731
    error = lambda x: (centre(x) - centre(clip.points)).norm(dim=-1).mean()  # noqa: E731
    assert min(error(result.points), error(result.mirrored().points)) < 0.7 * error(flat)


def test_auto_needs_no_template():
    edges = [list(b) for b in SKELETONS["h36m17"].bones]
    static = walking_person(20, turn=0.0).tracks.points
    assert reconstruct(Tracks.from_arrays(static, edges=edges)).method == "sfam"


def test_auto_with_known_cameras():
    clip = walking_person(60, turn=180.0)
    result = reconstruct(clip.tracks, cameras=clip.cameras)
    assert result.method == "sfam" and torch.equal(result.cameras, clip.cameras)
    still = walking_person(60, turn=0.0)
    assert reconstruct(still.tracks, cameras=still.cameras.numpy()).method == "kcs"


def test_warnings_are_the_chosen_methods_and_point_to_the_caller():
    points = walking_person(60, turn=180.0).tracks.points.clone()
    points[:, 6] = math.nan
    with pytest.warns(kt.KcsWarning) as told:
        reconstruct(points, skeleton="h36m17")
    assert len(told) == 1
    assert told[0].filename == __file__
