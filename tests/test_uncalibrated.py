"""The focal length that nobody knows: found from the tracks, or told to make no difference."""

import math
import warnings
from dataclasses import replace

import numpy as np
import pytest
import torch
from typer.testing import CliRunner

import kcs_torch as kt
from kcs_torch.cli import app
from kcs_torch.io import load_reconstruction
from kcs_torch.methods import uncalibrated
from kcs_torch.methods.uncalibrated import DISTANCES
from kcs_torch.types import Intrinsics

LENS = Intrinsics(1500.0, 1500.0, 960.0, 540.0)


def filmed(distance, frames=45, yaw=60.0):
    """Tracks in px of a person who walks so many mm before the camera, and the true points."""
    clip = kt.data.walking_person(frames, turn=0.0, yaw=yaw)
    points = clip.points + clip.points.new_tensor([0.0, 0.0, distance])
    return kt.Tracks.from_arrays(LENS.project(points), skeleton=clip.skeleton, fps=30.0), clip.points


def error(result, truth):
    a, b = (x - x.mean(1, keepdim=True) for x in (result.points, truth))
    a = a @ kt.functional.nearest_rotation((a.mT @ b).mT).mT
    return float((a * ((a * b).sum() / (a * a).sum()) - b).norm(dim=-1).mean())


def test_a_near_camera_is_found():
    tracks, truth = filmed(3500.0)
    found = kt.reconstruct(tracks, intrinsics="auto")
    focal = float(found.distance.log().mean().exp())  # the unit is a pixel there
    assert 0.6 < focal / LENS.focal < 1.6
    assert any(f"focal length of {focal:.0f} px found from the tracks" in note for note in found.diagnostics.notes)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", kt.KcsWarning)
        plain = kt.reconstruct(tracks)
    assert error(found, truth) < 0.6 * error(plain, truth)


def test_parallel_rays_are_left_as_they_are():
    """Whatever the method, it is PKC that judges."""
    tracks = kt.data.walking_person(30, turn=0.0, yaw=60.0).tracks
    found, plain = (kt.reconstruct(tracks, method="kcs", intrinsics=lens) for lens in ("auto", None))
    assert torch.equal(found.points, plain.points) and found.distance is None and found.method == "kcs"
    assert "no perspective found in the tracks: rays taken to be parallel" in found.diagnostics.notes


@pytest.fixture
def quick(monkeypatch):
    """Perspective that costs nothing, least for a body 4.5 units away; and what it was asked for."""
    asked = []

    def solved(method, tracks, lens, cameras=None):
        asked.append((method.name, lens.focal))
        made = kt.KCS()(tracks)
        unit = uncalibrated._seen(tracks)[1]
        return replace(made, method=method.name, objective=100 * math.log(lens.focal / unit / 4.5) ** 2)

    monkeypatch.setattr(uncalibrated, "reconstruct_perspective", solved)
    return asked


@pytest.mark.filterwarnings("ignore::kcs_torch.KcsWarning")
@pytest.mark.parametrize("method", ["kcs", "pkc"])
def test_pkc_judges_and_the_method_solves(quick, method):
    tracks, _ = filmed(3500.0, 12)
    found = kt.reconstruct(tracks, method=method, intrinsics="auto")
    unit = uncalibrated._seen(tracks)[1]
    assert found.method == method and found.objective == pytest.approx(0, abs=1e-9)
    assert (method, pytest.approx(4.5 * unit)) in quick
    assert {name for name, _ in quick} == {"pkc", method} and sum(name == "kcs" for name, _ in quick) <= 1
    several = kt.reconstruct_all([tracks, tracks], method=method, intrinsics="auto")
    assert [one.diagnostics.notes[-1] for one in several] == 2 * [found.diagnostics.notes[-1]]


@pytest.mark.parametrize("least", [0.7, 2.0, 3.3, 9.1, 34.0, 80.0])
def test_the_least_of_what_is_tried(least):
    """Of a parabola in the logarithm the minimum itself, within what is tried; few distances are asked for."""
    asked = []

    def cost(distance):
        asked.append(distance)
        return math.log(distance / least) ** 2

    found = uncalibrated._descended(cost)
    inside = min(max(least, DISTANCES[0]), DISTANCES[-1])
    assert found == pytest.approx(inside, rel=1e-6 if DISTANCES[1] < least < DISTANCES[-2] else 0.25)
    assert len(set(asked)) <= 6


def test_what_cannot_be_solved_is_not_chosen():
    low = DISTANCES[4]
    assert uncalibrated._descended(lambda d: math.inf if d < low else d) == pytest.approx(low)
    assert uncalibrated._descended(lambda _: math.inf) in DISTANCES


def test_what_it_needs_is_told():
    tracks, _ = filmed(3500.0, 12)
    arm = kt.Skeleton.from_names(list("abcd"), [("a", "b"), ("b", "c"), ("c", "d")])
    bare = kt.Tracks.from_arrays(tracks.points[:, :4], skeleton=arm)
    with pytest.raises(kt.OptionError, match="'auto' needs a skeleton with a template and a trunk"):
        kt.reconstruct(bare, method="sfam", intrinsics="auto")
    with pytest.raises(kt.OptionError, match="'auto' needs a bone whose joints are seen"):
        kt.reconstruct(replace(tracks, weights=0 * tracks.weights), method="kcs", intrinsics="auto")
    point = replace(tracks, points=torch.full_like(tracks.points, 700.0))
    with pytest.raises(kt.OptionError, match="'auto' needs a body of some size in the image"):
        kt.reconstruct(point, method="kcs", intrinsics="auto")
    with pytest.raises(kt.ShapeError, match="fx, fy, cx, cy"):
        kt.reconstruct(tracks, method="kcs", intrinsics="automatic")


def test_command_line(tmp_path, quick):
    tracks, _ = filmed(3500.0, 15)
    source, output = tmp_path / "tracks.npz", tmp_path / "out.npz"
    np.savez(source, points2d=tracks.points.numpy(), joint_names=np.array(tracks.skeleton.joints), fps=30.0)
    words = ["lift", str(source), "-o", str(output), "--method", "kcs", "--skeleton", "h36m17", "--intrinsics", "auto"]
    done = CliRunner().invoke(app, words)
    assert done.exit_code == 0, done.output
    wanted = kt.reconstruct(tracks, method="kcs", intrinsics="auto")
    torch.testing.assert_close(load_reconstruction(output).points, wanted.points)
