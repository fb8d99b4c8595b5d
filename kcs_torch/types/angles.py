"""How joints bend over time: :class:`JointAngles`."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import torch
from torch import Tensor

from kcs_torch.errors import OptionError, SkeletonError, counted
from kcs_torch.functional import flexion
from kcs_torch.functional.temporal import interpolate
from kcs_torch.skeleton import Hinge, Skeleton, map_joints

__all__ = ["JointAngles", "Joints", "angles_of"]

Joints = str | Sequence[str | Sequence[str]]
"""Names of hinges, or triples of names (parent, joint, child)."""

FIRM = 0.5
"""How firm a hinge has to be for its axis to tell hyperextension: the humerus turns about itself, elbows have none."""

Triple = tuple[int, int, int]


@dataclass(frozen=True, eq=False, repr=False)
class JointAngles:
    """How joints bend over time, in degrees: 0 straight, 180 folded.

    Attributes:
        degrees: (T,) by name; NaN where a joint is unseen.
        deviation: (T,) standard deviations by name, or None where nothing tells them.
        signed: names of the hinges whose hyperextension is negative; all others are 0 to 180.
        fps: frames per second, or None where unknown.
        source: where the motion comes from, for messages.
        seen: (T,) by name: whether all three joints are seen; where they are not, a result's angle is filled in.
    """

    degrees: dict[str, Tensor]
    deviation: dict[str, Tensor] | None = None
    signed: tuple[str, ...] = ()
    fps: float | None = None
    source: str = "angles"
    seen: dict[str, Tensor] = field(default_factory=dict)

    def __repr__(self) -> str:
        frames = len(next(iter(self.degrees.values())))
        return f"JointAngles({self.source!r}: {counted(frames, 'frame')} of {', '.join(self.degrees)})"

    def save(self, path: str | Path) -> Path:
        """Write a table (.csv): a row a frame with its time, and for each joint its angle and, if known, its deviation.

        Raises:
            OutputError: the suffix is another, or the file cannot be written; nothing is left half-written.
        """
        from kcs_torch.io.angles import save_angles

        return save_angles(self, path)


def angles_of(
    points: Tensor,
    seen: Tensor,
    body: Skeleton,
    joints: Joints | None,
    *,
    filled_in: bool = False,
    uncertainty: Tensor | None = None,
    fps: float | None = None,
    source: str = "angles",
) -> JointAngles:
    """The angles of a motion; see :meth:`Reconstruction.angles`.

    Args:
        points: (T, N, 3), of right-handed axes.
        seen: (T, N).
        body: the skeleton.
        joints: which; all hinges if None.
        filled_in: whether unseen joints have places, so that their angles are known.
        uncertainty: (T, N) standard deviation along z, or None.
        fps: frames per second.
        source: for messages.
    """
    chosen = _chosen(body, joints)
    index = torch.tensor([chain for chain, _ in chosen.values()], device=points.device)
    above, here, below = (points[:, i] for i in index.unbind(-1))
    axis, shown = torch.zeros_like(here), seen[:, index].all(-1)
    known = shown | filled_in
    seen = seen | filled_in
    filled, ever = interpolate(torch.where(seen[..., None], points, 0), seen), seen.any(0)
    signed = []
    for k, (name, (_, hinge)) in enumerate(chosen.items()):
        if hinge is not None and hinge.firm >= FIRM and bool(ever[hinge.left] & ever[hinge.right]):
            axis[:, k] = hinge.sign * (filled[:, hinge.left] - filled[:, hinge.right])
            signed.append(name)
    upper, lower = here - above, below - here
    angle = flexion(upper, lower, axis)
    deviation = None
    if uncertainty is not None:
        deviation = _deviation(angle.detach(), upper.detach(), lower.detach(), axis, uncertainty.detach()[:, index])
    columns = torch.where(known, angle.rad2deg(), torch.full_like(angle, math.nan)).unbind(1)
    spread = None if deviation is None else dict(zip(chosen, deviation.rad2deg().unbind(1), strict=True))
    sights = dict(zip(chosen, shown.unbind(1), strict=True))
    return JointAngles(dict(zip(chosen, columns, strict=True)), spread, tuple(signed), fps, source, sights)


def _deviation(angle: Tensor, upper: Tensor, lower: Tensor, axis: Tensor, depths: Tensor) -> Tensor:
    """Standard deviation of angles (T, J) from those of the three joints' depths (T, J, 3), which are independent.

    By the Gauss-Hermite rule of three nodes a depth. Where angles change in proportion to depth that is the first
    order, which would be next to nothing where a limb bends within the image or is straight.
    """
    step = torch.nn.functional.pad(depths.to(upper)[..., None], (2, 0)).unbind(-2)  # (T, J, 3) along z, of each joint
    square = torch.zeros_like(angle)
    for nodes in itertools.product((-1, 0, 1), repeat=3):
        above, here, below = (math.sqrt(3) * k * s for k, s in zip(nodes, step, strict=True))
        off = flexion(upper + here - above, lower + below - here, axis) - angle
        square += math.prod(1 / 6 if k else 2 / 3 for k in nodes) * off.square()
    return square.sqrt()


def _chosen(body: Skeleton, joints: Joints | None) -> dict[str, tuple[Triple, Hinge | None]]:
    """Which angles are asked for: their names, three joints each, and the hinge if it is one."""
    hinges = _hinges(body)
    if joints is None:
        if not hinges:
            raise OptionError(
                f"angles: skeleton '{body.name}' has no hinges: give one that has (kcs-torch angles: --skeleton "
                f"body25) or name three joints, such as {_example(body)}"
            )
        return {name: ((h.parent, h.joint, h.child), h) for name, h in hinges.items()}
    found: dict[str, tuple[Triple, Hinge | None]] = {}
    if not isinstance(joints, (str, Sequence)):
        raise OptionError(f"angles: expected names of hinges or triples of names, got {joints!r}")
    for one in [joints] if isinstance(joints, str) else joints:
        if isinstance(one, str):
            at = _index(body, one)
            mine = {name: h for name, h in hinges.items() if h.joint == at}
            if not mine:
                raise OptionError(
                    f"angles: {one!r} is no hinge of skeleton '{body.name}' ({', '.join(hinges) or 'it has none'}): "
                    f"name the joints beside it as well, such as {_example(body, at)}"
                )
            found |= {name: ((h.parent, h.joint, h.child), h) for name, h in mine.items()}
            continue
        names = list(one) if isinstance(one, Sequence) else []
        if len(names) != 3 or not all(isinstance(name, str) for name in names):
            raise OptionError(
                f"angles: expected the name of a hinge or three names (parent, joint, child), got {one!r}"
            )
        a, b, c = (_index(body, name) for name in names)
        if len({a, b, c}) != 3:
            raise OptionError(f"angles: expected three different joints (parent, joint, child), got {', '.join(names)}")
        found["-".join(body.joints[i] for i in (a, b, c))] = (a, b, c), None
    if not found:
        raise OptionError("angles: expected at least one joint, got none; leave joints out for all hinges")
    return found


def _hinges(body: Skeleton) -> dict[str, Hinge]:
    """The hinges by the names of their joints; by all three names where several bend at one joint."""
    at = [hinge.joint for hinge in body.hinges]
    return {
        body.joints[h.joint]
        if at.count(h.joint) == 1
        else "-".join(body.joints[i] for i in (h.parent, h.joint, h.child)): h
        for h in body.hinges
    }


def _index(body: Skeleton, name: str) -> int:
    """Index of a joint, however its name is spelt."""
    found = body.joints.index(name) if name in body.joints else map_joints(body.joints, [name])[0]
    if found is None:
        try:
            return body.index(name)
        except SkeletonError as error:
            raise SkeletonError(f"angles: {error}") from None
    return found


def _example(body: Skeleton, joint: int | None = None) -> str:
    """Three joints that bones join, as an argument."""
    names = ["parent", "joint", "child"]
    for here in range(body.num_joints) if joint is None else (joint,):
        beside = [a + b - here for a, b in body.bones if here in (a, b)]
        if len(beside) > 1:
            names = [body.joints[i] for i in (beside[0], here, beside[1])]
            break
    return f"joints=[({', '.join(map(repr, names))})] (kcs-torch angles: --joint {','.join(names)})"
