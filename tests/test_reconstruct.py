"""The entry call: what it accepts, what it refuses in words, and what its default does."""

import math
import re
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import pytest
import torch
from torch.testing import assert_close

import kcs_torch as kt
from kcs_torch import KCS, METHODS, PKC, OptionError, SfAM, ShapeError, SkeletonError, reconstruct
from kcs_torch.data import walking_person
from kcs_torch.errors import KcsError
from kcs_torch.methods import Estimate, Method
from kcs_torch.reconstruct import with_found_bones
from kcs_torch.skeleton import SKELETONS

# Few steps are made here, after which little has settled.
pytestmark = pytest.mark.filterwarnings("ignore::kcs_torch.ConvergenceWarning")

CLIP = walking_person(20, turn=90.0)
TRACKS, POINTS = CLIP.tracks, CLIP.tracks.points
QUICK = {
    "kcs": {"rounds": 2, "arrangement": "frames"},
    "sfam": {"beta": 2.5, "num_steps": 30},
    "pkc": {"viewpoint": "fixed", "rounds": 0, "steps": 3},
    "rigid": {"num_steps": 1},
    "pta": {"rank": 2},
    "csf": {"rank": 2},
    "bmm": {"num_steps": 30},
    "smsr": {"num_steps": 30},
    "local_rigidity": {"window": 7},
    "pnd": {"num_steps": 5},
}
"""Fields with which each method is fast."""


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
    words = r"^tracks: no bones .* give a skeleton \(17 joints fit .*coco17.*'auto'"
    with pytest.warns(kt.KcsWarning, match=words) as told:
        result = reconstruct(POINTS)
    assert (result.method, result.skeleton.name, result.units) == ("pkc", "points", "px")
    assert result.lengths.shape == (0,)
    assert len(told) == 1 and told[0].filename == __file__


def test_several_bodies_without_a_skeleton():
    people = [replace(kt.Tracks.from_arrays(POINTS), source=name) for name in ("one", "two")]
    with pytest.warns(kt.KcsWarning, match="no bones are given") as told:
        kt.reconstruct_all(people, method="sfam")
    assert [str(one.message).partition(":")[0] for one in told if "no bones" in str(one.message)] == ["one", "two"]


def test_notes_are_those_of_the_bones_that_were_found():
    points = POINTS.clone()
    points[:, 0] = math.nan
    tracks = kt.Tracks.from_arrays(points, skeleton="h36m17", notes=["kept"])
    notes = ("kept", "never seen, so placed beside their neighbours, as there is no template: pelvis")
    assert with_found_bones(tracks).notes == notes


def test_arrays_that_seem_to_be_shares_of_an_image_are_told():
    shares = (POINTS - POINTS.min()) / (POINTS.max() - POINTS.min())
    with pytest.warns(kt.KcsWarning, match=r"give image_size=\(width, height\), or the body"):
        reconstruct(shares, method="rigid", num_steps=1)
    reconstruct(shares, method="rigid", num_steps=1, units="m")  # a warning would be an error here
    shares[3, 4, 1] = 1.02  # a joint has left the image
    with pytest.warns(kt.KcsWarning, match="lie within 0 and 1"):
        reconstruct(shares, method="rigid", num_steps=1)
    reconstruct(2 * shares - 1, method="rigid", num_steps=1)


def test_methods_that_know_of_no_bones_do_not_ask_for_them():
    assert not reconstruct(POINTS, method="rigid", num_steps=1).skeleton.bones  # a warning would be an error here


@pytest.mark.parametrize("name", METHODS)
def test_a_methods_name_its_object_and_its_fields_are_one(name):
    fields = QUICK[name]
    method = METHODS[name](**fields)
    by_name = reconstruct(TRACKS, method=name, **fields)
    for other in (reconstruct(TRACKS, method=method), method(TRACKS)):
        assert torch.equal(other.points, by_name.points)
        assert other.method == by_name.method == name
    assert not torch.equal(reconstruct(TRACKS, method=name).points, by_name.points)


def test_results_follow_the_tracks_dtype():
    for dtype in (torch.float32, torch.float64):
        for method, fields in QUICK.items():
            result = reconstruct(TRACKS.to(dtype), method=method, **fields)
            given = (result.points, result.cameras, result.lengths, *(a.points for a in result.alternatives))
            assert {x.dtype for x in given} == {dtype}
    read = reconstruct(POINTS.float().numpy(), method="sfam", skeleton="h36m17")
    assert read.points.dtype == torch.float64  # as readers give it


@pytest.mark.parametrize("method", QUICK)
def test_the_callers_default_precision_does_not_matter(method):
    tracks = TRACKS.to(torch.float32)
    expected = reconstruct(tracks, method=method, **QUICK[method])
    torch.set_default_dtype(torch.float64)
    try:
        found = reconstruct(tracks, method=method, **QUICK[method])
    finally:
        torch.set_default_dtype(torch.float32)
    assert found.points.dtype == torch.float32
    assert (found.points - expected.points).norm() < 1e-2 * expected.points.norm()


def test_the_package_exports_it():
    import kcs_torch.reconstruct  # noqa: F401  # the submodule must not hide the function

    assert kt.reconstruct is reconstruct and callable(kt.reconstruct)


# ---------------------------------------------------------------------- what it refuses


def test_unknown_methods():
    refused(OptionError, "unknown method 'sfma': did you mean 'sfam'?", "choices: auto, ", ", kcs, ", method="sfma")
    refused(OptionError, "unknown method 'KCS'", "kcs", method="KCS")
    for nonsense in (None, 3, ["kcs"]):
        refused(OptionError, "unknown method", "auto, ", ", pkc, ", method=nonsense)
    refused(OptionError, "method: expected a name or a Method, got the class KCS: make one, KCS()", method=KCS)


@dataclass(frozen=True)
class Own(Method):
    """A method of a user's own: the flat guess, changed."""

    name = "own"
    change: Callable

    def solve(self, tracks, cameras):
        still = torch.eye(3, dtype=torch.float64)[:2].expand(20, 2, 3)
        flat = torch.nn.functional.pad(tracks.points, (0, 1))
        return self.change(Estimate(flat, still, flat.new_ones(20), converged=True, iterations=1))


@pytest.mark.parametrize(
    ("change", "told"),
    [
        (lambda found: None, "expected an Estimate, got NoneType"),
        (lambda found: found.points, "expected an Estimate, got Tensor"),
        (
            lambda found: replace(found, points=found.points[1:]),
            "points: expected a tensor (20, 17, 3), got (19, 17, 3)",
        ),
        (
            lambda found: replace(found, points=found.points.numpy()),
            "points: expected a tensor (20, 17, 3), got ndarray",
        ),
        (
            lambda found: replace(found, points=found.points / 0),
            "points: expected finite numbers, got NaN or infinity in",
        ),
        (lambda found: replace(found, cameras=found.cameras[:, :1]), "cameras: expected a tensor (20, 2, 3), got"),
        (lambda found: replace(found, cameras=2 * found.cameras), "cameras: expected the first two rows of rotations"),
        (lambda found: replace(found, scales=-found.scales), "scales: expected numbers >= 0, got -"),
        (lambda found: replace(found, deviation=found.scales), "deviation: expected a tensor (20, 17), got (20,)"),
    ],
)
def test_what_is_no_estimate_of_a_method_of_ones_own(change, told):
    refused(KcsError, f"own: solve: {told}", method=Own(change))
    with pytest.raises(KcsError, match=re.escape(f"own: solve: {told}")):
        kt.reconstruct_all([TRACKS], method=Own(change))


@pytest.mark.filterwarnings("ignore::kcs_torch.KcsWarning")  # it tells no depth
def test_a_method_of_ones_own_in_another_precision():
    rough = reconstruct(TRACKS, method=Own(lambda found: found.to(torch.zeros(()))))
    assert {x.dtype for x in (rough.points, rough.cameras, rough.scales, rough.lengths)} == {torch.float64}
    assert_close(rough.points, reconstruct(TRACKS, method=Own(lambda found: found)).points, rtol=1e-5, atol=1e-3)


def test_as_many_estimates_as_clips(monkeypatch):
    monkeypatch.setattr(Own, "solve_all", lambda self, tracks: [], raising=False)
    with pytest.raises(ShapeError, match="own: solve_all: expected 1 estimate, got 0"):
        kt.reconstruct_all([TRACKS], method=Own(lambda found: found))


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
        ("sfam", "beta", float("nan"), "sfam: beta: expected a number, got nan"),
        ("sfam", "window", 20, "overlap: expected below the window of 20 frames, got 50"),
        ("sfam", "num_steps", "many", "sfam: num_steps: expected a whole number, got 'many'"),
    ],
)
def test_values_out_of_range(method, field, value, words):
    refused(OptionError, words, method=method, **{field: value})


def test_options_of_arrays_with_tracks():
    for option in ({"skeleton": "coco17"}, {"confidence": np.ones((20, 17))}, {"fps": 25}, {"units": "mm"}):
        refused(OptionError, "belong to arrays; these tracks already have them", **option)


@pytest.mark.parametrize("option", [{"joint_names": list("ab")}, {"edges": [(0, 1)]}, {"threshold": 0.5}])
def test_what_tracks_are_made_with_is_no_field_of_a_method(option):
    (name,) = option
    with pytest.raises(OptionError, match=rf"{name} belongs to the tracks: reconstruct\(Tracks\.from_arrays\("):
        kt.reconstruct(POINTS, **option)


def test_fields_with_auto_are_the_defaults_own():
    refused(OptionError, "unknown option of method 'pkc' 'beta'", "rounds", beta=1.0)
    refused(OptionError, "pkc: steps: expected at least 1, got 0", steps=0)


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


# ---------------------------------------------------------------------- the default


def error(points):
    """Mean distance to the truth of CLIP."""
    centre = lambda x: x - x.mean(1, keepdim=True)  # noqa: E731
    return float((centre(points) - centre(CLIP.points)).norm(dim=-1).mean())


def test_the_default_is_pkc_and_takes_its_fields():
    fields = QUICK["pkc"]
    default = reconstruct(TRACKS, **fields)
    assert default.method == "pkc"
    for other in (reconstruct(TRACKS, method="auto", **fields), PKC(**fields)(TRACKS)):
        assert torch.equal(other.points, default.points)
    assert error(default.points) < 0.3 * error(CLIP.points * torch.tensor([1.0, 1.0, 0.0]))


def test_without_fields_it_is_pkc_as_it_comes():
    assert torch.equal(reconstruct(TRACKS).points, PKC()(TRACKS).points)


def test_known_cameras_are_kept():
    for cameras in (CLIP.cameras, CLIP.cameras.numpy()):
        result = reconstruct(TRACKS, cameras=cameras)
        assert result.method == "pkc" and torch.equal(result.cameras, CLIP.cameras)


def test_a_skeleton_is_found_where_that_is_asked_for():
    plain = walking_person(40, turn=120.0).tracks.points
    result = reconstruct(plain, skeleton="auto", method="sfam")
    assert result.skeleton.is_tree and result.skeleton.num_bones == 16
    assert result.points.shape == (40, 17, 3) and result.lengths.shape == (16,)


@pytest.mark.parametrize("method", METHODS)
def test_warnings_point_to_the_caller(method):
    points = POINTS.clone()
    points[:, 6] = math.nan
    calls = (
        lambda: reconstruct(points, skeleton="h36m17", method=method, **QUICK[method]),
        lambda: METHODS[method](**QUICK[method])(kt.Tracks.from_arrays(points, skeleton="h36m17")),
    )
    for call in calls:
        with pytest.warns(kt.KcsWarning, match="never seen") as told:
            call()
        assert {w.filename for w in told} == {__file__}


def test_all_of_one_is_told():
    tracks = kt.data.walking_person(12).tracks
    with pytest.raises(OptionError, match="reconstruct_all: expected a list of Tracks, got one: reconstruct takes it"):
        kt.reconstruct_all(tracks)
    with pytest.raises(OptionError, match="reconstruct_all: item 1: expected Tracks"):
        kt.reconstruct_all([tracks, tracks.points])


@pytest.mark.parametrize(
    "call", [kt.reconstruct, lambda one: kt.reconstruct_all([one]), kt.KCS(), lambda one: kt.SfAM().many([one])]
)
def test_tracks_that_nothing_can_be_made_of_are_refused(call):
    """No frames, and half precision by ``Tracks.to``, ended in errors of torch about amax, pinv and quantile."""
    tracks = kt.data.walking_person(12).tracks
    with pytest.raises(ShapeError, match="expected at least 1 frame, got none in walking_person"):
        call(tracks.frames(5, 5))
    for dtype, name in ((torch.float16, "float16"), (torch.bfloat16, "bfloat16")):
        with pytest.raises(ShapeError, match=rf"single or double precision, got {name} in walking_person: use tracks"):
            call(tracks.to(dtype))


def test_methods_take_tracks_and_no_arrays():
    tracks = kt.data.walking_person(12).tracks
    with pytest.raises(OptionError, match=r"^kcs: expected Tracks \(see Tracks.from_arrays\), got"):
        kt.KCS()(tracks.points)
    with pytest.raises(OptionError, match="^sfam: item 1: expected Tracks"):
        kt.SfAM().many([tracks, tracks.points])


@pytest.mark.parametrize("step", [0, -1, 2.0, True])
def test_frames_go_forward_by_whole_steps(step):
    clip = kt.data.walking_person(12)
    motion = kt.Motion.from_arrays(clip.points, skeleton="h36m17", units="mm", up="-y")
    for one in (clip.tracks, motion):
        with pytest.raises(OptionError, match="frames: step: expected a whole number from 1, got"):
            one.frames(0, 10, step)
