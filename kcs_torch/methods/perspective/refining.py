"""A method's solutions under parallel rays, refined under perspective: one round of full perspective."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from kcs_torch.functional.inference import undifferentiated
from kcs_torch.methods.perspective.parallel_image import body_unit, clean_image, image_noise
from kcs_torch.methods.perspective.scene import STEPS, Bodies, Scene, ahead
from kcs_torch.methods.perspective.view import View, slow_part
from kcs_torch.methods.pkc.limbs import outward
from kcs_torch.methods.pkc.long_gaps import time_seen
from kcs_torch.methods.pkc.moving_answer import STILL
from kcs_torch.types import Reconstruction, Tracks

__all__ = ["Found", "refine", "refine_again", "seen_along", "with_feet"]

FLAT = 0.0003
"""Root mean square parallax, for a body of 1.75, below which there is no perspective to speak of."""

SAME = 0.1
"""Change of the focal length's logarithm up to which a lens shows what another one did."""


@dataclass(frozen=True)
class Found:
    """Solutions of one round, best first.

    Attributes:
        bodies: of the solutions.
        lifted: the method's solutions that they came from, perhaps mirrored.
        scene: that they explain.
        view: whose rays are the scene's.
        flat: whether there was no perspective to speak of, so that they are the method's own.
        notes: of the method on the tracks, whichever of its solutions is best here.
        through: focal length through which flips of runs of signs were last looked for, or None.
    """

    bodies: Bodies
    lifted: tuple[Reconstruction, ...]
    scene: Scene
    view: View
    flat: bool
    notes: tuple[str, ...] = ()
    through: float | None = None

    def settled(self, k: int) -> bool:
        """Whether solution number ``k`` has settled: along rays, whatever it did before."""
        if self.flat:
            return self.lifted[int(self.bodies.origin[k])].diagnostics.converged
        return bool(self.bodies.moved[k] <= STILL)

    def usual(self, view: View) -> float | None:
        """Focal length of usual lenses, over that of a view; None where nothing tells."""
        return None if self.scene.usual is None else self.scene.usual * self.view.lens.focal / view.lens.focal

    @property
    def steps(self) -> int:
        """Steps of the refinement that made the solutions what they are."""
        return self.lifted[0].diagnostics.iterations if self.flat else STEPS


def seen_along(view: View, lifted: Reconstruction, distance: Tensor, straight: Tracks) -> Reconstruction:
    """A method's solution of tracks under parallel rays as one of the same tracks straightened, at distances (T,)."""
    scales = lifted.scales * distance / view.lens.focal
    flat = view.along(clean_image(lifted)) * distance[:, None, None]
    middle = flat.mean(1, keepdim=True)
    points = torch.cat([middle + (flat - middle) / scales[:, None, None], lifted.points[..., 2:]], -1)
    return replace(lifted, points=points, scales=scales, tracks=straight)


@undifferentiated
def refine(
    lifted: Reconstruction,
    view: View,
    distance: Tensor,
    depth: Tensor,
    rate: float,
    standing: Tensor | None,
    unit: float | None,
    *,
    mirror: bool,
    flips: bool,
    any_focal: bool,
    usual: float | None = None,
) -> Found:
    """Refine all solutions of the method under perspective, and the best one's mirror image.

    Args:
        lifted: the method's solutions, of straightened tracks.
        view: of the tracks.
        distance: (T,) by which they were straightened.
        depth: (T, N) by which they were straightened.
        rate: frames a second.
        standing: (T, C) how surely contact points stand still, or None.
        unit: of bodies found before, so that energies compare; that of the lifted one if None.
        mirror: whether depth may have the other sign.
        flips: whether runs of depths may have.
        any_focal: whether the view's focal length is to be found.
        usual: focal length of usual lenses, over the view's; None where nothing tells.
    """
    others = (lifted, *lifted.alternatives)
    flat = clean_image(lifted)
    rays = flat / ahead(distance, depth)[..., None]
    start = torch.stack([o.points[..., 2] for o in others])
    start = start - start.mean(-1, keepdim=True)
    own = body_unit(lifted)
    unit = unit or own
    scales = lifted.scales.clamp_min(1e-9).log()[:, None]
    scales = slow_part(scales, rate, view.cuts)[:, 0].exp()  # a method's own may jump
    noise = image_noise(lifted.tracks, flat, own)
    scene = Scene(outward(lifted.skeleton), rays, noise, rate, unit, standing, view.cuts, usual=usual)
    parallax = float((rays.norm(dim=-1) * start[0]).square().mean().sqrt()) / own
    if parallax < FLAT or not lifted.skeleton.num_bones:
        energy = start.new_tensor([o.objective for o in others])
        number = torch.arange(len(start), device=start.device)
        far = (distance / lifted.scales).expand(len(start), -1)
        bodies = Bodies(start, far, energy, number, torch.ones_like(energy), torch.zeros_like(energy))
        return Found(bodies, others, scene, view, True, lifted.diagnostics.notes)
    if mirror:
        others, start = (*others, lifted.mirrored()), torch.cat([start, -start[:1]])
    distance, start = distance / scales * (unit / own), start * (unit / own)
    scene, bodies = _refined(scene, distance, start, lifted.tracks, flips, any_focal)
    return Found(bodies, others, scene, view, False, lifted.diagnostics.notes)


@undifferentiated
def refine_again(found: Found, view: View, standing: Tensor | None, flips: bool) -> Found:
    """Refine what was found with its focal length, from the view through such a lens.

    Runs of signs that nothing bettered through nearly the same lens are not looked over again.
    """
    focal, before = view.lens.focal, found.through
    flips = flips and (before is None or abs(math.log(focal / before)) > SAME)
    bodies = found.bodies[found.bodies.energy.isfinite()]
    rays = view.seen_from(found.view, found.scene.rays)
    scene = replace(found.scene, rays=rays, standing=standing, any_focal=False, usual=found.usual(view))
    origin = bodies.origin
    seen = found.lifted[0].tracks
    scene, bodies = _refined(scene, bodies.distance[0], bodies.depth, seen, flips, any_focal=True)
    bodies = replace(bodies, origin=origin[bodies.origin])
    through = focal if flips else before
    return replace(found, bodies=bodies, scene=scene, view=view, through=through)


@undifferentiated
def with_feet(found: Found, standing: Tensor | None) -> Found:
    """What was found with its focal length, the best body once more, with feet that stand still, through this lens.

    Args:
        found: with a focal length.
        standing: as of :func:`refine`.
    """
    scene, bodies = replace(found.scene, standing=standing), found.bodies
    if standing is None or not bool((standing > 0).any() & bodies.energy[0].isfinite()):
        return found
    time = time_seen(found.lifted[0].tracks)
    start = bodies.distance[0, time], bodies.depth[:1, time], bodies.focal[:1]
    best = scene.during(time).refined(*start, same_focal=True)
    best = replace(best.held(time.start, len(scene.rays)), origin=bodies.origin[:1])
    return replace(found, scene=scene, bodies=_led_by(best, bodies))


def _led_by(best: Bodies, bodies: Bodies) -> Bodies:
    """``best`` in place of the first of bodies, from which it was refined; the others stay as far behind."""
    rest = replace(bodies[1:], energy=bodies.energy[1:] + (best.energy - bodies.energy[:1]))
    return best.joined(rest)


def _refined(
    scene: Scene, distance: Tensor, depth: Tensor, tracks: Tracks, flips: bool, any_focal: bool
) -> tuple[Scene, Bodies]:
    """Bodies refined from depths (H, T, N) at a distance (T,), best first; and the scene that they explain.

    Frames before the body is first seen, and after it was last seen, are held: a body that stands still in them would
    tell as much of the lens, and of usual postures, as one that moves. In gaps it moves on, so that these are refined.
    """
    # A foot that comes along its ray seems to stand still, and would make the focal length too short.
    goal = replace(scene, any_focal=True, standing=None) if any_focal else scene
    time = time_seen(tracks)
    bodies = _settled(scene.during(time), goal.during(time), distance[time], depth[:, time], flips)
    return goal, bodies.held(time.start, len(scene.rays))


def _settled(scene: Scene, goal: Scene, distance: Tensor, depth: Tensor, flips: bool) -> Bodies:
    """Bodies refined in a scene, with runs of signs turned over if they may be, and then the best one in the goal."""
    bodies = scene.refined(distance, depth)
    if flips:
        bodies = scene.turned_over(bodies)
    if not goal.any_focal:
        return bodies
    best = goal.refined(bodies.distance[0], bodies.depth[:1])
    return _led_by(replace(best, origin=bodies.origin[:1]), bodies)
