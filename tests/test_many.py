"""A folder of clips to a folder of motion: stopped, taken up again, with clips that fail."""

import json
import os
import runpy
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import torch
from pools import end_pool

import kcs_torch as kt
from kcs_torch.data import random_motion, walking_person
from kcs_torch.io import load_reconstruction
from kcs_torch.many import clips_of, folder, reconstruct_folder
from kcs_torch.many.record import MADE_BY, as_text
from kcs_torch.methods.clips import processes


def make_clips(folder, count, frames=8):
    """Small clips of different lengths in one folder and another within it."""
    (folder / "more").mkdir(parents=True)
    for i in range(count):
        tracks = walking_person(frames + i % 3, skeleton="coco17", yaw=40.0 * i).tracks
        kt.save(tracks, folder / ("more" if i % 4 == 3 else "") / f"clip{i}.npz")
    return folder


@pytest.fixture(scope="module")
def clips(tmp_path_factory):
    return make_clips(tmp_path_factory.mktemp("many") / "tracks", 6)


def run(source, output, **options):
    return reconstruct_folder(source, output, **{"method": "kcs", "pattern": "**/*.npz", **options})


def test_every_clip_once(clips, tmp_path):
    said = []
    outcome = run(clips, tmp_path / "out", suffixes=("npz", ".csv"), batch=4, progress=said.append)
    assert (outcome.clips, outcome.done, outcome.skipped, outcome.failed) == (6, 6, 0, ())
    assert outcome.frames == sum(8 + i % 3 for i in range(6))
    made = sorted(p.relative_to(tmp_path / "out").as_posix() for p in (tmp_path / "out").rglob("*") if p.is_file())
    made.remove(MADE_BY)
    assert made == sorted(f"{'more/' if i == 3 else ''}clip{i}.{s}" for i in range(6) for s in ("csv", "npz"))
    alone = kt.reconstruct(kt.load_tracks(clips / "clip4.npz"), method="kcs")
    torch.testing.assert_close(
        load_reconstruction(tmp_path / "out" / "clip4.npz").points, alone.points, rtol=1e-6, atol=1e-3
    )
    assert said[-1].startswith("6 of 6 clips, 0 failed")
    again = run(clips, tmp_path / "out", suffixes=("npz", ".csv"))
    assert (again.done, again.skipped) == (0, 6)
    (tmp_path / "out" / "clip1.csv").unlink()
    assert run(clips, tmp_path / "out", suffixes=("npz", ".csv")).done == 1


def test_shards_share_the_work(clips, tmp_path):
    parts = [run(clips, tmp_path, shard=k, shards=3) for k in range(3)]
    assert sum(part.clips for part in parts) == sum(part.done for part in parts) == 6
    assert len(list(tmp_path.rglob("*.npz"))) == 6
    with pytest.raises(kt.OptionError, match="shard"):
        run(clips, tmp_path, shard=3, shards=3)


def test_clips_that_fail_are_listed_and_stop_nobody(tmp_path):
    source = make_clips(tmp_path / "in", 3)
    (source / "bad.json").write_text("{")
    np.savez(source / "empty.npz", points2d=np.full((4, 17, 2), np.nan))
    outcome = run(source, tmp_path / "out", pattern="*.*", batch=5)
    assert outcome.done == 3 and {path.name for path, _ in outcome.failed} == {"bad.json", "empty.npz"}
    why = (tmp_path / "out" / "bad.failed.txt").read_text()
    assert why.startswith("FormatError") and "bad.json" in why
    again = run(source, tmp_path / "out", pattern="*.*")
    assert (again.done, again.skipped) == (0, 3) and {p.name for p, _ in again.failed} == {"bad.json", "empty.npz"}
    kt.save(walking_person(8, skeleton="coco17").tracks, source / "empty.npz")
    mended = run(source, tmp_path / "out", pattern="*.*", retry=True)
    assert mended.done == 1 and len(mended.failed) == 1
    assert not (tmp_path / "out" / "empty.failed.txt").exists()


def test_a_clip_that_breaks_the_batch_is_found(clips, tmp_path, monkeypatch):
    """An error that no check foresaw costs one clip, and its traceback is kept."""
    real = kt.KCS._template

    def template(self, tracks, cameras):
        if "clip2" in tracks.source:
            raise ZeroDivisionError("planted")
        return real(self, tracks, cameras)

    monkeypatch.setattr(kt.KCS, "_template", template)
    outcome = run(clips, tmp_path)
    assert outcome.done == 5 and outcome.failed[0][1] == "ZeroDivisionError: planted"
    assert "Traceback" in (tmp_path / "clip2.failed.txt").read_text()


def test_the_camera_is_kept_where_a_clip_breaks_the_batch(tmp_path, monkeypatch):
    """Halves of it, and each for itself, are still solved with its intrinsics."""
    source = make_clips(tmp_path / "in", 3)
    real, asked = folder.reconstruct_all, []

    def spied(tracks, **options):
        tracks = list(tracks)
        asked.append((len(tracks), options["intrinsics"]))
        if len(tracks) > 1:
            raise ZeroDivisionError("planted")
        return real(tracks, **options)

    monkeypatch.setattr(folder, "reconstruct_all", spied)
    camera = (1500.0, 1500.0, 960.0, 540.0)
    outcome = run(source, tmp_path / "out", intrinsics=camera)
    assert outcome.done == 3 and asked == [(n, camera) for n in (0, 3, 1, 2, 1, 1)]


def test_a_clip_that_breaks_the_batch_leaves_the_others_in_batches(clips, tmp_path, monkeypatch):
    """Clips alone take several times as long."""
    real, asked = folder.reconstruct_all, []

    def spied(tracks, **options):
        tracks = list(tracks)
        asked.append(len(tracks))
        if any("clip0" in one.source for one in tracks):
            raise ZeroDivisionError("planted")
        return real(tracks, **options)

    monkeypatch.setattr(folder, "reconstruct_all", spied)
    assert run(clips, tmp_path).done == 5 and asked == [0, 6, 3, 1, 2, 3]
    assert (tmp_path / "clip0.failed.txt").read_text().count("Traceback") == 1


def test_an_option_that_fits_some_clips_only_costs_the_others_alone(tmp_path):
    """A clip that is no number of a size, say, is listed; what fits no clip is told before anything is done."""
    source = make_clips(tmp_path / "in", 2)
    kt.save(random_motion("hand21", 8).tracks, source / "hand.npz")
    outcome = run(source, tmp_path / "out", scale="height=1.75m")
    assert outcome.done == 2 and [path.name for path, _ in outcome.failed] == ["hand.npz"]
    with pytest.raises(kt.KcsError, match="height"):
        run(source, tmp_path / "other", scale="height=-1m")


def test_up_goes_to_the_files_that_hold_it(tmp_path):
    source = make_clips(tmp_path / "in", 1)
    assert run(source, tmp_path / "out", suffixes=[".npz", ".bvh"], up="z").failed == ()
    up = kt.load_motion(tmp_path / "out" / "clip0.bvh").points
    run(source, tmp_path / "y", suffixes=[".bvh"], up="y")
    assert not np.allclose(up, kt.load_motion(tmp_path / "y" / "clip0.bvh").points)
    with pytest.raises(kt.OptionError, match="up"):
        run(source, tmp_path / "none", up="z")


def test_bones_are_found_where_that_is_asked_for(tmp_path):
    (tmp_path / "in").mkdir()
    tracks = random_motion("coco17", 40, turn=180).tracks
    kt.save(kt.Tracks.from_arrays(tracks.points), tmp_path / "in" / "a.npz")
    assert run(tmp_path / "in", tmp_path / "out").failed == ()
    assert run(tmp_path / "in", tmp_path / "found", skeleton="auto").failed == ()
    without, found = (load_reconstruction(tmp_path / name / "a.npz") for name in ("out", "found"))
    assert without.tracks.skeleton.num_bones == 0 < found.tracks.skeleton.num_bones


def test_what_was_written_before_another_file_failed_is_there(tmp_path):
    """A graph goes to .npz, not to .bvh: the clip failed, but not for those who ask for .npz alone."""
    (tmp_path / "in").mkdir()
    tracks = random_motion("coco17", 20).tracks
    kt.save(kt.Tracks.from_arrays(tracks.points), tmp_path / "in" / "a.npz")
    both = run(tmp_path / "in", tmp_path / "out", suffixes=[".npz", ".bvh"])
    assert len(both.failed) == 1 and "tree" in both.failed[0][1] and "--skeleton" in both.failed[0][1]
    assert len(run(tmp_path / "in", tmp_path / "out", suffixes=[".npz", ".bvh"]).failed) == 1
    alone = run(tmp_path / "in", tmp_path / "out")
    assert (alone.skipped, alone.failed) == (1, ())


def test_everybody(tmp_path):
    shared = walking_person(8, skeleton="coco17").tracks
    lists = []
    for frame, xy in enumerate(shared.points):
        for shift in (0, 500):
            keypoints = [v for n in range(17) for v in (*(xy[n] + shift).tolist(), 0.9)]
            lists.append({"image_id": frame, "keypoints": keypoints, "category_id": 1, "score": 1.0})
    (tmp_path / "in").mkdir()
    (tmp_path / "in" / "two.json").write_text(json.dumps(lists))
    outcome = run(tmp_path / "in", tmp_path / "out", pattern="*", everybody=True)
    assert outcome.done == 1 and {p.name for p in (tmp_path / "out").glob("*.npz")} == {"two_0.npz", "two_1.npz"}
    assert run(tmp_path / "in", tmp_path / "out", pattern="*", everybody=True).skipped == 1
    assert run(tmp_path / "in", tmp_path / "most", pattern="*").done == 1
    assert any("2 people found" in n for n in load_reconstruction(tmp_path / "most" / "two.npz").tracks.notes)
    more = run(tmp_path / "in", tmp_path / "out", pattern="*", everybody=True, suffixes=[".npz", ".csv"])
    assert more.done == 1 and {p.name for p in (tmp_path / "out").glob("*.csv")} == {"two_0.csv", "two_1.csv"}
    with pytest.raises(kt.OptionError, match="everybody=True, got everybody=False"):  # two_0 may be a clip's own name
        run(tmp_path / "in", tmp_path / "out", pattern="*")


@pytest.mark.parametrize(
    ("first", "then", "told"),
    [
        ({}, {"method": "sfam"}, "out: holds results of method=kcs, got method=sfam: give another output folder"),
        (
            {},
            {"method": kt.KCS(steps_per_weight=7)},
            "holds results of method.steps_per_weight=.*, got method.steps_per_weight=7",
        ),
        ({}, {"scale": "height=1.75m"}, "holds results of scale=None, got scale=height=1.75m"),
        ({}, {"skeleton": "auto"}, "reading.skeleton=None, got reading.skeleton=auto.* or retry"),
        ({"intrinsics": (900, 900, 0, 0)}, {}, r"intrinsics=Intrinsics\(fx=900.0.*, got intrinsics=None"),
    ],
)
def test_a_folder_holds_results_of_one_kind(clips, tmp_path, first, then, told):
    """What is there already is never taken for what another method would make."""
    source, out = make_clips(tmp_path / "in", 1), tmp_path / "out"
    assert run(source, out, **first).done == 1
    before = {path: path.read_bytes() for path in out.iterdir()}
    with pytest.raises(kt.OptionError, match=told):
        run(source, out, **{"method": "kcs", **then})
    assert {path: path.read_bytes() for path in out.iterdir()} == before
    assert run(source, out, **first, suffixes=[".npz", ".csv"], batch=3).done == 1


def test_what_failed_may_be_read_otherwise(tmp_path):
    """The rest stays; a retry that is stopped goes on as a retry."""
    source, out = make_clips(tmp_path / "in", 1), tmp_path / "out"
    np.savez(source / "odd.npz", points2d=np.random.default_rng(0).normal(size=(9, 17, 2)), fps=-1.0)
    assert len(run(source, out, pattern="*.npz").failed) == 1
    assert run(source, out, pattern="*.npz", retry=True, fps=25).done == 1
    assert run(source, out, pattern="*.npz", retry=True, fps=25).skipped == 2
    with pytest.raises(kt.OptionError, match=r"reading.fps=None, got reading.fps=25"):
        run(source, out, pattern="*.npz", fps=25)


def test_how_results_were_made_is_checked_without_links_and_where_it_is_damaged(tmp_path, monkeypatch):
    source, out = make_clips(tmp_path / "in", 1), tmp_path / "out"

    def refused(*args):
        raise PermissionError("no links here")

    monkeypatch.setattr(os, "link", refused)
    assert run(source, out).done == 1 and run(source, out, method=kt.KCS()).skipped == 1
    with pytest.raises(kt.OptionError, match="method=sfam"):
        run(source, out, method="sfam")
    (out / MADE_BY).write_text("[1")
    with pytest.raises(kt.FormatError, match=r"made_by.json: damaged: .* remove it"):
        run(source, out)
    assert sorted(path.name for path in out.iterdir()) == [MADE_BY, "clip0.npz"]


def test_networks_differ_by_their_weights():
    """Two trainings of one network are two methods; reading one twice is not."""
    torch.manual_seed(0)
    one, other = torch.nn.Linear(2, 2), torch.nn.Linear(2, 2)
    again = torch.nn.Linear(2, 2)
    again.load_state_dict(one.state_dict())
    assert as_text(one) == as_text(again) != as_text(other)


def test_a_sweep_writes_a_folder_for_each_method(tmp_path, root):
    pytest.importorskip("hydra")
    source = make_clips(tmp_path / "in", 1)
    command = [
        sys.executable, str(root / "scripts" / "reconstruct_many.py"), "-m", f"input={source}",
        f"hydra.sweep.dir={tmp_path / 'sweep'}", "method=kcs,sfam", "pattern='*.npz'",
    ]  # fmt: skip
    words = [f"output={tmp_path}/motion/${{hydra:runtime.choices.method}}"]
    done = subprocess.run([*command, *words], cwd=tmp_path, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    for method in ("kcs", "sfam"):
        assert load_reconstruction(tmp_path / "motion" / method / "clip0.npz").method == method
    done = subprocess.run(
        [*command, f"output={tmp_path}/one"], cwd=tmp_path, capture_output=True, text=True, timeout=300
    )
    assert done.returncode == 2 and "holds results of method=kcs, got method=sfam" in done.stderr
    told = subprocess.run([*command[:2], "--help"], cwd=tmp_path, capture_output=True, text=True, timeout=60)
    assert "-m input=tracks 'output=motion/${hydra:runtime.choices.method}' method=kcs,sfam\n" in told.stdout
    assert "Traceback" not in done.stderr


def test_names_that_would_meet_keep_their_suffix(tmp_path):
    for name in ("a.json", "a.csv", "b.npz"):
        (tmp_path / name).touch()
    targets = {clip.target.name for clip in clips_of(tmp_path, tmp_path / "out")}
    assert targets == {"a.json", "a.csv", "b"}


def test_the_folder_itself_is_no_clip(tmp_path):
    (tmp_path / "in" / "walk").mkdir(parents=True)
    assert [clip.name for clip in clips_of(tmp_path / "in", tmp_path / "out", "**")] == ["walk"]


def test_results_in_the_input_are_no_clips(tmp_path):
    source = make_clips(tmp_path / "in", 2)
    run(source, source / "out")
    assert run(source, source / "out").clips == 2


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"batch": 0}, "batch"),
        ({"batch": 2.5}, "batch: expected a whole number, got 2.5"),
        ({"shards": "two"}, "shards: expected a whole number, got 'two'"),
        ({"everybody": "no"}, "everybody: expected true or false, got 'no'"),
        ({"retry": "no"}, "retry: expected true or false, got 'no'"),
        ({"pattern": "*.xyz"}, "found none"),
        ({"suffixes": [".doc"]}, "suffix"),
        ({"suffixes": None}, "suffixes: expected a list of some, such as .npz, got None"),
        ({"beta": 1}, "beta"),
    ],
)
def test_wrong_options_are_told_at_once(clips, tmp_path, options, words):
    with pytest.raises((kt.KcsError, TypeError), match=words):
        run(clips, tmp_path, **options)
    with pytest.raises(kt.OptionError, match="expected a folder"):
        run(tmp_path / "none", tmp_path)


def test_what_the_killed_left_is_removed(clips, tmp_path):
    """A part clears its own folder, and others' that are old: they may be at work."""
    for name in (".part_0_of_1", ".part_1_of_4", ".part_2_of_4"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "clip9.npz").touch()
    os.utime(tmp_path / ".part_1_of_4", (0, 0))
    run(clips, tmp_path)
    assert [p.name for p in tmp_path.glob(".part*")] == [".part_2_of_4"]


def test_what_another_part_removes_meanwhile_is_no_matter(clips, tmp_path, monkeypatch):
    glob = Path.glob

    def vanishing(self, pattern, **options):
        for path in glob(self, pattern, **options):
            if path.name.startswith(".part_1"):
                path.rmdir()
            yield path

    (tmp_path / ".part_1_of_2").mkdir()
    monkeypatch.setattr(Path, "glob", vanishing)
    assert run(clips, tmp_path).done == 6


def test_true_size(clips, tmp_path):
    run(clips, tmp_path, scale="height=1.75m", suffixes=["npz", "trc"])
    result = load_reconstruction(tmp_path / "clip0.npz")
    assert result.units == "m" and 0.5 < float(result.points[..., 1].max() - result.points[..., 1].min()) < 2.5
    assert kt.load_motion(tmp_path / "clip0.trc").units == "m"


def test_killed_and_taken_up_again(tmp_path, root):
    """SIGKILL in the middle: nothing is lost, nothing made twice, nothing half written."""
    pytest.importorskip("hydra")
    source, output = make_clips(tmp_path / "in", 30), tmp_path / "out"
    command = [
        sys.executable, str(root / "scripts" / "reconstruct_many.py"), f"input={source}", f"output={output}",
        "method=kcs", "pattern='**/*.npz'", "batch=2", f"hydra.run.dir={tmp_path / 'run'}",
    ]  # fmt: skip

    def results():  # what lies in the part's own, hidden folder is not in its place yet
        return [p for p in output.rglob("clip*.npz") if not p.relative_to(output).parts[0].startswith(".")]

    started = subprocess.Popen(command, cwd=tmp_path, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    deadline = time.monotonic() + 120
    while len(results()) < 4 and time.monotonic() < deadline and started.poll() is None:
        time.sleep(0.02)
    started.send_signal(signal.SIGKILL)
    started.wait()
    first = {p: (p.stat().st_mtime_ns, p.stat().st_ino) for p in results()}
    assert 4 <= len(first) < 30
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert f"{30 - len(first)} made" in done.stdout and f"{len(first)} were there, 0 failed" in done.stdout
    made = list(output.rglob("*.npz"))
    assert len(made) == 30 and [path.name for path in output.glob(".*")] == [MADE_BY]
    assert all((p.stat().st_mtime_ns, p.stat().st_ino) == stamp for p, stamp in first.items())
    for path in made:
        assert torch.isfinite(load_reconstruction(path).points).all()


@pytest.mark.parametrize(
    ("launcher", "package"), [("joblib", "hydra_joblib_launcher"), ("submitit_local", "hydra_submitit_launcher")]
)
def test_launchers(clips, tmp_path, root, launcher, package):
    """The jobs of a multirun do a shard each, in processes of their own."""
    pytest.importorskip(f"hydra_plugins.{package}")
    command = [
        sys.executable, str(root / "scripts" / "reconstruct_many.py"), "-m", f"input={clips}",
        f"output={tmp_path / 'out'}", "method=kcs", "pattern='**/*.npz'", "shards=2", "shard=range(0,2)",
        f"hydra/launcher={launcher}", f"hydra.sweep.dir={tmp_path / 'sweep'}",
    ]  # fmt: skip
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    assert len(list((tmp_path / "out").rglob("*.npz"))) == 6


def test_a_multirun_says_that_clips_failed(clips, tmp_path, root):
    pytest.importorskip("hydra_plugins.hydra_joblib_launcher")
    (tmp_path / "in").mkdir()
    (tmp_path / "in" / "bad.json").write_text("{")
    kt.save(walking_person(8, skeleton="coco17").tracks, tmp_path / "in" / "good.npz")
    command = [
        sys.executable, str(root / "scripts" / "reconstruct_many.py"), "-m", f"input={tmp_path / 'in'}",
        f"output={tmp_path / 'out'}", "method=kcs", "shards=2", "shard=range(0,2)", "hydra/launcher=joblib",
        f"hydra.sweep.dir={tmp_path / 'sweep'}",
    ]  # fmt: skip
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=300)
    assert done.returncode == 1 and "1 clip failed" in done.stderr and "Traceback" not in done.stderr
    assert (tmp_path / "out" / "good.npz").exists() and (tmp_path / "out" / "bad.failed.txt").exists()


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (["output=out"], "error: input: expected a value, got none: add input=..."),
        (["input=nowhere", "output=out"], "error: nowhere: expected a folder of tracks"),
        (["input=in", "output=out", "scale=height=2miles"], "error: scale: expected height=1.75m, a bone"),
        (["input=in", "output=out", "+reading.fsp=25"], "error: unknown reading option 'fsp': did you mean 'fps'"),
        (["input=in", "output=out", "method=sfam", "+method.foo=3"], "error: unknown option of method 'sfam' 'foo'"),
    ],
)
def test_a_wrong_call_of_the_script_is_a_line(tmp_path, root, words, told):
    pytest.importorskip("hydra")
    (tmp_path / "in").mkdir()
    command = [sys.executable, str(root / "scripts" / "reconstruct_many.py"), *words]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 2 and told in done.stderr and "Traceback" not in done.stderr
    assert {path.name for path in tmp_path.iterdir()} <= {"in", "out"}  # Hydra leaves nothing unasked


def test_ctrl_c_tells_how_to_go_on(clips, tmp_path, root, monkeypatch, capsys):
    pytest.importorskip("hydra")

    def stop(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(folder._Work, "reconstruct", stop)
    words = [f"input={clips}", f"output={tmp_path / 'out'}", f"hydra.run.dir={tmp_path / 'run'}", "method=kcs"]
    monkeypatch.setattr(sys, "argv", ["reconstruct_many.py", *words])
    threads = torch.get_num_threads()
    with pytest.raises(SystemExit, match="130"):
        runpy.run_path(str(root / "scripts" / "reconstruct_many.py"), run_name="__main__")
    torch.set_num_threads(threads)
    assert "stopped: run it again to go on" in capsys.readouterr().err


def test_names_of_results_are_distinct_whatever_clips_are_called(tmp_path):
    """A name without its suffix may be another's whole name, and what follows a folder's last dot is no suffix."""
    for name in ("m.csv", "m.json", "m.csv.bak", "m.json.csv", "solo.csv"):
        (tmp_path / name).touch()
    (tmp_path / "shot.cam01").mkdir()
    targets = {clip.name: clip.target.name for clip in clips_of(tmp_path, tmp_path / "out")}
    assert len(set(targets.values())) == 6
    assert (targets["solo.csv"], targets["shot.cam01"], targets["m.csv"]) == ("solo", "shot.cam01", "m.csv")


def test_results_within_the_input_are_no_clips(clips, tmp_path):
    source = make_clips(tmp_path / "in", 2)
    run(source, source / "motion", pattern="*")
    names = [clip.name for clip in clips_of(source, source / "again", "**/*.npz")]
    assert names == ["clip0.npz", "clip1.npz"]
    for output in (source, tmp_path):
        with pytest.raises(kt.OptionError, match="lies in the output folder"):
            clips_of(source, output)


def test_what_cannot_be_read_so_leaves_no_trace(clips, tmp_path):
    """A wrong option of reading is told at once: no clip fails for it, and the right one is welcome after it."""
    for reading, told in (
        ({"skeleton": "cocco17"}, "did you mean 'coco17'"),
        ({"skeleton": str(tmp_path / "none.yaml")}, "none.yaml: cannot be read"),
        ({"fps": -1}, "fps"),
        ({"threshold": 3}, "threshold"),
        ({"fsp": 30}, "reading option"),
        ({"units": "inch"}, "unit of length 'inch'"),
        ({"suffixes": []}, "suffixes: expected at least one"),
        ({"scale": 1.75}, "expected height=1.75m, .* got '1.75'"),
    ):
        with pytest.raises(kt.KcsError, match=told):
            run(clips, tmp_path / "out", **reading)
    assert not (tmp_path / "out").exists()
    assert run(clips, tmp_path / "out", skeleton="coco17", suffixes=".npz").done == 6


def test_a_skeleton_file_counts_by_what_is_in_it(tmp_path):
    source, body = make_clips(tmp_path / "in", 1), tmp_path / "body.yaml"
    text = kt.SKELETONS["coco17"].to_dict()
    body.write_text(json.dumps(text))
    assert run(source, tmp_path / "out", skeleton=str(body)).done == 1
    assert run(source, tmp_path / "out", skeleton=str(body)).skipped == 1
    body.write_text(json.dumps({**text, "name": "other"}))
    with pytest.raises(kt.OptionError, match="reading.skeleton"):
        run(source, tmp_path / "out", skeleton=str(body))


def test_what_was_changed_since_is_told(tmp_path):
    source = make_clips(tmp_path / "in", 2)
    assert run(source, tmp_path / "out").outdated == ()
    later = time.time() + 60
    os.utime(source / "clip1.npz", (later, later))
    again = run(source, tmp_path / "out")
    assert (again.skipped, again.outdated) == (2, (source / "clip1.npz",))


def test_a_file_of_a_folder_that_was_changed_since_is_told(tmp_path):
    """A folder's own time tells of files that come and go, not of one that is written anew."""
    clip = tmp_path / "walk"
    clip.mkdir()
    (clip / "f0.json").touch()
    (made,) = clips_of(tmp_path, tmp_path / "out")
    result = tmp_path / "result.npz"
    result.touch()
    for path, time_of in ((clip / "f0.json", 10), (clip, 10), (result, 20)):
        os.utime(path, (time_of, time_of))
    assert not made.is_newer_than([result])
    os.utime(clip / "f0.json", (30, 30))
    assert made.is_newer_than([result])


def test_a_number_is_the_same_however_it_is_written(clips, tmp_path):
    run(clips, tmp_path, fps=30)
    assert run(clips, tmp_path, fps=30.0).failed == ()
    assert run(clips, tmp_path, fps=np.float64(30)).failed == ()


def test_a_size_that_no_body_has_is_told_before_anything_is_solved(clips, tmp_path, monkeypatch):
    monkeypatch.setattr(folder._Work, "_lift", lambda _, people: [pytest.fail("solved in vain") for one in people])
    failed = run(clips, tmp_path, scale="hieght=1.75m").failed
    assert failed and all("unknown size 'hieght'" in why for _, why in failed)
    with pytest.raises(kt.OptionError, match="scale: expected height"):
        run(clips, tmp_path / "other", scale="units=3m")


def test_doubted_clips_are_told(clips, tmp_path):
    outcome = run(clips, tmp_path / "told", method="pkc", pattern="*0.npz")
    assert outcome.doubted == ()
    source = tmp_path / "in"
    source.mkdir()
    chain = kt.Skeleton.from_names([f"j{k}" for k in range(6)], [(f"j{k}", f"j{k + 1}") for k in range(5)])
    still = random_motion(chain, 30, turn=0, generator=torch.Generator().manual_seed(0))
    kt.save(still.tracks, source / "still.npz")
    ((path, why),) = run(source, tmp_path / "out", method="pkc").doubted
    assert path.name == "still.npz" and "guess" in why


def test_results_are_levelled_in_the_files_that_hold_them_so(clips, tmp_path):
    run(clips, tmp_path / "level", suffixes=[".npz", ".trc"], pattern="clip0*", pitch=20)
    run(clips, tmp_path / "out", suffixes=[".npz", ".trc"], pattern="clip0*")
    level, out = (kt.load_motion(tmp_path / name / "clip0.trc") for name in ("level", "out"))
    alone = kt.Motion.of(load_reconstruction(tmp_path / "out" / "clip0.npz"), pitch=20)
    moved, wanted = (motion.points - motion.points[:1].mean(1, keepdim=True) for motion in (level, alone))
    torch.testing.assert_close(moved * (wanted.norm() / moved.norm()), wanted, rtol=1e-3, atol=1.0)
    assert not torch.allclose(level.points, out.points)
    with pytest.raises(kt.OptionError, match="pitch"):  # its results were made otherwise
        run(clips, tmp_path / "level", suffixes=[".npz", ".trc"], pattern="clip0*", pitch=10)
    with pytest.raises(kt.OptionError, match="pitch: none of .npz holds results"):
        run(clips, tmp_path / "none", pitch=10)
    with pytest.raises(kt.OptionError, match="pitch: expected the degrees"):
        run(clips, tmp_path / "none", suffixes=[".bvh"], pitch=100)
    with pytest.raises(kt.OptionError, match="unknown axis for up 'x'"):
        run(clips, tmp_path / "none", suffixes=[".bvh"], up="x")
    assert not (tmp_path / "none").exists()


def test_several_processes_make_the_same(clips, tmp_path, monkeypatch):
    pytest.importorskip("joblib")
    parts, real = [], processes._answers
    monkeypatch.setattr(
        processes, "_answers", lambda solve, rows, workers: parts.append(len(rows)) or real(solve, rows, workers)
    )
    outcome = run(clips, tmp_path / "two", workers=2, batch=4)
    end_pool()
    assert parts == [2, 2]
    assert (outcome.done, outcome.failed) == (6, ())
    run(clips, tmp_path / "one", batch=4)
    for path in sorted((tmp_path / "one").rglob("*.npz")):
        two = load_reconstruction(tmp_path / "two" / path.relative_to(tmp_path / "one"))
        torch.testing.assert_close(two.points, load_reconstruction(path).points, rtol=1e-6, atol=1e-3)
    with pytest.raises(kt.OptionError, match="workers: expected a whole number"):
        run(clips, tmp_path / "none", workers=0)
    run(clips, tmp_path / "two", workers=1)  # how many make them is nothing that results depend on
