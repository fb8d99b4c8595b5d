"""A skeleton from the data alone: the joint pairs that keep their distance, and their tree."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from kcs_torch.clean.common import check_seen
from kcs_torch.errors import KcsWarning, OptionError, ShapeError, users_level
from kcs_torch.functional.chain import bone_vectors
from kcs_torch.functional.ranks import nanmedian
from kcs_torch.functional.rigidity import distance_spread, rigid_tree
from kcs_torch.methods.pkc import PKC
from kcs_torch.methods.pkc.clip import LEAST_JOINTS
from kcs_torch.methods.sfam import SfAM
from kcs_torch.skeleton import Skeleton
from kcs_torch.skeleton.core import FOUND
from kcs_torch.types import Reconstruction, Tracks, as_floats
from kcs_torch.types.intake import as_number

__all__ = ["find_skeleton"]

LINKS = 2
"""Pairs of joints that are pulled to one distance before bones are chosen, as many times the number of joints."""


def find_skeleton(
    source: Tracks | Reconstruction | Tensor,
    *,
    weights: Tensor | None = None,
    joints: Sequence[str] | None = None,
    rigid_below: float = 0.05,
) -> Skeleton:
    """Find the bones of a body: the spanning tree over the joint pairs whose distance varies least.

    Markers on one limb keep their distance whatever the pose, markers on different limbs do not. A reconstruction need
    not be good for that; its mirror image or a wrong turn of the whole changes no distance.

    Args:
        source: tracks (which are lifted first: by :class:`SfAM`, then by :class:`PKC` with links between the steadiest
            joints there), a reconstruction, or points (T, N, 3).
        weights: (T, N), 0 where unseen; those of the tracks if None. Tracks are lifted by their own.
        joints: their names, for points; those of the tracks' skeleton otherwise.
        rigid_below: a bone whose length varies by more than this share (standard deviation over mean) is flexible, and
            so is one whose ends are never seen together.

    Returns:
        A skeleton named "found" with ``proportions``, the median lengths; its bones run away from the first joint.
        Bones of that name count as chosen from the very tracks that they are used for, so that their constant length
        makes no depth surer: give the skeleton another name if they were found elsewhere, in motion capture say.

    Raises:
        ShapeError: there are no two joints, points that are not finite (T, N, 3), or no tensor of them; the weights or
            the joints' names do not fit them; a weight is negative or not finite; tracks show no joint in any frame.
        OptionError: ``rigid_below`` is no share, or negative.

    Warns:
        KcsWarning: no joints keep their distance; or the body is at rest, so that bones are a guess.

    >>> import kcs_torch as kt
    >>> points = torch.zeros(20, 3, 3)
    >>> points[:, 1, 0] = 1
    >>> points[:, 2, 0] = 1 + torch.linspace(0, 1, 20).cos()
    >>> points[:, 2, 1] = torch.linspace(0, 1, 20).sin()
    >>> find_skeleton(points).bones
    ((0, 1), (1, 2))
    """
    share = as_number(rigid_below)
    if share is None or not share >= 0:
        raise OptionError(f"find_skeleton: rigid_below: expected a share >= 0, got {rigid_below!r}")
    unsure = False
    if isinstance(source, Tracks):
        check_seen(source, "find_skeleton")
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", KcsWarning)  # of depths that nobody sees
            source, unsure = _lifted(source, rigid_below)
    points, weights, joints = _given(source, weights, joints)
    cost, ratio, apart = _variation(points, weights)
    bones = rigid_tree(cost)
    lengths, sway = _of_bones(points, weights, bones)
    ends = bones.unbind(-1)
    loose = (ratio[ends] > rigid_below) | apart[ends] | unsure
    flexible = tuple(loose.nonzero().flatten().tolist())
    _warn(len(flexible) == len(bones), len(bones) > 1 and bool((sway <= rigid_below * lengths).all()), rigid_below)
    return Skeleton(
        joints=tuple(joints) if joints is not None else tuple(f"joint{i}" for i in range(points.shape[1])),
        bones=tuple((int(a), int(b)) for a, b in bones.tolist()),
        name=FOUND,
        proportions=tuple(lengths.tolist()) if bool((lengths > 0).all()) else None,
        flexible=flexible,
    )


def _given(
    source: Reconstruction | Tensor, weights: Tensor | None, joints: Sequence[str] | None
) -> tuple[Tensor, Tensor | None, Sequence[str] | None]:
    """Points (T, N, 3), weights (T, N) and the joints' names, checked."""
    if isinstance(source, Reconstruction):
        weights = source.tracks.weights if weights is None else weights
        joints = source.tracks.skeleton.joints if joints is None else joints
        source = source.points
    given: object = source
    if not isinstance(given, Tensor):
        hint = "torch.as_tensor takes arrays, Skeleton.load a file; kcs_torch.SKELETONS holds the built-in ones"
        raise ShapeError(
            f"find_skeleton: expected tracks, a result or a tensor of points, got {type(given).__name__}: {hint}"
        )
    if source.ndim != 3 or source.shape[-1] != 3 or source.shape[0] < 1 or source.shape[1] < 2:
        raise ShapeError(f"find_skeleton: expected points (T, N, 3) of at least 2 joints, got {tuple(source.shape)}")
    if not torch.isfinite(source).all():
        raise ShapeError("find_skeleton: expected finite points; give weights 0 where a joint is unseen")
    if weights is not None:
        weights = as_floats(weights, "find_skeleton: weights", None).to(source)
        if weights.shape != source.shape[:2]:
            raise ShapeError(f"find_skeleton: expected weights {tuple(source.shape[:2])}, got {tuple(weights.shape)}")
        if not bool((weights.isfinite() & (weights >= 0)).all()):
            raise ShapeError("find_skeleton: expected finite weights of 0 or more, 0 where a joint is unseen")
    if joints is not None and len(joints) != source.shape[1]:
        raise ShapeError(f"find_skeleton: joints: expected {source.shape[1]} names, got {len(joints)}")
    return source, weights, joints


def _lifted(tracks: Tracks, rigid_below: float) -> tuple[Reconstruction, bool]:
    """Tracks in space, and whether nothing says that joints keep their distance. The tracks' own bones tell nothing.

    SfAM alone is off by so much that a good part of the bones in its depths are wrong. PKC corrects it by links between
    many pairs, which are pulled weakly: what varies nonetheless is no bone. Links pull together what is no body, too:
    then no joints keep their distance in SfAM's depths, and PKC's are in doubt.
    """
    joints = tracks.skeleton.joints
    first = SfAM()(replace(tracks, skeleton=Skeleton(joints=joints, bones=(), name="points", tree=False)))
    if tracks.num_joints < LEAST_JOINTS:  # links would hold any depths
        return first, False
    cost, ratio, _ = _variation(first.points, tracks.weights)
    pairs = torch.triu_indices(len(cost), len(cost), 1, device=cost.device)
    least = pairs[:, cost[tuple(pairs)].argsort(stable=True)[: LINKS * len(cost)]]
    links = torch.cat([rigid_tree(cost).sort(-1).values, least.mT]).unique(dim=0)
    body = Skeleton(joints=joints, bones=tuple((int(a), int(b)) for a, b in links), name="links", tree=False)
    found = PKC()(replace(tracks, skeleton=body))
    return found, bool(found.diagnostics.doubt) and bool((ratio[tuple(pairs)] > rigid_below).all())


def _variation(points: Tensor, weights: Tensor | None) -> tuple[Tensor, Tensor, Tensor]:
    """What pairs of joints cost as bones, by what share their lengths vary, and which are never seen together, (N, N).

    Between equally rigid pairs, those of a body at rest say, the shorter is the likelier bone. What was never seen
    together is joined last, and nobody knows how far apart it is.
    """
    mean, spread = distance_spread(points, weights)
    cost, ratio = spread + 1e-3 * mean, spread / mean.clamp_min(torch.finfo(mean.dtype).tiny)
    if weights is None:
        return cost, ratio, torch.zeros_like(cost, dtype=torch.bool)
    apart = torch.minimum(weights[:, :, None], weights[:, None, :]).sum(0) == 0
    return torch.where(apart, 1e3 * (1 + cost.amax()) + mean, cost), ratio, apart


def _of_bones(points: Tensor, weights: Tensor | None, bones: Tensor) -> tuple[Tensor, Tensor]:
    """Median lengths (B,) of bones (B, 2), and how far their directions sway, over frames that show both ends."""
    vectors = bone_vectors(points, bones)
    if weights is not None:
        shown = (weights[:, bones] > 0).all(-1)
        vectors = torch.where((shown | ~shown.any(0))[..., None], vectors, torch.nan)
    lengths = nanmedian(vectors.norm(dim=-1), 0)
    return lengths, (vectors - vectors.nanmean(0)).square().nanmean(0).sum(-1).sqrt()


def _warn(loose: bool, resting: bool, rigid_below: float) -> None:
    """Tell what makes bones a guess."""
    if loose:
        warnings.warn(
            f"find_skeleton: no two joints keep their distance within {100 * rigid_below:g} %, so that no lengths hold "
            "the joints together: give the skeleton, if you know it, or tracks in which the viewpoint turns further",
            KcsWarning,
            stacklevel=users_level(),
        )
    if resting:
        warnings.warn(
            "find_skeleton: a single frame, or a body at rest: all joints keep their distances, and bones join the "
            "nearest. Give the skeleton, if you know it, or tracks in which the body moves",
            KcsWarning,
            stacklevel=users_level(),
        )
