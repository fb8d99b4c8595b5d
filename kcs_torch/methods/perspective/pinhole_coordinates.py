"""The coordinates in which the energy of a body seen along rays is minimised."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from kcs_torch.methods.perspective.plain_body import ACCELERATION, CLOSE, PlainBody
from kcs_torch.methods.pkc.weights import HEAVY

if TYPE_CHECKING:
    from kcs_torch.methods.perspective.pinhole import PinholeEnergy

__all__ = ["EASY", "FIRM", "STRAY", "USUAL", "coordinates"]

STRAY = 0.1
"""Usual deviation of the distance from what is given, as a share, all frames counting as one."""

FREE = 0.1
"""Usual deviation of a length, as a share: how long steps are."""

USUAL, FACTOR = 4.5, 1.5
"""Usual distance of a camera whose focal length is not known, for a body of 1.75, and by what factor it strays."""

FIRM = math.log(FACTOR) ** -2
"""Curvature of what it costs, in the logarithm."""

FARTHER = 3.0
"""By what factor it strays to the far side where the usual focal length is known: images that are cropped make bodies
large; one that is small is more often far away than seen through a short lens."""

EASY = FIRM**-1 * math.log(FARTHER) ** -2
"""That side's curvature, over the other's."""


def coordinates(energy: PinholeEnergy, image: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """How bones' depths (H, B, T) go with log lengths, and against log distances and log w; and scales (H, D).

    Scales are the roots of the curvature's inverse, roughly: of the lengths', smoothness and posture terms and of the
    distance's own.

    Args:
        energy: at its start.
        image: (H, 2, B, T) of its bones there.
    """
    model, body = energy.model, energy.body
    dz, size, distance = energy.own, energy.lengths[..., None], energy.path / energy.wide
    flat = image.square().sum(1)
    off = (flat + dz.square() - size.square()) / (2 * size)
    precision = body.precision if isinstance(body, PlainBody) else body.objective.precision(energy.lengths).mT
    spread = HEAVY * torch.log1p(precision * off.square() / HEAVY).mean(-1, keepdim=True)
    pull = precision / (1 + spread.clamp_max(1))
    if model is None:
        shape, acceleration = torch.full_like(size, 1 / CLOSE**2), ACCELERATION * energy.slow**2
    else:
        acceleration = model.weights.acceleration
        usual = model.posture.deviation.square().mean(-1)[:, None]
        shape = 5 / (model.weights.posture * (usual * size.square()).clamp_min(1e-3))
    smooth = 6 / acceleration**2  # the mean square of a second difference's coefficients
    curve = pull * (dz / size).square() + smooth + shape
    near = dz.square() + (0.5 * size).square()
    n = energy.seen.shape[1]
    slid = energy.seen @ (energy.rays[:, :n] * energy.depth[:, None, :n]) * energy.wide[..., None, None]
    slid = (slid * image).sum(1)  # by how much the squared image grows with log w, halved
    shear, drift, lean = (x * dz / near for x in (size.square(), flat, slid))
    own = (pull * (size - dz * shear / size).square()).sum(-1) + 1 / FREE**2
    own = own + shear.diff(n=2).square().sum(-1) / acceleration**2
    left = (pull * (flat / size - dz * drift / size).square()).sum(1)  # (H, T)
    steps = [  # (K,) each
        (real[n:, None] * energy.waves.diff(n=n, dim=0)).square().sum(0)
        for n, real in ((1, energy.follows), (2, energy.bends))
    ]
    waves = left @ energy.waves.square() + 1 / STRAY**2
    waves = waves + distance.square().mean(-1, keepdim=True) * steps[1] * energy.rough
    waves = waves + drift.square().mean(-1).sum(-1, keepdim=True) * steps[1] / acceleration**2
    focus = (pull * ((slid - dz * lean) / size).square()).sum((1, 2)) + FIRM
    focus = focus + lean.diff(n=2).square().sum((1, 2)) / acceleration**2
    focus = focus + (energy.bends[2:] * distance.diff(n=2)).square().sum(-1) * energy.rough
    if model is not None and model.standing is not None and model.standing.numel():
        firm = model.weights.contact / model.feet.slip**2
        both = torch.minimum(model.standing[1:], model.standing[:-1]) * energy.follows[1:, None]
        each = torch.nn.functional.pad(both, (0, 0, 0, 1)) + torch.nn.functional.pad(both, (0, 0, 1, 0))
        lines = energy.lines[list(energy.skeleton.contacts)]  # (C, B)
        curve = curve + firm * lines.mT.square() @ each.mT
        pulled = torch.einsum("hbt,cb->hbct", shear, lines).diff(dim=-1)
        own = own + firm * torch.einsum("tc,hbct->hb", both, pulled.square())
        moves = (distance[:, None] - lines @ drift).square() * each.mT / 2
        waves = waves + firm * moves.sum(1).mean(-1, keepdim=True) * steps[0]
        moves = distance[:, None].diff() + (lines @ lean).diff()
        focus = focus + firm * (both.mT * moves.square()).sum((1, 2))
    parts = [curve.flatten(1), waves] if energy.known else [curve.flatten(1), own, waves]
    scale = torch.cat(parts, 1).rsqrt()
    if energy.free is not None:
        scale = torch.cat([scale, (energy.free / focus.sqrt())[:, None]], 1)
    return shear, drift, lean, scale
