"""Look at results: :func:`player`, a page with a 3D player, and :func:`sheet`, a figure of key frames."""

from kcs_torch.viewer.html import player
from kcs_torch.viewer.sheet import sheet

__all__ = ["player", "sheet"]
