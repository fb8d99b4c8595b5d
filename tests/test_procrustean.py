"""The moving viewpoint: log-determinants of aligned bones, their curvature, starts and the energy as a loss."""

import pytest
import roma
import torch
from numerics import finite, normal
from torch.autograd import gradcheck
from torch.testing import assert_close

from kcs_torch.data.synthetic import walking_person
from kcs_torch.errors import OptionError, ShapeError
from kcs_torch.functional import complete_rotation, nearest_rotation
from kcs_torch.functional.chain import bone_lengths, bone_vectors
from kcs_torch.functional.rigidity import distance_spread, rigid_tree
from kcs_torch.functional.scatter import inverse_scatter, scatter_log_det
from kcs_torch.nn.procrustean import ProcrusteanEnergy
from kcs_torch.skeleton import Skeleton
from kcs_torch.solvers import curvature
from kcs_torch.solvers.curvature import block_roots, frame_curvature, whitening
from kcs_torch.solvers.lifts import random_lifts, turning_cameras
from kcs_torch.solvers.procrustean import (
    COARSE,
    FINE,
    Stage,
    align_rotations,
    aligned_levels,
    depth_deviation,
    length_energy,
    motion_energy,
    procrustean,
    track_energy,
)

BONES = torch.tensor([(0, 1), (1, 2), (2, 3), (1, 4), (4, 5)])
BODY = Skeleton.from_edges(BONES.tolist(), 6)


def swinging_body(frames: int = 60, degrees: float = 180.0) -> tuple[torch.Tensor, torch.Tensor]:
    """Points (T, 6, 3) in the camera frame, rms of the image 1, and the cameras (T, 3, 3): two arms swing."""
    time = torch.linspace(0, 6.0, frames, dtype=torch.float64)
    rest = torch.tensor([[0, -1, 0], [0, 0, 0], [1, 0.2, 0], [1.2, 1, 0], [-1, 0.3, 0], [-1.3, 1.2, 0]]).double()
    offset = bone_vectors(rest, BONES).expand(frames, -1, -1).clone()
    zero = torch.zeros_like(time)
    for bones, angle in (
        ((1, 2), 0.7 * time.sin()),
        ((2,), 0.5 * (2 * time).cos()),
        ((3, 4), 0.6 * (1.3 * time).cos()),
    ):
        swing = roma.rotvec_to_rotmat(torch.stack([angle, 0.4 * angle, zero], -1))
        for b in bones:
            offset[:, b] = (swing @ offset[:, b, :, None])[..., 0]
    points = torch.zeros(frames, 6, 3, dtype=torch.float64)
    for b, (parent, child) in enumerate(BONES.tolist()):
        points[:, child] = points[:, parent] + offset[:, b]
    cameras = turning_cameras([degrees], frames, dtype=torch.float64)[0]
    seen = points @ cameras.mT
    seen = seen - seen.mean(1, keepdim=True)
    return seen / seen[..., :2].square().sum(-1).mean().sqrt(), cameras


def test_scatter_log_det_is_the_gaussian_charge():
    values = torch.randn(2, 7, 4, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    scatter = values.mT @ values / 7 + 0.1 * torch.eye(4, dtype=torch.float64)
    assert torch.allclose(scatter_log_det(values, 0.1), 3.5 * torch.logdet(scatter))
    assert torch.allclose(inverse_scatter(values, 0.1), torch.linalg.inv(scatter))
    with pytest.raises(ShapeError):
        scatter_log_det(torch.zeros(3), 1.0)


@pytest.mark.parametrize("shape", [(5, 4), (2, 3, 6), (1, 3)])
def test_scatter_log_det_gradient(shape):
    assert gradcheck(lambda x: scatter_log_det(x, 0.1), torch.randn(shape, dtype=torch.float64, requires_grad=True))
    assert gradcheck(lambda x: scatter_log_det(x, 0.1), torch.zeros(shape, dtype=torch.float64, requires_grad=True))


@pytest.mark.parametrize("reflect", [False, True])
def test_nearest_rotation_gradient(reflect):
    matrix = torch.randn(3, 3, 3, dtype=torch.float64, requires_grad=True)
    assert gradcheck(lambda m: nearest_rotation(m, reflect=reflect), matrix)
    same = torch.eye(3, dtype=torch.float64).requires_grad_()  # all singular values repeat
    assert gradcheck(lambda m: nearest_rotation(m), same)
    flat = torch.zeros(3, 3, requires_grad=True)
    nearest_rotation(flat).sum().backward()
    assert flat.grad.isfinite().all()


def test_curvature_is_the_hessian_with_covariances_held():
    points, cameras = swinging_body(5)
    stage = Stage(1e-2, 0, 1.0, 0.0, 0.1)
    points, turned = points[None], cameras[None]
    levels = aligned_levels(points, turned, BONES, stage)
    precision = inverse_scatter(levels[0][1], stage.eps)
    mean = (bone_vectors(points, BONES) @ turned).flatten(-2).mean(-2, keepdim=True).detach()

    def surrogate(step):  # of frame 2, one half of the squared Mahalanobis distance
        shift = step[:18].view(3, 6).mT
        rotation = roma.rotvec_to_rotmat(step[18:]) @ turned[0, 2]
        row = (bone_vectors(points[0, 2] + shift, BONES) @ rotation).flatten() - mean[0, 0]
        return row

    jacobian = torch.autograd.functional.jacobian(surrogate, torch.zeros(21, dtype=torch.float64))
    expected = jacobian.mT @ precision[0] @ jacobian
    found = frame_curvature(points, turned, BONES, precision, 3)
    assert torch.allclose(found.matrix[0, 2], expected, atol=1e-8 * expected.abs().max())
    depth = frame_curvature(points, turned, BONES, precision, 1)
    pick = [*range(12, 18), 18, 19, 20]
    assert torch.allclose(depth.matrix[0, 2], expected[pick][:, pick], atol=1e-8 * expected.abs().max())
    roots = block_roots(depth)
    gauge = depth.matrix.clone()
    gauge[..., :6, :6] += gauge.diagonal(dim1=-2, dim2=-1)[..., :6].mean(-1)[..., None, None] / 6
    assert torch.allclose(roots @ roots.mT @ gauge, torch.eye(9, dtype=torch.float64).expand_as(gauge), atol=1e-2)


@pytest.mark.parametrize("free", [1, 3])
def test_roots_do_not_depend_on_how_many_frames_are_made_together(free, monkeypatch):
    points, cameras = swinging_body(9)
    points, turned = torch.stack([points, 1.1 * points]), torch.stack([cameras, cameras])
    precision = torch.rand(2, 9, 6, dtype=torch.float64) if free == 3 else None
    levels = aligned_levels(points, turned, BONES, FINE[0])
    make = lambda: whitening(  # noqa: E731
        points, turned, BONES, levels, free, BONES, torch.ones(5).double(), 0.01, precision
    )
    whole = make()
    monkeypatch.setattr(curvature, "RUN", 4)
    assert torch.allclose(make(), whole, rtol=1e-6, atol=1e-6)


def test_terms_have_gradients_also_where_nothing_moves():
    points, cameras = swinging_body(4)
    pull = torch.ones(5, dtype=torch.float64)
    for x in (points, torch.zeros_like(points), points[:1].expand(4, -1, -1), points[:1]):
        x = x.clone().requires_grad_()
        turned = cameras[: len(x)]
        total = motion_energy(x, turned, BONES, FINE[0]) + length_energy(x, BONES, pull, 0.01)
        total = total + track_energy(x, points[: len(x), :, :2] + 0.1, torch.ones(len(x), 6), 0.05)
        total.backward()
        assert total.isfinite() and x.grad.isfinite().all()
    free = points.clone().requires_grad_()
    assert gradcheck(lambda x: length_energy(x, BONES, pull, 0.05), free)
    assert gradcheck(lambda x: motion_energy(x, cameras, BONES, Stage(1e-2, 0, 1.0, 1.0, 0.1)), free)


def filmed_person(frames: int = 60) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Points (T, 17, 3) and cameras (T, 3, 3) of a walk seen from half around, rms of the image 1, and the bones."""
    clip = walking_person(frames, turn=180)
    points = clip.points - clip.points.mean(1, keepdim=True)
    points = points / points[..., :2].square().sum(-1).mean().sqrt()
    return points, complete_rotation(clip.cameras), clip.tracks.skeleton.bone_index()


def test_recovers_depths_and_ranks_the_true_start_first():
    points, cameras, bones = filmed_person()
    image = points[..., :2]
    blur = 0.2 * torch.randn(60, 17, 1, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    near = torch.cat([image, points[..., 2:] + blur], -1)
    starts = torch.cat([near[None], random_lifts(image, bones, 3, waves=0, generator=torch.Generator().manual_seed(0))])
    turned = align_rotations(starts, cameras.expand(4, -1, -1, -1), bones)
    found = procrustean(image, starts, turned, bones, stages=(*COARSE, FINE[0]))
    depth = found.points[..., 2] - found.points[..., 2].mean(-1, keepdim=True)
    error = torch.minimum(*[(depth - s * points[..., 2]).abs().mean((1, 2)) for s in (1, -1)])
    assert error[0] < 0.03
    assert error[found.objective.argmin()] < 0.03
    assert torch.equal(found.points[..., :2], image.expand(4, -1, -1, -1))  # noise 0 holds x and y
    best = found[found.objective.argmin()[None]]
    length = bone_lengths(best.points[0], bones)
    assert (length.std(0) / length.mean(0)).max() < 0.02


def test_unseen_and_outlying_tracks_do_not_pull():
    points, cameras, bones = filmed_person()
    image = points[..., :2].clone()
    weights = torch.ones(60, 17, dtype=torch.float64)
    weights[20:26, 3] = 0
    start = points.clone()
    start[20:26, 3] = start[19, 3]
    image[20:26, 3] = 7.0  # whatever stands there does not count
    image[40, 5] += 1.5  # an outlier, which the start does not share
    turned = align_rotations(start[None], cameras[None], bones)
    found = procrustean(image, start[None], turned, bones, weights=weights, noise=0.01).points[0]
    before, after = ((x - points)[20:26, 3, :2].norm(dim=-1) for x in (start, found))
    assert after.mean() < 0.6 * before.mean()
    assert (found - points)[40, 5, :2].norm() < 0.1


def views(degrees, frames=60):
    """Directions of view (1, T, 3) that turn evenly."""
    angle = torch.deg2rad(torch.linspace(0, degrees, frames, dtype=torch.float64))
    return torch.stack([angle.sin(), 0 * angle, angle.cos()], -1)[None]


def test_deviation_grows_as_the_viewpoint_turns_less():
    points, cameras = swinging_body()
    deviation = lambda seen: depth_deviation(points[None], cameras[None], BONES, views=seen)  # noqa: E731
    less = lambda found: (found**-2 - 0.5**-2).rsqrt()  # noqa: E731  # without the limit
    once, twice = deviation(views(360.0)), deviation(views(720.0))
    assert once.shape == (1, 60, 6) and (once > 0).all()
    torch.testing.assert_close(less(once), less(twice) * 2**0.6, rtol=0.01, atol=0)  # as spread out, half as far
    sides = views(90.0)
    fro = torch.cat([sides[:, ::2], sides.flip(1)[:, ::2]], 1)  # to and fro: as spread out, about twice as far
    torch.testing.assert_close(less(deviation(sides)), less(deviation(fro)) * 2**0.6, rtol=0.02, atol=0)
    variance = [1 - v.mean(1).square().sum() for v in (views(90.0), views(180.0))]
    ratio = 2**0.6 * (variance[1] / variance[0]) ** 0.75
    torch.testing.assert_close(less(deviation(views(90.0))), less(deviation(views(180.0))) * ratio)


def test_deviation_is_never_more_than_a_guess_s():
    points, cameras = swinging_body()
    found = depth_deviation(points[None], cameras[None], BONES, views=views(0.0))
    assert torch.isfinite(found).all() and 0.1 < found.amax() <= 0.5


def test_deviation_is_smaller_where_lengths_are_constant():
    points, cameras = swinging_body()
    stretched = points.clone()
    stretched[::2, 5] += 0.02 * (points[::2, 5] - points[::2, 4])  # one bone of five, in every other frame
    constant, less, none = (
        depth_deviation(p[None], cameras[None], BONES, views=views(90.0), rigid=r)
        for p, r in ((points, None), (stretched, None), (points, BONES[:0]))
    )
    assert (constant < 0.5 * less).all() and torch.isfinite(none).all()


@pytest.mark.parametrize("turned", [(2, 5, 3, 3), (1, 4, 3, 3)])
def test_shapes_are_checked(turned):
    with pytest.raises(ShapeError, match="procrustean"):
        procrustean(torch.zeros(5, 6, 2), torch.zeros(1, 5, 6, 3), torch.zeros(turned), BONES)
    with pytest.raises(ShapeError, match="bones"):
        procrustean(
            torch.zeros(5, 6, 2), torch.zeros(1, 5, 6, 3), torch.eye(3).expand(1, 5, 3, 3), torch.zeros(0, 2).long()
        )


@pytest.mark.parametrize("frames", [1, 2, 3])
def test_short_clips_stay_finite(frames):
    points, cameras = swinging_body(60)
    found = procrustean(points[:frames, :, :2], points[None, :frames], cameras[None, :frames], BONES)
    assert found.points.isfinite().all() and found.rotations.isfinite().all()


def test_lifts_keep_the_image_and_hardly_exceed_the_lengths():
    points, _ = swinging_body()
    lifts = random_lifts(points[..., :2], BONES, 3, generator=torch.Generator().manual_seed(0))
    assert torch.equal(lifts[..., :2], points[..., :2].expand(3, -1, -1, -1))
    longest = bone_lengths(points[..., :2], BONES).amax(0)
    assert (bone_lengths(lifts, BONES).amax((0, 1)) <= 1.02 * longest + 1e-9).all()
    assert not torch.allclose(lifts[0], lifts[1])


def test_distances_and_tree_find_the_rigid_parts():
    points, _ = swinging_body()
    mean, spread = distance_spread(points)
    apart = (points[:, 0] - points[:, 3]).norm(dim=-1)
    assert torch.allclose(mean[0, 3], apart.mean()) and torch.allclose(spread[0, 3], apart.std(correction=0))
    weighted = distance_spread(points, torch.ones(60, 6, dtype=torch.float64))
    assert torch.allclose(weighted[1], spread) and torch.allclose(weighted[0], mean)
    assert distance_spread(torch.full((4, 2, 3), torch.nan))[1].isnan().all()
    large = (1000 * points).half()
    for part, exact in zip(distance_spread(large), distance_spread(large.double()), strict=True):
        assert part.dtype == torch.half and (part - exact).abs().max() < 1e-3 * exact.max()
    tree = rigid_tree(spread + 1e-3 * mean)
    assert {frozenset(p) for p in tree.tolist()} == {frozenset(p) for p in BONES.tolist()}
    with pytest.raises(ShapeError):
        rigid_tree(torch.zeros(2, 3))


@pytest.mark.parametrize("weighted", [True, False])
def test_distances_have_a_gradient(weighted):
    """A joint is at no distance from itself, which never varies: two square roots of 0."""
    weights = normal(5, 4, seed=1).abs() if weighted else None
    for points in (normal(5, 4, 3), torch.zeros(5, 4, 3)):
        finite(lambda x: torch.stack(distance_spread(x, weights)), points)
    assert gradcheck(lambda x: distance_spread(x, weights), normal(5, 4, 3).requires_grad_())


@pytest.mark.parametrize("order", [0, 1])
def test_energy_gradient_and_degenerate_input(order):
    energy = ProcrusteanEnergy(BODY, order=order, eps=1e-2)
    assert gradcheck(energy, torch.randn(2, 5, 6, 3, dtype=torch.float64, requires_grad=True))
    points, _ = swinging_body(8)
    flat = torch.cat([points[..., :2], torch.zeros(8, 6, 1)], -1)
    for x in (torch.zeros(8, 6, 3), points[:1], points[:1].expand(8, -1, -1), flat):
        x = x.clone().requires_grad_()
        energy(x).backward()
        assert x.grad.isfinite().all()
    assert energy(points[:1].expand(8, -1, -1)).item() == pytest.approx(0, abs=1e-9)


def test_energy_does_not_see_turns_and_prefers_few_motions():
    energy = ProcrusteanEnergy(BODY, num_steps=30)
    points, _ = swinging_body(40)
    turned = points @ roma.random_rotmat(40, dtype=torch.float64)
    assert energy(turned).item() == pytest.approx(energy(points).item(), rel=1e-3)
    noisy = points + 0.1 * torch.randn(40, 6, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    assert energy(noisy) > energy(points) + 100
    given = energy(points, torch.eye(3, dtype=torch.float64).expand(40, 3, 3))
    assert given > energy(points)  # the camera's turning counts where rotations are held
    assert energy(points.expand(2, 3, -1, -1, -1)).shape == (2, 3)
    with pytest.raises(OptionError):
        ProcrusteanEnergy(BODY, eps=0.0)
    with pytest.raises(ShapeError):
        energy(points[:, :4])


@pytest.mark.parametrize("order", [0, 1])
def test_energy_does_not_see_places_where_joints_are_unseen(order):
    """Bones from unseen joints, which led to the origin, were among those that frames were first turned onto."""
    points, weights = swinging_body(20)[0], torch.ones(20, 6).double()
    weights[torch.arange(20), 2 + torch.arange(20) % 4] = 0  # no frame shows the whole body
    energy = ProcrusteanEnergy(BODY, order=order)
    expected = energy(points, weights=weights)
    for shift in (normal(3), 100 * normal(20, 1, 3)):
        assert_close(energy(points + shift, weights=weights), expected)


def test_tracks_that_are_unseen_may_be_nan():
    points, turns = normal(1, 12, 6, 3), torch.eye(3).double().expand(1, 12, 3, 3)
    weights = torch.ones(12, 6).double()
    weights[3, 4] = 0
    image = points[0, ..., :2]
    gone = torch.where(weights[..., None] > 0, image, torch.nan)
    found, expected = (
        procrustean(tracks, points, turns, BONES, weights=weights, noise=0.02, stages=FINE[:1])
        for tracks in (gone, image)
    )
    assert torch.equal(found.points, expected.points) and torch.equal(found.objective, expected.objective)


def test_half_precision_is_descended_from_in_single():
    points, turns = normal(1, 12, 6, 3).half(), torch.eye(3).half().expand(1, 12, 3, 3)
    found = procrustean(points[0, ..., :2], points, turns, BONES, stages=COARSE[:1])
    assert found.points.dtype == torch.float32 and found.points.isfinite().all()


@pytest.mark.parametrize("order", [0, 1])
def test_a_skeleton_without_bones_has_no_energy(order):
    energy = ProcrusteanEnergy(Skeleton(("a", "b"), (), tree=False), order=order)
    assert energy(normal(5, 2, 3), None, torch.ones(5, 2)) == energy(normal(5, 2, 3)) == 0


def test_an_eps_that_is_not_positive_is_told():
    for eps in (0.0, -1.0, float("nan")):
        with pytest.raises(OptionError, match="scatter_log_det: eps: expected a positive number, got"):
            scatter_log_det(normal(4, 3), eps)
