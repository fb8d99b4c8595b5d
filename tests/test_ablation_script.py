"""scripts/ablation.py: every ingredient is really off, and on again; a run on a few frames."""

import csv
import warnings
from dataclasses import replace

import numpy as np
import pytest
import torch

import kcs_torch as kt
from kcs_torch.data import walking_person


@pytest.fixture(scope="module")
def script(import_script):
    return import_script("ablation")


@pytest.fixture(scope="module")
def clips(script):
    """Walks, with noise, in slow motion, before a camera that goes round and with arms spread; a tree in motion."""
    noisy = walking_person(18, yaw=0, turn=0, noise=15, generator=torch.Generator().manual_seed(0)).tracks
    slow = replace(walking_person(20, fps=150, yaw=0, turn=0).tracks, fps=30)
    round_ = walking_person(24, yaw=0, turn=270).tracks
    spread = arms_spread(20)
    tree = next(iter(script.synthetic("tree", 24)))[1]
    return {"fixed": [noisy, slow, round_, spread], "moving": [tree]}


def arms_spread(frames):
    """A walk seen from the side, arms stretched out to both sides: towards the camera and away from it."""
    clip = walking_person(frames, yaw=75, turn=0)
    points, joints = clip.points.clone(), clip.tracks.skeleton.joints
    for side, sign in (("left", 1), ("right", -1)):
        shoulder, elbow, wrist = (joints.index(f"{side}_{part}") for part in ("shoulder", "elbow", "wrist"))
        across = points[:, joints.index("left_shoulder")] - points[:, joints.index("right_shoulder")]
        points[:, elbow] = points[:, shoulder] + 0.8 * sign * across
        points[:, wrist] = points[:, elbow] + 0.7 * sign * across
    return replace(clip.tracks, points=points[..., :2])


def lifted(variant, tracks):
    with variant.method() as method, warnings.catch_warnings():
        warnings.simplefilter("ignore", kt.KcsWarning)
        return method(tracks)


def same(one, other):
    """Whether both were found in as many steps, are alike to the last digit and cost the same."""
    alike = one.diagnostics.iterations == other.diagnostics.iterations and torch.equal(one.points, other.points)
    return alike and one.objective == other.objective


def test_a_variant_lasts_as_long_as_its_context(script):
    for name, variant in (pair for part in script.VARIANTS.values() for pair in part.items()):
        before = [getattr(owner, attribute) for owner, attribute, _ in variant.changes]
        with pytest.raises(RuntimeError), variant.method() as method:
            during = [getattr(owner, attribute) for owner, attribute, _ in variant.changes]
            assert all(a is not b for a, b in zip(before, during, strict=True)), name
            assert name == script.EVERYTHING or during or method != kt.PKC()
            raise RuntimeError
        after = [getattr(owner, attribute) for owner, attribute, _ in variant.changes]
        assert all(a is b for a, b in zip(before, after, strict=True)), name


@pytest.mark.parametrize("part", ["fixed", "moving"])
def test_every_ingredient_counts(script, clips, part):
    """A switch that reaches nothing, as its name has changed in the code, would leave every solution as it is."""
    usual = [lifted(script.VARIANTS[part][script.EVERYTHING], tracks) for tracks in clips[part]]
    for name, variant in script.VARIANTS[part].items():
        if name != script.EVERYTHING:
            others = (lifted(variant, tracks) for tracks in clips[part])
            assert not all(same(*pair) for pair in zip(others, usual, strict=True)), name


def test_a_term_that_does_not_exist_cannot_be_switched_off(script, clips):
    with pytest.raises(KeyError, match="friction"):
        lifted(script.without("friction"), clips["fixed"][0])


def test_figures_are_the_protocols(script, shared, protocol):
    ((_, tracks, truth),) = script.recorded(shared, "static_walk", 1, 20)
    assert tracks.num_frames == 20
    bent = truth + 30 * torch.randn(truth.shape, generator=torch.Generator().manual_seed(0), dtype=truth.dtype)
    for points in (bent, bent * torch.tensor([1.0, 1.0, -1.0])):
        expected = protocol.score(points.numpy(), truth.numpy(), None)
        assert script.rigid_error(points, truth) == pytest.approx(expected["rigid"], rel=1e-6)
        assert script.e3d(points, truth) == pytest.approx(expected["e3d"], rel=1e-6)


def test_suites_of_another_part_are_told(script, capsys):
    with pytest.raises(SystemExit):
        script.main(["--suites", "arm", "--parts", "fixed"])
    assert "--parts fixed: has none of the suites arm" in capsys.readouterr().err


@pytest.mark.parametrize("name", ["cases", "frames"])
def test_less_than_one_is_told(script, name, capsys):
    with pytest.raises(SystemExit):
        script.main([f"--{name}", "-3"])
    assert f"--{name}: expected at least 1, got -3" in capsys.readouterr().err


def test_parts_that_are_done_are_written(script, tmp_path, monkeypatch):
    """A later one that fails takes nothing along."""

    def measure(part, *_):
        return [{"part": part, "error": 1.0}] if part == "fixed" else 1 / 0

    monkeypatch.setattr(script, "measure", measure)
    with pytest.raises(ZeroDivisionError):
        script.main(["--suites", "walk", "arm", "--csv", str(tmp_path / "runs.csv")])
    assert (tmp_path / "runs.csv").read_text().split() == ["part,error", "fixed,1.0"]


@pytest.mark.parametrize(
    ("part", "suite", "variant"),
    [("fixed", "walk", "no discrete moves"), ("moving", "tree", "SfAM's guess as the only start")],
)
def test_script(script, part, suite, variant, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(script, "YAWS", (0.0, 90.0))  # fewer clips
    path = tmp_path / "made" / "runs.csv"
    script.main(["--suites", suite, "--frames", "12", "--variants", variant, "--csv", str(path)])
    title, head, line, *rows = filter(None, capsys.readouterr().out.splitlines())
    assert title == part and head == f"| | {suite} | ms a frame |" and set(line) == {"|", "-"}
    with path.open(newline="", encoding="utf-8") as file:
        runs = list(csv.DictReader(file))
    assert len(runs) == 2 * len(script.YAWS)
    for shown, name in zip(rows, (script.EVERYTHING, variant), strict=True):
        cells = [cell.strip() for cell in shown.strip("|").split("|")]
        errors = [float(run["error"]) for run in runs if run["variant"] == name]
        assert cells[0] == name and float(cells[1]) == pytest.approx(np.mean(errors), abs=0.051)
        assert 0 < float(cells[1]) < 100 and float(cells[2]) > 0


def test_without_coarse_stages_a_clip_of_more_frames_than_are_compared_is_solved(script):
    tree = next(iter(script.synthetic("tree", 104)))[1]
    assert lifted(script.MOVING_VARIANTS["no coarse stages"], tree).points.isfinite().all()
