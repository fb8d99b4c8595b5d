"""The size of a body: from one known length to a factor for all, and between units of length."""

from __future__ import annotations

import math
from collections.abc import Mapping

import torch
from torch import Tensor

from kcs_torch.errors import OptionError
from kcs_torch.skeleton import Skeleton, stature_weights
from kcs_torch.types.intake import as_number

__all__ = ["METRES", "size_factor", "unit_ratio"]

METRES = {"m": 1.0, "cm": 0.01, "mm": 0.001, "in": 0.0254, "ft": 0.3048}
"""Units of length in metres."""


def unit_ratio(old: str, new: str) -> float | None:
    """How many ``new`` units one ``old`` unit has; None where either is no length (px).

    >>> unit_ratio("m", "mm"), unit_ratio("px", "mm")
    (1000.0, None)
    """
    if old == new:
        return 1.0
    return METRES[old] / METRES[new] if old in METRES and new in METRES else None


def size_factor(
    body: Skeleton, lengths: Tensor, factor: float | None, sizes: Mapping[str, float], what: str = "scaled"
) -> float:
    """The factor by which a body of bone ``lengths`` (B,) grows to the one size that is given, or ``factor`` itself.

    Args:
        body: the skeleton.
        lengths: (B,) of its bones.
        factor: or None.
        sizes: one entry, ``height`` or the name of a bone, in the new unit; or none.
        what: who asks, for messages.

    Raises:
        OptionError: not exactly one of ``factor`` and a size is given, it is unknown, or it is not positive.
    """
    if (factor is None) == (len(sizes) != 1):
        raise OptionError(f"{what}: expected either factor=... or exactly one size, such as height=1.75")
    if factor is None:
        (name, given), *_ = sizes.items()
        size = _number(given, f"{what}: {name}")
        if name == "height":
            own = _height(body, lengths, what)
        elif name in body.bone_names:
            own = float(lengths[body.bone_names.index(name)])
        else:
            raise OptionError(
                f"{what}: unknown size {name!r}: expected 'height' or a bone, one of {', '.join(body.bone_names)}"
            )
        if not own > 0:
            raise OptionError(f"{what}: {name} is zero or unknown in this motion")
        factor = size / own
    factor = _number(factor, f"{what}: factor")
    if not (factor > 0 and math.isfinite(factor)):
        raise OptionError(f"{what}: expected a positive factor, got {factor}")
    return factor


def _number(value: object, what: str) -> float:
    """A number, or a tensor of one, as a float.

    Raises:
        OptionError: it is none.
    """
    number = as_number(value.item() if isinstance(value, Tensor) and value.numel() == 1 else value)
    if number is None:
        raise OptionError(f"{what}: expected a number, got {value!r}")
    return number


def _height(body: Skeleton, lengths: Tensor, what: str) -> float:
    """The person's stature; the mean over those legs whose bones are known."""
    weights = stature_weights(body)
    if weights is None:
        raise OptionError(
            f"{what}: height needs a head and a foot among the joints; skeleton '{body.name}' has none: give a bone"
        )
    weights = weights.to(lengths)
    rows = torch.where(weights != 0, weights * lengths, torch.zeros_like(weights)).sum(-1)
    return float(rows.nanmean())
