"""How far motion is from the truth: functions of tensors with the alignment named; :func:`compare` takes motion.

``MPJPE``, ``PCK``, ``E3D`` and ``BoneDeviation`` are the same figures as ``torchmetrics.Metric`` classes, summed over
batches and processes. They need the extra ``train``, and are loaded when first used.
"""

import importlib
import importlib.util
from typing import TYPE_CHECKING, Any

from kcs_torch.metrics.align import ALIGNMENTS, align
from kcs_torch.metrics.compare import Comparison, compare
from kcs_torch.metrics.errors import bone_deviation, coverage, e3d, mpjpe, pck
from kcs_torch.metrics.solutions import Difference, difference

if TYPE_CHECKING:
    from kcs_torch.metrics.torch_metrics import E3D, MPJPE, PCK, BoneDeviation

__all__ = [
    "ALIGNMENTS",
    "Comparison",
    "Difference",
    "align",
    "bone_deviation",
    "compare",
    "coverage",
    "difference",
    "e3d",
    "mpjpe",
    "pck",
]

_CLASSES = ("E3D", "MPJPE", "PCK", "BoneDeviation")

if importlib.util.find_spec("torchmetrics") is not None:
    __all__ += ["E3D", "MPJPE", "PCK", "BoneDeviation"]


def __getattr__(name: str) -> Any:
    if name not in _CLASSES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(importlib.import_module("kcs_torch.metrics.torch_metrics"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*__all__, *_CLASSES})
