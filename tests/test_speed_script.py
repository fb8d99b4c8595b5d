"""scripts/speed.py, and that the naive twins it measures do the same as the methods."""

import csv
import subprocess
import sys

import naive
import pytest
import torch
from numerics import BODY, normal
from torch.testing import assert_close

import kcs_torch as kt
from kcs_torch.data import walking_person
from kcs_torch.functional import bone_lengths
from kcs_torch.nn import steps


@pytest.mark.parametrize("shape", [(40, 9), (9, 40), (3, 20, 6), (2, 2, 5, 5)])
def test_shrinkage_twin(shape):
    matrix = normal(*shape)
    level = normal(*shape[:-2]).abs()
    assert_close(kt.functional.svt(matrix, level), naive.svt(matrix, level))


@pytest.mark.parametrize("damping", [0.0, 0.5])
def test_bone_step_twins(damping):
    points = normal(2, 5, 7, 3)
    bones = BODY.bone_index()
    lengths = bone_lengths(points, bones) * (1 + 0.2 * normal(2, 5, 6, seed=1)).abs()
    options = {"stiffness": normal(6, seed=2).abs(), "num_steps": 1, "damping": damping}
    got = kt.solvers.fit_bones(points, lengths, bones, **options)
    for twin in (naive.fit_bones, naive.fit_bones_frame_by_frame):
        assert_close(got, twin(points, lengths, bones, **options), rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize("known", [False, True], ids=["cameras found", "cameras given"])
@pytest.mark.parametrize("method", [kt.KCS(rounds=2), kt.SfAM(num_steps=12, window=20, overlap=5)], ids=["kcs", "sfam"])
def test_method_twins(method, known):
    clip = walking_person(36, turn=120, noise=3, missing=0.05, generator=torch.Generator().manual_seed(0))
    cameras = clip.cameras if known else None
    with pytest.warns() if method.name == "sfam" else torch.no_grad():  # twelve steps do not settle
        ours = method(clip.tracks, cameras).points
        for frame_by_frame in (False, True):
            with naive.naive(frame_by_frame=frame_by_frame):
                twin = method(clip.tracks, cameras).points
            assert not torch.equal(ours, twin)  # else it was not the twin that ran
            assert (ours - twin).abs().max() < 1e-2  # of a body of 1750 mm


def test_after_the_context_the_fast_parts_are_back():
    before = steps.svt, steps.fit_bones
    with pytest.raises(KeyError), naive.naive():
        assert (steps.svt, steps.fit_bones) == (naive.svt, naive.fit_bones)
        raise KeyError
    assert (steps.svt, steps.fit_bones) == before


@pytest.mark.parametrize("part", ["memory", "methods", "kernels", "growth", "joints", "batch", "scale", "gpu"])
def test_script(import_script, tmp_path, capsys, part):
    script = import_script("speed")
    table = tmp_path / "made" / "speed.csv"
    sizes = ["--frames", "26", "--growth", "12", "--memory", "12", "--joints", "5", "--runs", "1"]
    sizes += [
        "--which",
        "kcs",
        "sfam",
        "--clips",
        "2",
        "--short",
        "12",
        "--scale",
        "12",
        "--device",
        "cpu",
        "--batches",
        "2",
    ]
    script.main(["--parts", part, *sizes, "--csv", str(table)])
    shown = capsys.readouterr().out
    with table.open(newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) >= 2 and {row["part"] for row in rows} == {part}
    for row in rows:
        what = row.get("peak of") or row.get("ms a frame") or row.get("ms") or row.get("ms a clip") or row["method"]
        assert what in shown  # the table on the terminal has what the file has
        least = ("median", "import MB", "together", "clips a second")
        assert float(next(row[name] for name in least if row.get(name))) > 0


def test_clips_in_several_processes(import_script, capsys):
    script = import_script("speed")
    script.main(
        ["--parts", "batch", "--which", "kcs", "--clips", "3", "--short", "12", "--runs", "1", "--workers", "2"]
    )
    names, row = (line.split("  ") for line in capsys.readouterr().out.splitlines()[-2:])
    assert "ratio, 2 workers" in (name.strip() for name in names) and float(row[-1]) > 0


@pytest.mark.parametrize(
    ("name", "words", "told"),
    [
        ("speed", ["--runs", "0"], "--runs: expected at least 1, got 0"),
        ("speed", ["--workers", "0"], "--workers: expected at least 1, got 0"),
        ("speed", ["--threads", "0"], "--threads: expected at least 1, got 0"),
        ("speed", ["--growth", "100", "0"], "--growth: expected at least 1, got 0"),
        ("counts", ["--frames", "0"], "--frames: expected at least 1, got 0"),
        ("layers", ["--skeleton", "foo"], "argument --skeleton: invalid choice: 'foo'"),
        ("layers", ["--repeats", "0"], "--repeats: expected at least 1, got 0"),
        ("live", ["--frames", "0"], "--frames: expected at least 1, got 0"),
        ("live", ["--skeleton", "nope"], "argument --skeleton: invalid choice: 'nope'"),
        ("unrolled_memory", ["--solvers", "zz"], "argument --solvers: invalid choice: 'zz'"),
        ("unrolled_memory", ["--frames", "0"], "--frames: expected at least 1, got 0"),
    ],
)
def test_wrong_options_are_told(import_script, monkeypatch, capsys, name, words, told):
    monkeypatch.setattr(sys, "argv", [name, *words])
    with pytest.raises(SystemExit):
        import_script(name).main()
    assert told in capsys.readouterr().err


def test_parts_that_are_done_are_written(import_script, tmp_path, monkeypatch):
    """A later one that fails takes nothing along."""
    script, table = import_script("speed"), tmp_path / "speed.csv"
    monkeypatch.setattr(script, "compare_kernels", lambda *_: iter([{"ms": "svt", "median": 1.0}]))
    monkeypatch.setattr(script, "grow_joints", lambda *_: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        script.main(["--parts", "kernels", "joints", "--csv", str(table)])
    assert table.read_text().split() == ["part,ms,median", "kernels,svt,1.0"]


@pytest.mark.skipif(torch.cuda.is_available(), reason="a GPU is here")
def test_script_says_that_there_is_no_gpu(import_script):
    script = import_script("speed")
    with pytest.raises(SystemExit, match="expected a GPU"):
        script.main(["--parts", "gpu"])


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (["live.py", "--inputs", "nowhere", "--truth", "nowhere"], "--inputs nowhere: expected a folder with .npz"),
        (["formats.py", "nowhere"], "nowhere: expected a folder, found none"),
    ],
)
def test_folders_that_are_not_there_are_told(root, tmp_path, words, told):
    command = [sys.executable, str(root / "scripts" / words[0]), *words[1:]]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 2 and told in done.stderr and "Traceback" not in done.stderr


@pytest.mark.parametrize("inference", [False, True])
def test_counts_of_one_product_and_one_sum(import_script, inference):
    """By hand; in inference mode, in which methods run, too."""
    script = import_script("counts")
    with torch.inference_mode(inference):
        left, right = normal(4, 3, 5), normal(4, 5, 2)
        with script.Counter() as made:
            (left @ right).mT.add(1)
    assert (made.calls, made.matrix, made.other) == (2, 2 * 4 * 3 * 5 * 2, 24)
    assert made.bytes == 8 * (60 + 40 + 24) + 8 * (24 + 24)


def test_counts_of_operations(import_script, tmp_path, capsys):
    """A row for each method and camera."""
    script = import_script("counts")
    table = tmp_path / "made" / "counts.csv"
    script.main(["--methods", "kcs", "sfam", "--frames", "12", "--csv", str(table)])
    with table.open(newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert [row["method"] for row in rows] == ["kcs", "kcs", "sfam", "sfam"]
    assert all(float(row["bound"]) > 0 for row in rows)
    assert "GFLOP/s" in capsys.readouterr().out
