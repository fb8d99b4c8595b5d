"""What the tests of the baselines share: what a camera sees of points in the world, and errors of what is found."""

import torch

import kcs_torch as kt
from kcs_torch.functional import complete_rotation, project


def centred(points):
    return points - points.mean(1, keepdim=True)


def seen_from(world, cameras, **options):
    """Tracks of points (T, N, 3) in the world, and the points in the camera frame, centred."""
    world = centred(world)
    return kt.Tracks.from_arrays(project(world, cameras), **options), world @ complete_rotation(cameras).mT


def error(found, truth):
    """Largest deviation of the pose from the truth or its mirror image, a share of the body's size."""
    found, flip = centred(found), torch.tensor([1.0, 1.0, -1.0]).to(found)
    return float(min((found * sign - truth).abs().max() for sign in (1, flip)) / truth.std())
