"""The figures that papers print, each for a batch of clips; weights below 0 count as 0."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from kcs_torch.errors import OptionError, ShapeError
from kcs_torch.functional import bone_lengths, centre, nearest_rotation
from kcs_torch.functional.chain import incidence, index_rows
from kcs_torch.functional.guarded import LOST, largest, or_one, safe_root
from kcs_torch.functional.precision import wide
from kcs_torch.functional.ranks import nanmedian
from kcs_torch.functional.shapes import check_core
from kcs_torch.functional.weights import known
from kcs_torch.metrics.align import align as aligned
from kcs_torch.metrics.align import check_finite, first_of
from kcs_torch.skeleton import Skeleton, get_skeleton

__all__ = ["Bones", "bone_deviation", "bone_pairs", "coverage", "distances", "e3d", "mpjpe", "pck"]

Bones = Tensor | Sequence[tuple[int, int]] | str | Path | Skeleton
"""What :func:`bone_pairs` takes."""


def mpjpe(
    pred: Tensor, truth: Tensor, *, align: str = "root", weights: Tensor | None = None, root: int | None = None
) -> Tensor:
    """Mean distance of the joints after the alignment named: mean_tn |pred_tn - truth_tn|.

    Args:
        pred: (..., T, N, 3).
        truth: (..., T, N, 3).
        align: a name in :data:`~kcs_torch.metrics.ALIGNMENTS`: ``similarity`` gives PA-MPJPE, ``scale`` N-MPJPE,
            ``rigid`` the 3D error of kinematic chain space.
        weights: (..., T, N), 0 where a joint of the truth is unknown, whatever stands there; all 1 if None.
        root: index of the root joint for ``root`` and ``scale``; the middle of all joints if None.

    Returns:
        (...), in the unit of the truth; NaN where nothing counts.

    Raises:
        ShapeError: the shapes differ, or a number that counts is not finite.
        OptionError: there is no such alignment.

    >>> truth = torch.zeros(1, 2, 3)
    >>> mpjpe(truth + torch.tensor([3.0, 4, 0]), truth, align="none").item()
    5.0
    """
    return _mean(*distances(pred, truth, align, weights, root))


def pck(
    pred: Tensor,
    truth: Tensor,
    threshold: float,
    *,
    align: str = "root",
    weights: Tensor | None = None,
    root: int | None = None,
) -> Tensor:
    """Share of joints that are at most ``threshold`` from the truth after the alignment named.

    Args:
        pred: (..., T, N, 3).
        truth: (..., T, N, 3).
        threshold: in the unit of the truth; 150 mm is usual.
        align: as of :func:`mpjpe`.
        weights: as of :func:`mpjpe`.
        root: as of :func:`mpjpe`.

    Returns:
        (...), 0 to 1.

    Raises:
        ShapeError: the shapes differ.
        OptionError: there is no such alignment, or the threshold is no number or negative.
    """
    check_threshold(threshold, "pck")
    distance, mass = distances(pred, truth, align, weights, root)
    return _mean((distance <= threshold).to(distance), mass)


def check_threshold(threshold: Any, what: str) -> None:
    """Raise an OptionError unless a threshold is a number, at least 0."""
    try:
        fits = not isinstance(threshold, (bool, str)) and float(threshold) >= 0
    except (TypeError, ValueError, RuntimeError):  # RuntimeError: a tensor of several
        fits = False
    if not fits:
        raise OptionError(f"{what}: expected a threshold of at least 0, got {threshold!r}")


def e3d(pred: Tensor, truth: Tensor, *, weights: Tensor | None = None) -> Tensor:
    """Normalised error of non-rigid structure from motion (Akhter, Sheikh, Khan, Kanade 2008).

    Frames are centred; one orthogonal matrix, which may mirror, turns all frames of the prediction onto the truth; then
    the mean distance is divided by the mean standard deviation of the true joints along the axes.

    Args:
        pred: (..., T, N, 3).
        truth: (..., T, N, 3).
        weights: (..., T, N), 0 where a joint of the truth is unknown, whatever stands there; all 1 if None.

    Returns:
        (...), without unit; NaN where nothing counts, or the truth is a point.

    Raises:
        ShapeError: the shapes differ, or a number that counts is not finite.
    """
    pred, truth = _counted(pred, weights), _counted(truth, weights)
    pred = aligned(pred, truth, "none", weights=weights)  # checks the shapes; at least in single precision
    truth = truth.to(pred)
    mass = torch.ones_like(truth[..., 0]) if weights is None else weights.to(truth).clamp_min(0)
    source, target = centre(pred, mass)[0], centre(truth, mass)[0]
    with torch.autocast(pred.device.type, enabled=False):
        left = (source * mass[..., None]).flatten(-3, -2)
        turn = nearest_rotation(left.mT @ target.flatten(-3, -2), reflect=True)
        distance = (source @ turn[..., None, :, :] - target).norm(dim=-1)
    count = mass.sum(-1, keepdim=True)
    count = or_one(count)
    spread = safe_root((target.square() * mass[..., None]).sum(-2) / count)  # (..., T, 3)
    some = (mass.sum(-1) > 0).to(mass)
    size = (spread.mean(-1) * some).sum(-1) / some.sum(-1)
    lost = LOST * torch.finfo(truth.dtype).eps * largest(truth, 3, mass[..., None] > 0)[..., 0, 0, 0]
    return _mean(distance, weights) / torch.where(size > lost, size, torch.nan)


def coverage(
    pred: Tensor, deviation: Tensor, truth: Tensor, *, scale: bool = False, weights: Tensor | None = None
) -> Tensor:
    """Share of the depths that are off by no more than their standard deviation: about .68 where deviations are true.

    Depths count from the middle of each frame's joints. Parallel rays do not tell the sign of depth: of a clip and its
    mirror image, the nearer one counts.

    Args:
        pred: (..., T, N, 3), in the camera's frame, as a :class:`~kcs_torch.Reconstruction` has its ``points``.
        deviation: (..., T, N) standard deviations of its depths, in its unit, not negative: the ``uncertainty``.
        truth: (..., T, N, 3), in the same camera's frame.
        scale: take the size from the truth first, one factor for a clip and its deviations; where both have one unit
            there is no need.
        weights: (..., T, N), 0 where a joint of the truth is unknown, whatever stands there; all 1 if None.

    Returns:
        (...), 0 to 1; NaN where nothing counts.

    Raises:
        ShapeError: the shapes differ, or a number that counts is not finite, or a deviation that counts negative.

    >>> truth = torch.tensor([[[0.0, 0, -1], [0, 1, 0], [0, 2, 1]]])
    >>> coverage(1.2 * truth, torch.full((1, 3), 0.1), truth).item()
    0.3333333432674408
    """
    check_core(pred, "coverage: pred", "T", "N", 3)
    check_core(deviation, "coverage: deviation", *pred.shape[-3:-1])
    pred, truth = _counted(pred, weights), _counted(truth, weights)
    pred = aligned(pred, truth, "none", weights=weights)  # checks the rest; at least in single precision
    mass = torch.ones_like(pred[..., 0]) if weights is None else weights.to(pred).clamp_min(0)
    source, target = centre(pred, mass)[0], centre(truth.to(pred), mass)[0]
    odd = (mass > 0) & ~(deviation.isfinite() & (deviation >= 0))
    if bool(odd.any()):
        value, where = first_of(deviation.expand(odd.shape), odd)
        raise ShapeError(f"coverage: deviation: expected finite numbers >= 0, got {value} at {where}")
    each, factor = mass[..., None], mass.new_ones(mass.shape[:-2])

    def summed(values: Tensor) -> Tensor:
        return (values * each).sum((-3, -2, -1))

    flip = pred.new_tensor([1.0, 1.0, -1.0])
    turn = summed((source * target)[..., 2:]) < 0  # whose depths agree are nearer than their mirror image
    source = torch.where(turn[..., None, None, None], source * flip, source)
    if scale:
        factor = summed(source * target) / or_one(summed(source.square()))
    off = (factor[..., None, None] * source[..., 2] - target[..., 2]).abs()
    return _mean((off <= factor[..., None, None] * deviation.to(off)).to(off), weights)


def bone_deviation(points: Tensor, bones: Bones, *, weights: Tensor | None = None) -> Tensor:
    """Median over the bones of their length's standard deviation over the mean: how far they are from rigid.

    Of an even number of bones it is the lower of the two in the middle.

    Args:
        points: (..., T, N, 3).
        bones: (B, 2) joint indices, or a :class:`~kcs_torch.Skeleton` (a name, a file), whose rigid bones are taken.
        weights: (..., T, N), 0 where a joint is unknown, whatever stands there; all 1 if None.

    Returns:
        (...), a share: 0.01 is 1 per cent; NaN where no bone is known. The derivative is 0 where a length is constant.

    Raises:
        ShapeError: there are no bones, or the shapes do not fit them, or an end of a bone that counts is not finite.

    >>> points = torch.tensor([[[0.0, 0, 0], [0, 9, 0]], [[0, 0, 0], [0, 11, 0]]])
    >>> round(bone_deviation(points, [(0, 1)]).item(), 4)
    0.1
    """
    check_core(points, "bone_deviation: points", "T", "N", 3)
    index = bone_pairs(bones, points.shape[-2]).to(points.device)
    mass = torch.ones_like(points[..., 0], dtype=torch.bool)
    if weights is not None:
        check_core(weights, "bone_deviation: weights", *points.shape[-3:-1])
        mass = mass & (weights > 0)
    both = mass[..., index[:, 0]] & mass[..., index[:, 1]]  # (..., T, B)
    ends = both.to(torch.float32) @ incidence(index, points.shape[-2], dtype=torch.float32).abs().mT > 0
    points = torch.where(ends[..., None], points, 0.0)
    check_finite(points=points)
    lengths = bone_lengths(wide(points), index)
    share = both.to(lengths)
    count = share.sum(-2).clamp_min(1)
    mean = (lengths * share).sum(-2) / count
    spread = safe_root(((lengths - mean[..., None, :]).square() * share).sum(-2) / count)
    there = mean > 0
    return nanmedian(torch.where(there, spread / torch.where(there, mean, 1), torch.nan), -1)


def bone_pairs(bones: Bones, joints: int | None = None) -> Tensor:
    """The (B, 2) joint indices of bones; of a skeleton, of those that are rigid.

    Raises:
        ShapeError: there are no bones, or they are not those of so many ``joints``.
        SkeletonError: there is no skeleton of that name.
    """
    if isinstance(bones, (str, Path, Skeleton)):
        body = get_skeleton(bones)
        if joints not in (None, body.num_joints):
            expected = f"points of the {body.num_joints} joints of skeleton '{body.name}'"
            raise ShapeError(f"bones: expected {expected}, got {joints} joints")
        bones = body.bone_index()[list(body.rigid)]
    index = index_rows(bones, joints)
    if not len(index):
        raise ShapeError("bones: expected pairs of joints, got none")
    if joints is not None and isinstance(bones, Tensor) and not (index.is_meta or torch.compiler.is_compiling()):
        low, high = int(index.min()), int(index.max())
        if low < 0 or high >= joints:
            raise ShapeError(f"bones: expected joint indices 0..{joints - 1}, got {low}..{high}")
    return index


def distances(
    pred: Tensor, truth: Tensor, align: str, weights: Tensor | None, root: int | None
) -> tuple[Tensor, Tensor | None]:
    """Distances (..., T, N) after alignment, and how much each counts: nothing where the root is needed and unknown."""
    pred, truth = _counted(pred, weights), _counted(truth, weights)
    distance = (aligned(pred, truth, align, weights=weights, root=root) - truth).norm(dim=-1)
    if weights is not None and root is not None and align in ("root", "scale"):
        weights = weights * (weights[..., root, None] > 0)
    return distance, weights


def _counted(points: Tensor, weights: Tensor | None) -> Tensor:
    """Points, 0 where they do not count; what is no tensor or does not fit is told later."""
    fit = isinstance(points, Tensor) and isinstance(weights, Tensor) and weights.shape == points.shape[:-1]
    return known(points, weights) if fit else points


def _mean(values: Tensor, weights: Tensor | None) -> Tensor:
    """Weighted mean over frames and joints: (..., T, N) -> (...)."""
    if weights is None:
        return values.mean((-2, -1))
    weights = weights.to(values).clamp_min(0)  # sums of half precision would be rounded, or infinite
    return (values * weights).sum((-2, -1)) / weights.sum((-2, -1))
