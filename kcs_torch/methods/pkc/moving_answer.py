"""The moving viewpoint's solutions as an answer: their sign, how sure depths are, and what to warn of."""

from __future__ import annotations

import math
from dataclasses import replace

import torch
from torch import Tensor

from kcs_torch.functional.camera import complete_rotation, viewpoint_turn
from kcs_torch.methods.finish import Estimate, loose_bones
from kcs_torch.methods.pkc.body import TOLD
from kcs_torch.methods.pkc.moving_view import MovingView
from kcs_torch.skeleton import Skeleton
from kcs_torch.solvers.camera_path import view_energy
from kcs_torch.solvers.procrustean import COARSE, FINE

__all__ = ["MOVING_STEPS", "STILL", "from_moving"]

MOVING_STEPS = sum(stage.num_steps for stage in (*COARSE, *FINE))
"""L-BFGS steps of the moving viewpoint's solver, at most."""

STILL = 0.01
"""A solution has settled where the last ten steps (fewer tell nothing) moved depths by no more than so much, root mean
square: a share of the body's size."""

SURE, DOUBT = 0.8, 0.6
"""Correlation with SfAM's depths from which on those of the moving viewpoint are sure, and below which they are a
guess. Before cameras that turn by 180 degrees it is above .95 for people, dogs and hands, by 60 about .8, by none
.3 and less; of robots, whose joints turn about fixed axes, it says little."""

LEAD = 6.0
"""Lead of a solution whose bones are held to their lengths (see :class:`MovingView`) that is as sure as full agreement:
of 47 views of robot arms, real and random, 14 had one, and 12 of these had a tenth of a flat guess's error or less."""

BROKEN = 0.5
"""How sure a solution is at most, 1 being full agreement, that does not keep the lengths of rigid bones, or whose
viewpoint turns by less than it should."""

TURN = 60.0
"""Degrees by which the viewpoint should turn about a body: of a solution that turns by less, depth may be drawn out as
far as its turn is too small, and other methods follow it there."""


def from_moving(
    moving: MovingView,
    first: Estimate,
    skeleton: Skeleton,
    cameras: Tensor | None,
    notes: tuple[str, ...],
    *,
    mirrored: bool,
) -> Estimate:
    """Return the estimate and, if ``mirrored``, its mirror image, which nothing but known cameras tells apart.

    Where the viewpoint hardly turns the objective has many minima. SfAM, which looks for depth in another way, then
    finds other depths: how far both agree is how far depth is to be believed. Of few bones that are held to their
    lengths, many solutions have been compared: one that leads by far needs no other witness. Where bones that are
    rigid change their length all the same, the solution is wrong.
    """
    points, turned = moving.pose.points[0], moving.cameras()[0]
    path, told, flip = turned, False, points.new_tensor([1.0, 1.0, -1.0])
    if cameras is not None:
        path = complete_rotation(cameras)
        right, wrong = view_energy(torch.stack([points, points * flip]), path).tolist()
        points, told = points if right <= wrong else points * flip, abs(right - wrong) > TOLD
    one = torch.ones_like(points[:, 0, 0])
    value = float(moving.pose.objective[0])
    settled = bool(moving.pose.moved[0] <= STILL)
    agree = _agreement(points[..., 2], first.points[..., 2])
    size = points[..., 2].square().mean().sqrt()
    sure = witnessed = max(agree / SURE, moving.lead / LEAD)
    shown = math.inf if cameras is not None else float(viewpoint_turn(turned[:, :2]))
    if loose_bones(points, skeleton) or shown < TURN:  # another warning tells of the former
        sure = min(sure, BROKEN)
    spread = (moving.deviation(turned).square() + (size * max(0.0, 1 - sure)).square()).sqrt()
    doubt = ""
    needed = f"The viewpoint should turn about the body by {TURN:g} degrees or more, or the skeleton have a template"
    if witnessed < DOUBT / SURE:
        doubt = (
            "depth is little more than a guess: two methods find depths that hardly agree "
            f"(correlation {agree:.2f}). {needed}"
        )
    elif shown < TURN:
        doubt = f"depth may be drawn out or pressed flat: the viewpoint turned by only {shown:.0f} degrees. {needed}"
    main = Estimate(points, path[:, :2], one, settled, MOVING_STEPS, notes, spread, value, doubt=doubt)
    if told or not mirrored:
        return main
    seen = path[:, :2] if cameras is not None else path[:, :2] * flip
    said = ("the mirror image in depth",)
    other = replace(main, points=points * flip, cameras=seen, notes=said, doubt="")
    return replace(main, alternatives=(other,))


def _agreement(depth: Tensor, other: Tensor) -> float:
    """Correlation of two solutions' depths (T, N), whichever mirror images they are."""
    a, b = (z - z.mean(-1, keepdim=True) for z in (depth, other))
    return float((a * b).sum().abs() / (a.norm() * b.norm()).clamp_min(torch.finfo(a.dtype).tiny))
