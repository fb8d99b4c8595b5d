"""Unrolled solvers: derivatives that hold for whatever comes in, and learning."""

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from numerics import BODY, CHAIN, FLOATS, finite, gradcheck, normal, turning
from torch.testing import assert_close
from unrolled_scenes import BODIES, KINDS, each_body, scene, with_parameters

from kcs_torch.nn import UnrolledFPC, UnrolledSfAM
from kcs_torch.nn.steps import continuation, data_scale, estimate_lengths, shape_step, start_shape

SMOOTH_KINDS = ["any", "one frame", "two frames", "gaps", "unseen joint", "unseen frame"]


# ---------------------------------------------------------------------- derivatives


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
