"""How far motion is from the truth: functions of tensors, each with its alignment named."""

from kcs_torch.metrics.align import ALIGNMENTS, align
from kcs_torch.metrics.errors import bone_deviation, e3d, mpjpe, pck

__all__ = ["ALIGNMENTS", "align", "bone_deviation", "e3d", "mpjpe", "pck"]
