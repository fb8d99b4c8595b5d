"""Tracks cleaned before they are lifted, and motion smoothed after; each function returns a copy that says what it did.

Nothing here happens unasked, but that ``pkc`` begins with ``unswap``. Methods deal with noise, gaps and outliers by
themselves (``pkc`` does), so that the rest is for what one knows better than they: a cut-off that a field expects, a
frame rate, a part of a clip. Where a film has cuts, each shot is cleaned by itself.
"""

from kcs_torch.clean.gaps import fill
from kcs_torch.clean.gating import gate
from kcs_torch.clean.sides import unswap
from kcs_torch.clean.smoothing import SMOOTHERS, smooth
from kcs_torch.clean.timing import resample, split, trim

__all__ = ["SMOOTHERS", "fill", "gate", "resample", "smooth", "split", "trim", "unswap"]
