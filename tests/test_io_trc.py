"""TRC files: real ones, our own, and damaged ones."""

import random
from dataclasses import replace

import numpy as np
import pytest
import torch
from samples import walking_motion as walk

import kcs_torch as kt
from kcs_torch.errors import FormatError
from kcs_torch.io import load_motion, save

HEAD = """PathFileType\t4\t(X/Y/Z)\tx.trc
DataRate\tCameraRate\tNumFrames\tNumMarkers\tUnits\tOrigDataRate\tOrigDataStartFrame\tOrigNumFrames
60\t60\t2\t2\tmm\t60\t1\t2
Frame#\tTime\tHip\t\t\tKnee\t\t
\t\tX1\tY1\tZ1\tX2\tY2\tZ2
"""
ROWS = "1\t0.0\t1\t2\t3\t4\t5\t6\n2\t0.016\t1\t2\t3\t\t\t\n"


def write(folder, text):
    path = folder / "x.trc"
    path.write_text(text)
    return path


@pytest.mark.parametrize(
    "name, unit", [("meters", "m"), ("Millimetre", "mm"), ("CM", "cm"), ("feet", "ft"), ("au", "au")]
)
def test_units_may_be_written_out(tmp_path, name, unit):
    assert load_motion(write(tmp_path, HEAD.replace("mm", name) + ROWS)).units == unit


def test_cells_by_hand(tmp_path):
    motion = load_motion(write(tmp_path, HEAD + "\n" + ROWS))
    assert motion.points.tolist() == [[[1, 2, 3], [4, 5, 6]], [[1, 2, 3], [0, 0, 0]]]
    assert motion.seen.tolist() == [[True, True], [True, False]]
    assert (motion.fps, motion.units, motion.skeleton.joints) == (60, "mm", ("Hip", "Knee"))
    assert load_motion(write(tmp_path, HEAD + ROWS.replace("\t\t\t\n", "\n"))).seen.tolist()[1] == [True, False]
    assert torch.equal(
        load_motion(write(tmp_path, HEAD.replace("\t", ",") + ROWS.replace("\t", ","))).points, motion.points
    )
    nan = load_motion(write(tmp_path, HEAD + ROWS.replace("\t4\t5\t6", "\tNaN\tNaN\tNaN")))
    assert nan.seen.tolist() == [[True, False], [True, False]]
    assert load_motion(tmp_path / "x.trc", up="z").points[0, 0].tolist() == [1, 3, -2]


def test_times_of_the_rows(tmp_path):
    """The header is believed, but told; where it has no rate, times tell it."""
    rows = "".join(f"{i + 1}\t{i / 30:.3f}\t1\t2\t3\t4\t5\t6\n" for i in range(9))
    head = HEAD.replace("\t2\t2\tmm", "\t9\t2\tmm")
    told = "the header tells 60 frames a second, the rows' times 29.963: the header is believed"
    motion = load_motion(write(tmp_path, head + rows))
    assert motion.fps == 60 and told in motion.notes
    motion = load_motion(write(tmp_path, head.replace("60\t60", "30\t30") + rows))
    assert motion.fps == 30 and not any("header" in note for note in motion.notes)
    assert load_motion(write(tmp_path, head.replace("60\t60", "0\t0") + rows)).fps == 29.963
    assert load_motion(write(tmp_path, head.replace("60\t60", "0\t0") + rows.replace("0.033", "?"))).fps is None
    assert load_motion(write(tmp_path, HEAD + "1\n" + ROWS[ROWS.index("2\t0.016") :])).fps == 60  # a row without a time


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (HEAD, "a line a frame below the names"),
        (HEAD + "1\t0\t1\t2\tthree\t4\t5\t6\n", "line 6: expected numbers, got 'three'"),
        (HEAD + ROWS + "3\t0\t1\t2\tinf\t4\t5\t6\n", "line 8: expected numbers, got 'inf'"),
        (HEAD + "1\t0\t1\t2\t3\t4\t5\t6\t7\n", "line 6: expected 6 numbers of 2 markers, got 7"),
        (HEAD.replace("Frame#", "Bild"), "a line that begins with Frame#"),
        (HEAD.replace("Hip\t\t\tKnee", ""), "line 4: expected names of markers"),
        (HEAD.replace("60\t60", "fast\t60") + ROWS, "line 3: DataRate: expected numbers, got 'fast'"),
        ("PathFileType", "a line that begins with Frame#"),
    ],
)
def test_damage_is_named(tmp_path, text, message):
    with pytest.raises(FormatError, match=message):
        load_motion(write(tmp_path, text))


def test_the_header_is_not_believed(tmp_path):
    motion = load_motion(write(tmp_path, HEAD.replace("60\t2\t2", "60\t999999999\t2") + ROWS))
    assert motion.num_frames == 2
    assert "the header tells 999999999 frames, the file has 2" in motion.notes


def test_real_files(shared):
    folder = shared / "data" / "raw_formats" / "trc"
    raw = load_motion(folder / "S00_P00_T01_BalancingTrial_0-100.trc")
    assert (raw.num_frames, raw.skeleton.num_observed, raw.fps, raw.units) == (100, 21, 60, "m")
    assert raw.skeleton.joints[21:] == ("pelvis",) and raw.skeleton.is_tree  # by the names
    head, ankle = raw.skeleton.index("Head"), raw.skeleton.index("RAnkle")
    assert float((raw.points[:, head, 1] - raw.points[:, ankle, 1]).mean()) > 1.2
    table = np.loadtxt(folder / "S00_P00_T01_BalancingTrial_0-100.trc", skiprows=5, delimiter="\t", usecols=range(65))
    assert np.array_equal(raw.points[:, :21].numpy().reshape(100, -1), table[:, 2:])
    markers = load_motion(folder / "pyomeca_markers.trc")
    assert (markers.num_joints, markers.units) == (51, "mm")
    assert "the header tells 652 frames, the file has 93" in markers.notes


def test_what_is_written_is_read_back(tmp_path):
    motion = walk()
    weights = motion.weights.clone()
    weights[3, 4] = 0
    motion = replace(motion, weights=weights, points=motion.points * weights[..., None])
    back = load_motion(save(motion, tmp_path / "walk one.trc"))
    assert torch.allclose(back.points, motion.points, atol=1e-8)
    assert torch.equal(back.seen, motion.seen)
    assert back.skeleton == motion.skeleton  # found by the names
    lines = (tmp_path / "walk one.trc").read_text().split("\n")
    assert lines[0] == "PathFileType\t4\t(X/Y/Z)\twalk_one.trc"
    assert lines[2].split("\t") == ["25", "25", "12", "19", "m", "25", "1", "12"]
    assert {len(line.split("\t")) for line in lines[6:-1]} == {2 + 3 * 19}
    upright = load_motion(save(motion, tmp_path / "z.trc", up="z"), up="z")
    assert torch.allclose(upright.points, motion.points, atol=1e-8)


def test_names_with_blanks_are_told(tmp_path):
    motion = kt.Motion.from_arrays(torch.randn(3, 3, 3), joint_names=["a b", "a_b", "c"], fps=30, units="m", up="y")
    back = load_motion(save(motion, tmp_path / "w.trc", notes=(notes := [])))
    assert back.skeleton.joints == ("a_b", "a_b_2", "c")
    assert notes == ["joints are named otherwise in the file: 'a b' is 'a_b', 'a_b' is 'a_b_2'"]
    assert "\ta_b_2\t" in (tmp_path / "w.trc").read_text()


def test_mutated_files_end_in_our_errors(tmp_path):
    text = save(walk(4), tmp_path / "w.trc").read_text()
    read = 0
    for seed in range(150):
        pick = random.Random(seed)
        letters = list(text)
        for _ in range(pick.choice([1, 2, 8])):
            at = pick.randrange(len(letters))
            letters[at : at + pick.choice([0, 1, 30])] = pick.choice(["", "\t", "\n", "x", "nan", "1e999", "-", "\0"])
        (tmp_path / "m.trc").write_text("".join(letters))
        try:
            assert load_motion(tmp_path / "m.trc").points.isfinite().all()
            read += 1
        except kt.KcsError as error:
            assert "m.trc" in str(error)
    assert 0 < read < 150


def rows(path, order, first=1, cells=None, rate=10):
    """A file of ten frames of two markers, its rows in another order, or some of them."""
    head = "PathFileType\t4\t(X/Y/Z)\ta.trc\nDataRate\tCameraRate\tNumFrames\tNumMarkers\tUnits\n"
    head += f"{rate}\t10\t10\t2\tmm\nFrame#\tTime\tA\t\t\tB\n\t\tX1\tY1\tZ1\tX2\tY2\tZ2\n\n"
    lines = [[first + k, k / 10, k, 0, 0, k, 1, 1][:cells] for k in order]
    path.write_text(head + "".join("\t".join(map(str, line)) + "\n" for line in lines), encoding="utf-8")
    return load_motion(path)


def test_rows_are_frames_by_their_numbers(tmp_path):
    path = tmp_path / "a.trc"
    whole = rows(path, range(10))
    shuffled = rows(path, [*range(5, 10), *range(5)])
    assert torch.equal(shuffled.points, whole.points)
    assert any("the order of their numbers" in note for note in shuffled.notes)
    gapped = rows(path, [0, 1, 2, 6, 7, 8, 9])
    assert gapped.num_frames == 10 and gapped.fps == 10 and not gapped.seen[3:6].any()
    assert torch.equal(gapped.points[6:], whole.points[6:])
    assert any("frame 0 is the file's frame 21" in note for note in rows(path, range(10), first=21).notes)
    odd = rows(path, range(10)).num_frames
    path.write_text(path.read_text(encoding="utf-8").replace("\n1\t", "\n²\t"), encoding="utf-8")
    assert load_motion(path).num_frames == odd
    with pytest.raises(FormatError, match="expected every frame once, got frame 3 again"):
        rows(path, [0, 1, 2, 2, 3])


@pytest.mark.parametrize(("rate", "fps", "told"), [(10, 5, False), (5, 5, False), (30, 15, True)])
def test_the_rate_of_every_second_row(tmp_path, rate, fps, told):
    """The header's may be that of the numbers, or of the rows: which one, the times tell."""
    motion = rows(tmp_path / "a.trc", range(0, 10, 2), rate=rate)
    assert (motion.fps, motion.num_frames) == (fps, 5)
    assert any("the header is believed" in note for note in motion.notes) == told


def test_rows_that_end_early_are_told(tmp_path):
    motion = rows(tmp_path / "a.trc", range(10), cells=5)
    assert any("10 rows end before the last marker" in note for note in motion.notes)
    assert not any("end before" in note for note in rows(tmp_path / "b.trc", range(10)).notes)
