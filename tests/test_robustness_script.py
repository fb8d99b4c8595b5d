"""scripts/robustness.py: what it disturbs, by how much, and a run on a few frames."""

import csv
import math

import numpy as np
import pytest
import torch
from torch.testing import assert_close

from kcs_torch.data import walking_person
from kcs_torch.functional import bone_lengths, bone_vectors, project
from kcs_torch.functional.align import centre
from kcs_torch.skeleton import SKELETONS


@pytest.fixture(scope="module")
def script(import_script):
    return import_script("robustness")


@pytest.mark.parametrize(("share", "degrees"), [(0.0, 0.0), (0.3, 0.0), (0.0, 20.0), (0.1, 10.0)])
def test_templates_are_off_by_what_is_asked(script, share, degrees):
    body = SKELETONS["h36m17"]
    true = bone_vectors(body.template_points(dtype=torch.float64), body.bones)
    got = bone_vectors(script.perturbed(body, share, math.radians(degrees), script.generator(1)), body.bones)
    ratio = got.norm(dim=-1) / true.norm(dim=-1)
    assert (ratio - 1).abs().max() <= share + 1e-9 and (share == 0 or ratio.std() > 0.3 * share)
    cosine = (got * true).sum(-1) / (got.norm(dim=-1) * true.norm(dim=-1))
    assert_close(cosine, torch.full_like(cosine, math.cos(math.radians(degrees))))


def test_tracks_at_other_places_keep_everything_else(script):
    tracks = walking_person(9, skeleton="coco17", missing=0.2, generator=script.generator(0)).tracks
    moved = script.replace_points(tracks, tracks.points + 3)
    assert moved.skeleton == tracks.skeleton and moved.fps == tracks.fps and moved.units == tracks.units
    assert torch.equal(moved.weights, tracks.weights)
    assert_close(moved.points[tracks.seen], tracks.points[tracks.seen] + 3)


@pytest.mark.parametrize("curve", ["lines", "monotone cubics", "splines"])
def test_curves_go_through_what_is_seen_and_hold_the_ends(script, curve):
    points = np.arange(7.0)[:, None, None] * np.ones((7, 2, 3))
    seen = np.array([[0, 1], [1, 1], [1, 1], [0, 1], [0, 1], [1, 1], [0, 1]], dtype=bool)
    got = script.filled(points, seen, script.CURVES[curve])
    assert np.array_equal(got[seen], points[seen]) and np.array_equal(got[:, 1], points[:, 1])
    assert np.allclose(got[:, 0, 0], [1, 1, 2, 3, 4, 5, 5])


@pytest.mark.parametrize("curve", ["lines", "monotone cubics", "splines"])
def test_curves_hold_what_is_hardly_seen(script, curve):
    points = np.arange(1.0, 5)[:, None, None] * np.ones((4, 3, 3))
    seen = np.array([[0, 0, 1], [1, 0, 0], [0, 0, 1], [0, 0, 1]], dtype=bool)
    got = script.filled(points, seen, script.CURVES[curve])
    assert np.array_equal(got[:, 0], np.full((4, 3), 2.0)) and not got[:, 1].any()
    assert np.array_equal(got[seen], points[seen])


def test_parts_that_are_done_are_written(script, tmp_path, monkeypatch):
    """A later one that fails takes nothing along."""
    run = {"setting": "none", "case": "walk", "seed": 0} | dict.fromkeys(script.FIGURES, 1.0)
    monkeypatch.setattr(script, "Bench", lambda *_: None)
    monkeypatch.setitem(script.PARTS, "noise", lambda _: [run])
    monkeypatch.setitem(script.PARTS, "short", lambda _: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        script.main(["--parts", "noise", "short", "--csv", str(tmp_path / "runs.csv")])
    assert (tmp_path / "runs.csv").read_text().splitlines()[1] == "noise,none,walk,0,1.0,1.0,1.0"


def test_without_the_data_it_says_what_it_needs(script, tmp_path):
    with pytest.raises(SystemExit, match="expected a folder with protocol"):
        script.main(["--shared", str(tmp_path)])


@pytest.mark.parametrize("name", ["seeds", "frames", "sequences"])
def test_counts_are_at_least_one(script, name, capsys):
    with pytest.raises(SystemExit):
        script.main([f"--{name}", "0"])
    assert f"argument --{name}: expected at least 1, got 0" in capsys.readouterr().err


def test_true_lengths_and_cameras_are_those_of_the_case(script, shared):
    bench = script.Bench(shared, frames=30, sequences=1)
    ((label, tracks, truth),) = bench.orbits()
    assert label == "cmu_02_01_yaw45_orbit180" and tracks.num_frames == 30
    points = torch.from_numpy(truth["points3d"])
    size = bone_lengths(points, tracks.skeleton.bones)
    rigid = size.std(0) < 1e-2 * size.mean(0)
    assert rigid.sum() > 10
    assert_close(script.true_lengths(tracks, truth)[rigid], size[0][rigid], rtol=1e-2, atol=0)
    source = bench.protocol.load(bench.data, "cmu/cmu_02_01")["points3d"].astype(float)
    world = torch.from_numpy(source[::4][:30, bench.protocol.CMU17])
    seen = project(world, bench.orbit_cameras(30))
    assert_close(centre(seen)[0], centre(tracks.points)[0], rtol=0, atol=1e-3)


def test_a_few_frames_are_those_of_the_motion(script, shared):
    bench = script.Bench(shared, frames=30, sequences=1)
    assert bench.few("fly/df3d_fly", 16, 0.2, 60, 0) is None  # it has 15
    label, tracks, truth = bench.few("cmu/cmu_35_01", 10, 0.5, 90, 0)
    assert label == "cmu/cmu_35_01 from 0.5, orbit 90" and tracks.num_frames == 10 and not tracks.skeleton.template
    source = bench.protocol.load(bench.data, "cmu/cmu_35_01")["points3d"].astype(float)[::4]
    first = int(0.5 * (len(source) - 10))
    world = torch.from_numpy(source[first : first + 10, bench.protocol.CMU17])
    size = bone_lengths(world, tracks.skeleton.bone_index())
    assert_close(bone_lengths(torch.from_numpy(truth["points3d"]), tracks.skeleton.bone_index()), size)
    assert_close(tracks.points, torch.from_numpy(truth["points3d"][..., :2]))


def test_script(script, shared, tmp_path, capsys, monkeypatch):
    table = tmp_path / "made" / "runs.csv"
    usual = ["--sequences", "1", "--seeds", "2", "--shared", str(shared), "--csv", str(table)]
    monkeypatch.setattr(script, "FEW", (6,))
    script.main([*usual, "--frames", "40"])
    shown = capsys.readouterr().out
    with table.open(newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert list(dict.fromkeys(row["part"] for row in rows)) == list(script.PARTS)
    assert all(row["setting"] in shown and float(row["rigid"]) > 0 for row in rows)
    counts = {part: sum(row["part"] == part for row in rows) for part in script.PARTS}
    assert counts == {
        "lengths": 2 + 4 * 2,
        "variation": 2,
        "noise": 4 * (1 + 4 * 2),
        "template": 4 * (2 + 5 * 2),
        "missing": 1 + 3 * 4,
        "short": 2 * 3 * 3,
    }
    short = lambda kind: [float(row["e3d"]) for row in rows if row["setting"] == f"{kind}, 6 frames"]  # noqa: E731
    assert max(short("PKC")) < 0.4 * min(short("flat guess"))
    own, free = (row for row in rows if row["part"] == "variation")
    bones = [key for key in own if key.startswith("variation of ")]
    middle = [np.median([float(row[bone]) for bone in bones]) for row in (own, free)]
    assert middle[0] < middle[1]  # the articulated term keeps lengths more constant
