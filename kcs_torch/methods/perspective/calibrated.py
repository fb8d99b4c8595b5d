"""Full perspective for any method: undo it, lift as if the camera were far away, and again until both agree."""

from __future__ import annotations

import math
import time
import warnings
from dataclasses import replace

import torch
from torch import Tensor

from kcs_torch.clean.detector import detected
from kcs_torch.errors import KcsWarning, users_level
from kcs_torch.functional.camera import complete_rotation, viewpoint_turn
from kcs_torch.functional.inference import undifferentiated
from kcs_torch.methods.answer.root import standing_feet
from kcs_torch.methods.base import Method, apart, check_cameras
from kcs_torch.methods.perspective.answer import assemble, timed
from kcs_torch.methods.perspective.parallel_image import body_unit
from kcs_torch.methods.perspective.refining import Found, refine, refine_again, seen_along, with_feet
from kcs_torch.methods.perspective.scene import BLOCK, GAIN, ahead
from kcs_torch.methods.perspective.view import View, zoomed
from kcs_torch.methods.pkc.near import SEEMS_NEAR
from kcs_torch.methods.sfam import SfAM
from kcs_torch.nn.posture import has_trunk
from kcs_torch.types import Intrinsics, Reconstruction, Tracks, as_floats

__all__ = ["WIDE", "feet_on_ground", "reconstruct_perspective"]

ROUNDS, FOCAL_ROUNDS = 3, 4
"""Rounds, at most, of lifting and refining through a lens that is known, of which one is enough through one that is
not; and of refining alone, where the focal length is found."""

SETTLED = 0.01
"""Root mean square change of depth, for a body of 1.75, below which no further round is made."""

STILL = 2.0
"""Degrees of the turn of known cameras from which on feet that stand still in the image need not stand still."""

SOFT = 8
"""Rounds of SfAM, at most, that come first where no template helps: straightened by wrong depths, tracks do not fit
bones of constant length, which PKC insists on."""

CLOSE = 6.0
"""Distance, for a body of 1.75, below which tracks straightened anew, through the lens that was found, tell more."""

WIDE = 3.0
"""Tangent of the angle off the optical axis from which on the focal length is hardly true."""


def reconstruct_perspective(
    method: Method,
    tracks: Tracks,
    intrinsics: Intrinsics,
    cameras: Tensor | None = None,
    *,
    lifted: Reconstruction | None = None,
    guessed: float | None = None,
) -> Reconstruction:
    """Reconstruct a body before a pinhole camera by a method made for parallel rays.

    A virtual camera looks at the body along its line of sight, ray by ray (u, v). At the distance D_t, a joint of
    relative depth z lies at (u, v) (D_t + z): its image under parallel rays. Starting from z = 0 and D_t from the
    body's apparent size, each round lifts these tracks by the method, then refines depths, lengths and distances of all
    its solutions and of a mirror image together under perspective (:class:`PinholeEnergy`); bones' constant lengths
    tell mirror images apart, and so do feet that stand still. Where the method looks for runs of wrong signs, and the
    body has a template, they are turned over (:meth:`Scene.turned_over`). Where PKC knows no template, up to
    eight rounds of SfAM go before its own: it does not insist on lengths while depths are still wrong.

    Args:
        method: any.
        tracks: in pixels, or in whatever unit the intrinsics have.
        intrinsics: of the camera.
        cameras: (T, 2, 3) known camera rows, world to camera.
        lifted: what the method found in the tracks as if rays were parallel. The focal length is then to be found as
            well, from that of the intrinsics on, and noted; each round refines what the one before found, as its focal
            length shows it. Exact tracks whose first search ended early are lifted anew once, in the end.
            The best body is then refined with feet that stand still.
        guessed: focal length of usual lenses, if that of the intrinsics is a guess. Tracks are then lifted through such
            a lens, and the focal length is found together with what was found through it, and noted; feet as above.
            Exact tracks of a body that is close then are lifted anew once.

    Returns:
        The reconstruction in the camera's frame: ``points + (0, 0, distance)`` projects onto the image. Its unit is one
        pixel at the mean distance, which is the focal length then; ``scaled`` makes metres of it.

    Warns:
        KcsWarning: the field of view would be so wide that the focal length is hardly true.
    """
    begin = time.perf_counter()
    with apart([tracks]):
        tracks = method.prepared(tracks)
        result = _reconstruct(method, tracks, intrinsics, cameras, lifted, guessed)
    result = timed(result, time.perf_counter() - begin)
    method.warn(result)
    return result


def _reconstruct(
    method: Method,
    tracks: Tracks,
    intrinsics: Intrinsics,
    cameras: Tensor | None,
    lifted: Reconstruction | None,
    guessed: float | None,
) -> Reconstruction:
    """:func:`reconstruct_perspective` without autograd, on the tracks' device."""
    _warn_of_wide_rays(tracks, intrinsics)
    if cameras is not None:
        cameras = check_cameras(as_floats(cameras, "cameras", 3).to(tracks.points), tracks.num_frames)
    view = View.of(tracks, intrinsics, tracks.rate)
    if lifted is None:
        best = _best_of_rounds(method, tracks, view, cameras, None if guessed is None else guessed / intrinsics.focal)
    else:
        best = _along(tracks, view, cameras, lifted)
    if (guessed is not None or lifted is not None) and not best.flat:
        best = _with_focal(method, tracks, best, cameras)
    searched = method.turns_over and has_trunk(tracks.skeleton) and not detected(tracks) and not best.flat
    if searched and best.scene.any_focal and (_is_close(best) if lifted is None else _ended_early(lifted)):
        best = _lifted_anew(method, tracks, best, cameras)
    if best.scene.any_focal:
        best = with_feet(best, feet_on_ground(tracks, cameras))
    if searched:
        best = replace(best, bodies=undifferentiated(best.scene.polished)(best.bodies))
    return assemble(method, tracks, best, None if cameras is None else cameras.detach().clone())


def _best_of_rounds(method: Method, tracks: Tracks, view: View, cameras: Tensor | None, usual: float | None) -> Found:
    """What is found until depths settle or nothing gets better, arguments as of :func:`reconstruct_perspective`.

    Each round straightens the tracks by the depths and distances of the one before, and lifts them. A ``usual`` focal
    length is as of :func:`refine`; then the lens is a guess, and what more rounds made of it would not last.
    """
    distance, depth = view.first_distance(tracks, tracks.rate), torch.zeros_like(view.rays[..., 0])
    feet = feet_on_ground(tracks, cameras)
    best: Found | None = None
    unit: float | None = None
    soft = SOFT if method.turns_over and not has_trunk(tracks.skeleton) else 0
    rounds = ROUNDS if usual is None else 1
    while rounds > 0:
        straight = _straighten(tracks, view.rays, distance, depth)
        # The tracks of the first round agree with no depths yet: there the method may find signs by itself.
        step = SfAM() if soft else method.following(best is not None and tracks.num_frames <= BLOCK)
        made = _as_unsure(_lift(step, straight, view, cameras), best)
        found = refine(
            made, view, distance, depth, tracks.rate, feet, unit,
            mirror=cameras is None, flips=method.turns_over, any_focal=False, usual=usual,
        )  # fmt: skip
        bodies, unit = found.bodies, None if soft else found.scene.unit
        moved = float((bodies.depth[0] - depth).square().mean().sqrt()) / found.scene.unit
        sound = bool(bodies.energy.isfinite().any())
        if sound:
            distance, depth = bodies.distance[0], bodies.depth[0]
        if soft:
            soft = soft - 1 if sound and moved >= SETTLED else 0
            continue
        rounds -= 1
        better = best is None or bool(bodies.energy[0] < best.bodies.energy[0] - GAIN)
        if better:
            best = found
        if moved < SETTLED or not sound or not better or found.flat:
            break
    assert best is not None
    return best


def _along(tracks: Tracks, view: View, cameras: Tensor | None, lifted: Reconstruction) -> Found:
    """What was lifted under parallel rays, refined along those of a lens together with its focal length."""
    distance, depth = view.first_distance(tracks, tracks.rate), torch.zeros_like(view.rays[..., 0])
    made = seen_along(view, lifted, distance, _straighten(tracks, view.rays, distance, depth))
    given = made, view, distance, depth, tracks.rate, feet_on_ground(tracks, cameras), None
    return refine(*given, mirror=cameras is None, flips=False, any_focal=True)  # signs later: else a guess is confirmed


def _with_focal(method: Method, tracks: Tracks, best: Found, cameras: Tensor | None) -> Found:
    """What is found with its focal length, through the lens that each round asks for, until nothing gets better."""
    feet = feet_on_ground(tracks, cameras)
    for _ in range(FOCAL_ROUNDS):
        before = best.bodies
        view = View.of(tracks, zoomed(best.view.lens, float(before.focal[0])), tracks.rate)
        found = refine_again(best, view, feet, method.turns_over)
        bodies = found.bodies
        # Energies with and without a focal length to be found do not compare.
        if not bool(bodies.energy.isfinite().any()) or (
            best.scene.any_focal and not bool(bodies.energy[0] < before.energy[0])
        ):
            break
        best = found
        if float((bodies.depth[0] - before.depth[0]).square().mean().sqrt()) < SETTLED * found.scene.unit:
            break
    return best


def _is_close(best: Found) -> bool:
    """Whether a body is so close that what was found through a lens that was guessed may hold through no other."""
    return float(best.bodies.distance[0].mean()) < CLOSE * best.scene.unit


def _ended_early(lifted: Reconstruction) -> bool:
    """Whether the search under parallel rays ended before it looked for signs: flips of single runs mend only some."""
    return SEEMS_NEAR in lifted.diagnostics.notes


def _lifted_anew(method: Method, tracks: Tracks, best: Found, cameras: Tensor | None) -> Found:
    """What the method finds in tracks straightened by the best body so far, through its lens, if that is better."""
    view = View.of(tracks, zoomed(best.view.lens, float(best.bodies.focal[0])), tracks.rate)
    distance, depth = best.bodies.distance[0], best.bodies.depth[0]
    made = _as_unsure(_lift(method, _straighten(tracks, view.rays, distance, depth), view, cameras), best)
    given = made, view, distance, depth, tracks.rate, feet_on_ground(tracks, cameras), best.scene.unit
    found = refine(*given, mirror=cameras is None, flips=True, any_focal=True, usual=best.usual(view))
    return found if bool(found.bodies.energy[0] < best.bodies.energy[0] - GAIN) else best


def _as_unsure(lifted: Reconstruction, before: Found | None) -> Reconstruction:
    """A solution whose deviations are no less than before: straightened tracks confirm what straightened them."""
    first = None if before is None else before.lifted[0]
    if first is None or first.uncertainty is None or lifted.uncertainty is None:
        return lifted
    least = first.uncertainty * (body_unit(lifted) / body_unit(first))
    return replace(lifted, uncertainty=lifted.uncertainty.maximum(least))


def _warn_of_wide_rays(tracks: Tracks, intrinsics: Intrinsics) -> None:
    """Tell where a focal length makes rays lie so far off the optical axis that its unit seems wrong."""
    rays = intrinsics.rays(tracks.points)  # (T, N, 3)
    if bool(tracks.seen.any()) and float(rays[tracks.seen][:, :2].norm(dim=-1).median()) > WIDE:
        warnings.warn(
            f"{tracks.source}: half of all joints lie more than {math.degrees(math.atan(WIDE)):.0f} degrees off the "
            f"optical axis: is the focal length {intrinsics.focal:g} in the tracks' unit ({tracks.units})?",
            KcsWarning,
            stacklevel=users_level(),
        )


def feet_on_ground(tracks: Tracks, cameras: Tensor | None) -> Tensor | None:
    """How surely contact points stand still, (T, C); None where cameras (T, 2, 3) are known to turn."""
    return standing_feet(tracks) if cameras is None or float(viewpoint_turn(cameras)) < STILL else None


def _straighten(tracks: Tracks, rays: Tensor, distance: Tensor, depth: Tensor) -> Tracks:
    """The tracks under parallel rays, of a body at distances (T,) with relative depths (T, N)."""
    n = tracks.skeleton.num_observed
    own = torch.where(tracks.seen[..., None], rays * ahead(distance, depth)[..., None], torch.zeros_like(rays))
    points, weights = tracks.skeleton.complete(own[:, :n], tracks.weights[:, :n])
    return replace(tracks, points=points, weights=weights, detector=detected(tracks))  # told once for all rounds


def _lift(method: Method, straight: Tracks, view: View, cameras: Tensor | None) -> Reconstruction:
    """A method's solution of straightened tracks, about which nothing is warned of yet.

    They are prepared: what a method leaves out of the image says nothing here, and would be told of to nobody.
    """
    known = None if cameras is None else (view.look @ complete_rotation(cameras))[:, :2]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", KcsWarning)
        return method.of_prepared(straight, known, time.perf_counter())
