"""Full perspective in files and on the command line."""

import csv
import json
from dataclasses import dataclass, replace

import numpy as np
import pytest
import torch
from near_cameras import LENS, error, filmed, quietly
from typer.testing import CliRunner

import kcs_torch as kt
from kcs_torch.cli import app
from kcs_torch.io import load_reconstruction
from kcs_torch.methods.answer.root import ABSENT, FOUND
from kcs_torch.methods.perspective import calibrated
from kcs_torch.types import Intrinsics


def test_files_keep_the_distance(tmp_path):
    tracks, _ = filmed(frames=10)
    result = quietly(tracks, method="kcs", intrinsics=LENS)
    back = load_reconstruction(result.save(tmp_path / "a.npz"))
    assert torch.equal(back.distance, result.distance) and torch.equal(back.root_depth, result.root_depth)
    assert torch.equal(back.in_space(), result.in_space())
    told = json.loads(result.save(tmp_path / "a.json").read_text(encoding="utf-8"))
    assert told["distance"] == pytest.approx(result.distance.tolist())
    with result.save(tmp_path / "a.csv").open(encoding="utf-8", newline="") as file:
        rows = list(csv.reader(file))
    assert rows[0][-1] == "distance [px]"
    assert [float(row[-1]) for row in rows[1:]] == pytest.approx(result.distance.tolist())


def test_scaled_scales_the_distance():
    result = quietly(filmed(frames=5)[0], method="kcs", intrinsics=LENS)
    torch.testing.assert_close(result.scaled(units="m", factor=2.0).distance, 2 * result.distance)


def test_command_line(tmp_path):
    tracks, _ = filmed(frames=10)
    source, output = tmp_path / "tracks.npz", tmp_path / "out.npz"
    body = tracks.skeleton
    np.savez(source, points2d=tracks.points.numpy(), joint_names=np.array(body.joints), fps=30.0)
    words = ["lift", str(source), "-o", str(output), "--method", "kcs", "--skeleton", "h36m17"]
    done = CliRunner().invoke(app, [*words, "--intrinsics", "1500,1480,960,540"])
    assert done.exit_code == 0, done.output
    wanted = quietly(tracks, method="kcs", intrinsics=LENS)
    torch.testing.assert_close(load_reconstruction(output).distance, wanted.distance)
    for wrong in ("1500", "a,b,c,d", "-1,1,0,0", "nan,1,0,0", ""):
        done = CliRunner().invoke(app, [*words, "--intrinsics", wrong])
        assert done.exit_code == 2
        assert "--intrinsics: expected FX,FY,CX,CY" in done.output


@dataclass(frozen=True)
class Noted(kt.KCS):
    """KCS with a note on the tracks, and a solution beside it that has another one."""

    def solve(self, tracks, cameras):
        found = replace(super().solve(tracks, cameras), notes=("tracks smoothed",))
        return replace(
            found, alternatives=(replace(found, points=-found.points, notes=("the mirror image in depth",)),)
        )


@pytest.mark.filterwarnings("ignore::kcs_torch.KcsWarning")
def test_what_was_done_to_the_tracks_is_told_whichever_solution_wins(monkeypatch):
    """The method's notes on the tracks are the best solution's, although it was an alternative; its own are of none."""
    real = calibrated.refine

    def others_first(*arguments, **options):
        found = real(*arguments, **options)
        return replace(found, bodies=found.bodies[torch.arange(len(found.bodies.energy)).flip(0)])

    clip = kt.data.walking_person(20, skeleton="coco17", turn=0.0, yaw=50.0)
    lens = Intrinsics.of((1500.0, 1500.0, 0.0, 0.0))
    image = lens.project(clip.points + clip.points.new_tensor([0.0, 0.0, 3000.0]))
    tracks = kt.Tracks.from_arrays(image[:, :17], skeleton="coco17", fps=30.0)
    for order in (real, others_first):
        monkeypatch.setattr(calibrated, "refine", order)
        found = kt.reconstruct(tracks, method=Noted(), intrinsics=lens)
        assert "tracks smoothed" in found.diagnostics.notes
        assert not any("mirror image" in note for one in (found, *found.alternatives) for note in one.diagnostics.notes)


@pytest.mark.filterwarnings("ignore::kcs_torch.KcsWarning")
def test_nothing_is_said_of_the_root_depth_that_the_distance_replaces():
    """Whether feet stand still, hardly ever do, or are none."""
    walk = kt.data.walking_person(30, turn=0.0)
    sway = 30.0 * torch.sin(torch.arange(30) / 8.0)[:, None, None] * torch.linspace(-1, 1, 17)[:, None].double()
    feet = torch.zeros(17, 1).double()
    feet[list(walk.skeleton.contacts)] = 1
    stands = walk.points[:1] + sway * (1 - feet)
    bare = replace(walk.skeleton, contacts=())
    for points, skeleton, remark in ((stands, walk.skeleton, FOUND), (walk.points, bare, ABSENT)):
        scene = points + points.new_tensor([0.0, 0.0, 4000.0])
        tracks = kt.Tracks.from_arrays(Intrinsics.of(LENS).project(scene), skeleton=skeleton, fps=30.0)
        plain, found = kt.PKC()(tracks), kt.reconstruct(tracks, intrinsics=LENS)
        assert any(note.startswith(remark) for note in plain.diagnostics.notes)  # what there is to leave out
        for one in (found, *found.alternatives):
            assert not any(note.startswith((ABSENT, FOUND)) for note in one.diagnostics.notes)
            torch.testing.assert_close(one.root_depth, one.distance - one.distance[0])


def test_bodies_without_a_template_are_lifted_softly_first(monkeypatch):
    """Along the rays of wrong depths no bone keeps its length: a method that insists on it goes astray."""
    tracks, truth = filmed(nearest=2500.0, turn=180.0, frames=60)
    body = replace(tracks.skeleton, name="free", template=None, proportions=None, spread=None, hinges=())
    tracks = replace(tracks, skeleton=body)
    off = error(quietly(tracks, intrinsics=LENS).observed, truth)
    monkeypatch.setattr(calibrated, "SOFT", 0)
    assert off < 20 < error(quietly(tracks, intrinsics=LENS).observed, truth) / 2, off
