"""kcs_torch/metrics/solutions.py and Reconstruction.solution: several solutions of the same tracks, told apart."""

import json
from dataclasses import replace

import numpy as np
import pytest
import torch
from samples import walk_result
from typer.testing import CliRunner

import kcs_torch as kt
from kcs_torch.cli import app
from kcs_torch.errors import OptionError, ShapeError
from kcs_torch.io import load_reconstruction
from kcs_torch.metrics import difference
from kcs_torch.metrics.solutions import Difference


def several():
    best = replace(walk_result(), objective=-10.0)
    return replace(best, alternatives=tuple(replace(best, points=best.points + k, objective=k - 10.0) for k in (1, 2)))


def test_each_solution_goes_in_front_of_all_others():
    result = several()
    assert result.solution(1).objective == -10
    assert [s.objective for s in result.solution(2).alternatives] == [-10, -8]
    third = result.solution(3)
    assert third.objective == -8 and [s.objective for s in third.alternatives] == [-10, -9]
    assert third.points is result.alternatives[1].points
    assert all(s.alternatives == () for s in third.alternatives)


def test_what_is_doubtful_of_the_best_is_so_of_the_others():
    result = several()
    unsure = replace(result, diagnostics=replace(result.diagnostics, doubt="depth is a guess: why"))
    assert "depth is a guess" not in repr(result) and repr(unsure).endswith(", depth is a guess)")
    other = unsure.solution(2)
    assert other.diagnostics.doubt == "depth is a guess: why" and other.diagnostics.notes[-1] == "depth is a guess: why"
    assert result.solution(2).diagnostics.doubt == ""


@pytest.mark.parametrize("number", [0, 4, -1, "2", 1.0, True])
def test_other_numbers_are_refused(number):
    with pytest.raises(OptionError, match=r"walk\.npz: solution: expected a number from 1 to 3"):
        several().solution(number)


def test_one_solution_says_so():
    with pytest.raises(OptionError, match="one solution only"):
        walk_result().solution(2)


def test_the_mirror_image_is_told():
    result = walk_result(skeleton="h36m17")
    found = difference(result, result.mirrored())
    assert found.mirrored and str(found) == "the mirror image in depth"
    depth = result.points[..., 2] - result.points[..., 2].mean(1, keepdim=True)
    assert found.rms == pytest.approx(2 * float(depth.square().mean().sqrt()), rel=1e-3)
    points = result.points.clone()
    points[2, 3] = torch.nan  # says nothing of the others
    gap = replace(result, points=points)
    assert str(difference(gap, gap.mirrored())) == "the mirror image in depth"


def test_what_is_nearly_the_mirror_image_is_not_called_it():
    result = walk_result(skeleton="h36m17")
    mirror = result.mirrored()
    points = mirror.points.clone()
    points[:, :2, 2] += torch.tensor([20.0, -20.0])
    found = difference(result, replace(mirror, points=points))
    assert found.mirrored and found.beside_mirror == pytest.approx(20 * (2 / 17) ** 0.5, rel=1e-3)
    assert str(found) == f"nearly the mirror image in depth, {found.beside_mirror:.3g} {result.units} from it"
    assert difference(result, mirror).beside_mirror == 0


def test_a_flipped_forearm_is_named_with_its_share_of_frames():
    result = walk_result(20, skeleton="h36m17")
    elbow, wrist = (result.skeleton.index(f"left_{j}") for j in ("elbow", "wrist"))
    points = result.points.clone()
    points[:, wrist, 2] = points[:, elbow, 2] + 150
    ours = replace(result, points=points.clone())
    points[:10, wrist, 2] = points[:10, elbow, 2] - 150
    points[12, wrist, 2] = points[12, elbow, 2] - 1  # hardly tips at all
    found = difference(ours, replace(result, points=points))
    assert found.flipped == {"left_elbow-left_wrist": 0.5} and not found.mirrored
    # 300 in 10 frames and 151 in one, of which the pose's middle takes a 17th
    assert found.rms == pytest.approx(((10 * 300**2 + 151**2) / 20 * (16 / 17) / 17) ** 0.5, rel=1e-3)
    assert "left_elbow-left_wrist in 50 % of the frames" in str(found)
    assert next(iter(found.joints)) == "left_wrist" and len(found.joints) == 17
    depth = ((10 * 300**2 + 151**2) / 20) ** 0.5
    assert found.joints["left_wrist"] == pytest.approx(16 / 17 * depth, rel=1e-3)


def test_more_than_four_bones_are_counted():
    some = Difference(1.0, False, {f"a-{k}": 0.5 for k in range(6)})
    assert str(some).endswith("a-2 in 50 %, a-3 in 50 % of the frames, and 2 more bones")


def test_where_depth_begins_is_no_difference():
    result = walk_result()
    found = difference(result, replace(result, points=result.points + torch.tensor([0.0, 0, 50])))
    assert found.rms == pytest.approx(0, abs=1e-9) and not found.flipped and not found.mirrored
    assert str(found) == str(difference(result, result)) == "depths are the same" and found.joints == {}


def test_other_frames_are_refused():
    with pytest.raises(ShapeError, match="same frames and joints"):
        difference(walk_result(12), walk_result(13))


def test_lift_lists_the_solutions_and_writes_any(tmp_path):
    clip = kt.data.walking_person(40, turn=0.0, noise=2.0, generator=torch.Generator().manual_seed(0))
    tracks = kt.save(clip.tracks, tmp_path / "tracks.npz")

    def lift(name, *words, code=0):
        done = CliRunner().invoke(app, ["lift", str(tracks), "-o", str(tmp_path / name), *words])
        assert done.exit_code == code, done.output
        return done

    (report,) = json.loads(lift("best.npz", "--json").stdout)["people"]
    best = load_reconstruction(tmp_path / "best.npz")
    count = 1 + len(best.alternatives)
    assert count > 1 and report["solution"] == 1 and report["objective"] == best.objective
    assert [other["solution"] for other in report["alternatives"]] == list(range(2, count + 1))
    for told, other in zip(report["alternatives"], best.alternatives, strict=True):
        apart = difference(best, other)
        assert told["objective"] == other.objective
        assert (told["flipped"], told["rms_difference"], told["differs"]) == (apart.flipped, apart.rms, str(apart))

    words = lift("second.npz", "--solution", "2").stdout
    assert (
        "solution 1 " in words and "solution 2 " not in words and str(difference(best.alternatives[0], best)) in words
    )
    second = load_reconstruction(tmp_path / "second.npz")
    np.testing.assert_allclose(second.points, best.alternatives[0].points, rtol=1e-6, atol=1e-6)
    np.testing.assert_allclose(second.alternatives[0].points, best.points, rtol=1e-6, atol=1e-6)
    refused = lift("ninth.npz", "--solution", "9", code=2)
    assert f"expected a number from 1 to {count}, got 9" in refused.stderr
    assert not (tmp_path / "ninth.npz").exists()


@pytest.mark.filterwarnings("ignore::kcs_torch.errors.KcsWarning")
@pytest.mark.parametrize("lens", ["parallel", (1500.0, 1500.0, 960.0, 540.0)])
@pytest.mark.parametrize("template", [True, False])
def test_what_is_said_of_the_tracks_is_said_of_every_solution(lens, template):
    if lens == "parallel":
        noise = torch.Generator().manual_seed(0)
        clip = kt.data.walking_person(40, turn=0.0 if template else 90.0, noise=5.0, generator=noise)
        tracks = clip.tracks
    else:
        clip = kt.data.walking_person(40, turn=0.0 if template else 90.0)
        ahead = clip.points + torch.tensor([0.0, 0.0, 4000.0]).double()
        noise = 2 * torch.randn(40, 17, 2, generator=torch.Generator().manual_seed(0)).double()
        tracks = replace(clip.tracks, points=kt.types.Intrinsics.of(lens).project(ahead) + noise, units="px")
    if not template:
        tracks = replace(tracks, skeleton=replace(tracks.skeleton, template=None, hinges=(), spread=None))
    result = kt.reconstruct(tracks, intrinsics=lens)
    assert result.alternatives
    for one in (result, *result.alternatives):
        notes = one.diagnostics.notes
        assert sum(note.startswith("tracks smoothed: noise of") for note in notes) == 1
        assert ("pkc did not settle" in " ".join(notes)) != one.diagnostics.converged
    assert not any("see the alternatives" in note for other in result.alternatives for note in other.diagnostics.notes)


def test_points_are_no_solutions():
    points = torch.zeros(5, 17, 3)
    with pytest.raises(OptionError, match="difference: best: expected a Reconstruction, got Tensor: mpjpe compares"):
        difference(points, points)
