"""Angles as tables, and ``kcs-torch angles``."""

import csv
import functools
import json
import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from command_line import run as run_any
from numerics import normal
from samples import walk_result, walking_motion
from torch.testing import assert_close

import kcs_torch as kt
from kcs_torch.errors import OptionError, OutputError
from kcs_torch.types.angles import angles_of

run = functools.partial(run_any, "angles")


def table_of(path):
    with path.open(newline="", encoding="utf-8") as file:
        return list(csv.reader(file))


def test_a_table_holds_angles_and_deviations(tmp_path):
    found = walk_result(5).angles(["left_knee", "right_knee"])
    head, *rows = table_of(found.save(tmp_path / "new" / "angles.csv"))
    assert head[:4] == ["frame", "time [s]", "left_knee [deg]", "left_knee_deviation [deg]"]
    assert head[4:] == ["right_knee [deg]", "right_knee_deviation [deg]"]
    numbers = np.array(rows, float)
    assert numbers[:, 1] == pytest.approx([0, 0.04, 0.08, 0.12, 0.16])
    assert numbers[:, 2] == pytest.approx(found.degrees["left_knee"].numpy(), rel=1e-8)
    assert numbers[:, 5] == pytest.approx(found.deviation["right_knee"].numpy(), rel=1e-8)
    assert [p.name for p in (tmp_path / "new").iterdir()] == ["angles.csv"]


def test_what_is_unknown_is_empty(tmp_path):
    motion = replace(walking_motion(3), fps=None)
    weights = motion.weights.clone()
    weights[1, motion.skeleton.index("left_knee")] = 0
    head, *rows = table_of(replace(motion, weights=weights).angles("left_knee").save(tmp_path / "a.csv"))
    assert head == ["frame", "time [s]", "left_knee [deg]"]
    assert rows[1] == ["1", "", ""] and rows[0][1] == "" and float(rows[0][2]) > 0


def test_names_are_no_formulas(tmp_path):
    body = kt.Skeleton.from_names(["=a", "b", "c"], [("=a", "b"), ("b", "c")])
    motion = kt.Motion.from_arrays(normal(2, 3, 3), skeleton=body)
    assert table_of(motion.angles([("=a", "b", "c")]).save(tmp_path / "a.csv"))[0][2] == "'=a-b-c [deg]"


def test_tables_are_csv_and_nothing_is_left_half_written(tmp_path, monkeypatch):
    found = walk_result(3).angles()
    with pytest.raises(OutputError, match=r"a\.txt: expected a file with the suffix \.csv for angles, got \.txt"):
        found.save(tmp_path / "a.txt")
    with pytest.raises(OutputError, match="got none"):
        kt.io.save_angles(found, tmp_path / "angles")
    (tmp_path / "old.csv").write_text("mine")

    def full(header, rows, fps, path):
        path.write_text("half")
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("kcs_torch.io.angles.write_table", full)
    with pytest.raises(OutputError, match=r"old\.csv: cannot be written: No space left"):
        found.save(tmp_path / "old.csv")
    assert (tmp_path / "old.csv").read_text() == "mine" and len(list(tmp_path.iterdir())) == 1


@pytest.fixture
def saved(tmp_path):
    kt.save(walk_result(8), tmp_path / "r.npz")
    kt.save(walking_motion(8), tmp_path / "m.trc")
    kt.save(walk_result(8).tracks, tmp_path / "t.npz")
    return tmp_path


def test_command_tells_and_writes(saved):
    done = run(saved / "r.npz", "-o", saved / "a.csv")
    result = walk_result(8).angles()
    lines = done.stdout.splitlines()
    assert lines[0] == f"{saved / 'r.npz'}: 8 frames at 25 a second; 0 is straight"
    assert lines[1].split() == ["degrees", "least", "mean", "most", "deviation"]
    knee = result.degrees["left_knee"]
    told = [float(w) for w in next(line for line in lines if line.startswith("left_knee")).split()[1:]]
    seen = result.seen["left_knee"]
    knee = knee[seen]
    expected = [knee.min(), knee.mean(), knee.max(), result.deviation["left_knee"][seen].mean()]
    assert told == pytest.approx([float(v) for v in expected], abs=0.06)
    assert lines[-1] == f"wrote {saved / 'a.csv'}"
    assert len(table_of(saved / "a.csv")) == 9 and len(table_of(saved / "a.csv")[0]) == 10


def test_command_leaves_out_frames_that_do_not_show_the_joints(saved):
    """A result has a place for each; the table holds all of them."""
    result = walk_result(8)
    weights = torch.ones_like(result.tracks.weights)
    weights[2:5, result.skeleton.index("left_ankle")] = 0
    points = result.points.clone()
    points[3, result.skeleton.index("left_ankle")] += 1e4
    kt.save(replace(result, points=points, tracks=replace(result.tracks, weights=weights)), saved / "r.npz")
    done = run(saved / "r.npz", "--joint", "left_knee", "--joint", "right_knee", "-o", saved / "a.csv")
    found = kt.io.load_reconstruction(saved / "r.npz").angles()
    assert found.seen["left_knee"].tolist() == [True] * 2 + [False] * 3 + [True] * 3 and found.seen["right_knee"].all()
    shown = found.degrees["left_knee"][found.seen["left_knee"]]
    least, mean, most, _ = (float(word) for word in done.stdout.splitlines()[2].split()[1:])
    assert (least, mean, most) == pytest.approx((float(shown.min()), float(shown.mean()), float(shown.max())), abs=0.06)
    assert "note: left out, as a joint is unseen: 3 frames of left_knee\n" in done.stdout
    assert all(row[2] for row in table_of(saved / "a.csv"))
    weights[:, result.skeleton.index("left_ankle")] = 0
    kt.save(replace(result, tracks=replace(result.tracks, weights=weights)), saved / "r.npz")
    knee = json.loads(run(saved / "r.npz", "--joint", "left_knee", "--json").stdout)["angles"]["left_knee"]
    assert knee["frames"] == 0 and knee["least"] is None and knee["mean"] is None
    row = run(saved / "r.npz", "--joint", "left_knee").stdout.splitlines()[2]
    assert row.split() == ["left_knee", "unseen", "unknown"]


def test_command_takes_motion_and_joints(saved):
    words = ["--joint", "LKnee", "--joint", "neck, left_hip, left_knee", "--fps", 50]
    done = run(saved / "m.trc", *words, "-o", saved / "a.csv")
    assert "unknown" in done.stdout and "neck-left_hip-left_knee" in done.stdout
    head, _, second, *_ = table_of(saved / "a.csv")
    assert head == ["frame", "time [s]", "left_knee [deg]", "neck-left_hip-left_knee [deg]"]
    assert second[1] == "0.02"


def test_command_answers_in_json(saved):
    data = json.loads(run(saved / "r.npz", "--joint", "left_knee", "--mirror", "--json", "-o", saved / "a.csv").stdout)
    knee = data["angles"]["left_knee"]
    assert knee["most"] < 0 and knee["signed"] is True and data["fps"] == 25
    assert (saved / "a.csv").exists()
    assert json.loads(run(saved / "m.trc", "--json").stdout)["angles"]["left_elbow"]["deviation"] is None


@pytest.mark.parametrize(
    ("words", "match"),
    [
        (["t.npz"], "expected a result or 3D motion, got 2D tracks: lift them first"),
        (["m.trc", "--mirror"], "--mirror: expected a result"),
        (["r.npz", "--joint", "a,b"], "three names (parent, joint, child)"),
        (["r.npz", "--joint", "nose"], "'nose' is no hinge"),
        (["r.npz", "--joint", "knie"], "unknown joint"),
        (["r.npz", "-o", "a.npz"], "expected a file with the suffix .csv for angles"),
        (["r.npz", "-o", f"{'a' * 300}.csv"], "cannot be written: File name too long"),
        (["absent.npz"], "absent.npz"),
    ],
)
def test_command_answers_mistakes_with_a_line(saved, monkeypatch, words, match):
    monkeypatch.chdir(saved)
    before = sorted(p.name for p in saved.iterdir())
    done = run(*words, code=2)
    assert done.stderr.startswith("error: ") and done.stderr.count("\n") == 1 and match in done.stderr
    assert sorted(p.name for p in saved.iterdir()) == before


def test_command_does_not_replace_what_it_reads(saved, monkeypatch):
    monkeypatch.chdir(saved)
    (saved / "m.csv").write_bytes((saved / "m.trc").read_bytes())
    assert "which it would replace" in run("m.csv", "-o", "m.csv", code=2).stderr
    assert "which it would replace" in run("m.csv", "-o", "missing/../m.csv", code=2).stderr


def test_a_knee_keeps_its_sign_where_the_other_hip_is_unseen():
    clip = walking_motion(20)
    points, body = clip.points.clone(), clip.skeleton
    hip, knee, ankle = (points[:, body.index(f"left_{name}")] for name in ("hip", "knee", "ankle"))
    thigh = torch.nn.functional.normalize(knee - hip, dim=-1)
    shank = ankle - knee
    points[:, body.index("left_ankle")] = knee + 2 * (shank * thigh).sum(-1, keepdim=True) * thigh - shank
    seen = torch.ones(20, body.num_joints, dtype=torch.bool)
    whole = angles_of(points, seen, body, ["left_knee"]).degrees["left_knee"]
    assert whole[5:8].abs().min() > 2
    seen[5:8, body.index("right_hip")] = False
    torn = torch.where(seen[..., None], points, math.nan)
    assert_close(angles_of(torn, seen, body, ["left_knee"]).degrees["left_knee"], whole)
    seen[:, body.index("right_hip")] = False
    told = angles_of(torn, seen, body, ["left_knee"])
    assert not told.signed
    assert_close(told.degrees["left_knee"], whole.abs())


def test_what_are_no_joints_is_told():
    with pytest.raises(OptionError, match="expected names of hinges or triples of names, got 3"):
        walk_result().angles(3)
