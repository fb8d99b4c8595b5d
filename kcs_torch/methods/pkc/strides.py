"""Strides: which way a leg points from one passage through the image plane to the next, told by feet that stand."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from kcs_torch.methods.pkc.objective import Objective

__all__ = ["cheapest_runs", "strides"]

SPEEDS = 17
"""Speeds of the body towards the camera or away from it that are tried."""

STANDS = 0.5
"""How surely a foot stands that tells how fast the body may be."""

FAST = 0.95
"""Share of the frames in which such feet move against the trunk by less than the body may in depth."""

UNSTEADY = 0.12
"""Share of the fastest speed by which a body's speed varies."""


def strides(objective: Objective, own: Tensor, member: Tensor, places: Tensor, bend: Tensor) -> Tensor:
    """Signs (K, T, B) of legs' bones with which standing feet stand still in depth, for K speeds of the body.

    While its foot stands a leg swings back past the image plane, and then forth again. Bouncing off the plane it would
    look the same, and in a noisy image it moves as smoothly; but then the foot would not stand. For a steady speed v of
    the body each leg is a problem of its own: the signs of its runs between passages, one after the other, that
    minimise, with the feet's depths z, how surely they stand c, and the slip s,

        sum_tc c_tc / 2 log(1 + ((z_tc - z_t-1,c + v) / s)^2) + what changes of sign bend the motion.

    Of the thigh, the shin, or both together it is that which costs least that changes its signs.

    Args:
        objective: of one clip, with standing feet.
        own: (T, B) depths of the bones.
        member: (P, B), 1 for the bones of each part.
        places: (P, M) frames from which on a part's signs may change, ascending from 0 to T; T where there are fewer.
        bend: (P, T) what changes of sign cost there.
    """
    assert objective.standing is not None
    feet = objective.feet_moved()  # (B, C)
    moves = member @ (feet != 0).to(own) > 0  # (P, C)
    sure = torch.minimum(objective.standing[1:], objective.standing[:-1])  # (T - 1, C)
    step = (own @ feet).diff(dim=0)
    stands = step.abs()[sure > STANDS]
    legs = moves.any(1) & ~moves.all(1)
    if not (bool(legs.any()) and len(stands)):
        return own.new_ones(0, *own.shape)
    member, places, bend, moves = member[legs], places[legs], bend[legs], moves[legs]
    top = float(stands.quantile(FAST))
    speed = torch.linspace(-top, top, SPEEDS, dtype=own.dtype, device=own.device)[:, None, None, None]
    slip = math.hypot(objective.feet.slip, UNSTEADY * top)
    weight = sure * moves[:, None]  # (P, T - 1, C)
    part = (own * member[:, None]) @ feet  # (P, T, C)
    rest = step - part.diff(dim=1)

    def cost(before: int, after: int) -> Tensor:
        """What feet cost from each frame to the next, (V, P, T - 1), with signs of the part before and after."""
        move = rest + after * part[:, 1:] - before * part[:, :-1]
        return (weight * torch.log1p(((move + speed) / slip).square())).sum(-1) / 2

    steps = torch.stack([torch.stack([cost(before, after) for after in (1, -1)]) for before in (1, -1)])
    least, flips = cheapest_runs(steps, places, bend)
    made = own.new_ones(SPEEDS, *own.shape)
    group = (moves.to(own) @ moves.to(own).mT > 0).int().argmax(1)  # the first part of the same leg
    for leg in group.unique().tolist():
        of = (group == leg).nonzero().flatten()
        best = of[least[:, of].argmin(1)]  # (V,)
        chosen = flips[torch.arange(SPEEDS, device=own.device), best].to(own)
        made *= 1 - 2 * chosen[..., None] * member[best][:, None]
    return made.unique(dim=0)


def cheapest_runs(steps: Tensor, places: Tensor, bend: Tensor) -> tuple[Tensor, Tensor]:
    """The runs of signs that cost least, by dynamic programming over the runs: costs (V, P), and flips (V, P, T).

    Args:
        steps: (2, 2, V, P, T - 1) costs from each frame to the next: with the sign kept or flipped before, and after.
        places: (P, M) frames from which on signs may change, ascending from 0 to T; T where there are fewer.
        bend: (P, T) what a change costs there.
    """
    parts, frames = bend.shape
    index, both = torch.arange(parts, device=bend.device), torch.arange(2, device=bend.device)
    within = torch.nn.functional.pad(steps[both, both].cumsum(-1), (1, 0))  # (2, V, P, T) up to each frame
    same = torch.eye(2, dtype=torch.bool, device=bend.device)[..., None, None]
    value, start, came = torch.zeros_like(within[..., 0]), torch.zeros_like(places[:, 0]), []
    for place in places[:, 1:].unbind(1):
        last = place - 1
        value = value + within[..., index, last] - within[..., index, start]
        at = place.clamp_max(frames - 1)
        change = steps[..., index, at - 1] + torch.where(same, 0, bend[index, at])
        change = torch.where(place < frames, change, torch.where(same, 0, torch.inf).to(change))  # or the clip is over
        value, origin = (value[:, None] + change).min(0)  # (2, V, P)
        came.append(origin)
        start = torch.minimum(place, last.new_tensor(frames - 1))
    least, state = value.min(0)
    states = [state]
    for origin in reversed(came):
        states.append(origin.gather(0, states[-1][None])[0])
    chosen = torch.stack(states[::-1], -1)  # (V, P, M), 1 where a run is flipped
    time = torch.arange(frames, device=bend.device)
    run = (time >= places[:, 1:, None]).sum(1)  # (P, T)
    return least, chosen.gather(2, run.expand(len(chosen), -1, -1))
