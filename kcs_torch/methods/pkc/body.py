"""A body with a template: how its hypotheses are ranked and polished, and what they tell of the viewpoint."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from kcs_torch.functional.align import nearest_rotation
from kcs_torch.functional.camera import viewpoint_turn
from kcs_torch.functional.chain import bone_lengths
from kcs_torch.functional.guarded import or_one
from kcs_torch.functional.ranks import median
from kcs_torch.functional.temporal import blend_windows, window_starts
from kcs_torch.methods.clips.lockstep import Search
from kcs_torch.methods.clips.template import guessed
from kcs_torch.methods.pkc.assembly import TIGHT
from kcs_torch.methods.pkc.descents import Descent
from kcs_torch.methods.pkc.gaps import fill_gaps, gaps_of, usual_noise
from kcs_torch.methods.pkc.hypotheses import Hypotheses, refined
from kcs_torch.methods.pkc.moving_search import soften
from kcs_torch.methods.pkc.objective import Objective, bone_noise, usual_posture
from kcs_torch.methods.pkc.trunk import image_scale
from kcs_torch.methods.pkc.weights import Weights, at_pace, pace_of
from kcs_torch.skeleton import Skeleton
from kcs_torch.solvers.camera_path import choose_path, view_energy
from kcs_torch.solvers.lm import fit_bones
from kcs_torch.solvers.procrustean import COARSE, FINE, Pose, Stage, align_rotations

__all__ = ["LONG", "ONE", "POLISH", "TOLD", "TURNING", "Body", "agree"]

HOLD, DAMPING = 10, 2.0
"""Levenberg-Marquardt steps that make bones constant, and their damping: undamped, a bone that is short beside what its
joints have to move (a heel, a finger) turns back and forth and never settles."""

FRAMES = 4096
"""Frames of hypotheses whose bones are made constant at a time."""

POLISH = (FINE[0], Stage(1e-5, 100, 0.01, 1.0, 0.003))
"""The moving viewpoint's fine stages without the middle one, and with more steps in the last."""

CLOSE, RIVALS = 10.0, 3
"""By how much solutions may be dearer than the best to be polished as well, and how many of its own kind are."""

BEHIND = 3.0
"""By how much a rival is dearer before the last stage if it is to go no further: rivals seldom come nearer by 1."""

HELD = 0.08
"""Standard deviation by which polishing may move a depth, for a body of 1.75, each joint in each frame by itself."""

ONE = 20.0
"""Frames that count as one in what rivals are chosen by: errors of the changes last."""

LEVEL = 0.0003
"""Least noise, a share of the body's size, of tracks that are not exact throughout."""

LONG, OVERLAP = 2000, 40
"""Frames of a clip that are polished together, and by how many such blocks overlap."""

TURNING = 60.0
"""Degrees of the trunk's turn, as the template tells it, from which on the viewpoint's turn tells depth better."""

ODD, LITTLE = 0.115, 30.0
"""Root mean square, of the logarithm, by which lengths stray from the template's where it is of another body: people
stray by .07 to .11. The viewpoint's turn tells depth better than such a template from so many degrees on."""

LEAD, LESS = 10.0, 3.0
"""By how much what was found without a template of another body must be better, and how much less that one counts. A
guessed template has no such lead."""

TOLD = 3.0
"""By how much a mirror image must be dearer for known cameras to rule it out: of what they rule out so in 2000 motions,
96 % are mirror images (docs/pkc_tracks.md)."""


class Body:
    """One clip of a body with a template, in the template's units.

    Args:
        skeleton: with a template, spreads and a trunk.
        image: (T, N, 2), complete, centred per frame.
        rate: frames a second.
        noise: (T, N) standard deviation of the joints in the image.
        standing: (T, C) how surely the skeleton's contact points stand still, or None where nothing tells.
        pace: of the motion, see :func:`kcs_torch.methods.pkc.weights.pace_of`; None: as the image tells.

    Attributes:
        factor: units of the template per unit of the image.
        image: (T, N, 2), in units of the template.
        objective: that ranks hypotheses, over all frames.
    """

    def __init__(
        self,
        skeleton: Skeleton,
        image: Tensor,
        rate: float,
        noise: Tensor,
        standing: Tensor | None = None,
        pace: float | None = None,
    ) -> None:
        posture = usual_posture(skeleton, image.dtype, image.device)
        rigid = skeleton.rigid_mask(device=image.device)
        scale = image_scale(image, posture.rest_lengths, posture.bones, rigid, bone_noise(noise, posture.bones))
        scale = or_one(scale)
        self.skeleton, self.rate, self.factor = skeleton, rate, 1 / scale
        self.image = image / scale
        self.noise = noise / scale
        self.pace = pace_of(image, skeleton, rate) if pace is None else pace
        weights = at_pace(Weights(), rate, self.pace)
        self.objective = Objective(skeleton, self.image, weights, self.noise, standing=standing)

    def frames(self, depth: Tensor, image: Tensor | None = None) -> Tensor:
        """The trunk's rotations (T, 3, 3), template to camera, of depths (T, N), for all or for some frames' image."""
        image = self.image if image is None else image
        return nearest_rotation(self.objective.posture.frame(torch.cat([image, depth[..., None]], -1)))

    def joints(self, depth: Tensor) -> Tensor:
        """Joints (H, T, N, 3) of depths (H, T, N), in the template's units."""
        return torch.cat([self.image.expand(*depth.shape, 2), depth[..., None]], -1)

    def lengths(self, depth: Tensor) -> Tensor:
        """Median lengths (H, B) of the bones of depths (H, T, N)."""
        return median(bone_lengths(self.joints(depth), self.objective.bones), 1)

    def bodies(self, found: Hypotheses) -> Tensor:
        """Joints (H, T, N, 3) of hypotheses, in units of the image; bones keep their lengths as far as noise allows.

        Where the image is exact, only depth may differ from frame to frame. Where it is not, joints move by the least
        that makes bones as constant as the model takes them to be, which is SfAM's articulated step.
        """
        points = self.joints(found.depth)
        goal = self.objective
        if goal.noisy:
            stiffness = goal.rigid * (goal.noise / goal.weights.length).square()
            few = max(1, FRAMES // len(points))  # each frame is a problem of its own
            parts = zip(points.split(few, 1), stiffness.split(few), strict=True)
            given = (found.lengths[:, None], goal.bones)
            held = [fit_bones(p, *given, stiffness=s, num_steps=HOLD, damping=DAMPING) for p, s in parts]
            points = torch.cat(held, 1)
            points = points - points.mean(-2, keepdim=True)
        return points / self.factor

    def rank(self, depth: Tensor, steps: int) -> Search[Any, Any, Hypotheses]:
        """Depths (H, T, N) from elsewhere, refined on the objective, best first."""
        lengths = self.lengths(depth)
        usual = self.objective.posture.rest_lengths
        lengths = torch.where(lengths > 1e-3 * usual, lengths, usual)
        return (yield from refined(self.objective, Hypotheses(depth, lengths, depth.new_zeros(len(depth))), steps))

    def without_contacts(self, found: Hypotheses) -> Hypotheses:
        """Hypotheses ranked anew, and from now on, without contacts: nothing stands still if the camera turns."""
        energy = found.energy - self.objective.contact(found.depth)
        self.objective.standing = None
        return replace(found, energy=energy)[energy.argsort()]

    def seen_from(self, found: Hypotheses, cameras: Tensor, steps: int) -> Search[Any, Any, Hypotheses]:
        """What known cameras (T, 3, 3) leave of hypotheses and the mirror image of the best, ranked by them as well.

        Left out is what must be a mirror image, however well it goes with the template. A body without left and right,
        such as a hand, may be the mirror image of its template: then all that was found is turned over as it is, but
        for that the cameras have to rule out the other.
        """
        other = replace(found, depth=-found.depth, steps=0)
        if self.skeleton.mirror:
            other = yield from refined(self.objective, other[:1], steps)
        else:
            other = replace(other, energy=other.energy + TOLD)
        found = found.joined(other)
        dearer = self._dearer(found.depth, cameras)
        found = replace(found, energy=found.energy + self._seen_by(found.depth, cameras))
        order = found.energy.argsort()
        left = dearer[order] <= TOLD
        return found[order[left] if bool(left.any()) else order]

    def unsided(self, found: Hypotheses, cameras: Tensor) -> Hypotheses | None:
        """The mirror image of the best, which only the template tells from it: known cameras (T, 3, 3) do not.

        None if they do, or if left and right do, so that the template is to be believed.
        """
        best = found[:1]
        dearer = self._dearer(-best.depth, cameras)
        if self.skeleton.mirror or bool(dearer > TOLD):
            return None
        return replace(best, depth=-best.depth, energy=best.energy + dearer.clamp_min(0), steps=0)

    def _dearer(self, depth: Tensor, cameras: Tensor) -> Tensor:
        """By how much depths (H, T, N) cost more before known cameras (T, 3, 3) than their mirror images do, (H,)."""
        return self._seen_by(depth, cameras) - self._seen_by(-depth, cameras)

    def _seen_by(self, depth: Tensor, cameras: Tensor) -> Tensor:
        """What depths (H, T, N) cost before known cameras (T, 3, 3), (H,)."""
        return view_energy(self.joints(depth), cameras)

    @property
    def spanned(self) -> bool:
        """Whether bones link all joints, and these do not all lie at one point: what :meth:`polished` needs."""
        return self.skeleton.is_tree and bool(self.image.any())

    def turns(self, found: Hypotheses, least: float = 0.0) -> bool:
        """Whether the trunk of the best hypothesis turns far enough to tell depth better than the template does.

        That is by 60 degrees, or 30 of a body unlike its template, and by no less than ``least``.
        """
        return self._turn(found) >= max(LITTLE if self.is_odd(found) else TURNING, least)

    def stays(self, found: Hypotheses) -> bool:
        """Whether it hardly turns, so that signs hardly change where an unseen joint is in the image."""
        return self._turn(found) < LITTLE

    def sways(self, found: Hypotheses) -> bool:
        """Whether it turns far enough for aligned bones to tell depth as well as the template does, not better."""
        return LITTLE <= self._turn(found) < TURNING

    def _turn(self, found: Hypotheses) -> float:
        return float(viewpoint_turn(self.frames(found.depth[0])[:, :2]))

    def is_odd(self, found: Hypotheses) -> bool:
        """Whether the best hypothesis is a body of other proportions than the template's."""
        return self.objective.oddity(found.lengths[0]) > ODD

    def seen_from_around(self, found: Hypotheses) -> bool:
        """Whether a camera that goes round the body explains how the best hypothesis turns."""
        frames = self.frames(found.depth[0])
        if float(viewpoint_turn(frames[:, :2])) < TURNING / 2:  # no path that explains them turns twice as far
            return False
        path, kind, _ = choose_path(frames)
        return kind != "free" and float(viewpoint_turn(path[:, :2])) >= TURNING

    def polished(
        self, found: Hypotheses, steps: int, other: Tensor | None = None, cameras: Tensor | None = None
    ) -> Search[Any, Any, Hypotheses]:
        """Hypotheses, the best refined on the log-determinant of aligned bones' changes, and of the bones themselves.

        What the objective counts for a few frames only, these count for all. Changes take away what moves each bone by
        itself. Before a viewpoint that turns, aligned bones tell depth better than the template does, and together with
        it which of close rivals is best; ``other`` depths (T, N), or their mirror image, are a rival then, too, if they
        come as near in ``steps`` on the objective, and before ``cameras`` (T, 3, 3) that hypotheses were ranked by.
        Those that are dearer by far before the last stage are not refined by it. Energies stay those before, in their
        order.
        """
        around = self.turns(found)
        close = (found.energy - found.energy[0] < CLOSE) & ((found.depth * found.depth[0]).sum((1, 2)) > 0)
        close[0] = True  # of mirror images, which cost the same here, only the objective tells the right one
        pick = close.nonzero().flatten()[: RIVALS if around else 1]
        rivals = found[pick]
        if around and other is not None:
            other = alike(other, found.depth[0])[None]
            ranked = yield from self.rank(other, steps)
            if cameras is not None:
                ranked = replace(ranked, energy=ranked.energy + self._seen_by(ranked.depth, cameras))
            dearer = ranked.energy - found.energy[0]
            if self.is_odd(found):
                lead = 0.0 if guessed(self.skeleton) else LEAD
                rivals = rivals.joined(replace(ranked, depth=other, energy=found.energy[0] + lead + dearer / LESS))
            elif bool(dearer[0] < CLOSE):
                rivals = rivals.joined(replace(ranked, depth=other))
        stages = (COARSE[-1], *POLISH) if around else POLISH
        depth, image, value = yield from self.descended(rivals.depth, stages, rivals.energy)
        lengths = self.lengths(depth)
        best = (rivals.energy + value / ONE).argsort()[: len(pick)]
        return replace(
            found,
            depth=found.depth.index_copy(0, pick, depth[best]),
            lengths=found.lengths.index_copy(0, pick, lengths[best]),
            image=None if image is None else image[best[0]],
        )

    def filled(self, polished: Tensor) -> Body:
        """The same body with its gaps filled as a polished image (T, N, 2) has them."""
        image, noise = fill_gaps(self.image, polished, self.noise)
        return Body(self.skeleton, image / self.factor, self.rate, noise / self.factor, self.objective.standing)

    def descended(
        self, depth: Tensor, stages: tuple[Stage, ...], energy: Tensor | None = None
    ) -> Search[Any, Any, tuple[Tensor, Tensor | None, Tensor]]:
        """Depths (H, T, N) after stages of the moving viewpoint's descent, in blocks of long clips, and its values.

        Where joints are unseen here and there, their images (H, T, N, 2) as well. Rivals, which have an ``energy`` (H,)
        beside these values, go through the last stage only if they still may win.
        """
        skeleton, bones, frames = self.skeleton, self.objective.bones, len(self.image)
        size = self.image.square().mean().sqrt()
        level = usual_noise(self.noise) / float(size)
        if self.objective.noisy:  # where gaps were filled, at least
            level = max(level, LEVEL)
        sure = (level * size / self.noise.clamp_min(level * size)).square() if level > 0 else None
        points = self.joints(depth) / size
        turned = align_rotations(points, torch.stack([self.frames(one) for one in depth]), bones)
        rigid, soft = bones[list(skeleton.rigid)], tuple(soften(stage, level) for stage in stages)
        anchor = float(size / HELD) ** 2
        starts = window_starts(frames, min(LONG, frames), min(OVERLAP, frames - 1))
        depths, images, value = [], [], depth.new_zeros(len(depth))
        gaps = bool(gaps_of(self.noise).any())
        for some in (slice(first, first + LONG) for first in starts):
            weights = None if sure is None else sure[some]
            one = Descent(
                self.image[some] / size, points[:, some], turned[:, some], bones, weights, rigid,
                TIGHT, level, soft, anchor,
            )  # fmt: skip
            pose = yield from _raced(one, energy if len(starts) == 1 else None)
            depths.append(pose.points[..., 2].transpose(0, 1) * size)  # (T, H, N)
            if gaps:
                images.append(pose.points[..., :2].transpose(0, 1).flatten(2) * size)
            value = value + pose.objective
        depth = blend_windows(torch.stack(depths), starts, frames).transpose(0, 1)
        depth = depth[..., : skeleton.num_observed] @ self.objective.complete
        image = None
        if gaps:
            image = blend_windows(torch.stack(images), starts, frames).transpose(0, 1).unflatten(2, (-1, 2))
        return depth - depth.mean(-1, keepdim=True), image, value


def _raced(task: Descent, energy: Tensor | None) -> Search[Any, Any, Pose]:
    """Starts after all stages; rivals that are dearer by far, by energy (H,) and value, go without the last."""
    if energy is None or len(energy) == 1:
        (pose,) = yield [task]
        return pose
    (pose,) = yield [replace(task, stages=task.stages[:-1])]
    cost = energy + pose.objective / ONE
    near = cost < cost.amin() + BEHIND
    near[cost.argmin()] = True  # also of costs that are not finite
    near = near.nonzero().flatten()
    last = replace(task, points=pose.points[near], rotations=pose.rotations[near], held=task.points[near, ..., 2])
    (best,) = yield [replace(last, stages=task.stages[-1:])]
    more = (best.objective - pose.objective[near]).amax()  # with it the others stay behind
    pose = replace(pose, objective=pose.objective + more)
    parts = zip(vars(pose).values(), vars(best).values(), strict=True)
    return Pose(*(values.index_copy(0, near, some) for values, some in parts))


def alike(depth: Tensor, other: Tensor) -> Tensor:
    """Depths, or their mirror image if that is more like the others."""
    return torch.where((depth * other).sum() < 0, -depth, depth)


def agree(depth: Tensor, other: Tensor, share: float) -> bool:
    """Whether depths, or their mirror image, differ from the others by a share of these at most, root mean square."""
    return bool((alike(depth, other) - other).square().sum() <= share**2 * other.square().sum())
