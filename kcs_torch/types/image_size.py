"""The size of the image that tracks lie in: what users and files say of it, checked, and what is guessed."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from kcs_torch.errors import OptionError

__all__ = ["are_shares", "as_image_size", "fitting_size", "may_be_shares", "told_image_size", "usual_size"]

LARGEST = 10**6
"""Pixels of an image's side, at most."""

SIZES: tuple[tuple[int, int], ...] = (
    (640, 360),
    (640, 480),
    (854, 480),
    (1280, 720),
    (1920, 1080),
    (2704, 1520),
    (3840, 2160),
)
"""Usual sizes of images, whichever side is up; the smallest first."""

INSIDE = 0.99
"""Share of the joints that an image of usual size holds: detectors place some a little beside it."""

SHARES = 0.9
"""Share of the joints within 0 and 1 from which on they may be shares of the image: a hand may leave it."""

WHOLE = 2.0
"""Coordinates in an image whose median is above this are no shares of it."""

MOST = 0.5
"""Share of the joints that an image holds at least, or its size is wrong."""

CLEAR, BESIDE = 0.05, 0.1
"""Share of the joints, and how far they lie beside an image, over its sides, from which on width and height may be the
wrong way round. Of people whom the image's edge cuts, detectors place more of them beside it, but not as far. Up to
this share may lie left of an image whose size is guessed, or above it."""


def as_image_size(value: Any, units: str = "px", source: str = "") -> tuple[int, int] | None:
    """Width and height of an image in pixels, checked; None is unknown.

    Args:
        value: of a user.
        units: of the tracks in it, as short ones.
        source: of the tracks, for messages.

    Raises:
        OptionError: it is something else, or the tracks are not in pixels.
    """
    size, where = told_image_size(value), f"{source}: " if source else ""
    if value is not None and size is None:
        raise OptionError(
            f"{where}image_size: expected width and height of the video in pixels, such as (1920, 1080), got {value!r}"
        )
    if size is not None and units != "px":
        raise OptionError(
            f"{where}image_size: expected tracks in pixels of the image, got units '{units}': leave it out (kcs-torch: "
            "--image-size), or say units 'px' where the tracks are made if they are pixels"
        )
    return size


def told_image_size(value: Any, least: int = 1) -> tuple[int, int] | None:
    """Width and height of an image in pixels, as a file tells them; None where they are none, or below ``least``.

    >>> told_image_size([1920.0, 1080]), told_image_size([0, 1080]), told_image_size("large")
    ((1920, 1080), None, None)
    """
    try:
        sides = tuple(value)
        width, height = (int(side) for side in sides)
    except (TypeError, ValueError, OverflowError):
        return None
    whole = (width, height) == sides and not any(isinstance(side, bool) for side in sides)
    return (width, height) if whole and min(sides) >= least and max(sides) <= LARGEST else None


def fitting_size(points: Tensor, size: tuple[int, int], notes: list[str]) -> tuple[int, int] | None:
    """The size that an image of points (P, 2) is said to have; None where most lie outside. Notes tell what is odd."""
    image, turned = f"an image of {size[0]} x {size[1]} pixels", size[::-1]
    right = f"{turned} (kcs-torch: --image-size {turned[0]}x{turned[1]})"
    fix = f". If width and height are swapped, give image_size={right}" if _held(points, turned) >= INSIDE else ""
    if _held(points, size) < MOST:
        notes.append(f"most joints lie outside {image}: its size (image_size, --image-size) is left out{fix}")
        return None
    if fix and _held(points, size, BESIDE) < 1 - CLEAR:
        notes.append(f"many joints lie far outside {image}{fix}")
    return size


def are_shares(places: NDArray[np.float64]) -> bool:
    """Whether places (..., 2) in an image, some of which may be NaN, are shares of it rather than pixels."""
    known = places[np.isfinite(places)]
    return len(known) > 0 and bool(np.median(np.abs(known)) <= WHOLE)


def may_be_shares(points: Tensor) -> bool:
    """Whether points (P, 2) of joints that are seen may be shares of an image, as hardly any lies outside of 0 to 1."""
    return bool((points != points[:1]).any()) and _held(points, (1, 1)) >= SHARES


def usual_size(points: Tensor) -> tuple[int, int]:
    """The smallest image of usual size that holds nearly all of points (P, 2); (0, 0) if none does.

    Where few lie left of all images or above them, the image's edge cuts the body there, and tells nothing of the size.
    """
    if float((points < 0).any(-1).double().mean()) <= CLEAR:
        points = points.clamp(min=0)
    usual = (size for wide, high in SIZES for size in ((wide, high), (high, wide)))
    return next((size for size in usual if _held(points, size) >= INSIDE), (0, 0))


def _held(points: Tensor, size: tuple[int, int], beside: float = 0.0) -> float:
    """Share of points (P, 2) that lie within an image of this width and height, or ``beside`` it, over its sides."""
    sides = points.new_tensor(size)
    return float(((points >= -beside * sides) & (points <= (1 + beside) * sides)).all(-1).double().mean())
