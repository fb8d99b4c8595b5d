"""What a method finds, and how it becomes a reconstruction in the tracks' units and place."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor

from kcs_torch.clean.timing import cuts_of_all
from kcs_torch.errors import counted
from kcs_torch.functional.align import centre
from kcs_torch.functional.camera import viewpoint_turn
from kcs_torch.functional.chain import bone_lengths
from kcs_torch.functional.guarded import largest, or_one
from kcs_torch.functional.ranks import nanmedian
from kcs_torch.functional.temporal import interpolate
from kcs_torch.functional.weights import rms
from kcs_torch.methods.answer.root import root_depth
from kcs_torch.methods.answer.wrong import LOOSE, what_is_wrong
from kcs_torch.methods.clips.batches import FRAMES, Clips, padded
from kcs_torch.skeleton import Skeleton
from kcs_torch.types import Diagnostics, Reconstruction, Tracks
from kcs_torch.types.upright import how_they_stand
from kcs_torch.types.variation import BoneVariation, bone_variations

if TYPE_CHECKING:
    from kcs_torch.methods.base import Method

__all__ = [
    *("BY_SHOTS", "HARDLY", "NO_POSE", "SINGLE", "WEAK_TURN", "Estimate"),
    *("UNHELD", "extent", "finish", "loose_lengths", "note_on_cuts", "nothing_else", "on_turn"),
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

UNHELD = "does not hold them constant"
"""How the note ends on bones' lengths that a method leaves free."""


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


class _Told(NamedTuple):
    """What is told of a solution, whose points (T, N, 3) are in the tracks' units and place."""

    points: Tensor
    lengths: Tensor
    turn: float
    off: float
    variation: BoneVariation
    wrong: list[str]


def finish(
    method: Method, tracks: Sequence[Tracks], found: Sequence[Estimate], sizes: Sequence[Tensor], seconds: float
) -> list[Reconstruction]:
    """Bring estimates to their tracks' units and place, and say what there is to say about them.

    All is told on the processor, of as many solutions together as its cache holds.

    Args:
        method: that found them.
        tracks: clips of one skeleton, dtype and device.
        found: in each, in normalised units.
        sizes: that each clip's tracks were divided by.
        seconds: that each took.
    """
    clips, body = Clips.of(tracks).to("cpu"), tracks[0].skeleton
    views, flat = _notes_on_view(clips, body), (~(extent(clips) > 0)).tolist()
    every = [(k, one) for k, first in enumerate(found) for one in (first, *first.alternatives)]
    few = max(1, FRAMES // max(clips.counts))
    results: list[list[Reconstruction]] = [[] for _ in tracks]
    for some in (every[begin : begin + few] for begin in range(0, len(every), few)):
        of = [k for k, _ in some]
        shown = clips if of == list(range(len(tracks))) else Clips.of([tracks[k] for k in of]).to("cpu")
        told = _told(method, body, shown, [one for _, one in some], torch.stack([sizes[k] for k in of]))
        for (k, one), facts in zip(some, told, strict=True):
            doubt = one.doubt or nothing_else(method, tracks[k], facts.turn)
            notes = _notes_on_solution(method, tracks[k], one, facts, doubt)
            notes += [*views[k], *facts.wrong, *_notes_on_tracks(method, tracks[k], flat[k])]
            results[k].append(_reconstruction(method, tracks[k], one, sizes[k], seconds, facts, notes, doubt))
    for k, first in enumerate(found):
        if not flat[k] and tracks[k].num_frames > 1:
            results[k] = _with_roots(results[k], tracks[k], first)
    return [replace(own[0], alternatives=tuple(own[1:])) if own[1:] else own[0] for own in results]


def on_turn(method: Method, tracks: Tracks, turn: float, doubt: str) -> list[str]:
    """What depth rests on where the viewpoint hardly turns, by so many degrees, for the user, if no doubt tells it."""
    if turn >= WEAK_TURN or method.learned or (doubt and doubt == nothing_else(method, tracks, turn)):
        return []
    return [f"{_how_little(tracks, turn)}: depth rests on {_rest(method, tracks.skeleton)}"]


def loose_lengths(method: Method, variation: float) -> list[str]:
    """That bones' lengths vary, by so many per cent, if a method leaves them free."""
    if not variation > LOOSE or method.keeps_lengths:
        return []
    return [f"bone lengths vary by {variation:.1f} %: '{method.name}' {UNHELD}"]


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


def _told(method: Method, body: Skeleton, clips: Clips, found: Sequence[Estimate], size: Tensor) -> list[_Told]:
    """What is told of a solution of each of K clips, whose unit has a size (K,) in the tracks' units."""
    like, bones = clips.points, body.bone_index()
    given = (padded([getattr(one, name) for one in found]).to(like.device) for name in ("points", "scales", "cameras"))
    relative, scales, cameras = given
    points, images = _placed(clips, relative * size.to(like.device)[:, None, None, None], scales)
    lengths = clips.fill(bone_lengths(points, bones), math.nan)
    wrong = what_is_wrong(method, body, clips, points, images, [one.converged for one in found], lengths)
    variations = bone_variations(lengths, body, clips.seen.any(1))
    turns, off = viewpoint_turn(cameras, clips.inside), rms(images - clips.points, clips.seen.to(like), 2)
    device = size.device
    own = [one.clone() for one in clips.cut(points.to(device))]  # a part of the batch would keep all of it
    usual = [one.clone() for one in nanmedian(lengths, 1).to(device)]
    return [_Told(*row) for row in zip(own, usual, turns.tolist(), off.tolist(), variations, wrong, strict=True)]


def _placed(clips: Clips, points: Tensor, scales: Tensor) -> tuple[Tensor, Tensor]:
    """Points (K, T, N, 3) of scales (K, T) in their tracks' place, 0 in the padding; and their images (K, T, N, 2)."""
    images = points[..., :2] * scales[..., None, None]
    shift = _shift(clips.points - images, clips.weights)
    known = clips.seen.any(-1)
    if not bool(known.all()):
        shift = clips.fill(interpolate(shift, known[..., None]), 0.0)
    return points + torch.nn.functional.pad(shift, (0, 1)), images + shift


def _with_roots(results: Sequence[Reconstruction], tracks: Tracks, found: Estimate) -> list[Reconstruction]:
    """Solutions of a clip with the root's path in depth, those before a camera that may be taken to stand still."""
    still = [i for i, one in enumerate((found, *found.alternatives)) if one.still]
    if not still:
        return list(results)
    points, standing = torch.stack([results[i].points for i in still]), found.standing
    standing = None if standing is None else standing.to("cpu")
    roots, remark = root_depth(points.to("cpu"), tracks.to("cpu"), standing)
    paths = [None] * len(still) if roots is None else roots.to(points.device)
    told = list(results)
    for i, path in zip(still, paths, strict=True):
        facts = told[i].diagnostics
        told[i] = replace(told[i], root_depth=path, diagnostics=replace(facts, notes=(*facts.notes, remark)))
    return told


def _reconstruction(
    method: Method,
    tracks: Tracks,
    found: Estimate,
    size: Tensor,
    seconds: float,
    told: _Told,
    notes: Sequence[str],
    doubt: str,
) -> Reconstruction:
    """One solution, of which everything is told but the root's path."""
    diagnostics = Diagnostics(
        viewpoint_turn=told.turn,
        unseen_share=tracks.unseen_share,
        bone_variation=told.variation.median,
        reprojection_rms=told.off,
        converged=found.converged,
        iterations=found.iterations,
        seconds=seconds,
        notes=tuple(notes),
        doubt=doubt,
        largest_bone_variation=told.variation.largest,
        loosest_bone=told.variation.bone,
    )
    return Reconstruction(
        told.points,
        found.cameras,
        found.scales,
        told.lengths,
        tracks,
        method.name,
        diagnostics,
        uncertainty=None if found.deviation is None else _guessed(found.deviation, tracks) * size,
        objective=found.objective,
    )


def _notes_on_solution(method: Method, tracks: Tracks, found: Estimate, told: _Told, doubt: str) -> list[str]:
    """What is said of a solution by itself."""
    notes = [*found.notes, *on_turn(method, tracks, told.turn, doubt)]
    if doubt:
        notes.append(doubt)
    if not found.converged:
        notes.append(method.unsettled(found.iterations))
    return [*notes, *loose_lengths(method, told.variation.median)]


def _notes_on_view(clips: Clips, body: Skeleton) -> list[list[str]]:
    """What is said of how each clip's body stands, and of cuts."""
    notes = [[words] if words else [] for words in how_they_stand(clips.points, clips.seen, body, clips.counts)]
    for own, cuts in zip(notes, cuts_of_all(clips.points, clips.seen, body), strict=True):
        own += note_on_cuts(cuts)
    return notes


def note_on_cuts(cuts: Sequence[int]) -> list[str]:
    """What is said of shots that begin at these frames; nothing where there are none."""
    if not cuts:
        return []
    more = f" and {len(cuts) - SHOWN} more" if len(cuts) > SHOWN else ""
    return [f"the view jumps at frame {', '.join(map(str, cuts[:SHOWN]))}{more}, {BY_SHOTS}"]


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
    """Weighted mean over joints, (K, T, 1, D), those far from it counting less; 0 where no joint is seen."""
    middle = centre(residuals, weights)[1]
    for _ in range(FAR_STEPS):
        off = (residuals - middle).abs()
        far = (off / largest(off, 3).clamp_min(torch.finfo(off.dtype).tiny)).norm(dim=-1)  # no square overflows
        usual = nanmedian(torch.where(weights > 0, far, torch.nan).flatten(1), 1)[:, None, None]
        nearer = centre(residuals, weights / (1 + (far / (3 * or_one(usual))).square()))[1]
        middle = torch.where(usual[..., None] > 0, nearer, middle)
    return middle


def extent(tracks: Tracks | Clips) -> Tensor:
    """How far seen joints lie apart, at most, in a frame; 0 where it is rounding. Of each clip, if there are some."""
    seen = tracks.seen[..., None]
    far = torch.full_like(tracks.points, math.inf)
    low = torch.where(seen, tracks.points, far).amin(-2)
    apart = torch.where(seen, tracks.points, -far).amax(-2) - low
    apart = torch.where(apart > 8 * torch.finfo(apart.dtype).eps * low.abs(), apart, torch.zeros_like(apart))
    return largest(apart, 2).squeeze((-2, -1))
