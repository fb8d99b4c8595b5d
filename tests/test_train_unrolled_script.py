"""scripts/train_unrolled.py and scripts/unrolled_memory.py: small runs, and who is trained and who is tested on."""

import argparse
import math
import sys

import numpy as np
import pytest
import torch

import kcs_torch as kt

BONES = [[0, 1], [1, 2], [2, 3]]


@pytest.fixture(scope="module")
def scripts(import_script):
    return import_script("train_unrolled"), import_script("unrolled_memory")


def rows(text):
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in text.splitlines() if line.startswith("|")]


@pytest.mark.parametrize("solver", ["sfam", "pkc", "kcs", "fpc"])
def test_a_small_run_prints_its_table(scripts, solver, monkeypatch, capsys, tmp_path):
    arguments = f"--solver {solver} --data synthetic --rounds 2 --batch 2 --test 2 --frames 8 --steps 2 --many 3"
    monkeypatch.setattr(sys, "argv", ["train_unrolled.py", *arguments.split(), "--save", str(tmp_path / "solver.pt")])
    scripts[0].main()
    table = rows(capsys.readouterr().out)
    names = [row[0] for row in table[2:]]
    assert names[:2] == ["untrained", "untrained"] and names[-1] == "trained"
    assert [row[1] for row in table[2:4]] == ["2", "3"] and table[-1][1] == "2"
    assert all(float(row[2]) > 0 for row in table[2:])
    state = torch.load(tmp_path / "solver.pt", weights_only=True)
    assert state and all(bool(x.isfinite().all()) for x in state.values())


def test_what_is_fixed_is_not_learned(scripts, monkeypatch, capsys, tmp_path):
    arguments = "--data synthetic --rounds 1 --batch 2 --test 2 --frames 8 --steps 2 --many 2 --fix"
    arguments = arguments.split()
    monkeypatch.setattr(sys, "argv", ["train_unrolled.py", *arguments, "corner", "--save", str(tmp_path / "solver.pt")])
    scripts[0].main()
    assert "(threshold, step, stiffness, length)" in capsys.readouterr().out
    state, fresh = torch.load(tmp_path / "solver.pt", weights_only=True), kt.nn.UnrolledSfAM("h36m17", 2).state_dict()
    assert torch.equal(state["raw_corner"], fresh["raw_corner"])
    assert not torch.equal(state["raw_step"], fresh["raw_step"])
    monkeypatch.setattr(sys, "argv", ["train_unrolled.py", *arguments, "eps"])
    with pytest.raises(SystemExit, match=r"--fix eps: sfam learns .*corner"):
        scripts[0].main()


def test_windows_that_no_clip_has_are_told(scripts, monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["train_unrolled.py", "--data", "synthetic", "--frames", "1000"])
    with pytest.raises(SystemExit, match="2"):
        scripts[0].main()
    assert "--frames: expected at most 240, as the clips have, got 1000" in capsys.readouterr().err


def test_training_lowers_the_error_of_others(scripts):
    script = scripts[0]
    options = argparse.Namespace(
        frames=20, turn=(60.0, 180.0), noise=2.0, missing=0.0, rounds=25, batch=4, lr=0.1, seed=0, verbose=False
    )
    skeleton, clips = script.motions("synthetic", tested=False)
    film, others = script.Film(clips, options), script.Film(script.motions("synthetic", tested=True)[1], options)
    held_out = [others.batch(8, torch.Generator().manual_seed(5))]
    layer = script.build("sfam", skeleton, 4, trained=True, corner=math.inf)  # the norm that leaves most to learn
    before = script.score(layer, held_out)[0].mean()
    script.train(layer, film, options)
    assert script.score(layer, held_out)[0].mean() < 0.85 * before


def test_nobody_is_trained_and_tested_on(scripts, tmp_path):
    for subject in ("01", "35", "02", "86"):
        points = np.full((12, 4, 3), float(subject)) + np.arange(4)[:, None]
        np.savez(tmp_path / f"cmu_{subject}_01.npz", points3d=points, edges=BONES, fps=30.0, units="mm")
    np.savez(tmp_path / "cmu_walk.npz", points3d=np.zeros((12, 4, 3)), edges=BONES, fps=30.0, units="mm")  # of whom?
    people = [{float(x[0, 0, 0]) for x in scripts[0].motions(str(tmp_path), tested)[1]} for tested in (False, True)]
    assert people == [{1.0, 86.0}, {2.0, 35.0}]
    with pytest.raises(SystemExit, match="no motion files"):
        scripts[0].motions(str(tmp_path / "none"), False)


def test_truth_is_what_the_cameras_saw(scripts):
    options = argparse.Namespace(frames=15, turn=(60.0, 90.0), noise=0.0, missing=0.2)
    film = scripts[0].Film(scripts[0].motions("synthetic", tested=False)[1], options)
    tracks, cameras, weights, truth = film.batch(3, torch.Generator().manual_seed(0))
    flat = truth @ cameras.mT
    assert torch.allclose(flat, tracks - tracks.mean(-2, keepdim=True))
    assert 0.6 < weights.mean() < 0.95
    turn = kt.functional.viewpoint_turn(cameras)
    assert ((turn > 50) & (turn < 95)).all()


def test_memory_is_counted_for_each_gradient(scripts, monkeypatch, capsys):
    arguments = "--solvers fpc --steps 3 30 --frames 8"
    monkeypatch.setattr(sys, "argv", ["unrolled_memory.py", *arguments.split()])
    scripts[1].main()
    table = rows(capsys.readouterr().out)[2:]
    assert [row[1] for row in table] == ["unrolled", "grad_steps=5", "implicit"]
    clip = kt.data.walking_person(8, skeleton="h36m17", turn=120.0)
    size = [scripts[1].measure(kt.nn.UnrolledFPC(n), clip.tracks.points, clip.cameras)[0] for n in (3, 30)]
    assert size[1] > 5 * size[0]
