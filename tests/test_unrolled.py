"""Unrolled solvers: untrained they are the method; and the parts that they are made of."""

import itertools
import math

import pytest
import torch
from numerics import BODY, CHAIN, FLOATS, HALVES, RING, dense_fit_bones, gradcheck, normal, rotations
from torch.testing import assert_close
from unrolled_scenes import each_body, scene

from kcs_torch.errors import OptionError, ShapeError, SkeletonError
from kcs_torch.functional import bone_lengths
from kcs_torch.methods import SfAM
from kcs_torch.nn import MLPLifter, RefinedLifter, UnrolledFPC, UnrolledKCS, UnrolledPKC, UnrolledSfAM
from kcs_torch.nn.steps import continuation, data_scale, estimate_lengths, shape_step, start_shape
from kcs_torch.nn.unrolled.base import row_length

LAYERS = [
    UnrolledFPC(40),
    UnrolledSfAM(BODY, 40),
    UnrolledKCS(BODY, 40, template=normal(7, 3, seed=8)),
    UnrolledPKC(BODY, 5),
]


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
    tracks, cameras, weights = scene(BODY)
    module = UnrolledSfAM(BODY, 5)
    usual = module(tracks, cameras, weights=weights)
    start = start_shape(tracks, cameras, weights)
    assert_close(module(tracks, cameras, weights=weights, start=start), usual)
    assert not torch.allclose(module(tracks, cameras, weights=weights, start=start + normal(6, 7, 3)), usual)


@pytest.mark.parametrize("layer", LAYERS, ids=lambda layer: type(layer).__name__)
def test_a_start_may_stand_anywhere(layer):
    tracks, cameras, weights = scene(BODY, "gaps")
    start, away = normal(6, 7, 3), 100 * normal(6, 1, 3, seed=1)
    usual = layer(tracks, cameras, weights=weights, start=start)
    assert_close(layer(tracks, cameras, weights=weights, start=start + away), usual)


@pytest.mark.parametrize("layer", LAYERS[:3], ids=lambda layer: type(layer).__name__)
def test_steps_do_not_diverge_whatever_the_weights_and_the_cameras_scale(layer):
    tracks, cameras, weights = scene(BODY, "gaps")
    usual = layer(tracks, cameras, weights=weights)
    for one, rows, mass in [(tracks, cameras, 30 * weights), (9 * tracks, 9 * cameras, weights)]:
        assert layer(one, rows, weights=mass).abs().max() < 30 * usual.abs().max()
    several = torch.stack([weights, 5 * weights]), torch.stack([tracks] * 2), torch.stack([cameras] * 2)
    got = layer(several[1], several[2], weights=several[0])
    assert_close(got[0], usual)
    assert_close(got[1], layer(tracks, cameras, weights=5 * weights))


@pytest.mark.parametrize("layer", LAYERS, ids=lambda layer: type(layer).__name__)
@pytest.mark.parametrize("length", [0.5, 1.1, 4.0])
def test_the_length_of_a_clips_rows_does_not_count(layer, length):
    tracks, cameras, weights = scene(BODY, "gaps")
    usual = layer(tracks, cameras, weights=weights)
    assert_close(layer(length * tracks, length * cameras, weights=weights), usual)
    one, other = torch.stack([tracks, length * tracks]), torch.stack([cameras, length * cameras])
    assert_close(layer(one, other, weights=weights.expand(2, -1, -1)), torch.stack([usual, usual]))


@pytest.mark.parametrize("layer", [LAYERS[0], LAYERS[1], LAYERS[3]], ids=lambda layer: type(layer).__name__)
def test_longer_rows_make_a_shape_smaller_in_the_derivative_too(layer):
    """At rows of length 1, which are left as they are; bounds of the scales of KCS are constants."""
    tracks, cameras, weights = scene(BODY, "gaps")
    usual = layer(tracks, cameras, weights=weights)
    scale = torch.tensor(1.0, dtype=torch.float64, requires_grad=True)
    (slope,) = torch.autograd.grad(layer(tracks, scale * cameras, weights=weights).square().sum(), scale)
    assert_close(slope, -2 * usual.square().sum())


@pytest.mark.parametrize("layer", LAYERS, ids=lambda layer: type(layer).__name__)
def test_one_clip_has_cameras_of_several_lengths(layer):
    tracks, cameras, weights = scene(BODY, "gaps")
    lengths = torch.tensor([1.0, 2.0], dtype=torch.float64)[:, None, None, None]
    got = layer(tracks, lengths * cameras, weights=weights)
    usual = layer(tracks, cameras, weights=weights)
    assert_close(got, torch.stack([usual, usual / 2]))


@pytest.mark.parametrize("layer", LAYERS, ids=lambda layer: type(layer).__name__)
def test_a_frame_without_a_camera_does_not_make_lengths_count(layer):
    tracks, cameras, weights = scene(BODY, "gaps")
    cameras = cameras.clone()
    cameras[4] = 0
    usual = layer(tracks, cameras, weights=weights)
    assert_close(layer(64 * tracks, 64 * cameras, weights=weights), usual)  # without rounding, as the frame is a point


def test_lengths_of_rows():
    cameras = rotations(5, seed=1)[:, :2]
    assert torch.equal(row_length(cameras, of_clip=True), torch.ones(1, 1, 1, dtype=torch.float64))
    assert torch.equal(row_length(cameras, of_clip=False), torch.ones(5, 1, 1, dtype=torch.float64))
    padded = torch.cat([2 * cameras, torch.zeros_like(cameras)])
    assert_close(row_length(padded, of_clip=True), torch.full((1, 1, 1), 2.0, dtype=torch.float64))
    assert_close(row_length(padded, of_clip=False).flatten(), torch.full((10,), 2.0, dtype=torch.float64))
    assert row_length(torch.zeros(2, 0, 2, 3), of_clip=True).flatten().tolist() == [1, 1]


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
