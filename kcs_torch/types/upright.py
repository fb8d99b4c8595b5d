"""Whether a body stands on its feet, in an image whose y points down, and what to say where it does not."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from kcs_torch.skeleton import Skeleton

__all__ = ["ABOVE", "how_it_stands", "how_they_stand", "lean", "upside_down"]

CLEARLY = 0.3
"""How far feet are above the rest, over the joints' root mean square distance from their mean height."""

STRAIGHT = 0.14
"""Horizontal distance of a template's feet from the rest, over the vertical one, up to which it stands upright."""

FLAT = 3.0
"""How much farther to the side of the rest feet are than below it if the body lies."""

NEARLY_ALL = 0.9
"""Share of the frames in which feet are above the rest of the body, or beside it, where axes may well be others."""

ABOVE = "the feet are above the rest of the body"
"""How the sentences begin that say so."""

_Y_UP = "y points up in these tracks, give -y instead (with intrinsics the image's height - y)"

_SWAPPED = "x and y are swapped in these tracks (rows and columns of an image are y and x)"

_HEADSTAND = (
    f"{ABOVE}{{often}}. If {_Y_UP}: it has to point down, as in images, or the body is upside down and mirrored. If it "
    "does point down, joints may be in another order"
)

_ASIDE = (
    f"{ABOVE} and beside it{{often}}, as if it bent. If {_Y_UP}. If it does not, either {_SWAPPED}, or the video is "
    "stored turned: turn them. A picture tells which (kcs_torch.viewer.draw_tracks; kcs-torch info FILE -o joints.png)"
)

_LYING = (
    f"the body lies on its side{{often}}. If it does not, {_SWAPPED}, so that the body is mirrored, too; or the video "
    "is stored turned: turn them"
)


def how_it_stands(points: Tensor, seen: Tensor, skeleton: Skeleton) -> str:
    """What to say of a body that does not stand on its feet in nearly all frames, for the user; else empty.

    Args:
        points: (T, N, 2).
        seen: (T, N).
        skeleton: one without contacts stands.
    """
    return how_they_stand(points[None], seen[None], skeleton, [len(points)])[0]


def how_they_stand(points: Tensor, seen: Tensor, skeleton: Skeleton, counts: Sequence[int]) -> list[str]:
    """:func:`how_it_stands` of each of K clips (K, T, N, 2), of which so many frames are no padding: that is unseen."""
    if not skeleton.contacts:
        return [""] * len(counts)
    away, spread, shown = _feet(points, seen, skeleton)
    size = spread.sum(-1).sqrt()
    right, (aside, below) = away[..., 0], away.abs().unbind(-1)
    far = aside > CLEARLY * size
    lies = far & (aside > FLAT * below)
    bends = far & (FLAT * aside > below)  # or leans: swapped axes put such a body's feet there, above it or below
    shares = _share(torch.stack([lies, bends & (right > 0), bends & (right < 0)]), shown & (size > 0))
    often = (torch.cat([shares, _above(away, spread, shown)[None]]) > NEARLY_ALL).T.tolist()
    said = []
    for count, (down, to_right, to_left, above) in zip(counts, often, strict=True):
        words = _LYING if down else (_ASIDE if to_right or to_left else _HEADSTAND) if above else ""
        said.append(words.format(often=" in nearly all frames" if count > 1 else ""))
    return said


def lean(points: Tensor, seen: Tensor, skeleton: Skeleton) -> float:
    """Degrees by which a body leans along z in the mean over time: what is above its feet is on the side of larger z.

    Args:
        points: (T, N, 3), y pointing up.
        seen: (T, N).
        skeleton: one without contacts does not lean, nor does one without a template, or an animal, whose head is
            before its feet: it would seem to lean as it faces.
    """
    if skeleton.template is None:
        return 0.0
    rest = skeleton.template_points(dtype=points.dtype, device=points.device)[None]
    x, y, z = _feet(rest, seen.new_ones(rest.shape[:-1]), skeleton)[0][0].tolist()
    if math.hypot(x, z) > STRAIGHT * abs(y):
        return 0.0
    away, spread, shown = _feet(points, seen, skeleton)
    shown &= spread.any(-1)
    _, y, z = away[shown].double().mean(0).tolist() if bool(shown.any()) else (0.0, -1.0, 0.0)
    return math.degrees(math.atan2(-z, -y))


def upside_down(heights: Tensor, seen: Tensor, skeleton: Skeleton) -> bool:
    """Whether the joints that touch the ground are clearly above the others in more than half of the frames.

    Frames count that show joints of both kinds.

    Args:
        heights: (T, N) y of the joints, pointing down.
        seen: (T, N).
        skeleton: one without contacts is never upside down.
    """
    return bool(_above(*_feet(heights[..., None], seen, skeleton)) > 0.5)


def _above(away: Tensor, spread: Tensor, shown: Tensor) -> Tensor:
    """The share (...) of frames in which :func:`_feet` are clearly above the others, by the last coordinate."""
    size = spread[..., -1].sqrt()
    return _share(-away[..., -1] > CLEARLY * size, shown & (size > 0))


def _feet(points: Tensor, seen: Tensor, skeleton: Skeleton) -> tuple[Tensor, Tensor, Tensor]:
    """Where the joints (..., N, D) that touch the ground are from the others, how far all are from their mean.

    Returns:
        The means' difference (..., D), the mean square by coordinate (..., D), and whether both kinds are shown (...).
    """
    feet = list(skeleton.contacts)
    others = [n for n in range(skeleton.num_joints) if n not in feet]
    kinds = [torch.tensor(joints, dtype=torch.long, device=points.device) for joints in (feet, others)]
    own = seen[..., None]
    feet_seen, others_seen = (own.index_select(-2, kind).sum(-2) for kind in kinds)
    of_feet, of_others = (torch.where(own, points, 0).index_select(-2, kind).sum(-2) for kind in kinds)
    count = (feet_seen + others_seen).clamp_min(1)
    off = torch.where(own, points - ((of_feet + of_others) / count)[..., None, :], 0)
    away = of_feet / feet_seen.clamp_min(1) - of_others / others_seen.clamp_min(1)
    return away, off.square().sum(-2) / count, ((feet_seen > 0) & (others_seen > 0))[..., 0]


def _share(of: Tensor, shown: Tensor) -> Tensor:
    """In how many of the frames that are shown (..., T) something holds, (...): a share, 0 of none."""
    return (of & shown).sum(-1).double() / shown.sum(-1).clamp_min(1)
