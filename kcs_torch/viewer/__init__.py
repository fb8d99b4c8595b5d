"""Look at tracks and results.

:func:`player`: a page with a 3D player. :func:`sheet`: a figure of key frames. :func:`animation`: a film.
:func:`draw_tracks` and :func:`draw_skeleton`: which joint is which.
"""

from kcs_torch.viewer.animation import animation
from kcs_torch.viewer.draw import draw_skeleton, draw_tracks
from kcs_torch.viewer.html import player
from kcs_torch.viewer.sheet import sheet

__all__ = ["animation", "draw_skeleton", "draw_tracks", "player", "sheet"]
