"""The native .npz: what it takes, what it refuses, and exact round trips."""

import io
import json
import pickle
import zipfile
from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from samples import walk_result

from kcs_torch.errors import FormatError, KcsError, KcsWarning, OptionError, SkeletonError
from kcs_torch.io import load_people, load_reconstruction, load_tracks, save
from kcs_torch.io.containers import archive
from kcs_torch.skeleton import SKELETONS, Skeleton
from kcs_torch.types import Intrinsics, Tracks

quick = settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])


def arrays(num_frames=5, **changes):
    rng = np.random.default_rng(1)
    given_ = {
        "points2d": rng.uniform(0, 100, (num_frames, 3, 2)),
        "confidence": rng.uniform(0.5, 1, (num_frames, 3)),
        "edges": np.array([[0, 1], [1, 2]]),
        "joint_names": np.array(["hip", "knee", "ankle"]),
        "fps": np.float64(50),
        "units": np.array("mm"),
    } | changes
    return {k: v for k, v in given_.items() if v is not None}


def written(path, **changes):
    np.savez(path, **arrays(**changes))
    return path


# ---------------------------------------------------------------------- tracks


def test_reads_everything(tmp_path):
    tracks = load_tracks(written(tmp_path / "leg.npz"))
    assert tracks.skeleton.joints == ("hip", "knee", "ankle")
    assert tracks.skeleton.bones == ((0, 1), (1, 2))
    assert (tracks.fps, tracks.units, tracks.num_frames) == (50.0, "mm", 5)
    assert torch.equal(tracks.points, torch.from_numpy(arrays()["points2d"]))
    assert torch.equal(tracks.weights, torch.from_numpy(arrays()["confidence"]))


def test_confidences_may_be_called_so(tmp_path):
    confidence = arrays()["confidence"]
    tracks = load_tracks(written(tmp_path / "leg.npz", confidence=None, confidences=confidence))
    assert torch.equal(tracks.weights, torch.from_numpy(confidence))


def test_points_alone_are_enough(tmp_path):
    np.savez(tmp_path / "p.npz", points2d=arrays()["points2d"].astype(np.float32))
    tracks = load_tracks(tmp_path / "p.npz")
    assert (tracks.fps, tracks.units, tracks.skeleton.num_bones) == (None, "px", 0)
    assert (tracks.weights == 1).all()


def test_names_may_be_bytes_and_rate_unknown(tmp_path):
    tracks = load_tracks(written(tmp_path / "b.npz", joint_names=np.array([b"a", b"b", b"c"]), fps=np.float32("nan")))
    assert tracks.skeleton.joints == ("a", "b", "c")
    assert tracks.fps is None


def test_nan_is_unseen_and_threshold_counts(tmp_path):
    points, confidence = arrays()["points2d"], arrays()["confidence"]
    points[2, 1] = np.nan
    confidence[3, 0] = 0.2
    path = written(tmp_path / "n.npz", points2d=points, confidence=confidence)
    assert (~load_tracks(path).seen).nonzero().tolist() == [[2, 1], [3, 0]]
    assert (~load_tracks(path, threshold=0.1).seen).nonzero().tolist() == [[2, 1]]


def test_options_go_before_the_file(tmp_path):
    body = Skeleton.from_names(["ankle", "knee"], [("knee", "ankle")], name="shank")
    tracks = load_tracks(written(tmp_path / "o.npz"), skeleton=body, fps=10)
    assert tracks.fps == 10
    assert torch.equal(tracks.points, torch.from_numpy(arrays()["points2d"][:, [2, 1]]))  # matched by name
    assert torch.equal(tracks.weights, torch.from_numpy(arrays()["confidence"][:, [2, 1]]))
    assert "matched by name" in tracks.notes[0]


@pytest.mark.parametrize("units", ["px", "Pixels"])
def test_shares_of_the_image_become_pixels(tmp_path, units):
    """--image-size went unheard."""
    points = arrays()["points2d"] * 0 + [0.25, 0.5]
    path = written(tmp_path / "a.npz", points2d=points, units=units)
    tracks = load_tracks(path, image_size=(1280, 720))
    assert tracks.points[tracks.seen].unique(dim=0).tolist() == [[320, 360]]
    path = written(tmp_path / "b.npz", points2d=points * 1000, units=units)
    tracks = load_tracks(path, image_size=(1280, 720))
    assert tracks.points[tracks.seen].unique(dim=0).tolist() == [[250, 500]]
    assert tracks.image_size == (1280, 720) and tracks.units == "px" and not tracks.notes


def test_the_file_may_tell_the_size_of_the_image(tmp_path):
    points = arrays()["points2d"] * 0 + [0.25, 0.5]
    told = {"units": "px", "image_size": np.array([1280, 720])}
    for scale in ([1280, 720], 1):
        tracks = load_tracks(path := written(tmp_path / "a.npz", points2d=points * scale, **told))
        assert tracks.image_size == (1280, 720)
        assert tracks.points[tracks.seen].unique(dim=0).tolist() == [[320, 360]]
    assert load_tracks(path, image_size=(640, 480)).image_size == (640, 480)  # the caller goes before the file
    assert load_tracks(path, image_size=(640, 480)).points[0, 0].tolist() == [160, 240]
    path = written(tmp_path / "mm.npz", image_size=np.array([1280, 720]))
    assert load_tracks(path).image_size is None
    with pytest.raises(OptionError, match=r"mm.npz: image_size: expected tracks in pixels .* got units 'mm': leave it"):
        load_tracks(path, image_size=(1280, 720))  # it went unheard


def test_shares_that_are_saved_come_back_in_pixels(tmp_path):
    tracks = Tracks.from_arrays(np.random.default_rng(0).random((5, 17, 2)), skeleton="coco17", image_size=(1280, 720))
    back = load_tracks(save(tracks, tmp_path / "a.npz"))
    assert torch.equal(back.points, tracks.points) and back.image_size == (1280, 720) and back.notes == tracks.notes


def test_none_is_as_good_as_no_array(tmp_path):
    """np.savez pickles it."""
    keys = ("confidence", "edges", "fps", "units", "image_size", "skeleton", "notes", "detector")
    tracks = load_tracks(written(tmp_path / "a.npz", **dict.fromkeys(keys, np.array(None))))
    assert (tracks.fps, tracks.units, tracks.image_size, tracks.detector) == (None, "px", None, None)
    with pytest.raises(FormatError, match="'points2d' holds pickled objects"):
        load_tracks(written(tmp_path / "b.npz", points2d=np.array(None)))
    for size in ([1920, None], {"width": 1920}):
        path = written(tmp_path / "c.npz", image_size=np.array(size, object))
        with pytest.raises(FormatError, match="'image_size' holds pickled .* write it as an array of numbers, .* None"):
            load_tracks(path)


@pytest.mark.parametrize("size", [(0, 720), (-1280, 720), (1280.5, 720), (1280,), "large", (True, True), (np.nan, 1)])
def test_a_size_that_is_none_is_unknown(tmp_path, size):
    tracks = load_tracks(written(tmp_path / "a.npz", units="px", image_size=np.array(size)))
    assert tracks.image_size is None and not tracks.notes


def test_letters_that_there_are_none_of(tmp_path):
    """Python fails on such a text, in whatever it is asked first."""
    for order in "<>":
        units = np.array(["mm"], f"{order}U2")
        units.view(f"{order}u4")[1] = 0x100006D if order == "<" else 0x110000
        with pytest.raises(FormatError, match="'units' is damaged: it holds letters that there are none of"):
            load_tracks(written(tmp_path / "a.npz", units=units))
    assert load_tracks(written(tmp_path / "a.npz", units=np.array("\U0010ffff"))).units == "\U0010ffff"


def test_what_may_be_shares_of_the_image_is_told(tmp_path):
    points = np.random.default_rng(0).uniform(0.2, 0.8, arrays()["points2d"].shape)
    with pytest.warns(KcsWarning, match="if they are shares of the image"):
        notes = load_tracks(written(tmp_path / "a.npz", points2d=points, units="px")).notes
    told = [note for note in notes if "image_size=" in note]
    assert len(told) == 1
    path = written(tmp_path / "a.npz", points2d=points, units="px", notes=np.array(json.dumps(told)))
    with pytest.warns(KcsWarning, match="if they are shares of the image"):
        again = load_tracks(path).notes
    assert [note for note in again if "image_size=" in note] == told  # once, in a file that was saved with it
    metres = load_tracks(written(tmp_path / "b.npz", points2d=points, units="m")).notes
    assert not any("image_size=" in note for note in metres)


def test_other_names_are_taken_in_their_order(tmp_path):
    body = Skeleton.from_names(["a", "b", "c"], [("a", "b"), ("b", "c")])
    tracks = load_tracks(written(tmp_path / "o.npz"), skeleton=body)
    assert torch.equal(tracks.points, torch.from_numpy(arrays()["points2d"]))
    assert any("order" in n for n in tracks.notes)


def test_names_that_do_not_fit_are_told(tmp_path):
    body = Skeleton.from_names(["hip", "knee", "heel", "toe"], [("hip", "knee"), ("knee", "heel"), ("heel", "toe")])
    with pytest.raises(SkeletonError, match=r"got 3 joints, none of them named heel, toe; they are hip, knee, ankle"):
        load_tracks(written(tmp_path / "o.npz"), skeleton=body)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"points2d": None}, "'points2d' .* got confidence, edges"),
        ({"points2d": np.zeros((5, 3))}, r"'points2d': expected 3 dimensions, got shape \(5, 3\)"),
        ({"points2d": np.zeros((5, 3, 3))}, "points: expected shape"),
        ({"points2d": np.zeros((0, 3, 2))}, "at least 1 frame"),
        ({"points2d": np.zeros((5, 3, 2), complex)}, "'points2d': expected floating-point numbers"),
        ({"points2d": np.full((5, 3, 2), "x")}, "'points2d': expected floating-point numbers"),
        ({"points2d": np.full((5, 3, 2), np.inf)}, "frame 0, joint 'hip' is infinite"),
        ({"points2d": np.full((5, 3, 2), np.nan)}, "no joint is seen"),
        ({"confidence": np.ones((5, 4))}, "confidence: expected shape"),
        ({"confidence": np.full((5, 3), -0.1)}, "is negative"),
        ({"confidence": np.full((5, 3), np.inf)}, "is infinite"),
        ({"confidence": np.ones(5)}, "'confidence': expected 2 dimensions"),
        ({"edges": np.array([[0, 7]])}, "edges"),
        ({"edges": np.array([0, 1, 2])}, "edges: expected shape"),
        ({"edges": np.array([[0.0, np.nan]])}, "'edges': expected integers"),
        ({"joint_names": np.array(["a", "b"])}, "joint_names: expected 3 names, got 2"),
        ({"joint_names": np.array([1, 2, 3])}, "'joint_names': expected text"),
        ({"joint_names": np.array(["a", "a", "b"])}, "given twice: a"),
        ({"fps": np.array([1.0, 2.0])}, "'fps': expected one value"),
        ({"fps": np.float64(-5)}, "fps: expected a positive number"),
        ({"units": np.float64(1)}, "'units': expected text"),
    ],
)
def test_wrong_content_names_file_and_key(tmp_path, changes, message):
    with pytest.raises(KcsError, match=message) as caught:
        load_tracks(written(tmp_path / "bad.npz", **changes))
    assert "bad.npz" in str(caught.value)


def test_motion_without_tracks_says_so(tmp_path):
    np.savez(tmp_path / "m.npz", points3d=np.zeros((4, 3, 3)))
    with pytest.raises(FormatError, match="3D motion only"):
        load_tracks(tmp_path / "m.npz")


def test_arrays_of_other_names_are_told_theirs(tmp_path):
    np.savez(tmp_path / "m.npz", np.zeros((4, 17, 2)))
    with pytest.raises(FormatError, match=r"expected an array 'points2d' .* numpy\.savez\(.* got arr_0"):
        load_tracks(tmp_path / "m.npz")


# ---------------------------------------------------------------------- files that mean harm


class Burglar:
    def __init__(self, path):
        self.path = path

    def __reduce__(self):
        return (open, (self.path, "w"))


@pytest.mark.parametrize("key", ["points2d", "confidence", "edges", "joint_names", "units"])
def test_pickles_are_refused_and_not_run(tmp_path, key):
    loot = tmp_path / "loot"
    evil = np.array([Burglar(str(loot))], object)
    path = written(tmp_path / "evil.npz", **{key: evil})
    loot.unlink(missing_ok=True)
    with pytest.raises(FormatError, match=f"'{key}' holds pickled objects"):
        load_tracks(path)
    assert not loot.exists()


def test_a_bare_pickle_is_no_format(tmp_path):
    loot = tmp_path / "loot"
    (tmp_path / "evil.npz").write_bytes(pickle.dumps(Burglar(str(loot))))
    loot.unlink(missing_ok=True)
    with pytest.raises(FormatError):
        load_tracks(tmp_path / "evil.npz")
    with pytest.raises(FormatError):
        load_tracks(tmp_path / "evil.npz", format="npz")
    assert not loot.exists()


def test_zip_bombs_are_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(archive, "LARGE", 2**20)
    np.savez_compressed(tmp_path / "bomb.npz", points2d=np.zeros((100_000, 3, 2)))
    with pytest.raises(FormatError, match=r"'points2d' unpacks from .* refused as a zip bomb"):
        load_tracks(tmp_path / "bomb.npz")


def test_too_much_is_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(archive, "LIMIT", 400)
    with pytest.raises(FormatError, match="unpack"):
        load_tracks(written(tmp_path / "big.npz"))


def test_a_header_that_claims_too_much_reserves_nothing(tmp_path):
    npy = io.BytesIO()
    np.lib.format.write_array_header_1_0(npy, {"descr": "<f8", "fortran_order": False, "shape": (10**13, 3, 2)})
    with zipfile.ZipFile(tmp_path / "claim.npz", "w") as file:
        file.writestr("points2d.npy", npy.getvalue() + bytes(48))
    with pytest.raises(FormatError, match="'points2d': its size does not fit its shape"):
        load_tracks(tmp_path / "claim.npz")


@pytest.mark.parametrize("share", [0.1, 0.5, 0.9, 0.99])
def test_truncated_files_say_so(tmp_path, share):
    path = written(tmp_path / "cut.npz")
    data = path.read_bytes()
    path.write_bytes(data[: int(len(data) * share)])
    with pytest.raises(FormatError, match=r"cut.npz.*(damaged|truncated)"):
        load_tracks(path)


@quick
@given(data=st.data())
def test_flipped_bytes_give_tracks_or_our_errors(tmp_path, data):
    raw = bytearray(written(tmp_path / "good.npz").read_bytes())
    for _ in range(data.draw(st.integers(1, 4))):
        raw[data.draw(st.integers(0, len(raw) - 1))] = data.draw(st.integers(0, 255))
    (tmp_path / "flipped.npz").write_bytes(raw[: data.draw(st.integers(1, len(raw)))])
    try:
        people = load_people(tmp_path / "flipped.npz", format=data.draw(st.sampled_from([None, "npz"])))
    except KcsError:
        return
    assert all(torch.isfinite(p.points).all() for p in people)


@quick
@given(data=st.data())
def test_flipped_arrays_give_tracks_or_our_errors(tmp_path, data):
    """As above, but behind the zip archive's check sums, which would catch the change."""
    key = data.draw(st.sampled_from(sorted(arrays())))
    good = written(tmp_path / "good.npz")
    with zipfile.ZipFile(good) as old, zipfile.ZipFile(tmp_path / "flipped.npz", "w") as new:
        for member in old.infolist():
            raw = bytearray(old.read(member))
            if member.filename == f"{key}.npy":
                for _ in range(data.draw(st.integers(1, 3))):
                    raw[data.draw(st.integers(0, len(raw) - 1))] = data.draw(st.integers(0, 255))
            new.writestr(member.filename, bytes(raw))
    try:
        tracks = load_tracks(tmp_path / "flipped.npz")
    except KcsError:
        return
    assert torch.isfinite(tracks.points).all()


# ---------------------------------------------------------------------- results


def same(a, b):
    return a is b is None or (a.dtype == b.dtype and torch.equal(a, b))


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("skeleton", ["coco17", "body25", "h36m17"])
def test_results_come_back_exactly(tmp_path, skeleton, dtype):
    result = walk_result(skeleton=skeleton, dtype=dtype, fps=None if skeleton == "body25" else 29.97)
    back = load_reconstruction(save(result, tmp_path / "r.npz"))
    for name in ("points", "cameras", "scales", "lengths", "uncertainty"):
        assert same(getattr(back, name), getattr(result, name)), name
    for name in ("points", "weights"):
        assert same(getattr(back.tracks, name), getattr(result.tracks, name)), name
    assert back.skeleton == result.skeleton
    for name in ("fps", "units", "source", "notes"):
        assert getattr(back.tracks, name) == getattr(result.tracks, name)
    assert (back.method, back.units) == (result.method, result.units)
    assert repr(back.diagnostics) == repr(result.diagnostics)  # repr: NaN is not NaN


def solutions():
    """A result with a mirror image, and a solution of its own distance, units left open and no uncertainty."""
    best = replace(walk_result(), objective=-109.25 - 1e-13, root_depth=torch.linspace(0, 1, 12).double())
    far = torch.linspace(5, 6, 12).double()
    facts = replace(best.diagnostics, notes=("the mirror image in depth",), reprojection_rms=2 / 3)
    mirror = replace(best.mirrored(), objective=-100.0, diagnostics=facts)
    other = replace(best, points=best.points + 1 / 3, objective=float("nan"), distance=far, uncertainty=None)
    other = replace(other, intrinsics=Intrinsics(900.0, 1100.0, 1 / 3, -5.0))
    return replace(best, alternatives=(mirror, replace(other, root_depth=None, lengths=best.lengths / 3)))


def test_objective_and_alternatives_come_back_exactly(tmp_path):
    result = solutions()
    back = load_reconstruction(save(result, tmp_path / "r.npz"))
    assert len(back.alternatives) == 2
    for ours, theirs in zip((result, *result.alternatives), (back, *back.alternatives), strict=True):
        for name in ("points", "cameras", "scales", "lengths", "uncertainty", "root_depth", "distance"):
            assert same(getattr(theirs, name), getattr(ours, name)), name
        assert repr(theirs.objective) == repr(ours.objective)
        assert repr(theirs.diagnostics) == repr(ours.diagnostics)
        assert (theirs.method, theirs.units, theirs.intrinsics) == (ours.method, ours.units, ours.intrinsics)
        assert theirs.tracks is back.tracks


def test_a_result_of_an_earlier_version_has_no_alternatives(tmp_path):
    path = save(solutions(), tmp_path / "r.npz")
    with np.load(path) as file:
        old = {k: v for k, v in file.items() if k not in ("alternatives", "objective") and "alternative" not in k}
    np.savez(path, **old)
    back = load_reconstruction(path)
    assert back.alternatives == () and np.isnan(back.objective)


def test_results_without_uncertainty_come_back(tmp_path):
    back = load_reconstruction(save(walk_result(uncertain=False), tmp_path / "r.npz"))
    assert back.uncertainty is None


@pytest.mark.parametrize("name", list(SKELETONS))
def test_every_skeleton_comes_back(tmp_path, name):
    body = SKELETONS[name]
    assert Skeleton.from_dict(json.loads(json.dumps(body.to_dict()))) == body


def test_half_precision_comes_back_as_the_same_numbers(tmp_path):
    result = walk_result()
    half = replace(result, points=result.points.to(torch.bfloat16))
    assert torch.equal(load_reconstruction(save(half, tmp_path / "h.npz")).points, half.points.float())


def test_results_hold_what_the_measuring_protocol_reads(tmp_path):
    result = walk_result()
    with np.load(save(result, tmp_path / "r.npz"), allow_pickle=False) as file:
        assert file["points3d"].shape == (12, result.skeleton.num_observed, 3)
        assert np.array_equal(file["points3d"], result.observed.numpy())
        assert np.array_equal(file["points3d_all"], result.points.numpy())
        assert file["cameras"].shape == (12, 2, 3)
        assert list(file["joint_names_all"]) == list(result.skeleton.joints)
        assert np.array_equal(file["bones"], result.skeleton.bone_index().numpy())
        unseen = file["confidence"] == 0
        assert unseen.any()
        assert np.array_equal(np.isnan(file["points2d"]).all(-1), unseen)
        assert (file["edges"] < len(file["joint_names"])).all()


def test_results_are_tracks_again(tmp_path):
    result = walk_result()
    tracks = load_tracks(save(result, tmp_path / "r.npz"), threshold=0)
    assert torch.equal(tracks.points, result.tracks.points)
    assert torch.equal(tracks.weights, result.tracks.weights)
    assert tracks.skeleton == result.skeleton
    assert tracks.units == result.tracks.units
    assert tracks.notes == result.tracks.notes


@pytest.mark.parametrize(
    ("key", "value", "message"),
    [
        ("points3d_all", None, "without points3d_all"),
        ("points3d_all", np.zeros((12, 3, 3)), "'points3d_all': expected"),
        ("points3d_all", np.full((12, 19, 3), np.inf), "'points3d_all': expected finite numbers"),
        ("confidence", np.full((12, 17), 2.0), "'points2d': expected finite"),
        ("fps", np.array(-1.0), "'fps': expected a positive number"),
        ("cameras", np.zeros((12, 2, 3), int), "'cameras': expected floating-point"),
        ("confidence", np.full((12, 17), np.nan), "'points2d': expected finite"),
        ("skeleton", np.array("{"), "'skeleton': expected JSON"),
        ("skeleton", np.array("[]"), "'skeleton': expected a JSON dict"),
        ("skeleton", np.array("9" * 5000), "'skeleton': expected JSON"),
        ("skeleton", np.array('{"joints": ["a", "a"], "bones": []}'), "given twice"),
        ("diagnostics", np.array("{}"), "'diagnostics'"),
        ("notes", np.array("7"), "'notes': expected a JSON list"),
        ("objective", np.array("best"), "'objective': expected"),
        ("alternatives", np.array(3), "expected an array 'alternative3_points3d_all'"),
        ("alternatives", np.array(10**9), "'alternatives': expected how many"),
        ("alternatives", np.array(-1), "'alternatives': expected how many"),
        ("alternatives", np.array(np.nan), "'alternatives': expected how many"),
        ("alternative1_points3d_all", np.zeros((12, 3, 3)), "'alternative1_points3d_all': expected"),
        ("alternative2_diagnostics", np.array("{}"), "'alternative2_diagnostics'"),
        ("alternative2_intrinsics", np.array([-1.0, 1, 0, 0]), "expected positive focal lengths"),
    ],
)
def test_damaged_results_are_told(tmp_path, key, value, message):
    path = save(solutions(), tmp_path / "r.npz")
    with np.load(path) as file:
        content = dict(file)
    del content[key]
    np.savez(path, **content, **({} if value is None else {key: value}))
    with pytest.raises(FormatError, match=message) as caught:
        load_reconstruction(path)
    assert "r.npz" in str(caught.value)


def test_tracks_are_no_result(tmp_path):
    with pytest.raises(FormatError, match="load_tracks"):
        load_reconstruction(written(tmp_path / "t.npz"))
    (tmp_path / "t.txt").write_text("hello")
    with pytest.raises(FormatError, match=r"expected a result"):
        load_reconstruction(tmp_path / "t.txt")


# ---------------------------------------------------------------------- real files


def test_every_file_of_the_data_folder_loads_or_says_why(shared):
    files = sorted((shared / "data").rglob("*.npz"))
    assert files
    for path in files:
        with np.load(path, allow_pickle=False) as file:
            keys = set(file.files)
        if "points2d" in keys:
            assert load_tracks(path).num_frames > 1
        else:
            with pytest.raises(FormatError, match="3D motion only"):
                load_tracks(path)


def test_tracks_come_back_as_sure_as_they_were(tmp_path):
    """Also joints that cleaning filled, whose confidence is low, and what is known of a detector."""
    tracks = walk_result().tracks
    for detector, size in ((None, None), (False, (1280, 720)), (True, None)):
        weights, guess = tracks.weights.clone(), None if size else (0, 0)
        weights[3, 4] = 0.1
        points = tracks.points / 10 + tracks.points.new_tensor([640, 360])  # within the image
        mine = replace(tracks, points=points, weights=weights, detector=detector, units="px", image_size=size)
        mine = replace(mine, image_guess=guess)
        back = load_tracks(save(mine, tmp_path / "t.npz"))
        assert (back.detector, back.image_size, back.image_guess) == (detector, size, guess)
        assert float(back.weights[3, 4]) == pytest.approx(0.1)
        assert not load_tracks(tmp_path / "t.npz", threshold=0.3).seen[3, 4]
        whole = save(replace(walk_result(), tracks=mine), tmp_path / "r.npz")
        back = load_reconstruction(whole).tracks
        assert (back.detector, back.image_size, back.image_guess) == (detector, size, guess)


def test_files_of_others_go_through_a_threshold(tmp_path):
    faint = np.ones((5, 3))
    faint[2, 1] = 0.2
    path = written(tmp_path / "raw.npz", confidence=faint)
    assert not load_tracks(path).seen[2, 1]
    assert load_tracks(path, threshold=0.1).seen[2, 1]
