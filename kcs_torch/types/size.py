"""The size of a body: from one known length to a factor for all, and between units of length."""

from __future__ import annotations

import math
from collections.abc import Mapping

from torch import Tensor

from kcs_torch.errors import OptionError
from kcs_torch.skeleton import Skeleton

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
        (name, size), *_ = sizes.items()
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
    if not (factor > 0 and math.isfinite(factor)):
        raise OptionError(f"{what}: expected a positive factor, got {factor}")
    return factor


def _height(body: Skeleton, lengths: Tensor, what: str) -> float:
    """Longest path through the bones: head to foot of the straightened body."""
    neighbours: dict[int, list[tuple[int, float]]] = {i: [] for i in range(body.num_joints)}
    for (a, b), length in zip(body.bones, lengths.tolist(), strict=True):
        neighbours[a].append((b, length))
        neighbours[b].append((a, length))
    names = list(body.joints)
    tops = [i for i, n in enumerate(names) if "head" in n.lower() or "nose" in n.lower()]
    feet = [i for i, n in enumerate(names) if any(w in n.lower() for w in ("ankle", "heel", "foot"))]
    if not tops or not feet:
        raise OptionError(
            f"{what}: height needs a head and a foot among the joints; skeleton '{body.name}' has none: give a bone"
        )
    best = 0.0
    for top in tops:
        reach = {top: 0.0}
        stack = [top]
        while stack:
            i = stack.pop()
            for j, length in neighbours[i]:
                if j not in reach:
                    reach[j] = reach[i] + length
                    stack.append(j)
        best = max([best, *(reach[f] for f in feet if f in reach)])
    return best
