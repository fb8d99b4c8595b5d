"""3D at once: frames go in one at a time, poses come out."""

from kcs_torch.live.tracker import LivePose, Tracker

__all__ = ["LivePose", "Tracker"]
