"""Unrolled solvers: clips of several lengths in one padded batch are solved as if each stood alone."""

import math

import pytest
import torch
from numerics import BODY, normal
from torch.nn.utils.rnn import pad_sequence
from torch.testing import assert_close
from unrolled_scenes import scene

from kcs_torch import ShapeError
from kcs_torch.data import walking_person
from kcs_torch.nn import MLPLifter, RefinedLifter, UnrolledFPC, UnrolledKCS, UnrolledPKC, UnrolledSfAM
from kcs_torch.solvers import Implicit

TEMPLATE = normal(BODY.num_joints, 3, seed=8).tolist()
SETTLED = Implicit(settle=5000, tolerance=1e-13, adjoint_steps=100, adjoint_tolerance=1e-10)
LAYERS = {
    "fpc": lambda: UnrolledFPC(6),
    "fpc, corner": lambda: UnrolledFPC(6, corner=0.05, momentum=0.5),
    "fpc, implicit": lambda: UnrolledFPC(4, mu=0.3, final=0.1, gradient=SETTLED),
    "sfam": lambda: UnrolledSfAM(BODY, 6),
    "sfam, lengths": lambda: UnrolledSfAM(BODY, 6, lengths=[1.0] * BODY.num_bones, learnable_lengths=True),
    "kcs": lambda: UnrolledKCS(BODY, 6, template=TEMPLATE),
    "kcs in frames": lambda: UnrolledKCS(BODY, 6, template=TEMPLATE, arrangement="frames", scale_range=math.inf),
    "pkc": lambda: UnrolledPKC(BODY, 5),
    "pkc, held": lambda: UnrolledPKC(BODY, 5, realign_from=1.0),
}
each_layer = pytest.mark.parametrize("name", list(LAYERS))
COUNTS = (7, 4, 1)


def clips():
    """Three clips, one of them with gaps, and the same as one batch whose padding holds nonsense."""
    every = [scene(BODY, "gaps" if n == 7 else "any", frames=n) for n in COUNTS]
    batch = [pad_sequence([clip[k] for clip in every], batch_first=True, padding_value=fill)
             for k, fill in enumerate((1e3, math.nan, 1.0))]  # fmt: skip
    inside = torch.arange(max(COUNTS)) < torch.tensor(COUNTS)[:, None]
    return every, batch, inside


@each_layer
def test_a_padded_clip_is_solved_as_if_alone(name):
    layer, (every, (tracks, cameras, weights), inside) = LAYERS[name](), clips()
    got = layer(tracks, cameras, weights=weights, inside=inside)
    for k, (one, rows, seen) in enumerate(every):
        assert_close(got[k, : len(one)], layer(one, rows, weights=seen), rtol=1e-7, atol=1e-9)
    assert not got[~inside].any()
    assert_close(layer(*every[0][:2], weights=every[0][2], inside=inside[0]), got[0], rtol=1e-7, atol=1e-9)


@each_layer
def test_so_are_its_start_and_gradients(name):
    layer, (every, (tracks, cameras, weights), inside) = LAYERS[name](), clips()
    start, pull = normal(3, 7, BODY.num_joints, 3, seed=5), normal(3, 7, BODY.num_joints, 3, seed=6)
    start[~inside] = math.nan
    tracks.requires_grad_()
    (layer(tracks, cameras, weights=weights, start=start, inside=inside) * pull).sum().backward()
    whole = [p.grad.clone() for p in layer.parameters()]
    layer.zero_grad()
    for k, (one, rows, seen) in enumerate(every):
        one.requires_grad_()
        (layer(one, rows, weights=seen, start=start[k, : len(one)]) * pull[k, : len(one)]).sum().backward()
        near = {"rtol": 1e-6, "atol": 1e-8}
        assert_close(tracks.grad[k, : len(one)], one.grad, **near)
        assert not tracks.grad[k, len(one) :].any()
    assert_close(whole, [p.grad for p in layer.parameters()], **near)


@pytest.mark.filterwarnings("ignore:.*where nothing holds a direction:kcs_torch.ConvergenceWarning")
@each_layer
def test_nothing_but_padding(name):
    layer, (tracks, cameras, weights) = LAYERS[name](), scene(BODY, frames=5)
    tracks.requires_grad_()
    got = layer(tracks, cameras, weights=weights, inside=torch.zeros(5, dtype=torch.bool))
    got.sum().backward()
    assert not got.any() and not tracks.grad.any()
    assert all(p.grad is None or p.grad.isfinite().all() for p in layer.parameters())


def test_cameras_of_a_template_too():
    layer = UnrolledKCS("h36m17", 4)
    every = [walking_person(n, turn=60, yaw=yaw).tracks.points for n, yaw in ((70, 0), (130, 40))]
    inside = torch.arange(130) < torch.tensor([[70], [130]])
    tracks = pad_sequence(every, batch_first=True)
    cameras, scales = layer.find_cameras(tracks, inside=inside)
    got = layer(tracks, cameras, scales=scales, inside=inside)
    for k, one in enumerate(every):
        rows, sizes = layer.find_cameras(one)
        assert_close((cameras[k, : len(one)], scales[k, : len(one)]), (rows, sizes))
        assert_close(got[k, : len(one)], layer(one, rows, scales=sizes))
    assert not cameras[0, 70:].any() and not scales[0, 70:].any()
    assert_close(layer(tracks, cameras, inside=inside)[0, :70], layer(every[0], cameras[0, :70]))
    last = layer.find_cameras(tracks.flip(-3), inside=inside.flip(-1))  # padding may come first
    first = layer.find_cameras(every[0].flip(0))
    assert_close((last[0][0, 60:], last[1][0, 60:]), first)


def test_a_lifter_s_solver_is_told_too():
    refined = RefinedLifter(MLPLifter(BODY, width=8), UnrolledSfAM(BODY, 4)).double().eval()
    every, (tracks, _, weights), inside = clips()
    got = refined(tracks, weights, inside=inside)
    for k, (one, _, seen) in enumerate(every):
        assert_close(got[k, : len(one)], refined(one, seen), rtol=1e-7, atol=1e-9)
    assert not got[~inside].any()
    tracks[~inside] = 1e5
    assert_close(refined(tracks, None, inside=inside)[1, :4], refined(every[1][0]), rtol=1e-7, atol=1e-9)
    with pytest.raises(ShapeError, match="RefinedLifter: inside: expected True or False for each frame, got"):
        refined(tracks, inside=inside.double())


def test_what_is_inside_is_yes_or_no_for_each_frame():
    layer, (tracks, cameras, _) = UnrolledFPC(2), scene(BODY, frames=5)
    with pytest.raises(ShapeError, match=r"inside \(..., 5\), got \(4,\)"):
        layer(tracks, cameras, inside=torch.ones(4, dtype=torch.bool))
    with pytest.raises(ShapeError, match="inside: expected True or False for each frame, got torch.float32"):
        layer(tracks, cameras, inside=torch.ones(5))


@each_layer
def test_vmap_follows(name):
    if "implicit" in name:
        pytest.skip("its number of steps depends on the data")
    layer, (_, (tracks, cameras, weights), inside) = LAYERS[name](), clips()
    scales = {"scales": torch.ones(3, 7, dtype=torch.float64)} if "kcs" in name else {}
    run = lambda t, c, w, i, s: layer(t, c, weights=w, inside=i, **s)  # noqa: E731
    got = torch.func.vmap(run)(tracks, cameras, weights, inside, scales)
    assert_close(got, run(tracks, cameras, weights, inside, scales))
