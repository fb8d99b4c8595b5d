"""How two solutions of the same tracks differ: what is nearer in one and farther in the other."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import torch

from kcs_torch.errors import OptionError, ShapeError, counted
from kcs_torch.functional.chain import bone_vectors
from kcs_torch.types import Reconstruction

__all__ = ["Difference", "difference"]

LEVEL = 0.1
"""Share of its length below which a bone's depth has no sign to speak of."""

MIRRORED = 0.3
"""A mirror image's depths add up to less than this share of their difference."""

EXACT = 1e-3
"""And those of the mirror image itself to less than this share; as the difference of the same depths to their sum."""

FEW = 0.05
"""Share of frames in which a bone must be flipped to be named."""


@dataclass(frozen=True)
class Difference:
    """How a solution differs from another.

    Attributes:
        rms: root mean square distance of the joints, each pose about its own middle in depth, in the solutions' unit.
        mirrored: whether it is nearly the mirror image in depth.
        flipped: bones that tip the other way in depth, and the share of frames in which they do; most often first.
        beside_mirror: root mean square distance in depth from the mirror image, 0 where it is just that.
        units: the solutions'.
        joints: those whose depths differ, and by how much (root mean square); farthest first.
    """

    rms: float
    mirrored: bool
    flipped: dict[str, float]
    beside_mirror: float = 0.0
    units: str = ""
    joints: dict[str, float] = field(default_factory=dict)

    def __str__(self) -> str:
        if self.mirrored and not self.beside_mirror:
            return "the mirror image in depth"
        if self.mirrored:
            return f"nearly the mirror image in depth, {f'{self.beside_mirror:.3g} {self.units}'.rstrip()} from it"
        if not self.flipped:
            differ = bool(self.joints) or math.isnan(self.rms)
            return "depths differ, no bone tips the other way" if differ else "depths are the same"
        some = dict(list(self.flipped.items())[:4])
        more = f", and {counted(len(self.flipped) - 4, 'more bone')}" if len(self.flipped) > 4 else ""
        if min(some.values()) == 1:  # all the time, as in a single image
            return f"other sign of depth: {', '.join(some)}{more}"
        named = ", ".join(f"{bone} in {100 * share:.0f} %" for bone, share in some.items())
        return f"other sign of depth: {named} of the frames{more}"


def difference(best: Reconstruction, other: Reconstruction) -> Difference:
    """Compare two solutions of the same tracks.

    Args:
        best: the one.
        other: the other, usually of ``best.alternatives``.

    Raises:
        OptionError: one of them is no reconstruction.
        ShapeError: they are not of the same frames and joints.

    >>> import kcs_torch as kt
    >>> from kcs_torch.data import walking_person
    >>> result = kt.reconstruct(walking_person(30).tracks, method="sfam")
    >>> print(difference(result, result.mirrored()))
    the mirror image in depth
    """
    for name, one in (("best", best), ("other", other)):
        if not isinstance(one, Reconstruction):
            raise OptionError(
                f"difference: {name}: expected a Reconstruction, got {type(one).__name__}: mpjpe compares points"
            )
    if best.points.shape != other.points.shape:
        shapes = f"{tuple(best.points.shape)} and {tuple(other.points.shape)}"
        raise ShapeError(f"difference: expected solutions of the same frames and joints, got points {shapes}")
    ours, theirs = best.points.detach().double(), other.points.detach().double()
    both = torch.stack([ours, theirs.to(ours.device)])
    depth = both[..., 2] - both[..., 2].nanmean(-1, keepdim=True)
    apart = torch.cat([(both[1] - both[0])[..., :2], (depth[1] - depth[0])[..., None]], -1)
    rms = float(apart.square().sum(-1).nanmean().sqrt())
    add, subtract = (float(z.square().nanmean().sqrt()) for z in (depth.sum(0), depth[1] - depth[0]))
    body = best.skeleton
    joints: dict[str, float] = {}
    if subtract > EXACT * add:
        far = (depth[1] - depth[0]).square().nanmean(0).sqrt().nan_to_num(0.0)
        order = far.argsort(descending=True, stable=True).tolist()
        joints = {body.joints[j]: float(far[j]) for j in order if far[j] > 0}
    flipped: dict[str, float] = {}
    if body.num_bones:
        tips = bone_vectors(both, body.bone_index(device=both.device))
        steep = (tips[..., 2].abs() > LEVEL * tips.norm(dim=-1)).all(0)
        share = (steep & (tips[0, ..., 2] * tips[1, ..., 2] < 0)).double().mean(0)
        order = share.argsort(descending=True, stable=True).tolist()
        flipped = {body.bone_names[b]: float(share[b]) for b in order if share[b] >= FEW}
    beside = 0.0 if add <= EXACT * subtract else add
    return Difference(rms, add < MIRRORED * subtract, flipped, beside, best.units, joints)
