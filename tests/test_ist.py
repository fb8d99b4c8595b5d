"""The metric upgrade: cameras of rigid and deforming bodies, and the convex relaxation behind it."""

import pytest
import torch
from numerics import BATCHES, DEVICES, FLOATS, HALVES, leaves_arguments_alone, normal, rotations, turning
from torch.testing import assert_close

from kcs_torch.errors import OptionError, ShapeError
from kcs_torch.functional import factorize, nearest_rotation, orthonormality_defect, rows_to_cameras
from kcs_torch.solvers import ist, metric_upgrade


def rigid(frames=20, joints=12, seed=0, degrees=200.0):
    """Centred tracks of a rigid body that tumbles, and its cameras."""
    cameras = (turning(frames, degrees, tilt=0.4) @ rotations(seed=seed))[:, :2]
    points = normal(joints, 3, seed=seed)
    points = points - points.mean(0)
    return points @ cameras.mT, cameras


def deforming(frames=60, joints=25, shapes=2, seed=0):
    """Centred tracks of a body with K basis shapes whose weights vary, and its cameras."""
    cameras = (turning(frames, 300.0, tilt=0.4) @ rotations(seed=seed))[:, :2]
    basis = normal(shapes, joints, 3, seed=seed)
    basis = basis - basis.mean(1, keepdim=True)
    time = torch.linspace(0, 6, frames, dtype=torch.float64)[:, None]
    weights = torch.cat([torch.ones_like(time), *[0.4 * (time * (k + 1)).sin() for k in range(1, shapes)]], 1)
    points = torch.einsum("tk,knd->tnd", weights, basis)
    return points @ cameras.mT, cameras


def gauge_error(found, true):
    """Degrees between camera rows (..., T, 2, 3), at worst, after the best common rotation or reflection."""
    turn = nearest_rotation((found.mT @ true).sum(-3), reflect=True)
    cosine = (found @ turn[..., None, :, :] * true).sum((-2, -1)) / 2
    return torch.rad2deg(torch.arccos(cosine.clamp(-1, 1))).max().item()


def upgraded(tracks, rank, **options):
    motion, _ = factorize(tracks, rank)
    q, defect = metric_upgrade(motion, ist(motion), **options)
    return motion @ q[..., None, :, :], defect


@pytest.mark.parametrize("frames", [3, 5, 20])
def test_relaxation_finds_rigid_cameras_roughly_and_the_upgrade_exactly(frames):
    tracks, cameras = rigid(frames)
    motion, _ = factorize(tracks, 3)
    rough = rows_to_cameras(motion @ ist(motion))[0]
    assert gauge_error(rough, cameras) < 10
    rows, defect = upgraded(tracks, 3, num_steps=300, tolerance=1e-12)
    assert defect < 1e-12
    assert gauge_error(rows_to_cameras(rows)[0], cameras) < 1e-3
    assert_close(rows.square().sum(-1).mean(), torch.ones(()).double())


def test_without_weight_the_relaxation_is_exact_for_rigid_bodies():
    tracks, cameras = rigid(20)
    motion, _ = factorize(tracks, 3)
    q = ist(motion, weight=0.0, num_steps=4000)
    assert orthonormality_defect(motion @ q).max() < 1e-6
    assert gauge_error(rows_to_cameras(motion @ q)[0], cameras) < 0.1


def test_relaxation_is_optimal():
    """Against other positive semi-definite matrices: the objective that the docstring states."""
    tracks, _ = deforming()
    motion, _ = factorize(tracks, 3)  # at rank 3 the cut to rank 3 loses nothing
    a, b = motion[:, 0], motion[:, 1]

    def objective(f, weight):
        aa, bb, ab = ((x @ f * y).sum(-1) for x, y in ((a, a), (b, b), (a, b)))
        misfit = torch.stack([aa - bb, 2 * ab, aa + bb - 2], -1)
        return 0.5 * misfit.square().sum((-2, -1)) / len(a) + weight * f.diagonal(dim1=-2, dim2=-1).sum(-1)

    first = 2 * (a.mT @ a + b.mT @ b) / len(a)  # the gradient at 0, which scales the weight
    weight = 1e-3 * torch.linalg.matrix_norm(first)
    q = ist(motion, num_steps=3000)
    best = objective(q @ q.mT, weight)
    for k in range(200):
        other = q + 10.0 ** (-4 + k / 50) * q.norm() * normal(3, 3, seed=k)
        assert objective(other @ other.mT, weight) >= best * (1 - 1e-6)


def test_a_body_of_two_shapes():
    tracks, cameras = deforming()
    rows, defect = upgraded(tracks, 6)
    assert defect < 2e-4
    assert gauge_error(rows_to_cameras(rows)[0], cameras) < 3
    rank3 = upgraded(tracks, 3)[1]
    assert defect < 0.05 * rank3  # the data tell that one shape is too few


def test_the_upgrade_never_raises_the_defect_and_stops_early():
    tracks, _ = deforming()
    motion, _ = factorize(tracks, 6)
    start = normal(6, 3)
    last = None
    for steps in (0, 1, 5, 20, 80):
        _, defect = metric_upgrade(motion, start, num_steps=steps, tolerance=0.0)
        assert last is None or defect <= last
        last = defect
    assert_close(metric_upgrade(motion, start, num_steps=400)[1], metric_upgrade(motion, start, num_steps=150)[1])


def test_defect_is_that_of_the_rows():
    tracks, _ = deforming()
    motion, _ = factorize(tracks, 6)
    q, defect = metric_upgrade(motion, normal(6, 3), num_steps=10)
    assert_close(defect, orthonormality_defect(motion @ q).mean())
    assert_close((motion @ q).square().sum(-1).mean(), torch.ones(()).double())


def test_scale_and_gauge_of_the_start_do_not_matter():
    tracks, _ = deforming()
    motion, _ = factorize(tracks, 6)
    start, turn = normal(6, 3), rotations()
    one, _ = metric_upgrade(motion, start, num_steps=20)
    two, _ = metric_upgrade(motion, 1e3 * start @ turn, num_steps=20)
    assert_close(one @ turn, two, rtol=1e-5, atol=1e-6)
    three, defect = metric_upgrade(1e-3 * motion, start, num_steps=20)
    assert_close(1e-3 * three, one, rtol=1e-5, atol=1e-6)
    assert defect < 1


def test_smoothness_prefers_the_camera_that_moves_evenly():
    tracks, _ = deforming()
    tracks = tracks + 0.1 * normal(*tracks.shape, seed=4)
    motion, _ = factorize(tracks, 6)
    bend = lambda q: (motion @ q).diff(n=2, dim=0).square().sum()  # noqa: E731
    start = ist(motion)
    plain, free = metric_upgrade(motion, start)
    smooth, defect = metric_upgrade(motion, start, smoothness=1.0)
    assert bend(smooth) < bend(plain)
    assert defect > free  # the price
    total = lambda q: orthonormality_defect(motion @ q).mean() + bend(q) / len(motion)  # noqa: E731
    assert total(smooth) < total(plain)


def test_evenness_makes_the_rows_of_all_frames_equally_long():
    """What is minimised is the sum that Tomasi and Kanade have, with the scale held."""
    tracks, _ = deforming()
    tracks = tracks + 0.1 * normal(*tracks.shape, seed=4)
    motion, _ = factorize(tracks, 6)

    def total(q):
        a, b = (motion @ q).unbind(1)
        length = (a.square().sum(-1) - 1).square() + (b.square().sum(-1) - 1).square()
        return (length / 2 + (a * b).sum(-1).square()).mean()

    start = ist(motion)
    free, defect = metric_upgrade(motion, start)
    even, price = metric_upgrade(motion, start, evenness=1.0, num_steps=400, tolerance=1e-9)
    spread = lambda q: (motion @ q).square().sum((-2, -1)).std()  # noqa: E731
    assert spread(even) < spread(free) and price > defect
    assert total(even) < total(free)
    for k in range(40):  # a minimum among Q of the same scale
        other = even + 1e-2 * even.norm() * normal(6, 3, seed=k)
        other = other / (motion @ other).square().sum(-1).mean().sqrt()
        assert total(other) > total(even)


def test_several_starts_at_once():
    tracks, _ = deforming()
    motion, _ = factorize(torch.stack([tracks, rigid(60, 25)[0]]), 6)
    starts = normal(4, 1, 6, 3)
    q, defect = metric_upgrade(motion, starts, num_steps=15, tolerance=0.0)
    assert q.shape == (4, 2, 6, 3) and defect.shape == (4, 2)
    for i in range(4):
        for j in range(2):
            alone, value = metric_upgrade(motion[j], starts[i, 0], num_steps=15, tolerance=0.0)
            assert_close(q[i, j], alone, rtol=1e-4, atol=1e-5)
            assert_close(defect[i, j], value, rtol=1e-4, atol=1e-9)


@pytest.mark.parametrize("batch", BATCHES)
def test_relaxation_of_batches(batch):
    motion = normal(*batch, 8, 2, 4)
    q = ist(motion, num_steps=20)
    alone = torch.stack([(p := ist(m, num_steps=20)) @ p.mT for m in motion.reshape(-1, 8, 2, 4)])
    assert_close(q @ q.mT, alone.reshape(*batch, 4, 4))  # Q is unique up to a rotation


@pytest.mark.parametrize("dtype", FLOATS)
@pytest.mark.parametrize("kind", ["zero", "static", "one frame", "two frames", "planar"])
def test_degenerate_motion_is_finite(kind, dtype):
    motion = {
        "zero": torch.zeros(6, 2, 4),
        "static": normal(1, 2, 4).expand(6, 2, 4),
        "one frame": normal(1, 2, 4),
        "two frames": normal(2, 2, 4),
        "planar": normal(6, 2, 4) * torch.tensor([1.0, 1, 0, 0]),
    }[kind].to(dtype)
    q = ist(motion)
    better, defect = metric_upgrade(motion, q)
    for value in (q, better, defect):
        assert torch.isfinite(value).all()


@pytest.mark.parametrize(
    ("scale", "dtype"), [(1e-6, torch.float32), (1e6, torch.float32), (1e-6, torch.float64), (1e6, torch.float64)]
)
def test_any_unit(scale, dtype):
    tracks, cameras = rigid()
    rows, _ = upgraded((scale * tracks).to(dtype), 3, num_steps=300, tolerance=1e-12)
    assert gauge_error(rows_to_cameras(rows.double())[0], cameras) < 0.1


@pytest.mark.parametrize("shape", [(5, 2, 2), (5, 3, 3), (2, 3)])
def test_motion_that_does_not_fit(shape):
    with pytest.raises(ShapeError, match="ist: expected motion"):
        ist(torch.zeros(shape))
    with pytest.raises(ShapeError, match="metric_upgrade: expected motion"):
        metric_upgrade(torch.zeros(shape), torch.zeros(3, 3))


@pytest.mark.parametrize("together", [0, -1, 4, 1.5, True])
def test_neighbours_that_do_not_make_the_batch(together):
    with pytest.raises(OptionError, match="together: expected a divisor of the 6 motions"):
        metric_upgrade(normal(6, 5, 2, 4), normal(6, 4, 3), together=together)


@pytest.mark.parametrize("dtype", HALVES)
def test_half_precision_is_widened(dtype):
    motion, start = normal(8, 2, 3).to(dtype), normal(3, 3, seed=1).to(dtype)
    found, expected = (metric_upgrade(motion.to(d), start.to(d), num_steps=20)[0] for d in (dtype, torch.float32))
    assert found.dtype == dtype
    assert_close(found, expected.to(dtype))
    rows = normal(200, 2, 3).to(dtype)
    cameras, scales = rows_to_cameras(rows)
    for ours, wide in zip((cameras, scales), rows_to_cameras(rows.float()), strict=True):
        assert_close(ours, wide.to(dtype))


@pytest.mark.parametrize("shape", [(3, 3), (4, 2), (3,)])
def test_start_that_does_not_fit(shape):
    with pytest.raises(ShapeError, match=r"expected start \(\.\.\., 4, 3\)"):
        metric_upgrade(normal(5, 2, 4), torch.zeros(shape).double())


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("dtype", FLOATS)
def test_results_follow_dtype_and_device(dtype, device):
    motion = normal(6, 2, 4, dtype=dtype, device=device)
    q = leaves_arguments_alone(ist, motion)
    values = [q, *leaves_arguments_alone(lambda m, s: metric_upgrade(m, s, smoothness=0.1), motion, q)]
    assert {(v.dtype, v.device.type) for v in values} == {(dtype, device)}


def test_motion_without_frames_is_told():
    with pytest.raises(ShapeError, match=r"ist: expected motion \(\.\.\., T, 2, R\) with T >= 1 and R >= 3"):
        ist(torch.zeros(0, 2, 4))
    with pytest.raises(ShapeError, match=r"metric_upgrade: expected motion"):
        metric_upgrade(torch.zeros(0, 2, 4), torch.zeros(4, 3))
