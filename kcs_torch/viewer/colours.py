"""Which colour a joint or a bone has: one for each side of the body, told apart by colour-blind people too."""

from __future__ import annotations

from kcs_torch.skeleton import Skeleton

__all__ = ["COLOURS", "bone_side"]

COLOURS = {"left": "#0072b2", "right": "#d55e00", "centre": "#444444"}
"""Blue, vermilion and grey of Okabe and Ito's palette."""


def bone_side(skeleton: Skeleton, bone: int) -> str:
    """Side of a bone: 'left' or 'right' if an end of it is on that side, 'centre' if none or both are.

    >>> hips = Skeleton.from_names(["hip", "left_hip", "right_hip"], [("hip", "left_hip"), ("hip", "right_hip")])
    >>> [bone_side(hips, b) for b in range(2)]
    ['left', 'right']
    """
    sides = {skeleton.side(joint) for joint in skeleton.bones[bone]} - {"centre"}
    return sides.pop() if len(sides) == 1 else "centre"
