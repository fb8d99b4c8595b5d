"""Hypotheses of a body with a template as an answer: which differ, how sure depths are, and what the prior told."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from kcs_torch.functional.camera import viewpoint_turn
from kcs_torch.methods.answer.finish import Estimate
from kcs_torch.methods.pkc.answers import (
    APART,
    angle_doubt,
    depth_deviation,
    guess_variance,
    hardly_told,
    told_by_prior,
)
from kcs_torch.methods.pkc.body import Body
from kcs_torch.methods.pkc.hypotheses import Hypotheses, distinct
from kcs_torch.methods.pkc.moving_answer import STILL
from kcs_torch.skeleton import Skeleton

__all__ = ["SEE_OTHERS", "UNSIDED", "from_hypotheses", "uncertain_signs"]

SEE_OTHERS = "see the alternatives"
"""How notes end that are true of the best solution alone."""

UNSIDED = (
    "depth may be mirrored: the known cameras turn too little, beside how the body itself turns, to tell which of two "
    "mirror images is right, so that it is the one like the template. Of a body that is the template's mirror image, "
    "as a left hand is a right one's, take the alternative that is"
)
"""What is said of a body that only its template tells from its mirror image."""

OTHERS = 4
"""Further solutions that tell how sure depths are, whether they are returned or not."""


def uncertain_signs(found: Hypotheses, skeleton: Skeleton) -> list[str]:
    """What is said of bones whose depth has another sign in a close rival of the best hypothesis; nothing of none."""
    doubtful = told_by_prior(found, skeleton)
    if not doubtful:
        return []
    return [f"forward or backward is uncertain for {', '.join(doubtful)}, decided by usual postures: {SEE_OTHERS}"]


def from_hypotheses(
    found: Hypotheses,
    body: Body,
    cameras: Tensor | None,
    notes: tuple[str, ...],
    *,
    telling: Tensor | None,
    alternatives: int,
    detections: bool,
    told: bool,
) -> Estimate:
    """Return the best estimate in the tracks' units, with so many distinct alternatives at most.

    Args:
        found: hypotheses, best first.
        body: that they are of.
        cameras: (T, 2, 3) that are known, or None: then the trunk's.
        notes: on the clip so far.
        telling: (T, 3, 3) those that are known and turn, by which hypotheses were told apart, or None.
        alternatives: further solutions, at most.
        detections: whether joints are a detector's.
        told: whether enough steps were made to tell from the last ones that a solution has settled.
    """
    image = body.image if detections else None
    other = None if telling is None else body.unsided(found, telling)
    if other is not None:
        found = found.joined(other)
    found = distinct(found, max(alternatives, OTHERS) + 1, APART)
    decided = (*notes, *uncertain_signs(found, body.skeleton))
    made = []
    wanted = found[: alternatives + 1]
    for k, (depth, points) in enumerate(zip(wanted.depth, body.bodies(wanted), strict=True)):
        one = torch.ones_like(points[:, 0, 0])
        turned = body.frames(depth)[:, :2]
        turn = float(viewpoint_turn(turned))
        spread = depth_deviation(
            found[k : k + OTHERS + 1], body.noise, body.skeleton, image=image, turn=turn,
            doubt=angle_doubt(body.objective, depth, found.lengths[k], turn),
            guess=guess_variance(body.skeleton, found.lengths[k], turn),
        )  # fmt: skip
        doubt = "" if k else hardly_told(depth, spread, body.skeleton, turn) or ("" if other is None else UNSIDED)
        settled = told and found.moved is not None and bool(found.moved[k] <= STILL)
        path, said, value = turned if cameras is None else cameras, notes if k else decided, float(found.energy[k])
        facts = (settled, found.steps, said, spread / body.factor, value)
        made.append(Estimate(points, path, one, *facts, doubt=doubt, still=telling is None))
    return replace(made[0], alternatives=tuple(made[1:]))
