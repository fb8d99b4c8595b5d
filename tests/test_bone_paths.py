"""Paths that bones of constant length can take: lengths and signs told by their images alone."""

import pytest
import torch

from kcs_torch.data.synthetic import random_motion
from kcs_torch.functional import bone_vectors
from kcs_torch.methods.pkc.assembly import followed
from kcs_torch.skeleton import Skeleton
from kcs_torch.solvers.bone_paths import bone_paths, nearest_paths, path_energy


def swung(frames=120, rate=0.11, tilt=0.3):
    """One bone (T, 2, 3) of length 1 that turns evenly about a tilted axis, through the image plane and back."""
    angle = rate * torch.arange(frames, dtype=torch.float64) + 0.4
    tip = torch.stack([angle.cos(), tilt * angle.sin(), (1 - tilt**2) ** 0.5 * angle.sin()], -1)
    return torch.stack([torch.zeros_like(tip), tip], 1)


@pytest.fixture(scope="module")
def arm():
    """Points (T, N, 3) of an arm of six bones before a camera that turns."""
    skeleton = Skeleton.from_edges([(i, i + 1) for i in range(6)], 7)
    motion = random_motion(skeleton, num_frames=150, turn=120, generator=torch.Generator().manual_seed(4))
    return motion.points - motion.points.mean(1, keepdim=True), skeleton.bone_index()


def test_a_bone_that_passes_through_the_image_plane_is_found():
    points = swung()
    paths = bone_paths(points[..., :2], torch.tensor([[0, 1]]))
    depth = points[:, 1, 2]
    off = torch.stack([(paths.depth[0, 0] - s * depth).abs().amax() for s in (1, -1)]).amin()
    assert float(off) < 0.05
    assert float(paths.cost[0, 0]) == 0 and bool((paths.cost[0].diff() >= 0).all())


def test_the_true_path_is_among_those_of_most_bones(arm):
    points, bones = arm
    paths = bone_paths(points[..., :2], bones)
    true = bone_vectors(points, bones)[..., 2].mT  # (B, T)
    off = torch.minimum(*((paths.depth - s * true[:, None]).square().mean(-1) for s in (1, -1)))  # (B, K)
    length = bone_vectors(points, bones).norm(dim=-1).mean(0)
    assert int((off.amin(1).sqrt() < 0.1 * length).sum()) >= 4
    near = nearest_paths(paths, -true[None])[0]
    assert torch.allclose((near + true).square().mean(-1), off.amin(1))


def test_paths_of_a_bone_differ_from_each_other(arm):
    points, bones = arm
    paths = bone_paths(points[..., :2], bones)
    for own, cost in zip(paths.depth, paths.cost, strict=True):
        some = own[cost.isfinite()]
        gap = [min((a - b).square().mean(), (a + b).square().mean()) for i, a in enumerate(some) for b in some[:i]]
        assert all(float(g) > 1e-4 for g in gap)


def test_long_bones_that_never_show_their_length_are_dearer():
    points = swung()
    flat, depth = points[:, 1, :2], points[:, 1, 2]
    long = (3.0**2 - flat.square().sum(-1)).sqrt()
    assert float(path_energy(depth, flat)) < float(path_energy(long, flat))


@pytest.mark.parametrize(
    ("frames", "size"),
    [(20, 0.0), (1, 1.0), (2, 1.0), (20, 1.0)],
    ids=["one place", "one frame", "two frames", "static"],
)
def test_degenerate_images_stay_finite(frames, size):
    tracks = (size * torch.tensor([[0.0, 0.0], [1.0, 0.5], [2.0, -0.3]])).expand(frames, 3, 2)
    bones = torch.tensor([[0, 1], [1, 2]])
    paths = bone_paths(tracks.double(), bones)
    assert paths.depth.isfinite().all() and not paths.cost.isnan().any()
    assert bool(paths.cost[:, 0].eq(0).all())
    assert nearest_paths(paths, torch.rand(2, 2, len(tracks), dtype=torch.float64)).isfinite().all()


def test_between_frames_that_are_known_bones_follow_their_paths():
    points = swung()
    points = points - points.mean(1, keepdim=True)
    paths, pick = bone_paths(points[..., :2], torch.tensor([[0, 1]])), torch.arange(0, 120, 10)
    weight = torch.arange(120, dtype=torch.float64)[:, None] / 10
    low = weight.long().clamp_max(len(pick) - 2)
    z = points[pick, :, 2]
    linear = points.clone()
    linear[..., 2] = z[low[:, 0]] * (1 - weight + low) + z[low[:, 0] + 1] * (weight - low)
    made = followed(paths, linear[None], torch.tensor([[0, 1]]), pick)[0]
    assert float((made - points).abs().amax()) < 0.1 * float((linear - points).abs().amax())
