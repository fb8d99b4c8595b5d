"""PND: its distribution, its steps against the Gaussian written out, and shapes that follow its model."""

import math
from dataclasses import fields, replace

import pytest
import torch
from baseline_clips import centred, error
from numerics import camera_disagreement, count_operations, normal, rotations, tumbling
from test_baselines_later import figures, quiet
from torch.testing import assert_close

import kcs_torch as kt
from kcs_torch.data import walking_person
from kcs_torch.functional import complete_rotation
from kcs_torch.methods import PND
from kcs_torch.methods.clips.batches import padded
from kcs_torch.methods.pnd import ProcrusteanNormal, align_to_mean, fit_procrustean_normal, procrustean_tangent
from kcs_torch.methods.pnd import fit as module
from kcs_torch.methods.pnd.fit import FARTHEST, Image, expect

PND2 = {"pickup": (0.0193, 0.1142), "yoga": (0.0169, 0.1046)}  # the authors' improved code: e3d, e3d_world


def procrustean(frames=120, joints=14, modes=3, size=0.2, seed=0):
    """Shapes drawn from a Procrustean normal distribution of a few modes (T, N, 3), and its mean."""
    mean = centred(normal(1, joints, 3, seed=seed))[0]
    mean = mean / mean.norm()
    ways = procrustean_tangent(mean) @ normal(3 * joints, modes, seed=seed + 1)
    away = normal(frames, modes, seed=seed + 2) @ ways.mT * size / ways.norm(dim=0).mean()
    return mean + away.view(frames, 3, joints).mT, mean


def test_the_tangent_space_has_no_rigid_motion():
    mean = centred(normal(1, 9, 3))[0]
    tangent = procrustean_tangent(mean)
    assert_close(tangent @ tangent, tangent)
    assert tangent.trace().item() == pytest.approx(27 - 7)
    turn = torch.linalg.matrix_exp(1e-6 * torch.tensor([[0, -3.0, 1], [3, 0, 2], [-1, -2, 0]]).double())
    for moved in ((1 + 1e-6) * mean, mean + 1e-6 * torch.tensor([1.0, 2, -3]), mean @ turn):
        assert (tangent @ (moved - mean).mT.flatten()).norm() < 1e-10
    line = torch.linspace(-1, 1, 5).double()[:, None] * torch.tensor([1.0, 0, 0])  # it cannot turn about itself
    assert procrustean_tangent(line).trace().item() == pytest.approx(15 - 6)


def test_aligned_shapes_lie_in_the_tangent_space():
    shapes, mean = procrustean(20)
    moved = torch.linspace(0.5, 2, 20).double()[:, None, None] * (shapes @ rotations(20))
    turn, factor = align_to_mean(moved, mean)
    assert_close((moved @ turn) * factor[:, None, None], shapes)
    found = ProcrusteanNormal.of_shapes(moved, torch.eye(3).double().expand(20, 3, 3))
    assert_close(found.shapes(), moved)
    away = (found.aligned - found.mean).mT.flatten(1)
    assert (away - away @ procrustean_tangent(found.mean)).norm() < 1e-6 * away.norm()
    assert_close(found.mean.norm(), torch.ones(()).double())
    assert_close(found.aligned.mean(0), found.mean, rtol=0, atol=1e-6)


def test_shapes_are_aligned_clip_by_clip():
    """Padding counts in no mean, median or moment; frames that show nearly nothing have a place by the others'."""
    parts = [procrustean(n, seed=n)[0] @ rotations(n).mT for n in (20, 11)]
    parts[1][3] *= 1e-6
    inside = torch.arange(20) < torch.tensor([[20], [11]])
    views = padded([rotations(20), rotations(11)])
    found = ProcrusteanNormal.of_shapes(padded(parts), views, spread=0.1, inside=inside)
    for k, part in enumerate(parts):
        alone = vars(ProcrusteanNormal.of_shapes(part, views[k, : len(part)], spread=0.1))
        ours = taken(found, k)
        assert_close({name: x[: len(alone[name])] for name, x in vars(ours).items()}, alone)
        assert not ours.scales[len(part) :].any() and not ours.aligned[len(part) :].any()


def case(frames=40, joints=8, weights=None, seed=0):
    """A model away from its optimum, and tracks: what the E-step is tested on."""
    shapes, _ = procrustean(frames, joints, seed=seed)
    now = ProcrusteanNormal.of_shapes(shapes @ rotations(frames).mT, rotations(frames), spread=0.1)
    tracks = now.shapes()[..., :2] + 0.02 * normal(frames, joints, 2, seed=9)
    weights = torch.ones(frames, joints).double() if weights is None else weights
    return now, tracks, weights


def stacked(*records):
    """Models of single clips as one of several, or a single one as a batch of one."""
    kind = type(records[0])
    return kind(*(torch.stack([getattr(one, field.name) for one in records]) for field in fields(kind)))


def taken(record, k):
    """One clip of several."""
    return type(record)(*(getattr(record, field.name)[k] for field in fields(record)))


def e_step(now, tracks, weights, level):
    one = torch.ones(1).double()
    return taken(expect(stacked(now), Image.of(tracks[None], weights[None]), level * one, 0 * one), 0)


def fit(tracks, weights, start, **options):
    """Of a single clip."""
    fitted, history, change = fit_procrustean_normal(tracks[None], weights[None], stacked(start), **options)
    return taken(fitted, 0), history[:, 0], change[0]


def gaussian(now, tracks, weights, level, t):
    """Mean and covariance of frame t's image without its translation, written out with all matrices, and the data."""
    seen = weights[t] > 0
    joints = int(seen.sum())
    root = weights[t, seen].sqrt().diag()
    camera = now.scales[t] * now.rotations[t, :2]
    basis = torch.linalg.svd(root.diagonal()[None]).Vh[1:] @ root  # all weighted images that no translation changes
    pick = torch.eye(len(seen)).double()[seen]
    take = torch.kron(torch.eye(2).double(), basis) @ torch.kron(camera, pick)
    image = (basis @ tracks[t, seen]).mT.flatten()
    spread = take @ now.covariance @ take.mT + level * torch.eye(2 * (joints - 1)).double()
    return take, image - take @ now.mean.mT.flatten(), spread


WEIGHTS = torch.rand(40, 8, generator=torch.Generator().manual_seed(3)).double()
GAPS = torch.where(WEIGHTS < 0.3, 0.0, WEIGHTS)


@pytest.mark.parametrize("weights", [None, WEIGHTS * 0 + 0.25, WEIGHTS, GAPS], ids=["one", "even", "soft", "gaps"])
def test_the_e_step_is_that_of_the_gaussian_written_out(weights):
    now, tracks, weights = case(weights=weights)
    level = 1e-3
    found = e_step(now, tracks, weights, level)
    total, rest, noise = 0.0, 0.0, 0.0
    for t in range(len(tracks)):
        take, off, spread = gaussian(now, tracks, weights, level, t)
        distribution = torch.distributions.MultivariateNormal(torch.zeros_like(off), spread)
        total += float(distribution.log_prob(off)) + len(off) / 2 * math.log(2 * math.pi)
        gain = now.covariance @ take.mT @ spread.inverse()
        mean = (now.mean.mT.flatten() + gain @ off).view(3, 8).mT
        assert_close(found.aligned[t], mean, rtol=0, atol=1e-7)
        posterior = now.covariance - gain @ take @ now.covariance
        rest = rest + posterior
        miss = off - take @ (gain @ off)
        noise += float(miss.square().sum() + (take @ posterior @ take.mT).trace())
    assert float(found.likelihood) == pytest.approx(total, rel=1e-7)
    assert_close(found.rest, rest, rtol=0, atol=1e-7)
    assert float(found.noise) == pytest.approx(noise / float((2 * ((weights > 0).sum(1) - 1)).sum()), rel=1e-7)


@pytest.mark.parametrize("weights", [None, WEIGHTS, GAPS], ids=["one", "soft", "gaps"])
def test_the_step_of_rotations_is_gauss_newton_on_the_likelihood_of_each_frame(weights):
    """Its gradient is that of automatic differentiation through the Gaussian written out, so is its Jacobian."""
    now, tracks, weights = case(weights=weights)
    level = 1e-3
    found = e_step(now, tracks, weights, level)
    axes = torch.eye(3).double()
    spin = -torch.linalg.cross(axes[:, None].expand(3, 3, 3), axes[None].expand(3, 3, 3), dim=-1)
    for t in range(0, 40, 7):

        def moved(w, t=t):
            turn = torch.linalg.matrix_exp((w[:3, None, None] * spin).sum(0))
            place = (turn @ now.rotations[t])[None], (now.scales[t] * w[3].exp())[None]
            model = ProcrusteanNormal(now.mean, now.covariance, *place, now.aligned)
            return gaussian(model, tracks[t : t + 1], weights[t : t + 1], level, 0)

        def likelihood(w, moved=moved):
            _, off, spread = moved(w)
            return -(off @ spread.inverse() @ off) / 2 - torch.logdet(spread) / 2

        still, shape = torch.zeros(4).double(), found.aligned[t].mT.flatten()
        slope = torch.autograd.functional.jacobian(likelihood, still)
        ways = torch.autograd.functional.jacobian(lambda w, x=shape, f=moved: f(w)[0] @ x, still)
        step = torch.linalg.solve(ways.mT @ moved(still)[2].inverse() @ ways + 1e-9 * torch.eye(4), slope)
        assert_close(found.steps[t], step * min(1, FARTHEST / step.norm()), rtol=1e-6, atol=1e-9)


def test_the_likelihood_falls_in_no_step():
    shapes, _ = procrustean(60, 10)
    view = rotations(60, seed=2)
    tracks = (shapes @ view.mT)[..., :2] + 0.003 * normal(60, 10, 2, seed=9)
    weights = torch.where(torch.rand(60, 10, generator=torch.Generator().manual_seed(0)) < 0.2, 0.0, 1.0).double()
    # A poor start: depth is noise, rotations are 10 degrees off.
    rough = torch.cat([tracks, (shapes @ view.mT)[..., 2:] + 0.1 * normal(60, 10, 1, seed=4)], -1)
    wrong = torch.linalg.matrix_exp(0.1 * (lambda x: x - x.mT)(normal(60, 3, 3, seed=6))) @ view
    start = ProcrusteanNormal.of_shapes(centred(rough), wrong, spread=0.1)
    for fall in (0.3, 0.9):
        _, history, _ = fit(tracks, weights, start, num_steps=60, noise=0.1, final=1e-9, fall=fall)
        assert len(history) == 61 and history[-1] > history[0] + 100
        assert (history.diff() > -1e-9 * history[-1].abs()).all()


def test_the_noise_is_that_of_the_tracks():
    shapes, _ = procrustean(200, 16, modes=2)
    view, sigma = rotations(200, seed=2), 0.004
    exact = shapes @ view.mT
    tracks = exact[..., :2] + sigma * normal(200, 16, 2, seed=9)
    start = ProcrusteanNormal.of_shapes(exact, view)
    fitted, _, _ = fit(tracks, torch.ones(200, 16).double(), start, num_steps=60, noise=0.05)
    miss = (centred(tracks) - centred(fitted.shapes())[..., :2]).square().mean().sqrt()
    assert float(miss) == pytest.approx(sigma, rel=0.15)  # what is left is the noise, neither more nor less
    assert (fitted.shapes() - exact).norm() / exact.norm() < 0.05


def problem(frames, weights=None, depth=0.1, noise=0.003):
    """Tracks and weights of 10 joints, and a start whose depth and rotations are off."""
    shapes, _ = procrustean(frames, 10, seed=frames)
    view = rotations(frames, seed=2)
    tracks = (shapes @ view.mT)[..., :2] + noise * normal(frames, 10, 2, seed=9)
    rough = torch.cat([tracks, (shapes @ view.mT)[..., 2:] + depth * normal(frames, 10, 1, seed=4)], -1)
    wrong = torch.linalg.matrix_exp(depth * (lambda x: x - x.mT)(normal(frames, 3, 3, seed=6))) @ view
    start = ProcrusteanNormal.of_shapes(centred(rough), wrong, spread=0.1)
    return tracks, torch.ones(frames, 10).double() if weights is None else weights, start


def flat_problem(frames):
    """The same with a start that knows nothing of depth or rotations: some of its steps are undone."""
    tracks, weights, _ = problem(frames, soft(frames))
    flat = torch.nn.functional.pad(tracks, (0, 1)) + 1e-3 * normal(frames, 10, 3)
    return tracks, weights, ProcrusteanNormal.of_shapes(centred(flat), rotations(frames, seed=5))


def padded_problems(problems):
    """As one batch."""
    starts = [one for _, _, one in problems]
    over_time = (padded([getattr(one, name) for one in starts]) for name in ("rotations", "scales", "aligned"))
    start = ProcrusteanNormal(*(torch.stack([getattr(x, name) for x in starts]) for name in ("mean", "covariance")),
                              *over_time)  # fmt: skip
    return *(padded([one[k] for one in problems]) for k in (0, 1)), start


def soft(frames, least=0.3):
    weights = torch.rand(frames, 10, generator=torch.Generator().manual_seed(frames)).double()
    return torch.where(weights < least, 0.0, weights)


def test_clips_of_a_batch_are_fitted_each_for_itself(monkeypatch):
    """Noise, damping, steps undone and the end are each clip's own, whatever lengths and weights are beside it."""
    sizes = []

    def counted(now, *others):
        sizes.append(len(now.mean))
        return expect(now, *others)

    monkeypatch.setattr(module, "expect", counted)
    problems = [problem(40, depth=0.4), problem(20, soft(20, 0.0)), problem(33, soft(33), noise=0.03), flat_problem(6)]
    options = {"num_steps": 25, "noise": 1e-3, "final": 1e-9, "fall": 0.5}
    tracks, weights, start = padded_problems(problems)
    fitted, history, change = fit_procrustean_normal(tracks, weights, start, **options)
    assert {1, 4} == set(sizes)  # some steps were undone, of one clip only
    for k, one in enumerate(problems):
        alone, likelihood, moved = fit(*one, **options)
        frames = len(one[0])
        assert_close(history[:, k], likelihood, rtol=1e-9, atol=1e-6)
        assert_close(change[k], moved, rtol=1e-4, atol=1e-9)
        assert_close(fitted.shapes()[k, :frames], alone.shapes(), rtol=0, atol=1e-7)
        assert not fitted.shapes()[k, frames:].any()


def test_a_clip_that_ends_early_leaves_the_others_going(monkeypatch):
    calls = []

    def broken(now, data, *others):
        calls.append(found := expect(now, data, *others))
        lost = (data.frames == 20) & torch.tensor(len(calls) > 4)
        return replace(found, likelihood=torch.where(lost, torch.nan, found.likelihood))

    monkeypatch.setattr(module, "expect", broken)
    problems = [problem(30, depth=1e-3), problem(20, depth=1e-3)]
    options = {"num_steps": 8, "noise": 0.1, "fall": 0.9}
    fitted, history, change = fit_procrustean_normal(*padded_problems(problems), **options)
    for k, one in enumerate(problems):
        calls.clear()
        alone, likelihood, moved = fit(*one, **options)
        assert len(likelihood) == (9, 4)[k]
        assert_close(history[: len(likelihood), k], likelihood)
        assert_close(change[k], moved)
        assert_close(fitted.shapes()[k, : len(one[0])], alone.shapes())


@pytest.mark.parametrize("chunk", [1, 70, 250, 10**6])
def test_how_many_frames_go_together_makes_no_difference(monkeypatch, chunk):
    tracks, weights, start = padded_problems([problem(14, soft(14)), problem(20), problem(6), problem(11, soft(11))])
    one = torch.ones(4).double()
    whole = expect(start, Image.of(tracks, weights), 1e-3 * one, one)
    monkeypatch.setattr(module, "CHUNK", chunk)
    assert_close(vars(expect(start, Image.of(tracks, weights), 1e-3 * one, one)), vars(whole))


@quiet
def test_a_batch_takes_few_more_operations_than_a_clip(monkeypatch):
    """Sixteen clips of nearly one length, where caches do not bound how many frames go together, as on a GPU."""
    monkeypatch.setattr(module, "CHUNK", module.GPU_CHUNK)
    clips = [walking_person(n, turn=150.0, yaw=3.0 * n).tracks for n in range(24, 40)]
    one, many = (count_operations(lambda c=some: PND(num_steps=20).many(c)).total for some in (clips[-1:], clips))
    assert many < 3 * one


@quiet
def test_pnd_finds_procrustean_shapes_that_are_seen_from_all_sides():
    shapes, _ = procrustean(150, 16, modes=8, size=0.3)
    view = complete_rotation(tumbling(150, 700.0))
    zoom = torch.linspace(0.8, 1.2, 150).double()[:, None, None]
    truth = zoom * (shapes @ view.mT)
    tracks = kt.Tracks.from_arrays(truth[..., :2])
    result = PND()(tracks)
    assert error(result.points, truth) < 0.1
    assert camera_disagreement(result.cameras, view[:, :2]) < 1.0
    assert result.diagnostics.converged
    assert error(kt.SfAM(beta=0.0, camera_path="free")(tracks).points, truth) > 1  # where it starts


@quiet
def test_pnd_fills_gaps_by_its_e_step():
    shapes, _ = procrustean(150, 20, modes=3)
    truth = shapes @ complete_rotation(tumbling(150, 700.0)).mT
    points = truth[..., :2].clone()
    gone = torch.rand(150, 20, generator=torch.Generator().manual_seed(0)) < 0.2
    points[gone] = torch.nan
    found = centred(PND()(kt.Tracks.from_arrays(points)).points)
    flip = torch.tensor([1.0, 1.0, -1.0]).double()
    off = min((found * sign - truth)[gone].norm() for sign in (1, flip))
    assert off < 0.1 * truth[gone].norm()


@quiet
@pytest.mark.parametrize("name", PND2)
def test_pnd_is_as_good_as_the_authors_code(protocol, shared, name):
    found = figures(PND(), protocol, shared, name)
    assert found["e3d"] < 1.12 * PND2[name][0] and found["e3d_world"] < PND2[name][1]
