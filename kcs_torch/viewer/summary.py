"""Results in one line of words, and what is doubtful about them."""

from __future__ import annotations

import math
from collections.abc import Sequence

from kcs_torch.errors import counted
from kcs_torch.types import Reconstruction

__all__ = ["doubts", "summarise"]


def summarise(result: Reconstruction) -> str:
    """Say how long a motion is and what its diagnostics are; what is unknown is left out."""
    d = result.diagnostics
    fps = f" at {result.fps:g} a second" if result.fps else ""
    several = len(result.points) > 1
    facts = [
        f"{counted(len(result.points), 'frame')}{fps}",
        f"skeleton {result.skeleton.name}",
        _fact("viewpoint turn {:.0f}°", d.viewpoint_turn) if several else "",
        _fact("unseen {:.1f} %", 100 * d.unseen_share),
        f"bone variation {d.variation}" if several and math.isfinite(d.bone_variation) else "",
        _fact(f"reprojection {{:.3g}} {result.tracks.units}", d.reprojection_rms),
        ("converged" if d.iterations else "") if d.converged else f"not converged after {d.iterations} iterations",
    ]
    return " · ".join(f for f in facts if f)


def doubts(results: Sequence[Reconstruction], names: Sequence[str]) -> list[str]:
    """Say whose depth is hardly to be believed: of one body with the reasons, of several a line for those alike."""
    if len(results) == 1:
        return [result.diagnostics.doubt for result in results if result.diagnostics.doubt]
    who: dict[str, list[str]] = {}
    for result, name in zip(results, names, strict=True):
        who.setdefault(result.diagnostics.brief_doubt, []).append(name)
    return [f"{doubt}: {', '.join(who[doubt])}" for doubt in who if doubt]


def _fact(text: str, value: float) -> str:
    return text.format(value) if math.isfinite(value) else ""
