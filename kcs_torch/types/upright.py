"""Whether a body stands on its feet, in an image whose y points down, and what to say where it does not."""

from __future__ import annotations

import math

from torch import Tensor

from kcs_torch.skeleton import Skeleton

__all__ = ["ABOVE", "how_it_stands", "lean", "lies_down", "upside_down"]

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
    if lies_down(points, seen, skeleton, NEARLY_ALL):
        said = _LYING
    elif upside_down(points[..., 1], seen, skeleton, NEARLY_ALL):
        said = _ASIDE if _leans(points, seen, skeleton, NEARLY_ALL) else _HEADSTAND
    else:
        said = ""
    return said.format(often=" in nearly all frames" if len(points) > 1 else "")


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
    away, _, shown = _feet(points, seen, skeleton)
    _, y, z = away[shown].double().mean(0).tolist() if bool(shown.any()) else (0.0, -1.0, 0.0)
    return math.degrees(math.atan2(-z, -y))


def upside_down(heights: Tensor, seen: Tensor, skeleton: Skeleton, share: float = 0.5) -> bool:
    """Whether the joints that touch the ground are clearly above the others in more than a share of the frames.

    Args:
        heights: (T, N) y of the joints, pointing down.
        seen: (T, N).
        skeleton: one without contacts is never upside down.
        share: of the frames that show joints of both kinds.
    """
    below, size, shown = _feet(heights[..., None], seen, skeleton)
    return bool(shown.any()) and _share(-below[:, 0] > CLEARLY * size, shown) > share


def lies_down(points: Tensor, seen: Tensor, skeleton: Skeleton, share: float) -> bool:
    """Whether those joints are clearly beside the others, and hardly below them, in more than a share of the frames.

    Args:
        points: (T, N, 2).
        seen: (T, N).
        skeleton: one without contacts does not lie.
        share: of the frames that show joints of both kinds.
    """
    away, size, shown = _feet(points, seen, skeleton)
    aside, below = away.abs().unbind(-1)
    return bool(shown.any()) and _share((aside > CLEARLY * size) & (aside > FLAT * below), shown) > share


def _leans(points: Tensor, seen: Tensor, skeleton: Skeleton, share: float) -> bool:
    """Whether those joints are to one side of the others as they are below them in a body that bends, or leans.

    Swapped axes put such a body's feet there, and above it or below.

    Args:
        points: (T, N, 2).
        seen: (T, N).
        skeleton: with contacts.
        share: of the frames that show joints of both kinds.
    """
    away, size, shown = _feet(points, seen, skeleton)
    aside, below = away.unbind(-1)
    far = (aside.abs() > CLEARLY * size) & (FLAT * aside.abs() > below.abs())
    return max(_share(far & (aside > 0), shown), _share(far & (aside < 0), shown)) > share


def _feet(points: Tensor, seen: Tensor, skeleton: Skeleton) -> tuple[Tensor, Tensor, Tensor]:
    """Where feet are, from the others (T, D); how far joints are from their mean (T,); frames that show both (T,)."""
    feet = list(skeleton.contacts)
    others = [n for n in range(skeleton.num_joints) if n not in feet]

    def mean(joints: list[int], values: Tensor) -> Tensor:
        """(T, 1, D), over the joints that a frame shows."""
        own = seen[:, joints, None]
        return values[:, joints].where(own, 0).sum(1, keepdim=True) / own.sum(1, keepdim=True).clamp_min(1)

    every = [*feet, *others]
    size = mean(every, (points - mean(every, points)).square().sum(-1, keepdim=True))[:, 0, 0].sqrt()
    shown = seen[:, feet].any(1) & seen[:, others].any(1) & (size > 0)
    return (mean(feet, points) - mean(others, points))[:, 0], size, shown


def _share(of: Tensor, shown: Tensor) -> float:
    return float(of[shown].double().mean())
