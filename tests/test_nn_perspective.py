"""Reprojection through a pinhole: where a body stands, the energy by hand, gradients, and what lies behind."""

import warnings

import pytest
import scipy.optimize
import torch
from numerics import FLOATS, HALVES, finite, gradcheck, leaves_arguments_alone, normal, rotations, same_as_loop
from torch.testing import assert_close

from kcs_torch.errors import OptionError, ShapeError
from kcs_torch.functional import perspective, pinhole_translation
from kcs_torch.nn import PerspectiveEnergy, ReprojectionEnergy
from kcs_torch.types import Intrinsics

LENS = (900.0, 950.0, 320.0, 240.0)
K = torch.tensor(LENS).double()


def scene(*batch, frames=5, noise=0.0, dtype=torch.float64):
    """Relative points of a body some metres away, where it stands, and its image in pixels."""
    points = 0.4 * normal(*batch, frames, 7, 3)
    place = torch.tensor([0.3, -0.2, 4.0]).double() + 0.5 * normal(*batch, frames, 3, seed=1)
    tracks = perspective(points + place[..., None, :], K) + noise * normal(*batch, frames, 7, 2, seed=2)
    return points.to(dtype), place.to(dtype), tracks.to(dtype)


def test_perspective_is_the_matrix_product():
    points = scene()[0] + torch.tensor([0, 0, 5.0]).double()
    matrix = torch.tensor([[LENS[0], 0, LENS[2]], [0, LENS[1], LENS[3]], [0, 0, 1]]).double()
    image = points @ matrix.mT
    assert_close(perspective(points, K), image[..., :2] / image[..., 2:])
    assert_close(Intrinsics.of(LENS).project(points), perspective(points, K))
    assert gradcheck(perspective, points, K)


def test_the_place_is_found():
    points, place, tracks = scene(3)
    weights = torch.rand(3, 5, 7, generator=torch.Generator().manual_seed(0)).double()
    rays = (tracks - K[2:]) / K[:2]
    assert_close(pinhole_translation(points, rays, weights), place)
    assert gradcheck(pinhole_translation, points[0], rays[0], weights[0] + 0.1, fast=True)


def test_the_place_is_that_of_least_squares():
    points, _, tracks = scene(frames=1, noise=20.0)
    rays, weights = (tracks - K[2:]) / K[:2], torch.linspace(0.2, 1, 7).double()

    def residual(t):
        moved = points[0].numpy() + t
        return ((moved[:, :2] - rays[0].numpy() * moved[:, 2:]) * weights.sqrt().numpy()[:, None]).ravel()

    best = scipy.optimize.least_squares(residual, [0.0, 0, 1]).x
    assert_close(pinhole_translation(points[0], rays[0], weights), torch.from_numpy(best), rtol=1e-5, atol=1e-6)


def test_no_error_where_the_image_is_right():
    points, place, tracks = scene()
    assert PerspectiveEnergy()(points, tracks, LENS).max() < 1e-15
    assert PerspectiveEnergy()(1000 * points + 7, tracks, LENS).max() < 1e-15  # in millimetres, about any origin
    absolute = points + place[:, None]
    assert PerspectiveEnergy(translation=False)(absolute, tracks, LENS).max() < 1e-15
    assert PerspectiveEnergy()(points @ rotations(5), tracks, LENS).min() > 1
    assert PerspectiveEnergy()(points * torch.tensor([1.0, 1.0, -1.0]), tracks, LENS).min() > 1  # unlike parallel rays


def test_energy_by_hand():
    points, place, tracks = scene(noise=5.0)
    at = points + place[:, None]
    off = (perspective(at, K) - tracks).square().sum(-1)
    weights = torch.rand(5, 7, generator=torch.Generator().manual_seed(0)).double()
    fixed = PerspectiveEnergy(translation=False)
    assert_close(fixed(at, tracks, LENS), 0.5 * off.sum(-1))
    assert_close(fixed(at, tracks, LENS, weights), 0.5 * (weights * off).sum(-1))
    far = torch.where(off > 36, 2 * 6 * off.sqrt() - 36, off)
    assert_close(PerspectiveEnergy(translation=False, huber=6.0)(at, tracks, LENS), 0.5 * far.sum(-1))
    found = PerspectiveEnergy()(points, tracks, LENS)
    assert (found < 1.3 * fixed(at, tracks, LENS)).all() and (found > 0).all()


def test_far_away_it_is_weak_perspective():
    focal, distance = 1e7, 4e4
    points, scale = 0.4 * normal(5, 7, 3), focal / distance
    tracks = scale * points[..., :2] + 9 * normal(5, 7, 2, seed=3)
    weak = ReprojectionEnergy()(scale * points, tracks)
    place = torch.zeros(5, 1, 3).double()
    place[..., :2] = (tracks / scale - points[..., :2]).mean(1, keepdim=True)  # where parallel rays put it
    place[..., 2] = distance
    full = PerspectiveEnergy(translation=False)(points + place, tracks, (focal, focal, 0, 0))
    assert_close(full, weak, rtol=1e-3, atol=0)


def test_intrinsics_in_any_form():
    points, _, tracks = scene(2, noise=5.0)
    expected = PerspectiveEnergy()(points, tracks, LENS)
    matrix = [[LENS[0], 0, LENS[2]], [0, LENS[1], LENS[3]], [0, 0, 1]]
    for lens in (Intrinsics.of(LENS), matrix, K, K.expand(2, 4)):
        assert_close(PerspectiveEnergy()(points, tracks, lens), expected)
    other = torch.stack([K, 2 * K])  # of each clip
    both = PerspectiveEnergy()(points, torch.stack([tracks[0], 2 * tracks[1]]), other)
    assert_close(both, torch.stack([expected[0], 4 * expected[1]]))
    matrices = torch.tensor(matrix).double() * torch.tensor([[[1.0]], [[2.0]]])
    matrices[:, 2, 2] = 1
    assert_close(PerspectiveEnergy()(points, torch.stack([tracks[0], 2 * tracks[1]]), matrices), both)
    with pytest.raises(ShapeError, match=r"intrinsics of all clips, or of each, got those of \(3,\)"):
        PerspectiveEnergy()(points, tracks, K.expand(3, 4))


@pytest.mark.parametrize("lens", [LENS, Intrinsics.of(LENS), K], ids=["numbers", "object", "tensor"])
def test_it_compiles_without_a_break(lens):
    points, _, tracks = scene(2, noise=5.0)
    energy = PerspectiveEnergy()
    torch._dynamo.reset()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # what Dynamo says of itself
        found = torch.compile(energy, backend="aot_eager", fullgraph=True)(points, tracks, lens)
    torch._dynamo.reset()
    assert_close(found, energy(points, tracks, lens))


@pytest.mark.parametrize("translation", [True, False])
@pytest.mark.parametrize("huber", [None, 4.0])
def test_gradients(translation, huber):
    points, place, tracks = scene(frames=3, noise=5.0)
    at = points if translation else points + place[:, None]
    energy = PerspectiveEnergy(translation=translation, huber=huber)
    weights = torch.rand(3, 7, generator=torch.Generator().manual_seed(0)).double() + 0.1
    assert gradcheck(energy, at, tracks, K, weights, fast=True)


@pytest.mark.parametrize("translation", [True, False])
@pytest.mark.parametrize("place", ["one joint behind", "one joint near", "all behind"])
def test_gradients_of_what_lies_behind(translation, place):
    """The nearest depth hangs on all joints."""
    points, where, tracks = scene(frames=3, noise=5.0)
    at = points if translation else points + where[:, None]
    if place == "all behind":
        at, tracks = at - torch.tensor([0, 0, 8.0]).double(), 2 * K[2:] - tracks  # upside down, as it were behind
    else:
        at[:, 2, 2] -= 4.5 if place == "one joint behind" else 3.8
    weights = torch.rand(3, 7, generator=torch.Generator().manual_seed(0)).double() + 0.1
    energy = PerspectiveEnergy(translation=translation)
    assert energy(at, tracks, LENS).max() > 1e4
    assert gradcheck(energy, at, tracks, K, weights, fast=True)


@pytest.mark.parametrize("dtype", FLOATS)
@pytest.mark.parametrize("z", [-4.0, -1e-6, 0.0])
def test_one_joint_behind_has_a_finite_slope(z, dtype):
    """It has no size, whose root has none; nor is there rounding that takes the place of a size."""
    points, tracks = torch.full((5, 7, 3), z, dtype=dtype), torch.full((5, 7, 2), 300.0, dtype=dtype)
    weights, energy = torch.zeros(5, 7, dtype=dtype), PerspectiveEnergy(translation=False)
    for seen in (1, 3):  # at one point
        weights[:, :seen] = 0.3
        finite(lambda x, y, w: energy(x, y, LENS, w), points, tracks, weights)
        assert energy(points, tracks, LENS, weights).max() < 1e13


def test_what_lies_behind_is_charged_and_pushed_ahead():
    _, _, tracks = scene()
    energy = PerspectiveEnergy(translation=False)
    points = (scene()[0] - torch.tensor([0, 0, 4.0]).double()).requires_grad_()
    before = energy(points, tracks, LENS)
    (grad,) = torch.autograd.grad(before.sum(), points)
    assert torch.isfinite(grad).all() and (grad[..., 2].sum(-1) < 0).all() and before.min() > 1e6
    nearer = [energy(points + points.new_tensor([0, 0, z]), tracks, LENS) for z in (-4.0, 0.0, 1.0, 2.0, 3.0, 4.0, 8.0)]
    assert (torch.stack(nearer).diff(dim=0) < 0).all()
    one = torch.tensor([[[0.0, 0, 1.0], [0, 0, 1.0], [0, 0, 0.1]]]).double()  # nearest: 0.15 of the distance of 0.7
    near = 0.15 * 0.7
    expected = 0.5 * LENS[0] * LENS[1] * ((near - 0.1) / near) ** 2
    assert energy(one, K[2:].expand(1, 3, 2), LENS).item() == pytest.approx(expected)


@pytest.mark.parametrize("dtype", FLOATS)
@pytest.mark.parametrize("kind", ["one joint seen", "two joints seen", "one point", "one pixel", "flat", "zero"])
def test_degenerate_frames_are_finite(kind, dtype):
    points, _, tracks = scene(dtype=dtype)
    weights = torch.ones(5, 7, dtype=dtype)
    if kind.endswith("seen"):
        weights[:, 1 + (kind == "two joints seen") :] = 0
    if kind in ("one point", "zero"):
        points = torch.zeros_like(points) + (kind == "one point")
    if kind in ("one pixel", "zero"):
        tracks = torch.full_like(tracks, 300.0)
    if kind == "flat":
        points[..., 2] = 0
    for translation in (True, False):
        energy = PerspectiveEnergy(translation=translation)
        finite(lambda x, y, w, e=energy: e(x, y, LENS, w), points, tracks, weights)
    if kind == "one joint seen":
        assert PerspectiveEnergy()(points, tracks, LENS, weights).max() < 1e-3


@pytest.mark.parametrize("dtype", FLOATS)
def test_joints_that_coincide_have_a_bounded_slope(dtype):
    """The best place for them is the camera's own: what is left of their distance there is rounding."""
    tracks = scene(dtype=dtype)[2]
    for place in ((1.0, 1.0, 1.0), (0.3, -2.0, 7.0), (100.0, -20.0, 3000.0)):
        for weight in (1.0, 0.37, 0.01, 1e-5, 1e-7):
            points = torch.tensor(place, dtype=dtype).expand(5, 7, 3).clone().requires_grad_()
            value = PerspectiveEnergy()(points, tracks, LENS, torch.full((5, 7), weight, dtype=dtype))
            (grad,) = torch.autograd.grad(value.sum(), points)
            assert torch.isfinite(value).all() and grad.abs().max() < weight * 1e8, (place, weight)


def test_tracks_that_are_nan_are_unseen():
    points, _, tracks = scene(noise=2.0)
    weights = torch.ones(5, 7).double()
    weights[1, 2] = weights[3, :5] = weights[4] = 0
    hidden = torch.where(weights[..., None] > 0, tracks, torch.nan)
    expected = PerspectiveEnergy()(points, tracks, LENS, weights)
    assert_close(PerspectiveEnergy()(points, hidden, LENS), expected, rtol=0, atol=0)
    (grad,) = finite(lambda x: PerspectiveEnergy()(x, hidden, LENS), points)
    assert grad[:4].any() and not grad[weights == 0].any()


def test_a_few_steps_lower_it():
    points, _, tracks = scene()
    start = (points + 0.1 * normal(5, 7, 3, seed=7)).requires_grad_()
    energy, optimiser = PerspectiveEnergy(), torch.optim.Adam([start], 0.01)
    first = energy(start, tracks, LENS).mean().item()
    for _ in range(100):
        optimiser.zero_grad()
        energy(start, tracks, LENS).mean().backward()
        optimiser.step()
    assert energy(start, tracks, LENS).mean() < 0.05 * first


def test_batches_dtypes_and_autocast():
    lens = torch.tensor([3.0, 3.0, 0, 0]).double()
    same_as_loop(lambda x, y, w: PerspectiveEnergy()(0.2 * x, 0.2 * y, lens, w.abs()), (5, 7, 3), (5, 7, 2), (5, 7))
    points, _, tracks = scene(noise=5.0)
    expected = PerspectiveEnergy()(points, tracks, LENS)
    for dtype in HALVES:
        value = leaves_arguments_alone(lambda x, y: PerspectiveEnergy()(x, y, LENS), points.to(dtype), tracks.to(dtype))
        assert value.dtype == dtype
    single = PerspectiveEnergy()(points.float(), tracks.float(), LENS)
    assert_close(single.double(), expected, rtol=1e-3, atol=1e-2)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        assert torch.equal(PerspectiveEnergy()(points.float(), tracks.float(), LENS), single)


def test_what_does_not_fit_is_said():
    points, _, tracks = scene()
    for options in ({"huber": 0.0}, {"nearest": 0.0}, {"nearest": float("nan")}):
        with pytest.raises(OptionError, match="PerspectiveEnergy"):
            PerspectiveEnergy(**options)
    for wrong in (tracks[:4], tracks[:, :6], points):
        with pytest.raises(ShapeError, match=r"tracks \(\.\.\., 5, 7, 2\)"):
            PerspectiveEnergy()(points, wrong, LENS)
    with pytest.raises(ShapeError, match="intrinsics"):
        PerspectiveEnergy()(points, tracks, (1.0, 2.0))
    with pytest.raises(ShapeError, match=r"PerspectiveEnergy: expected intrinsics \(4,\) that are the same in all"):
        PerspectiveEnergy()(points, tracks, torch.tensor(LENS).expand(5, 4))


def matrix(lens):
    fx, fy, cx, cy = lens.unbind(-1)
    zero, one = torch.zeros_like(fx), torch.ones_like(fx)
    return torch.stack([fx, zero, cx, zero, fy, cy, zero, zero, one], -1).unflatten(-1, (3, 3))


def test_a_matrix_has_a_derivative_and_is_mapped():
    points, _, tracks = scene(noise=1.0)
    energy = PerspectiveEnergy()
    (own,) = torch.autograd.grad(energy(points, tracks, lens := K.clone().requires_grad_()).sum(), lens)
    (found,) = torch.autograd.grad(energy(points, tracks, full := matrix(K).requires_grad_()).sum(), full)
    assert_close(torch.stack([found[0, 0], found[1, 1], found[0, 2], found[1, 2]]), own)
    several = torch.func.vmap(lambda k: energy(points, tracks, k))(torch.stack([matrix(K), matrix(2 * K)]))
    assert_close(several[0], energy(points, tracks, LENS))


@pytest.mark.parametrize(
    "wrong",
    [
        torch.zeros(4),
        torch.tensor([-1500.0, 1500, 640, 360]),
        torch.full((2, 4), torch.nan),
        matrix(K).mT[None],
        2 * matrix(K)[None],
        matrix(K)[None] + torch.tensor([[0.0, 50, 0], [0, 0, 0], [0, 0, 0]]),
    ],
    ids=["zero", "negative", "nan", "transposed", "doubled", "skewed"],
)
def test_tensors_of_intrinsics_are_looked_at(wrong):
    points, _, tracks = scene()
    with pytest.raises(OptionError, match="intrinsics: expected"):
        PerspectiveEnergy()(points, tracks, wrong)
