"""How far motion is from the truth: functions of tensors with the alignment named; :func:`compare` takes motion."""

from kcs_torch.metrics.align import ALIGNMENTS, align
from kcs_torch.metrics.compare import Comparison, compare
from kcs_torch.metrics.errors import bone_deviation, e3d, mpjpe, pck

__all__ = ["ALIGNMENTS", "Comparison", "align", "bone_deviation", "compare", "e3d", "mpjpe", "pck"]
