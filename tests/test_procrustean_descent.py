"""The Procrustean objective's gradient written out, against autograd through its energies; rotations from vectors."""

import math
from functools import partial

import pytest
import roma
import torch
from numerics import BODY, CHAIN, RING, count_operations, gradcheck, normal, rotations
from torch.testing import assert_close

from kcs_torch.functional.chain import bone_vectors
from kcs_torch.solvers import procrustean_descent as module
from kcs_torch.solvers.curvature import whitening
from kcs_torch.solvers.procrustean import (
    Stage,
    aligned_levels,
    length_energy,
    motion_energy,
    track_energy,
)
from kcs_torch.solvers.procrustean_descent import Descent, Turn, cross_matrix

STAGES = {
    "poses": Stage(1e-2, 1, 1.0, 0.0, 0.1),
    "changes": Stage(1e-4, 1, 0.01, 1.0, 0.01),
    "changes alone": Stage(1e-3, 1, 0.0, 1.0, 0.03),
}


def problem(
    body=BODY, frames=12, count=2, noise=0.0, stage=STAGES["changes"], rigid=None, dtype=torch.float64, base=None,
):  # fmt: skip
    """A descent, and the same energy as a function that autograd differentiates."""
    joints = body.num_joints
    base = normal(count, frames, joints, 3, dtype=dtype) if base is None else base
    turn = rotations(count, frames, dtype=dtype)
    bones = body.bone_index()
    rigid = bones if rigid is None else rigid
    stiff = 0.5 + normal(len(rigid), seed=1, dtype=dtype).abs()
    tracks, weights = normal(frames, joints, 2, seed=2, dtype=dtype), normal(frames, joints, seed=3, dtype=dtype).abs()
    free = 3 if noise else 1
    size = free * joints + 3
    roots = 0.2 * normal(count, frames, size, size, seed=4, dtype=dtype)
    descent = Descent(
        base, turn, roots, bones, rigid, stiff, stage,
        tracks=tracks, weights=weights, noise=noise,
    )  # fmt: skip

    def move(u):
        step = (roots @ u.view(count, frames, -1, 1)).squeeze(-1)
        shift = step[..., :-3].unflatten(-1, (free, joints)).mT
        shift = torch.nn.functional.pad(shift, (2, 0)) if free == 1 else shift
        return base + shift, roma.rotvec_to_rotmat(step[..., -3:]) @ turn

    def energy(u):
        x, r = move(u)
        total = motion_energy(x, r, bones, stage) + length_energy(x, rigid, stiff, stage.slack)
        return total if not noise else total + track_energy(x, tracks, weights, noise)

    return descent, move, energy, torch.zeros(count, frames * size, dtype=dtype)


def by_autograd(energy, u):
    u = u.clone().requires_grad_()
    value = energy(u)
    return value.detach(), *torch.autograd.grad(value.sum(), u)


def agree(descent, move, energy, u):
    for one, other in zip(descent(u), by_autograd(energy, u), strict=True):
        assert_close(one, other, rtol=1e-9, atol=1e-7 * float(other.abs().amax()))  # few frames, small eps
    for one, other in zip(descent.moved(u), move(u), strict=True):
        assert_close(one, other)


@pytest.mark.parametrize("noise", [0.0, 0.1])
@pytest.mark.parametrize("stage", STAGES)
@pytest.mark.parametrize("run", [1, 7, 20, 39, 40])
def test_long_clips_in_runs(run, stage, noise, monkeypatch):
    """Runs of frames, of which the last may be short, take nothing from the changes between them."""
    descent, _, _, start = problem(frames=40, stage=STAGES[stage], noise=noise)
    u = start + 0.3 * normal(*start.shape, seed=5)
    value, slope = descent(u)
    monkeypatch.setattr(module, "RUN", run)
    for one, other in zip(descent(u), (value, slope), strict=True):
        assert_close(one, other, rtol=1e-9, atol=1e-9 * float(other.abs().amax()))


@pytest.mark.parametrize("noise", [0.0, 0.1])
@pytest.mark.parametrize("stage", STAGES)
@pytest.mark.parametrize("frames", [1, 2, 3, 12])
def test_as_autograd(frames, stage, noise):
    descent, move, energy, start = problem(frames=frames, stage=STAGES[stage], noise=noise)
    for size in (0.0, 1.0, 10.0):
        agree(descent, move, energy, size * normal(*start.shape))


@pytest.mark.parametrize("noise", [0.0, 0.1])
@pytest.mark.parametrize("pairs", [[], [(0, 2)], [(0, 1), (1, 3), (0, 3), (2, 3)]])
@pytest.mark.parametrize("body", [CHAIN, RING], ids=["chain", "ring"])
def test_pairs_that_are_no_bones(body, pairs, noise):
    rigid = torch.tensor(pairs, dtype=torch.long).reshape(-1, 2)
    descent, move, energy, start = problem(body, rigid=rigid, noise=noise)
    agree(descent, move, energy, normal(*start.shape))


@pytest.mark.parametrize("noise", [0.0, 0.1])
def test_held_depths(noise):
    """A pull on each depth, as autograd's of the same."""
    descent, move, energy, start = problem(noise=noise)
    held, weights = normal(2, 12, BODY.num_joints, seed=8), torch.tensor([3.0, 0.5]).double()
    pulled = Descent(
        descent.points.permute(0, 3, 2, 1), descent.rotations.permute(0, 3, 1, 2), descent.roots, BODY.bone_index(),
        BODY.bone_index(), descent.stiffness, STAGES["changes"],
        tracks=normal(12, BODY.num_joints, 2, seed=2), weights=normal(12, BODY.num_joints, seed=3).abs(),
        noise=noise, anchor=(held, weights),
    )  # fmt: skip
    both = lambda u: energy(u) + weights / 2 * (move(u)[0][..., 2] - held).square().sum((-2, -1))  # noqa: E731
    agree(pulled, move, both, normal(*start.shape))
    agree(pulled.rows(torch.tensor([1])), lambda u: [x[1:] for x in move(torch.cat([u, u]))],
          lambda u: both(torch.cat([u, u]))[1:], normal(*start.shape)[1:])  # fmt: skip


@pytest.mark.parametrize("stage", STAGES)
@pytest.mark.parametrize("frames", [(12, 9), (40, 31, 27), (5, 5, 3)])
def test_padded_clips_are_as_alone(frames, stage):
    """Values, slopes and whitening of clips that are padded to one length; what pads them has no slope."""
    longest, bones, stiff = max(frames), BODY.bone_index(), torch.ones(BODY.num_bones).double()
    at = STAGES[stage]
    counts = torch.tensor(frames).double()
    points, turn = normal(len(frames), longest, BODY.num_joints, 3), rotations(len(frames), longest)
    for one, count in zip(points, frames, strict=True):
        one[count:] = 0
    size = BODY.num_joints + 3
    unused = {"tracks": points[0, ..., :2], "weights": points[0, ..., 0], "noise": 0.0}
    levels = lambda x, r, n: aligned_levels(x, r, bones, at, n)  # noqa: E731
    roots = whitening(points, turn, bones, levels(points, turn, counts), 1, bones, stiff, at.slack, counts=counts)
    assert roots.isfinite().all()
    step = 0.1 * normal(len(frames), longest * size, seed=6)
    for one, count in zip(step, frames, strict=True):
        one[count * size :] = 0  # as there is no slope, nothing moves there
    many = Descent(points, turn, roots, bones, bones, stiff, at, counts=counts, **unused)
    value, slope = many(step)
    for i, count in enumerate(frames):
        x, r = points[i : i + 1, :count], turn[i : i + 1, :count]
        own = whitening(x, r, bones, levels(x, r, None), 1, bones, stiff, at.slack)
        if count > 2:
            assert_close(roots[i : i + 1, :count], own)
        alone = Descent(x, r, roots[i : i + 1, :count], bones, bones, stiff, at, **unused)
        expected, slopes = alone(step[i : i + 1, : count * size])
        assert_close(value[i : i + 1], expected)
        assert_close(slope[i : i + 1, : count * size], slopes, rtol=1e-8, atol=1e-8 * float(slopes.abs().amax()))
        assert not slope[i, count * size :].any()
        (part,) = many.rows(torch.tensor([i]))(step[i : i + 1])[:1]
        assert_close(part, expected)


def test_bones_that_are_points():
    """Joints at one place, all frames alike: nothing of it is NaN."""
    base = normal(2, 12, BODY.num_joints, 3)
    descent, *_ = problem(base=0 * base)
    value, slope = descent(torch.zeros(2, 12 * 10).double())
    assert value.isfinite().all() and (slope == 0).all()
    base[:, :, 1] = base[:, :, 0]  # one bone
    descent, _, _, start = problem(base=base)
    assert all(x.isfinite().all() for x in descent(start))


def test_a_step_too_far_is_no_number_and_no_error():
    descent, *_, start = problem()
    value, slope = descent(torch.full_like(start, torch.nan))
    assert value.isnan().all() and slope.isnan().any(-1).all()


@pytest.mark.parametrize("size", [0.0, 1e-12, 1e-6, 1e-3, 0.0547, 0.0548, 0.3, 3.0, math.pi, 7.0])
def test_rotations_from_vectors(size):
    """As roma has them, and gradients as autograd has them: at none, at small and at large angles."""
    unit = normal(5, 3)
    vector = (size * unit / unit.norm(dim=-1, keepdim=True)).mT
    turn = partial(Turn, cross=cross_matrix(vector))
    made = turn(vector).matrices()
    assert_close(made.permute(2, 0, 1), roma.rotvec_to_rotmat(vector.mT), rtol=0, atol=1e-14)
    slopes = normal(3, 3, 5, seed=1)
    found = turn(vector).slopes(slopes)
    if size:
        leaf = vector.mT.clone().requires_grad_()
        made = roma.rotvec_to_rotmat(leaf).permute(1, 2, 0)
        assert_close(found, torch.autograd.grad((made * slopes).sum(), leaf)[0].mT, rtol=0, atol=1e-9)
    for i in range(3):  # against differences
        step = torch.zeros(3, 1).double()
        step[i] = 1e-5
        rise = ((turn(vector + step).matrices() - turn(vector - step).matrices()) * slopes).sum((0, 1)) / 2e-5
        assert_close(found[i], rise, rtol=0, atol=1e-8)


def test_gradient_by_differences():
    descent, _, _, start = problem(frames=4, noise=0.1, count=1)

    class Wrapped(torch.autograd.Function):
        @staticmethod
        def forward(ctx, u):
            value, slope = descent(u)
            ctx.save_for_backward(slope)
            return value

        @staticmethod
        def backward(ctx, grad):
            return grad[:, None] * ctx.saved_tensors[0]

    assert gradcheck(Wrapped.apply, 0.5 * normal(*start.shape), fast=True)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_follows_dtype_and_leaves_its_arguments_alone(dtype):
    descent, *_, start = problem(dtype=dtype, noise=0.1)
    u = normal(*start.shape, dtype=dtype)
    before = u.clone()
    first, again = descent(u), descent(u)
    assert all(x.dtype == dtype for x in first) and torch.equal(u, before)
    assert all(torch.equal(a, b) for a, b in zip(first, again, strict=True))
    assert bone_vectors(descent.moved(u)[0], BODY.bone_index()).dtype == dtype


def test_fewer_operations_than_autograd_takes():
    """Counts, which no busy machine changes: of operations, and of numbers written."""
    for noise, most in ((0.0, 125), (0.1, 145)):
        descent, _, energy, start = problem(frames=60, noise=noise)
        ours = count_operations(lambda d=descent, u=start: d(u))
        naive = count_operations(lambda e=energy, u=start: by_autograd(e, u))
        assert ours.total < most and ours.total < naive.total / 2
        assert ours.elements < naive.elements / 1.5
