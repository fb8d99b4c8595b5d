"""The trunk's orientation: a rigid template seen under weak perspective, and its two-fold ambiguity."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from kcs_torch.functional.align import centre
from kcs_torch.functional.chain import bone_vectors
from kcs_torch.functional.temporal import best_path
from kcs_torch.methods.clips.lockstep import Search
from kcs_torch.nn.posture import PostureEnergy
from kcs_torch.solvers.pose import fit_cameras

__all__ = [
    "Facing",
    "Trunk",
    "facings",
    "image_scale",
    "longest_image",
    "mirror",
    "trunk_misfit",
    "trunk_path",
    "trunk_turns",
]

FIT = 0.03
"""Standard deviation of the trunk's joints about its template, a standing person being about 1.75 tall."""

TURN = 0.15
"""Standard deviation of the trunk's turn from frame to frame, in radians, at 30 frames a second."""


LONGER, FILLED = 1.5, 3.0
"""By how many standard deviations of its noise the longest image of a bone is too long; and how many times as noisy as
where it is surest it is where a gap was filled, at least: a detector that is less sure still shows it."""


@dataclass(frozen=True)
class Trunk:
    """A trunk's joints in rest and the bones that they make.

    Attributes:
        rest: (N, 3), the template, perhaps with central bones of another length.
        lengths: (B,) of the bones of ``rest``.
    """

    rest: Tensor
    lengths: Tensor


class Facing(NamedTuple):
    """A rigid template (n, 3) whose rotation and scale are wanted in each frame of an image (T, n, 2), both centred."""

    image: Tensor
    rest: Tensor


def facings(tasks: Sequence[Facing]) -> list[tuple[Tensor, Tensor]]:
    """Rotations (C, T, 3, 3) and scales (C, T) of each task from C headings; all frames are fitted together."""
    groups: dict[object, list[int]] = {}
    for i, (image, _) in enumerate(tasks):
        groups.setdefault((image.shape[1], image.dtype, image.device), []).append(i)
    out: dict[int, tuple[Tensor, Tensor]] = {}
    for group in groups.values():
        counts = [len(tasks[i].image) for i in group]
        image = torch.cat([tasks[i].image for i in group])
        rest = torch.cat([tasks[i].rest.expand(len(tasks[i].image), -1, -1) for i in group])
        one = image.new_ones(len(image))
        fit = fit_cameras(image, rest, image.new_ones(image.shape[:2]), 0.9 * one, 1.1 * one, robust=None)
        out |= zip(group, zip(fit.rotations.split(counts, 1), fit.scales.split(counts, 1), strict=True), strict=True)
    return [out[i] for i in range(len(tasks))]


def image_scale(image: Tensor, lengths: Tensor, bones: Tensor, rigid: Tensor, noise: Tensor) -> Tensor:
    """Scale of a clip: image units per unit of length, a 0-dimensional tensor.

    Each bone's longest image over its usual length is about the scale, if the bone ever lies in the image plane; the
    0.6 quantile over bones lets those that never do, and those of unusual length, pass.

    Args:
        image: (T, N, 2).
        lengths: (B,) usual lengths.
        bones: (B, 2).
        rigid: (B,) bool, bones that count.
        noise: (T, B) standard deviation of the bones' images.
    """
    use = rigid & (lengths > 0)
    if not bool(use.any()):
        return image.new_ones(())
    ratio = longest_image(bone_vectors(image, bones[use]), noise[:, use]) / lengths[use]
    return torch.quantile(ratio, 0.6)


def longest_image(flat: Tensor, noise: Tensor) -> Tensor:
    """How long bones look at most, (B,), less what noise adds; filled-in frames count only where there are no others.

    Args:
        flat: (T, B, 2) images of the bones.
        noise: (T, B) their standard deviation.
    """
    size = flat.norm(dim=-1)
    sure = noise <= FILLED * noise.amin(0)
    return torch.where(sure, size - LONGER * noise, torch.nan).nanquantile(0.985, 0).clamp_min(0)


def mirror(rotations: Tensor) -> Tensor:
    """Rotations (..., 3, 3) of the mirror image in depth, S R S: the same image of a flat body."""
    flip = torch.tensor([1.0, 1.0, -1.0], dtype=rotations.dtype, device=rotations.device)
    return rotations * flip[:, None] * flip


def _facing(image: Tensor, trunk: Trunk, joints: Tensor) -> Facing:
    """The trunk's joints in an image (T, N, 2), and in rest."""
    return Facing(centre(image[:, joints])[0], centre(trunk.rest[joints])[0])


def trunk_misfit(
    image: Tensor, trunk: Trunk, joints: Tensor, rotations: Tensor, scales: Tensor | float = 1.0
) -> Tensor:
    """Half the squared misfit, in deviations, of the trunk's template in each frame, (C, T) of (C, T, 3, 3)."""
    goal, rest = _facing(image, trunk, joints)
    return (scales * (rest @ rotations[..., :2, :].mT) - goal).square().sum((-2, -1)) / (2 * FIT**2)


def trunk_path(
    image: Tensor, trunk: Trunk, posture: PostureEnergy, correlation: float, turn: float
) -> Search[Facing, tuple[Tensor, Tensor], Tensor]:
    """A smooth path of the trunk's rotation, template to camera, (T, 3, 3), as a search.

    Args:
        image: (T, N, 2), in units of the template.
        trunk: what to fit.
        posture: says which joints are the trunk's.
        correlation: frames that count as one.
        turn: standard deviation of the turn from frame to frame, in radians.
    """
    joints = posture.trunk
    ((rotations, scales),) = yield [_facing(image, trunk, joints)]
    rotations = torch.cat([rotations, mirror(rotations)])  # (16, T, 3, 3)
    off = trunk_misfit(image, trunk, joints, rotations, scales.repeat(2, 1)[..., None, None])
    choice = best_path(off.mT / correlation, trunk_turns(rotations, turn))
    return rotations[choice, torch.arange(len(image), device=image.device)]


def trunk_turns(rotations: Tensor, turn: float, cap: float | None = None) -> Tensor:
    """Cost of turning from each of C rotations to each of the next frame's, (T - 1, C, C), from (C, T, 3, 3)."""
    trace = torch.einsum("atij,btij->tab", rotations[:, :-1], rotations[:, 1:])
    cost = torch.arccos(((trace - 1) / 2).clamp(-1, 1)).square() / (2 * turn**2)
    return cost if cap is None else cost.clamp_max(cap)
