"""What a method finds, and how it becomes a reconstruction in the tracks' units and place."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from kcs_torch.clean.timing import cuts_of
from kcs_torch.errors import counted
from kcs_torch.functional.align import centre
from kcs_torch.functional.camera import viewpoint_turn
from kcs_torch.functional.chain import bone_lengths
from kcs_torch.functional.ranks import median
from kcs_torch.functional.temporal import interpolate
from kcs_torch.functional.weights import rms
from kcs_torch.methods.answer.root import root_depth
from kcs_torch.methods.answer.wrong import LOOSE, what_is_wrong
from kcs_torch.skeleton import Skeleton
from kcs_torch.types import Diagnostics, Reconstruction, Tracks
from kcs_torch.types.upright import how_it_stands
from kcs_torch.types.variation import bone_variation

if TYPE_CHECKING:
    from kcs_torch.methods.base import Method

__all__ = [
    *("BY_SHOTS", "HARDLY", "NO_POSE", "SINGLE", "WEAK_TURN", "Estimate"),
    *("extent", "finish", "little_turn", "nothing_else"),
]

WEAK_TURN = 30.0
"""Degrees of viewpoint turn below which depth is weakly determined."""

FAR_STEPS = 2
"""How often joints are weighed anew by their distance, when the body is put in its place."""

SHOWN = 5
"""Cuts that are named at most."""

BY_SHOTS = (
    "as at a cut of a film, or where another body is followed. Shots of one body tell 'pkc' each other's depth; those "
    "of others, or for other methods, should be solved by themselves: kt.reconstruct_all(kt.clean.split(tracks)), or "
    "part by part with --frames"
)

NO_POSE = "all joints lie at one point in every frame: there is no pose to find"
"""What is noted, and warned of, where tracks show a point."""

HARDLY, SINGLE = "the viewpoint turned by only", "a single image shows one viewpoint"
"""How a note begins that says how little the viewpoint turned, and of one frame."""


@dataclass(frozen=True)
class Estimate:
    """What a method finds, in normalised units: centred per frame, root mean square of the tracks 1.

    Attributes:
        points: (T, N, 3) in the camera frame.
        cameras: (T, 2, 3) orthonormal rows.
        scales: (T,) relative weak-perspective scale, mean 1.
        converged: whether the stopping rule was met.
        iterations: steps made.
        notes: sentences for the user.
        deviation: (T, N) standard deviation of depth, or None.
        objective: value that ranks the solutions of one method on one clip, lower is better; NaN where it has none.
        alternatives: further solutions, best first.
        still: whether the camera may be taken to stand still, so that feet tell the root's depth.
        standing: (T, C) how surely the skeleton's contact points stand still, where the method knows better than the
            tracks as they are; None where it does not, or where they hardly ever do.
        doubt: why depth is little more than a guess, a sentence; empty where it is more. The user is warned.
    """

    points: Tensor
    cameras: Tensor
    scales: Tensor
    converged: bool
    iterations: int
    notes: tuple[str, ...] = ()
    deviation: Tensor | None = None
    objective: float = math.nan
    alternatives: tuple[Estimate, ...] = ()
    still: bool = False
    standing: Tensor | None = None
    doubt: str = ""

    def to(self, like: Tensor) -> Estimate:
        """The same on the device of a tensor, and in its dtype."""
        held = {name: value.to(like) for name, value in vars(self).items() if isinstance(value, Tensor)}
        return replace(self, **held, alternatives=tuple(other.to(like) for other in self.alternatives))  # type: ignore[arg-type]


def finish(
    method: Method, tracks: Tracks, found: Estimate, size: Tensor, known: Tensor, seconds: float
) -> Reconstruction:
    """Bring an estimate to the tracks' units and place, and say what there is to say about it.

    Args:
        method: that found it.
        tracks: it was found in.
        found: in normalised units.
        size: that the tracks were divided by.
        known: (T,) frames that show something.
        seconds: that it took.
    """
    every = [found, *found.alternatives]
    placed = [_placed(tracks, one, size, known) for one in every]
    still, roots, remark = [i for i, one in enumerate(every) if one.still], None, ""
    pointlike = not bool(extent(tracks) > 0)
    if still and not pointlike and tracks.num_frames > 1:
        roots, remark = root_depth(torch.stack([placed[i][0] for i in still]), tracks, found.standing)
    paths = {} if roots is None else dict(zip(still, roots, strict=True))
    results = [
        _reconstruction(
            method, tracks, one, size, seconds, *where, pointlike, paths.get(i), remark if one.still else ""
        )
        for i, (one, where) in enumerate(zip(every, placed, strict=True))
    ]
    return replace(results[0], alternatives=tuple(results[1:]))


def little_turn(method: Method, tracks: Tracks, turn: float) -> str:
    """What depth rests on where the viewpoint hardly turns, by so many degrees, for the user; else empty."""
    if turn >= WEAK_TURN or method.learned:
        return ""
    return f"{_how_little(tracks, turn)}: depth rests on {_rest(method, tracks.skeleton)}"


def _how_little(tracks: Tracks, turn: float) -> str:
    return SINGLE if tracks.num_frames == 1 else f"{HARDLY} {counted(round(turn), 'degree')}"


def nothing_else(method: Method, tracks: Tracks, turn: float) -> str:
    """Why depth is little more than a guess where the viewpoint hardly turns, by so many degrees; else empty."""
    body = tracks.skeleton
    if turn >= WEAK_TURN or method.learned or method.knows_template(body):
        return ""
    told = body.template is not None and method.name not in ("pkc", "kcs")
    others = ", while 'pkc' and 'kcs' use the skeleton's template" if told else ""
    return (
        f"depth is little more than a guess: {_how_little(tracks, turn)}, and '{method.name}' has nothing else that "
        f"tells depth{others}"
    )


def _rest(method: Method, body: Skeleton) -> str:
    """What depth rests on where the viewpoint does not turn."""
    if method.knows_template(body):
        return "the template and lengths"
    return "constant lengths alone" if body.rigid and method.keeps_lengths else "nothing"


def _placed(tracks: Tracks, found: Estimate, size: Tensor, known: Tensor) -> tuple[Tensor, Tensor]:
    """Points (T, N, 3) in the tracks' units and place, and their images (T, N, 2)."""
    points = found.points * size
    seen = points[..., :2] * found.scales[:, None, None]
    shift = _shift(tracks.points - seen, tracks.weights)
    if not bool(known.all()):
        shift = interpolate(shift, known[:, None])
    return points + torch.nn.functional.pad(shift, (0, 1)), seen + shift


def _reconstruction(
    method: Method,
    tracks: Tracks,
    found: Estimate,
    size: Tensor,
    seconds: float,
    points: Tensor,
    seen: Tensor,
    pointlike: bool,
    root: Tensor | None,
    remark: str,
) -> Reconstruction:
    """One solution, whose place is known.

    Args:
        method: that found it.
        tracks: it was found in.
        found: in normalised units.
        size: of a unit of these in the tracks' units.
        seconds: that it took.
        points: (T, N, 3) in the tracks' units and place.
        seen: (T, N, 2) their images.
        pointlike: whether all joints lie at one point in every frame.
        root: (T,) the root's path in depth, or None.
        remark: on that path, for the user; may be empty.
    """
    body = tracks.skeleton
    bones = bone_lengths(points, body.bone_index(device=points.device))
    variation = bone_variation(bones, body, tracks.seen.any(0))
    turn = float(viewpoint_turn(found.cameras))
    notes = _notes_on_solution(method, tracks, found, turn, variation.median)
    notes += what_is_wrong(method, points, seen, tracks, found.converged, lengths=bones)
    notes += _notes_on_tracks(method, tracks, pointlike)
    if remark:
        notes.append(remark)
    diagnostics = Diagnostics(
        viewpoint_turn=turn,
        unseen_share=tracks.unseen_share,
        bone_variation=variation.median,
        reprojection_rms=float(rms(seen - tracks.points, tracks.seen.to(points.dtype))),
        converged=found.converged,
        iterations=found.iterations,
        seconds=seconds,
        notes=tuple(notes),
        doubt=found.doubt or nothing_else(method, tracks, turn),
        largest_bone_variation=variation.largest,
        loosest_bone=variation.bone,
    )
    return Reconstruction(
        points,
        found.cameras,
        found.scales,
        median(bones, 0),
        tracks,
        method.name,
        diagnostics,
        uncertainty=None if found.deviation is None else _guessed(found.deviation, tracks) * size,
        objective=found.objective,
        root_depth=root,
    )


def _notes_on_solution(method: Method, tracks: Tracks, found: Estimate, turn: float, variation: float) -> list[str]:
    """What is said of a solution: the viewpoint turns by so many degrees, and bones vary by so many per cent."""
    notes = list(found.notes)
    if little := little_turn(method, tracks, turn):
        notes.append(little)
    if found.doubt:
        notes.append(found.doubt)
    if not found.converged:
        notes.append(method.unsettled(found.iterations))
    if variation > LOOSE and not method.keeps_lengths:
        notes.append(f"bone lengths vary by {variation:.1f} %: '{method.name}' does not hold them constant")
    if stands := how_it_stands(tracks.points, tracks.seen, tracks.skeleton):
        notes.append(stands)
    if cuts := cuts_of(tracks):
        places = ", ".join(map(str, cuts[:SHOWN])) + (f" and {len(cuts) - SHOWN} more" if len(cuts) > SHOWN else "")
        notes.append(f"the view jumps at frame {places}, {BY_SHOTS}")
    return notes


def _notes_on_tracks(method: Method, tracks: Tracks, pointlike: bool) -> list[str]:
    """What is said of tracks that tell a method less than others would."""
    body, notes = tracks.skeleton, []
    if not body.rigid:
        kind = "no bones" if not body.num_bones else "no rigid bones"
        notes.append(f"the skeleton has {kind}: no lengths hold the joints together, and their variation is unknown")
    if tracks.fps is None and tracks.num_frames > 1 and method.reckons_in_seconds:
        notes.append("30 frames a second assumed, as the rate is not known: give fps=... (kcs-torch: --fps)")
    if pointlike:
        notes.append(NO_POSE)
    return notes


def _guessed(deviation: Tensor, tracks: Tracks) -> Tensor:
    """Deviations (T, N) of depth, as large as the body where nothing but a neighbour's place tells where a joint is."""
    if tracks.skeleton.template is not None:
        return deviation
    return torch.where(tracks.seen.any(0), deviation, deviation.clamp_min(1.0))


def _shift(residuals: Tensor, weights: Tensor) -> Tensor:
    """Weighted mean over joints, (T, 1, D), joints that are far from it counting less; 0 where no joint is seen."""
    middle = centre(residuals, weights)[1]
    for _ in range(FAR_STEPS):
        off = (residuals - middle).abs()
        far = (off / off.amax().clamp_min(torch.finfo(off.dtype).tiny)).norm(dim=-1)  # no square overflows
        usual = far[weights > 0].median() if bool((weights > 0).any()) else far.sum()
        if not bool(usual > 0):
            break
        middle = centre(residuals, weights / (1 + (far / (3 * usual)).square()))[1]
    return middle


def extent(tracks: Tracks) -> Tensor:
    """How far seen joints lie apart, at most, in a frame; 0 where it is rounding."""
    seen = tracks.seen[..., None]
    far = torch.full_like(tracks.points, math.inf)
    low = torch.where(seen, tracks.points, far).amin(1)
    apart = torch.where(seen, tracks.points, -far).amax(1) - low
    apart = torch.where(apart > 8 * torch.finfo(apart.dtype).eps * low.abs(), apart, torch.zeros_like(apart))
    return apart.amax() if apart.numel() else apart.sum()
