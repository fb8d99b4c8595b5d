"""Full perspective: any method before a pinhole camera, of known focal length or of one that the tracks tell."""

from kcs_torch.methods.perspective.calibrated import reconstruct_perspective
from kcs_torch.methods.perspective.uncalibrated import reconstruct_uncalibrated

__all__ = ["reconstruct_perspective", "reconstruct_uncalibrated"]
