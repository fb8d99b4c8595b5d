"""How far motion is from the truth: functions of tensors with the alignment named; :func:`compare` takes motion."""

from kcs_torch.metrics.align import ALIGNMENTS, align
from kcs_torch.metrics.compare import Comparison, compare
from kcs_torch.metrics.errors import bone_deviation, e3d, mpjpe, pck
from kcs_torch.metrics.solutions import Difference, difference

__all__ = [
    "ALIGNMENTS",
    "Comparison",
    "Difference",
    "align",
    "bone_deviation",
    "compare",
    "difference",
    "e3d",
    "mpjpe",
    "pck",
]
