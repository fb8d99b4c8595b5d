"""From a video to 2D tracks, by a detector of others that runs on this machine. An extra: nothing else needs it."""

from kcs_torch.detect.run import DETECTORS, detect_video

__all__ = ["DETECTORS", "detect_video"]
