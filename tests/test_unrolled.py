"""Unrolled solvers: untrained they are the method; their derivatives hold for whatever comes in."""

import itertools
import math
from copy import deepcopy

import pytest
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
    rotations,
    same_as_loop,
    turning,
)
from torch.func import functional_call
from torch.testing import assert_close

from kcs_torch.errors import OptionError, ShapeError, SkeletonError
from kcs_torch.functional import bone_lengths, rows_to_cameras
from kcs_torch.methods import SfAM
from kcs_torch.nn import MLPLifter, RefinedLifter, UnrolledFPC, UnrolledKCS, UnrolledPKC, UnrolledSfAM
from kcs_torch.nn.steps import continuation, data_scale, estimate_lengths, shape_step, start_shape

BODIES = {"body": BODY, "chain": CHAIN, "ring": RING}
each_body = pytest.mark.parametrize("body", BODIES.values(), ids=BODIES.keys())


def scene(body, kind="any", *, frames=6, turn=90.0, dtype=torch.float64):
    """Tracks (T, N, 2), cameras (T, 2, 3) and weights (T, N); ordinary or degenerate."""
    joints = body.num_joints
    frames = {"one frame": 1, "two frames": 2}.get(kind, frames)
    cameras = turning(frames, turn)[:, :2]
    points = normal(joints, 3) + 0.3 * normal(frames, joints, 3, seed=1)
    weights = torch.ones(frames, joints, dtype=torch.float64)
    if kind == "static":
        points, cameras = points[:1].expand(frames, -1, -1), cameras[:1].expand(frames, -1, -1)
    tracks = points @ cameras.mT + normal(frames, 1, 2, seed=2)
    if kind == "zero":
        tracks = torch.zeros_like(tracks)
    if kind in ("gaps", "unseen joint", "unseen frame", "nothing seen"):
        weights = normal(frames, joints, seed=3).abs().clamp(0.2, 1)
    if kind == "gaps":
        weights = weights * (normal(frames, joints, seed=4) > -0.5)
        weights[(weights > 0).sum(-1) < 2] = 0.5
    if kind == "unseen joint":
        weights[:, 1] = 0
    if kind == "unseen frame":
        weights[2] = 0
    if kind == "nothing seen":
        weights = torch.zeros_like(weights)
    return tuple(x.to(dtype, copy=True) for x in (tracks, cameras, weights))


KINDS = ["any", "static", "one frame", "two frames", "gaps", "unseen joint", "unseen frame", "nothing seen", "zero"]


def naive(body, tracks, cameras, weights, *, steps, mu, final, tau, momentum, beta, articulate_from, corner):
    """The iteration written out, with plain SVDs and 3N x 3N systems: one clip."""
    share = weights[..., None]
    middle = (tracks * share).sum(-2, keepdim=True) / share.sum(-2, keepdim=True)
    centred = tracks - middle
    shape = (centred * (share > 0)) @ cameras
    scale = torch.linalg.svdvals(((centred * share) @ cameras).flatten(-2))[0]
    rigid = list(body.rigid)
    bones = body.bone_index()[rigid]
    seen = (weights[:, bones[:, 0]] > 0) & (weights[:, bones[:, 1]] > 0)
    first = round(articulate_from * steps) if beta > 0 else steps
    ahead = shape
    for k in range(steps):
        residual = ahead @ cameras.mT - tracks
        residual = residual - (residual * share).sum(-2, keepdim=True) / share.sum(-2, keepdim=True)
        gradient = (residual * share) @ cameras
        rate = 2 * tau
        if k >= first:
            rate = tau
            size = bone_lengths(ahead, bones)
            lengths = torch.stack([size[seen[:, b], b].median() for b in range(len(bones))])
            fitted = [dense_fit_bones(frame, lengths, bones, torch.tensor(beta), 1) for frame in ahead]
            gradient = gradient + ahead - torch.stack(fitted)
        u, s, vt = torch.linalg.svd((ahead - rate * gradient).flatten(-2), full_matrices=False)
        level = mu * (final / mu) ** (k / (steps - 1)) * scale
        level = level / (1 + s / (corner * scale))
        new = ((u * (s - rate * level).clamp_min(0)) @ vt).unflatten(-1, shape.shape[-2:])
        ahead, shape = new + momentum * (new - shape), new
    return shape


# ---------------------------------------------------------------------- the iteration


@pytest.mark.parametrize("body", [BODY, CHAIN], ids=["body", "chain"])
@pytest.mark.parametrize("kind", ["any", "gaps", "two frames"])
@pytest.mark.parametrize("momentum", [0.0, 0.8])
@pytest.mark.parametrize("articulate_from", [0.0, 0.6])
@pytest.mark.parametrize("corner", [math.inf, 0.1])
def test_untrained_is_the_iteration_written_out(body, kind, momentum, articulate_from, corner):
    tracks, cameras, weights = scene(body, kind)
    options = {"mu": 0.4, "final": 1e-4, "tau": 0.45, "momentum": momentum, "corner": corner}
    module = UnrolledSfAM(body, 8, beta=1.2, articulate_from=articulate_from, **options)
    expected = naive(body, tracks, cameras, weights, steps=8, beta=1.2, articulate_from=articulate_from, **options)
    assert_close(module(tracks, cameras, weights=weights), expected, rtol=1e-6, atol=1e-6)
    plain = UnrolledFPC(8, **{**options, "tau": 0.9})
    expected = naive(body, tracks, cameras, weights, steps=8, beta=0.0, articulate_from=1.0, **options)
    assert_close(plain(tracks, cameras, weights=weights), expected)
    if kind != "gaps":
        assert_close(module(tracks, cameras), module(tracks, cameras, weights=weights))


@each_body
@pytest.mark.parametrize("learnable", [True, False])
@pytest.mark.parametrize("articulate_from", [0.0, 0.6])
@pytest.mark.parametrize("corner", [math.inf, 0.3])
def test_untrained_is_the_method(body, learnable, articulate_from, corner):
    tracks, cameras, weights = scene(body, "gaps", frames=12, turn=180.0)
    options = {"mu": 0.4, "final": 1e-4, "tau": 0.45, "momentum": 0.7, "beta": 1.2, "corner": corner}
    method = SfAM(num_steps=9, articulate_from=articulate_from, window=None, **options)
    expected = method.shape(tracks[None], cameras[None], weights[None], body).value[0]
    module = UnrolledSfAM(body, 9, articulate_from=articulate_from, learnable=learnable, **options)
    assert_close(module(tracks, cameras, weights=weights), expected)
    method = SfAM(num_steps=9, window=None, **{**options, "beta": 0.0})
    expected = method.shape(tracks[None], cameras[None], weights[None], body).value[0]
    module = UnrolledFPC(9, learnable=learnable, mu=0.4, final=1e-4, tau=0.9, momentum=0.7, corner=corner)
    assert_close(module(tracks, cameras, weights=weights), expected)


def test_defaults_are_those_of_the_method():
    tracks, cameras, weights = scene(BODY, frames=12, turn=180.0)
    expected = (
        SfAM(num_steps=10, momentum=0.8, window=None).shape(tracks[None], cameras[None], weights[None], BODY).value[0]
    )
    assert_close(UnrolledSfAM(BODY)(tracks, cameras), expected)


def test_many_steps_reach_the_optimum():
    """1/2 |R S + t - W|^2 + mu |S#|_*: minus the gradient over mu is a subgradient of the nuclear norm."""
    tracks, cameras, weights = scene(BODY, "gaps", frames=10)
    share = 0.05
    shape = UnrolledFPC(1500, mu=share, final=share, learnable=False)(tracks, cameras, weights=weights)
    level = share * data_scale(tracks, cameras, weights)
    matrix = shape.flatten(-2)

    def misfit(x):
        residual = (x.unflatten(-1, (7, 3)) @ cameras.mT - tracks) * (weights[..., None] > 0)
        mean = (residual * weights[..., None]).sum(-2, keepdim=True) / weights.sum(-1)[:, None, None]
        return 0.5 * (weights[..., None] * (residual - mean).square()).sum()

    leaf = matrix.clone().requires_grad_()
    dual = -torch.autograd.grad(misfit(leaf), leaf)[0] / level
    assert torch.linalg.matrix_norm(dual, 2) < 1 + 1e-6
    assert_close((dual * matrix).sum(), torch.linalg.svdvals(matrix).sum(), rtol=1e-6, atol=0)


def test_articulation_keeps_bones_more_constant():
    tracks, cameras, _ = scene(BODY, frames=30)
    bones = BODY.bone_index()[list(BODY.rigid)]

    def variation(beta_from):
        shape = UnrolledSfAM(BODY, 60, articulate_from=beta_from)(tracks, cameras)
        size = bone_lengths(shape, bones)
        return (size.std(0) / size.mean(0)).mean()

    assert variation(0.5) < 0.5 * variation(1.0)


def test_scale_world_and_translation_pass_through():
    tracks, cameras, weights = scene(BODY, "gaps")
    module, turn = UnrolledSfAM(BODY, 8), rotations()
    shape = module(tracks, cameras, weights=weights)
    assert_close(module(1e3 * tracks, cameras, weights=weights), 1e3 * shape)
    assert_close(module(tracks, cameras @ turn, weights=weights), shape @ turn)
    assert_close(module(tracks + normal(6, 1, 2), cameras, weights=weights), shape)
    order = torch.tensor([3, 1, 5, 0, 2, 4])
    assert_close(module(tracks[order], cameras[order], weights=weights[order]), shape[order])


def test_unseen_joints_do_not_count():
    tracks, cameras, weights = scene(BODY, "gaps")
    elsewhere = torch.where(weights[..., None] > 0, tracks, 50 + tracks)
    module = UnrolledSfAM(BODY, 8)
    assert_close(module(elsewhere, cameras, weights=weights), module(tracks, cameras, weights=weights))


@pytest.mark.parametrize("dtype", FLOATS)
def test_a_frame_without_a_bone_gets_a_pose(dtype):
    """Started at a single point it stayed there, or grew out of rounding in any direction."""
    tracks, cameras, weights = scene(BODY, frames=20, dtype=dtype)
    weights[8:10] = 0
    weights[9, 3] = 1  # a single joint tells nothing of the shape
    start = start_shape(tracks, cameras, weights)
    assert_close(start[8], (2 * start[7] + start[10]) / 3)
    for module, least in [
        (UnrolledFPC(30), 0.2),
        (UnrolledSfAM(BODY, 30), 0.5),
    ]:  # only bones hold it against shrinkage
        size = module(tracks, cameras, weights=weights).square().sum((-2, -1)).sqrt()
        assert (size[8:10] > least * size.median()).all() and (size[8:10] < 1.5 * size.median()).all()


def test_lengths_may_be_given():
    tracks, cameras, _ = scene(BODY, frames=10)
    module = UnrolledSfAM(BODY, 40, beta=20.0)
    bones = BODY.bone_index()
    own = bone_lengths(module(tracks, cameras), bones).median(0).values
    target = own * torch.tensor([9.0, 1.3, 1, 1, 1, 1])  # the spine is flexible: its length does not count
    found = bone_lengths(module(tracks, cameras, lengths=target), bones).median(0).values
    assert (found[1] - target[1]).abs() < 0.5 * (own[1] - target[1]).abs()
    other = own * torch.tensor([0.1, 1.3, 1, 1, 1, 1])
    assert_close(module(tracks, cameras, lengths=other), module(tracks, cameras, lengths=target))


def test_a_start_may_be_given():
    tracks, cameras, weights = scene(BODY, "gaps")
    module = UnrolledSfAM(BODY, 5)
    usual = module(tracks, cameras, weights=weights)
    start = start_shape(tracks, cameras, weights)
    assert_close(module(tracks, cameras, weights=weights, start=start), usual)
    assert not torch.allclose(module(tracks, cameras, weights=weights, start=start + normal(6, 7, 3)), usual)


def test_solve_tells_of_convergence():
    tracks, cameras, _ = scene(BODY, frames=20)
    short, long = UnrolledSfAM(BODY, 4), UnrolledSfAM(BODY, 200)
    assert not short.solve(tracks, cameras).converged
    solution = long.solve(tracks, cameras)
    assert solution.converged and solution.iterations == 200
    assert torch.equal(long(tracks, cameras), solution.value)


def test_windows_of_one_body_share_their_lengths():
    tracks, cameras, weights = scene(BODY, frames=12)
    cut = lambda x: x.reshape(2, 6, *x.shape[1:])  # noqa: E731
    arguments, module = (cut(tracks), cut(cameras)), UnrolledSfAM(BODY, 1, articulate_from=0.0, momentum=0.0)
    got = module.solve(*arguments, weights=cut(weights), one_body=True).value
    start = start_shape(tracks, cameras, weights)
    bones = BODY.bone_index()[list(BODY.rigid)]
    lengths = bone_lengths(start, bones).median(0).values  # of all frames
    given = torch.cat([torch.ones(1).double(), lengths])
    assert_close(got, module(*arguments, weights=cut(weights), lengths=given))
    double = module.solve(*arguments, weights=cut(weights), lengths=7.0 * given, one_body=True).value
    assert_close(double, got)  # proportions only


# ---------------------------------------------------------------------- derivatives

SMOOTH_KINDS = ["any", "one frame", "two frames", "gaps", "unseen joint", "unseen frame"]


def with_parameters(module):
    """The module as a function of inputs and parameters, and its parameters."""
    names = [name for name, _ in module.named_parameters()]

    def run(inputs, parameters, **options):
        return functional_call(module, dict(zip(names, parameters, strict=True)), inputs, options)

    return run, [p.detach() for p in module.parameters()]


@pytest.mark.parametrize("kind", [*SMOOTH_KINDS, "static"])
@pytest.mark.parametrize("corner", [math.inf, 0.3])
def test_fpc_gradient(kind, corner):
    tracks, cameras, weights = scene(CHAIN, kind, frames=4)
    run, parameters = with_parameters(UnrolledFPC(3, mu=0.3, final=0.03, corner=corner))

    def function(w, r, *values):
        return run((w, r), values, weights=weights)

    assert gradcheck(function, tracks, cameras, *parameters)


@pytest.mark.parametrize("kind", SMOOTH_KINDS)
@pytest.mark.parametrize("body", [BODY, CHAIN], ids=["body", "chain"])
def test_sfam_gradient(kind, body):
    tracks, cameras, weights = scene(body, kind, frames=5)
    run, parameters = with_parameters(UnrolledSfAM(body, 3, mu=0.3, final=0.03, articulate_from=0.3))

    def function(w, r, *values):
        return run((w, r), values, weights=weights)

    assert gradcheck(function, tracks, cameras, *parameters, fast=body is BODY)


@pytest.mark.parametrize("kind", [*SMOOTH_KINDS, "static"])
def test_sfam_gradient_with_lengths_and_start(kind):
    """Lengths are given: a median of equal lengths, as static tracks have, has no derivative."""
    tracks, cameras, weights = scene(CHAIN, kind, frames=4)
    start = start_shape(tracks, cameras, weights) + 0.3 * normal(*tracks.shape[:-1], 3, seed=8)
    run, parameters = with_parameters(UnrolledSfAM(CHAIN, 2, mu=0.3, final=0.1, articulate_from=0.0))

    def function(w, r, s, ell, *values):
        return run((w, r), values, weights=weights, start=s, lengths=ell)

    assert gradcheck(function, tracks, cameras, start, torch.tensor([1.0, 2.0, 1.5]).double(), *parameters, fast=True)


def test_gradient_in_the_weights():
    tracks, cameras, _ = scene(CHAIN, frames=4)
    weights = normal(4, 4, seed=3).abs().clamp(0.2, 1)
    for module in (UnrolledFPC(3, mu=0.3, final=0.03), UnrolledSfAM(CHAIN, 3, mu=0.3, final=0.03)):
        assert gradcheck(lambda w, m=module: m(tracks, cameras, weights=w), weights)


def test_gradient_of_a_batch_and_of_repeated_singular_values():
    """Four joints on the axes: S# has equal singular values from the start."""
    module, bent = UnrolledFPC(2, mu=0.3, final=0.2), UnrolledFPC(2, mu=0.3, final=0.2, corner=0.3)
    eye = torch.eye(3).double()[:2].expand(2, 3, 2, 3)
    tracks = torch.zeros(2, 3, 4, 2).double()
    tracks[:, :, 0, 0] = tracks[:, :, 1, 1] = 1
    tracks[:, :, 2, 0] = tracks[:, :, 3, 1] = -1
    tracks = tracks * torch.tensor([1.0, -1.0, 1.0])[:, None, None]
    assert gradcheck(lambda w, r: module(w, r), tracks, eye, fast=True)
    run, parameters = with_parameters(bent)
    assert gradcheck(lambda w, r, *values: run((w, r), values), tracks, eye, *parameters, fast=True)


@each_body
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("dtype", FLOATS)
@pytest.mark.parametrize("articulate_from", [0.0, 0.6])
def test_degenerate_clips_are_finite(body, kind, dtype, articulate_from):
    tracks, cameras, weights = scene(body, kind, dtype=dtype)
    for module in (UnrolledFPC(6), UnrolledFPC(6, corner=0.1), UnrolledSfAM(body, 6, articulate_from=articulate_from)):
        run, parameters = with_parameters(module.to(dtype))
        finite(lambda w, r, *values, f=run: f((w, r), values, weights=weights), tracks, cameras, *parameters)


@pytest.mark.parametrize("dtype", FLOATS)
@pytest.mark.parametrize("kind", ["zero", "nothing seen", "unseen frame"])
def test_derivatives_do_not_pile_up_over_many_steps(dtype, kind):
    """A bone of length zero has no direction: its derivative, 1e4 a step, would overflow."""
    tracks, cameras, weights = scene(BODY, kind, dtype=dtype)
    module = UnrolledSfAM(BODY, 120, articulate_from=0.0).to(dtype)
    run, parameters = with_parameters(module)
    start = start_shape(tracks, cameras, weights)
    grads = finite(lambda w, r, s, *v: run((w, r), v, weights=weights, start=s), tracks, cameras, start, *parameters)
    assert grads[2].abs().max() < 1e6


@given(
    st.integers(0, 10**6),
    st.floats(-6, 6),
    st.sampled_from(FLOATS),
    st.sampled_from(KINDS),
    st.sampled_from(sorted(BODIES)),
)
@settings(max_examples=40, deadline=None)
def test_nothing_is_nan_at_any_scale(seed, power, dtype, kind, body):
    tracks, cameras, weights = scene(BODIES[body], kind, dtype=dtype)
    tracks = 10.0**power * (tracks + 0.1 * normal(BODIES[body].num_joints, 2, seed=seed, dtype=dtype))
    module = UnrolledSfAM(BODIES[body], 4, articulate_from=(seed % 3) / 2).to(dtype)
    run, parameters = with_parameters(module)
    finite(lambda w, r, *values: run((w, r), values, weights=weights), tracks, cameras, *parameters)


def test_second_derivatives_raise():
    tracks, cameras, _ = scene(CHAIN)
    for module in (UnrolledFPC(2), UnrolledSfAM(CHAIN, 2)):
        leaf = tracks.clone().requires_grad_()
        (grad,) = torch.autograd.grad(module(leaf, cameras).sum(), leaf, create_graph=True)
        with pytest.raises(RuntimeError, match="second derivatives"):
            grad.square().sum().backward()


# ---------------------------------------------------------------------- learning


def test_there_is_a_parameter_for_each_step():
    assert {n: tuple(p.shape) for n, p in UnrolledFPC(4).named_parameters()} == {
        "raw_threshold": (4,),
        "raw_step": (4,),
    }
    names = {n: tuple(p.shape) for n, p in UnrolledSfAM(BODY, 4).named_parameters()}
    assert names == {"raw_threshold": (4,), "raw_step": (4,), "raw_stiffness": (4,), "raw_corner": (4,)}
    # The plain nuclear norm has no corner to learn.
    assert {n for n, _ in UnrolledFPC(4, corner=0.2).named_parameters()} == {"raw_threshold", "raw_step", "raw_corner"}
    assert {n for n, _ in UnrolledSfAM(BODY, 4, corner=math.inf).named_parameters()} == {*names} - {"raw_corner"}
    assert not list(UnrolledSfAM(BODY, 4, learnable=False).parameters())


def test_learning_lowers_the_error_and_keeps_parameters_positive():
    truth = normal(7, 3) + 0.3 * normal(20, 7, 3, seed=1)
    truth = truth - truth.mean(-2, keepdim=True)
    cameras = turning(20, 200.0)[:, :2]
    module = UnrolledSfAM(BODY, 6)
    optimizer = torch.optim.Adam(module.parameters(), lr=0.5)
    losses = []
    for _ in range(25):
        optimizer.zero_grad()
        loss = (module(truth @ cameras.mT, cameras) - truth).square().mean()
        loss.backward()
        optimizer.step()
        losses.append(loss.item())
        for name in ("threshold", "step", "stiffness", "corner"):
            assert (module._values(name, truth) > 0).all()
    assert min(losses) < 0.8 * losses[0]


@pytest.mark.parametrize("dtype", FLOATS)
def test_parameters_pushed_far_stay_harmless(dtype):
    """A softplus underflows to zero in the end."""
    tracks, cameras, weights = scene(BODY, "gaps", dtype=dtype)
    own = {"lengths": range(1, BODY.num_bones + 1), "learnable_lengths": True}
    for value in (-2000.0, -740.0, -100.0, 50.0):
        for name in ("raw_threshold", "raw_stiffness", "raw_corner", "raw_length"):
            module = UnrolledSfAM(BODY, 4, articulate_from=0.0, **own).to(dtype)
            with torch.no_grad():
                getattr(module, name).fill_(value)
            run, parameters = with_parameters(module)
            finite(lambda w, *v, f=run: f((w, cameras), v, weights=weights), tracks, *parameters)


@pytest.mark.parametrize("grad_steps", [0, 1, 2, 4, 9, None])
def test_grad_steps_records_the_last_steps(grad_steps):
    tracks, cameras, _ = scene(BODY)
    options = {"articulate_from": 0.5, "corner": math.inf}
    whole, module = UnrolledSfAM(BODY, 4, **options), UnrolledSfAM(BODY, 4, **options, grad_steps=grad_steps)
    value = module(tracks, cameras)
    assert torch.equal(value, whole(tracks, cameras))
    if grad_steps == 0:
        assert not value.requires_grad
        return
    recorded = 4 if grad_steps is None else min(grad_steps, 4)
    value.square().sum().backward()
    for parameter in (module.raw_step, module.raw_threshold):
        assert torch.equal(parameter.grad != 0, torch.arange(4) >= 4 - recorded)
    assert torch.equal(module.raw_stiffness.grad != 0, torch.arange(4) >= max(4 - recorded, 2))
    if recorded == 1:
        with torch.no_grad():
            state = _states(whole, tracks, cameras)
        by_hand = UnrolledSfAM(BODY, 4, **options)
        last = shape_step(
            state[-1], tracks, cameras, None,
            by_hand._values("threshold", tracks)[3] * data_scale(tracks, cameras), by_hand._values("step", tracks)[3],
            bones=by_hand.bones, lengths=estimate_lengths(state[-1], by_hand.bones)[0],
            stiffness=by_hand._values("stiffness", tracks)[3].expand(5),
        )  # fmt: skip
        assert_close(last, value)
        last.square().sum().backward()
        assert_close(module.raw_step.grad, by_hand.raw_step.grad)


def _states(module, tracks, cameras):
    """The points from which an untrained module makes its steps."""
    points, shape = [start_shape(tracks, cameras, None)], start_shape(tracks, cameras, None)
    for k in range(module.num_steps - 1):
        level = module._values("threshold", tracks)[k] * data_scale(tracks, cameras)
        bones = {}
        if k >= module.first:
            lengths = estimate_lengths(points[-1], module.bones)[0]
            stiffness = module._values("stiffness", tracks)[k].expand(len(module.bones))
            bones = {"bones": module.bones, "lengths": lengths, "stiffness": stiffness}
        new = shape_step(points[-1], tracks, cameras, None, level, module._values("step", tracks)[k], **bones)
        points.append(new + module.momentum * (new - shape))
        shape = new
    return points


@pytest.mark.parametrize("learnable", [True, False])
def test_state_round_trip(learnable, tmp_path):
    tracks, cameras, _ = scene(BODY)
    one = UnrolledSfAM(BODY, 4, mu=0.3, tau=0.4, beta=3.0, corner=0.3, learnable=learnable)
    two = UnrolledSfAM(BODY, 4, learnable=learnable)
    assert set(one.state_dict()) == {"raw_threshold", "raw_step", "raw_stiffness", "raw_corner"}
    torch.save(one.state_dict(), tmp_path / "state.pt")
    two.load_state_dict(torch.load(tmp_path / "state.pt", weights_only=True))
    assert torch.equal(two(tracks, cameras), one(tracks, cameras))


@pytest.mark.parametrize("learnable", [True, False])
def test_states_from_before_corners_were_learned(learnable):
    """The corner stays what the constructor was told, as it was then; a plain norm takes no other's corners."""
    tracks, cameras, _ = scene(BODY)
    for make in (lambda **o: UnrolledSfAM(BODY, 4, **o), lambda **o: UnrolledFPC(4, **o)):
        old = make(mu=0.3, corner=0.3, learnable=learnable)
        state = {name: value for name, value in old.state_dict().items() if name != "raw_corner"}
        new = make(corner=0.3, learnable=learnable)
        kept = dict(state)
        new.load_state_dict(kept)
        assert kept.keys() == state.keys()
        assert torch.equal(new(tracks, cameras), old(tracks, cameras))
        inside = torch.nn.Sequential(make(corner=0.3, learnable=learnable))
        inside.load_state_dict({f"0.{name}": value for name, value in state.items()})
        assert torch.equal(inside[0](tracks, cameras), old(tracks, cameras))
        plain = make(corner=math.inf, learnable=learnable)
        plain.load_state_dict(state)
        with pytest.raises(RuntimeError, match="raw_corner"):
            plain.load_state_dict(old.state_dict())


def test_each_step_has_its_corner():
    """Learned corners that differ: the steps one after another, each with its own."""
    tracks, cameras, weights = scene(BODY, "gaps")
    corners = torch.tensor([0.5, 0.02, 3.0], dtype=torch.float64)
    module = UnrolledFPC(3, mu=0.3, final=0.03, momentum=0.0, corner=0.2)
    with torch.no_grad():
        module.raw_corner.copy_(corners.expm1().log())
    shape, scale = start_shape(tracks, cameras, weights), data_scale(tracks, cameras, weights)
    for level, corner in zip(continuation(3, 0.3, 0.03), corners, strict=True):
        one = torch.as_tensor(level) * scale
        shape = shape_step(shape, tracks, cameras, weights, one, 1.0, corner=corner * scale)
    assert_close(module(tracks, cameras, weights=weights), shape)


def test_learning_turns_a_wrong_corner():
    """Truth of rank two, which a corner far too large makes smaller: once it has fallen, the error has, too."""
    truth = (normal(20, 2, seed=5) @ normal(2, 21, seed=6)).unflatten(-1, (7, 3))
    truth = truth - truth.mean(-2, keepdim=True)
    cameras = turning(20, 200.0)[:, :2]
    module = UnrolledFPC(6, mu=0.3, final=0.05, corner=2.0)
    for name in ("raw_threshold", "raw_step"):
        getattr(module, name).requires_grad_(False)
    optimizer = torch.optim.Adam([module.raw_corner], lr=0.3)
    losses = []
    for _ in range(20):
        optimizer.zero_grad()
        loss = (module(truth @ cameras.mT, cameras) - truth).square().mean()
        loss.backward()
        optimizer.step()
        losses.append(loss.item())
    assert losses[-1] < 0.5 * losses[0] and (module._values("corner", truth)[1:] < 1.0).all()


@pytest.mark.parametrize("body", [BODY, "h36m17"])
def test_casting_the_module(body):
    module = UnrolledSfAM(body, 4)
    joints = module.skeleton.num_joints
    tracks, cameras = normal(6, joints, 2), turning(6)[:, :2]
    before = module(tracks, cameras)
    module.to(torch.float32)
    assert {p.dtype for p in module.parameters()} == {torch.float32} and module.bones.dtype == torch.long
    assert_close(module(tracks.float(), cameras.float()), before.float(), rtol=1e-3, atol=1e-3)
    assert_close(module(tracks, cameras), before, rtol=1e-4, atol=1e-4)


# ---------------------------------------------------------------------- shapes, precision, options


@each_body
def test_batches_equal_loops(body):
    joints = body.num_joints
    camera = lambda *a: (a[0], rows_to_cameras(a[1])[0], *[x.abs() for x in a[2:]])  # noqa: E731
    fpc, sfam = UnrolledFPC(4), UnrolledSfAM(body, 4, articulate_from=0.25)
    same_as_loop(fpc, (5, joints, 2), (5, 2, 3), make=camera)
    same_as_loop(sfam, (5, joints, 2), (5, 2, 3), make=camera)
    same_as_loop(lambda w, r, c: sfam(w, r, weights=c), (5, joints, 2), (5, 2, 3), (5, joints), make=camera)
    same_as_loop(lambda w, r, ell: sfam(w, r, lengths=ell), (5, joints, 2), (5, 2, 3), (body.num_bones,), make=camera)
    same_as_loop(lambda w, r, s: sfam(w, r, start=s), (5, joints, 2), (5, 2, 3), (5, joints, 3), make=camera)


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("dtype", FLOATS + HALVES)
def test_results_follow_dtype_and_device(dtype, device):
    tracks, cameras, weights = (x.to(device) for x in scene(BODY, "gaps", dtype=dtype))
    for module in (UnrolledFPC(3), UnrolledSfAM(BODY, 3)):
        module.to(device)
        run = lambda w, r, c, m=module: m(w, r, weights=c)  # noqa: E731
        value = leaves_arguments_alone(run, tracks, cameras, weights)
        assert (value.dtype, value.device.type) == (dtype, device)
        assert torch.isfinite(value).all()


@pytest.mark.parametrize("device", DEVICES)
def test_autocast_does_not_coarsen(device):
    """Nor does a start in half precision, which a network under autocast gives, break anything."""
    tracks, cameras, _ = (x.to(device) for x in scene(BODY, dtype=torch.float32))
    for module in (UnrolledFPC(5), UnrolledSfAM(BODY, 5)):
        module.to(device)
        expected = module(tracks, cameras)
        with torch.autocast(device, dtype=torch.bfloat16):
            assert torch.equal(module(tracks, cameras), expected)
            start = normal(6, 7, 3, dtype=torch.bfloat16, device=device)
            assert module(tracks, cameras, start=start).dtype == torch.float32


def test_shapes_that_do_not_fit():
    tracks, cameras, weights = scene(BODY)
    for module in (UnrolledFPC(2), UnrolledSfAM(BODY, 2)):
        for wrong in (tracks[0], tracks[:4], normal(6, 7, 3)):
            with pytest.raises(ShapeError, match=r"tracks \(\.\.\., T, N, 2\) and cameras"):
                module(wrong, cameras)
        with pytest.raises(ShapeError, match=r"of rotations the first two rows, cameras\[\.\.\., :2, :\]"):
            module(tracks, turning(6))
        with pytest.raises(ShapeError, match="at least 1 frame"):
            module(tracks[:0], cameras[:0])
        with pytest.raises(ShapeError, match="tracks in floating point, got torch.int64"):
            module(tracks.long(), cameras)
        for wrong in (
            (tracks.numpy(), cameras, None),
            (tracks, cameras.numpy(), None),
            (tracks, cameras, tracks.numpy()),
        ):
            with pytest.raises(ShapeError, match=r"a tensor of (tracks|cameras|start), got ndarray"):
                module(wrong[0], wrong[1], start=wrong[2])
        many = tracks.expand(3, -1, -1, -1)
        with pytest.raises(ShapeError, match=r"cameras like that of tracks \(3, 6, 7, 2\), got \(2, 6, 2, 3\)"):
            module(many, cameras.expand(2, -1, -1, -1))
        with pytest.raises(ShapeError, match="start like that of tracks"):
            module(many, cameras, start=normal(2, 6, 7, 3))
        with pytest.raises(ShapeError, match=r"weights \(\.\.\., 6, 7\)"):
            module(tracks, cameras, weights=weights[:, :5])
        with pytest.raises(ShapeError, match=r"start \(\.\.\., 6, 7, 3\)"):
            module(tracks, cameras, start=tracks)


@pytest.mark.parametrize("joints", [6, 8])
def test_wrong_joint_count_names_the_skeleton(joints):
    """More joints than the skeleton has were taken without a word."""
    with pytest.raises(ShapeError, match="7, 2.*skeleton 'body7', got"):
        UnrolledSfAM(BODY, 2)(normal(6, joints, 2), turning(6)[:, :2])
    tracks, cameras, _ = scene(BODY)
    with pytest.raises(ShapeError, match=r"lengths \(\.\.\., 6\), got \(5,\)"):
        UnrolledSfAM(BODY, 2)(tracks, cameras, lengths=torch.ones(5))


@pytest.mark.parametrize("layer", [UnrolledSfAM, UnrolledPKC])
def test_lengths_that_are_not_of_the_batch(layer):
    """Lengths of other clips ended in an error of torch, or in one about the batch of something."""
    tracks, cameras, _ = (x.expand(2, *x.shape) for x in scene(BODY))
    with pytest.raises(ShapeError, match=r"lengths \(\.\.\., 6\), got \(3, 6\) for tracks \(2, 6, 7, 2\)"):
        layer(BODY, 2)(tracks, cameras, lengths=torch.ones(3, 6))
    with pytest.raises(ShapeError, match="expected a tensor of lengths, got list"):
        layer(BODY, 2)(tracks, cameras, lengths=[1.0] * 6)


@pytest.mark.parametrize("deterministic", [False, True])
@pytest.mark.parametrize("layer", [UnrolledFPC(2), UnrolledSfAM(BODY, 2), UnrolledPKC(BODY, 2)])
def test_shapes_are_known_without_data(layer, deterministic):
    """The meta device has as few deterministic operations as a GPU: with them layers failed there."""
    torch.use_deterministic_algorithms(deterministic)
    tracks, cameras, weights = (x.to("meta") for x in scene(BODY, "gaps"))
    assert deepcopy(layer).to("meta")(tracks, cameras, weights=weights).shape == (6, 7, 3)


@pytest.mark.parametrize("layer", [UnrolledFPC(2), UnrolledSfAM(BODY, 2), UnrolledPKC(BODY, 2)])
def test_weights_and_lengths_may_have_another_precision(layer):
    tracks, cameras, weights = scene(BODY, "gaps", dtype=torch.float32)
    given = {} if isinstance(layer, UnrolledFPC) else {"lengths": torch.linspace(0.8, 1.2, 6)}
    value = layer(tracks, cameras, weights=weights, **given)
    given = {name: x.double() for name, x in given.items()}
    assert_close(layer(tracks, cameras, weights=weights.double(), **given), value)


@pytest.mark.parametrize(
    "options",
    [
        {"num_steps": 0},
        {"tau": 0.0},
        {"tau": math.nan},
        {"tau": math.inf},
        {"mu": math.inf},
        {"mu": 0.0},
        {"final": 0.0},
        {"mu": 0.1, "final": 0.2},
        {"momentum": 1.0},
        {"momentum": -0.1},
        {"corner": 0.0},
        {"corner": math.nan},
    ],
)
def test_options_out_of_range(options):
    with pytest.raises(OptionError, match="expected"):
        UnrolledFPC(**options)
    with pytest.raises(OptionError, match="expected"):
        UnrolledSfAM(BODY, **options)


@pytest.mark.parametrize(
    "options", [{"beta": 0.0}, {"beta": math.nan}, {"articulate_from": 1.5}, {"articulate_from": -0.1}]
)
def test_articulated_options_out_of_range(options):
    with pytest.raises(OptionError, match="beta and corner > 0 and articulate_from"):
        UnrolledSfAM(BODY, **options)


def test_unknown_skeleton():
    with pytest.raises(SkeletonError, match="h36m17"):
        UnrolledSfAM("h36m18")


def test_skeleton_without_rigid_bones_is_plain_fpc():
    from dataclasses import replace

    loose = replace(CHAIN, flexible=(0, 1, 2))
    tracks, cameras, _ = scene(CHAIN)
    options = {"mu": 0.4, "final": 1e-3, "momentum": 0.5, "corner": 0.2}
    plain = UnrolledFPC(5, tau=1.0, **options)(tracks, cameras)
    assert_close(UnrolledSfAM(loose, 5, tau=0.5, **options)(tracks, cameras), plain)


# ---------------------------------------------------------------------- parts


def test_continuation():
    weights = continuation(5, 0.5, 5e-5)
    assert weights[0] == 0.5 and weights[-1] == pytest.approx(5e-5)
    ratios = [b / a for a, b in itertools.pairwise(weights)]
    assert ratios == pytest.approx([0.1] * 4)
    assert continuation(1, 0.5, 0.1) == [0.5]
    assert continuation(3, 0.2, 0.2) == [0.2] * 3


@pytest.mark.parametrize("arguments", [(0, 0.5, 0.1), (3, 0.1, 0.5), (3, 0.5, 0.0)])
def test_continuation_out_of_range(arguments):
    with pytest.raises(OptionError, match="continuation"):
        continuation(*arguments)


def test_data_scale():
    tracks, cameras, weights = scene(BODY, "gaps")
    mean = (tracks * weights[..., None]).sum(1, keepdim=True) / weights.sum(1)[:, None, None]
    matrix = (weights[..., None] * (tracks - mean) @ cameras).flatten(1)
    assert_close(data_scale(tracks, cameras, weights), torch.linalg.matrix_norm(matrix, 2))
    assert gradcheck(lambda w, r: data_scale(w, r, weights), tracks, cameras)
    assert data_scale(tracks, cameras, torch.zeros_like(weights)) == 0


def test_estimated_lengths_are_medians_of_what_is_seen():
    points, weights = normal(9, 7, 3), (normal(9, 7, seed=1) > -0.3).double()
    weights[:, 6] = 0  # never: then all frames count
    bones = BODY.bone_index()
    lengths, rigidity = estimate_lengths(points, bones, weights)
    size = bone_lengths(points, bones)
    for b, (parent, child) in enumerate(bones.tolist()):
        seen = (weights[:, parent] > 0) & (weights[:, child] > 0)
        assert_close(lengths[b], (size[seen, b] if seen.any() else size[:, b]).median())
    assert_close(estimate_lengths(points, bones)[0], size.median(0).values)
    assert torch.equal(rigidity, torch.ones(6).double())


def test_steady_bones_are_graded_rigid():
    points = normal(1, 4, 3).expand(30, 4, 3).clone()
    points = points + 0.01 * normal(30, 4, 3, seed=1)
    points[:, 3] += normal(30, 3, seed=2)  # both bones of joint d vary
    _, rigidity = estimate_lengths(points, RING.bone_index(), graded=True)
    assert (rigidity[:2] > 0.1).all() and (rigidity[2:] < 1e-3).all()


@pytest.mark.parametrize("dtype", FLOATS)
def test_grades_of_bones_without_length_are_finite(dtype):
    """Three of four bones have length zero in most frames: their share of it was infinite, and the grade NaN."""
    points = torch.zeros(5, 4, 3, dtype=dtype)
    points[:, 1] = normal(5, 3, dtype=dtype)
    points[4] = normal(4, 3, dtype=dtype)
    bones = torch.tensor([[0, 2], [0, 3], [2, 3], [0, 1]])
    for shape in (points, torch.zeros_like(points), points[:1].expand(5, 4, 3)):
        lengths, rigidity = estimate_lengths(shape, bones, graded=True)
        assert torch.isfinite(lengths).all()
        assert ((rigidity >= 0) & (rigidity <= 1)).all()


@pytest.mark.parametrize("dtype", HALVES)
def test_half_precision_is_widened_inside(dtype):
    """Singular values of tracks in millimetres leave the range of float16: the answer was 0 everywhere, or NaN."""
    tracks, cameras, weights = (x.to(dtype) for x in scene(BODY, "gaps"))
    for scale in (1.0, 1e4):
        far = scale * tracks
        for module in (UnrolledFPC(4), UnrolledSfAM(BODY, 4)):
            rough, exact = module(far, cameras, weights=weights), module(far.float(), cameras.float(), weights=weights)
            assert rough.dtype == dtype
            assert_close(rough.float(), exact, rtol=0.02, atol=0.02 * scale)


def test_step_without_bones_is_plain():
    tracks, cameras, weights = scene(BODY, "gaps")
    shape, level, step = normal(6, 7, 3), torch.tensor(0.3).double(), 0.5
    bones = BODY.bone_index()
    plain = shape_step(shape, tracks, cameras, weights, level, step)
    free = shape_step(
        shape, tracks, cameras, weights, level, step,
        bones=bones, lengths=torch.ones(6).double(), stiffness=torch.zeros(6).double(),
    )  # fmt: skip
    assert_close(free, plain)


def test_what_is_no_number_of_steps_or_no_camera_is_told():
    for steps in (2.5, "10", 0, None):
        with pytest.raises(OptionError, match="whole num_steps"):
            UnrolledSfAM(BODY, num_steps=steps)
    with pytest.raises(ShapeError, match="expected a tensor of cameras, got NoneType"):
        UnrolledSfAM(BODY, num_steps=2)(torch.zeros(3, BODY.num_joints, 2), None)


def test_a_lifter_is_refined_by_a_solver_of_its_skeleton():
    """Bones of another body of as many joints would link other joints, without a word."""
    with pytest.raises(SkeletonError, match="RefinedLifter: expected a solver of the network's skeleton, 'h36m17'"):
        RefinedLifter(MLPLifter("h36m17"), UnrolledSfAM("cmu17", num_steps=2))


@pytest.mark.parametrize(
    ("solver", "options"),
    [
        (UnrolledFPC, {"mu": "a"}),
        (UnrolledFPC, {"tau": None}),
        (UnrolledFPC, {"momentum": "0.5"}),
        (UnrolledFPC, {"corner": "sharp"}),
        (UnrolledSfAM, {"beta": "a"}),
        (UnrolledSfAM, {"articulate_from": [0.5]}),
        (UnrolledKCS, {"scale_range": "wide"}),
        (UnrolledKCS, {"final": "1e-5"}),
        (UnrolledPKC, {"slack": "a"}),
        (UnrolledPKC, {"eps": True}),
    ],
)
def test_what_is_no_number_is_refused_by_name(solver, options):
    skeleton = () if solver is UnrolledFPC else ("h36m17",)
    (name,) = options
    with pytest.raises(OptionError, match=f"{solver.__name__}: {name}: expected a number, got"):
        solver(*skeleton, **options)


@pytest.mark.parametrize("lengths", [5, "ab", ["a"] * 16])
def test_lengths_that_are_no_numbers_are_refused(lengths):
    with pytest.raises(OptionError, match="lengths: expected 16 positive numbers"):
        UnrolledSfAM("h36m17", lengths=lengths)
