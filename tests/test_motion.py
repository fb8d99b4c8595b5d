"""3D motion: axes, virtual joints, gaps, sizes, cameras; reading it from native files."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from samples import walk_result
from samples import walking_motion as walk

import kcs_torch as kt
from kcs_torch.errors import FormatError, OptionError, OutputError, ShapeError, SkeletonError
from kcs_torch.functional import orbit
from kcs_torch.io import MOTION_READERS, detect_motion_format, load_any, load_motion, save
from kcs_torch.io.formats.pages import as_result
from kcs_torch.types import Motion
from kcs_torch.types.axes import AXES, from_y_up, to_y_up
from kcs_torch.types.upright import lean

# ---------------------------------------------------------------------- the thing itself


def test_an_animal_that_faces_the_camera_does_not_lean():
    """Its head is before its feet; a person's is above them."""
    for name, leans in (("ap10k", False), ("coco17", True)):
        body = kt.SKELETONS[name]
        points = body.template_points(dtype=torch.float64)[None]
        points = to_y_up(points @ orbit(points.new_zeros(()), -20.0), "-y")
        told = lean(points, torch.ones(points.shape[:-1], dtype=torch.bool), body)
        assert abs(told) == pytest.approx(20, abs=5) if leans else told == 0


@pytest.mark.parametrize("up", AXES)
def test_axes_are_turned_and_not_mirrored(up):
    points = torch.randn(4, 3, 3, dtype=torch.float64)
    turned = to_y_up(points, up)
    assert torch.equal(from_y_up(turned, up), points)
    assert float(torch.linalg.det(to_y_up(torch.eye(3), up))) == 1
    assert torch.equal(turned[..., 1], points[..., "xyz".index(up[-1])] * (-1 if "-" in up else 1))


def test_a_result_stands_on_its_feet():
    result = walk_result().scaled(units="m", factor=1e-3)
    motion = Motion.of(result)
    nose, foot = motion.skeleton.index("nose"), motion.skeleton.index("left_ankle")
    assert bool((motion.points[:, nose, 1] > motion.points[:, foot, 1] + 1).all())
    assert float(motion.points[..., 1].min()) == 0
    assert float(motion.points[0, :, 0].mean()) == pytest.approx(0, abs=1e-9)
    assert (motion.units, motion.fps, motion.skeleton) == ("m", 25.0, result.skeleton)
    assert any("towards or away from the camera is not known" in note for note in motion.notes)
    back = from_y_up(motion.points, "-y")
    assert torch.allclose(back - back[:1, :1], result.points - result.points[:1, :1])


def test_joints_of_a_result_that_are_nan_are_unseen_and_spoil_no_others(tmp_path):
    result = walk_result().scaled(units="m", factor=1e-3)
    points = result.points.clone()
    points[0] = torch.nan
    points[3, 4] = torch.nan
    motion = Motion.of(replace(result, points=points))
    assert bool(torch.isfinite(motion.points).all()) and torch.equal(motion.seen, torch.isfinite(points).all(-1))
    apart = motion.points - Motion.of(result).points
    assert torch.allclose(apart[motion.seen], apart[5, 5].expand_as(apart[motion.seen]))
    for suffix in (".trc", ".csv"):
        back = load_motion(kt.save(motion, tmp_path / f"w{suffix}"))
        assert torch.equal(back.seen, motion.seen)
    nothing = Motion.of(replace(result, points=torch.full_like(points, torch.nan)))
    assert not bool(nothing.seen.any()) and bool((nothing.points == 0).all())


def test_a_result_walks_through_space_where_its_path_is_known():
    result = walk_result()
    path = torch.linspace(0, 2000, 12, dtype=torch.float64)
    motion = Motion.of(replace(result, root_depth=path))
    apart = Motion.of(result).points - motion.points
    assert torch.allclose(apart[..., 2] - apart[:1, :, 2], path[:, None].expand(-1, 19))  # z is towards the viewer
    seen = replace(result, distance=path + 5000)
    assert torch.equal(from_y_up(Motion.of(seen).points, "-y"), seen.in_space())  # the camera is the origin


@pytest.mark.parametrize("pitch", [25, -30.0])
def test_a_camera_that_looks_down_is_levelled(pitch, tmp_path):
    """With its path as without, and a note tells of a body that leans so much."""
    level = walk_result().scaled(units="m", factor=1e-3)
    tilt = orbit(torch.zeros((), dtype=torch.float64), pitch)
    seen = replace(level, points=level.points @ tilt.mT)
    expected = Motion.of(level).points
    assert torch.allclose(Motion.of(seen, pitch=pitch).points, expected)
    assert not torch.allclose(Motion.of(seen).points, expected, atol=0.2)
    there = torch.full((12,), 5.0, dtype=torch.float64)
    before = Motion.of(replace(level, distance=there)).points  # the camera is the origin
    far = replace(seen, points=from_y_up(before, "-y") @ tilt.mT, distance=0 * there)
    assert torch.allclose(Motion.of(far, pitch=pitch).points, before)
    notes: list[str] = []
    for suffix in (".trc", ".csv"):  # results in .csv are in the camera's axes otherwise
        save(seen, tmp_path / f"w{suffix}", pitch=pitch, notes=notes)
        assert torch.allclose(load_motion(tmp_path / f"w{suffix}").points, expected)
    assert not any("leans" in note for note in notes)
    save(seen, tmp_path / "w.trc", notes=notes)
    (said,) = (note for note in notes if "leans" in note)
    told = round(pitch + 10.7)  # the walk itself is seen from above
    assert f"leans {abs(told)} degrees {'towards' if told > 0 else 'away from'} it" in said and f"pitch {told})" in said
    save(level, tmp_path / "w.trc", notes=(level_notes := []))
    assert not any("leans" in note for note in level_notes)


def test_pitches_that_no_camera_has_and_files_that_are_not_levelled(tmp_path):
    result = walk_result(4).scaled(units="m", factor=1e-3)
    for wrong in (91, float("nan"), "5"):
        with pytest.raises(OptionError, match="pitch: expected the degrees by which the camera looked down"):
            Motion.of(result, pitch=wrong)
    with pytest.raises(OptionError, match=r"w\.npz: pitch is for \.bvh, \.c3d, \.csv, \.trc; this one"):
        save(result, tmp_path / "w.npz", pitch=5)
    with pytest.raises(OptionError, match="pitch is for results, .* got motion"):
        save(Motion.of(result), tmp_path / "w.trc", pitch=5)
    with pytest.raises(OptionError, match="are for 3D motion, got 2D tracks"):
        save(result.tracks, tmp_path / "w.npz", pitch=5)


def test_arrays_are_checked_like_tracks():
    points = np.random.default_rng(0).normal(size=(5, 17, 3))
    points[2, 3] = np.nan
    motion = Motion.from_arrays(points, skeleton="coco17", fps=30, units="m")
    assert motion.points.shape == (5, 19, 3)  # with the virtual joints
    assert motion.points.isfinite().all()
    assert not motion.seen[2, 3]
    pelvis = motion.points[:, motion.skeleton.index("pelvis")]
    assert torch.allclose(pelvis, torch.from_numpy(points[:, 11:13].mean(1)))
    with pytest.raises(ShapeError, match=r"expected shape \(frames, joints, 3\)"):
        Motion.from_arrays(points[..., :2])
    with pytest.raises(ShapeError, match="frame 0, joint 'joint1' is infinite"):
        Motion.from_arrays(np.where(np.arange(3)[:, None] == 1, np.inf, points[:1, :3]))
    with pytest.raises(ShapeError, match="no joint is seen"):
        Motion.from_arrays(np.full((2, 3, 3), np.nan))
    with pytest.raises(SkeletonError, match="17 joints of skeleton 'coco17'"):
        Motion.from_arrays(points[:, :5], skeleton="coco17")
    with pytest.raises(OptionError, match="axis for up"):
        Motion.from_arrays(points, up="upwards")


def test_names_find_the_skeleton_in_any_order():
    body = kt.SKELETONS["coco17"]
    motion = walk()
    order = torch.randperm(19, generator=torch.Generator().manual_seed(0)).tolist()
    points = motion.points.clone()
    points[:, body.index("neck")] += 1  # a file's own virtual joints are kept
    found = Motion.from_arrays(points[:, order], joint_names=[body.joints[i] for i in order])
    assert found.skeleton == body
    assert torch.equal(found.points, points)


def test_lengths_and_scale():
    motion = walk()
    gone = motion.weights.clone()
    gone[3, 5] = 0
    gone[:, 7] = 0
    part = replace(motion, weights=gone, points=motion.points * gone[..., None])
    for bone, a, b in zip(motion.skeleton.bones, motion.lengths, part.lengths, strict=True):
        assert math.isnan(b) if 7 in bone else float(b) == pytest.approx(float(a), rel=1e-6)
    tall = motion.scaled(units="cm", height=200)
    assert tall.units == "cm"
    assert float(tall.lengths[0] / motion.lengths[0]) == pytest.approx(200 / 1.5, rel=0.3)
    thigh = motion.scaled(units="mm", **{"left_hip-left_knee": 430})
    assert float(thigh.lengths[thigh.skeleton.bone_names.index("left_hip-left_knee")]) == pytest.approx(430)
    with pytest.raises(OptionError, match="unknown size 'weight'"):
        motion.scaled(units="m", weight=80)


def test_frames_thin_out():
    motion = walk()
    assert motion.frames(2, 10, 3).fps == pytest.approx(25 / 3)
    assert torch.equal(motion.frames(2, 10, 3).points, motion.points[2:10:3])


# ---------------------------------------------------------------------- filming it


def test_tracks_are_those_of_the_protocol(protocol, shared):
    case = {"src": "cmu/cmu_35_01", "yaw": 45, "pitch": 10, "orbit": 180, "max_frames": 60}
    given, truth = protocol.build(shared / "data", case)
    motion = load_motion(shared / "data" / "cmu" / "cmu_35_01.npz", up="y").frames(0, 240, 4)
    names = np.load(shared / "data" / "cmu" / "cmu_35_01.npz")["joint_names"][protocol.CMU17].tolist()
    at = [motion.skeleton.index(name) for name in names]
    tracks = motion.tracks(yaw=45, pitch=10, turn=180)
    centred = lambda x: x - x.mean(1, keepdims=True)  # noqa: E731
    assert np.allclose(centred(tracks.points[:, at].numpy()), centred(given["points2d"]), atol=1e-6)
    seen = motion.in_camera(yaw=45, pitch=10, turn=180)[:, at].numpy()
    assert np.allclose(centred(seen), centred(truth["points3d"]), atol=1e-6)
    assert (tracks.fps, tracks.units) == (30, "mm")


def test_the_camera_sees_the_front():
    motion = walk()  # from a result: the camera is where it was
    seen = motion.in_camera()
    assert torch.allclose(seen - seen[:1, :1], from_y_up(motion.points - motion.points[:1, :1], "-y"))


def test_a_pinhole_sees_all_of_it():
    motion = walk()
    lens = (900.0, 900.0, 640.0, 360.0)
    tracks = motion.tracks(intrinsics=lens, turn=90)
    assert tracks.units == "px"
    points = tracks.points[:, :17]
    assert bool(((points > 0) & (points < torch.tensor([1280.0, 720.0]))).all())
    assert float(points[..., 1].max() - points[..., 1].min()) > 150
    truth = motion.in_camera(turn=90)[:, :17]
    far = motion.tracks(intrinsics=lens, turn=90, distance=1e6).points[:, :17]
    centre = torch.tensor([640.0, 360.0], dtype=far.dtype)
    assert torch.allclose((far - centre) * 1e6 / 900, truth[..., :2], atol=1e-4)
    with pytest.raises(OptionError, match="distance: expected more than"):
        motion.tracks(intrinsics=lens, distance=0.1)
    with pytest.raises(OptionError, match=r"distance: expected it with intrinsics=.*, got 5 alone"):
        motion.tracks(distance=5)


def test_noise_and_gaps_of_tracks():
    motion = walk()
    weights = motion.weights.clone()
    weights[4, 9] = 0
    motion = replace(motion, weights=weights)
    clean = motion.tracks()
    assert not clean.seen[4, 9]
    assert clean.skeleton == motion.skeleton
    draw = lambda: motion.tracks(noise=0.01, generator=torch.Generator().manual_seed(1)).points  # noqa: E731
    assert torch.equal(draw(), draw())
    off = (draw() - clean.points)[:, :17][clean.seen[:, :17]]
    assert float(off.std()) == pytest.approx(0.01, rel=0.2)
    with pytest.raises(OptionError, match="noise"):
        motion.tracks(noise=-1)
    for angle in (float("nan"), float("inf"), "45", None):
        with pytest.raises(OptionError, match="yaw: expected a finite number of degrees, got"):
            motion.tracks(yaw=angle)


def test_what_is_filmed_can_be_lifted():
    clip = kt.data.walking_person(30, skeleton="h36m17")
    motion = Motion.from_arrays(clip.points, up="-y", skeleton=clip.skeleton, fps=30, units="mm")
    result = kt.reconstruct(motion.tracks(turn=120), method="kcs")
    found = kt.metrics.compare(Motion.of(result), motion, align=["similarity"])
    flat = kt.metrics.mpjpe(
        motion.in_camera(turn=120) * torch.tensor([1.0, 1, 0]), motion.in_camera(turn=120), align="similarity"
    )
    assert found.mpjpe["similarity"] < 0.7 * float(flat)


# ---------------------------------------------------------------------- native files


@pytest.mark.parametrize("up", ["y", "z"])
def test_native_file_gives_motion_back(tmp_path, up):
    motion = walk()
    weights = motion.weights.clone()
    weights[2, 4] = 0
    motion = replace(motion, weights=weights, points=motion.points * weights[..., None], notes=("made for a test",))
    path = save(motion, tmp_path / "m.npz", up=up)
    back = load_motion(path)
    assert torch.equal(back.points, motion.points)
    assert torch.equal(back.seen, motion.seen)
    assert (back.skeleton, back.fps, back.units, back.notes[:1]) == (motion.skeleton, 25.0, "m", motion.notes)
    assert isinstance(load_any(path), Motion)
    with pytest.raises(FormatError, match=r"load_motion\(path\) reads it"):
        kt.load_tracks(path)


def test_a_result_is_read_as_motion(tmp_path):
    result = walk_result()
    path = save(result, tmp_path / "r.npz")
    assert torch.equal(load_motion(path).points, Motion.of(result).points)
    assert isinstance(load_any(path), kt.Reconstruction)
    assert load_motion(path, fps=50).fps == 50


def test_the_rate_that_is_given_is_that_of_all_solutions(tmp_path):
    result = walk_result()
    path = save(replace(result, alternatives=(result.mirrored(),)), tmp_path / "r.npz")
    assert load_any(path, fps=50).solution(2).fps == 50


def test_motion_is_made_of_results_alone():
    motion = walk(8)
    for other, name in ((motion, "Motion"), (motion.tracks(), "Tracks"), (None, "NoneType")):
        with pytest.raises(OptionError, match=rf"Motion\.of: expected a result of reconstruct\(\), got {name}"):
            Motion.of(other)


def test_motion_without_frames_is_not_filmed():
    with pytest.raises(ShapeError, match="expected at least 1 frame, got none"):
        walk(8).frames(8, 9).tracks()


def test_tracks_are_written_and_read_back(tmp_path):
    tracks = walk_result().tracks
    back = load_any(save(tracks, tmp_path / "t.npz"))
    assert isinstance(back, kt.Tracks)
    assert torch.equal(back.points, tracks.points)
    assert torch.equal(back.weights, tracks.weights)
    with pytest.raises(OutputError, match=r"got 2D tracks, which go to .npz"):
        save(tracks, tmp_path / "t.bvh")


def test_arrays_of_others_are_taken_as_a_cameras(tmp_path):
    points = np.random.default_rng(0).normal(size=(5, 4, 3))
    np.savez(tmp_path / "a.npz", points3d=points, fps=np.nan)
    motion = load_motion(tmp_path / "a.npz")
    assert np.allclose(motion.points.numpy(), points * [1, -1, -1])
    assert any("camera's, y down" in note for note in motion.notes)
    assert np.allclose(load_motion(tmp_path / "a.npz", up="y").points.numpy(), points)
    assert motion.fps is None


@pytest.mark.parametrize(
    ("arrays", "message"),
    [
        ({"points2d": np.ones((3, 4, 2))}, "expected 3D motion under 'points3d'"),
        ({"points3d": np.ones((3, 4, 2))}, r"expected shape \(frames, joints, 3\)"),
        ({"points3d": np.ones((3, 4, 3)), "joint_names": np.array(["a"])}, "expected 4 names, got 1"),
        ({"points3d": np.array([None])}, "pickled"),
        ({"points3d": np.ones((3, 4, 3)), "up": np.array("w")}, "'up': expected one of y, z, x, -y, -z, got 'w'"),
    ],
)
def test_other_archives_are_refused(tmp_path, arrays, message):
    np.savez(tmp_path / "x.npz", **arrays)
    with pytest.raises(FormatError, match=message):
        load_motion(tmp_path / "x.npz")


# ---------------------------------------------------------------------- reading and writing in general


def test_options_are_checked(tmp_path):
    path = save(walk(), tmp_path / "m.npz")
    for options, message in [
        ({"format": "bvg"}, "did you mean 'bvh'"),
        ({"up": "w"}, "axis for up"),
        ({"fps": 0}, r"fps \(--fps\): expected a positive number"),
    ]:
        with pytest.raises(OptionError, match=message):
            load_motion(path, **options)
    (tmp_path / "text").write_text("hello")
    with pytest.raises(FormatError, match=f"formats {', '.join(MOTION_READERS)}, got something else"):
        load_motion(tmp_path / "text")
    with pytest.raises(FormatError, match="no such file"):
        load_motion(tmp_path / "absent.trc")
    with pytest.raises(FormatError, match="expected tracks or motion in one of"):
        load_any(tmp_path / "text")
    with pytest.raises(OptionError, match="unknown format"):
        load_any(path, format="nothing")


def test_units_of_files(tmp_path):
    motion = walk()
    for suffix, usual, factor in ((".trc", "m", 1), (".c3d", "mm", 1000)):
        back = load_motion(save(motion, tmp_path / f"m{suffix}"))
        assert back.units == usual
        assert torch.allclose(back.points, factor * motion.points, rtol=1e-5, atol=factor * 1e-6)
        inches = load_motion(save(motion, tmp_path / f"m{suffix}", units="in"))
        assert inches.units == "in"
        assert torch.allclose(inches.points, motion.points / 0.0254, rtol=1e-5, atol=1e-4)
    with pytest.raises(OptionError, match="unknown unit of length 'yards'"):
        save(motion, tmp_path / "m.trc", units="yards")


def test_an_unknown_size_is_told(tmp_path):
    motion = replace(walk(), units="px")
    with pytest.warns(kt.KcsWarning, match="m.trc: the true size is not known: lengths are in px; set it with"):
        save(motion, tmp_path / "m.trc")
    assert load_motion(tmp_path / "m.trc").units == "px"
    notes: list[str] = []
    save(motion, tmp_path / "m.bvh", notes=notes)
    assert any("--scale height=1.75m" in note for note in notes)
    hand = replace(Motion.from_arrays(torch.rand(3, 21, 3), skeleton="hand21", fps=30), units="px")
    with pytest.warns(kt.KcsWarning, match="set it with .* or --scale wrist-thumb_cmc=...mm"):
        save(hand, tmp_path / "hand.trc")
    with pytest.raises(OptionError, match="'hand21' has none: give a bone, such as wrist-thumb_cmc"):
        hand.scaled(units="m", height=0.18)
    with pytest.raises(OptionError, match="only lengths in px"):
        save(motion, tmp_path / "m.trc", units="mm")


def test_an_unknown_rate_is_told(tmp_path):
    for suffix in (".trc", ".c3d", ".bvh"):
        with pytest.warns(kt.KcsWarning, match="frame rate is not known: 30 is written") as told:
            replace(walk(), fps=None).save(tmp_path / f"m{suffix}")
        assert {w.filename for w in told} == {__file__}  # the user's own line
        assert load_motion(tmp_path / f"m{suffix}").fps == pytest.approx(30)


def test_motion_is_no_result(tmp_path):
    with pytest.raises(OutputError, match=r"got motion, which goes to .bvh, .c3d, .csv"):
        walk().save(tmp_path / "m.json")


def test_motion_can_be_looked_at(tmp_path):
    """Pages and pictures show motion as a camera beside it sees it."""
    motion = walk()
    shown = as_result(motion)
    assert shown.skeleton == motion.skeleton and shown.units == motion.units
    assert torch.allclose(shown.points, motion.in_camera(yaw=20.0, pitch=8.0))
    assert torch.allclose(shown.tracks.points, shown.points[..., :2], atol=1e-6 * float(shown.points.abs().max()))
    assert shown.diagnostics.bone_variation == pytest.approx(0, abs=0.1)
    for suffix in (".html", ".png"):
        assert motion.save(tmp_path / f"m{suffix}").stat().st_size > 5000


def test_pages_fill_gaps_and_lay_what_is_never_seen_on_its_neighbour():
    motion = walk()
    body, weights = motion.skeleton, motion.weights.clone()
    hip, knee, ankle, wrist = map(body.index, ("left_hip", "left_knee", "left_ankle", "right_wrist"))
    weights[:, [knee, ankle]] = 0
    weights[3, wrist] = 0
    gappy = replace(motion, weights=weights, points=motion.points * weights[..., None])
    filled = gappy.filled()
    assert torch.equal(filled[:, knee], motion.points[:, hip]) and torch.equal(filled[:, ankle], motion.points[:, hip])
    assert torch.allclose(filled[3, wrist], motion.points[[2, 4], wrist].mean(0))
    assert torch.equal(filled[gappy.seen], motion.points[gappy.seen])
    assert torch.equal(motion.filled(), motion.points)
    assert torch.allclose(as_result(gappy).points, replace(motion, points=filled).in_camera(yaw=20.0, pitch=8.0))


def test_csv_holds_results_as_they_are_or_with_an_axis_up(tmp_path):
    result = walk_result()

    def table(**options):
        path = save(result, tmp_path / "w.csv", **options)
        return np.genfromtxt(path, delimiter=",", skip_header=1)[:, 2:].reshape(12, -1, 3)

    assert np.allclose(table(), result.points)
    assert np.allclose(table(units="cm"), 100 * result.points)
    y, z = table(up="y"), table(up="z")
    assert np.allclose(y, Motion.of(result).points)
    assert np.allclose(z[..., 2], y[..., 1])
    assert np.allclose(z[..., 1], -y[..., 2])
    with pytest.raises(OptionError, match="holds results in the camera's axes"):
        save(result, tmp_path / "w.npz", up="y")
    with pytest.raises(OptionError, match="axis for up"):
        save(result, tmp_path / "w.csv", up="x")


def test_every_real_file_is_of_one_format(shared):
    files = [f for f in sorted((shared / "data" / "raw_formats").rglob("*")) if f.is_file()]
    found = {}
    for path in files:
        try:
            found[path.name] = detect_motion_format(path)
        except FormatError:
            continue
    names = {"runway03.c3d": "c3d", "35.asf": "amc", "35_01.amc": "amc"}
    names |= {"points3d.h5": "sleap", "reachingDEMO_3D.h5": "deeplabcut"}
    names |= {f.name: f.suffix[1:] for f in files if f.suffix in (".bvh", ".trc")}
    assert found == names
    assert set(found.values()) <= set(MOTION_READERS)
    for path in files:  # none of them is also read as tracks
        if path.name in found:
            with pytest.raises(FormatError, match="3D|motion|three"):
                kt.load_tracks(path)


def test_confidences_come_back(tmp_path):
    motion = walk(8)
    weights = torch.full_like(motion.weights, 0.4)
    weights[2, 3] = 0
    back = load_motion(save(replace(motion, weights=weights), tmp_path / "m.npz"))
    assert torch.allclose(back.weights, weights)


def test_own_virtual_joints_are_as_sure_as_they_are_told():
    body = kt.SKELETONS["coco17"]
    points, sure = torch.rand(4, 19, 3, generator=torch.Generator().manual_seed(0)).double(), torch.ones(4, 19)
    sure[:, -1], sure[:, -2] = 0, 0.3
    made = Motion.from_arrays(points, sure, joint_names=body.joints, skeleton="coco17")
    assert made.weights[:, -1].tolist() == [0] * 4 and made.weights[0, -2] == pytest.approx(0.3)
    assert torch.equal(made.points[:, -2], points[:, -2])
    points[0, -1] = math.inf
    with pytest.raises(ShapeError, match=f"joint '{body.joints[-1]}' is infinite"):
        Motion.from_arrays(points, joint_names=body.joints, skeleton="coco17")


@pytest.mark.parametrize(("lens", "distance"), [((1000, 1000, 0, 0), None), ((1000, 1000, 960, 540), "far")])
def test_a_distance_is_a_number_that_something_tells(lens, distance):
    with pytest.raises(OptionError, match="distance: expected a number"):
        walk(8).tracks(intrinsics=lens, distance=distance)


def test_what_is_said_of_a_file_goes_before_it_and_a_note_tells(tmp_path):
    made = Motion.from_arrays(torch.rand(5, 17, 3, dtype=torch.float64), skeleton="h36m17", units="m", fps=30)
    made.save(tmp_path / "a.trc")
    made.save(tmp_path / "a.npz")
    read = load_motion(tmp_path / "a.trc", units="Centimetres")
    assert read.units == "cm"
    note = "the file says that its unit is m: its numbers are read as cm, as units=cm (kcs-torch: --from-units) asks"
    assert note in read.notes
    turned = load_motion(tmp_path / "a.npz", up="z")
    assert "the file says that y points up: z is taken to, as up=z (kcs-torch: --from-up) asks" in turned.notes
    for same in (load_motion(tmp_path / "a.npz", up="y", units="m"), load_motion(tmp_path / "a.npz")):
        assert not same.notes
        torch.testing.assert_close(same.points, made.points, rtol=0, atol=0)
    with pytest.raises(OptionError, match="unknown unit 'foo'"):
        load_motion(tmp_path / "a.npz", units="foo")


def test_results_keep_their_path_in_depth_whatever_is_said_of_them(tmp_path):
    result = walk_result(12).scaled(units="m", factor=1e-3)
    path = torch.linspace(0, 3, 12).to(result.points)
    replace(result, root_depth=path).save(tmp_path / "r.npz")
    plain = load_motion(tmp_path / "r.npz")
    assert float(plain.points[..., 2].amax() - plain.points[..., 2].amin()) > 2.5
    for same in ({"up": "-y"}, {"skeleton": plain.skeleton}):
        torch.testing.assert_close(load_motion(tmp_path / "r.npz", **same).points, plain.points, rtol=0, atol=0)
    turned = load_motion(tmp_path / "r.npz", up="z")
    torch.testing.assert_close(turned.points[..., 1], -plain.points[..., 2])
    assert any("the file says that -y points up: z is taken to" in note for note in turned.notes)
    fewer = load_motion(tmp_path / "r.npz", skeleton="h36m17")
    of = lambda motion, name: motion.points[:, motion.skeleton.index(name)]  # noqa: E731
    torch.testing.assert_close(of(fewer, "left_knee"), of(plain, "left_knee"))
    assert load_motion(tmp_path / "r.npz", units="metres").units == "m"


@pytest.mark.parametrize("units", ["", "  "])
def test_a_size_has_a_unit(units):
    result = walk_result(4)
    for motion in (result, Motion.of(result)):
        with pytest.raises(OptionError, match="units: expected the name of the new unit"):
            motion.scaled(units=units, height=1.75)
