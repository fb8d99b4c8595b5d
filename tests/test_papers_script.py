"""scripts/papers.py: tables of rows, the cases that they are measured on, and runs on a few frames."""

import csv
import math
import subprocess
import sys

import numpy as np
import pytest
import torch
from omegaconf import OmegaConf
from torch.testing import assert_close

from kcs_torch.errors import OptionError
from kcs_torch.functional.align import centre
from kcs_torch.methods import METHODS


@pytest.fixture(scope="module")
def papers(import_script):
    return import_script("papers")


@pytest.fixture(scope="module")
def kcs(import_script):
    return import_script("papers_kcs")


@pytest.fixture(scope="module")
def settings(papers, import_script, shared):
    bench = import_script("robustness").Bench(shared, 30, 1)
    return papers.Settings(bench, ("kcs", "sfam", "bmm"), paths=2, seeds=1, walks=1, frames=100)


ROWS = [
    {"setting": "a", "at": "x", "e3d": 0.25},
    {"setting": "a", "at": "x", "e3d": 0.75},
    {"setting": "a", "at": "y", "e3d": 1.5},
    {"setting": "b", "at": "y", "e3d": 12.0},
    {"setting": "printed", "at": None, "e3d": 3.0},
    {"setting": "other figure", "at": "z", "rigid": 3.0},
]


def test_means_of_a_setting_at_a_point(papers):
    top, mean = papers.pivot(ROWS, "e3d")
    assert top == ["x", "y"] and list(mean) == ["a", "b", "printed"]
    assert mean["a"] == [0.5, 1.5, 1.0]
    assert mean["b"][1] == 12 and math.isnan(mean["b"][0])
    assert mean["printed"][2] == 3 and math.isnan(mean["printed"][0])
    assert papers.pivot(ROWS, "rigid")[1] == {"other figure": [3.0, 3.0]}


def test_numbers_run_upwards(papers):
    rows = [{"setting": "a", "at": at, "e3d": 1.0} for at in (10, 2, 0)]
    assert papers.pivot(rows, "e3d")[0] == [0, 2, 10]


def test_table(papers):
    part = papers.Part("Title", "place", ("e3d", "bone_cv"), lambda _: iter(ROWS))
    assert papers.markdown(part, ROWS).splitlines() == [
        "## Title",
        "",
        "| `e3d` over place | x | y | mean |",
        "|---|---|---|---|",
        "| a | .5000 | 1.50 | 1.00 |",
        "| b | - | 12.00 | - |",
        "| printed | - | - | 3.00 |",
    ]


def test_growth_is_told_by_its_exponent(papers):
    rows = [{"setting": "cubic", "at": at, "seconds": 2e-6 * at**3} for at in (100, 200, 400)]
    part = papers.Part("Growth", "frames", ("seconds",), lambda _: iter(rows), log=True)
    assert papers.markdown(part, rows).rstrip().endswith("| 2.00 | 16.00 | 128.00 | 3.00 |")
    assert math.isnan(papers.slope([100.0], [1.0]))


def test_parts_are_chosen_by_name(papers):
    assert list(papers.chosen_parts("all")) == list(papers.parts())
    assert list(papers.chosen_parts(["walk35", "table2"])) == ["walk35", "table2"]
    with pytest.raises(OptionError, match=r"walk36: expected all or some of table2, .*walk35"):
        papers.chosen_parts(["table2", "walk36"])


def test_the_configuration_names_every_part(papers, root):
    text = (root / "configs" / "benchmark.yaml").read_text(encoding="utf-8")
    assert f"[{','.join(papers.parts())}]" in text


@pytest.mark.parametrize("seed", range(5))
def test_camera_paths_move_as_little_as_is_asked(kcs, seed):
    yaw, pitch = kcs.camera_path(50, seed)
    assert 0 <= pitch <= 20 and np.ptp(yaw) <= 20 and np.ptp(yaw) > 1
    assert np.abs(np.diff(yaw)).max() < 2  # slowly
    assert np.array_equal(yaw, kcs.camera_path(50, seed)[0])
    assert abs(yaw[0] - kcs.camera_path(50, seed + 1)[0][0]) > 1e-3
    assert np.ptp(kcs.camera_path(50, seed, 0.0)[0]) == 0


def test_mean_pose_is_free_of_turns(kcs):
    chance = torch.Generator().manual_seed(0)
    pose = torch.randn(9, 3, generator=chance, dtype=torch.float64)
    turns = torch.linalg.qr(torch.randn(20, 3, 3, generator=chance, dtype=torch.float64)).Q
    turns = turns * torch.linalg.det(turns)[:, None, None]
    walk = kcs.Walk((pose @ turns + 5).numpy(), np.array(["hip", "neck", "spine"] * 3), np.zeros((0, 2), int), 30.0)
    mean = torch.tensor(kcs.mean_pose([walk]), dtype=torch.float64)
    assert_close(torch.cdist(mean, mean), torch.cdist(pose, pose))
    assert_close(torch.linalg.det(mean[:3]).sign(), torch.linalg.det(centre(pose)[0][:3]).sign())  # no mirror image


@pytest.mark.parametrize("joints", [14, 17, 21])
def test_walks_have_the_joints_and_bones_that_are_asked_for(kcs, settings, joints):
    walk = kcs.load_walk(settings, "35_01", joints)
    assert walk.points.shape[1:] == (joints, 3) and len(walk.names) == joints and walk.fps == 30
    start, end = walk.points[:, walk.edges[:, 0]], walk.points[:, walk.edges[:, 1]]
    lengths = np.linalg.norm(start - end, axis=-1)
    limbs = lengths[:, lengths.mean(0) > 150]
    assert len(walk.edges) == joints - 1 and (limbs.std(0) < 0.05 * limbs.mean(0)).all()
    tracks, truth = walk.seen(settings.bench.protocol, np.zeros(len(walk.points)), 10.0)
    assert tracks.skeleton.num_observed == joints
    assert_close(tracks.points[:, :joints], torch.from_numpy(truth[..., :2]))


def test_sides_are_told_from_the_way_a_person_walks(kcs, settings):
    rows = list(kcs.sides(settings))
    assert {row["at"] for row in rows} == {0, 15, 30, 45, 60, 75, 90}
    error = {(row["setting"], row["at"]): row["rigid"] for row in rows}
    for setting in {row["setting"] for row in rows}:
        assert error[setting, 90] < error[setting, 0]  # legs that swing in the image are seen


@pytest.mark.filterwarnings("ignore::kcs_torch.errors.KcsWarning")
@pytest.mark.parametrize("name", ["noise", "lengths", "variation", "walk35", "joints"])
def test_parts_yield_finite_figures(papers, settings, name):
    part = papers.parts()[name]
    rows = list(part.run(settings))
    for figure in part.figures:
        values = [row[figure] for row in rows if figure in row]
        assert values and np.isfinite(values).all() and min(values) >= 0
    assert len(papers.markdown(part, rows).splitlines()) > 5


@pytest.mark.parametrize("log", [False, True])
def test_plots_over_names_are_points_with_plain_numbers(papers, tmp_path, monkeypatch, log):
    """A bar on a logarithmic axis begins wherever the axis does, so that its height tells nothing."""
    from matplotlib import pyplot as plt

    made = []
    monkeypatch.setattr(plt, "close", made.append)
    at = [10, 100] if log else ["x", "y"]
    rows = [{"setting": name, "at": at[i], "e3d": 30.0 * (i + 1)} for name in "ab" for i in range(2)]
    papers.plot(papers.Part("title", "at", ("e3d",), None, log=log), rows, tmp_path / "plot.png")
    (axes,) = made[0].axes
    assert not axes.patches and [list(line.get_ydata()) for line in axes.lines] == [[30.0, 60.0]] * 2
    labels = [label.get_text() for label in axes.get_yticklabels(which="both")]
    assert any(labels) and not any("10^" in label for label in labels)
    monkeypatch.undo()
    plt.close(made[0])


def test_no_plot_is_half_written(papers, tmp_path, monkeypatch):
    def fail(figure, path, **options):
        path.write_bytes(b"half")
        raise RuntimeError("no space")

    monkeypatch.setattr("matplotlib.figure.Figure.savefig", fail)
    rows = [{"setting": "a", "at": 1, "e3d": 1.0}]
    with pytest.raises(RuntimeError, match="no space"):
        papers.plot(papers.Part("title", "at", ("e3d",), None), rows, tmp_path / "plot.png")
    assert not list(tmp_path.iterdir())


def test_tables_that_are_stopped_say_where_they_are(papers, import_script, shared, tmp_path, monkeypatch):
    def stop(*_):
        raise KeyboardInterrupt

    script = import_script("benchmark")
    monkeypatch.setattr("papers.make", stop)
    paper = OmegaConf.create({"parts": "all", "methods": "all", "clip": 30, "sequences": 1})
    with pytest.raises(SystemExit, match=f"stopped: tables of the parts that were done are in {tmp_path}"):
        script.make_papers(paper, shared, tmp_path)


def test_one_command_writes_rows_tables_and_plots(root, shared, tmp_path):
    words = ["paper.parts=[rounds,growth]", "paper.walks=1", "paper.frames=100", "paper.methods=[kcs]"]
    command = [sys.executable, str(root / "scripts" / "benchmark.py"), *words, f"shared={shared}", "hydra.run.dir=out"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    out = tmp_path / "out"
    text = (out / "tables.md").read_text(encoding="utf-8")
    assert text.count("## KCS, figure") == 2 and text in done.stdout
    for name in ("rounds", "growth"):
        assert (out / f"{name}.png").read_bytes().startswith(b"\x89PNG")
        with (out / f"{name}.csv").open(newline="", encoding="utf-8") as file:
            assert all(row["setting"] and row["at"] for row in csv.DictReader(file))


def test_unknown_methods_are_named(import_script, tmp_path):
    paper = {"parts": "all", "methods": ["kcs", "sfm"], "clip": 30, "sequences": 1}
    with pytest.raises(OptionError, match=f"sfm: expected all or some of {', '.join(METHODS)}"):
        import_script("benchmark").make_papers(OmegaConf.create(paper), tmp_path, tmp_path)
