"""The options of a tracker, checked."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

from kcs_torch.errors import OptionError, SkeletonError
from kcs_torch.methods.pkc import PKC
from kcs_torch.skeleton import Skeleton, get_skeleton
from kcs_torch.types.hints import is_a
from kcs_torch.types.image_size import as_image_size
from kcs_torch.types.intake import as_number, check_rate
from kcs_torch.types.size import short_unit

__all__ = ["LEAST", "Options", "check_options"]

LEAST = 12
"""Frames that a window has at least."""

LENGTH, AGAIN = 3.0, 10.0
"""Seconds of a window, and after which it is solved again."""


class Options(NamedTuple):
    """Arguments of a tracker, and its attributes; all that it holds is made for them."""

    skeleton: Skeleton
    fps: float
    window: int
    period: int
    units: str
    threshold: float
    wait: bool
    method: PKC
    image_size: tuple[int, int] | None


def check_options(
    skeleton: str | Path | Skeleton,
    fps: float,
    window: int | None,
    period: int | None,
    units: str,
    threshold: float,
    wait: bool,
    method: PKC | None,
    image_size: tuple[int, int] | None,
) -> Options:
    """What :class:`.Tracker` is given, which says what it means.

    Raises:
        SkeletonError: the skeleton is unknown, or its bones are no tree.
        OptionError: a number is out of range, or something is of another kind.
    """
    body = None if skeleton == "auto" else get_skeleton(skeleton)
    if body is None or not body.is_tree:
        raise SkeletonError(
            f"Tracker: expected a skeleton whose bones form one tree, got '{body.name if body else skeleton}'; "
            "kcs_torch.find_skeleton finds one from a clip"
        )
    rate, least = check_rate(fps, "Tracker: fps"), as_number(threshold)
    if least is None or not 0 <= least <= 1:
        raise OptionError(f"Tracker: threshold: expected a confidence within 0..1, got {threshold!r}")
    if not is_a(wait, bool):
        raise OptionError(f"Tracker: wait: expected true or false, got {wait!r}")
    if method is not None and not isinstance(method, PKC):
        raise OptionError(f"Tracker: method: expected a kcs_torch.PKC, or None for its defaults, got {method!r}")
    window = max(2 * LEAST, round(LENGTH * rate)) if window is None else window
    period = max(window, round(AGAIN * rate)) if period is None else period
    for name, value in (("window", window), ("period", period)):
        if not is_a(value, int) or value < LEAST:
            raise OptionError(f"Tracker: {name}: expected at least {LEAST} frames, a whole number, got {value!r}")
    unit = short_unit(units)
    size = as_image_size(image_size, unit, "Tracker")
    return Options(body, rate, int(window), int(period), unit, least, wait, method or PKC(), size)
