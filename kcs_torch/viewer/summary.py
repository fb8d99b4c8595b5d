"""A result in one line of words."""

from __future__ import annotations

import math

from kcs_torch.errors import counted
from kcs_torch.types import Reconstruction

__all__ = ["summarise"]


def summarise(result: Reconstruction) -> str:
    """Say how long a motion is and what its diagnostics are; what is unknown is left out."""
    d = result.diagnostics
    fps = f" at {result.fps:g} a second" if result.fps else ""
    facts = [
        f"{counted(len(result.points), 'frame')}{fps}",
        f"skeleton {result.skeleton.name}",
        _fact("viewpoint turn {:.0f}°", d.viewpoint_turn),
        _fact("unseen {:.1f} %", 100 * d.unseen_share),
        f"bone variation {d.variation}" if math.isfinite(d.bone_variation) else "",
        _fact(f"reprojection {{:.3g}} {result.tracks.units}", d.reprojection_rms),
        "converged" if d.converged else f"not converged after {d.iterations} iterations",
    ]
    return " · ".join(f for f in facts if f)


def _fact(text: str, value: float) -> str:
    return text.format(value) if math.isfinite(value) else ""
