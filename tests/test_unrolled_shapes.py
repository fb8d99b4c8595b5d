"""Unrolled solvers: shapes, precision and options."""

import math
from copy import deepcopy

import pytest
import torch
from numerics import (
    BODY,
    CHAIN,
    DEVICES,
    FLOATS,
    HALVES,
    leaves_arguments_alone,
    normal,
    same_as_loop,
    turning,
)
from torch.testing import assert_close
from unrolled_scenes import each_body, scene

from kcs_torch.errors import NotFiniteError, OptionError, ShapeError, SkeletonError
from kcs_torch.functional import rows_to_cameras
from kcs_torch.nn import UnrolledFPC, UnrolledPKC, UnrolledSfAM


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


def test_cameras_that_are_not_finite_are_named():
    tracks, cameras, _ = scene(BODY)
    cameras = cameras.clone()
    cameras[2] = torch.nan
    for module in (UnrolledFPC(2), UnrolledSfAM(BODY, 2)):
        with pytest.raises(NotFiniteError, match=r"and cameras, where any are given, finite numbers in every frame"):
            module(tracks, cameras)


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
