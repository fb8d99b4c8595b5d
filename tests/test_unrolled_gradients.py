"""How unrolled solvers are differentiated: all steps, the last steps, the fixed point; each against differences."""

import pytest
import torch
from numerics import BODY, CHAIN, FLOATS, finite, gradcheck, normal
from torch.testing import assert_close
from unrolled_scenes import KINDS, scene, with_parameters

from kcs_torch.errors import ConvergenceWarning, OptionError
from kcs_torch.nn import UnrolledFPC, UnrolledKCS, UnrolledPKC, UnrolledSfAM
from kcs_torch.solvers import Implicit
from kcs_torch.solvers.iterate import Solution

REST = normal(7, 3)  # what the scenes vary
LENGTHS = (1.0, 1.2, 0.8, 0.9, 1.1, 1.3)
MILD = {"mu": 0.3, "final": 0.03}
MAKE = {
    "fpc": lambda n, **o: UnrolledFPC(n, **MILD, **o),
    "sfam": lambda n, **o: UnrolledSfAM(
        BODY, n, **MILD, articulate_from=0.3, lengths=LENGTHS, learnable_lengths=True, **o
    ),
    "kcs": lambda n, **o: UnrolledKCS(
        BODY, n, **MILD, template=REST, arrangement="frames", learnable_lengths=True, scale_range=1e6, **o
    ),
    "pkc": lambda n, **o: UnrolledPKC(
        BODY, n, eps=0.3, final=0.03, noise=0.1, lengths=LENGTHS, learnable_lengths=True, **o
    ),
}
each_solver = pytest.mark.parametrize("name", list(MAKE))


@each_solver
@pytest.mark.parametrize("kind", ["any", "gaps", "one frame", "unseen joint"])
def test_unrolled_gradient(name, kind):
    """In tracks, cameras, start and all parameters, bone lengths included."""
    tracks, cameras, weights = scene(BODY, kind, frames=4)
    start = normal(*tracks.shape[:-1], 3, seed=8)
    run, parameters = with_parameters(MAKE[name](3))
    function = lambda w, r, s, *v: run((w, r), v, weights=weights, start=s)  # noqa: E731
    assert gradcheck(function, tracks, cameras, start, *parameters, fast=True)


@each_solver
def test_unrolled_gradient_in_the_weights(name):
    tracks, cameras, _ = scene(BODY, frames=4)
    weights = normal(4, 7, seed=3).abs().clamp(0.2, 1)
    module = MAKE[name](2)
    assert gradcheck(lambda u: module(tracks, cameras, weights=u), weights, fast=True)


def last_steps(module, kept, held=None):
    """Make ``module`` run its last ``kept`` steps from a held state; or, where that is None, find the state."""
    found = []

    def run(step, start, **_):
        first = module.num_steps - kept
        steps = range(first) if held is None else range(first, module.num_steps)
        state = (start, start) if held is None else held
        for k in steps:
            shape = step(state[1], k)
            state = (shape, shape + module.momentum * (shape - state[0]))
        found.append(tuple(x.detach() for x in state))
        return Solution(state[0], True, len(steps))

    module._run = run
    return found


@each_solver
@pytest.mark.parametrize("kept", [1, 3])
def test_truncated_gradient_is_that_of_the_last_steps(name, kept):
    """The state before them is a constant: so finite differences hold it, and vary the rest."""
    tracks, cameras, weights = scene(BODY, "gaps", frames=5)
    probe = MAKE[name](5)
    found = last_steps(probe, kept)
    with torch.no_grad():
        probe(tracks, cameras, weights=weights)
    tail = MAKE[name](5)
    last_steps(tail, kept, held=found[0])
    run, parameters = with_parameters(tail)
    function = lambda w, r, *v: run((w, r), v, weights=weights)  # noqa: E731
    assert gradcheck(function, tracks, cameras, *parameters, fast=True)  # of the oracle

    truncated, parameters = with_parameters(MAKE[name](5, grad_steps=kept))
    grads = []
    for one in (run, truncated):
        leaves = [x.clone().requires_grad_() for x in (tracks, cameras, *parameters)]
        value = one(tuple(leaves[:2]), leaves[2:], weights=weights)
        grads.append(torch.autograd.grad(value, leaves, normal(*value.shape, seed=4)))
    assert_close(grads[1], grads[0], rtol=1e-6, atol=1e-9)


# ---------------------------------------------------------------------- the fixed point

EXACT = Implicit(settle=1500, tolerance=1e-12, adjoint_steps=120, adjoint_tolerance=1e-9)


def strict(name, **options):
    """Settings under which a step is a contraction: much shrinkage, or much noise."""
    if name == "fpc":
        return UnrolledFPC(3, mu=0.3, final=0.3, momentum=0.0, **options)
    if name == "sfam":
        return UnrolledSfAM(
            BODY, 3, mu=0.3, final=0.3, momentum=0.0, corner=2.0, articulate_from=0.0, lengths=LENGTHS,
            learnable_lengths=True, **options,
        )  # fmt: skip
    if name == "kcs":
        return UnrolledKCS(
            BODY, 3, template=REST, mu=0.3, final=0.3, arrangement="frames", learnable_lengths=True, scale_range=1e6,
            **options,
        )  # fmt: skip
    return UnrolledPKC(
        BODY,
        3,
        eps=10.0,
        final=10.0,
        noise=0.3,
        slack=1.0,
        realign_from=1.0,
        lengths=LENGTHS,
        learnable_lengths=True,
        **options,
    )


@each_solver
def test_implicit_gradient_is_that_of_the_fixed_point(name):
    """In tracks, cameras, weights and all parameters; the solver runs to its end for every difference."""
    tracks, cameras, weights = scene(BODY, "gaps", frames=4)
    module = strict(name, gradient=EXACT)
    found = module.solve(tracks, cameras, weights=weights)
    assert found.converged
    start = found.value.detach()  # no matter to the fixed point: it saves steps
    run, parameters = with_parameters(module)
    function = lambda w, r, u, *v: run((w, r), v, weights=u * (weights > 0), start=start)  # noqa: E731
    assert gradcheck(function, tracks, cameras, weights, *parameters, fast=True, atol=1e-4)


@each_solver
def test_implicit_gradient_is_the_limit_of_unrolling(name):
    tracks, cameras, weights = scene(BODY, "gaps", frames=5)
    implicit, plain = strict(name, gradient=EXACT), strict(name)
    # The last step again and again: so many steps that the first no longer count.
    step_of = plain._run

    def long(step, start, **options):
        plain.num_steps = 600
        return step_of(lambda x, k: step(x, min(k, 2)), start, **options)

    plain._run = long
    grads = []
    for module in (implicit, plain):
        leaf, turned = tracks.clone().requires_grad_(), cameras.clone().requires_grad_()
        value = module(leaf, turned, weights=weights)
        learned = [p for n, p in module.named_parameters() if n in ("raw_length", "raw_noise")]
        grads.append(torch.autograd.grad(value, (leaf, turned, *learned), normal(*value.shape, seed=4)))
        plain.num_steps = 3
    assert_close(grads[0], grads[1], rtol=1e-4, atol=1e-5)


def test_implicit_gradient_reaches_the_last_step_alone_and_no_start():
    tracks, cameras, _ = scene(BODY)
    module = strict("fpc", gradient="implicit")
    start = normal(*tracks.shape[:-1], 3, seed=8).requires_grad_()
    value = module(tracks, cameras, start=start)
    value.square().sum().backward()
    assert start.grad is None
    assert torch.equal(module.raw_threshold.grad != 0, torch.tensor([False, False, True]))
    # A fixed point does not depend on the step size that leads to it: Adam would follow what rounding leaves.
    assert not module.raw_step.grad.any()


def test_implicit_goes_on_until_the_shape_stands_still():
    tracks, cameras, _ = scene(BODY)
    solution = UnrolledFPC(3, mu=0.5, final=0.3, gradient="implicit").solve(tracks, cameras)
    assert solution.converged and 3 < solution.iterations < 303
    long = UnrolledFPC(400, mu=0.3, final=0.3)(tracks, cameras)
    assert_close(solution.value, long, rtol=1e-4, atol=1e-4)
    with torch.no_grad():
        assert torch.equal(UnrolledFPC(3, mu=0.5, final=0.3, gradient="implicit")(tracks, cameras), solution.value)


def test_implicit_records_nothing_where_nothing_is_asked():
    tracks, cameras, _ = scene(BODY)
    assert not strict("sfam", gradient="implicit", learnable=False).requires_grad_(False)(tracks, cameras).requires_grad


def test_batches_do_not_mix_in_the_adjoint():
    """One clip that settles at once and one that takes long, together and alone."""
    tracks, cameras, _ = scene(BODY)
    both = torch.stack([tracks, 3 + 0.1 * tracks.flip(0)]).requires_grad_()
    module = strict("fpc", gradient=EXACT)
    module(both, cameras).square().sum().backward()
    for k in range(2):
        leaf = both.detach()[k].clone().requires_grad_()
        module(leaf, cameras).square().sum().backward()
        assert_close(both.grad[k], leaf.grad, rtol=1e-6, atol=1e-8)


def test_windows_of_one_body_are_one_problem_in_the_adjoint():
    """Their shared lengths couple them: a solver that takes them for apart would give another gradient."""
    tracks, cameras, _ = scene(BODY, frames=10)
    cut = lambda x: x.reshape(2, 5, *x.shape[1:])  # noqa: E731
    module = UnrolledSfAM(BODY, 2, mu=0.5, final=0.3, momentum=0.0, articulate_from=0.0, gradient=EXACT)
    function = lambda w: module.solve(cut(w), cut(cameras), one_body=True).value  # noqa: E731
    assert gradcheck(function, tracks, fast=True, atol=1e-4)


# ---------------------------------------------------------------------- degenerate clips, memory, options


BRIEF = Implicit(settle=10, adjoint_steps=15)


@each_solver
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("dtype", FLOATS)
@pytest.mark.parametrize("options", [{"grad_steps": 2}, {"gradient": BRIEF}], ids=["last", "implicit"])
@pytest.mark.filterwarnings("ignore::kcs_torch.errors.ConvergenceWarning")
def test_degenerate_clips_are_finite(name, kind, dtype, options):
    tracks, cameras, weights = scene(BODY, kind, dtype=dtype)
    run, parameters = with_parameters(MAKE[name](4, **options).to(dtype))
    finite(lambda w, r, *v: run((w, r), v, weights=weights), tracks, cameras, *parameters)


@each_solver
@pytest.mark.parametrize("options", [{}, {"gradient": BRIEF}], ids=["all", "implicit"])
@pytest.mark.filterwarnings("ignore::kcs_torch.errors.ConvergenceWarning")
def test_what_lies_under_a_mask_does_not_count(name, options):
    tracks, cameras, weights = scene(BODY, "gaps")
    module = MAKE[name](3, **options)
    hidden = torch.where(weights[..., None] > 0, tracks, torch.nan)
    grads = []
    for image in (torch.where(weights[..., None] > 0, tracks, 0), hidden):
        leaf = image.clone().requires_grad_()
        value = module(leaf, cameras, weights=weights)
        (grad,) = torch.autograd.grad(value.square().sum(), leaf)
        grads.append((value, torch.where(weights[..., None] > 0, grad, 0)))
        assert torch.isfinite(grad).all()
    assert_close(grads[1], grads[0], rtol=0, atol=0)


@each_solver
@pytest.mark.parametrize("kind", ["gaps", "unseen joint", "unseen frame", "nothing seen"])
@pytest.mark.parametrize("options", [{}, {"gradient": BRIEF}], ids=["all", "implicit"])
@pytest.mark.filterwarnings("ignore::kcs_torch.errors.ConvergenceWarning")
def test_tracks_that_are_nan_are_unseen(name, kind, options):
    """Without weights as with weights of 0 there, value and gradient; and where the weights know nothing of it."""
    tracks, cameras, weights = scene(BODY, kind)
    seen = (weights > 0).to(weights)
    hidden = torch.where(seen[..., None] > 0, tracks, torch.nan)
    module = MAKE[name](3, **options)
    grads = []
    for given in (seen, None, torch.ones_like(seen)):
        leaf = hidden.clone().requires_grad_()
        value = module(leaf, cameras, weights=given)
        (grad,) = torch.autograd.grad(value.square().sum(), leaf)
        assert torch.isfinite(value).all() and torch.isfinite(grad).all() and not grad[seen == 0].any()
        grads.append((value, grad))
    assert_close(grads[1], grads[0], rtol=0, atol=0)
    assert_close(grads[2], grads[0], rtol=0, atol=0)
    if kind != "nothing seen":
        assert grads[1][1].any()


def test_cameras_are_found_where_tracks_are_nan():
    tracks, _, weights = scene(BODY, "gaps")
    seen = (weights > 0).to(weights)
    module = UnrolledKCS(BODY, 2, template=REST)
    expected = module.find_cameras(tracks, weights=seen)
    found = module.find_cameras(torch.where(seen[..., None] > 0, tracks, torch.nan))
    assert_close(found, expected, rtol=0, atol=0)
    assert torch.isfinite(found[0]).all() and torch.isfinite(found[1]).all()


@each_solver
def test_a_zero_length_bone_is_finite(name):
    tracks, cameras, weights = scene(BODY)
    tracks[:, 2] = tracks[:, 1]
    run, parameters = with_parameters(MAKE[name](4))
    finite(lambda w, r, *v: run((w, r), v, weights=weights), tracks, cameras, *parameters)


def saved_bytes(module, *arguments):
    """Bytes that autograd keeps for the backward pass, each storage once."""
    kept = {}

    def pack(x):
        kept[x.untyped_storage().data_ptr()] = x.untyped_storage().nbytes()
        return x

    with torch.autograd.graph.saved_tensors_hooks(pack, lambda x: x):
        value = module(*arguments)
    assert value.requires_grad
    return sum(kept.values())


@pytest.mark.parametrize("name", ["fpc", "kcs"])
def test_memory_grows_with_recorded_steps_alone(name):
    tracks, cameras, _ = scene(BODY)
    size = lambda n, **options: saved_bytes(MAKE[name](n, **options), tracks, cameras)  # noqa: E731
    assert size(40) > 3 * size(10)
    assert size(40, grad_steps=5) < 1.3 * size(10, grad_steps=5) < size(10)
    implicit = Implicit(settle=10)
    assert size(40, gradient=implicit) < 1.3 * size(10, gradient=implicit) < size(10)


def test_options_of_the_gradient():
    with pytest.raises(OptionError, match="'unrolled', 'implicit' or an Implicit, got 'exact'"):
        UnrolledFPC(gradient="exact")
    with pytest.raises(OptionError, match="grad_steps: the implicit gradient records one step"):
        UnrolledFPC(gradient="implicit", grad_steps=3)
    with pytest.raises(OptionError, match="grad_steps >= 0"):
        UnrolledSfAM(BODY, grad_steps=-1)
    assert "Implicit(settle=7" in repr(UnrolledFPC(gradient=Implicit(settle=7)))


def test_a_fixed_point_out_of_reach_is_told():
    """A static clip before a still camera: depth shrinks towards 0, ever more slowly, and the adjoint tells."""
    tracks, cameras, _ = scene(CHAIN, "any")
    module = UnrolledFPC(3, mu=1e-4, final=1e-7, gradient=Implicit(settle=5, adjoint_steps=3))
    leaf = tracks.clone().requires_grad_()
    solution = module.solve(leaf, cameras)
    assert not solution.converged
    with pytest.warns(ConvergenceWarning, match="UnrolledFPC: the derivative"):
        solution.value.square().sum().backward()
    assert torch.isfinite(leaf.grad).all()
