"""The moving viewpoint's solutions as an answer: their sign, how sure depths are, and what to warn of."""

from __future__ import annotations

import math
from dataclasses import replace

import torch
from torch import Tensor

from kcs_torch.functional.camera import complete_rotation, viewpoint_turn
from kcs_torch.methods.answer.finish import Estimate
from kcs_torch.methods.answer.wrong import loose_bones
from kcs_torch.methods.pkc.body import TOLD
from kcs_torch.methods.pkc.leaps import leaps_of
from kcs_torch.methods.pkc.moving_solutions import MovingView, agreement
from kcs_torch.skeleton import Skeleton
from kcs_torch.solvers.camera_path import view_energy
from kcs_torch.solvers.procrustean import COARSE, FINE

__all__ = ["MOVING_STEPS", "STILL", "from_moving"]

MOVING_STEPS = sum(stage.num_steps for stage in (*COARSE, *FINE))
"""L-BFGS steps of the moving viewpoint's solver, at most."""

STILL = 0.01
"""A solution has settled where the last ten steps (fewer tell nothing) moved depths by no more than so much, root mean
square: a share of the body's size."""

DOUBT = 0.7
"""Correlation with SfAM's depths below which those of the moving viewpoint are a guess. Before cameras that turn by 180
degrees it is above .95 for people, dogs and hands, by 60 about .8, by none .3 and less; of robots, whose joints turn
about fixed axes, it says little."""

APART = math.sqrt(2)
"""How far depths are off that have nothing to do with the true ones, over their size. They are taken to be off by the
share of this that the correlation lacks: of what agrees by .9, joints are off by a seventh of the body's depth."""

LEAD = 6.0
"""Lead of a solution whose bones are held to their lengths (see :class:`MovingView`) that is as sure as full agreement:
of 47 views of robot arms, real and random, 14 had one, and 12 of these had a tenth of a flat guess's error or less."""

CLOSE = 1.0
"""Lead below which a solution is doubted whatever else agrees with it: of 16 views of robot arms and random chains with
less, 15 had more than a fifth of a flat guess's error, and 6 of these no other doubt."""

BROKEN = 0.65
"""How sure a solution is at most, 1 being full agreement, that does not keep the lengths of rigid bones, whose
viewpoint turns by less than it should, or that another one rivals."""

TURN = 60.0
"""Degrees by which the viewpoint should turn about a body: of a solution that turns by less, depth may be drawn out as
far as its turn is too small, and other methods follow it there."""

NEEDED = f"The viewpoint should turn about the body by {TURN:g} degrees or more, or the skeleton have a template"
"""What would tell depth."""


def from_moving(
    moving: MovingView,
    first: Estimate,
    skeleton: Skeleton,
    cameras: Tensor | None,
    notes: tuple[str, ...],
    *,
    alternatives: int,
) -> Estimate:
    """Return the estimate and so many alternatives at most: its mirror image, and solutions that are hardly dearer.

    Nothing but known cameras tells a solution from its mirror image. Where the viewpoint hardly turns the objective has
    many minima. SfAM, which looks for depth in another way, then finds other depths: how far both agree is how far
    depth is to be believed. Of few bones that are held to their lengths, many solutions have been compared: one that
    leads by far needs no other witness, and one that hardly leads is doubted all the same. Where bones that are rigid
    change their length, the solution is wrong.
    """
    (best, told), *more = (_upright(moving, k, cameras) for k in range(len(moving.value)))
    rivals = [one for one, _ in more]
    depth = best.points[..., 2]
    shown = math.inf if cameras is not None else float(viewpoint_turn(best.cameras))
    agree = agreement(depth, first.points[..., 2])
    sure = witnessed = max(agree, moving.lead / LEAD)
    rivalled = moving.rivalled or 0 < moving.lead < CLOSE
    leaps = leaps_of(depth[None])[0].nonzero().flatten().tolist()
    if loose_bones(best.points, skeleton) or shown < TURN or rivalled or leaps:  # another warning tells of the first
        sure = min(sure, BROKEN)
    lack = APART * max(0.0, 1 - sure) * depth.square().mean().sqrt()
    needed = NEEDED if shown < TURN else "More joints, a longer clip or a skeleton with a template would decide"
    doubt = ""
    if witnessed < DOUBT:
        doubt = (
            "depth is little more than a guess: two methods find depths that hardly agree "
            f"(correlation {agree:.2f}). {needed}"
        )
    elif leaps:
        doubt = f"depth is uncertain: from frame {leaps[0]} on all joints lie on the other side in depth. {needed}"
    elif shown < TURN:
        few = f"the viewpoint turned by only {math.floor(shown)} degrees"
        doubt = f"depth may be drawn out or pressed flat: {few}. {needed}"
    elif rivalled:
        where = "" if moving.rivalled else " (see the alternatives)"
        doubt = f"depth is uncertain: bodies that differ fit the tracks nearly as well{where}. {needed}"

    best, *rivals = (_unsurer(one, lack) for one in (best, *rivals))
    best = replace(best, notes=notes, doubt=doubt)
    others = []
    if not told and alternatives > 0:
        flip = best.points.new_tensor([1.0, 1.0, -1.0])
        seen = best.cameras if cameras is not None else best.cameras * flip
        said = ("the mirror image in depth", *notes)
        others.append(replace(best, points=best.points * flip, cameras=seen, notes=said, doubt=""))
    said = ("another body that fits the tracks nearly as well", *notes)
    others += [replace(other, notes=said) for other in rivals]
    return replace(best, alternatives=tuple(others[:alternatives]))


def _upright(moving: MovingView, index: int, cameras: Tensor | None) -> tuple[Estimate, bool]:
    """One solution, or its mirror image if known cameras tell that it is the right one; and whether they tell."""
    points, turned = moving.pose.points[index], moving.cameras(index)[0]
    path, told = turned, False
    if cameras is not None:
        path, flip = complete_rotation(cameras), points.new_tensor([1.0, 1.0, -1.0])
        right, wrong = view_energy(torch.stack([points, points * flip]), path).tolist()
        points, told = points if right <= wrong else points * flip, abs(right - wrong) > TOLD
    one, settled = torch.ones_like(points[:, 0, 0]), bool(moving.pose.moved[index] <= STILL)
    spread, value = moving.deviation(turned, index), float(moving.value[index])
    return Estimate(points, path[:, :2], one, settled, MOVING_STEPS, deviation=spread, objective=value), told


def _unsurer(one: Estimate, lack: Tensor) -> Estimate:
    """The estimate with a standard deviation that all its depths have beside their own."""
    return one if one.deviation is None else replace(one, deviation=torch.hypot(one.deviation, lack))
