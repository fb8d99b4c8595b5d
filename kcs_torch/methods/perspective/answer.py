"""What is told of a body that was found under full perspective: :func:`assemble`."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import torch
from torch import Tensor

from kcs_torch.clean.detector import detected
from kcs_torch.functional.camera import complete_rotation, viewpoint_turn
from kcs_torch.methods.answer.finish import (
    BY_SHOTS,
    HARDLY,
    SINGLE,
    UNHELD,
    loose_lengths,
    note_on_cuts,
    nothing_else,
    on_turn,
)
from kcs_torch.methods.answer.root import ABSENT, FOUND
from kcs_torch.methods.answer.wrong import WHY_LOOSE, what_is_wrong
from kcs_torch.methods.base import Method
from kcs_torch.methods.clips.batches import Clips
from kcs_torch.methods.perspective.refining import Found
from kcs_torch.methods.perspective.scene import Bodies
from kcs_torch.methods.perspective.view import View, lens_note, zoomed
from kcs_torch.methods.pkc.answers import CLOSE, HEADING
from kcs_torch.methods.pkc.fixed_answer import SEE_OTHERS, UNSIDED
from kcs_torch.methods.pkc.near import SEEMS_NEAR
from kcs_torch.methods.pkc.objective import usual_posture
from kcs_torch.nn.posture import has_trunk
from kcs_torch.types import Reconstruction, Tracks

__all__ = ["assemble", "in_every_solution", "leaning", "noted", "timed"]

APART = 0.04
"""Root mean square difference in depth, for a body of 1.75, from which on solutions count as two."""

LEAN, ASIDE = 0.05, 0.1
"""Standard deviation, in radians, of the direction from which a body is seen if the focal length was found: a shorter
lens and a body that leans explain much the same image; and if the image's size is a guess as well."""


def assemble(method: Method, tracks: Tracks, found: Found, cameras: Tensor | None = None) -> Reconstruction:
    """The best solution in the camera's frame, with those of the others that differ from it.

    Args:
        method: that lifted the tracks.
        tracks: as they are in the image.
        found: in them.
        cameras: (T, 2, 3) that are known, or None.
    """
    bodies, unit = found.bodies, found.scene.unit
    most, keep = max(1, len(found.lifted[0].alternatives)), list[int]()
    most = min(most, getattr(method, "alternatives", most))
    for k, depth in enumerate(bodies.depth):
        if keep and not bool(depth.isfinite().all() & bodies.distance[k].isfinite().all()):
            continue
        apart = [float((depth - bodies.depth[j]).square().mean().sqrt()) for j in keep]
        if len(keep) <= most and all(a > APART * unit for a in apart):
            keep.append(k)
    made = [_in_camera(method, tracks, found, k, cameras) for k in keep]
    if has_trunk(tracks.skeleton) and not found.flat:
        signs = found.scene.uncertain(bodies[torch.tensor(keep, device=bodies.energy.device)])
        facts = made[0].diagnostics
        made[0] = replace(made[0], diagnostics=replace(facts, notes=(*signs, *facts.notes)))
    return replace(made[0], alternatives=tuple(made[1:]))


def _in_camera(method: Method, tracks: Tracks, found: Found, k: int, cameras: Tensor | None) -> Reconstruction:
    """Solution number ``k`` in the camera's frame, whose ``cameras`` (T, 2, 3) may be known."""
    bodies, body = found.bodies, tracks.skeleton
    lifted = found.lifted[int(bodies.origin[k])]
    view, scene = found.view, found.scene
    if scene.any_focal:
        view = View.of(tracks, zoomed(view.lens, float(bodies.focal[k])), scene.rate)
        scene = replace(scene, rays=view.seen_from(found.view, scene.rays))
    intrinsics, look = view.lens, view.look
    points = scene.points(bodies, k) @ look
    points = body.complete(points[:, : body.num_observed])[0]
    root = points[..., 2].mean(-1)
    factor = intrinsics.focal / root.log().mean().exp()
    points, root = points * factor, root * factor
    n = body.num_observed  # virtual joints are means of others in the image, too, which no projection is
    images = intrinsics.project(points)
    off = (images - tracks.points)[:, :n][tracks.seen[:, :n]]
    points = torch.cat([points[..., :2], points[..., 2:] - root[:, None, None]], -1)
    if cameras is None:
        cameras = (_turn(lifted, points, look) @ complete_rotation(lifted.cameras))[:, :2]
    turn = float(viewpoint_turn(cameras))
    facts = replace(
        lifted.diagnostics,
        viewpoint_turn=turn,
        converged=found.settled(k),
        iterations=found.steps,
        reprojection_rms=float(off.square().sum(-1).mean().sqrt()),
        doubt=_doubt(method, found, k, turn),
    )
    unsure = None if lifted.uncertainty is None else lifted.uncertainty * factor
    if unsure is not None and scene.any_focal and not detected(tracks):
        unsure = unsure.hypot(leaning(points, tracks, imaged=scene.usual is not None))
    made = replace(
        lifted,
        points=points,
        cameras=cameras,
        scales=intrinsics.focal / root,
        tracks=tracks,
        diagnostics=facts,
        uncertainty=unsure,
        objective=float(bodies.energy[k]),
        root_depth=root - root[0],
        distance=root,
        intrinsics=intrinsics,
        alternatives=(),
    ).remeasured()
    notes = _notes_on_solution(method, found, k, made, images)
    varies = f": the body's distance varies by a factor of {root.amax() / root.amin():.2f}" if len(root) > 1 else ""
    notes.append(f"full perspective{varies}")
    if scene.any_focal:
        notes.append(lens_note(intrinsics, tracks.units))
    return replace(made, diagnostics=replace(made.diagnostics, notes=tuple(notes)))


def _turn(lifted: Reconstruction, points: Tensor, look: Tensor) -> Tensor:
    """Rotations (T, 3, 3) from the frame of what was lifted to the camera's, by which refinement turned the trunk.

    Args:
        lifted: along the lines of sight.
        points: (T, N, 3) that it became in the camera's frame.
        look: (T, 3, 3) from the camera's frame to the lines of sight; inverted where there is no trunk to go by.
    """
    if not has_trunk(lifted.skeleton):
        return look.mT
    frame = usual_posture(lifted.skeleton, points.dtype, points.device).frame
    turn = frame(points) @ frame(lifted.points).mT
    return torch.where(torch.linalg.det(turn)[:, None, None] > 0.5, turn, look.mT)


def in_every_solution(result: Reconstruction, change: Callable[[Reconstruction], Reconstruction]) -> Reconstruction:
    """A result with a change made to it and to each of its alternatives."""
    return replace(change(result), alternatives=tuple(map(change, result.alternatives)))


def noted(result: Reconstruction, *notes: str) -> Reconstruction:
    """A result with further notes on every solution."""

    def change(one: Reconstruction) -> Reconstruction:
        return replace(one, diagnostics=replace(one.diagnostics, notes=(*one.diagnostics.notes, *notes)))

    return in_every_solution(result, change)


def timed(result: Reconstruction, seconds: float) -> Reconstruction:
    """A result that took so long, all of its solutions together."""

    def change(one: Reconstruction) -> Reconstruction:
        return replace(one, diagnostics=replace(one.diagnostics, seconds=seconds))

    return in_every_solution(result, change)


def leaning(points: Tensor, tracks: Tracks, *, imaged: bool) -> Tensor:
    """Standard deviation (T, N) of depths for the direction from which points (T, N, 3) are seen, the lens being found.

    Where nothing is known of the image, the camera is taken to look at the tracks' middle. Of a detector's tracks the
    method allows for as much by itself.
    """
    angle = HEADING if not imaged else ASIDE if tracks.image_size is None else LEAN
    flat = points[..., :2]
    return angle * (flat - flat.mean(-2, keepdim=True)).norm(dim=-1)


def _one_side(bodies: Bodies) -> bool:
    """Whether lengths, seen along the rays, tell the best body from mirror images as known cameras do not."""
    turned = (bodies.depth * bodies.depth[0]).sum((1, 2)) < 0
    return not bool((turned & (bodies.energy < bodies.energy[0] + CLOSE)).any())


def _doubt(method: Method, found: Found, k: int, turn: float) -> str:
    """Why depth of solution number ``k``, seen from viewpoints that turn by so many degrees, is hardly to be believed.

    What the method doubts holds of its best solution, unless the rays tell better.
    """
    first, tracks = found.lifted[0].diagnostics, found.lifted[0].tracks
    if first.doubt == nothing_else(method, tracks, first.viewpoint_turn):  # by the turn before the lens was known
        return nothing_else(method, tracks, turn)
    told = first.doubt == UNSIDED and not found.flat and _one_side(found.bodies)
    return "" if k or told else first.doubt


def _notes_on_solution(method: Method, found: Found, k: int, made: Reconstruction, images: Tensor) -> list[str]:
    """What is said of solution number ``k``: what the method said of the tracks, and what is true of this one."""
    tracks, facts, before = made.tracks, made.diagnostics, found.lifted[0].diagnostics.doubt
    # True of what was lifted, perhaps not of this; straightened tracks do not leap where a film was cut.
    stale = [WHY_LOOSE, UNHELD, HARDLY, SINGLE, SEEMS_NEAR, BY_SHOTS, "weak perspective", "did not settle"]
    if k or not found.flat:
        stale.append(SEE_OTHERS)
    notes = [
        note
        for note in found.notes
        if not note.startswith((ABSENT, FOUND)) and note != before and not any(part in note for part in stale)
    ]
    notes += note_on_cuts(found.view.cuts)
    if not facts.converged:
        notes.append(method.unsettled(found.steps))
    notes += on_turn(method, tracks, facts.viewpoint_turn, facts.doubt)
    if facts.doubt:
        notes.append(facts.doubt)
    notes += loose_lengths(method, facts.bone_variation)
    clips = Clips.of([tracks])
    return notes + what_is_wrong(method, tracks.skeleton, clips, made.points[None], images[None], [facts.converged])[0]
