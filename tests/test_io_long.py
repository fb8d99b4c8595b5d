"""Long tables: a row a frame and joint."""

import numpy as np
import pytest
import torch
from samples import SAMPLES, lines, person, write_long, write_table
from typer.testing import CliRunner

import kcs_torch as kt
from kcs_torch.cli import app
from kcs_torch.errors import FormatError, KcsError
from kcs_torch.io import (
    MOTION_READERS,
    READERS,
    detect_format,
    detect_motion_format,
    load_any,
    load_motion,
    load_people,
    load_tracks,
)
from kcs_torch.io.registry import Probe
from kcs_torch.io.tables.long import LongHeader
from kcs_torch.skeleton import SKELETONS

LEG = ("hip", "left knee", "Foot")


def same(a, b):
    assert a.skeleton == b.skeleton
    assert torch.equal(a.points, b.points) and torch.equal(a.weights, b.weights)
    assert a.fps == b.fps


# ---------------------------------------------------------------------- tracks


@pytest.mark.parametrize("what", ["confidence", "likelihood", "Score", "visibility", "prob", None])
def test_long_tables_are_read_as_wide_ones(tmp_path, what):
    columns = ("x", "y", what) if what else ("x", "y")
    long = write_long(tmp_path / "long.csv", LEG, columns)
    assert detect_format(long) == "csv"
    tracks, wide = load_tracks(long), load_tracks(write_table(tmp_path / "wide.csv", LEG, columns))
    same(tracks, wide)
    assert tracks.notes == wide.notes and tracks.fps == 25


@pytest.mark.parametrize("name", ["coco17", "mediapipe33"])
def test_names_of_a_built_in_skeleton_select_it_in_any_order(tmp_path, name):
    body = SKELETONS[name]
    names = body.joints[: body.num_observed]
    tracks = load_tracks(write_long(tmp_path / "a.csv", names[::-1]))
    assert tracks.skeleton is body
    assert np.allclose(tracks.points[:, : len(names)], person(4, len(names))[:, ::-1, :2])


@pytest.mark.parametrize("joint", ["joint", "Keypoint", "bodypart", "part", "landmark", "name", "node", "body_part"])
def test_other_spellings_of_the_table(tmp_path, joint):
    text = write_long(tmp_path / "a.csv", LEG).read_text()
    expected = load_tracks(tmp_path / "a.csv")
    for change in (
        text.replace("joint", joint),
        text.replace(",", ";"),
        text.replace(",", "\t"),
        text.replace("x,y", "X [px],Y [px]"),
        "\ufeff" + text,
        text.replace("\n", "\r\n"),
        text.replace("frame", "frame_idx", 1),
    ):
        (tmp_path / "b.csv").write_text(change, encoding="utf-8", newline="")
        assert detect_format(tmp_path / "b.csv") == "csv"
        assert torch.equal(load_tracks(tmp_path / "b.csv").points, expected.points)


def test_rows_in_any_order_and_joints_as_they_appear(tmp_path):
    header, *rows = write_long(tmp_path / "a.csv", LEG).read_text().splitlines()
    (tmp_path / "b.csv").write_text("\n".join([header, *rows[:3], "", *rows[:2:-1]]))
    same(load_tracks(tmp_path / "a.csv"), load_tracks(tmp_path / "b.csv"))
    (tmp_path / "c.csv").write_text("\n".join([header, *rows[::-1]]))
    back = load_tracks(tmp_path / "c.csv")
    assert back.skeleton.joints == LEG[::-1]
    assert torch.equal(back.points, load_tracks(tmp_path / "a.csv").points.flip(1))


def test_what_has_no_row_is_unseen(tmp_path):
    rows = ("frame,joint,x,y,prob", "4,a,10,20,.9", "4,b,30,40,.8", "5,b,31,41,", "7,a,12,22,.7", "7,b,,,.9")
    tracks = load_tracks(lines(tmp_path / "a.csv", *rows))
    expected = [[0.9, 0.8], [0, 0], [0, 0], [0.7, 0]]
    assert tracks.weights.numpy() == pytest.approx(np.array(expected))
    assert any(note.startswith("1 of 4 frames has no person (number 6)") for note in tracks.notes)
    assert "frame 0 is image 4" in tracks.notes


def test_times_place_frames(tmp_path):
    rows = [f"{t},{name},{t},{7 + at}" for t in (0, 0.04, 0.12) for at, name in enumerate("ab")]
    tracks = load_tracks(lines(tmp_path / "a.csv", "time,joint,x,y", *rows))
    assert tracks.seen.all(1).tolist() == [True, True, False, True]
    assert tracks.fps == pytest.approx(25)


def test_far_frames_need_little(tmp_path):
    rows = [f"{t},{name},1,{at}" for t in (0, 900000000) for at, name in enumerate("ab", 1)]
    assert load_tracks(lines(tmp_path / "a.csv", "frame,joint,x,y", *rows)).num_frames == 2


@pytest.mark.parametrize("column", ["person", "individual", "track", "id", "animal"])
def test_people_by_a_column(tmp_path, column):
    rows = [
        f"{t},{who},{name},{100 * at + t},{5 + y}"
        for t in range(4)
        for at, who in ((1, "b"), (7, "a"))
        for y, name in enumerate(("hip", "foot"))
        if (t, who) != (2, "a")
    ]
    path = lines(tmp_path / "a.csv", f"frame,{column},joint,x,y", *rows)
    b, a = load_people(path)
    assert b.points[:, 0, 0].tolist() == [100, 101, 102, 103]
    assert a.seen.all(1).tolist() == [True, True, False, True]
    assert load_tracks(path, person=1).points[0, 0, 0] == 700


@pytest.mark.parametrize("numbers", ["rows", "joints"])
def test_numbers_of_rows_or_joints_are_no_people(tmp_path, numbers):
    places = [(t, i) for t in range(4) for i in range(2)]
    rows = [f"{2 * t + i if numbers == 'rows' else i},{t},{'ab'[i]},{t + 1},{i}" for t, i in places]
    (tracks,) = load_people(lines(tmp_path / "a.csv", "id,frame,joint,x,y", *rows))
    assert tracks.seen.all() and tracks.skeleton.joints == ("a", "b")


HEAD = "frame,joint,x,y"


@pytest.mark.parametrize(
    ("rows", "message"),
    [
        ((HEAD,), "in at least one of 0 frames"),
        ((HEAD, "0,a,1,2"), "at least 2 joints, got 1"),
        ((f"{HEAD},x", "0,a,1,2,3"), "expected every column once, got 'x' again"),
        ((HEAD, "0,a,1,2", "0,b,1"), "row 3: expected 4 values as in the first row, got 3"),
        ((HEAD, "0,a,1,2", "", "0,b,1,?"), r"row 4: 'y': expected a number, got '\?'"),
        ((HEAD.replace(",", ";"), "0;a;1,5;2"), r"row 2: 'x': expected a number, got '1,5' \(write decimals with"),
        ((HEAD, "0,a,1,2", "0,b,1,inf"), "row 3: 'y': expected a coordinate"),
        ((HEAD, "0,a,1,2", ".5,b,1,2"), "row 3: 'frame': expected a whole number, got 0.5"),
        ((HEAD, "0,a,1,2", ",b,1,2"), "row 3: 'frame': expected a whole number, got an empty cell"),
        (("t,joint,x,y", "0,a,1,2", ",b,1,2"), "row 3: 't': expected a time, got an empty cell"),
        ((HEAD, "0,a,1,2", "0, ,1,2"), "row 3: 'joint': expected a joint's name, got an empty cell"),
        (
            (HEAD, "0,a,1,2", "3,b,1,2", "3,a,1,2", "3,b,5,6"),
            "row 5: expected every joint once in a frame, or a column 'person', got 'b' in frame 3 again",
        ),
        (("t,joint,x,y", ".5,a,1,2", ".5,a,1,2"), "row 3: .* got 'a' in time 0.5 again"),
        (
            (f"{HEAD},track", "0,a,1,2,m", "0,a,1,2,n", "1,a,1,2,n", "1,b,1,2,n", "1,b,1,2,n"),
            "row 6: expected every joint once in a frame of one 'track', got 'b' in frame 1 again",
        ),
        ((HEAD, *(f"0,j{i},1,2" for i in range(2001))), "'joint': expected 2000 joints at most, got 2001"),
        (
            (HEAD, *(f"{i * 19},j{i % 1500},1,2" for i in range(12000)), "1,j0,1,2"),
            "are more than fits: split the file",
        ),
        ((f"{HEAD},z", "0,a,1,2,3", "0,b,1,2,3"), "expected 2D tracks, got 3D motion .* leave the columns z out"),
    ],
)
def test_tables_that_are_none_are_told(tmp_path, rows, message):
    path = lines(tmp_path / "broken.csv", *rows)
    with pytest.raises(KcsError, match=message) as caught:
        load_people(path, format="csv")
    assert len(rows) == 2 or str(path) in str(caught.value)


# ---------------------------------------------------------------------- motion


def test_z_makes_it_motion(tmp_path):
    long = write_long(tmp_path / "long.csv", SKELETONS["coco17"].joints[:17], ("x", "y", "z"))
    wide = write_table(tmp_path / "wide.csv", SKELETONS["coco17"].joints[:17], ("x", "y", "z"))
    assert detect_motion_format(long) == "csv"
    motion, expected = load_motion(long), load_motion(wide, format="csv")
    same(motion, expected)
    assert motion.notes == expected.notes and motion.skeleton.name == "coco17"
    for format in (None, "csv"):
        assert isinstance(load_any(long, format=format), kt.Motion)
    with pytest.raises(FormatError, match=r"got 3D motion \(csv\)"):
        load_tracks(long)


def test_motion_with_gaps_units_and_confidences(tmp_path):
    rows = ("0,m1,1,2,3,.9", "0,'=m2,4,5,6,.9", "1,m1,1,2,3,.1", "3,m1,1,2,3,.9", "3,'=m2,4,5,6,.9")
    motion = load_motion(lines(tmp_path / "a.csv", "frame,marker,x [mm],y [mm],z [mm],score", *rows))
    assert motion.seen.tolist() == [[True, True], [True, False], [False, False], [True, True]]
    assert (motion.units, motion.skeleton.joints) == ("mm", ("m1", "=m2"))
    assert "columns of joints that are left out: score" in motion.notes


@pytest.mark.parametrize(
    ("rows", "message"),
    [
        (("frame,joint,x,y,z",), "expected a row a frame"),
        (
            ("frame,individual,joint,x,y,z", *(f"{t},{who},{j},1,2,3" for t in (0, 1) for who in "mn" for j in "ab")),
            "the motion of one body, got several: column 'individual' has 2: write a table for each",
        ),
    ],
)
def test_motion_that_is_none_is_told(tmp_path, rows, message):
    path = lines(tmp_path / "broken.csv", *rows)
    with pytest.raises(FormatError, match=message) as caught:
        load_motion(path)
    assert str(path) in str(caught.value)


def test_the_command_line_takes_it(tmp_path):
    path = write_long(tmp_path / "a.csv", SKELETONS["mediapipe33"].joints[:33], ("x", "y", "z"))
    for words in (["angles", path], ["score", path, path], ["convert", path, tmp_path / "b.npz"]):
        done = CliRunner().invoke(app, [str(word) for word in words])
        assert done.exit_code == 0, done.output


# ---------------------------------------------------------------------- others' tables


def test_tables_of_others_stay_theirs(tmp_path):
    pytest.importorskip("h5py")
    for name, writers in SAMPLES.items():
        for i, write in enumerate(writers):
            (folder := tmp_path / f"{name}{i}").mkdir()
            probe = Probe(write(folder))
            assert [n for n, reader in READERS.items() if reader.recognises(probe)] == [name]
            line = probe.head.split(b"\n", 1)[0].decode("utf-8", "replace")
            assert (LongHeader.of(line) is not None) == (probe.path.name == "long.csv")


@pytest.mark.parametrize(
    "header", ["frame,joint,x,y,a_x,a_y,b_x,b_y", "track,frame_idx,instance.score,node,x,y", "joint,x,y", "frame,x,y"]
)
def test_what_is_no_long_table(tmp_path, header):
    probe = Probe(lines(tmp_path / "a.csv", header, ",".join("3" for _ in header.split(","))))
    found = {name for name, reader in READERS.items() if reader.recognises(probe)}
    assert found == {"csv"} if "a_x" in header else found <= {"sleap"}
    assert not any(reader.recognises(probe) for reader in MOTION_READERS.values())
    if "a_x" in header:
        assert load_tracks(probe.path).skeleton.joints == ("a", "b")
