"""Half precision and autocast: what factorises matrices is computed in single precision."""

import pytest
import torch
from numerics import HALVES, normal, turning
from torch.testing import assert_close

from kcs_torch.functional import (
    back_project,
    chain_inverse,
    euler_rotation,
    factorize,
    kcs_matrix,
    minimal_turn,
    orbit,
    points_from_bones,
    pose_matrix,
    project,
    rotation_angle,
)
from kcs_torch.nn import PostureEnergy
from kcs_torch.solvers import (
    choose_path,
    constant_path,
    fit_bones,
    ist,
    metric_upgrade,
    null_space_upgrade,
    root_velocity,
)

MOTION, PATH = normal(12, 2, 4).float(), turning(12).float()

PRODUCTS = {
    "back_project": (lambda tracks: back_project(tracks, PATH[:, :2]), normal(12, 5, 2).float()),
    "kcs_matrix": (kcs_matrix, normal(12, 5, 3).float()),
    "points_from_bones": (lambda vectors: points_from_bones(vectors, torch.eye(5)), normal(12, 5, 3).float()),
    "pose_matrix": (lambda points: pose_matrix(points, [(0, 1), (1, 2)]), normal(12, 5, 3).float()),
    "project": (lambda points: project(points, PATH[:, :2]), normal(12, 5, 3).float()),
}

TURNED = {
    "euler_rotation": (lambda angles: euler_rotation("ZXY", angles), normal(12, 3).float()),
    "minimal_turn": (lambda way: minimal_turn(way, way.flip(-1)), normal(12, 3).float()),
    "orbit": (orbit, 100 * normal(12).float()),
    "rotation_angle": (lambda turns: rotation_angle(turns, turns.flip(0)), turning(12).float()),
    "PostureEnergy.frame": (PostureEnergy("h36m17").frame, normal(12, 17, 3).float()),
}

FUNCTIONS = {
    "chain_inverse": (chain_inverse, torch.tensor([[-1.0, 0], [1, -1], [0, 1]])),
    "choose_path": (lambda path: choose_path(path, "smooth")[::2], PATH),
    "constant_path": (constant_path, PATH),
    "factorize": (lambda tracks: factorize(tracks=tracks, rank=3), normal(12, 5, 2).float()),
    "fit_bones": (lambda points: fit_bones(points, points.new_ones(2), [(0, 1), (1, 2)]), normal(12, 5, 3).float()),
    "ist": (ist, MOTION),
    "metric_upgrade": (lambda motion: metric_upgrade(motion, motion[:2].flatten(0, 1)[:, :3], num_steps=5), MOTION),
    "null_space_upgrade": (null_space_upgrade, MOTION),
    "root_velocity": (lambda move: root_velocity(move, torch.ones_like(move), 0.1, 0.1), normal(12, 2).float()),
}


def both(result):
    return result if isinstance(result, tuple) else (result,)


@pytest.mark.parametrize("dtype", HALVES)
@pytest.mark.parametrize("name", FUNCTIONS)
def test_half_precision_is_widened_and_comes_back(name, dtype):
    function, values = FUNCTIONS[name]
    values = values.to(dtype)
    for ours, expected in zip(both(function(values)), both(function(values.float())), strict=True):
        assert ours.dtype == dtype
        assert_close(ours, expected.to(dtype), rtol=0, atol=0)


@pytest.mark.parametrize("name", [*FUNCTIONS, *PRODUCTS, *TURNED])
def test_autocast_makes_no_difference(name):
    function, values = {**FUNCTIONS, **PRODUCTS, **TURNED}[name]
    with torch.autocast("cpu", dtype=torch.bfloat16):
        found = both(function(values))
    for ours, expected in zip(found, both(function(values)), strict=True):
        assert_close(ours, expected, rtol=0, atol=0)
