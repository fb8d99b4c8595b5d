"""Intrinsics: from numbers and matrices, their rays, and what is refused."""

import math

import numpy as np
import pytest
import torch
from near_cameras import LENS, filmed

import kcs_torch as kt
from kcs_torch.types import Intrinsics


def test_intrinsics_from_numbers_and_from_a_matrix():
    matrix = [[1500, 0, 960], [0, 1480, 540], [0, 0, 1]]
    wanted = Intrinsics(*LENS)
    for value in (
        LENS,
        list(LENS),
        np.array(LENS),
        torch.tensor(LENS),
        matrix,
        np.array(matrix),
        wanted,
        np.array(LENS, ">f4"),
    ):
        assert Intrinsics.of(value) == wanted
    assert wanted.focal == pytest.approx(math.sqrt(1500 * 1480))


def test_rays_and_projection_are_inverse():
    lens = Intrinsics(*LENS)
    points = torch.tensor([[0.3, -0.2, 4.0], [-1.0, 1.0, 2.0]], dtype=torch.float64)
    image = lens.project(points)
    assert image[0].tolist() == pytest.approx([1500 * 0.3 / 4 + 960, -1480 * 0.2 / 4 + 540])
    torch.testing.assert_close(lens.rays(image) * points[:, 2:], points)


@pytest.mark.parametrize("lens", [(1e-3, 1e-3, 0, 0), torch.eye(3), (1000, 1000, 1e300, 0), (1e300, 1e-300, 0, 0)])
@pytest.mark.parametrize("method", ["kcs", "sfam", "pkc"])
def test_intrinsics_of_another_camera_or_unit_are_refused(lens, method):
    """As pixels with a camera matrix of normalised coordinates; no NaN comes back."""
    tracks = filmed(frames=12)[0]
    with pytest.raises(kt.OptionError, match=r"in the unit of the tracks, whose coordinates are about \d+, got"):
        kt.reconstruct(tracks, method=method, intrinsics=lens)


def test_rays_of_nothing_and_of_what_is_not_known():
    lens = Intrinsics(*LENS)
    assert lens.rays(torch.zeros(0, 2)).shape == (0, 3)
    assert lens.rays(torch.full((4, 2), torch.nan)).isnan()[:, :2].all()


@pytest.mark.parametrize(
    ("value", "kind", "says"),
    [
        ([1500, 1500.0], kt.ShapeError, r"got \[1500, 1500\.0\]: the principal point is lacking"),
        ((1500, 1500, 960), kt.ShapeError, r"got shape \(3,\)"),
        ((1500, 1500, 960, 540, -0.2, 0.1), kt.ShapeError, r"got shape \(6,\): a lens that distorts .* undistort the"),
        ((np.eye(3), np.zeros(5)), kt.ShapeError, r"got two arrays: a lens that distorts .*undistortPoints"),
        (np.eye(4), kt.ShapeError, r"got shape \(4, 4\)"),
        ("1500", kt.ShapeError, "got '1500'"),
        ({"fx": 1}, kt.ShapeError, "fx, fy, cx, cy"),
        ((-1500, 1500, 0, 0), kt.OptionError, "positive focal lengths, got fx = -1500"),
        ((0, 1500, 0, 0), kt.OptionError, "positive focal lengths"),
        ((math.nan, 1500, 0, 0), kt.OptionError, "finite"),
        ((1500, 1500, math.inf, 0), kt.OptionError, "finite"),
        ([[1500, 50, 0], [0, 1500, 0], [0, 0, 1]], kt.OptionError, "without skew.*undistort"),
        ([[1500, 0, 0], [0, 1500, 0], [0, 0, 2]], kt.OptionError, "without skew"),
        ([[1500, 0, 0], [0, 1500, 0], [0, 0, 2]], kt.OptionError, "divide it by its last number"),
        (np.full((3, 3), math.nan), kt.OptionError, "give finite numbers"),
        (np.array([1500, 1500, 960, 540j]), kt.ShapeError, "expected real numbers, got complex128"),
        ((10**400, 1500, 0, 0), kt.OptionError, "finite numbers"),
        (((10**400, 0, 0), (0, 1500, 0), (0, 0, 1)), kt.ShapeError, "fx, fy, cx, cy"),
    ],
)
def test_bad_intrinsics_are_told(value, kind, says):
    with pytest.raises(kind, match=says):
        kt.reconstruct(filmed(frames=3)[0], intrinsics=value)


def test_cameras_that_do_not_fit_are_told():
    with pytest.raises(kt.ShapeError, match=r"cameras: expected finite \(3, 2, 3\)"):
        kt.reconstruct(filmed(frames=3)[0], intrinsics=LENS, cameras=torch.zeros(2, 2, 3))
