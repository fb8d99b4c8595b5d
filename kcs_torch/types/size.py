"""The size of a body: from one known length to a factor for all, and between units of length."""

from __future__ import annotations

import math
import re
import warnings
from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

from kcs_torch.errors import KcsWarning, OptionError, users_level
from kcs_torch.skeleton import Skeleton, map_joints, stature_weights
from kcs_torch.types.intake import as_number

__all__ = ["METRES", "check_size", "parse_size", "short_unit", "size_factor", "size_hint", "unit_ratio"]

METRES = {"m": 1.0, "cm": 0.01, "mm": 0.001, "in": 0.0254, "ft": 0.3048}
"""Units of length in metres."""

PREFIXES = {"": "m", "centi": "cm", "milli": "mm"}
SPELT = {f"{size}{word}": unit for size, unit in PREFIXES.items() for word in ("meter", "meters", "metre", "metres")}
SPELT |= {"inch": "in", "inches": "in", "foot": "ft", "feet": "ft", "pixel": "px", "pixels": "px"}
"""Their names as words."""


def short_unit(name: str) -> str:
    """A unit as it is written here, whatever a file calls it; other units in small letters.

    Raises:
        OptionError: it is no text.

    >>> short_unit("Millimeters"), short_unit("px")
    ('mm', 'px')
    """
    if not isinstance(name, str):
        raise OptionError(f"units: expected a name such as 'm', got {name!r}")
    name = name.strip().lower()
    return SPELT.get(name, name)


def unit_ratio(old: str, new: str) -> float | None:
    """How many ``new`` units one ``old`` unit has; None where either is no length (px).

    >>> unit_ratio("m", "mm"), unit_ratio("px", "mm")
    (1000.0, None)
    """
    if old == new:
        return 1.0
    return METRES[old] / METRES[new] if old in METRES and new in METRES else None


STATURES = 0.1, 10.0
"""Statures in metres, lowest and highest, that are hardly a slip in the unit: of a toy and of a giant."""


def size_factor(
    body: Skeleton,
    lengths: Tensor,
    factor: float | None,
    sizes: Mapping[str, float],
    *,
    units: str,
) -> float:
    """The factor by which a body of bone ``lengths`` (B,) grows to the one size that is given, or ``factor`` itself.

    Args:
        body: the skeleton.
        lengths: (B,) of its bones.
        factor: or None.
        sizes: one entry, ``height`` or the name of a bone, in the new unit; or none.
        units: the new unit.

    Raises:
        OptionError: the unit has no name, not exactly one of ``factor`` and a size is given, it is unknown, or it is
            not positive.

    Warns:
        KcsWarning: nobody is so tall in this unit.
    """
    what = "scaled"
    if not units:
        raise OptionError(f"{what}: units: expected the name of the new unit, such as 'm', got nothing")
    if (factor is None) == (len(sizes) != 1):
        raise OptionError(f"{what}: expected either factor=... or exactly one size, such as height=1.75")
    if factor is None:
        (name, given), *_ = sizes.items()
        size = _number(given, f"{what}: {name}")
        if name == "height":
            own = _height(body, lengths, what)
        else:
            own = float(lengths[_bone(body, name, what)])
        if not own > 0:
            raise OptionError(f"{what}: {name} is zero or unknown in this motion")
        if not 0 < size < math.inf:
            raise OptionError(f"{what}: {name}: expected a positive number, got {size:g}")
        metres = size * METRES[units] if units in METRES else 1.0
        if name == "height" and not STATURES[0] <= metres <= STATURES[1]:
            said = "" if units == "m" else f" is {metres:.4g} m"
            message = f"{what}: a height of {size:g} {units}{said}: is the unit another?"
            warnings.warn(message, KcsWarning, stacklevel=users_level())
        factor = size / own
    factor = _number(factor, f"{what}: factor")
    if not (factor > 0 and math.isfinite(factor)):
        raise OptionError(f"{what}: expected a positive factor, got {factor}")
    return factor


def check_size(body: Skeleton, name: str, what: str = "scaled") -> None:
    """Make sure that a body has a size of this name: ``height``, ``factor`` or a bone.

    Raises:
        OptionError: it has none.
    """
    if name == "height":
        _stature(body, what)
    elif name != "factor":
        _bone(body, name, what)


def _bone(body: Skeleton, name: str, what: str) -> int:
    """Index of the bone of a name, however its joints are spelled and in either order."""
    if name in body.bone_names:
        return body.bone_names.index(name)
    for cut in (i for i, letter in enumerate(name) if letter == "-"):
        ends = map_joints(body.joints, [name[:cut], name[cut + 1 :]])
        for i, bone in enumerate(body.bones):
            if None not in ends and set(bone) == set(ends):
                return i
    raise OptionError(
        f"{what}: unknown size {name!r}: expected 'height' or a bone, one of {', '.join(body.bone_names)}"
    )


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
    weights = _stature(body, what).to(lengths)
    rows = torch.where(weights != 0, weights * lengths, torch.zeros_like(weights)).sum(-1)
    return float(rows.nanmean())


def _stature(body: Skeleton, what: str) -> Tensor:
    """The weights of :func:`stature_weights`."""
    weights = stature_weights(body)
    if weights is None:
        bone = f", such as {body.bone_names[0]}" if body.bones else ""
        raise OptionError(
            f"{what}: height needs a head and a foot among the joints; skeleton '{body.name}' has none: give a bone"
            f"{bone}"
        )
    return weights


def size_hint(body: Skeleton) -> str:
    """How to set a body's size: by the stature where it has one, else by a bone.

    >>> from kcs_torch.skeleton import get_skeleton
    >>> size_hint(get_skeleton("hand21"))
    'scaled(units="m", **{"wrist-thumb_cmc": ...}) or --scale wrist-thumb_cmc=...mm'
    """
    if stature_weights(body) is not None or not body.bones:
        return "scaled(units=..., height=1.75) or --scale height=1.75m"
    bone = body.bone_names[0]
    return f'scaled(units="m", **{{"{bone}": ...}}) or --scale {bone}=...mm'


def parse_size(text: str, what: str = "scale") -> dict[str, Any]:
    """Read a size with its unit as arguments of ``scaled``.

    Raises:
        OptionError: it is of another form.

    >>> parse_size("height=1.75m"), parse_size("left_knee-left_ankle=430mm")
    ({'units': 'm', 'height': 1.75}, {'units': 'mm', 'left_knee-left_ankle': 430.0})
    """
    text = str(text)
    found = re.fullmatch(r"(.+)=\s*([0-9]*\.?[0-9]+(?:[eE][+-]?[0-9]+)?)\s*([a-z]+)", text.strip())
    known = found is not None and found[3] in METRES and found[1].strip() not in ("units", "self")
    if found is None or not known or not 0 < float(found[2]) < float("inf"):
        raise OptionError(
            f"{what}: expected height=1.75m, a bone such as left_knee-left_ankle=430mm, or factor=2mm, with one of the "
            f"units {', '.join(METRES)}; got {text!r}"
        )
    return {"units": found[3], found[1].strip(): float(found[2])}
