"""What the tests of PKC share: quick options, and errors of depth."""

import math

import torch

from kcs_torch import Skeleton, Tracks
from kcs_torch.data import random_motion

NAN = math.nan
FLIP = torch.tensor([1.0, 1.0, -1.0]).double()
QUICK = {"viewpoint": "fixed", "rounds": 0, "steps": 5}


def centred(points):
    return points - points.mean(1, keepdim=True)


def error(points, truth):
    """Mean distance to the truth, over that of a flat guess."""
    flat = centred(truth)[..., 2].abs().mean()
    return float((centred(points) - centred(truth)).norm(dim=-1).mean() / flat)


def robot():
    """An arm of four bones that nobody has described."""
    arm = Skeleton.from_names(["base", "one", "two", "three", "tip"], [
        ("base", "one"), ("one", "two"), ("two", "three"), ("three", "tip"),
    ])  # fmt: skip
    return random_motion(arm, 60, turn=180.0, generator=torch.Generator().manual_seed(3))


def of(points):
    return Tracks.from_arrays(points, skeleton="h36m17", fps=30.0)
