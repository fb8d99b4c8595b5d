"""Majorise-minimise steps on PKC's energy: they never raise it, end at its minimum, and know what they cannot see."""

import pytest
import torch
from numerics import BODY, CHAIN, FLOATS, RING, finite, normal, rotations, same_as_loop, turning
from torch.testing import assert_close
from unrolled_scenes import KINDS, scene, with_parameters

from kcs_torch.errors import OptionError, ShapeError, SkeletonError
from kcs_torch.functional import bone_lengths, bone_vectors, complete_rotation, rows_to_cameras
from kcs_torch.nn import UnrolledFPC, UnrolledPKC
from kcs_torch.nn.majorise import majorise_step, turn_onto_mean

BONES = BODY.bone_index()
RIGID = BONES[list(BODY.rigid)]
SCALES = {"bones": BONES, "rigid": RIGID, "eps": 0.05, "slack": 0.3, "noise": 0.1}


def problem(kind="gaps", seed=0):
    """Points to start from, tracks about their middle, cameras, weights and lengths."""
    tracks, cameras, weights = scene(BODY, kind, frames=8)
    tracks = tracks * (weights > 0)[..., None]
    return normal(len(tracks), 7, 3, seed=seed), tracks, cameras, weights, 1 + 0.2 * normal(5, seed=3).abs()


def misfit(points, tracks, cameras, weights):
    """Residuals (T, N, 2), each frame's translation at its optimum."""
    off = points @ cameras.mT - tracks
    return off - (off * weights[..., None]).sum(1, keepdim=True) / weights.sum(1)[:, None, None]


def viewpoint_energy(points, tracks, cameras, weights, lengths):
    """F of the module's docstring, written out."""
    flat = bone_vectors(points, BONES).flatten(-2)
    centred = flat - flat.mean(0)
    scatter = centred.mT @ centred / len(points) + SCALES["eps"] * torch.eye(18)
    charge = lambda r: 9 / 2 * (r / 3).square().log1p().sum()  # noqa: E731
    off = misfit(points, tracks, cameras, weights).norm(dim=-1) / SCALES["noise"]
    total = len(points) / 2 * torch.logdet(scatter) + (9 / 2 * weights * (off / 3).square().log1p()).sum()
    return total + charge((bone_lengths(points, RIGID) - lengths) / SCALES["slack"])


@pytest.mark.parametrize("kind", ["any", "gaps", "unseen joint", "one frame", "static"])
@pytest.mark.parametrize("seed", range(3))
def test_no_step_raises_the_energy(kind, seed):
    points, *given = problem(kind, seed)
    values = [viewpoint_energy(points, *given)]
    for _ in range(30):
        points = majorise_step(points, *given, **SCALES)
        values.append(viewpoint_energy(points, *given))
    change = torch.stack(values).diff()
    assert (change <= 1e-7 * abs(float(values[0]))).all()
    assert change[0] < 0


def test_steps_end_where_the_energy_is_flat():
    points, *given = problem()
    for _ in range(3000):
        points = majorise_step(points, *given, **SCALES)
    leaf = points.clone().requires_grad_()
    (grad,) = torch.autograd.grad(viewpoint_energy(leaf, *given), leaf)
    other = normal(*points.shape, seed=9).requires_grad_()
    (far,) = torch.autograd.grad(viewpoint_energy(other, *given), other)
    assert grad.abs().max() < 1e-5 * far.abs().max()


def test_a_step_is_the_minimum_of_the_quadratic_written_out():
    """The majoriser by its definition, minimised by autograd's Hessian: one Newton step of a quadratic is exact."""
    points, tracks, cameras, weights, lengths = problem()
    flat = bone_vectors(points, BONES).flatten(-2)
    centred = flat - flat.mean(0)
    precision = torch.linalg.inv(centred.mT @ centred / len(points) + SCALES["eps"] * torch.eye(18))
    vectors = bone_vectors(points, RIGID)
    size = vectors.norm(dim=-1)
    cauchy = lambda r: 1 / (1 + (r / 3).square())  # noqa: E731
    stiff = cauchy((size - lengths) / SCALES["slack"]) / SCALES["slack"] ** 2

    off = lambda x: misfit(x, tracks, cameras, weights)  # noqa: E731
    share = weights * cauchy(off(points).norm(dim=-1) / SCALES["noise"]) / SCALES["noise"] ** 2

    def quadratic(x):
        x = x.reshape(points.shape)
        away = bone_vectors(x, BONES).flatten(-2) - flat.mean(0)
        total = 0.5 * (away @ precision * away).sum()
        goal = lengths[:, None] * vectors / size[..., None]
        total = total + 0.5 * (stiff[..., None] * (bone_vectors(x, RIGID) - goal).square()).sum()
        return total + 0.5 * (share[..., None] * off(x).square()).sum()

    zero = torch.zeros(points.numel()).double()
    hessian = torch.autograd.functional.hessian(quadratic, zero)
    grad = torch.autograd.functional.jacobian(quadratic, zero)
    best = -(torch.linalg.pinv(hessian, hermitian=True, rtol=1e-10) @ grad).reshape(points.shape)
    found = majorise_step(points, tracks, cameras, weights, lengths, **SCALES)
    assert_close(found, best - best.mean(-2, keepdim=True), rtol=1e-5, atol=1e-5)


def test_turning_onto_the_mean_moves_nothing_in_the_image():
    points, turned = normal(9, 7, 3), rotations(9)
    spread = lambda x: (bone_vectors(x, BONES) - bone_vectors(x, BONES).mean(0)).square().sum()  # noqa: E731
    again, cameras = turn_onto_mean(points, turned, BONES)
    assert_close(again @ cameras.mT, points @ turned.mT)
    assert_close(cameras @ cameras.mT, torch.eye(3).double().expand(9, 3, 3))
    assert spread(again) < spread(points)


def walk(frames=40, degrees=200.0):
    """A body of rigid bones that bends in two ways before a camera that goes round; truth and cameras (T, 3, 3)."""
    time = torch.linspace(0, 12, frames, dtype=torch.float64)
    vectors = torch.nn.functional.normalize(normal(6, 3), dim=-1)[None] + torch.stack(
        [0.5 * time.sin(), 0.5 * (1.7 * time).cos()], -1
    ).matmul(normal(2, 18, seed=1)).unflatten(-1, (6, 3))
    vectors = torch.nn.functional.normalize(vectors, dim=-1) * torch.tensor([1.0, 0.5, 1.2, 1.2, 1.5, 1.5])[:, None]
    points = torch.zeros(frames, 7, 3, dtype=torch.float64)
    for b, (parent, child) in enumerate(BONES.tolist()):
        points[:, child] = points[:, parent] + vectors[:, b]
    return points - points.mean(-2, keepdim=True), turning(frames, degrees)


def test_it_finds_articulated_motion_better_than_the_nuclear_norm():
    truth, turned = walk()
    tracks, cameras = truth @ turned[:, :2].mT, turned[:, :2]
    with torch.no_grad():
        error = lambda layer: (layer(tracks, cameras) - truth).norm(dim=-1).mean()  # noqa: E731
        plain, ours = error(UnrolledFPC(300)), error(UnrolledPKC(BODY, 60, realign_from=1.0))
    assert ours < 0.75 * plain


def test_a_body_that_turns_needs_realignment():
    """The body spins in the world of the cameras, where its poses are therefore of high rank."""
    truth, turned = walk()
    spin = turning(40, -200.0, tilt=0.0)
    truth = truth @ spin
    tracks, cameras = truth @ turned[:, :2].mT, turned[:, :2]
    start = truth + 0.3 * normal(*truth.shape, seed=2)
    with torch.no_grad():
        run = lambda share: UnrolledPKC(BODY, 60, realign_from=share)(tracks, cameras, start=start)  # noqa: E731
        error = [(run(share) - truth).norm(dim=-1).mean() for share in (0.5, 1.0)]
    assert error[0] < 0.75 * error[1]


def test_lengths_are_kept():
    truth, turned = walk()
    tracks, cameras = truth @ turned[:, :2].mT, turned[:, :2]
    true = bone_lengths(truth, BONES).mean(0)
    wrong = true * torch.tensor([1, 1, 1.1, 1, 1, 1]).double()
    with torch.no_grad():
        layer, plain = UnrolledPKC(BODY, 40, noise=0.1, lengths=wrong.tolist()), UnrolledPKC(BODY, 40, noise=0.1)
        own, relative, given = plain(tracks, cameras), layer(tracks, cameras), plain(tracks, cameras, lengths=wrong)
    size = lambda x: bone_lengths(x, BONES).median(0).values  # noqa: E731
    for found in (relative, given):
        assert (size(found)[2] - wrong[2]).abs() < 0.9 * (size(own)[2] - wrong[2]).abs()  # the image resists


def test_scale_world_and_translation_pass_through():
    tracks, cameras, weights = scene(BODY, "gaps")
    module, turn = UnrolledPKC(BODY, 6, noise=0.1, final=1e-2), rotations()
    shape = module(tracks, cameras, weights=weights)
    assert_close(module(1e3 * tracks, cameras, weights=weights), 1e3 * shape, rtol=1e-5, atol=1e-3)
    assert_close(module(tracks + normal(6, 1, 2), cameras, weights=weights), shape, rtol=1e-5, atol=1e-6)
    assert_close(module(tracks, cameras @ turn, weights=weights), shape @ turn, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("body", [BODY, CHAIN, RING], ids=["body", "chain", "ring"])
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("dtype", FLOATS)
def test_degenerate_clips_are_finite(body, kind, dtype):
    tracks, cameras, weights = scene(body, kind, dtype=dtype)
    run, parameters = with_parameters(UnrolledPKC(body, 6).to(dtype))
    finite(lambda w, r, *v: run((w, r), v, weights=weights), tracks, cameras, *parameters)


@pytest.mark.parametrize("value", [-2000.0, -740.0, 50.0])
def test_parameters_pushed_far_stay_harmless(value):
    tracks, cameras, weights = scene(BODY, "gaps")
    own = {"lengths": range(1, BODY.num_bones + 1), "learnable_lengths": True}
    for name in ("raw_eps", "raw_slack", "raw_noise", "raw_length"):
        module = UnrolledPKC(BODY, 4, **own)
        with torch.no_grad():
            getattr(module, name).fill_(value)
        run, parameters = with_parameters(module)
        finite(lambda w, *v, f=run: f((w, cameras), v, weights=weights), tracks, *parameters)


def test_batches_equal_loops():
    module = UnrolledPKC(BODY, 3, eps=0.3, final=0.1, noise=0.1)
    camera = lambda *a: (a[0], rows_to_cameras(a[1])[0], *[x.abs() for x in a[2:]])  # noqa: E731
    same_as_loop(module, (5, 7, 2), (5, 2, 3), make=camera)
    same_as_loop(lambda w, r, u: module(w, r, weights=u), (5, 7, 2), (5, 2, 3), (5, 7), make=camera)
    same_as_loop(lambda w, r, s: module(w, r, start=s), (5, 7, 2), (5, 2, 3), (5, 7, 3), make=camera)


def test_lengths_of_several_bodies_make_several_shapes():
    module, (tracks, cameras, weights) = UnrolledPKC(BODY, 3, eps=0.3, final=0.1, noise=0.1), scene(BODY)
    lengths = 1 + 0.2 * normal(3, 6).abs()
    found = module(tracks, cameras, weights=weights, lengths=lengths)
    assert_close(found, torch.stack([module(tracks, cameras, weights=weights, lengths=one) for one in lengths]))


def test_a_network_in_single_precision_may_start_it():
    tracks, cameras, _ = scene(BODY, dtype=torch.float32)
    start = normal(6, 7, 3, dtype=torch.bfloat16).requires_grad_()
    value = UnrolledPKC(BODY, 3)(tracks, cameras, start=start)
    assert value.dtype == torch.float32
    value.sum().backward()
    assert torch.isfinite(start.grad).all()


def test_what_does_not_fit():
    for options in ({"slack": 0.0}, {"noise": -1.0}, {"realign_from": 1.5}):
        with pytest.raises(OptionError, match="expected slack and noise > 0"):
            UnrolledPKC(BODY, **options)
    with pytest.raises(OptionError, match="continuation"):
        UnrolledPKC(BODY, eps=1e-3, final=1e-2)
    with pytest.raises(SkeletonError, match="learnable_lengths: skeleton 'body7' has neither"):
        UnrolledPKC(BODY, learnable_lengths=True)
    tracks, cameras, _ = scene(BODY)
    with pytest.raises(ShapeError, match="7, 2.*skeleton 'body7'"):
        UnrolledPKC(BODY, 2)(tracks[:, :6], cameras)
    with pytest.raises(ShapeError, match=r"lengths \(\.\.\., 6\)"):
        UnrolledPKC(BODY, 2)(tracks, cameras, lengths=torch.ones(5))
    assert complete_rotation(cameras).shape == (6, 3, 3)
