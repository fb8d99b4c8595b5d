"""Plain tables: columns for each joint of any names, times, people, confidences by all their names, and 3D motion."""

import warnings

import numpy as np
import pytest
import torch
from samples import lines, person, write_mediapipe_csv, write_table
from typer.testing import CliRunner

import kcs_torch as kt
from kcs_torch.cli import app
from kcs_torch.errors import FormatError, KcsError, KcsWarning, OptionError
from kcs_torch.io import (
    READERS,
    detect_format,
    detect_motion_format,
    load_any,
    load_motion,
    load_people,
    load_tracks,
)
from kcs_torch.io.registry import Probe
from kcs_torch.skeleton import SKELETONS
from kcs_torch.types import Motion

LEG = ("hip", "left knee", "Foot")


def notes_of(path, **options):
    return " | ".join(load_tracks(path, **options).notes)


# ---------------------------------------------------------------------- tracks


@pytest.mark.parametrize("what", ["confidence", "conf", "score", "likelihood", "probability", "prob", "c", "Score"])
def test_confidences_are_weights_whatever_they_are_called(tmp_path, what):
    path = write_table(tmp_path / "a.csv", LEG, ("x", "y", what))
    text = path.read_text().splitlines()
    text[1] = text[1].removesuffix("0.8") + "0.1"
    text[2] = text[2].removesuffix("0.8")
    tracks = load_tracks(lines(path, *text))
    assert detect_format(path) == "csv"
    assert tracks.skeleton.joints == LEG
    assert tracks.weights.tolist() == [[0.8, 0.8, 0], [0.8, 0.8, 0], [0.8] * 3, [0.8] * 3]
    assert np.allclose(tracks.points[2:], person(4, 3)[2:, :, :2])
    assert tracks.fps == 25
    assert load_tracks(path, threshold=0.05).weights[0, 2] == pytest.approx(0.1)


@pytest.mark.filterwarnings("ignore:.*shares of the image")
@pytest.mark.parametrize(("said", "unit"), [("[mm]", "mm"), ("[Metres]", "m"), ("[px]", "px"), ("[pixels]", "px")])
def test_the_header_tells_the_unit_of_tracks(tmp_path, said, unit):
    """They were taken for pixels."""
    wide = lines(tmp_path / "a.csv", f"a_x {said},a_y {said},b_x {said},b_y {said}", ".1,.2,.3,.4", ".1,.3,.2,.4")
    long = lines(
        tmp_path / "b.csv", f"frame,joint,x {said},y {said}", "0,a,.1,.2", "0,b,.3,.4", "1,a,.1,.3", "1,b,.2,.4"
    )
    for path in (wide, long):
        tracks = load_tracks(path)
        assert tracks.units == unit
        assert any("image_size" in note for note in tracks.notes) == (unit == "px")  # as they may be shares of it
        if unit != "px":
            with pytest.raises(OptionError, match=f"expected tracks in pixels of the image, got units '{unit}'"):
                load_tracks(path, image_size=(640, 480))


def test_visibility_is_no_confidence(tmp_path):
    path = write_table(tmp_path / "a.csv", LEG, ("x", "y", "visibility"))
    assert load_tracks(path).weights.numpy() == pytest.approx(0.3 + 0.7 * 0.8)
    assert "visibility v tells what is hidden" in notes_of(path)


def test_a_joint_without_a_confidence_is_seen_and_other_columns_are_told(tmp_path):
    header = "a_x,a_y,a_score,a_visibility,b_x,b_y,b_std_dev,c_x,d_y,remark"
    path = lines(tmp_path / "a.csv", header, "1,2,.5,.1,3,4,9,5,6,good", "1,3,.5,.1,3,5,9,5,6,bad")
    tracks = load_tracks(path)
    assert (tracks.skeleton.joints, tracks.weights[0].tolist()) == (("a", "b"), [0.5, 1.0])
    assert "columns are missing, so their joints are left out: c_y, d_x" in tracks.notes
    assert "columns of joints that are left out: visibility, std_dev" in tracks.notes


@pytest.mark.parametrize("name", ["body25", "h36m17", "coco17", "ap10k", "cmu17"])
def test_names_of_a_built_in_skeleton_select_it_in_any_order(tmp_path, name):
    body = SKELETONS[name]
    names = body.joints[: body.num_observed]
    path = write_table(tmp_path / "a.csv", names[::-1])
    tracks = load_tracks(path)
    assert tracks.skeleton is body
    assert np.allclose(tracks.points[:, : len(names)], person(4, len(names))[:, ::-1, :2])
    assert (tracks.weights[:, : len(names)] == 0.8).all()


def test_other_spellings_of_the_table(tmp_path):
    text = write_table(tmp_path / "a.csv", LEG).read_text()
    expected = load_tracks(tmp_path / "a.csv").points
    for change in (
        text.replace("_", "."),
        text.replace(",", ";"),
        text.replace(",", "\t"),
        text.replace("_x", "_X [px]").replace("_y", "_Y [px]"),
        "\ufeff" + text,
    ):
        (tmp_path / "b.csv").write_text(change, encoding="utf-8", newline="")
        assert detect_format(tmp_path / "b.csv") == "csv"
        assert torch.equal(load_tracks(tmp_path / "b.csv").points, expected)


@pytest.mark.parametrize("missing", ["", "nan", "NaN", "NA", "N/A", "null", "None"])
def test_missing_numbers_are_unseen_joints_however_they_are_written(tmp_path, missing):
    wide = lines(tmp_path / "w.csv", "frame,a_x,a_y,b_x,b_y", "0,1,2,3,4", f"1,{missing},{missing},5,6")
    long = lines(tmp_path / "l.csv", "frame,joint,x,y", "0,a,1,2", "0,b,3,4", f"1,a,{missing},{missing}", "1,b,5,6")
    for path in (wide, long):
        tracks = load_tracks(path)
        assert tracks.seen.tolist() == [[True, True], [False, True]]
        assert tracks.points[tracks.seen].tolist() == [[1, 2], [3, 4], [5, 6]]


def test_a_row_a_frame_is_one_body_however_it_jumps(tmp_path):
    rows = [",".join(map(str, row)) for row in np.random.default_rng(0).uniform(1, 500, (30, 6)).tolist()]
    (tracks,) = load_people(lines(tmp_path / "a.csv", "a_x,a_y,b_x,b_y,c_x,c_y", *rows))
    assert tracks.seen.all() and tracks.num_frames == 30


def test_numbers_of_rows_are_no_people(tmp_path):
    (tracks,) = load_people(lines(tmp_path / "a.csv", "id,a_x,a_y,b_x,b_y", *(f"{t},{t + 1},2,3,4" for t in range(5))))
    assert tracks.seen.all() and tracks.num_frames == 5


def test_people_by_a_column(tmp_path):
    rows = [f"{t},{who},{100 * at + t},5,{100 * at + t},50" for t in range(4) for at, who in ((1, "b"), (7, "a"))]
    a, b = load_people(lines(tmp_path / "a.csv", "frame,person,hip_x,hip_y,foot_x,foot_y", *rows))
    assert {a.points[0, 0, 0].item(), b.points[0, 0, 0].item()} == {100, 700}
    assert a.points[:, 0, 0].diff().tolist() == [1, 1, 1]


@pytest.mark.parametrize("order", [lambda rows: rows, sorted], ids=["in turns", "one after the other"])
@pytest.mark.parametrize("column", ["animal", "individual", "track", "person"])
def test_animals_without_numbers_of_frames_are_told_apart(tmp_path, column, order):
    rows = order([f"{who},{100 * at + t},5,{100 * at + t},50" for t in range(4) for at, who in ((1, "b"), (7, "a"))])
    people = load_people(lines(tmp_path / "a.csv", f"{column},hip_x,hip_y,foot_x,foot_y", *rows))
    assert sorted(one.points[:, 0, 0].tolist() for one in people) == [[100, 101, 102, 103], [700, 701, 702, 703]]
    assert any("each person's rows are counted from 0" in note for note in people[0].notes)


@pytest.mark.parametrize(
    ("column", "times", "fps", "seen"),
    [
        ("time", [0, 0.04, 0.08, 0.12], 25, [0, 1, 2, 3]),
        ("time [s]", [7, 7.04, 7.12, 7.16], 25, [0, 1, 3, 4]),
        ("time", [0, 40, 80, 120], 25, [0, 1, 2, 3]),
        ("time_ms", [0, 2000, 4000, 6000], 0.5, [0, 1, 2, 3]),
        ("t", [0.12, 0.08, 0.04, 0], 25, [0, 1, 2, 3]),
        ("timestamp", [0, 0.04, 0.1, 0.12], 25, [0, 1, 2, 3]),
        ("time", ["", "", "", ""], None, [0, 1, 2, 3]),
        ("time", [1, 1e30, 2, 3], None, [0, 1, 2, 3]),
        ("timestamp", [0, 5e-324, 0.1, 0.12], 25, [0, 1, 2, 3]),
    ],
    ids=["seconds", "gap", "milliseconds", "unit", "backwards", "uneven", "none", "far", "near"],
)
def test_times_place_frames_and_tell_the_rate(tmp_path, column, times, fps, seen):
    path = lines(tmp_path / "a.csv", f"{column},a_x,a_y,b_x,b_y", *(f"{t},{9 - i},2,3,4" for i, t in enumerate(times)))
    tracks = load_tracks(path)
    assert tracks.seen.all(1).nonzero().flatten().tolist() == seen
    assert tracks.fps is None if fps is None else tracks.fps == pytest.approx(fps, rel=1e-3)
    assert ("uneven" in notes_of(path)) == (column == "timestamp")
    if column == "t":
        assert tracks.points[:, 0, 0].tolist() == [6, 7, 8, 9]
    assert load_tracks(path, fps=50).fps == 50


@pytest.mark.parametrize(("fps", "unit", "digits"), [(30, 1000, 0), (29.97, 1, 3), (240, 1000, 0)])
def test_times_may_be_rounded(tmp_path, fps, unit, digits):
    kept = [i for i in range(3000) if i % 40 != 9 and not 1000 <= i < 1300]  # many short gaps, and a long one
    rows = (f"{unit * i / fps:.{digits}f},{i},2,3,4" for i in kept)
    tracks = load_tracks(lines(tmp_path / "a.csv", "timestamp,a_x,a_y,b_x,b_y", *rows))
    assert tracks.seen.all(1).nonzero().flatten().tolist() == kept
    assert tracks.fps == pytest.approx(fps, rel=1e-4)
    assert not any("uneven" in note for note in tracks.notes)


@pytest.mark.parametrize(
    ("column", "start", "told"), [("time", 0, True), ("t", 1, True), ("time_s", 0, False), ("time", 0.5, True)]
)
def test_times_that_count_frames_are_told(tmp_path, column, start, told):
    path = lines(tmp_path / "a.csv", f"{column},a_x,a_y,b_x,b_y", *(f"{start + i},{9 - i},2,3,4" for i in range(4)))
    assert load_tracks(path).fps == 1
    assert ("at 1 frame a second: give fps=... (kcs-torch: --fps) if they count frames" in notes_of(path)) == told


def test_frames_go_before_times_and_their_steps_are_frames(tmp_path):
    path = lines(tmp_path / "a.csv", "frame,time,a_x,a_y,b_x,b_y", *(f"{5 * i},{i / 6},1,2,3,4" for i in (0, 1, 3)))
    tracks = load_tracks(path)
    assert tracks.seen.all(1).tolist() == [True, True, False, True]
    assert tracks.fps == pytest.approx(6, abs=1e-3)


def test_a_blank_row_is_a_frame_where_nothing_numbers_the_frames(tmp_path):
    """It was left out, so that those after it came too soon."""
    rows = ["1,2,3,4", ",,,", "2,2,3,4", "", "3,2,3,4", ",,,"]
    tracks = load_tracks(lines(tmp_path / "a.csv", "a_x,a_y,b_x,b_y", *rows))
    assert tracks.seen.all(1).tolist() == [True, False, True, True]
    tracks = load_tracks(lines(tmp_path / "b.csv", "frame,a_x,a_y,b_x,b_y", "0,1,2,3,4", ",,,,", "1,2,2,3,4"))
    assert tracks.num_frames == 2 and bool(tracks.seen.all())


def test_landmarks_whose_z_is_a_length_are_motion(tmp_path):
    """They were read as 2D tracks in pixels; lengths in metres are told from shares by nobody."""
    body = SKELETONS["mediapipe33"]
    head = ",".join(f"{name}_{axis}" for name in body.joints[:33] for axis in "xyz")
    points = 1000 * body.template_points()[:33].numpy()
    rows = [",".join(map(str, ((points + t) * scale).ravel())) for scale in (1, 1e-3) for t in range(3)]
    path = lines(tmp_path / "a.csv", head, "," * 98, *rows[:3])
    motion = load_any(path)
    assert isinstance(motion, Motion) and detect_motion_format(path) == "csv" and motion.num_frames == 4
    assert np.ptp(motion.points[1, :33].numpy(), 0).max() == pytest.approx(np.ptp(points, 0).max())
    path = lines(tmp_path / "b.csv", head, *rows[3:])
    with pytest.raises(FormatError, match="got landmarks of an image: .* name the format: csv;"):
        load_motion(path)
    assert load_motion(path, format="csv").num_frames == 3


@pytest.mark.parametrize("place", ["frame", "time"])
def test_an_index_beside_frames_or_times_numbers_rows(tmp_path, place):
    """It was taken for the frames, so that of two people each was seen in every other one."""
    rows = [f"{2 * t + k},{t},{k},{1 + t},2,{3 + k},4" for t in range(3) for k in (0, 1)]
    people = load_people(lines(tmp_path / "a.csv", f"index,{place},person,a_x,a_y,b_x,b_y", *rows))
    assert [(p.num_frames, bool(p.seen.all())) for p in people] == [(3, True), (3, True)]
    rows = [f"{3 * t + k},{t},{j},{1 + t},{2 + k}" for t in range(3) for k, j in enumerate("abc")]
    tracks = load_tracks(lines(tmp_path / "b.csv", f"index,{place},joint,x,y", *rows))
    assert tracks.num_frames == 3 and bool(tracks.seen.all())


def test_shares_of_the_image_are_told_and_scaled_by_its_size(tmp_path):
    path = lines(tmp_path / "a.csv", "a_x,a_y,b_x,b_y", ".1,.2,.3,.4", ".1,.2,.3,.5")
    with pytest.warns(KcsWarning, match=r"a\.csv: .*if they are shares .*--image-size 1920x1080\); else the"):
        tracks = load_tracks(path)
    assert any("if they are shares of the image, give image_size" in note for note in tracks.notes)
    assert tracks.points[0].tolist() == [[0.1, 0.2], [0.3, 0.4]]
    told = CliRunner().invoke(app, ["info", str(path)])
    assert "if they are shares" in told.stderr and "if they are shares" not in told.stdout
    beside = lines(tmp_path / "b.csv", "a_x,a_y,b_x,b_y", "-.1,.2,.3,1.4", "-.1,.2,.3,1.5")
    assert "if they are shares" in notes_of(beside)  # metres, rather: no warning, which would be an error here
    assert load_tracks(path, image_size=(100, 50)).points[0].numpy() == pytest.approx(np.array([[10, 10], [30, 20]]))


HEAD = "frame,a_x,a_y,b_x,b_y"


@pytest.mark.parametrize(
    ("rows", "message"),
    [
        ((HEAD,), "in at least one of 0 frames"),
        (("frame,joint,px,py", "0,a,1,2"), "expected columns such as nose_x, nose_y, got 'frame,joint,px,py'"),
        ((f"{HEAD},a_x", "0,1,2,3,4,5"), "expected every column once, got 'a_x' again"),
        ((HEAD, "0,1,2,3,4", "1,2,3"), "row 3: expected 5 values as in the first row, got 3"),
        ((HEAD, "0,1,x,3,4"), "row 2: 'a_y': expected a number, got 'x'"),
        ((HEAD, "0,1,2,3,4", "0,1,2,3,4"), "row 3: expected every frame once, or a column 'person', got frame 0 again"),
        (("time" + HEAD[5:], ".5,1,2,3,4", ".5,1,2,3,4"), "row 3: .* got time 0.5 again"),
        ((HEAD.replace(",", ";"), "0;1,5;2;3;4"), r"row 2: 'a_x': expected a number, got '1,5' \(write decimals with"),
        ((HEAD, "0,1,inf,3,4"), "row 2: 'a_y': expected a coordinate"),
        (("a_x,a_y,a_z,b_x,b_y,b_z", "1,2,3,4,5,6"), "expected 2D tracks, got 3D motion .* leave the columns z out"),
    ],
)
def test_tables_that_are_none_are_told(tmp_path, rows, message):
    path = lines(tmp_path / "broken.csv", *rows)
    with pytest.raises(KcsError, match=message) as caught:
        load_people(path, format="csv")
    assert str(path) in str(caught.value)


def test_what_no_reader_takes_says_what_a_table_needs(tmp_path):
    path = lines(tmp_path / "long.csv", "frame,joint,px,py", "0,a,1,2")
    expected = "got a table that begins with 'frame,joint,px,py': csv has .*name_x, name_y.* frame, joint, x, y"
    with pytest.raises(FormatError, match=expected):
        load_tracks(path)


def test_mediapipes_tables_stay_mediapipes(tmp_path):
    path = write_mediapipe_csv(tmp_path / "a.csv")
    deep = lines(tmp_path / "b.csv", *path.read_text().replace("_visibility", "_z").splitlines())
    for table, got in ((path, "got something else"), (deep, "got landmarks of an image: .* name the format: csv;")):
        assert [name for name, reader in READERS.items() if reader.recognises(Probe(table))] == ["mediapipe"]
        with pytest.raises(FormatError, match=got):
            detect_motion_format(table)
    assert load_motion(deep, format="csv").skeleton.name == "mediapipe33"
    assert isinstance(load_any(deep, format="csv"), kt.Motion)
    with pytest.warns(KcsWarning, match="if they are shares of the image"):
        assert isinstance(load_any(path, format="csv"), kt.Tracks)


# ---------------------------------------------------------------------- motion


@pytest.fixture(scope="module")
def result():
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", kt.KcsWarning)
        return kt.reconstruct(kt.data.walking_person(12, skeleton="coco17", fps=30).tracks, method="kcs")


def test_joints_of_no_name_have_no_columns(tmp_path):
    motion = Motion.from_arrays(torch.randn(3, 2, 3), joint_names=["a", " "])
    with pytest.raises(kt.OutputError, match=r"walk\.csv: .* that of joint 1 is blank"):
        kt.save(motion, tmp_path / "walk.csv")
    assert not list(tmp_path.iterdir())


def test_joints_of_one_name_but_for_blanks_have_no_columns_of_their_own(tmp_path):
    """Such a table was written, and could not be read."""
    motion = Motion.from_arrays(torch.randn(3, 2, 3), joint_names=["a", " a"])
    with pytest.raises(kt.OutputError, match=r"walk\.csv: .* two joints are 'a': rename one"):
        kt.save(motion, tmp_path / "walk.csv")
    assert not list(tmp_path.iterdir())


def test_coordinates_as_large_as_tracks_may_have_are_read_back(tmp_path, result):
    back = load_motion(kt.save(Motion.of(result).scaled(units="u", factor=1e24), tmp_path / "walk.csv"))
    assert torch.allclose(back.points / 1e24, Motion.of(result).points, rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize("height", [None, 1.7], ids=["pixels", "metres"])
def test_a_result_is_read_back_as_motion(tmp_path, result, height):
    moved = result if height is None else result.scaled(height=height, units="m")
    path = kt.save(moved, tmp_path / "walk.csv")
    assert detect_motion_format(path) == "csv"
    motion = load_motion(path)
    assert motion.skeleton is SKELETONS["coco17"]  # with the virtual joints
    assert (motion.fps, motion.units) == (30, moved.units)
    assert torch.allclose(motion.points, moved.points * torch.tensor([1.0, -1, -1]), rtol=1e-6, atol=1e-6)
    assert any(note.startswith("-y is taken to point up") for note in motion.notes)
    with pytest.raises(FormatError, match=r"got 3D motion \(csv\)"):
        load_tracks(path)


@pytest.mark.parametrize("up", ["y", "z"])
def test_motion_with_gaps_is_read_back(tmp_path, result, up):
    motion = kt.Motion.of(result)
    motion.weights[3, 9] = 0
    motion.points[3, 9] = 0
    back = load_motion(kt.save(motion, tmp_path / "walk.csv", up=up))
    assert torch.equal(back.weights, motion.weights)
    assert torch.allclose(back.points, motion.points, rtol=1e-6, atol=1e-6)
    assert back.fps == 30


def test_the_command_line_scores_and_converts_it(tmp_path, result):
    motion = kt.Motion.of(result.scaled(height=1.7, units="m"))
    table, truth = kt.save(motion, tmp_path / "walk.csv"), kt.save(motion, tmp_path / "walk.trc")
    for words in (["score", table, truth], ["score", truth, table], ["convert", table, tmp_path / "b.bvh"]):
        done = CliRunner().invoke(app, [str(word) for word in words])
        assert done.exit_code == 0, done.output
        assert words[0] != "score" or "100.0 %" in done.output


def test_commands_take_the_format_of_motion_that_looks_like_mediapipes(tmp_path):
    names = SKELETONS["mediapipe33"].joints[:33]
    path = write_table(tmp_path / "walk.csv", names, ("x", "y", "z"))

    def told(*words, code=0):
        done = CliRunner().invoke(app, [str(word) for word in words])
        assert done.exit_code == code, done.output
        return done.output

    assert "got 2D tracks: lift them first (kcs-torch lift), or say with --format" in told("angles", path, code=2)
    assert "left_knee" in told("angles", path, "--format", "csv")
    assert "expected 3D motion" in told("score", path, path, "--pred-format", "csv", code=2)
    assert "MPJPE" in told("score", path, path, "--pred-format", "csv", "--truth-format", "csv")
    told("convert", path, tmp_path / "walk.npz", "--format", "csv")
    assert load_motion(tmp_path / "walk.npz").skeleton.name == "mediapipe33"
    for words in (["angles", path, "--format"], ["score", path, path, "--pred-format"]):
        assert "unknown format 'cvs'" in told(*words, "cvs", code=2)
    assert "got 2D tracks" in told("angles", write_table(tmp_path / "a.csv", names), "--format", "csv", code=2)


def test_markers_of_any_names(tmp_path):
    path = lines(
        tmp_path / "rig.csv",
        "time,m1_x [mm],m1_y [mm],m1_z [mm],'=m2_x [mm],'=m2_y [mm],'=m2_z [mm]",
        "0,1,2,3,4,5,6",
        "0.01,1,2,3,,,",
        "0.03,1,2,3,4,5,6",
    )
    motion = load_motion(path)
    assert (motion.skeleton.joints, motion.fps, motion.units) == (("m1", "=m2"), 100, "mm")
    assert motion.seen.tolist() == [[True, True], [True, False], [False, False], [True, True]]
    assert load_motion(path, up="z").points[0].tolist() == [[1, 3, -2], [4, 6, -5]]
    assert any("3D" in note or "frame" in note for note in motion.notes)


@pytest.mark.parametrize(
    ("rows", "message"),
    [
        (("a_x,a_y,a_z,b_x,b_y,b_z",), "expected a row a frame"),
        (
            ("t,id,a_x,a_y,a_z,b_x,b_y,b_z", "0,1,1,2,3,4,5,6", "0,2,1,2,3,4,5,6"),
            "the motion of one body, got several",
        ),
        (("a_x,a_y,a_z,b_x,b_y,b_z", "1,2,3,4,5,?"), r"row 2: 'b_z': expected a number, got '\?'"),
    ],
)
def test_motion_that_is_none_is_told(tmp_path, rows, message):
    path = lines(tmp_path / "broken.csv", *rows)
    with pytest.raises(KcsError, match=message) as caught:
        load_motion(path)
    assert str(path) in str(caught.value)


def test_a_zero_is_a_place_unless_it_is_the_corner(tmp_path):
    """These tables may be anything, also about the body's middle; detectors' own files know no place at 0."""
    rows = ("frame,a_x,a_y,b_x,b_y", "0,412,0,300.5,44", "1,410,0,333.5,44", "2,405,10,303.5,44")
    assert load_tracks(lines(tmp_path / "a.csv", *rows)).seen.all()
    rows = ("frame,a_x,a_y,b_x,b_y", "0,0,0,-30,44", "1,0,0,33,44", "2,5,60,30,44")
    assert load_tracks(lines(tmp_path / "b.csv", *rows)).seen.all()
    rows = ("frame,a_x,a_y,b_x,b_y", "0,0,0,3,4", "1,1,2,3,4")
    tracks = load_tracks(lines(tmp_path / "c.csv", *rows))
    assert tracks.seen.tolist() == [[False, True], [True, True]]
    assert any(note.startswith("1 joint that lies exactly at (0, 0) is taken as unseen") for note in tracks.notes)
    rows = ("frame,a_x,a_y,b_x,b_y", "0,0,0,-1,4", *(f"{t},{t},2,3,4" for t in range(1, 12)))  # one beside the image
    assert load_tracks(lines(tmp_path / "d.csv", *rows)).seen[0].tolist() == [False, True]


# ---------------------------------------------------------------------- tables of pandas and others


@pytest.mark.parametrize("name", ["Frame #", "frame_no", "Frame Number", "FRAME ID", "frame", "frameindex", "index"])
def test_frame_numbers_by_any_usual_name(tmp_path, name):
    path = lines(tmp_path / "a.csv", f"{name},a_x,a_y,b_x,b_y", "4,1,2,3,4", "5,1,2,3,4", "7,1,2,3,4")
    tracks = load_tracks(path)
    assert tracks.num_frames == 4 and tracks.weights[2].sum() == 0


def test_a_column_without_a_name_is_told_unless_it_counts_rows(tmp_path):
    """pandas writes its index so: of a table cut out of another it numbers frames, or rows of several people."""
    rows = ("1,2,3,4", "5,6,7,8", "1,3,3,5")
    for index, told in (("0", "1", "2"), False), (("1", "2", "3"), False), (("7", "9", "11"), True):
        for name in ("", "Unnamed: 0"):
            path = lines(tmp_path / "a.csv", f"{name},a_x,a_y,b_x,b_y", *map(",".join, zip(index, rows, strict=True)))
            assert ("one without a name (call it 'frame'" in notes_of(path)) is told
    path = lines(
        tmp_path / "a.csv", "image,a_x,a_y,b_x,b_y,_x,_y", *(f"{k}.png,{row},0,0" for k, row in enumerate(rows))
    )
    assert "other columns are left out: image, _x, _y" in notes_of(path)


@pytest.mark.parametrize("missing", ["NULL", "n/a", "#N/A", "<NA>", "none", "NaN", " "])
def test_missing_numbers_in_any_usual_spelling(tmp_path, missing):
    tracks = load_tracks(lines(tmp_path / "a.csv", "a_x,a_y,b_x,b_y", f"{missing},2,3,4", "1,2,3,4"))
    assert tracks.weights.tolist() == [[0, 1], [1, 1]]


def test_line_breaks_in_the_names_of_columns(tmp_path):
    """Quoted, they are legal CSV, which spreadsheets write; our own tables are read back."""
    body = kt.Skeleton.from_names(["nose\ntip", 'the "big", toe', "hip"], [], tree=False)
    result = kt.Motion.from_arrays(torch.randn(5, 3, 3, dtype=torch.float64), up="y", skeleton=body, units="m")
    kt.save(result, tmp_path / "a.csv")
    again = load_motion(tmp_path / "a.csv", up="y")
    assert again.skeleton.joints == body.joints
    torch.testing.assert_close(again.points, result.points)
    path = lines(tmp_path / "b.csv", 'frame,"nose\ntip_x","nose\ntip_y",b_x,b_y', "0,1,2,3,4")
    assert detect_format(path) == "csv" and load_tracks(path).skeleton.joints == ("nose\ntip", "b")
    with pytest.raises(FormatError, match="columns such as"):
        load_tracks(lines(tmp_path / "c.csv", 'frame,"a_x,a_y', "1,2,3"), format="csv")


def test_some_joints_of_coco_are_no_landmarks(tmp_path):
    """Limbs of a person, without the face: MediaPipe's 33 landmarks would be unseen for the most part."""
    limbs = SKELETONS["coco17"].joints[5:17]
    tracks = load_tracks(write_table(tmp_path / "a.csv", limbs, ("x", "y", "score")))
    assert tracks.skeleton.name == "coco17" and "these joints of coco17 have no columns" in " ".join(tracks.notes)
    assert tracks.seen[:, 5:17].all() and not tracks.seen[:, :5].any()
    visible = load_tracks(write_table(tmp_path / "b.csv", limbs, ("x", "y", "visibility")), image_size=(100, 100))
    assert visible.skeleton.name == "mediapipe33"


@pytest.mark.parametrize("name", ["coco17", "h36m17", "mpii16", "ap10k", "wholebody63"])
def test_names_that_others_have_too_are_no_landmarks(tmp_path, name):
    """In metres, which are small numbers; capitals and blanks do not matter for COCO's."""
    names = SKELETONS[name].joints[: SKELETONS[name].num_observed]
    path = write_table(tmp_path / "a.csv", names, ("x", "y"))
    header, *rows = path.read_text().splitlines()
    small = [",".join([row.split(",")[0], *(str(float(x) / 200) for x in row.split(",")[1:])]) for row in rows]
    tracks = load_tracks(lines(path, header, *small))
    assert detect_format(path) == "csv" and tracks.skeleton.name == name
    assert np.allclose(tracks.points[:, : len(names)], person(4, len(names))[..., :2] / 200)
    if name == "coco17":
        lines(path, header.replace("left_", "Left ").replace("right_", "Right "), *small)
        assert load_tracks(path).skeleton.name == name
    deep = write_table(tmp_path / "b.csv", names, ("x", "y", "z"))
    assert detect_motion_format(deep) == "csv" and load_motion(deep).skeleton.name == name


def test_which_way_is_up_is_told_where_it_is_assumed(tmp_path):
    path = write_table(tmp_path / "a.csv", ("snout", "tail"), ("x", "y", "z"))
    assert any("point up" in note for note in load_motion(path).notes)
    assert not any("point up" in note for note in load_motion(path, up="-y").notes)


def _two_people(path, spelt, *, long=False):
    """Two people, 300 px apart, six frames; ``spelt`` tells what a frame calls each of them."""
    rows = ["frame,person,joint,x,y" if long else "frame,person,a_x,a_y,b_x,b_y"]
    for t in range(6):
        for who in range(2):
            places = {"a": (300 * who + 10 + t, 20), "b": (300 * who + 15 + t, 60)}
            start = f"{t},{spelt(t, who)}"
            if long:
                rows += [f"{start},{name},{x},{y}" for name, (x, y) in places.items()]
            else:
                rows.append(",".join([start, *(f"{x},{y}" for x, y in places.values())]))
    return lines(path, *rows)


@pytest.mark.parametrize("long", [False, True])
@pytest.mark.parametrize(
    "spelt", [lambda t, who: f"{who}.0" if t % 2 else who, lambda t, who: f" {who}" if t % 2 else who]
)
def test_a_person_is_one_however_the_number_is_spelt(tmp_path, spelt, long):
    people = load_people(_two_people(tmp_path / "a.csv", spelt, long=long), skeleton=None)
    assert [int(one.seen.any(1).sum()) for one in people] == [6, 6]
    assert {one.notes[0] for one in people} == {"the file calls this one '0'", "the file calls this one '1'"}


@pytest.mark.parametrize("missing", ["", "nan", "NA", "-1"])
def test_somebody_without_an_id_is_followed_by_place(tmp_path, missing):
    spelt = lambda t, who: missing if who and t == 3 else f"p{who}"  # noqa: E731
    people = load_people(_two_people(tmp_path / "a.csv", spelt))
    assert [int(one.seen.any(1).sum()) for one in people] == [6, 6]
    assert all(any("a track id is missing in frame 3" in note for note in one.notes) for one in people)
    nobody = load_people(_two_people(tmp_path / "b.csv", lambda t, who: missing))
    assert [int(one.seen.any(1).sum()) for one in nobody] == [6, 6]


def test_motion_of_two_without_ids_is_not_of_one(tmp_path):
    rows = [f"{t},,{x},1,1,{x + 1},2,2,{x + 2},3,3" for t in range(3) for x in (0, 50)]
    path = lines(tmp_path / "a.csv", "frame,person,a_x,a_y,a_z,b_x,b_y,b_z,c_x,c_y,c_z", *rows)
    with pytest.raises(FormatError, match="expected the motion of one body, got several"):
        load_motion(path)
