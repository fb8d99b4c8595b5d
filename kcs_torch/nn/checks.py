"""What modules are called and made with, checked; errors name the module."""

from __future__ import annotations

import math
from collections.abc import Sequence
from numbers import Integral, Real
from typing import TYPE_CHECKING, Any, cast

import torch
from torch import Tensor, nn

from kcs_torch.errors import OptionError, ShapeError
from kcs_torch.functional.shapes import fit_together
from kcs_torch.skeleton import Skeleton

if TYPE_CHECKING:
    from kcs_torch.nn.layers import SkeletonModule

__all__ = [
    "check_beside",
    "check_clip",
    "check_coordinates",
    "check_inside",
    "check_joints",
    "check_lengths",
    "check_one",
    "check_points",
    "check_positive",
    "check_tensor",
    "check_weights",
    "check_whole",
    "shown",
]


def check_tensor(value: Any, what: str, module: nn.Module) -> None:
    """Raise a ShapeError unless ``value`` is a tensor."""
    if not isinstance(value, Tensor):
        kind = type(value).__name__
        raise ShapeError(
            f"{type(module).__name__}: expected a tensor of {what}, got {kind}: use torch.as_tensor({what})"
        )


def check_points(points: Any, module: nn.Module, what: str = "points") -> None:
    """Raise a ShapeError unless ``points`` are a tensor of floating-point numbers."""
    check_tensor(points, what, module)
    if not points.is_floating_point():
        raise ShapeError(f"{type(module).__name__}: expected {what} in floating point, got {points.dtype}")


def check_coordinates(points: Tensor, module: nn.Module) -> None:
    """Raise a ShapeError unless ``points`` (..., N, D) have at most three coordinates."""
    if not 0 < points.shape[-1] <= 3:
        raise ShapeError(
            f"{type(module).__name__}: expected points of 2 or 3 coordinates, got {tuple(points.shape)}; confidences "
            "are no coordinate: pass points[..., :3], and weights where the module takes them"
        )


def check_clip(points: Tensor, module: nn.Module) -> None:
    """Raise a ShapeError unless ``points`` are (..., T, N, D)."""
    check_points(points, module)
    if points.ndim < 3:
        raise ShapeError(f"{type(module).__name__}: expected points (..., T, N, D), got {tuple(points.shape)}")
    check_coordinates(points, module)


def check_joints(module: nn.Module, skeleton: Skeleton, points: Tensor, form: str) -> None:
    """Raise a ShapeError unless ``points`` have the joints of the skeleton, and are where the module is.

    Args:
        module: which is asking; holds the skeleton's bones.
        skeleton: whose joints they have to be.
        points: (..., N, D).
        form: such as "points (..., T, {}, 3)": what is expected, with a place for the number of joints.
    """
    joints, own = skeleton.num_joints, cast(Tensor, module.bones).device
    if own != points.device:
        name = type(module).__name__
        raise ShapeError(
            f"{name}: expected points on the device of the module, {own}, got {points.device}: move the module, "
            "module.to(points.device)"
        )
    if points.ndim >= form.count(",") and points.shape[-2] == joints:
        return
    dims = int(form.rstrip(")").rpartition(" ")[2])
    message = (
        f"{type(module).__name__}: expected {form.format(joints)} for skeleton '{skeleton.name}', "
        f"got {tuple(points.shape)}"
    )
    if points.ndim >= 2 and points.shape[-2] == skeleton.num_observed < joints:
        virtual = ", ".join(skeleton.joints[skeleton.num_observed :])
        message += f": without its virtual joints {virtual}, which skeleton.complete(points, weights) appends to both"
    elif points.ndim >= 2 and points.shape[-1] in (joints, skeleton.num_observed) and points.shape[-2] == dims:
        message += ": their last two axes are swapped, .mT puts them right"
    elif points.ndim and points.shape[-1] in (dims * joints, dims * skeleton.num_observed):
        message += f": flat, unflatten(-1, ({points.shape[-1] // dims}, {dims})) gives joints their axis"
    raise ShapeError(message)


def check_beside(
    value: Any, what: str, shape: Sequence[int], clip: Tensor, module: nn.Module, of: str = "points"
) -> None:
    """Raise a ShapeError unless ``value`` is None or a tensor (..., *shape) whose batch fits (..., T, N, D)."""
    if value is None:
        return
    check_tensor(value, what, module)
    given, own = tuple(value.shape), value.ndim - len(shape)
    if own < 0 or given[own:] != tuple(shape) or not fit_together(given[:own], clip.shape[:-3]):
        expected = f"{what} (..., {', '.join(map(str, shape))})"
        raise ShapeError(f"{type(module).__name__}: expected {expected}, got {given} for {of} {tuple(clip.shape)}")


def check_inside(inside: Any, tracks: Tensor, module: nn.Module) -> None:
    """Raise a ShapeError unless ``inside`` is None or (..., T) bool, for tracks (..., T, N, 2)."""
    check_beside(inside, "inside", tracks.shape[-3:-2], tracks, module, "tracks")
    if inside is not None and inside.dtype != torch.bool:
        kind = type(module).__name__
        raise ShapeError(f"{kind}: inside: expected True or False for each frame, got {inside.dtype}")


def check_weights(weights: Tensor | None, points: Tensor, module: nn.Module) -> None:
    """Raise a ShapeError unless ``weights`` are (..., T, N) for points (..., T, N, D)."""
    if weights is None:
        return
    check_tensor(weights, "weights", module)
    if weights.shape[-2:] != points.shape[-3:-1] or not fit_together(weights.shape[:-2], points.shape[:-3]):
        expected = f"(..., {points.shape[-3]}, {points.shape[-2]}) for points {tuple(points.shape)}"
        message = f"{type(module).__name__}: expected weights {expected}, got {tuple(weights.shape)}"
        if weights.shape[-1:] == points.shape[-3:-2]:
            message += ": those of frames are weights[..., None].expand(..., N)"
        raise ShapeError(message)


def check_lengths(lengths: Tensor | None, points: Tensor, module: SkeletonModule) -> None:
    """Raise a ShapeError unless ``lengths`` are (..., B) for points (..., T, N, D) of the module's skeleton."""
    if lengths is None:
        return
    check_tensor(lengths, "lengths", module)
    count = module.skeleton.num_bones
    if lengths.shape[-1:] != (count,) or not fit_together(lengths.shape[:-1], points.shape[:-3]):
        expected = f"(..., {count}), the same in all frames, for points {tuple(points.shape)}"
        raise ShapeError(f"{type(module).__name__}: expected lengths {expected}, got {tuple(lengths.shape)}")
    check_one(lengths, 1, f"lengths ({count},)", points, module)


def check_one(value: Tensor, core: int, what: str, points: Tensor, module: nn.Module) -> None:
    """Raise a ShapeError if a value with so many core dimensions is of each frame where points are one clip (T, N, D).

    It would pass for one of each of T bodies.
    """
    if points.ndim == 3 and value.shape[: value.ndim - core] == points.shape[:1] and len(points) > 1:
        raise ShapeError(
            f"{type(module).__name__}: expected {what} that are the same in all frames of a clip "
            f"{tuple(points.shape)}, got {tuple(value.shape)}: take their median over the frames; if they are of as "
            "many bodies, give points[None]"
        )


def check_positive(module: nn.Module, *, finite: bool = False, **options: Any) -> None:
    """Raise an OptionError unless all options are positive numbers, and below infinity if ``finite``."""
    for name, value in options.items():
        if not isinstance(value, Real) or not float(value) > 0 or (finite and float(value) == math.inf):
            kind = "positive number that is finite" if finite else "positive number"
            raise OptionError(f"{type(module).__name__}: {name}: expected a {kind}, got {value!r}")


def check_whole(module: nn.Module, least: int, **options: Any) -> None:
    """Raise an OptionError unless all options are whole numbers, ``least`` or more."""
    for name, value in options.items():
        if not isinstance(value, Integral) or value < least:
            raise OptionError(
                f"{type(module).__name__}: {name}: expected a whole number, at least {least}, got {value!r}"
            )


def shown(module: nn.Module, *names: str) -> str:
    """Settings of a module, as its text tells them."""
    return ", ".join(f"{name}={getattr(module, name)!r}" for name in names)
