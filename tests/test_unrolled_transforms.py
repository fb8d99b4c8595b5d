"""Unrolled solvers and spectral functions under torch.func.vmap, torch.compile and torch.export."""

import io
import warnings

import pytest
import torch
from numerics import BODY, normal
from torch.func import grad, vmap
from torch.testing import assert_close
from unrolled_scenes import scene

from kcs_torch.functional import (
    log_det,
    nearest_rotation,
    nuclear_norm,
    psd_shrink,
    scatter_log_det,
    spectral_norm,
    svt,
)
from kcs_torch.nn import UnrolledFPC, UnrolledKCS, UnrolledPKC, UnrolledSfAM

FUNCTIONS = {
    "svt": svt,
    "svt wide": lambda x, t: svt(x.mT, t),
    "psd_shrink": lambda x, t: psd_shrink(x.mT @ x, t),
    "nuclear_norm": lambda x, t: t * nuclear_norm(x),
    "spectral_norm": lambda x, t: t * spectral_norm(x),
    "log_det": lambda x, t: log_det(x.mT @ x, t),
    "scatter_log_det": lambda x, t: scatter_log_det(x, t.detach()),
    "nearest_rotation": lambda x, t: t * nearest_rotation(x[..., :3, :3]),
}
each_function = pytest.mark.parametrize("name", list(FUNCTIONS))


@each_function
def test_vmap_is_a_loop(name):
    function = FUNCTIONS[name]
    matrices, levels = normal(3, 6, 4), torch.tensor([0.1, 1.0, 0.5], dtype=torch.float64)
    both = vmap(function)(matrices, levels)
    assert_close(both, torch.stack([function(m, t) for m, t in zip(matrices, levels, strict=True)]))
    assert_close(
        vmap(function, (0, None))(matrices, levels[1]), torch.stack([function(m, levels[1]) for m in matrices])
    )
    assert_close(
        vmap(function, (None, 0))(matrices[0], levels), torch.stack([function(matrices[0], t) for t in levels])
    )
    assert_close(vmap(function, (1, 0))(matrices.transpose(0, 1), levels), both)
    twice = vmap(vmap(function, (None, 0)), (0, None))(matrices, levels)
    assert_close(twice[1, 2], function(matrices[1], levels[2]))


@each_function
def test_gradients_under_vmap_are_those_of_a_loop(name):
    function = FUNCTIONS[name]
    matrices, levels = normal(3, 6, 4), torch.tensor([0.1, 1.0, 0.5], dtype=torch.float64)
    cotangent = normal(*function(matrices[0], levels[0]).shape, seed=5)
    loss = lambda m, t: (function(m, t) * cotangent).sum()  # noqa: E731
    expected = []
    for m, t in zip(matrices, levels, strict=True):
        leaves = m.clone().requires_grad_(), t.clone().requires_grad_()
        found = torch.autograd.grad(loss(*leaves), leaves, allow_unused=True)
        expected.append([torch.zeros_like(x) if g is None else g for g, x in zip(found, leaves, strict=True)])
    got = vmap(grad(loss, (0, 1)))(matrices, levels)
    assert_close(got[0], torch.stack([e[0] for e in expected]))
    assert_close(got[1], torch.stack([e[1] for e in expected]))


def test_thresholds_with_more_dimensions_than_the_matrix():
    """Its batch dimensions are brought to one number: (V, M, N) and (V, 5)."""
    matrices, levels = normal(3, 6, 4), normal(3, 5, seed=1).abs()
    expected = torch.stack([svt(m, t) for m, t in zip(matrices, levels, strict=True)])
    assert_close(vmap(svt)(matrices, levels), expected)
    loss = lambda m, t: svt(m, t).square().sum()  # noqa: E731
    got = vmap(grad(loss, (0, 1)))(matrices, levels)
    for k in range(3):
        leaves = matrices[k].clone().requires_grad_(), levels[k].clone().requires_grad_()
        assert_close((got[0][k], got[1][k]), torch.autograd.grad(loss(*leaves), leaves))


@pytest.mark.parametrize("name", ["svt", "psd_shrink", "nuclear_norm", "spectral_norm", "scatter_log_det"])
def test_second_derivatives_raise_under_transforms(name):
    loss = lambda m: FUNCTIONS[name](m, torch.tensor(0.5, dtype=torch.float64)).square().sum()  # noqa: E731
    with pytest.raises(RuntimeError, match="second derivatives"):
        grad(lambda m: grad(loss)(m).square().sum())(normal(6, 4))


# ---------------------------------------------------------------------- unrolled solvers

LENGTHS = (1.0, 1.2, 0.8, 0.9, 1.1, 1.3)
SOLVERS = {
    "fpc": lambda: UnrolledFPC(3),
    "sfam": lambda: UnrolledSfAM(BODY, 3, articulate_from=0.3, lengths=LENGTHS, learnable_lengths=True),
    "kcs": lambda: UnrolledKCS(BODY, 3, template=normal(7, 3), learnable_lengths=True),
    "pkc": lambda: UnrolledPKC(BODY, 2, noise=0.1, final=1e-2),
}
each_solver = pytest.mark.parametrize("name", list(SOLVERS))


def clips():
    tracks, cameras, weights = scene(BODY, "gaps")
    more = tracks + 0.1 * normal(*tracks.shape, seed=7)
    return torch.stack([tracks, more]), cameras.expand(2, *cameras.shape), torch.stack([weights, weights.flip(0)])


@each_solver
def test_solvers_under_vmap(name):
    """Clips of one length as a mapped dimension, and each clip's own gradient."""
    module, arguments = SOLVERS[name](), clips()
    run = lambda w, r, u: module(w, r, weights=u)  # noqa: E731
    assert_close(vmap(run)(*arguments), torch.stack([run(*one) for one in zip(*arguments, strict=True)]))
    loss = lambda *a: run(*a).square().sum()  # noqa: E731
    leaf = arguments[0].clone().requires_grad_()
    (expected,) = torch.autograd.grad(sum(loss(*one) for one in zip(leaf, *arguments[1:], strict=True)), leaf)
    assert_close(vmap(grad(loss))(*arguments), expected, rtol=1e-6, atol=1e-8)


@each_solver
def test_solvers_compile_without_a_break(name):
    """Traced by Dynamo into one graph, forward and backward, and run by aot_eager; Inductor takes much longer.

    A single step, as tracing takes its time for each.
    """
    module = {
        "fpc": lambda: UnrolledFPC(1),
        "sfam": lambda: UnrolledSfAM(BODY, 1, articulate_from=0.0, lengths=LENGTHS, learnable_lengths=True),
        "kcs": lambda: UnrolledKCS(BODY, 1, template=normal(7, 3), learnable_lengths=True),
        "pkc": lambda: UnrolledPKC(BODY, 1, noise=0.1, final=1e-1),
    }[name]()
    tracks, cameras, weights = (x[0] for x in clips())
    leaf = tracks.clone().requires_grad_()
    torch._dynamo.reset()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # what Dynamo says of itself
        value = torch.compile(module, backend="aot_eager", fullgraph=True)(leaf, cameras, weights=weights)
        got = torch.autograd.grad(value.square().sum(), [leaf, *module.parameters()])
    torch._dynamo.reset()
    plain = module(leaf, cameras, weights=weights)
    assert_close(value, plain)
    expected = torch.autograd.grad(plain.square().sum(), [leaf, *module.parameters()])
    assert_close(got, expected, rtol=1e-6, atol=1e-8)


@each_solver
def test_solvers_compile_for_clips_of_any_length(name):
    """Without guards on the corner or the scale's range, and with batches of symbols that broadcast."""
    module = {
        "fpc": lambda: UnrolledFPC(1, corner=0.1),
        "sfam": lambda: UnrolledSfAM(BODY, 1, articulate_from=0.0),
        "kcs": lambda: UnrolledKCS(BODY, 1, template=normal(7, 3)),
        "pkc": lambda: UnrolledPKC(BODY, 1, noise=0.1, final=1e-1),
    }[name]()
    tracks, cameras, weights = clips()
    torch._dynamo.reset()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # what Dynamo says of itself
        compiled = torch.compile(module, backend="eager", fullgraph=True, dynamic=True)
        for frames in (slice(None), slice(1, None)):
            part = tracks[:, frames], cameras[:, frames]
            found = compiled(*part, weights=weights[:, frames])
            assert_close(found, module(*part, weights=weights[:, frames]))
    torch._dynamo.reset()


@each_solver
def test_solvers_export(name):
    """As a program of plain operators, which another clip of the same size runs through."""
    module = SOLVERS[name]()
    tracks, cameras, weights = clips()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        exported = torch.export.export(module, (tracks[0], cameras[0]), {"weights": weights[0]})
        with io.BytesIO() as file:
            torch.export.save(exported, file)
            file.seek(0)
            loaded = torch.export.load(file)
    for program in (exported, loaded):
        found = program.module()(tracks[1], cameras[1], weights=weights[1])
        assert_close(found, module(tracks[1], cameras[1], weights=weights[1]))


@each_solver
def test_solvers_are_traced(name):
    module, (tracks, cameras, _) = SOLVERS[name](), clips()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # sizes are constants of the trace
        traced = torch.jit.trace(module, (tracks[0], cameras[0]), check_trace=False)
    assert_close(traced(tracks[1], cameras[1]), module(tracks[1], cameras[1]))


@each_solver
def test_an_ensemble_under_vmap(name):
    """Parameters and buffers of several solvers, stacked."""
    modules, (tracks, cameras, _) = [SOLVERS[name]() for _ in range(3)], clips()
    state = torch.func.stack_module_state(modules)
    run = lambda p, b: torch.func.functional_call(modules[0], (p, b), (tracks[0], cameras[0]))  # noqa: E731
    expected = torch.stack([module(tracks[0], cameras[0]) for module in modules])
    assert_close(vmap(run)(*state), expected)
