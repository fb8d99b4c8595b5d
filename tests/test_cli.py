"""The command line: what it writes, what it says, and how it answers mistakes."""

import json
import os
import runpy
import signal
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from command_line import run
from needs import SUFFIXES

import kcs_torch as kt

QUICK = ["--set", "viewpoint=fixed", "--set", "rounds=0", "--set", "steps=3"]
"""The default method in a tenth of its time, for tests of what goes on around it."""


# ---------------------------------------------------------------------- the whole program


def test_help_lists_every_command():
    text = run("--help").stdout
    for command in ("demo", "detect", "doctor", "lift", "info", "view", "skeletons"):
        assert command in text


@pytest.mark.parametrize("command", ["lift", "demo"])
def test_help_names_every_method(command):
    text = run(command, "--help").stdout
    for name in ["auto", *kt.METHODS]:
        assert name in text


def test_help_names_every_suffix():
    from kcs_torch.io import WRITERS

    for suffix in WRITERS:
        assert suffix in run("lift", "--help").stdout


def test_help_tells_exit_codes_and_what_is_replaced():
    text = " ".join(run("--help").stdout.replace("│", " ").split())
    assert "0 done; 2 an input or the call is wrong" in text and "130 stopped by Ctrl-C, 143 by SIGTERM" in text
    for command in ("lift", "view"):
        assert "A file that is there is replaced." in " ".join(run(command, "--help").stdout.replace("│", " ").split())


def test_version():
    assert run("--version").stdout.strip() == f"kcs-torch {kt.__version__}"


def test_as_a_module(monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["kcs_torch", "--version"])
    with pytest.raises(SystemExit) as end:
        runpy.run_module("kcs_torch", run_name="__main__", alter_sys=True)
    assert not end.value.code and capsys.readouterr().out.strip() == f"kcs-torch {kt.__version__}"


def test_console_script_answers_an_error_with_one_line(tmp_path):
    code = "import sys; from kcs_torch.cli import main; sys.argv[0] = 'kcs-torch'; main()"
    words = [sys.executable, "-c", code, "lift", "absent.npz", "-o", str(tmp_path / "out.npz")]
    done = subprocess.run(words, capture_output=True, text=True, check=False)
    assert done.returncode == 2
    assert done.stdout == ""
    assert done.stderr.startswith("error: ") and done.stderr.count("\n") == 1
    assert "absent.npz" in done.stderr


# ---------------------------------------------------------------------- lift


@pytest.fixture(scope="module")
def lifted(openpose_folder, tmp_path_factory):
    """A result in every format, and the JSON that the command printed."""
    folder = tmp_path_factory.mktemp("lifted")
    outputs = [folder / f"walk{suffix}" for suffix in SUFFIXES]
    words = [w for path in outputs for w in ("-o", path)]
    done = run("lift", openpose_folder, *words, *QUICK, "--fps", 25, "--json")
    return folder, json.loads(done.stdout)


def test_lift_writes_every_format_and_nothing_else(lifted):
    folder, _ = lifted
    assert {p.name for p in folder.iterdir()} == {f"walk{suffix}" for suffix in SUFFIXES}


@pytest.mark.filterwarnings("ignore:.*never seen")  # the detector's missed joint
@pytest.mark.filterwarnings("ignore:.*did not settle")  # in three steps
def test_lift_writes_what_the_library_computes(lifted, openpose_folder):
    folder, report = lifted
    saved = np.load(folder / "walk.npz", allow_pickle=False)
    result = kt.reconstruct(kt.load_tracks(openpose_folder, fps=25), viewpoint="fixed", rounds=0, steps=3)
    np.testing.assert_allclose(saved["points3d"], result.points, rtol=1e-6, atol=1e-6)
    (person,) = report["people"]
    assert person["frames"] == 40 and person["joints"] == 25 and person["skeleton"] == "body25"
    assert person["fps"] == 25
    assert person["method"] == result.method
    assert person["unseen_share"] == pytest.approx(1 / 25)
    assert person["converged"] is result.diagnostics.converged
    assert person["bone_variation"] == pytest.approx(result.diagnostics.bone_variation)
    assert [Path(f).name for f in person["files"]] == [f"walk{s}" for s in SUFFIXES]


def test_lift_reports_in_words(openpose_folder, tmp_path):
    done = run("lift", openpose_folder, "-o", tmp_path / "a.npz", *QUICK)
    for words in ("40 frames, 25 joints (body25)", "unseen joints", "4.0 %", "viewpoint turn", "bone variation"):
        assert words in done.stdout
    assert "2 people found" in done.stdout
    assert str(tmp_path / "a.npz") in done.stdout


def test_lift_says_which_folders_it_makes(openpose_folder, tmp_path):
    path = tmp_path / "new" / "deep" / "a.npz"
    done = run("lift", openpose_folder, "-o", path, "-m", "sfam")
    assert f"wrote {path}, in new folders: {path.parent}" in done.stdout
    done = run("lift", openpose_folder, "-o", path, "-m", "sfam")
    assert f"wrote {path}" in done.stdout and "new folder" not in done.stdout
    path = tmp_path / "third" / "a.npz"
    done = run("lift", openpose_folder, "-o", path, "-m", "sfam", "--json")
    assert json.loads(done.stdout)["people"][0]["new_folders"] == [str(path.parent)]


def test_lift_finds_the_skeleton(tmp_path):
    """Tracks without bones get those that their motion shows."""
    clip = kt.data.walking_person(60, skeleton="h36m17", turn=150)
    np.savez(tmp_path / "points.npz", points2d=clip.tracks.points.numpy())
    run("lift", tmp_path / "points.npz", "--skeleton", "auto", "-m", "sfam", "-o", tmp_path / "found.npz")
    found = kt.io.load_reconstruction(tmp_path / "found.npz").skeleton
    assert len(found.bones) >= 10
    run("lift", tmp_path / "points.npz", "-m", "sfam", "-o", tmp_path / "bare.npz")
    assert not kt.io.load_reconstruction(tmp_path / "bare.npz").skeleton.bones


@pytest.mark.parametrize("method", kt.METHODS)
def test_lift_by_each_method(openpose_folder, tmp_path, method):
    done = run("lift", openpose_folder, "-o", tmp_path / "a.npz", "--method", method, "--json")
    assert json.loads(done.stdout)["people"][0]["method"] == method


def test_lift_mirror_turns_depth_round(openpose_folder, tmp_path):
    """Under parallel rays."""
    for name, word in (("plain", ()), ("mirrored", ("--mirror",))):
        run("lift", openpose_folder, "-o", tmp_path / f"{name}.npz", *QUICK, "--intrinsics", "parallel", *word)
    plain, mirrored = (np.load(tmp_path / f"{name}.npz")["points3d"] for name in ("plain", "mirrored"))
    np.testing.assert_allclose(mirrored, plain * [1, 1, -1], rtol=1e-6, atol=1e-6)


def test_lift_everybody(openpose_folder, tmp_path):
    done = run("lift", openpose_folder, "-o", tmp_path / "a.npz", "--person", "all", "-m", "sfam", "--json")
    people = json.loads(done.stdout)["people"]
    assert [p["person"] for p in people] == [0, 1]
    assert {p.name for p in tmp_path.iterdir()} == {"a_0.npz", "a_1.npz"}
    assert people[0]["unseen_share"] < 0.1 < people[1]["unseen_share"]


def test_lift_everybody_says_whom_a_warning_is_about(openpose_folder, tmp_path):
    """Each warning names the file and the person, each once, and no note repeats it; so is said what all have."""
    words = ("lift", openpose_folder, "-o", tmp_path / "a.npz", "--person", "all", "-m", "sfam", "--unswap")
    words += ("--set", "num_steps=2")
    done = run(*words)
    for number in (0, 1):
        warning = f"warning: {openpose_folder}, person {number}: sfam did not settle within 2 steps\n"
        assert done.stderr.count(warning) == 1
        assert f"{openpose_folder}, person {number}: 40 frames" in done.stdout
    assert all(line.count(", person ") == line.count(str(openpose_folder)) == 1 for line in done.stderr.splitlines())
    everybody = done.stdout.rpartition("everybody:\n")[2]
    notes = [line for line in everybody.splitlines() if line.startswith("  note: ")]
    assert notes and all(done.stdout.count(note) == 1 for note in notes)
    told = json.loads(run(*words, "--json").stdout)["people"]
    assert all(note.removeprefix("  note: ") in one["notes"] for note in notes for one in told)
    warned = "never seen, so placed by the skeleton alone: "
    assert done.stderr.count(warned) == 2 and warned not in done.stdout
    assert all(sum(note.startswith(warned) for note in one["notes"]) == 1 for one in told)


def test_lift_everybody_who_is_in_these_frames(openpose_folder, tmp_path):
    words = ("lift", openpose_folder, "-o", tmp_path / "a.npz", "--person", "all", "-m", "sfam", "--frames")
    done = run(*words, "0:1")  # the second person comes in frame 1
    assert f"note: {openpose_folder}, person 1: not seen in frames 0:1: left out\n" in done.stderr
    assert {p.name for p in tmp_path.iterdir()} == {"a_0.npz"}
    assert "left out" not in run(*words, "0:2").stderr
    assert {p.name for p in tmp_path.iterdir()} == {"a_0.npz", "a_1.npz"}
    assert "expected frames within 0:40" in run(*words, "90:", code=2).stderr


def test_lift_leaves_out_who_is_hardly_seen(openpose_folder, tmp_path):
    words = ("lift", openpose_folder, "-o", tmp_path / "a.npz", "--person", "all", "-m", "sfam", "--least-seen")
    done = run(*words, 0.6)  # the second person is seen in every other frame
    assert f"note: {openpose_folder}, person 1: seen in 50 % of the frames: left out\n" in done.stderr
    assert {p.name for p in tmp_path.iterdir()} == {"a_0.npz"}
    assert "left out" not in run(*words, 0.6, "--frames", "1:4").stderr  # in two of these
    assert "left out" not in run(*words, 0.5).stderr
    assert {p.name for p in tmp_path.iterdir()} == {"a_0.npz", "a_1.npz"}
    points = kt.data.walking_person(8, skeleton="h36m17").tracks.points.clone()
    points[::2] = torch.nan
    np.savez(tmp_path / "one.npz", points2d=points.numpy())
    told = run("lift", tmp_path / "one.npz", *words[2:], 0.6, code=2).stderr
    assert "--least-seen: nobody is seen in 60 % of the frames; the most visible person is in 50 %" in told
    assert "expected frames within 0:40" in run(*words, 0.9, "--frames", "90:", code=2).stderr
    for wrong in ((1.5,), (0.5, "--person", 1)):
        assert "--least-seen: expected a share from 0 to 1, with --person all" in run(*words, *wrong, code=2).stderr


def test_lift_tells_who_is_seen_in_few_of_the_frames_that_are_taken(openpose_folder, tmp_path):
    for k, path in enumerate(sorted(openpose_folder.iterdir())):
        read = json.loads(path.read_text())
        seldom = read | {"people": read["people"][: 2 if k in (11, 13) else 1]}
        (tmp_path / path.name).write_text(json.dumps(seldom))
    words = ("lift", tmp_path, "-o", tmp_path / "out" / "a.npz", "--person", "all", "-m", "sfam")
    warned = f"{tmp_path}, person 1: visible in only 5 % of the frames: the rest is guessed (--least-seen 0.1 leaves"
    assert warned in run(*words).stderr
    for frames in ("10:15", "seen"):
        assert "visible in only" not in run(*words, "--frames", frames).stderr


def test_all_of_one_person_have_no_file_together(openpose_folder, tmp_path):
    words = ("-o", tmp_path / "a.html", "--person", "all", "--least-seen", 0.9, "-m", "sfam")
    run("lift", openpose_folder, *words)
    assert [path.name for path in tmp_path.glob("*.html")] == ["a_0.html"]


def test_lift_one_of_several(openpose_folder, tmp_path):
    done = run("lift", openpose_folder, "-o", tmp_path / "a.npz", "--person", 1, "-m", "sfam", "--json")
    (person,) = json.loads(done.stdout)["people"]
    assert person["unseen_share"] > 0.4


def test_lift_with_the_users_own_skeleton(openpose_folder, tmp_path):
    own = kt.SKELETONS["body25"].to_dict() | {"name": "mine"}
    (tmp_path / "mine.json").write_text(json.dumps(own))
    words = ["--skeleton", tmp_path / "mine.json", "-m", "sfam", "--json"]
    done = run("lift", openpose_folder, "-o", tmp_path / "a.npz", *words)
    assert json.loads(done.stdout)["people"][0]["skeleton"] == "mine"


def test_lift_sets_fields(openpose_folder, tmp_path):
    def lifted(*words):
        run("lift", openpose_folder, "-o", tmp_path / "a.npz", "-m", "sfam", *words)
        return np.load(tmp_path / "a.npz")["points3d"]

    plain = lifted()
    np.testing.assert_array_equal(lifted("--set", f"beta={kt.SfAM().beta}"), plain)
    assert np.abs(lifted("--set", "beta=0", "--set", "num_steps=40") - plain).max() > 1


MISTAKES = {
    "no such file": (["lift", "absent.json", "-o", "OUT.npz"], "FormatError", "absent.json"),
    "method": (["lift", "IN", "-o", "OUT.npz", "-m", "sfma"], "OptionError", "did you mean 'sfam'"),
    "field": (["lift", "IN", "-o", "OUT.npz", "-m", "sfam", "--set", "betta=1"], "OptionError", "did you mean 'beta'"),
    "no value": (["lift", "IN", "-o", "OUT.npz", "-m", "sfam", "--set", "beta"], "OptionError", "name=value"),
    "bad value": (
        ["lift", "IN", "-o", "OUT.npz", "-m", "sfam", "--set", "beta=much"],
        "OptionError",
        "a number",
    ),
    "skeleton": (["lift", "IN", "-o", "OUT.npz", "--skeleton", "body52"], "SkeletonError", "did you mean 'body25'"),
    "wrong skeleton": (["lift", "IN", "-o", "OUT.npz", "--skeleton", "hand21"], "SkeletonError", "hand21"),
    "format": (["lift", "IN", "-o", "OUT.npz", "--format", "opnpose"], "OptionError", "did you mean 'openpose'"),
    "person": (["lift", "IN", "-o", "OUT.npz", "--person", "7"], "FormatError", "2 people"),
    "person's name": (["lift", "IN", "-o", "OUT.npz", "--person", "-1"], "OptionError", "a number from 0, or all"),
    "threshold": (["lift", "IN", "-o", "OUT.npz", "--threshold", "2"], "OptionError", "0 to 1"),
    "fps": (["lift", "IN", "-o", "OUT.npz", "--fps", "-5"], "OptionError", "fps"),
    "frames beyond": (
        ["lift", "IN", "-o", "OUT.npz", "--frames", "500:600"],
        "OptionError",
        "--frames: expected",
    ),
    "no frame rate": (
        ["lift", "IN", "-o", "OUT.npz", "--fps", "0"],
        "OptionError",
        "fps (--fps): expected a positive number, got 0",
    ),
    "suffix": (["lift", "IN", "-o", "OUT.doc"], "OutputError", ".npz"),
    "detector of tracks": (["lift", "IN", "-o", "OUT.npz", "--detector", "rtmlib"], "OptionError", "belong to videos"),
    "model of tracks": (["lift", "IN", "-o", "OUT.npz", "--model", "no.onnx"], "OptionError", "belong to videos"),
    "joints of tracks": (["lift", "IN", "-o", "OUT.npz", "--what", "hands"], "OptionError", "belong to videos"),
    "a name of two": (
        ["lift", "IN", "--person", "all", "-o", "OUT.html", "-o", "OUT_1.html"],
        "OutputError",
        "OUT_1.html: would hold both person 1 and everybody",
    ),
    "unit": (["lift", "IN", "-o", "OUT.bvh", "--units", "parsec"], "OptionError", "unknown unit of length 'parsec'"),
    "unit of an unknown size": (["lift", "IN", "-o", "OUT.bvh", "--units", "m"], "OptionError", "--scale height="),
    "no suffix": (["lift", "IN", "-o", "OUT"], "OutputError", ".npz"),
    "output is a folder": (["lift", "IN", "-o", "FOLDER.npz"], "OutputError", "folder"),
    "info": (["info", "absent.json"], "FormatError", "absent.json"),
    "skeletons show": (["skeletons", "show", "body52"], "SkeletonError", "did you mean 'body25'"),
    "demo": (["demo", "-o", "OUT", "-m", "kc"], "OptionError", "did you mean 'pkc' or 'kcs'"),
}


@pytest.mark.parametrize("name", MISTAKES)
def test_mistakes_get_one_line_and_write_nothing(name, openpose_folder, tmp_path):
    words, kind, hint = MISTAKES[name]
    (tmp_path / "FOLDER.npz").mkdir()
    place = {"IN": openpose_folder} | {w: tmp_path / w for w in words if w.startswith(("OUT", "FOLDER"))}
    done = run(*(place.get(w, w) for w in words), "--json", code=2)
    assert done.stderr.startswith("error: ") and done.stderr.count("\n") == 1
    answer = json.loads(done.stdout)
    assert answer["type"] == kind
    assert hint in answer["error"] and hint in done.stderr
    assert [p.name for p in tmp_path.rglob("*")] == ["FOLDER.npz"]


@pytest.mark.parametrize(
    ("suffix", "package", "told"),
    [
        (".c3d", "ezc3d", "out.c3d: C3D: needs the package ezc3d"),
        (".rrd", "rerun", "out.rrd: a recording needs the package rerun-sdk"),
        (".mp4", "imageio_ffmpeg", "out.mp4: an MP4 needs ffmpeg"),
    ],
)
def test_what_cannot_be_written_is_told_before_the_lift(openpose_folder, tmp_path, monkeypatch, suffix, package, told):
    monkeypatch.setitem(sys.modules, package, None)
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.setattr(kt, "reconstruct_all", lambda *a, **k: pytest.fail("lifted before it was told"))
    done = run("lift", openpose_folder, "-o", tmp_path / f"out{suffix}", code=2)
    assert told in done.stderr and not list(tmp_path.iterdir())
    run("lift", openpose_folder, "-o", tmp_path / "out.npz", "--units", "parsec", code=2)
    run("lift", openpose_folder, "-o", tmp_path / "out.npz", "--scale", "height=2m", "--units", "parsec", code=2)


def test_a_skeleton_that_a_file_does_not_take_is_told_before_the_lift(tmp_path, monkeypatch):
    monkeypatch.setattr(kt, "reconstruct_all", lambda *a, **k: pytest.fail("lifted before it was told"))
    tracks = kt.Tracks.from_arrays(np.random.default_rng(0).normal(size=(10, 300, 2)))
    kt.save(tracks, tmp_path / "t.npz")
    for suffix, told in (
        (".bvh", "expected a skeleton whose bones are one tree"),
        (".c3d", "expected up to 255 joints"),
    ):
        done = run("lift", tmp_path / "t.npz", "-o", tmp_path / f"a{suffix}", "-o", tmp_path / "a.npz", code=2)
        assert done.stderr.startswith(f"error: {tmp_path / 'a'}{suffix}: {told}")
    assert [path.name for path in tmp_path.iterdir()] == ["t.npz"]


@pytest.fixture()
def broken(monkeypatch):
    """Writers of BVH and of pages that fail, as no check foresaw."""
    import kcs_torch.io.write as write

    def fails(*args):
        raise OSError("the disk is full")

    both = {".bvh": {"write_motion": fails}, ".html": {"write": fails, "write_people": fails}}
    changed = {suffix: replace(write.WRITERS[suffix], **fields) for suffix, fields in both.items()}
    monkeypatch.setattr(write, "WRITERS", {**write.WRITERS, **changed})


@pytest.mark.parametrize("words", [[], ["--person", "all"]])
def test_a_writer_that_fails_costs_no_other_file(openpose_folder, tmp_path, broken, words):
    outputs = [tmp_path / name for name in ("new/a.bvh", "a.npz", "a.html", "a.csv")]
    flags = [word for path in outputs for word in ("-o", path)]
    done = run("lift", openpose_folder, *flags, "-m", "kcs", *words, "--json", code=2)
    answer = json.loads(done.stdout)
    written = [Path(name) for person in answer["people"] for name in person["files"]]
    assert sorted(path for path in tmp_path.iterdir()) == sorted(written)
    assert {path.suffix for path in written} == {".npz", ".csv"} and len(written) == (4 if words else 2)
    for name in ["new/a_0.bvh", "new/a_1.bvh", "a_0.html", "a.html"] if words else ["new/a.bvh", "a.html"]:
        assert f"{tmp_path / name}: cannot be written: the disk is full" in answer["error"] and name in done.stderr
    spoken = run("lift", openpose_folder, *flags, "-m", "kcs", *words, code=2)
    assert f"a{'_1' if words else ''}.csv" in spoken.stdout and "bvh" not in spoken.stdout


def test_a_bug_in_a_writer_costs_no_other_file_and_shows_where_it_is(lifted, tmp_path, monkeypatch):
    import kcs_torch.io.write as write

    def fails(*args):
        raise ZeroDivisionError("planted")

    monkeypatch.setattr(write, "WRITERS", {**write.WRITERS, ".bvh": replace(write.WRITERS[".bvh"], write_motion=fails)})
    with pytest.raises(ZeroDivisionError):
        run("convert", lifted[0] / "walk.npz", tmp_path / "a.bvh", tmp_path / "a.csv")
    assert [path.name for path in tmp_path.iterdir()] == ["a.csv"]


def test_sigterm_leaves_no_file_half_written(lifted, tmp_path, monkeypatch):
    import kcs_torch.io.write as write

    def stopped(*args):
        assert list(tmp_path.iterdir())
        if signal.getsignal(signal.SIGTERM) != signal.SIG_DFL:  # else this process would end
            os.kill(os.getpid(), signal.SIGTERM)

    bvh = replace(write.WRITERS[".bvh"], write_motion=stopped)
    monkeypatch.setattr(write, "WRITERS", {**write.WRITERS, ".bvh": bvh})
    before = signal.signal(signal.SIGTERM, signal.SIG_DFL)
    try:
        run("convert", lifted[0] / "walk.npz", tmp_path / "a.bvh", code=143)
        assert signal.getsignal(signal.SIGTERM) == signal.SIG_DFL
    finally:
        signal.signal(signal.SIGTERM, before)
    assert not list(tmp_path.iterdir())


def test_view_writes_what_it_can(lifted, tmp_path, broken):
    result = lifted[0] / "walk.npz"
    for results in ([result], [result, result]):
        out = tmp_path / f"{len(results)}"
        done = run("view", *results, "-o", out / "a.html", "-o", out / "a.gif", code=2)
        assert done.stdout == f"wrote {out / 'a.gif'}\n" and [path.name for path in out.iterdir()] == ["a.gif"]


def test_an_output_that_is_named_twice_is_written_once(lifted, tmp_path):
    path, same = tmp_path / "a.csv", tmp_path / "b" / ".." / "a.csv"
    assert run("convert", lifted[0] / "walk.npz", path, same, path).stdout == f"wrote {path}\n"
    assert run("view", lifted[0] / "walk.npz", "-o", path, "-o", path).stdout == f"wrote {path}\n"


def test_a_late_mistake_leaves_earlier_outputs_alone(openpose_folder, tmp_path):
    (tmp_path / "old.npz").write_bytes(b"old")
    run("lift", openpose_folder, "-o", tmp_path / "old.npz", "-o", tmp_path / "new.doc", code=2)
    assert (tmp_path / "old.npz").read_bytes() == b"old"


def test_lift_refuses_to_replace_the_tracks(lifted, tmp_path):
    tracks = tmp_path / "walk.npz"
    tracks.write_bytes((lifted[0] / "walk.npz").read_bytes())
    done = run("lift", tracks, "-o", tracks, code=2)
    assert "replace" in done.stderr
    assert tracks.read_bytes() == (lifted[0] / "walk.npz").read_bytes()


def test_warnings_are_one_line_on_standard_error(openpose_folder, tmp_path, monkeypatch):
    import warnings

    plain = kt.reconstruct_all

    def warned(*args, **options):
        warnings.warn("stopped at its limit\nafter 3 steps", kt.ConvergenceWarning, stacklevel=2)
        return plain(*args, **options)

    monkeypatch.setattr(kt, "reconstruct_all", warned)
    done = run("lift", openpose_folder, "-o", tmp_path / "a.npz", "-m", "sfam", "--json")
    assert "warning: stopped at its limit after 3 steps\n" in done.stderr
    assert json.loads(done.stdout)["people"]


# ---------------------------------------------------------------------- info, view, skeletons


def test_info(openpose_folder):
    facts = json.loads(run("info", openpose_folder, "--json").stdout)
    assert facts["format"] == "openpose" and facts["frames"] == 40 and facts["skeleton"] == "body25"
    assert facts["joints"] == list(kt.SKELETONS["body25"].joints[:25])
    first, second = facts["people"]
    assert (first["frames_seen"], second["frames_seen"]) == (40, 20)
    assert first["mean_confidence"] == pytest.approx(0.9)
    assert first["unseen_share"] == pytest.approx(1 / 25)
    assert second["unseen_share"] == pytest.approx(1 - 0.5 * 24 / 25)


def test_info_in_words(openpose_folder):
    done = run("info", openpose_folder)
    assert done.stderr == ""  # no progress where nobody watches
    text = done.stdout
    assert "format openpose, 40 frames" in text and "body25" in text and "52.0 %" in text


def test_info_tells_the_size_of_the_image(openpose_folder):
    assert json.loads(run("info", openpose_folder, "--json").stdout)["image_size"] is None
    size = ["--image-size", "1920x1080"]
    assert json.loads(run("info", openpose_folder, *size, "--json").stdout)["image_size"] == [1920, 1080]
    assert "in px of an image of 1920 x 1080\n" in run("info", openpose_folder, *size).stdout


def test_lift_takes_the_size_of_the_image_of_pixels(openpose_folder, tmp_path):
    run("lift", openpose_folder, "-o", tmp_path / "walk.npz", *QUICK, "--fps", 25, "--image-size", "1920x1080")
    assert kt.io.load_reconstruction(tmp_path / "walk.npz").tracks.image_size == (1920, 1080)


def test_info_reads_a_result(lifted):
    facts = json.loads(run("info", lifted[0] / "walk.npz", "--json").stdout)
    assert facts["frames"] == 40 and facts["fps"] == 25 and facts["skeleton"] == "body25"


def test_view_writes_beside_the_result(lifted, tmp_path):
    result = tmp_path / "walk.npz"
    result.write_bytes((lifted[0] / "walk.npz").read_bytes())
    run("view", result)
    assert "<html" in (tmp_path / "walk.html").read_text(encoding="utf-8").lower()
    run("view", result, "-o", tmp_path / "sheet.png")
    assert (tmp_path / "sheet.png").read_bytes().startswith(b"\x89PNG")


def test_view_of_tracks_says_what_it_wants(shared, tmp_path):
    tracks = shared / "data" / "video2d" / "mediapipe_dancer.npz"
    done = run("view", tracks, "-o", tmp_path / "a.html", code=2)
    assert done.stderr.startswith("error: ") and "mediapipe_dancer.npz: expected a result" in done.stderr
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("words", [["skeletons"], ["skeletons", "list"]])
def test_skeletons_lists_all(words):
    text = run(*words).stdout
    for name in kt.SKELETONS:
        assert name in text


def test_skeletons_list_as_json():
    rows = json.loads(run("skeletons", "list", "--json").stdout)
    assert [row["name"] for row in rows] == list(kt.SKELETONS)
    assert next(row for row in rows if row["name"] == "body25")["joints"] == 25


@pytest.mark.parametrize("name", kt.SKELETONS)
def test_skeletons_show_every_joint(name):
    text = run("skeletons", "show", name).stdout
    body = kt.SKELETONS[name]
    for joint in body.joints:
        assert joint in text
    for hinge in body.hinges:
        assert f"{body.joints[hinge.joint]} {hinge.bends}" in text
    ground = text.split("touch the ground: ")[1].splitlines()[0]
    assert ground == (", ".join(body.joints[i] for i in body.contacts) or "none known")


def test_skeletons_show_is_a_skeleton_file(tmp_path):
    path = tmp_path / "mine.json"
    path.write_text(run("skeletons", "show", "coco17", "--json").stdout, encoding="utf-8")
    assert kt.Skeleton.load(path) == kt.SKELETONS["coco17"]


def test_skeletons_show_a_graph_that_is_no_tree(tmp_path):
    path = tmp_path / "ring.json"
    ring = {"joints": ["a", "b", "c"], "bones": [["a", "b"], ["b", "c"], ["c", "a"]], "tree": False}
    path.write_text(json.dumps(ring))
    assert "c-a" in run("skeletons", "show", path).stdout


def test_skeletons_show_draws_the_template(tmp_path):
    run("skeletons", "show", "coco17", "-o", tmp_path / "coco17.png")
    assert (tmp_path / "coco17.png").read_bytes().startswith(b"\x89PNG")


# ---------------------------------------------------------------------- demo


def test_demo_beats_the_flat_guess(tmp_path):
    facts = json.loads(run("demo", "-o", tmp_path / "demo", "--json").stdout)
    assert {p.name for p in (tmp_path / "demo").iterdir()} == {"walk.npz", "walk.html", "walk.png"}
    assert facts["error"] < 0.5 * facts["error_flat"]
