"""scripts/benchmark.py, on a small protocol made here and on a case of the real one."""

import csv
import os
import re
import subprocess
import sys

import pytest

from kcs_torch.errors import OptionError

PROTOCOL = """
import numpy as np
FIGURES = ("rigid", "bone_cv")
EDGES = np.array([(0, 1), (1, 2), (2, 3), (1, 4)])

def suites():
    return {"turn": [dict(src="a"), dict(src="b")], "broken": [dict(src="nan"), dict(src="a")]}

def case_name(case):
    return "case_" + case["src"]

def load(data, src):
    raise FileNotFoundError(src)

def build(data, case):
    t = np.linspace(0, 3, 30)[:, None]
    rest = np.array([[0, 0, 0], [0, -10, 1], [3, -14, 2], [5, -18, 0], [-4, -13, -2]], float)
    x, z = rest[:, 0] + np.sin(4 * t), rest[:, 2] + np.cos(3 * t)
    X = np.stack([x * np.cos(t) + z * np.sin(t), rest[:, 1] + 0 * t, z * np.cos(t) - x * np.sin(t)], -1)
    W = X[..., :2].copy()
    if case["src"] == "nan":
        W[:] = np.nan
    names = np.array(["root", "neck", "shoulder", "hand", "head"])
    confidence = np.isfinite(W).all(-1) * 1.0
    given = dict(points2d=W, confidence=confidence, edges=EDGES, joint_names=names, fps=30.0, units="mm")
    return given, dict(points3d=X, edges=EDGES, world=None)

def score(pred, truth, edges, cameras=None, world=None):
    assert pred.shape == truth.shape and cameras.shape == (30, 2, 3)
    return dict(rigid=float(abs(pred - truth).mean()), bone_cv=1.0)
"""


def benchmark(root, folder, *words, path=None):
    command = [sys.executable, str(root / "scripts" / "benchmark.py"), *words]
    looked = os.pathsep.join(filter(None, [path and str(path), os.environ.get("PYTHONPATH")]))
    return subprocess.run(
        command, cwd=folder, capture_output=True, text=True, check=False, env={**os.environ, "PYTHONPATH": looked}
    )


def rows(path):
    with path.open(newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


@pytest.fixture
def folder(tmp_path):
    (tmp_path / "shared" / "protocol").mkdir(parents=True)
    (tmp_path / "shared" / "protocol" / "protocol.py").write_text(PROTOCOL, encoding="utf-8")
    (tmp_path / "work").mkdir()
    return tmp_path / "work"


def test_multirun_writes_predictions_and_one_table(root, folder):
    done = benchmark(root, folder, "-m", "method=kcs,sfam", "suite=turn", "hydra.sweep.dir=out")
    assert done.returncode == 0, done.stderr
    table = rows(folder / "out" / "results.csv")
    assert [(r["method"], r["case"]) for r in table] == [(m, c) for m in ("kcs", "sfam") for c in ("case_a", "case_b")]
    for row in table:
        assert row["suite"] == "turn" and row["frames"] == "30" and row["joints"] == "5" and not row["error"]
        assert float(row["ms_per_frame"]) == pytest.approx(1000 * float(row["seconds"]) / 30, rel=0.05, abs=0.01)
        assert not row["covered"]  # neither gives deviations
    for method in ("0_kcs", "1_sfam"):
        assert {p.name for p in (folder / "out" / method / "turn").iterdir()} == {"case_a.npz", "case_b.npz"}
        assert len(rows(folder / "out" / method / "results.csv")) == 2


def test_what_is_measured_again_in_its_folder_replaces_what_was(root, folder):
    for methods in ("kcs,rigid", "rigid"):  # the second run of rigid has another number, and a folder of its own
        done = benchmark(root, folder, "-m", f"method={methods}", "suite=turn", "hydra.sweep.dir=again")
        assert done.returncode == 0, done.stderr
    table = rows(folder / "again" / "results.csv")
    assert [(r["method"], r["case"]) for r in table] == [(m, c) for m in ("kcs", "rigid") for c in ("case_a", "case_b")]
    assert table[2:] == rows(folder / "again" / "0_rigid" / "results.csv") != rows(folder / "again/1_rigid/results.csv")


@pytest.mark.parametrize("failing", [False, True])
def test_runs_of_a_sweep_in_processes_of_their_own(root, folder, failing):
    pytest.importorskip("hydra_plugins.hydra_joblib_launcher")
    suite = "broken" if failing else "turn"
    done = benchmark(
        root, folder, f"suite={suite}", "-m", "method=kcs,rigid", "hydra/launcher=joblib", "hydra.sweep.dir=out"
    )
    assert done.returncode == failing and "Traceback" not in done.stderr, done.stderr
    assert ("1 case failed" in done.stderr) == failing
    assert [bool(row["error"]) for row in rows(folder / "out" / "results.csv")] == [failing, False] * 2


def test_a_stopped_run_keeps_what_it_has_and_goes_on(root, folder):
    """The second case stops the first run as Ctrl-C does; nothing of it is left half written."""
    stops = 'if case["src"] == "b" and not __import__("os").path.exists("went_on"): raise KeyboardInterrupt'
    text = PROTOCOL.replace("    t = np.linspace", f"    {stops}\n    t = np.linspace", 1)
    (folder.parent / "shared" / "protocol" / "protocol.py").write_text(text, encoding="utf-8")
    words = ("method=rigid", "suite=turn", "hydra.run.dir=out")
    stopped = benchmark(root, folder, *words)
    assert stopped.returncode == 1 and "keep=true goes on" in stopped.stderr and "Traceback" not in stopped.stderr
    first = rows(folder / "out" / "results.csv")
    assert [row["case"] for row in first] == ["case_a"]
    assert {path.name for path in (folder / "out" / "turn").iterdir()} == {"case_a.npz"}
    (folder / "went_on").touch()
    done = benchmark(root, folder, *words, "keep=true")
    assert done.returncode == 0 and done.stdout.count("was done, and is kept") == 1, done.stderr
    both = rows(folder / "out" / "results.csv")
    assert [row["case"] for row in both] == ["case_a", "case_b"] and both[0] == first[0]
    assert "2/2" in done.stdout
    prediction = (folder / "out" / "turn" / "case_a.npz").read_bytes()
    other = benchmark(root, folder, *words, "keep=true", "intrinsics=parallel")
    assert other.returncode == 0 and "is kept" not in other.stdout
    assert rows(folder / "out" / "results.csv") == both
    assert (folder / "out" / "turn" / "case_a.npz").read_bytes() == prediction
    assert [row["case"] for row in rows(folder / "out" / "1" / "results.csv")] == ["case_a", "case_b"]
    assert (folder / "out" / "1" / "turn" / "case_a.npz").is_file()


def test_a_sweep_that_is_extended_keeps_what_was_done_under_any_number(root, folder):
    words = ("-m", "method=rigid", "suite=turn", "case=case_a", "hydra.sweep.dir=out")
    assert benchmark(root, folder, *words, "method.num_steps=2,3").returncode == 0
    before = {path: path.read_bytes() for path in (folder / "out").glob("*/turn/*.npz")}
    done = benchmark(root, folder, *words, "method.num_steps=1,2,3", "keep=true")
    assert done.returncode == 0 and done.stdout.count("was done, and is kept") == 2, done.stderr
    assert len(before) == 2 and all(path.read_bytes() == text for path, text in before.items())
    steps = [re.search(r"num_steps=(\d)", row["options"])[1] for row in rows(folder / "out" / "results.csv")]
    assert sorted(steps) == ["1", "2", "3"]
    assert (folder / "out" / "0_rigid" / "1" / "turn" / "case_a.npz").is_file()


def test_a_run_that_is_stopped_between_cases_says_so(root, folder):
    (folder.parent / "shared" / "protocol" / "protocol.py").write_text("raise KeyboardInterrupt", encoding="utf-8")
    stopped = benchmark(root, folder, "method=rigid", "suite=turn")
    assert stopped.returncode == 130 and stopped.stderr.startswith("stopped: what was done is in the runs' folders")


def test_a_row_is_written_when_its_case_is_done(root, folder):
    """Whatever ends the process then, as a cluster that kills it."""
    text = PROTOCOL.replace(
        "    t = np.linspace", '    case["src"] == "b" and __import__("os")._exit(9)\n    t = np.linspace', 1
    )
    (folder.parent / "shared" / "protocol" / "protocol.py").write_text(text, encoding="utf-8")
    assert benchmark(root, folder, "method=rigid", "suite=turn", "hydra.run.dir=out").returncode == 9
    assert [row["case"] for row in rows(folder / "out" / "results.csv")] == ["case_a"]


def test_a_method_of_ones_own_has_its_own_name(root, folder):
    text = "import kcs_torch as kt\n\nclass Mine(kt.methods.Rigid):\n    name = 'mine'\n"
    (folder / "mine.py").write_text(text, encoding="utf-8")
    target = "method._target_=mine.Mine"
    alone = benchmark(root, folder, "suite=turn", target)
    assert alone.returncode == 2 and f"{target}: cannot be imported: No module named 'mine'" in alone.stderr
    assert "PYTHONPATH" in alone.stderr and "Traceback" not in alone.stderr
    other = benchmark(root, folder, "suite=turn", "method._target_=mine.Mien", path=folder)
    assert other.returncode == 2 and "mine.Mien: module 'mine' has no 'Mien': did you mean Mine?" in other.stderr
    done = benchmark(root, folder, "suite=turn", target, "hydra.run.dir=out", path=folder)
    assert done.returncode == 0, done.stderr
    assert {row["method"] for row in rows(folder / "out" / "results.csv")} == {"mine"}


def test_a_table_of_several_recipes(script):
    shared = {"suite": "turn", "method": "sfam", "cameras": "estimated", "intrinsics": "none", "error": ""}
    values = (("", "1"), ("", 3.0), ("", 0.0), ("beta=0", "7"), ("beta=1", 0.0))
    made = [shared | {"options": text, "rigid": value} for text, value in values]
    lines = script.table([*made, shared | {"options": "", "rigid": "", "error": "no"}], ("rigid",)).splitlines()
    expected = ["sfam 3/4 1.3333", "sfam beta=0 1/1 7.0000", "sfam beta=1 1/1 0.0000"]
    assert [" ".join(line.split()[1:]) for line in lines[1:]] == expected


def test_a_failing_case_is_a_row_and_an_exit_code(root, folder):
    done = benchmark(root, folder, "method=sfam", "suite=[broken]", "hydra.run.dir=out", "+method.beta=0.5")
    assert done.returncode == 1
    bad, good = rows(folder / "out" / "results.csv")
    assert bad["error"].startswith("ShapeError: ") and not bad["rigid"]
    assert good["rigid"] and not good["error"]
    assert good["options"] == "beta=0.5"


@pytest.fixture(scope="module")
def script(import_script):
    return import_script("benchmark")


def test_suites_and_cases_are_chosen_by_name_and_pattern(script, folder):
    protocol = script.load_protocol(folder.parent / "shared")
    names = lambda *choice: [(s, c["src"]) for s, c in script.chosen(protocol, *choice)]  # noqa: E731
    assert names("turn", "*") == [("turn", "a"), ("turn", "b")]
    assert names(["turn", "turn"], "*_a") == [("turn", "a")]
    assert names(["broken", "turn"], "*_a") == [("broken", "a"), ("turn", "a")]
    assert len(names("all", "*")) == 4


def test_wrong_choices(script, folder):
    with pytest.raises(OptionError, match="expected a folder with protocol"):
        script.load_protocol(folder / "nowhere")
    protocol = script.load_protocol(folder.parent / "shared")
    with pytest.raises(OptionError, match="turn, broken"):
        list(script.chosen(protocol, ["turn", "walks"], "*"))


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (["method=sfam", "+method.foo=3"], "error: unknown option of method 'sfam' 'foo': choices are "),
        (["method=sfam", "cameras=no"], "error: cameras: expected true or false, got 'no'"),
        (["method=sfam", "+method.beta=much"], "error: sfam: beta: expected a number, got 'much'"),
        (["suite=null"], "error: suite: expected all, a suite or a list of suites, got None"),
        (["paper=null"], "error: paper: expected its settings, such as paper.parts=all, got None"),
        (
            ["method._target_=kcs_torch.nn.SymmetryEnergy", "+method.skeleton=coco17"],
            "expected a kcs_torch.Method, got",
        ),
        (["paper.parts=growth", "paper.frames=few"], "error: paper.frames: expected a whole number within 100.."),
        (["intrinsics=1"], "error: intrinsics=1: expected null, true, auto or parallel"),
        (
            ["paper.parts=growth", "suite=turn"],
            "error: suite: the papers' tables do not read it: leave it out, or paper.parts",
        ),
        (["paper.parts=growth", "+method.beta=0"], "error: method: the papers' tables do not read it"),
        (["paper.parts=growth", "+paper.frame=100"], "error: unknown setting of paper 'frame': did you mean 'frames'"),
    ],
)
def test_wrong_settings_are_a_line(root, folder, words, told):
    done = benchmark(root, folder, *words)
    assert done.returncode == 2 and told in done.stderr and "Traceback" not in done.stderr


@pytest.mark.parametrize(
    ("script", "word", "meant"), [("benchmark", "+suit=a", "suite"), ("reconstruct_many", "+batsch=1", "batch")]
)
def test_settings_that_nothing_reads_are_told(root, folder, script, word, meant):
    """Of a name that it does not know Hydra says how to add it, and nothing would come of that."""
    command = [sys.executable, str(root / "scripts" / f"{script}.py"), word]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
    assert done.returncode == 2 and f"did you mean '{meant}'" in done.stderr and "Traceback" not in done.stderr


@pytest.mark.parametrize("name", ["benchmark", "reconstruct_many"])
def test_hydra_is_missed_in_one_line(root, folder, name):
    code = (
        "import runpy, sys; sys.modules['hydra'] = None\n"
        f"runpy.run_path({str(root / 'scripts' / name)!r} + '.py', run_name='__main__')"
    )
    done = subprocess.run([sys.executable, "-c", code], cwd=folder, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (1, "error: hydra is missing: pip install hydra-core\n")


def test_no_case_is_an_error(root, folder):
    done = benchmark(root, folder, "suite=turn", "case=x*")
    assert done.returncode == 2 and "error: case=x*: matches no case" in done.stderr


def test_real_case_with_its_lens(root, shared, tmp_path):
    words = ["method=kcs", "suite=real_openpose", "case=*camera1", f"shared={shared}", "hydra.run.dir=out"]
    plain, lens = benchmark(root, tmp_path, *words), benchmark(root, tmp_path, *words, "intrinsics=true")
    for done in (plain, lens):
        assert done.returncode == 0, done.stdout + done.stderr
    first, second = rows(tmp_path / "out" / "results.csv")
    assert (first["intrinsics"], second["intrinsics"]) == ("none", "true")
    assert float(second["pa"]) < float(first["pa"])
    wrong = benchmark(root, tmp_path, *words, "intrinsics=maybe")
    assert wrong.returncode == 2 and "expected null, true, auto or parallel" in wrong.stdout + wrong.stderr


def test_real_case_with_true_cameras(root, shared, tmp_path):
    words = ["method=sfam", "suite=akhter", "case=*pickup", f"shared={shared}", "cameras=true", "hydra.run.dir=out"]
    done = benchmark(root, tmp_path, *words)
    assert done.returncode == 0, done.stdout + done.stderr
    (row,) = rows(tmp_path / "out" / "results.csv")
    assert row["cameras"] == "true" and not row["covered"]
    assert float(row["e3d_world"]) == pytest.approx(float(row["e3d"]), rel=0.2)


def test_how_many_errors_deviations_cover(root, shared, tmp_path):
    words = ["method=pkc", "suite=real_openpose", "case=*camera1", f"shared={shared}", "hydra.run.dir=out"]
    done = benchmark(root, tmp_path, *words)
    assert done.returncode == 0, done.stdout + done.stderr
    (row,) = rows(tmp_path / "out" / "results.csv")
    assert f"covered {float(row['covered']):.4f}" in done.stdout
    assert 0.5 < float(row["covered"]) < 1  # of whatever size the tracks are
