"""Writing results: what is in the files, and that they appear whole or not at all."""

import csv
import json
import os
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from needs import SUFFIXES
from samples import walk_result

import kcs_torch as kt
from kcs_torch.errors import OutputError
from kcs_torch.io import WRITERS, load_reconstruction, registry, save, write
from kcs_torch.io.atomic import atomic_path
from kcs_torch.io.formats.text import write_table


@pytest.fixture(scope="module")
def result():
    return walk_result()


def everything_below(folder):
    return sorted(str(p.relative_to(folder)) for p in folder.rglob("*"))


# ---------------------------------------------------------------------- content


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_what_cannot_be_written_is_told(tmp_path, result, suffix):
    motion = kt.Motion.of(result)
    for empty in (motion.frames(9, 9), result.tracks.frames(9, 9)):
        with pytest.raises(OutputError):
            save(empty, tmp_path / f"out{suffix}")
    for other, name in (([result, result], "list"), (result.points, "Tensor"), (None, "NoneType")):
        with pytest.raises(OutputError, match=f"expected a result, motion or tracks, got {name}: .*save_people"):
            save(other, tmp_path / f"out{suffix}")
    assert everything_below(tmp_path) == []


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_every_suffix_is_written(tmp_path, result, suffix):
    path = save(result, tmp_path / f"out{suffix}")
    assert path == tmp_path / f"out{suffix}"
    assert path.stat().st_size > 1000
    assert everything_below(tmp_path) == [path.name]
    assert kt.save is save


def test_csv_has_one_row_a_frame(tmp_path, result):
    with save(result, tmp_path / "w.csv").open(newline="") as file:
        header, *rows = csv.reader(file)
    joints = result.skeleton.joints
    assert header[:5] == ["frame", "time [s]", "nose_x [m]", "nose_y [m]", "nose_z [m]"]
    assert header[2::3] == [f"{j}_x [m]" for j in joints]
    table = np.array(rows, float)
    assert np.array_equal(table[:, 0], np.arange(12))
    assert np.allclose(table[:, 1], np.arange(12) / 25)
    assert np.allclose(table[:, 2:].reshape(12, -1, 3), result.points.numpy(), rtol=1e-8)


def test_csv_without_a_rate_has_no_times(tmp_path, result):
    still = replace(result, tracks=replace(result.tracks, fps=None))
    with save(still, tmp_path / "w.csv").open(newline="") as file:
        assert {row["time [s]"] for row in csv.DictReader(file)} == {""}


def test_csv_times_of_long_clips_differ(tmp_path):
    """After a quarter of an hour at 120 frames a second, six digits tell two frames at the same time."""
    write_table(["a"], np.zeros((130_000, 1)), 120.0, tmp_path / "w.csv")
    with (tmp_path / "w.csv").open(newline="") as file:
        times = [float(row["time [s]"]) for row in csv.DictReader(file)]
    assert np.allclose(np.diff(times), 1 / 120, rtol=1e-3, atol=0)


def test_csv_names_are_no_formulas(tmp_path, result):
    body = replace(result.skeleton, joints=("=1+1", "a,b", *result.skeleton.joints[2:]))
    path = save(replace(result, tracks=replace(result.tracks, skeleton=body)), tmp_path / "w.csv")
    with path.open(newline="") as file:
        header = next(csv.reader(file))
    assert header[2] == "'=1+1_x [m]"
    assert header[5] == "a,b_x [m]"


def test_json_holds_the_motion(tmp_path, result):
    data = json.loads(save(result, tmp_path / "w.json").read_text(), parse_constant=pytest.fail)
    assert np.allclose(data["points3d"], result.points.numpy(), rtol=1e-8)
    assert np.allclose(data["cameras"], result.cameras.numpy(), rtol=1e-8)
    assert data["joint_names"] == list(result.skeleton.joints)
    assert [tuple(e) for e in data["edges"]] == list(result.skeleton.bones)
    assert (data["units"], data["fps"], data["method"]) == ("m", 25.0, "SfAM")
    assert data["diagnostics"]["bone_variation"] is None  # NaN, which JSON has not
    assert data["diagnostics"]["viewpoint_turn"] == 12.5
    assert kt.Skeleton.from_dict(data["skeleton"]) == result.skeleton


def test_json_says_null_for_what_is_not_finite(tmp_path, result):
    lost = replace(result, points=torch.where(torch.arange(3) == 2, torch.nan, result.points))
    data = json.loads(save(lost, tmp_path / "w.json").read_text(), parse_constant=pytest.fail)
    assert data["points3d"][0][0][2] is None
    assert data["points3d"][0][0][1] == pytest.approx(float(result.points[0, 0, 1]))


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_odd_text_is_written(tmp_path, result, suffix):
    names = ("naïve Ω 鼻", "$x_{", "lone \ud800", "<script>", *result.skeleton.joints[4:])
    tracks = replace(result.tracks, skeleton=replace(result.skeleton, joints=names), source="$\\bad{ <b> 鼻 \ud800.npz")
    odd = replace(result, tracks=tracks, method="$a_{")
    path = save(odd, tmp_path / f"odd{suffix}")
    assert path.stat().st_size > 1000
    if suffix == ".npz":
        assert load_reconstruction(path).skeleton.joints == odd.skeleton.joints


def test_results_that_carry_gradients_are_written(tmp_path, result):
    learnt = replace(result, points=result.points.clone().requires_grad_())
    for suffix in SUFFIXES:
        save(learnt, tmp_path / f"w{suffix}")
    assert torch.equal(load_reconstruction(tmp_path / "w.npz").points, result.points)


# ---------------------------------------------------------------------- where to


def test_parents_are_created_and_old_files_replaced(tmp_path, result):
    path = tmp_path / "new" / "deep" / "W.NPZ"
    save(replace(result, method="old"), path)
    save(result, str(path))
    assert load_reconstruction(path).method == "SfAM"
    assert everything_below(tmp_path) == ["new", "new/deep", "new/deep/W.NPZ"]


def test_files_have_the_permissions_of_the_umask(tmp_path, result):
    (tmp_path / "plain").write_text("")
    path = save(result, tmp_path / "w.csv")
    assert path.stat().st_mode == (tmp_path / "plain").stat().st_mode


def test_a_link_is_followed(tmp_path, result):
    (tmp_path / "target.csv").write_text("old")
    (tmp_path / "link.csv").symlink_to(tmp_path / "target.csv")
    save(result, tmp_path / "link.csv")
    assert (tmp_path / "link.csv").is_symlink()
    assert (tmp_path / "target.csv").read_text().startswith("frame")


@pytest.mark.parametrize("path", [None, 3, b"w.npz"])
def test_what_is_no_path_is_told(result, path):
    for write_to in (result.save, lambda path: save(result, path)):
        with pytest.raises(OutputError, match=r"^path: expected the name of a file, such as 'motion\.npz', got"):
            write_to(path)


def test_an_error_of_a_writer_names_the_file_that_was_asked_for(tmp_path, result, monkeypatch):
    monkeypatch.setitem(sys.modules, "ezc3d", None)
    with pytest.raises(OutputError, match=rf"^{tmp_path}/a\.c3d: needs the package ezc3d"):
        save(result, tmp_path / "a.c3d")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("name", ["w", "w.bvx", "w.npz.gz", ".npz"])
def test_an_unknown_suffix_is_answered_with_the_known_ones(tmp_path, result, name):
    with pytest.raises(OutputError, match="suffixes " + ", ".join(WRITERS)):
        save(result, tmp_path / name)
    assert everything_below(tmp_path) == []
    with pytest.raises(OutputError, match=r"got '\.fbx'; Blender and others import \.bvh"):
        save(result, tmp_path / "w.fbx")


def test_paths_that_cannot_be_written(tmp_path, result):
    (tmp_path / "file").write_text("kept")
    (tmp_path / "folder.npz").mkdir()
    before = everything_below(tmp_path)
    for path, message in [
        (tmp_path / "file" / "w.npz", "cannot be written"),
        (tmp_path / "folder.npz", "got a folder"),
        (tmp_path / f"{'x' * 300}.npz", "cannot be written"),
        (tmp_path / "a\0b.npz", "cannot be written"),
        ("/proc/absent/w.npz", "cannot be written"),
    ]:
        with pytest.raises(OutputError, match=message):
            save(result, path)
        assert everything_below(tmp_path) == before
    assert (tmp_path / "file").read_text() == "kept"


def test_a_read_only_file_is_not_replaced(tmp_path, result):
    """The rename that puts a file in its place asks for the folder's permission only."""
    save(result, tmp_path / "w.npz")
    before = (tmp_path / "w.npz").read_bytes()
    (tmp_path / "w.npz").chmod(0o444)
    (tmp_path / "link.npz").symlink_to(tmp_path / "w.npz")
    for name in ("w.npz", "link.npz"):
        with pytest.raises(OutputError, match=rf"{name}: is there and read-only: give another name"):
            save(result, tmp_path / name)
    assert (tmp_path / "w.npz").read_bytes() == before
    (tmp_path / "w.npz").chmod(0o644)
    save(result, tmp_path / "w.npz")


def test_a_device_is_not_replaced(tmp_path):
    os.mkfifo(tmp_path / "pipe.csv")
    with pytest.raises(OutputError, match="device or pipe"), atomic_path(tmp_path / "pipe.csv"):
        pass
    assert (tmp_path / "pipe.csv").is_fifo()


# ---------------------------------------------------------------------- when it fails


def full(*_, **__):
    raise OSError(28, "No space left on device")


@pytest.mark.parametrize("old", [True, False])
def test_a_full_disk_leaves_nothing_behind(tmp_path, result, monkeypatch, old):
    path = tmp_path / ("here.npz" if old else "new/deep/w.npz")
    if old:
        path.write_text("old")
    before = everything_below(tmp_path)
    monkeypatch.setattr(os, "replace", full)
    with pytest.raises(OutputError, match="cannot be written: No space left on device"):
        save(result, path)
    assert everything_below(tmp_path) == before
    assert not old or path.read_text() == "old"


@pytest.mark.parametrize(
    ("failure", "raised"), [(full, OutputError), (RuntimeError, RuntimeError), (KeyboardInterrupt, KeyboardInterrupt)]
)
def test_a_writer_that_fails_half_way_leaves_nothing_behind(tmp_path, result, monkeypatch, failure, raised):
    def half(_, path: Path):
        path.write_text("half of it")
        if failure is full:
            full()
        raise failure

    monkeypatch.setitem(write.WRITERS, ".csv", registry.Writer(".csv", "fails", half))
    (tmp_path / "w.csv").write_text("old")
    with pytest.raises(raised):
        save(result, tmp_path / "w.csv")
    with pytest.raises(raised):
        save(result, tmp_path / "new" / "w.csv")
    assert everything_below(tmp_path) == ["w.csv"]
    assert (tmp_path / "w.csv").read_text() == "old"


def test_a_folder_that_somebody_else_filled_is_kept(tmp_path):
    with pytest.raises(RuntimeError), atomic_path(tmp_path / "new" / "w.csv"):
        (tmp_path / "new" / "theirs").write_text("kept")
        raise RuntimeError
    assert everything_below(tmp_path) == ["new", "new/theirs"]


@pytest.mark.parametrize("theirs", ["made", "removed"])
def test_another_process_makes_or_removes_the_folder_at_the_same_time(tmp_path, monkeypatch, theirs):
    """Commands that begin together make a new folder to see whether they can write there, and remove it again."""
    mkdir, first = Path.mkdir, []

    def raced(self, *args, **options):
        mkdir(self, *args, **options)
        if not first:
            first.append(self)
            if theirs == "made":
                raise FileExistsError
            self.rmdir()

    monkeypatch.setattr(Path, "mkdir", raced)
    with atomic_path(tmp_path / "new" / "w.csv") as temporary:
        temporary.write_text("whole")
    assert first and everything_below(tmp_path) == ["new", "new/w.csv"]
