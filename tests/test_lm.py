"""The bone-length step: against a dense Levenberg-Marquardt, scipy, and its own optimality condition."""

import itertools

import pytest
import scipy.optimize
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from numerics import (
    BODY,
    CHAIN,
    DEVICES,
    FLOATS,
    HALVES,
    RING,
    dense_fit_bones,
    finite,
    gradcheck,
    leaves_arguments_alone,
    normal,
    same_as_loop,
)
from torch.testing import assert_close

from kcs_torch.errors import OptionError, ShapeError
from kcs_torch.functional import bone_lengths
from kcs_torch.skeleton import SKELETONS
from kcs_torch.solvers import fit_bones

BONES = {"tree": BODY.bone_index(), "ring": RING.bone_index(), "chain": CHAIN.bone_index()}
JOINTS = {"tree": 7, "ring": 4, "chain": 4}
each_body = pytest.mark.parametrize("body", BONES)


def problem(body, *batch, share=0.3):
    """Points, and lengths that differ from theirs by some 30 per cent."""
    points = normal(*batch, JOINTS[body], 3)
    size = bone_lengths(points, BONES[body])
    return points, size * (1 + share * normal(*size.shape, seed=1)).abs()


def energy(shape, points, lengths, bones, stiffness):
    bone = (stiffness * (bone_lengths(shape, bones) - lengths).square()).sum(-1)
    return 0.5 * (bone + (shape - points).square().sum((-2, -1)))


@each_body
@pytest.mark.parametrize("damping", [0.0, 0.7])
@pytest.mark.parametrize("num_steps", [1, 2, 4])
def test_every_step_is_that_of_the_dense_system(body, damping, num_steps):
    points, lengths = problem(body)
    stiffness = normal(len(lengths), seed=2).abs()
    got = fit_bones(points, lengths, BONES[body], stiffness=stiffness, num_steps=num_steps, damping=damping)
    assert_close(
        got, dense_fit_bones(points, lengths, BONES[body], stiffness, num_steps, damping), rtol=1e-6, atol=1e-6
    )


def test_start():
    points, lengths = problem("tree")
    start = points + 0.2 * normal(7, 3, seed=5)
    for damping in (0.0, 0.5):
        got = fit_bones(points, lengths, BONES["tree"], num_steps=2, damping=damping, start=start)
        assert_close(got, dense_fit_bones(points, lengths, BONES["tree"], 1.5, 2, damping, start), rtol=1e-6, atol=1e-6)
    assert torch.equal(fit_bones(points, lengths, BONES["tree"], num_steps=0, start=start), start)
    assert torch.equal(fit_bones(points, lengths, BONES["tree"], num_steps=0), points)


@each_body
@pytest.mark.parametrize("stiffness", [0.1, 1.5, 50.0])
def test_solution_is_the_optimum(body, stiffness):
    points, lengths = problem(body)
    bones = BONES[body]
    got = fit_bones(points, lengths, bones, stiffness=stiffness, num_steps=200)
    leaf = got.clone().requires_grad_()
    (grad,) = torch.autograd.grad(energy(leaf, points, lengths, bones, stiffness), leaf)
    assert grad.abs().max() < 1e-5
    best = energy(got, points, lengths, bones, stiffness)
    others = got + 0.05 * normal(300, *points.shape, seed=3)
    assert (energy(others, points, lengths, bones, stiffness) > best).all()
    found = scipy.optimize.least_squares(
        lambda flat: torch.cat(
            [
                stiffness**0.5 * (bone_lengths(torch.from_numpy(flat).reshape(points.shape), bones) - lengths),
                torch.from_numpy(flat) - points.flatten(),
            ]
        ).numpy(),
        points.flatten().numpy(),
        xtol=1e-12,
        ftol=1e-12,
        gtol=1e-12,
    )
    assert_close(got.flatten(), torch.from_numpy(found.x), rtol=0, atol=1e-4)


def test_a_few_steps_suffice_near_the_solution():
    """A body of mean bone length 1 with joints displaced by 1 per cent: each step gains a digit."""
    body = SKELETONS["h36m17"]
    bones, rest = body.bone_index(), body.template_points(dtype=torch.float64)
    rest = rest / bone_lengths(rest, bones).mean()
    points = rest + 0.01 * normal(50, 17, 3)
    limit = fit_bones(points, bone_lengths(rest, bones), bones, num_steps=50)
    for steps, error in [(1, 1e-3), (2, 1e-4), (3, 1e-5), (4, 1e-6)]:
        assert (fit_bones(points, bone_lengths(rest, bones), bones, num_steps=steps) - limit).abs().max() < error


def test_short_bones_settle():
    """A heel whose joints have to move by more than its length: undamped steps would turn it back and forth for ever.

    So would they bones that are far longer than their targets.
    """
    leg = torch.tensor([[0, 0, 0], [0, 0.42, 0], [0.02, 0.57, 0], [-0.033, 0.42, 0]], dtype=torch.float64)
    points = leg + 0.05 * normal(200, 4, 3)
    bones, lengths = torch.tensor([[0, 1], [1, 2], [1, 3]]), torch.tensor([0.42, 0.15, 0.033], dtype=torch.float64)
    for damping in (0.0, 2.0):
        found = fit_bones(points, lengths, bones, stiffness=100.0, num_steps=10, damping=damping)
        off = (bone_lengths(found, bones) - lengths).abs() / lengths
        assert (off.amax(-1) > 0.05).double().mean() < 0.1


@pytest.mark.parametrize("stiffness", [1.5, 100.0])
def test_more_steps_never_raise_the_objective(stiffness):
    """Neither where all bones are three times too long, nor in a frame whose steps are not those of its neighbours."""
    body = SKELETONS["h36m17"]
    bones, rest = body.bone_index(), body.template_points(dtype=torch.float64)
    rest = rest / bone_lengths(rest, bones).mean()
    lengths = bone_lengths(rest, bones)
    points = rest * torch.tensor([1.0, 2.0, 3.0])[:, None, None] + 0.1 * normal(3, 17, 3)
    last = energy(points, points, lengths, bones, stiffness)
    for num_steps in range(2, 12):
        fitted = fit_bones(points, lengths, bones, stiffness=stiffness, num_steps=num_steps)
        now = energy(fitted, points, lengths, bones, stiffness)
        assert (now <= last + 1e-6).all()
        last = now
    best = fit_bones(points, lengths, bones, stiffness=stiffness, num_steps=200).requires_grad_()
    (grad,) = torch.autograd.grad(energy(best, points, lengths, bones, stiffness).sum(), best)
    assert grad.abs().max() < 1e-5 * stiffness


def test_steps_that_are_not_taken_leave_the_derivatives_right():
    body = SKELETONS["h36m17"]
    bones, rest = body.bone_index(), body.template_points(dtype=torch.float64)
    rest = rest / bone_lengths(rest, bones).mean()
    run = lambda p, ell: fit_bones(p, ell, bones, num_steps=4)  # noqa: E731
    assert gradcheck(run, 3 * rest, bone_lengths(rest, bones), fast=True)
    # Where nothing moves, steps differ from none by rounding: they are taken, or there would be no derivative.
    lengths = bone_lengths(rest, bones).requires_grad_()
    (grad,) = torch.autograd.grad((fit_bones(rest, lengths, bones) * normal(17, 3)).sum(), lengths)
    assert (grad != 0).all()


def test_damping_does_not_move_the_solution():
    points, lengths = problem("tree", 4, share=0.1)
    plain = fit_bones(points, lengths, BONES["tree"], num_steps=100)
    damped = fit_bones(points, lengths, BONES["tree"], num_steps=400, damping=3.0)
    assert_close(damped, plain, rtol=0, atol=1e-7)
    once = fit_bones(points, lengths, BONES["tree"], num_steps=1, damping=3.0) - points
    assert (once.norm() < 0.6 * (fit_bones(points, lengths, BONES["tree"], num_steps=1) - points).norm()).all()


def test_lengths_that_fit_already_move_nothing():
    points, _ = problem("tree", 3)
    lengths = bone_lengths(points, BONES["tree"])
    assert_close(fit_bones(points, lengths, BONES["tree"]), points, rtol=0, atol=1e-7)


def test_the_mean_stays():
    points, lengths = problem("tree", 3)
    assert_close(fit_bones(points, lengths, BONES["tree"]).mean(-2), points.mean(-2))


def test_rotation_passes_through():
    points, lengths = problem("tree")
    turn = torch.linalg.qr(normal(3, 3))[0]
    assert_close(fit_bones(points @ turn, lengths, BONES["tree"]), fit_bones(points, lengths, BONES["tree"]) @ turn)


def test_stiffness_zero_frees_a_bone():
    points, lengths = problem("tree")
    free = fit_bones(points, lengths, BONES["tree"], stiffness=0.0)
    assert torch.equal(free, points)
    stiffness = torch.full((6,), 2.0).double()
    stiffness[2] = 0
    kept = [0, 1, 3, 4, 5]
    part = fit_bones(points, lengths[kept], BONES["tree"][kept], stiffness=2.0)
    assert_close(fit_bones(points, lengths, BONES["tree"], stiffness=stiffness), part)


@pytest.mark.parametrize("dtype", FLOATS)
def test_stiffness_zero_has_a_derivative(dtype):
    """The root of the stiffness has none: this was NaN."""
    points, lengths = problem("chain")
    (_, _, grad) = finite(
        lambda p, ell, k: fit_bones(p, ell, BONES["chain"], stiffness=k),
        points.to(dtype),
        lengths.to(dtype),
        torch.tensor([0.0, 1.0, 0.0], dtype=dtype),
    )
    assert (grad != 0).all()
    if dtype == torch.float64:  # one-sided difference
        cotangent = normal(4, 3, seed=9)
        value = lambda k: (fit_bones(points, lengths, BONES["chain"], stiffness=k) * cotangent).sum()  # noqa: E731
        for bone in (0, 2):
            up = torch.tensor([0.0, 1.0, 0.0]).double()
            base = value(up)
            up[bone] = 1e-6
            assert_close((value(up) - base) / 1e-6, grad[bone], rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("dtype", FLOATS)
@pytest.mark.parametrize("stiffness", [1e5, 1e8, 1e15, float("inf")])
def test_stiffness_without_bound(dtype, stiffness):
    """More links than degrees of freedom, which makes the bones' system singular but for its unit diagonal."""
    bones = torch.tensor(list(itertools.combinations(range(6), 2)))
    points = normal(20, 6, 3, dtype=dtype)
    target = bone_lengths(points + 0.01 * normal(20, 6, 3, seed=1, dtype=dtype), bones)
    fitted = fit_bones(points, target, bones, stiffness=stiffness)
    assert (bone_lengths(fitted, bones) - target).abs().max() < 2e-3
    finite(lambda p, ell: fit_bones(p, ell, bones, stiffness=stiffness), points, target)


def test_length_zero_pulls_a_bone_together():
    points = torch.tensor([[0.0, 0, 0], [1, 0, 0]]).double()
    fitted = fit_bones(points, torch.zeros(1).double(), torch.tensor([[0, 1]]), stiffness=1e8)
    assert bone_lengths(fitted, [(0, 1)]) < 1e-6
    soft = fit_bones(points, torch.zeros(1).double(), torch.tensor([[0, 1]]), stiffness=0.5)  # b (1 + 2 beta) = 1
    assert_close(bone_lengths(soft, [(0, 1)]), torch.tensor([0.5]).double())


@each_body
def test_gradient(body):
    points, lengths = problem(body)
    stiffness = normal(len(lengths), seed=2).abs() + 0.1
    for steps, damping in [(1, 0.0), (3, 0.0), (2, 0.5)]:
        run = lambda p, ell, k, s=steps, d=damping: fit_bones(  # noqa: E731
            p, ell, BONES[body], stiffness=k, num_steps=s, damping=d
        )
        assert gradcheck(run, points, lengths, stiffness)
    assert gradcheck(lambda p, s: fit_bones(p, lengths, BONES[body], start=s), points, points + 0.1)


def test_gradient_of_batches_by_broadcasting():
    points, lengths = problem("chain", 2)
    run = lambda p, ell, k: fit_bones(p, ell, BONES["chain"], stiffness=k)  # noqa: E731
    assert gradcheck(run, points, lengths[0], torch.tensor(1.5).double(), fast=True)


def test_other_precisions_are_brought_to_that_of_the_points():
    points, lengths = problem("chain")
    expected = fit_bones(points, lengths, BONES["chain"], start=points + 0.1)
    found = fit_bones(points, lengths.float(), BONES["chain"], start=(points + 0.1).float())
    assert_close(found, expected, rtol=1e-5, atol=1e-5)
    assert fit_bones(points.float(), lengths, BONES["chain"]).dtype == torch.float32
    with pytest.raises(ShapeError, match="fit_bones: points: expected floating point, got torch.int64"):
        fit_bones(points.long(), lengths, BONES["chain"])
    with pytest.raises(ShapeError, match=r"fit_bones: points and lengths: expected the same batch, got \(2, "):
        fit_bones(torch.stack([points] * 2), torch.stack([lengths] * 3), BONES["chain"])


def test_second_derivative():
    points, lengths = problem("chain")
    leaves = [points.requires_grad_(), lengths.requires_grad_(), torch.tensor(1.5).double().requires_grad_()]
    run = lambda p, ell, k: fit_bones(p, ell, BONES["chain"], stiffness=k, num_steps=2)  # noqa: E731
    assert torch.autograd.gradgradcheck(run, leaves, fast_mode=True)


def test_gradient_at_a_bone_of_length_zero():
    """Its direction is smoothed over 1e-4 of the mean length: the derivative is steep there, and right."""
    points, lengths = problem("chain")
    points[2] = points[1]
    run = lambda p, ell: fit_bones(p, ell, BONES["chain"], num_steps=1)  # noqa: E731
    leaves = (points.requires_grad_(), lengths.requires_grad_())
    assert torch.autograd.gradcheck(run, leaves, eps=1e-7, rtol=1e-3, atol=1e-3)
    assert torch.isfinite(fit_bones(points, lengths, BONES["chain"], num_steps=5)).all()


def test_gradient_at_a_target_of_zero():
    points, lengths = problem("chain")
    lengths[1] = 0
    run = lambda p, ell: fit_bones(p, ell, BONES["chain"], num_steps=2)  # noqa: E731
    assert gradcheck(run, points, lengths)


@given(
    st.integers(0, 10**6),
    st.floats(-6, 6),
    st.floats(-6, 6),
    st.floats(-6, 6),
    st.sampled_from(FLOATS),
    st.sampled_from(sorted(BONES)),
)
@settings(max_examples=60, deadline=None)
def test_nothing_is_nan_at_any_scale(seed, size, length, stiffness, dtype, body):
    points = normal(2, JOINTS[body], 3, seed=seed, dtype=dtype) * 10.0**size
    lengths = normal(len(BONES[body]), seed=seed + 1, dtype=dtype).abs() * 10.0**length
    if seed % 2:
        points[0, 1] = points[0, 0]
    if seed % 3 == 0:
        lengths[0] = 0
    if seed % 5 == 0:
        points[1] = 0
    beta = torch.tensor(10.0**stiffness, dtype=dtype)
    finite(lambda p, ell, k: fit_bones(p, ell, BONES[body], stiffness=k, num_steps=1), points, lengths, beta)
    fitted = fit_bones(points, lengths, BONES[body], stiffness=beta, num_steps=5)
    assert torch.isfinite(fitted).all()


@pytest.mark.parametrize("dtype", FLOATS)
@pytest.mark.parametrize("length", [0.0, 1.0])
def test_a_body_at_a_single_point(dtype, length):
    lengths = torch.full((6,), length, dtype=dtype)
    finite(lambda p, ell: fit_bones(p, ell, BONES["tree"]), torch.zeros(2, 7, 3, dtype=dtype), lengths)


def test_batches_equal_loops():
    same_as_loop(lambda p, ell: fit_bones(p, ell.abs(), BONES["tree"]), (7, 3), (6,))
    same_as_loop(lambda p, ell, k: fit_bones(p, ell.abs(), BONES["tree"], stiffness=k.abs()), (7, 3), (6,), (6,))
    same_as_loop(lambda p, ell: fit_bones(p, ell.abs(), BONES["tree"], damping=0.3), (7, 2), (6,))  # in the plane


def test_the_default_device_makes_no_difference():
    points, lengths = problem("tree", 2)
    for options in ({"num_steps": 3}, {"num_steps": 1, "damping": 0.5}):
        usual = fit_bones(points, lengths, BONES["tree"], **options)
        with torch.device("meta"):
            assert torch.equal(fit_bones(points, lengths, BONES["tree"], **options), usual)


def test_no_bones():
    points = normal(2, 4, 3)
    none = torch.zeros(0, 2, dtype=torch.long)
    assert torch.equal(fit_bones(points, torch.zeros(0).double(), none), points)


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("dtype", FLOATS + HALVES)
def test_results_follow_dtype_and_device(dtype, device):
    points, lengths = (x.to(device, dtype) for x in problem("tree", 2))
    bones = BONES["tree"].to(device)
    got = leaves_arguments_alone(lambda p, ell: fit_bones(p, ell, bones), points, lengths)
    assert (got.dtype, got.device.type) == (dtype, device)
    expected = fit_bones(points.double(), lengths.double(), bones)
    assert_close(got.double(), expected, rtol=0, atol=100 * torch.finfo(dtype).eps)
    assert fit_bones(points, lengths, bones, start=points).dtype == dtype


@pytest.mark.parametrize(
    "options", [{"num_steps": -1}, {"damping": -0.1}, {"stiffness": -1.0}, {"stiffness": float("nan")}]
)
def test_options_out_of_range(options):
    with pytest.raises(OptionError, match="fit_bones: expected"):
        fit_bones(*problem("tree"), BONES["tree"], **options)


def test_shapes_that_do_not_fit():
    points, lengths = problem("tree")
    with pytest.raises(ShapeError, match=r"lengths \(\.\.\., 6\)"):
        fit_bones(points, lengths[:4], BONES["tree"])
    with pytest.raises(ShapeError, match="points"):
        fit_bones(points[0], lengths, BONES["tree"])
    with pytest.raises(ShapeError, match=r"fit_bones: start: expected shape \(\.\.\., 7, 3\), got"):
        fit_bones(points, lengths, BONES["tree"], start=points[..., :2])
    for shape in [(5,), (3, 6)]:
        with pytest.raises(ShapeError, match=r"fit_bones: stiffness: expected a number or a tensor that broadcasts"):
            fit_bones(torch.stack([points] * 4), lengths, BONES["tree"], stiffness=torch.ones(shape))


def test_bones_may_be_a_list():
    points, lengths = problem("tree")
    assert torch.equal(fit_bones(points, lengths, BONES["tree"].tolist()), fit_bones(points, lengths, BONES["tree"]))
