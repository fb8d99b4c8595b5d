"""The figures as ``torchmetrics.Metric`` classes: summed over batches and processes, then divided once."""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from kcs_torch.functional.align import check_alignment
from kcs_torch.metrics.errors import Bones, bone_deviation, bone_pairs, check_threshold, distances, e3d
from kcs_torch.skeleton import get_skeleton

try:
    from torchmetrics import Metric
except ModuleNotFoundError as reason:
    if reason.name != "torchmetrics":
        raise
    raise ModuleNotFoundError(
        "kcs_torch.metrics: MPJPE, PCK, E3D and BoneDeviation need the package torchmetrics: "
        "pip install torchmetrics. The functions mpjpe, pck, e3d and bone_deviation do without it.",
        name="torchmetrics",
    ) from None

__all__ = ["E3D", "MPJPE", "PCK", "BoneDeviation"]


class _Mean(Metric):
    """A weighted mean, whose sums are states.

    A ``MetricCollection`` takes metrics for the same whose states have the same names, and the same values after the
    first batch, and updates only one of them from there on: the names tell what is measured.

    Args:
        measured: what else than the class tells metrics apart.
        beside: more of it, of a class derived.
        options: of ``torchmetrics.Metric``.
    """

    is_differentiable = False
    full_state_update = False
    plot_lower_bound = 0.0

    def __init__(self, *measured: object, beside: object = None, **options: Any) -> None:
        super().__init__(**options)
        key = hashlib.sha256(repr((type(self).__name__, *measured, beside)).encode()).hexdigest()[:16]
        self._total, self._count = f"total_{key}", f"count_{key}"
        for name in (self._total, self._count):
            self.add_state(name, torch.zeros((), dtype=torch.float64), dist_reduce_fx="sum")

    @property
    def total(self) -> Tensor:
        """The sum of what has been added."""
        return getattr(self, self._total)

    @property
    def count(self) -> Tensor:
        """How much that was."""
        return getattr(self, self._count)

    def _add(self, values: Tensor, mass: Tensor) -> None:
        mass = mass.to(values).clamp_min(0).expand(values.shape)
        values = torch.where(mass > 0, values, torch.zeros_like(values))  # NaN where nothing counts
        total = self.total + (values.detach().double() * mass).sum()  # not in place: Lightning validates in inference
        count = self.count + mass.double().sum()  # mode, whose tensors nothing may change later
        setattr(self, self._total, total)
        setattr(self, self._count, count)

    def compute(self) -> Tensor:
        """Return the mean over all that has been added; NaN where nothing counted."""
        return (self.total / self.count).float()


class MPJPE(_Mean):
    """Mean distance of the joints after the alignment named: :func:`kcs_torch.metrics.mpjpe` over all batches.

    Args:
        align: a name in :data:`~kcs_torch.metrics.ALIGNMENTS`: ``similarity`` gives PA-MPJPE, ``scale`` N-MPJPE;
            ``sequence`` turns and scales each clip as one. Never mirrored.
        root: index of the root joint for ``root`` and ``scale``; the middle of all joints if None.
        options: of ``torchmetrics.Metric``.

    Raises:
        OptionError: there is no such alignment, or the root is no index.

    >>> metric = MPJPE(align="none")
    >>> truth = torch.zeros(2, 1, 2, 3)
    >>> metric.update(truth + torch.tensor([3.0, 4, 0]), truth)
    >>> metric.compute()
    tensor(5.)
    """

    higher_is_better = False

    def __init__(self, align: str = "root", *, root: int | None = None, **options: Any) -> None:
        super().__init__(align, root, **options)
        check_alignment(align, root)
        self.align, self.root = align, root

    def extra_repr(self) -> str:
        return f"align={self.align!r}, root={self.root!r}"

    def update(self, pred: Tensor, truth: Tensor, weights: Tensor | None = None) -> None:
        """Add a batch of clips.

        Args:
            pred: (..., T, N, 3).
            truth: (..., T, N, 3).
            weights: (..., T, N), 0 where a joint of the truth is unknown, whatever stands there; all 1 if None.

        Raises:
            ShapeError: the shapes differ, or a number that counts is not finite.
        """
        self._add(*self._measure(pred, truth, weights))

    def _measure(self, pred: Tensor, truth: Tensor, weights: Tensor | None) -> tuple[Tensor, Tensor]:
        distance, mass = distances(pred, truth, self.align, weights, self.root)
        return distance, torch.ones_like(distance) if mass is None else mass


class PCK(MPJPE):
    """Share of joints that are near the truth: :func:`kcs_torch.metrics.pck` over all batches.

    Args:
        threshold: in the unit of the truth; 150 mm is usual.
        align: as of :class:`MPJPE`.
        root: as of :class:`MPJPE`.
        options: of ``torchmetrics.Metric``.

    Raises:
        OptionError: there is no such alignment, or the threshold is no number or negative.
    """

    higher_is_better = True
    plot_upper_bound = 1.0

    def __init__(self, threshold: float, align: str = "root", *, root: int | None = None, **options: Any) -> None:
        super().__init__(align, root=root, beside=threshold, **options)
        check_threshold(threshold, "PCK")
        self.threshold = threshold

    def extra_repr(self) -> str:
        return f"threshold={self.threshold:g}, {super().extra_repr()}"

    def _measure(self, pred: Tensor, truth: Tensor, weights: Tensor | None) -> tuple[Tensor, Tensor]:
        distance, mass = super()._measure(pred, truth, weights)
        return (distance <= self.threshold).to(distance), mass


class E3D(_Mean):
    """Mean over the clips of the normalised error of non-rigid structure from motion, :func:`kcs_torch.metrics.e3d`.

    One orthogonal matrix for a clip, which may mirror, as papers have it. Clips without any known joint, or whose truth
    is a point, do not count.
    """

    higher_is_better = False

    def update(self, pred: Tensor, truth: Tensor, weights: Tensor | None = None) -> None:
        """Add a batch of clips, as :meth:`MPJPE.update`."""
        value = e3d(pred, truth, weights=weights)
        self._add(value, ~torch.isnan(value))


class BoneDeviation(_Mean):
    """Mean over the clips of how far bones are from rigid, :func:`kcs_torch.metrics.bone_deviation`; needs no truth.

    Args:
        bones: (B, 2) joint indices, or a :class:`~kcs_torch.Skeleton` (a name, a file), whose rigid bones are taken.
        options: of ``torchmetrics.Metric``.

    Raises:
        ShapeError: there are no bones.
    """

    higher_is_better = False

    def __init__(self, bones: Bones, **options: Any) -> None:
        bones = get_skeleton(bones) if isinstance(bones, (str, Path)) else bones
        super().__init__(bone_pairs(bones).tolist(), **options)
        self.bones = bones

    def update(self, pred: Tensor, weights: Tensor | None = None) -> None:
        """Add a batch of clips (..., T, N, 3) with weights (..., T, N), 0 where a joint is unknown.

        In a ``MetricCollection`` with others name the arguments: ``update(pred=..., truth=...)``.

        Raises:
            ShapeError: the shapes do not fit, or an end of a bone that counts is not finite.
        """
        value = bone_deviation(pred, self.bones, weights=weights)
        self._add(value, ~torch.isnan(value))
