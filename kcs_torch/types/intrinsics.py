"""What is known of a pinhole camera: :class:`Intrinsics`."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from kcs_torch.errors import OptionError, ShapeError
from kcs_torch.functional.camera import perspective
from kcs_torch.types.intake import as_floats

__all__ = ["SKEW", "Intrinsics"]

WIDEST = 20.0
"""Tangent of the angle off the optical axis that no lens without distortion reaches for half of what it shows."""

STRAIGHTEN = (
    ": a lens that distorts is not modelled: undistort the tracks first, in OpenCV by undistortPoints(points, K, "
    "distortion, P=K)"
)

UNIT = 2.0
"""Coordinates up to this, half of them, are shares of an image or metres on its plane, no pixels."""

SKEW = 1e-3
"""Skew, over the focal length, up to which it is rounding."""

COARSE = 50.0
"""Focal lengths from this on are in pixels."""

BESIDE = 0.25
"""Share of the joints that lie beside the image from which on its corner is likely to be another."""


@dataclass(frozen=True)
class Intrinsics:
    """A pinhole camera without distortion: u = fx X/Z + cx, v = fy Y/Z + cy, in the unit of the tracks.

    >>> Intrinsics.of([[1000, 0, 640], [0, 1000, 360], [0, 0, 1]])
    Intrinsics(fx=1000.0, fy=1000.0, cx=640.0, cy=360.0)
    """

    fx: float
    fy: float
    cx: float
    cy: float

    def __post_init__(self) -> None:
        if not all(math.isfinite(x) for x in (self.fx, self.fy, self.cx, self.cy)):
            raise OptionError(f"intrinsics: expected finite numbers, got {self}")
        if not (self.fx > 0 and self.fy > 0):
            raise OptionError(f"intrinsics: expected positive focal lengths, got fx = {self.fx:g}, fy = {self.fy:g}")

    @classmethod
    def of(cls, value: Any) -> Intrinsics:
        """Read (fx, fy, cx, cy) or a matrix K (3, 3).

        Raises:
            ShapeError: it is neither.
            OptionError: a focal length is not positive, a number is not finite, or K is skewed.
        """
        if isinstance(value, Intrinsics):
            return value
        what = "intrinsics: expected (fx, fy, cx, cy) or a matrix K (3, 3)"
        if isinstance(value, (tuple, list)) and len(value) == 2:
            if all(isinstance(x, (int, float)) for x in value):
                raise ShapeError(f"{what}, got {value!r}: the principal point is lacking, the image's middle as a rule")
            raise ShapeError(f"{what}, got two arrays{STRAIGHTEN}")
        if isinstance(value, (tuple, list)) and len(value) == 4 and all(isinstance(x, (int, float)) for x in value):
            try:
                return cls(*map(float, value))  # without tensors, so that torch.compile follows
            except OverflowError:
                raise OptionError(f"{what} of finite numbers, got {value!r}") from None
        if isinstance(value, str):
            raise ShapeError(f"{what}, got {value!r}")
        matrix = as_floats(value, what, None).double()
        if matrix.shape not in ((4,), (3, 3)):
            hint = STRAIGHTEN if matrix.ndim == 1 and len(matrix) > 4 else ""
            raise ShapeError(f"{what}, got shape {tuple(matrix.shape)}{hint}")
        if matrix.ndim == 1:
            return cls(*matrix.tolist())
        (fx, skew, cx), (tilt, fy, cy), last = matrix.tolist()
        hint = ""
        if not bool(matrix.isfinite().all()):
            hint = "give finite numbers"
        elif tilt != 0 or last != [0, 0, 1]:
            hint = "divide it by its last number, or transpose it, where it is written otherwise"
        elif abs(skew) > SKEW * abs(fx):
            hint = "undistort the tracks first, which takes off the skew as well"
        if hint:
            raise OptionError(
                "intrinsics: expected K = [[fx, 0, cx], [0, fy, cy], [0, 0, 1]] without skew, got "
                f"{matrix.tolist()}: {hint}"
            )
        return cls(fx, fy, cx, cy)

    @property
    def focal(self) -> float:
        """The geometric mean of the focal lengths."""
        return math.sqrt(self.fx) * math.sqrt(self.fy)

    def rays(self, image: Tensor) -> Tensor:
        """(..., 3) directions (X/Z, Y/Z, 1) of image points (..., 2).

        Raises:
            OptionError: half of them would lie more than 87 degrees off the optical axis, which no lens without
                distortion shows: the intrinsics are of another camera, or in another unit than the points.
        """
        x, y = (image[..., 0] - self.cx) / self.fx, (image[..., 1] - self.cy) / self.fy
        off = torch.maximum(x.abs(), y.abs()).detach().flatten().nanmedian()
        if bool(off > WIDEST):
            across = float(image.detach().abs().flatten().nanmedian())
            raise OptionError(
                "intrinsics: expected focal lengths and a principal point in the unit of the tracks, whose coordinates "
                f"are about {across:.3g}, got {self}: half of all points would lie beside the camera, not before it"
            )
        return torch.stack([x, y, torch.ones_like(x)], -1)

    def check_unit(self, image: Tensor) -> None:
        """Make sure that points (n, 2) of an image are in the unit of the focal lengths.

        Raises:
            OptionError: they are shares of the image, or of the focal length, where these are pixels.
        """
        off = image.abs().amax(-1)
        if len(off) and self.focal > COARSE and 0 < float(off.median()) <= UNIT:
            raise OptionError(
                "intrinsics: expected tracks in the unit of the focal lengths, got coordinates of about "
                f"{float(off.median()):.2g} and {self}: multiply shares of the image by its width and height; "
                "undistorted points come in pixels with P=K, in OpenCV"
            )

    def beside(self, image: Tensor) -> str:
        """What to say where many points (n, 2) lie beside the image whose middle is the principal point, else ""."""
        if len(image) and self.cx == self.cy == 0 and self.focal > COARSE and bool((image > 0).all()):
            return (
                "intrinsics: a principal point at (0, 0) is the image's corner, to the right of and below which all "
                "joints lie: cx and cy are about half of the image's width and height"
            )
        if not (len(image) and self.cx > 0 and self.cy > 0):
            return ""
        middle = image.new_tensor([self.cx, self.cy])
        share = float((((image - middle) / middle).abs() > 1.1).any(-1).to(image).mean())
        if share <= BESIDE:
            return ""
        x, y = image.median(0).values.tolist()
        return (
            f"intrinsics: {100 * share:.0f} % of the joints, which are about ({x:.4g}, {y:.4g}), lie beside an image "
            f"whose middle is ({self.cx:.4g}, {self.cy:.4g}): x and y count from its upper left corner, y down. Where "
            "y points up give its height - y; after cropping take the corner off cx and cy"
        )

    def project(self, points: Tensor) -> Tensor:
        """Images (..., 2) of points (..., 3) in the camera frame."""
        return perspective(points, self.tensor(points))

    def tensor(self, like: Tensor) -> Tensor:
        """(4,) fx, fy, cx, cy in the dtype and on the device of another tensor."""
        return like.new_tensor([self.fx, self.fy, self.cx, self.cy])
