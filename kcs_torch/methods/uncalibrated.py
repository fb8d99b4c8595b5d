"""A camera that nobody has calibrated: the focal length under which a body explains its tracks best."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable
from dataclasses import replace

from torch import Tensor

from kcs_torch.errors import KcsWarning, OptionError
from kcs_torch.functional.chain import bone_lengths
from kcs_torch.functional.temporal import interpolate
from kcs_torch.methods.base import Method, apart
from kcs_torch.methods.perspective import reconstruct_perspective
from kcs_torch.methods.pkc import PKC
from kcs_torch.methods.pkc.objective import usual_posture
from kcs_torch.nn.posture import trunk_joints
from kcs_torch.types import Intrinsics, Reconstruction, Tracks

__all__ = ["reconstruct_uncalibrated"]

DISTANCES = tuple(2.0 * 1.5**k for k in range(8))
"""Distances that are tried, for a body of 1.75: 2 to 34."""

BETTER = 5.0
"""By how much the objective must be lower than at the largest distance for perspective to be believed."""

FIRST = 3
"""Index of the distance that is tried first."""

LONGEST = 0.9
"""Share of the frames in which a bone looks no longer than what is taken for its length."""


def reconstruct_uncalibrated(method: Method, tracks: Tracks, cameras: Tensor | None = None) -> Reconstruction:
    """Reconstruct a body before a pinhole camera of unknown focal length.

    The nearer a camera is, the more the size of a limb in the image changes with its depth: bones of constant length,
    the template's posture and feet that stand still tell how much. PKC solves the tracks for focal lengths at which the
    body is 2 to 34 of its units away (a person is 1.75 tall), from one to the next as long as the objective falls; the
    minimum of a parabola through the best and its neighbours is the focal length. The principal point is taken to be
    the tracks' middle.

    Args:
        method: any.
        tracks: of a body with a template.
        cameras: as of :func:`kcs_torch.methods.perspective.reconstruct_perspective`.

    Returns:
        As :func:`kcs_torch.methods.perspective.reconstruct_perspective`; a note tells the intrinsics. Where the tracks
        show no perspective, the method's own solution, for parallel rays.

    Raises:
        OptionError: the skeleton has no template with a trunk, or no bone is seen.
    """
    if len(trunk_joints(tracks.skeleton)) < 3:
        raise OptionError(
            f"intrinsics: 'auto' needs a skeleton with a template and a trunk, '{tracks.skeleton.name}' has none: "
            "expected (fx, fy, cx, cy) or a matrix K (3, 3)"
        )
    with apart([tracks]):
        middle, unit = _seen(tracks)
    judge = method if isinstance(method, PKC) else PKC()
    found: dict[float, Reconstruction] = {}

    def lens(distance: float) -> Intrinsics:
        return Intrinsics(distance * unit, distance * unit, *middle)

    def solve(distance: float) -> float:
        """The objective where the body is so far away."""
        if distance not in found:
            found[distance] = reconstruct_perspective(judge, tracks, lens(distance), cameras)
        value = found[distance].objective
        return value if math.isfinite(value) else math.inf

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", KcsWarning)
        solve(_descended(solve))
        best = min(found, key=solve)
        near = solve(best) < solve(DISTANCES[-1]) - BETTER
        if near and judge is method:
            result = found[best]
        else:
            result = reconstruct_perspective(method, tracks, lens(best), cameras) if near else method(tracks, cameras)
    method._warn(result, "")
    note = "no perspective found in the tracks: rays taken to be parallel"
    if near:
        at = ", ".join(f"{x:.0f}" for x in middle)
        focal = f"focal length of {best * unit:.0f} {tracks.units} found from the tracks"
        note = f"{focal}, principal point taken to be ({at})"
    said = replace(result.diagnostics, notes=(*result.diagnostics.notes, note))
    return replace(result, diagnostics=said)


def _descended(cost: Callable[[float], float]) -> float:
    """The distance of least cost: the best one tried, or the minimum of a parabola through it and its neighbours."""
    i = FIRST
    while True:
        near = [k for k in (i - 1, i, i + 1) if 0 <= k < len(DISTANCES)]
        least = min(near, key=lambda k: cost(DISTANCES[k]))
        if least == i:
            break
        i = least
    if not 0 < i < len(DISTANCES) - 1:
        return DISTANCES[i]
    low, here, high = (cost(DISTANCES[k]) for k in (i - 1, i, i + 1))
    bend = low - 2 * here + high
    shift = (low - high) / (2 * bend) if 0 < bend < math.inf else 0.0
    return DISTANCES[i] * (DISTANCES[i + 1] / DISTANCES[i]) ** shift


def _seen(tracks: Tracks) -> tuple[tuple[float, float], float]:
    """The tracks' middle, and how long the unit of a body of 1.75 looks where its bones lie in the image plane."""
    body, seen = tracks.skeleton, tracks.seen
    known = seen.any(0)
    filled = interpolate(tracks.points, seen)
    bones = body.bone_index(device=filled.device)[list(body.rigid)]
    usual = usual_posture(body, filled.dtype, filled.device).rest_lengths[list(body.rigid)]
    use = known[bones].all(-1) & (usual > 0)
    if not bool(use.any()):
        raise OptionError(f"{tracks.source}: intrinsics: 'auto' needs a bone whose joints are seen: expected numbers")
    look = bone_lengths(filled, bones)[:, use].quantile(LONGEST, 0)
    unit = float((look / usual[use]).median())
    if not unit > 0:
        raise OptionError(f"{tracks.source}: intrinsics: 'auto' needs a body of some size in the image: it has none")
    x, y = filled[:, known].mean((0, 1)).tolist()
    return (x, y), unit
