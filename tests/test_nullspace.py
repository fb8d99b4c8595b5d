"""The metric upgrade by null space and least trace."""

import pytest
import torch
from numerics import BATCHES, DEVICES, FLOATS, camera_disagreement, leaves_arguments_alone, normal, rotations, turning
from torch.testing import assert_close

from kcs_torch.errors import ShapeError
from kcs_torch.functional import factorize, orthonormality_defect, rows_to_cameras
from kcs_torch.solvers import metric_upgrade, null_space_upgrade


def seen(frames=60, joints=25, shapes=1, even=True):
    """Centred tracks of a body with some basis shapes, the first one's weight even over time or not; the cameras."""
    cameras = (turning(frames, 300.0, tilt=0.4) @ rotations(seed=0))[:, :2]
    basis = normal(shapes, joints, 3, seed=1)
    basis = basis - basis.mean(1, keepdim=True)
    time = torch.linspace(0, 6, frames, dtype=torch.float64)[:, None]
    weights = torch.cat([torch.ones_like(time), *[0.4 * (time * (k + 1)).sin() for k in range(1, shapes)]], 1)
    if not even:
        weights[:, 0] += 0.3 * time[:, 0].cos()
    return torch.einsum("tk,knd->tnd", weights, basis) @ cameras.mT, cameras


def angle(motion, q, cameras):
    return float(camera_disagreement(rows_to_cameras(motion @ q)[0], cameras))


@pytest.mark.parametrize("even", [True, False])
@pytest.mark.parametrize("softness", [0.0, 1e-6])
def test_rigid_tracks_have_an_exact_null_space(even, softness):
    tracks, cameras = seen(even=even)
    motion, _ = factorize(tracks, 3)
    q = null_space_upgrade(motion, softness=softness, num_steps=400)
    assert orthonormality_defect(motion @ q).max() < 1e-8
    assert angle(motion, q, cameras) < 1e-3
    assert_close((motion @ q).square().sum(-1).mean(), torch.ones(()).double(), rtol=1e-4, atol=0)


@pytest.mark.parametrize("shapes", [2, 3])
def test_cameras_of_deforming_bodies_are_near_without_a_search(shapes):
    tracks, cameras = seen(shapes=shapes)
    motion, _ = factorize(tracks + 1e-3 * normal(*tracks.shape, seed=4), 3 * shapes)
    start = null_space_upgrade(motion)
    assert angle(motion, start, cameras) < 12
    assert angle(motion, metric_upgrade(motion, start)[0], cameras) < 4


def test_the_trace_is_least():
    """Of the softened objective, against other semi-definite matrices of the same scale."""
    tracks, _ = seen(shapes=2)
    motion, _ = factorize(tracks + 0.05 * normal(*tracks.shape, seed=4), 3)  # at rank 3 the cut loses nothing
    size = motion.norm(dim=(0, 1)).sqrt()
    rows = motion / motion.abs().max()
    rows = rows / (rows.norm(dim=(0, 1)).sqrt())
    a, b = rows[:, 0], rows[:, 1]
    inner = lambda f, x, y: (x @ f * y).sum(-1)  # noqa: E731
    scale = lambda f: (inner(f, a, a) + inner(f, b, b)).mean() / 2  # noqa: E731

    def misfit(f):
        return (((inner(f, a, a) - inner(f, b, b)) / 2).square() + inner(f, a, b).square()).mean()

    results = {}
    for softness in (1e-3, 1e3):
        q = null_space_upgrade(motion, softness=softness, num_steps=2000) * size[:, None]
        f = q @ q.mT
        results[softness] = f / scale(f)
    strict, loose = results.values()
    assert misfit(strict) < misfit(loose) and strict.trace() > loose.trace()
    others = [normal(3, 3, seed=k) for k in range(200)]
    for other in (x @ x.mT for x in others):
        assert other.trace() / scale(other) > 0.999 * loose.trace()  # so loose that the trace alone counts


@pytest.mark.parametrize("batch", BATCHES)
def test_batches(batch):
    motion = normal(*batch, 8, 2, 4)
    q = null_space_upgrade(motion, num_steps=20)
    alone = torch.stack([(p := null_space_upgrade(m, num_steps=20)) @ p.mT for m in motion.reshape(-1, 8, 2, 4)])
    assert_close(q @ q.mT, alone.reshape(*batch, 4, 4))  # Q is unique up to a rotation


@pytest.mark.parametrize(("scale", "dtype"), [(1e-9, torch.float32), (1e9, torch.float32), (1e-200, torch.float64)])
def test_any_unit(scale, dtype):
    tracks, _ = seen(shapes=2)
    motion, _ = factorize(tracks, 6)
    plain, scaled = null_space_upgrade(motion), null_space_upgrade((motion * scale).to(dtype))
    scaled = scaled.double() * scale
    assert_close(scaled @ scaled.mT, plain @ plain.mT, rtol=1e-3, atol=1e-3 * float((plain @ plain.mT).abs().max()))


@pytest.mark.parametrize("dtype", FLOATS)
@pytest.mark.parametrize("softness", [0.0, 1e-3])
@pytest.mark.parametrize("kind", ["zero", "static", "one frame", "two frames", "planar", "column of rounding"])
def test_degenerate_motion_is_finite(kind, softness, dtype):
    motion = {
        "zero": torch.zeros(6, 2, 4),
        "static": normal(1, 2, 4).expand(6, 2, 4),
        "one frame": normal(1, 2, 4),
        "two frames": normal(2, 2, 4),
        "planar": normal(6, 2, 4) * torch.tensor([1.0, 1, 0, 0]),
        "column of rounding": normal(6, 2, 4) * torch.tensor([1.0, 1, 1, 1e-17]),
    }[kind].to(dtype)
    q = null_space_upgrade(motion, softness=softness)
    assert torch.isfinite(q).all()
    assert (motion @ q).abs().max() < 1e3


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("dtype", FLOATS)
def test_results_follow_inputs(device, dtype):
    motion = normal(8, 2, 4, dtype=dtype, device=device)
    q = leaves_arguments_alone(null_space_upgrade, motion)
    assert (q.dtype, q.device.type) == (dtype, device)


@pytest.mark.parametrize("shape", [(5, 2, 2), (5, 3, 3), (2, 3)])
def test_motion_that_does_not_fit(shape):
    with pytest.raises(ShapeError, match="null_space_upgrade: expected motion"):
        null_space_upgrade(torch.zeros(shape))
