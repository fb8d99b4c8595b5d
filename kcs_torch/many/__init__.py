"""Thousands of clips: a folder of tracks to a folder of motion, in parts that can be stopped and taken up again."""

from kcs_torch.many.clips import Clip, clips_of
from kcs_torch.many.folder import Outcome, reconstruct_folder

__all__ = ["Clip", "Outcome", "clips_of", "reconstruct_folder"]
