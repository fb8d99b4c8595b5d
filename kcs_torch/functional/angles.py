"""Angles between bones: how far joints bend."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from kcs_torch.functional.chain import index_rows
from kcs_torch.functional.guarded import safe_norm, unit_size
from kcs_torch.functional.precision import alike
from kcs_torch.functional.shapes import check_batches, check_core, check_floats

__all__ = ["angle_between", "flexion", "joint_angles"]

AGAINST = 0.5
"""Cosine between a bend's axis and the reverse of the hinge's from which on the hinge is bent the wrong way."""


def angle_between(first: Tensor, second: Tensor) -> Tensor:
    """Return the angle between vectors, exact also where it is small: 2 atan2(|a - b|, |a + b|) of unit vectors a, b.

    Args:
        first: (..., D).
        second: (..., D).

    Returns:
        (...) in radians, 0 to pi. 0 with the derivative 0 where a vector has no length; the derivative is 0 also where
        the vectors are parallel, at which it has a kink.

    Raises:
        ShapeError: they have not as many coordinates, or are not in floating point.

    >>> angle_between(torch.tensor([1.0, 0, 0]), torch.tensor([[0.0, 2, 0], [-1, 0, 0], [0, 0, 0]])).tolist()
    [1.5707963705062866, 3.1415927410125732, 0.0]
    """
    check_floats(first, "angle_between: first", "D")
    check_floats(second, "angle_between: second", first.shape[-1])
    check_batches("angle_between: first and second", first, second, cores=(1, 1))
    first, second = alike(first, second)
    return _between(_unit(first), _unit(second))


def flexion(upper: Tensor, lower: Tensor, axis: Tensor | None = None) -> Tensor:
    """Return by how much a lower bone is bent away from the direction of the upper one.

    Args:
        upper: (..., 3) from the joint above to the one that bends.
        lower: (..., 3) from this to the joint below.
        axis: (..., 3) about which the lower bone turns when the joint bends its way, by the right-hand rule, of any
            length; None, or 0 where it is not known.

    Returns:
        (...) in radians: 0 where both bones are in line, pi where the limb is folded. Negative where it bends the other
        way, about an axis within 60 degrees of the reverse of ``axis``: a limb that turns about itself bends sideways
        at times, which is not the wrong way. 0 with the derivative 0 where a bone has no length.

    Raises:
        ShapeError: they are not (..., 3), or not in floating point.

    >>> thigh, shank = torch.tensor([0.0, 1, 0]), torch.tensor([0.0, 1, 1])
    >>> left = torch.tensor([1.0, 0, 0])  # y is down and z away from the viewer, whom the person faces
    >>> flexion(thigh, shank, left).rad2deg().item(), flexion(thigh, shank, -left).rad2deg().item()
    (45.0, -45.0)
    """
    check_floats(upper, "flexion: upper", 3)
    check_floats(lower, "flexion: lower", 3)
    check_batches("flexion: upper and lower", upper, lower, cores=(1, 1))
    upper, lower = alike(upper, lower)
    first, second = _unit(upper), _unit(lower)
    angle = _between(first, second)
    if axis is None:
        return angle
    check_core(axis, "flexion: axis", 3)
    check_batches("flexion: upper, lower and axis", upper, lower, axis, cores=(1, 1, 1))
    turn = torch.linalg.cross(first.detach(), second.detach())
    along = (turn * _unit(axis.detach().to(turn))).sum(-1)
    return torch.where(along < -AGAINST * safe_norm(turn), -angle, angle)


def joint_angles(points: Tensor, joints: Tensor | Sequence[Sequence[int]]) -> Tensor:
    """Return the flexion of joints: by how much the bone to the child is bent away from the bone from the parent.

    Args:
        points: (..., N, D).
        joints: (J, 3) integer (parent, joint, child) triples.

    Returns:
        (..., J) in radians: 0 straight, pi folded; 0 with the derivative 0 where two joints coincide.

    Raises:
        ShapeError: ``joints`` is not (J, 3), or a list of joints that the points have not; or these are not in floating
            point.

    >>> arm = torch.tensor([[0.0, 0, 0], [0, 3, 0], [2, 3, 0]])
    >>> joint_angles(arm, [(0, 1, 2)]).rad2deg().tolist()
    [90.0]
    """
    check_floats(points, "joint_angles: points", "N", "D")
    index = index_rows(joints, points.shape[-2], what="joints", form=("parent", "joint", "child"))
    above, here, below = (points.index_select(-2, i) for i in index.to(points.device).unbind(-1))
    return angle_between(here - above, below - here)


def _between(first: Tensor, second: Tensor) -> Tensor:
    """The angle between unit vectors; 0 where one of them is 0."""
    known = (first != 0).any(-1) & (second != 0).any(-1)
    total = safe_norm(first + second)
    angle = 2 * torch.atan2(safe_norm(first - second), torch.where(known, total, torch.ones_like(total)))
    return torch.where(known, angle, torch.zeros_like(angle))


def _unit(vectors: Tensor) -> Tensor:
    """Vectors over their length; 0 where that is 0."""
    scaled = unit_size(vectors, 1)
    length = safe_norm(scaled)[..., None]
    return scaled / torch.where(length == 0, torch.ones_like(length), length)
