"""SMSR, local rigidity and PND: exact where their models hold, and as good as published where not."""

import math
from dataclasses import replace

import pytest
import torch
from baseline_clips import centred, error, seen_from
from numerics import camera_disagreement, normal, rotations, tumbling
from torch.testing import assert_close

import kcs_torch as kt
from kcs_torch.errors import OptionError
from kcs_torch.functional import back_project, dct_basis, project
from kcs_torch.methods import BMM, PND, SMSR, LocalRigidity
from kcs_torch.methods.local_rigidity import rigid_pairs, triangulation, window_cameras

LATER = (SMSR, LocalRigidity, PND)
quiet = pytest.mark.filterwarnings("ignore::kcs_torch.errors.KcsWarning")


def low_rank(frames=100, joints=26, cosines=6):
    """Points of a shape that stays and of two more whose weights move within a few cosines."""
    weights = dct_basis(frames, cosines, dtype=torch.float64) * frames**0.5 @ normal(cosines, 3, seed=5)
    weights = weights * torch.tensor([0.0, 0.3, 0.2]) + torch.tensor([1.0, 0.0, 0.0])
    return torch.einsum("tk,knj->tnj", weights, normal(3, joints, 3, seed=1))


# ---------------------------------------------------------------------- SMSR


@quiet
def test_smsr_is_exact_on_smooth_shapes_of_low_rank():
    cameras = rotations(120, seed=7)[:, :2]
    tracks, truth = seen_from(low_rank(120, 30), cameras)
    result = SMSR(num_steps=300, cosines=1.0)(tracks)
    assert error(result.points, truth) < 1e-3
    assert camera_disagreement(result.cameras, cameras) < 0.05
    assert result.diagnostics.converged


def test_smsr_without_smoothing_solves_the_problem_of_bmm():
    """Two solvers of one convex problem, at one weight of the nuclear norm."""
    cameras = tumbling(60)
    tracks = project(centred(low_rank(60, 16)), cameras)
    weights = torch.rand(60, 16, generator=torch.Generator().manual_seed(0)).double() * 0.5 + 0.5
    first = SMSR(cosines=1.0, num_steps=500, mu=0.1, final=0.1).find_shape(tracks, weights, cameras)
    other = BMM(num_steps=500, mu=0.1, final=0.1).find_shape(tracks, weights, cameras)
    assert_close(first.value, other.value, rtol=0, atol=1e-3 * float(other.value.abs().max()))


def test_smsr_keeps_the_slow_cosines_alone():
    cameras = tumbling(60)
    world = centred(low_rank(60, 16))
    tracks = project(world, cameras)
    one = torch.ones(60, 16).double()
    basis = dct_basis(60, 60, dtype=torch.float64)
    quick = basis[:, 50, None, None] * normal(1, 16, 2)
    plain = SMSR(cosines=0.5).find_shape(tracks, one, cameras).value
    assert_close(SMSR(cosines=0.5).find_shape(tracks + quick, one, cameras).value, plain)
    assert not torch.allclose(SMSR(cosines=1.0).find_shape(tracks + quick, one, cameras).value, plain, atol=1e-2)


# ---------------------------------------------------------------------- local rigidity


@quiet
@pytest.mark.parametrize("known", [True, False])
def test_local_rigidity_finds_a_rigid_body(known):
    cameras = tumbling(60, 900.0)
    tracks, truth = seen_from(normal(1, 12, 3).expand(60, 12, 3), cameras)
    result = LocalRigidity(window=9)(tracks, cameras=cameras if known else None)
    assert error(result.points[4:-4], truth[4:-4]) < 0.1  # windows at the ends are half as long, and show less
    assert camera_disagreement(result.cameras, cameras) < 0.5
    assert result.diagnostics.bone_variation != result.diagnostics.bone_variation  # there are no bones


@pytest.mark.parametrize("window", [5, 15])
def test_windows_of_one_rigid_body_are_one_world(window):
    """No window is left in its mirror image, nor in a frame of its own."""
    cameras = tumbling(120, 700.0)
    tracks = project(centred(normal(1, 10, 3)), cameras)
    assert camera_disagreement(window_cameras(tracks, window), cameras) < 0.05


@quiet
def test_local_rigidity_follows_slow_deformation_before_a_quick_camera():
    """The less, the less deforms within a window."""
    rigid, wave = centred(normal(1, 14, 3)), centred(normal(1, 14, 3, seed=4))
    errors = []
    for speed in (1.0, 0.5):
        phase = torch.linspace(0, speed * math.pi, 90, dtype=torch.float64)[:, None, None]
        cameras = tumbling(90, 1500.0)
        tracks, truth = seen_from(rigid + 0.4 * phase.sin() * wave, cameras)
        errors.append(error(LocalRigidity(window=9, num_steps=0)(tracks, cameras=cameras).points, truth))
    assert errors[0] < 0.15 and errors[1] < 0.6 * errors[0]


def test_triangulation_is_the_weighted_least_squares_of_the_window():
    cameras, tracks = tumbling(12), normal(12, 3, 2)
    weights = torch.rand(12, 3, generator=torch.Generator().manual_seed(0)).double() + 0.1
    normals, goal = triangulation(tracks, weights, cameras, 5, 0.3)
    for t, n in ((0, 0), (6, 1), (11, 2)):
        rows, seen = [], []
        for s in range(max(0, t - 2), min(12, t + 3)):
            share = (1 - abs(s - t) / 3) * (1.0 if s == t else 0.3) * weights[s, n]
            rows.append(share.sqrt() * cameras[s])
            seen.append(share.sqrt() * tracks[s, n])
        design, image = torch.cat(rows), torch.cat(seen)
        assert_close(normals[t, n], design.mT @ design)
        assert_close(goal[t, n], design.mT @ image)


def test_pairs_that_keep_their_distance_are_found_and_hold():
    """Two rigid parts that turn about a joint, four points each."""
    angle = torch.linspace(0, 3, 80, dtype=torch.float64).sin()
    zero, one = torch.zeros_like(angle), torch.ones_like(angle)
    turn = torch.stack([angle.cos(), -angle.sin(), zero, angle.sin(), angle.cos(), zero, zero, zero, one], -1)
    turn = turn.view(80, 3, 3)
    world = torch.cat([normal(1, 4, 3).expand(80, 4, 3), normal(1, 4, 3, seed=2) @ turn.mT], 1)
    bones, lengths = rigid_pairs(world, 100, 1e-3)
    assert {tuple(b) for b in bones.tolist()} == {(a + k, b + k) for k in (0, 4) for b in range(4) for a in range(b)}
    assert_close(lengths, (world[0, bones[:, 0]] - world[0, bones[:, 1]]).norm(dim=-1))
    cameras = tumbling(80, 250.0)
    tracks, truth = project(centred(world), cameras), centred(world)
    method = LocalRigidity(window=9, stiffness=3.0)
    loose, firm = (
        replace(method, num_steps=k).find_shape(tracks, one[:, None].expand(80, 8), cameras).value for k in (0, 40)
    )
    assert (firm - truth).norm() < 0.9 * (loose - truth).norm()
    spread = lambda x: (x[:, bones[:, 0]] - x[:, bones[:, 1]]).norm(dim=-1).std(0).mean()  # noqa: E731
    assert spread(firm) < 0.5 * spread(loose)


# ---------------------------------------------------------------------- what all keep to


@quiet
@pytest.mark.parametrize("kind", LATER)
def test_bones_are_not_looked_at(kind):
    clip = kt.data.walking_person(40, turn=150.0)
    found, plain = kind()(clip.tracks).points, kind()(kt.Tracks.from_arrays(clip.tracks.points)).points
    assert error(found, centred(plain)) < 1e-6


@quiet
@pytest.mark.parametrize("kind", LATER)
def test_single_precision_is_as_good(kind):
    tracks, _ = seen_from(low_rank(60, 20), tumbling(60))
    found = kind()(kt.Tracks.from_arrays(tracks.points.float()))
    assert found.points.dtype == found.cameras.dtype == torch.float32
    assert error(found.points.double(), centred(kind()(tracks).points)) < 5e-3


@pytest.mark.parametrize(
    ("kind", "field", "value"),
    [
        (SMSR, "rank", 0),
        (SMSR, "cosines", 0.0),
        (SMSR, "cosines", 1.1),
        (SMSR, "num_steps", 0),
        (SMSR, "mu", math.inf),
        (SMSR, "final", 0.6),
        (SMSR, "tau", 2.0),
        (LocalRigidity, "window", 2),
        (LocalRigidity, "pairs", -1.0),
        (LocalRigidity, "rigid_below", 0.0),
        (LocalRigidity, "neighbours", 0.0),
        (LocalRigidity, "stiffness", math.inf),
        (LocalRigidity, "num_steps", -1),
        (PND, "num_steps", 0),
        (PND, "noise", 0.0),
        (PND, "final", 1.0),
        (PND, "fall", 1.0),
        (PND, "spread", -0.1),
    ],
)
def test_fields_out_of_range(kind, field, value):
    with pytest.raises(OptionError, match=f"{kind.name}: {field}: expected"):
        kind(**{field: value})


@quiet
@pytest.mark.parametrize("method", [SMSR(num_steps=3), PND(num_steps=1, noise=1.0)], ids=lambda method: method.name)
def test_not_converging_is_told(method):
    tracks, _ = seen_from(low_rank(40, 12), tumbling(40))
    with pytest.warns(kt.ConvergenceWarning, match="did not settle within"):
        assert not method(tracks).diagnostics.converged


# ---------------------------------------------------------------------- the papers' sequences

PUBLISHED = {  # e3d_world of SMSR as published
    "drink": 0.0287,
    "pickup": 0.2020,
    "stretch": 0.0783,
    "yoga": 0.1493,
}
LOCAL = {"pickup": 0.12, "yoga": 0.07}  # nothing is published by this measure: what it is here, and a margin


def figures(method, protocol, shared, name):
    source = {"src": f"akhter/akhter_{name}", "given": True}
    given, truth = protocol.build(shared / "data", source)
    found = method(kt.Tracks.from_arrays(given["points2d"]))
    return protocol.score(
        found.points.numpy(), truth["points3d"], truth["edges"], found.cameras.numpy(), truth["world"]
    )


@quiet
@pytest.mark.parametrize("name", PUBLISHED)
def test_smsr_is_as_good_as_published(protocol, shared, name):
    assert figures(SMSR(), protocol, shared, name)["e3d_world"] < 1.1 * PUBLISHED[name]


@quiet
@pytest.mark.parametrize("name", LOCAL)
def test_local_rigidity_is_far_better_than_flat(protocol, shared, name):
    assert figures(LocalRigidity(), protocol, shared, name)["e3d"] < LOCAL[name]


def test_back_projection_is_where_the_shapes_start():
    """A flat weight: the first step of SMSR from the pseudo-inverse has no residual, so mu alone moves it."""
    cameras = tumbling(30)
    tracks = project(centred(low_rank(30, 10)), cameras)
    one = torch.ones(30, 10).double()
    found = SMSR(cosines=1.0, num_steps=1, mu=1e-9, final=1e-9).find_shape(tracks, one, cameras)
    assert_close(found.value, back_project(tracks, cameras), rtol=0, atol=1e-6)
