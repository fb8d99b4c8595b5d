"""What goes in and what comes out: :class:`Tracks`, :class:`Intrinsics`, :class:`Reconstruction`, :class:`Motion`.

Everything that a user passes is checked here, once.
"""

from kcs_torch.types.angles import JointAngles
from kcs_torch.types.intake import as_floats
from kcs_torch.types.intrinsics import Intrinsics
from kcs_torch.types.motion import Motion
from kcs_torch.types.reconstruction import Diagnostics, Reconstruction
from kcs_torch.types.tracks import Tracks
from kcs_torch.types.variation import BoneVariation

__all__ = [
    "BoneVariation",
    "Diagnostics",
    "Intrinsics",
    "JointAngles",
    "Motion",
    "Reconstruction",
    "Tracks",
    "as_floats",
]
