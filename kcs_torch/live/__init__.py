"""3D at once: frames go in one at a time, poses come out."""

from kcs_torch.live.pose import LivePose
from kcs_torch.live.tracker import Tracker

__all__ = ["LivePose", "Tracker"]
