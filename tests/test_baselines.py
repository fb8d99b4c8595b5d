"""Rigid factorisation, PTA, CSF and BMM: exact where their models hold, as good as their authors' code where not."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from baseline_clips import error, seen_from
from numerics import camera_disagreement, normal, rotations, tumbling, turning
from torch.testing import assert_close

import kcs_torch as kt
from kcs_torch.data import walking_person
from kcs_torch.errors import OptionError
from kcs_torch.functional import back_project, complete_rotation, dct_basis, project
from kcs_torch.methods import BMM, CSF, PND, PTA, SMSR, Rigid, SfAM
from kcs_torch.methods.clips.cameras import most_shapes, still_cameras
from kcs_torch.methods.csf import fit_column_space
from kcs_torch.methods.factorised import camera_rows, fit_basis_shapes, trajectory_design

BASELINES = (Rigid, PTA, CSF, BMM)
quiet = pytest.mark.filterwarnings("ignore::kcs_torch.errors.KcsWarning")


def combined(weights, shapes=None, joints=22):
    """Points (T, N, 3) whose basis shapes have the weights (T, K)."""
    shapes = normal(weights.shape[1], joints, 3, seed=1) if shapes is None else shapes
    return torch.einsum("tk,knj->tnj", weights, shapes)


def band_limited(frames=70, cosines=4, joints=22):
    """Points whose coordinates are combinations of the first cosines, slower ones larger."""
    return combined(
        dct_basis(frames, cosines, dtype=torch.float64) / torch.arange(1.0, cosines + 1) ** 2, joints=joints
    )


def low_rank(frames=80, joints=26):
    """Points of a mean and two more basis shapes whose weights move within six cosines."""
    mix = torch.eye(6, 3, dtype=torch.float64) + 0.4 * normal(6, 3, seed=5)
    mix[:, 0] = torch.eye(6)[0]
    basis = dct_basis(frames, 6, dtype=torch.float64) * frames**0.5
    return combined(basis @ mix * torch.tensor([1.0, 0.5, 0.3]), joints=joints)


def rigid_body(frames=30, joints=12):
    return combined(torch.ones(frames, 1, dtype=torch.float64), joints=joints)


# ---------------------------------------------------------------------- exact where the model holds

MODELS = {
    "rigid": (Rigid(), rigid_body()),
    "pta": (PTA(rank=4, cutoff=1e-3), band_limited()),
    "pta, as many cosines as it takes": (PTA(tolerance=1e-8, cutoff=1e-3), band_limited()),
    "csf": (CSF(rank=3, tolerance=1e-8, cutoff=1e-3), low_rank()),
}


@quiet
@pytest.mark.parametrize("known", [True, False])
@pytest.mark.parametrize("case", MODELS)
def test_what_the_model_holds_is_found_exactly(case, known):
    method, world = MODELS[case]
    # Of a camera that moves as slowly as the body there are several with orthonormal rows.
    cameras = tumbling(len(world)) if known else rotations(len(world), seed=7)[:, :2]
    tracks, truth = seen_from(world, cameras)
    result = method(tracks, cameras=cameras if known else None)
    assert error(result.points, truth) < (1e-6 if known else 1e-4)
    assert camera_disagreement(result.cameras, cameras) < 0.05
    assert result.diagnostics.converged and result.diagnostics.reprojection_rms < 1e-5


@quiet
@pytest.mark.parametrize("case", MODELS)
def test_gaps_do_no_harm_where_the_model_holds(case):
    """The shape is fitted to what is seen: completion errs, and counts for little."""
    method, world = MODELS[case]
    cameras = tumbling(len(world))
    tracks, truth = seen_from(world, cameras)
    points = tracks.points.clone()
    points[torch.rand(points.shape[:2], generator=torch.Generator().manual_seed(0)) < 0.1] = torch.nan
    result = method(kt.Tracks.from_arrays(points), cameras=cameras)
    assert error(result.points, truth) < 0.2
    flat = torch.cat([truth[..., :2], torch.zeros_like(truth[..., 2:])], -1)
    assert error(flat, truth) > 2


def test_a_rigid_shape_is_one_shape():
    tracks, _ = seen_from(low_rank(), tumbling(80))
    result = Rigid()(tracks)
    world = result.points @ complete_rotation(result.cameras)
    world = world - world.mean(1, keepdim=True)
    assert_close(world, world[:1].expand_as(world))


@quiet
@pytest.mark.parametrize("noise", [0.0, 1e-4])
@pytest.mark.parametrize("method", [PTA(), CSF(), BMM()], ids=lambda method: method.name)
def test_a_stiff_body_stays_stiff(method, noise):
    """Models with room for more do not make use of it."""
    cameras = (turning(60, 180.0, tilt=0.3) @ rotations(seed=2))[:, :2]
    tracks, truth = seen_from(rigid_body(60, 17), cameras)
    points = tracks.points + noise * tracks.points.std() * normal(60, 17, 2)
    assert error(method(kt.Tracks.from_arrays(points)).points, truth) < 0.02


def test_the_default_number_of_cosines_is_what_the_tracks_need():
    cameras = rotations(70, seed=7)[:, :2]
    counts = []
    for cosines in (2, 5, 9):
        world = combined(dct_basis(70, cosines, dtype=torch.float64), joints=30)
        tracks = seen_from(world, cameras)[0].points
        counts.append(PTA()._rank(tracks, cameras))
    assert counts == [2, 5, 9]
    noise = 0.3 * normal(70, 30, 2)  # no number of cosines explains it: cross-validation decides
    slow = seen_from(band_limited(joints=30), cameras)[0].points
    assert PTA()._rank(slow / slow.std() + noise, cameras) < 10


# ---------------------------------------------------------------------- against other ways to the same end


def test_basis_shapes_are_the_weighted_least_squares():
    frames, joints, rank = 40, 5, 3
    cameras, basis = tumbling(frames), dct_basis(frames, rank, dtype=torch.float64)
    tracks, weights = normal(frames, joints, 2), torch.rand(frames, joints, dtype=torch.float64) + 0.1
    found = fit_basis_shapes(tracks, weights, cameras, basis, cutoff=0.0)
    design = trajectory_design(cameras, basis)
    for n in range(joints):
        root = weights[:, n].repeat_interleave(2).sqrt()
        expected = torch.linalg.lstsq(root[:, None] * design, (root * tracks[:, n].flatten())[:, None]).solution
        assert_close(found[:, n].flatten(), expected[:, 0])
    even = torch.full_like(weights, 0.3)
    assert_close(
        fit_basis_shapes(tracks, even, cameras, basis, cutoff=0.1),
        fit_basis_shapes(tracks, even + 1e-12 * weights, cameras, basis, cutoff=0.1),
    )


def test_basis_shapes_have_a_derivative():
    cameras, basis = tumbling(8), dct_basis(8, 2, dtype=torch.float64)
    weights = torch.rand(8, 3, dtype=torch.float64) + 0.1
    fit = lambda w: fit_basis_shapes(w, weights, cameras, basis, cutoff=0.1)  # noqa: E731
    assert torch.autograd.gradcheck(fit, (normal(8, 3, 2).requires_grad_(),))


def test_what_no_camera_shows_is_left_flat():
    """Before a camera that stands still the design is singular."""
    cameras = torch.eye(3, dtype=torch.float64)[:2].expand(20, 2, 3)
    tracks = project(low_rank(20, 6), cameras)
    shapes = fit_basis_shapes(tracks, torch.ones(20, 6).double(), cameras, dct_basis(20, 4).double(), cutoff=1e-3)
    assert shapes.isfinite().all()
    assert_close(shapes[..., 2], torch.zeros_like(shapes[..., 2]), rtol=0, atol=1e-9)


def test_the_column_space_is_a_minimum():
    """Of |W - M pinv(M) W|^2 itself, which the solver never forms: no slope, and noise only raises it."""
    cameras = tumbling(60)
    design = trajectory_design(cameras, dct_basis(60, 8, dtype=torch.float64))
    tracks = project(low_rank(60, 14), cameras).mT.flatten(0, 1)
    tracks = tracks + 0.05 * tracks.std() * normal(*tracks.shape)

    def cost(x):
        motion = design @ torch.kron(x.contiguous(), torch.eye(3, dtype=x.dtype))
        return (tracks - motion @ torch.linalg.lstsq(motion, tracks).solution).square().sum()

    found = fit_column_space(design, tracks, 2, tolerance=1e-12)
    assert found.converged
    assert_close(found.value.mT @ found.value, torch.eye(2).double())
    x = found.value.clone().requires_grad_()
    (slope,) = torch.autograd.grad(cost(x), x)
    start = torch.eye(8, 2, dtype=torch.float64, requires_grad=True)
    (steep,) = torch.autograd.grad(cost(start), start)
    assert slope.norm() < 1e-4 * steep.norm()
    assert cost(found.value) < 0.8 * cost(start.detach())
    for seed in range(20):
        assert cost(found.value + 1e-2 * normal(8, 2, seed=seed)) > cost(found.value)


def test_the_column_space_is_that_of_a_general_solver():
    from scipy.optimize import minimize

    cameras = tumbling(40)
    design = trajectory_design(cameras, dct_basis(40, 5, dtype=torch.float64))
    tracks = project(low_rank(40, 10), cameras).mT.flatten(0, 1)

    def cost(x):
        motion = design.numpy() @ np.kron(x.reshape(5, 2), np.eye(3))
        return ((tracks.numpy() - motion @ (np.linalg.pinv(motion) @ tracks.numpy())) ** 2).sum()

    found = fit_column_space(design, tracks, 2, tolerance=1e-10)
    other = minimize(cost, np.eye(5, 2).ravel(), method="BFGS")
    assert cost(found.value.numpy()) == pytest.approx(other.fun, rel=1e-4)


def nuclear(points):
    return torch.linalg.matrix_norm(points.flatten(-2), "nuc")


def test_bmm_has_the_least_nuclear_norm_of_all_shapes_with_its_image():
    world, cameras = low_rank(50, 16), tumbling(50)
    world = world - world.mean(1, keepdim=True)
    tracks = project(world, cameras)
    solution = BMM(num_steps=400).find_shape(tracks, torch.ones(50, 16).double(), cameras)
    found = solution.value
    assert solution.converged
    assert (project(found, cameras) - tracks).norm() < 1e-3 * tracks.norm()
    assert nuclear(found) < nuclear(back_project(tracks, cameras)) and nuclear(found) < 1.001 * nuclear(world)
    view = complete_rotation(cameras)[:, 2]
    for seed in range(10):  # moves along the rays
        for size in (1e-2, 1e-1):
            moved = found + size * normal(50, 16, 1, seed=seed) * view[:, None]
            assert nuclear(moved) > 0.9999 * nuclear(found)
    towards = found + 0.2 * (world - found)
    assert nuclear(towards) > 0.9999 * nuclear(found)


@quiet
def test_bmm_finds_shapes_of_low_rank_that_are_seen_from_all_sides():
    tracks, truth = seen_from(low_rank(120, 30), rotations(120, seed=7)[:, :2])
    assert error(BMM(num_steps=300)(tracks).points, truth) < 1e-3


# ---------------------------------------------------------------------- cameras


@quiet
@pytest.mark.parametrize("method", [SfAM(), BMM(), SMSR(), PND(num_steps=3)], ids=lambda method: method.name)
def test_only_proportions_of_weights_count(method):
    tracks = walking_person(30, turn=180, missing=0.2, generator=torch.Generator().manual_seed(0)).tracks
    faint = method(replace(tracks, weights=tracks.weights / 8))
    assert_close(faint.points, method(tracks).points)


@pytest.mark.parametrize("evenness", [0.0, 1.0])
def test_cameras_of_deforming_bodies(evenness):
    for world in (rigid_body(), low_rank(), low_rank(120, 30)):
        cameras = tumbling(len(world))
        tracks = seen_from(world, cameras)[0].points
        found = camera_rows(tracks, 12, evenness=evenness, num_steps=300)
        assert camera_disagreement(found, cameras) < 0.01


def test_cameras_that_zoom_take_an_uneven_scale():
    cameras = tumbling(80)
    zoom = torch.linspace(0.6, 1.5, 80, dtype=torch.float64)[:, None, None]
    tracks = zoom * seen_from(low_rank(), cameras)[0].points
    assert camera_disagreement(camera_rows(tracks, 3, evenness=0.0, num_steps=300), cameras) < 0.01
    assert camera_disagreement(camera_rows(tracks, 3, evenness=1.0, num_steps=300), cameras) > 1


@pytest.mark.parametrize(("frames", "joints"), [(1, 20), (20, 3), (2, 5), (3, 4), (4, 30)])
def test_cameras_of_next_to_nothing_are_cameras(frames, joints):
    for tracks in (normal(frames, joints, 2), torch.zeros(frames, joints, 2).double()):
        rows = camera_rows(tracks - tracks.mean(1, keepdim=True), 12)
        assert_close(rows @ rows.mT, torch.eye(2).double().expand(frames, 2, 2), rtol=0, atol=1e-9)
        if most_shapes(tracks) < 1:
            assert torch.equal(rows, still_cameras(tracks))


# ---------------------------------------------------------------------- what every baseline keeps to


@quiet
@pytest.mark.parametrize("kind", BASELINES)
def test_bones_are_not_looked_at(kind):
    clip = kt.data.walking_person(40, turn=150.0)
    bare = kt.Tracks.from_arrays(clip.tracks.points)
    found, plain = kind()(clip.tracks).points, kind()(bare).points
    centre = lambda x: x - x.mean(1, keepdim=True)  # noqa: E731
    assert error(found, centre(plain)) < 1e-6


@quiet
@pytest.mark.parametrize("method", [Rigid(), PTA(), CSF(rank=3), BMM()], ids=lambda method: method.name)
def test_single_precision_is_as_good(method):
    tracks, _ = seen_from(low_rank(), rotations(80, seed=7)[:, :2])
    found = method(kt.Tracks.from_arrays(tracks.points.float()))
    assert found.points.dtype == torch.float32
    centre = lambda x: x - x.mean(1, keepdim=True)  # noqa: E731
    assert error(found.points.double(), centre(method(tracks).points)) < 1e-3


@pytest.mark.parametrize(
    ("kind", "field", "value"),
    [
        (Rigid, "num_steps", 0),
        (Rigid, "cutoff", 1.0),
        (PTA, "rank", 0),
        (PTA, "rank", "all"),
        (PTA, "tolerance", 0.0),
        (PTA, "most", 0),
        (PTA, "cutoff", -0.1),
        (PTA, "camera_rank", 0),
        (CSF, "rank", 0),
        (CSF, "rank", "auto"),
        (CSF, "cosines", 0.0),
        (CSF, "cosines", 1.1),
        (CSF, "num_steps", 0),
        (CSF, "tolerance", -1.0),
        (CSF, "cutoff", 1.0),
        (CSF, "camera_rank", 0),
        (BMM, "rank", 0),
        (BMM, "num_steps", 0),
        (BMM, "mu", 0.0),
        (BMM, "final", 0.6),
        (BMM, "momentum", 1.0),
    ],
)
def test_fields_out_of_range(kind, field, value):
    with pytest.raises(OptionError, match=f"{kind.name}: {field}: expected"):
        kind(**{field: value})


@pytest.mark.parametrize("method", [CSF(num_steps=1), BMM(num_steps=3)], ids=lambda method: method.name)
def test_not_converging_is_told(method):
    tracks, _ = seen_from(low_rank(), tumbling(80))
    with pytest.warns(kt.ConvergenceWarning, match="did not settle within"):
        assert not method(tracks).diagnostics.converged


# ---------------------------------------------------------------------- the papers' sequences

SEQUENCES = ("drink", "pickup", "stretch", "yoga")
AUTHORS = {  # what the authors' own code reaches by this protocol: e3d, e3d_world, in the order of SEQUENCES
    "pta": ((0.0232, 0.0684, 0.0832, 0.0527), (0.0250, 0.2374, 0.1034, 0.1554)),
    "csf": ((0.0200, 0.0462, 0.0393, 0.0351), (0.0224, 0.2300, 0.0712, 0.1473)),
    "bmm": ((0.0224, 0.0503, 0.0400, 0.0346), (0.0266, 0.1692, 0.1034, 0.1377)),
}


@pytest.fixture(scope="module")
def figures_of(protocol, shared):
    def figures(sequence, method):
        given, truth = protocol.build(shared / "data", {"src": f"akhter/akhter_{sequence}", "given": True})
        found = kt.reconstruct(given["points2d"], method=method)
        return protocol.score(
            found.points.numpy(), truth["points3d"], truth["edges"], found.cameras.numpy(), truth["world"]
        )

    return figures


@quiet
@pytest.mark.parametrize("method", AUTHORS)
def test_as_good_as_the_authors_code(method, figures_of):
    for sequence, body, world in zip(SEQUENCES, *AUTHORS[method], strict=True):
        figures = figures_of(sequence, method)
        assert figures["e3d"] < 1.1 * body, sequence
        assert figures["e3d_world"] < 1.1 * world, sequence


@quiet
@quiet
def test_any_tolerance_will_do():
    tracks, _ = seen_from(band_limited(20, 2), tumbling(20))
    for tolerance in (1e300, 2**63):
        assert bool(PTA(tolerance=tolerance)(tracks).points.isfinite().all())


@quiet
def test_more_shapes_than_csf_takes_are_the_most_it_takes(monkeypatch):
    monkeypatch.setattr("kcs_torch.methods.csf.MOST", 2)
    tracks = walking_person(30, turn=180).tracks
    assert torch.equal(CSF(rank=3)(tracks).points, CSF(rank=2)(tracks).points)


@pytest.mark.parametrize("method", ["pta", "csf"])
def test_the_papers_own_ranks_give_the_papers_figures(method, figures_of):
    """Neither worse nor better: the same mathematics."""
    ranks = {"pta": (13, 12, 12, 11), "csf": (6, 6, 8, 7)}[method]
    make = {"pta": lambda k: PTA(rank=k, cutoff=0.0), "csf": lambda k: CSF(rank=k)}[method]
    for sequence, rank, body in zip(SEQUENCES, ranks, AUTHORS[method][0], strict=True):
        assert figures_of(sequence, make(rank))["e3d"] == pytest.approx(body, rel=0.1), sequence
