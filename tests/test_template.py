"""What a template needs beside itself: its scale in the image, and a stand-in where there is none."""

import pytest
import torch
from numerics import leaves_arguments_alone, normal, rotations, turning
from torch.testing import assert_close

from kcs_torch import Skeleton, Tracks
from kcs_torch.data import walking_person
from kcs_torch.functional import superpose
from kcs_torch.methods.clips.template import clip_scale, rigid_shape
from kcs_torch.skeleton import SKELETONS

BODY = SKELETONS["h36m17"]
REST = BODY.template_points(dtype=torch.float64)


def test_scale_of_a_body_that_shows_every_bone_at_full_length():
    turned = 250 * REST @ rotations(400, seed=1).mT
    tracks = Tracks.from_arrays(turned[..., :2], skeleton=BODY)
    scale = leaves_arguments_alone(lambda rest: clip_scale(tracks, rest), REST)
    assert scale.shape == (400,)
    assert_close(scale, torch.full_like(scale, 250.0), rtol=0.03, atol=0)
    assert_close(clip_scale(tracks, 10 * REST), scale / 10)


def test_scale_follows_somebody_who_comes_nearer():
    size = torch.linspace(200, 400, 300, dtype=torch.float64)
    turned = size[:, None, None] * REST @ rotations(300, seed=1).mT
    scale = clip_scale(Tracks.from_arrays(turned[..., :2], skeleton=BODY), REST)
    assert_close(scale, size, rtol=0.25, atol=0)
    assert scale[-1] > 1.4 * scale[0]
    assert (scale.diff().abs() < 3).all()  # no steps between spans


def test_unseen_joints_and_one_long_arm_have_no_vote():
    turned = 250 * REST @ rotations(200, seed=1).mT
    points = turned[..., :2].clone()
    plain = clip_scale(Tracks.from_arrays(points, skeleton=BODY), REST)
    points[:, 16] *= 3
    assert_close(clip_scale(Tracks.from_arrays(points, skeleton=BODY), REST), plain, rtol=0.02, atol=0)
    points[:, 3] = torch.nan
    assert_close(clip_scale(Tracks.from_arrays(points, skeleton=BODY), REST), plain, rtol=0.02, atol=0)


@pytest.mark.parametrize("frames", [1, 2, 59, 61, 200])
def test_scale_is_positive_and_finite(frames):
    clip = walking_person(frames).tracks
    blank = clip.points.clone()
    blank[1:] = torch.nan
    for points, body in (
        (clip.points, BODY),
        (blank, BODY),
        (torch.zeros_like(clip.points), BODY),
        (clip.points, Skeleton.from_edges([], 17, tree=False)),
    ):
        scale = clip_scale(Tracks.from_arrays(points, skeleton=body), REST)
        assert scale.shape == (frames,) and (scale > 0).all() and torch.isfinite(scale).all()


@pytest.mark.parametrize("known", [False, True])
def test_rigid_shape_is_found(known):
    cameras = turning(60, 150.0)
    shape = normal(12, 3, seed=4)
    points = shape @ cameras.mT
    tracks = Tracks.from_arrays(points[..., :2])
    found = rigid_shape(tracks, cameras[:, :2]) if known else rigid_shape(tracks)
    if known:
        assert_close(found - found.mean(0), shape - shape.mean(0), rtol=0, atol=0.01)
    mirrors = (superpose(found * sign, shape, "rigid") for sign in (1, torch.tensor([1.0, 1.0, -1.0])))
    assert min(float((moved - shape).abs().max()) for moved in mirrors) < 0.02


@pytest.mark.parametrize(("frames", "joints"), [(1, 5), (2, 2), (1, 2), (3, 3), (20, 2)])
def test_rigid_shape_of_too_little(frames, joints):
    found = rigid_shape(Tracks.from_arrays(normal(frames, joints, 2)))
    assert found.shape == (joints, 3) and torch.isfinite(found).all()


def test_rigid_shape_is_flat_where_nothing_turns():
    points = normal(1, 9, 2).expand(30, 9, 2)
    size = torch.linalg.svdvals(rigid_shape(Tracks.from_arrays(points)))
    assert size[2] < 1e-6 * size[0]
