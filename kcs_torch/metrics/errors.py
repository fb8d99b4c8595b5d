"""The figures that papers print, each for a batch of clips."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import torch
from torch import Tensor

from kcs_torch.errors import OptionError, ShapeError
from kcs_torch.functional import bone_lengths, centre, nearest_rotation
from kcs_torch.functional.ranks import nanmedian
from kcs_torch.metrics.align import align as aligned
from kcs_torch.metrics.align import check_tensors
from kcs_torch.skeleton import Skeleton, get_skeleton

__all__ = ["Bones", "bone_deviation", "bone_pairs", "distances", "e3d", "mpjpe", "pck"]

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
        weights: (..., T, N), 0 where a joint of the truth is unknown; all 1 if None.
        root: index of the root joint for ``root`` and ``scale``; the middle of all joints if None.

    Returns:
        (...), in the unit of the truth; NaN where nothing counts.

    Raises:
        ShapeError: the shapes differ.
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
        OptionError: there is no such alignment, or the threshold is negative.
    """
    if not threshold >= 0:
        raise OptionError(f"pck: expected a threshold of at least 0, got {threshold}")
    distance, mass = distances(pred, truth, align, weights, root)
    return _mean((distance <= threshold).to(distance), mass)


def e3d(pred: Tensor, truth: Tensor, *, weights: Tensor | None = None) -> Tensor:
    """Normalised error of non-rigid structure from motion (Akhter, Sheikh, Khan, Kanade 2008).

    Frames are centred; one orthogonal matrix, which may mirror, turns all frames of the prediction onto the truth; then
    the mean distance is divided by the mean standard deviation of the true joints along the axes.

    Args:
        pred: (..., T, N, 3).
        truth: (..., T, N, 3).
        weights: (..., T, N), 0 where a joint of the truth is unknown; all 1 if None.

    Returns:
        (...), without unit.

    Raises:
        ShapeError: the shapes differ.
    """
    pred = aligned(pred, truth, "none", weights=weights)  # checks the shapes; at least in single precision
    truth = truth.to(pred)
    mass = torch.ones_like(truth[..., 0]) if weights is None else weights.to(truth)
    source, target = centre(pred, mass)[0], centre(truth, mass)[0]
    with torch.autocast(pred.device.type, enabled=False):
        left = (source * mass[..., None]).flatten(-3, -2)
        turn = nearest_rotation(left.mT @ target.flatten(-3, -2), reflect=True)
        distance = (source @ turn[..., None, :, :] - target).norm(dim=-1)
    count = mass.sum(-1, keepdim=True)
    count = torch.where(count > 0, count, torch.ones_like(count))
    spread = ((target.square() * mass[..., None]).sum(-2) / count).sqrt()  # (..., T, 3)
    known = (mass.sum(-1) > 0).to(mass)
    return _mean(distance, weights) / ((spread.mean(-1) * known).sum(-1) / known.sum(-1))


def bone_deviation(points: Tensor, bones: Bones, *, weights: Tensor | None = None) -> Tensor:
    """Median over the bones of their length's standard deviation over the mean: how far they are from rigid.

    Args:
        points: (..., T, N, 3).
        bones: (B, 2) joint indices, or a :class:`~kcs_torch.Skeleton` (a name, a file), whose rigid bones are taken.
        weights: (..., T, N), 0 where a joint is unknown, whatever stands there; all 1 if None.

    Returns:
        (...), a share: 0.01 is 1 per cent.

    Raises:
        ShapeError: there are no bones.

    >>> points = torch.tensor([[[0.0, 0, 0], [0, 9, 0]], [[0, 0, 0], [0, 11, 0]]])
    >>> round(bone_deviation(points, [(0, 1)]).item(), 4)
    0.1
    """
    check_tensors(points=points, weights=weights)
    index = bone_pairs(bones).to(points.device)
    points = points.to(torch.promote_types(points.dtype, torch.float32))
    lengths = bone_lengths(points, index)  # (..., T, B)
    mass = torch.ones_like(lengths)
    if weights is not None:
        mass = (weights[..., index[:, 0]] > 0).to(points) * (weights[..., index[:, 1]] > 0).to(points)
        lengths = torch.where(mass > 0, lengths, torch.zeros_like(lengths))
    count = mass.sum(-2)
    mean = (lengths * mass).sum(-2) / count
    spread = ((lengths - mean[..., None, :]).square() * mass).sum(-2).div(count).sqrt()
    return nanmedian(spread / mean, -1)


def bone_pairs(bones: Bones) -> Tensor:
    """The (B, 2) joint indices of bones; of a skeleton, of those that are rigid.

    Raises:
        ShapeError: there are no bones.
        SkeletonError: there is no skeleton of that name.
    """
    if isinstance(bones, (str, Path, Skeleton)):
        body = get_skeleton(bones)
        bones = body.bone_index()[list(body.rigid)]
    index = torch.as_tensor(bones)
    if index.ndim != 2 or not len(index):
        raise ShapeError(f"bones: expected pairs of joints, got shape {tuple(index.shape)}")
    return index


def distances(
    pred: Tensor, truth: Tensor, align: str, weights: Tensor | None, root: int | None
) -> tuple[Tensor, Tensor | None]:
    """Distances (..., T, N) after alignment, and how much each counts: nothing where the root is needed and unknown."""
    distance = (aligned(pred, truth, align, weights=weights, root=root) - truth).norm(dim=-1)
    if weights is not None and root is not None and align in ("root", "scale"):
        weights = weights * (weights[..., root, None] > 0)
    return distance, weights


def _mean(values: Tensor, weights: Tensor | None) -> Tensor:
    """Weighted mean over frames and joints: (..., T, N) -> (...)."""
    if weights is None:
        return values.mean((-2, -1))
    weights = weights.to(values)  # sums of half precision would be rounded, or infinite
    return (values * weights).sum((-2, -1)) / weights.sum((-2, -1))
