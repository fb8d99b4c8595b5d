"""KCS's steps as a layer: untrained they are the method's, written out and as it runs."""

import math
import warnings

import pytest
import torch
from numerics import BODY, FLOATS, HALVES, finite, leaves_arguments_alone, normal, same_as_loop
from torch.testing import assert_close
from unrolled_scenes import KINDS, scene, with_parameters

from kcs_torch import KCS
from kcs_torch.data import walking_person
from kcs_torch.errors import OptionError, ShapeError, SkeletonError
from kcs_torch.functional import bone_lengths, bone_vectors, complete_rotation, incidence, rows_to_cameras
from kcs_torch.nn import UnrolledKCS
from kcs_torch.nn.unrolled import kcs as unrolled_kcs
from kcs_torch.solvers.pose import fit_cameras

REST = normal(7, 3)
CLIP = walking_person(30, turn=60.0, missing=0.1, generator=torch.Generator().manual_seed(0))
TRACKS = CLIP.tracks
BODY_17 = TRACKS.skeleton
each_arrangement = pytest.mark.parametrize("arrangement", ["stacked", "frames"])


def naive(rest, bones, tracks, cameras, scales, weights, *, steps, mu, final, tau, arrangement):
    """The iteration written out, with plain SVDs, frame by frame: one clip."""
    matrix = incidence(bones, len(rest), dtype=rest.dtype)
    inverse = torch.linalg.pinv(matrix).mT
    rest = rest - rest.mean(0)

    def off(deviation):
        rows = []
        for t in range(len(tracks)):
            seen = (rest + inverse @ deviation[t]) @ cameras[t].mT - tracks[t] / scales[t]
            share = weights[t][:, None]
            rows.append((seen - (seen * share).sum(0) / share.sum()) * share)
        return torch.stack(rows)

    def fold(x):
        return torch.cat([*x.mT], 0) if arrangement == "stacked" else x.reshape(len(x), -1)

    def unfold(m):
        return torch.stack([*m.split(3)]).mT if arrangement == "stacked" else m.reshape(len(tracks), -1, 3)

    pull = lambda residual: matrix.mT @ (residual @ cameras)  # noqa: E731
    deviation = torch.zeros(len(tracks), len(bones), 3, dtype=rest.dtype)
    scale = torch.linalg.svdvals(fold(pull(off(deviation))))[0]
    for k in range(steps):
        u, s, vt = torch.linalg.svd(fold(deviation - tau * pull(off(deviation))), full_matrices=False)
        level = mu * (final / mu) ** (k / max(steps - 1, 1)) * scale
        deviation = unfold((u * (s - tau * level).clamp_min(0)) @ vt)
    return scales.mean() * (rest + inverse @ deviation)


@each_arrangement
@pytest.mark.parametrize("kind", ["any", "gaps", "two frames"])
@pytest.mark.parametrize("tau", [1.0, 0.7])
def test_untrained_is_the_iteration_written_out(arrangement, kind, tau):
    tracks, cameras, weights = scene(BODY, kind)
    scales = 1 + 0.1 * normal(len(tracks), seed=9)
    options = {"mu": 0.4, "final": 0.01, "tau": tau, "arrangement": arrangement}
    expected = naive(REST, BODY.bone_index(), tracks, cameras, scales, weights, steps=6, **options)
    for more in ({}, {"learnable": False}, {"learnable_lengths": True}):
        module = UnrolledKCS(BODY, 6, template=REST, **options, **more)
        assert_close(module(tracks, cameras, scales=scales, weights=weights), expected)


@each_arrangement
@pytest.mark.parametrize("steps", [1, 7])
def test_untrained_is_the_method(arrangement, steps):
    """One round of KCS with one step at each of n weights."""
    method = KCS(rounds=1, num_weights=steps, steps_per_weight=1, rho=0.3, arrangement=arrangement)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        result = method(TRACKS)
    layer = UnrolledKCS(TRACKS.skeleton, steps, mu=0.5, final=0.5 * 0.3 ** (steps - 1), arrangement=arrangement)
    cameras, scales = layer.find_cameras(TRACKS.points, weights=TRACKS.weights)
    assert_close(cameras, result.cameras, rtol=0, atol=1e-5)
    assert_close(scales / scales.mean(), result.scales, rtol=1e-5, atol=0)
    shape = layer(TRACKS.points, cameras, scales=scales, weights=TRACKS.weights)
    found = shape @ complete_rotation(cameras).mT
    centred = result.points - result.points.mean(-2, keepdim=True)
    assert_close(found, centred, rtol=0, atol=1e-5 * float(centred.abs().max()))


def test_scales_are_those_of_the_method_where_cameras_are_known():
    """By least squares, within bounds about the clip's scale; without bounds they are the least-squares scale."""
    layer, free = (UnrolledKCS(TRACKS.skeleton, 3, scale_range=x) for x in (1.1, math.inf))
    cameras, _ = layer.find_cameras(TRACKS.points, weights=TRACKS.weights)
    flat = layer.rest @ cameras.mT
    share = TRACKS.weights[..., None]
    image = (TRACKS.points - (TRACKS.points * share).sum(1, keepdim=True) / share.sum(1, keepdim=True)) * share
    scales = (flat * image).sum((1, 2)) / (flat.square() * share).sum((1, 2))
    run = lambda module, **o: module(TRACKS.points, cameras, weights=TRACKS.weights, **o)  # noqa: E731
    assert_close(run(free), run(layer, scales=scales))
    points, seen = layer._centred(TRACKS.points, TRACKS.weights)
    low, high = layer._bounds(points, seen, layer.rest)
    assert_close(high / low, torch.full_like(low, 1.21))
    assert_close(run(layer), run(layer, scales=scales.clamp(low, high)))


def test_lengths_scale_the_templates_bones():
    body = TRACKS.skeleton
    layer = UnrolledKCS(body, 2, learnable_lengths=True)
    own = bone_lengths(layer.rest, layer.bones)
    assert_close(layer.template(layer.rest), layer.rest)
    assert layer.raw_length.shape == (body.num_bones,)
    given = UnrolledKCS(body, 2, lengths=[1.0] * body.num_bones)
    rest = given.template(layer.rest)
    assert_close(bone_lengths(rest, layer.bones), own.mean().expand_as(own))
    unit = lambda x: torch.nn.functional.normalize(bone_vectors(x, layer.bones), dim=-1)  # noqa: E731
    assert_close(unit(rest), unit(layer.rest))
    assert not list(UnrolledKCS(body, 2, lengths=[1.0] * body.num_bones, learnable=False).parameters())


def test_learning_finds_the_bodys_lengths():
    """The template's bones are wrong by up to a third; steps and lengths are learned on one clip, another tells."""
    generator = torch.Generator().manual_seed(3)
    truth = REST + 0.05 * torch.randn(24, 7, 3, generator=generator, dtype=torch.float64)
    truth = truth - truth.mean(-2, keepdim=True)
    cameras = scene(BODY, frames=12)[1]
    layer = UnrolledKCS(BODY, 4, template=REST, learnable_lengths=True)
    with torch.no_grad():
        layer.raw_length += 0.5 * normal(6, seed=5)
    loss = lambda x: (layer(x @ cameras.mT, cameras, scales=torch.ones(12).double()) - x).square().mean()  # noqa: E731
    before = loss(truth[12:]).item()
    optimiser = torch.optim.Adam(layer.parameters(), 0.05)
    for _ in range(60):
        optimiser.zero_grad()
        loss(truth[:12]).backward()
        optimiser.step()
    assert loss(truth[12:]).item() < 0.3 * before


def test_links_may_close_chains():
    layer = UnrolledKCS(BODY, 3, template=REST, links=[("left_hand", "right_hand")], learnable_lengths=True)
    assert len(layer.bones) == 7 and layer.raw_length.shape == (7,)
    tracks, cameras, _ = scene(BODY)
    assert torch.isfinite(layer(tracks, cameras)).all()


def test_a_start_may_be_given():
    tracks, cameras, weights = scene(BODY, "gaps")
    scales = torch.ones(len(tracks)).double()
    layer, long = (UnrolledKCS(BODY, n, template=REST, mu=0.2, final=0.2) for n in (3, 6))
    first = layer(tracks, cameras, scales=scales, weights=weights)
    again = layer(tracks, cameras, scales=scales, weights=weights, start=first)
    assert_close(again, long(tracks, cameras, scales=scales, weights=weights))
    template = layer.template(tracks).expand_as(first)
    assert_close(layer(tracks, cameras, scales=scales, weights=weights, start=template), first)


def test_scale_and_translation_pass_through():
    tracks, cameras, weights = scene(BODY, "gaps")
    module = UnrolledKCS(BODY, 5, template=REST)
    shape = module(tracks, cameras, weights=weights)
    assert_close(module(1e3 * tracks, cameras, weights=weights), 1e3 * shape)
    assert_close(module(tracks + normal(6, 1, 2), cameras, weights=weights), shape)
    assert_close(UnrolledKCS(BODY, 5, template=50 * REST)(tracks, cameras, weights=weights), shape)


@each_arrangement
def test_batches_equal_loops(arrangement):
    module = UnrolledKCS(BODY, 3, template=REST, arrangement=arrangement)
    camera = lambda *a: (a[0], rows_to_cameras(a[1])[0], *[x.abs() for x in a[2:]])  # noqa: E731
    same_as_loop(module, (5, 7, 2), (5, 2, 3), make=camera)
    same_as_loop(lambda w, r, u: module(w, r, weights=u), (5, 7, 2), (5, 2, 3), (5, 7), make=camera)
    same_as_loop(module.find_cameras, (5, 7, 2))


@each_arrangement
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("dtype", FLOATS)
def test_degenerate_clips_are_finite(arrangement, kind, dtype):
    tracks, cameras, weights = scene(BODY, kind, dtype=dtype)
    module = UnrolledKCS(BODY, 5, template=REST, arrangement=arrangement, learnable_lengths=True).to(dtype)
    run, parameters = with_parameters(module)
    finite(lambda w, r, *v: run((w, r), v, weights=weights), tracks, cameras, *parameters)
    found, scales = leaves_arguments_alone(lambda w, u: module.find_cameras(w, weights=u), tracks, weights)
    assert torch.isfinite(found).all() and torch.isfinite(scales).all()
    finite(lambda w, *v: run((w, found), v, weights=weights, scales=scales), tracks, *parameters)


def test_a_template_with_a_bone_of_no_length():
    rest = REST.clone()
    rest[2] = rest[1]
    tracks, cameras, _ = scene(BODY)
    run, parameters = with_parameters(UnrolledKCS(BODY, 4, template=rest, learnable_lengths=True))
    finite(lambda w, r, *v: run((w, r), v), tracks, cameras, *parameters)


def test_state_round_trip():
    one = UnrolledKCS(BODY, 4, template=REST, tau=0.7, learnable_lengths=True)
    two = UnrolledKCS(BODY, 4, template=REST, learnable_lengths=True)
    assert set(one.state_dict()) == {"raw_threshold", "raw_step", "raw_length"}
    two.load_state_dict(one.state_dict())
    tracks, cameras, _ = scene(BODY)
    assert torch.equal(one(tracks, cameras), two(tracks, cameras))


def test_weights_and_scales_may_have_another_precision():
    module, given = UnrolledKCS(BODY, 2, template=REST), scene(BODY, "gaps", dtype=torch.float32)
    tracks, cameras, weights = given
    value = module(tracks, cameras, weights=weights, scales=torch.linspace(0.5, 0.6, 6))
    scales = torch.linspace(0.5, 0.6, 6, dtype=torch.float32).double()
    assert_close(module(tracks, cameras, weights=weights.double(), scales=scales), value)


@pytest.mark.parametrize("dtype", HALVES)
@pytest.mark.parametrize("frames", [1, 30, 31])
def test_half_precision_is_widened_inside(dtype, frames):
    """A span of its own, an odd number of frames, had the scale 0 / 0; and squares of pixels are out of range."""
    clip = walking_person(frames, skeleton="h36m17", dtype=torch.float32, turn=120.0)
    tracks, cameras, module = clip.tracks.points.to(dtype), clip.cameras.to(dtype), UnrolledKCS("h36m17", 3)
    pairs = [(module(tracks, cameras), module(tracks.float(), cameras.float()))]
    pairs += zip(module.find_cameras(tracks), module.find_cameras(tracks.float()), strict=True)
    for rough, exact in pairs:
        assert rough.dtype == dtype
        assert_close(rough.float(), exact, rtol=2 * torch.finfo(dtype).eps, atol=torch.finfo(dtype).eps)


def test_what_does_not_fit():
    with pytest.raises(SkeletonError, match="no template"):
        UnrolledKCS(BODY)
    with pytest.raises(ShapeError, match="template: expected 7 finite positions"):
        UnrolledKCS(BODY, template=REST[:5])
    for options in ({"tau": 0.0}, {"scale_range": 0.5}, {"arrangement": "rows"}):
        with pytest.raises(OptionError, match="expected tau > 0"):
            UnrolledKCS(BODY, template=REST, **options)
    for lengths in ([1.0] * 5, [1.0] * 5 + [-1.0]):
        with pytest.raises(OptionError, match="lengths: expected 6 positive numbers"):
            UnrolledKCS(BODY, template=REST, lengths=lengths)
    tracks, cameras, _ = scene(BODY)
    module = UnrolledKCS(BODY, 2, template=REST)
    with pytest.raises(ShapeError, match="7, 2.*skeleton 'body7'"):
        module(tracks[:, :6], cameras)
    with pytest.raises(ShapeError, match=r"scales \(\.\.\., 6\)"):
        module(tracks, cameras, scales=torch.ones(5))
    with pytest.raises(ShapeError, match=r"scales \(\.\.\., 6\), got \(3, 6\) for tracks \(2, 6, 7, 2\)"):
        module(tracks.expand(2, -1, -1, -1), cameras, scales=torch.ones(3, 6))
    with pytest.raises(ShapeError, match="expected a tensor of scales, got list"):
        module(tracks, cameras, scales=[1.0] * 6)
    with pytest.raises(ShapeError, match="expected a tensor of tracks, got list"):
        module(tracks.tolist(), cameras)
    with pytest.raises(ShapeError, match=r"cameras \(\.\.\., T, 2, 3\)"):
        module(tracks, cameras[:3])


def test_cameras_of_many_clips_are_found_together(monkeypatch):
    calls = []
    monkeypatch.setattr(unrolled_kcs, "fit_cameras", lambda *given: calls.append(len(given[0])) or fit_cameras(*given))
    UnrolledKCS(BODY, 2, template=REST).find_cameras(normal(3, 2, 5, 7, 2), inside=torch.arange(5) < 4)
    assert calls == [30]


def test_an_empty_batch_has_no_cameras():
    tracks, _, _ = scene(BODY)
    rows, sizes = UnrolledKCS(BODY, 2, template=REST).find_cameras(tracks[None][:0])
    assert rows.shape == (0, len(tracks), 2, 3) and sizes.shape == (0, len(tracks))


@pytest.mark.parametrize("padded", [False, True])
def test_frames_that_show_nobody_do_not_make_the_body_small(padded):
    layer = UnrolledKCS("h36m17", num_steps=4, scale_range=2.0)
    weights = TRACKS.weights.clone()
    weights[5:25] = 0
    inside = torch.arange(30) < 28 if padded else None
    whole, gap = (layer(TRACKS.points, CLIP.cameras, weights=w, inside=inside) for w in (TRACKS.weights, weights))
    sizes = [bone_lengths(shape[:4], BODY_17.bones).sum() for shape in (whole, gap)]
    assert_close(sizes[1], sizes[0], rtol=0.05, atol=0)
