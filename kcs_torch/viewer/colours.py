"""Which colour a joint or a bone has: one for each side of the body, told apart by colour-blind people too."""

from __future__ import annotations

from kcs_torch.skeleton import Skeleton

__all__ = ["COLOURS", "bone_keys", "bone_side", "joint_keys"]

COLOURS = {
    "left": "#0072b2",
    "right": "#d55e00",
    "centre": "#444444",
    "limb 1": "#0072b2",
    "limb 2": "#d55e00",
    "limb 3": "#009e73",
    "limb 4": "#b5548f",
    "limb 5": "#b98300",
    "limb 6": "#3f8fc4",
}
"""Okabe and Ito's palette, the light ones darkened: sides of a body; limbs of one that has no sides, such as a hand."""

LIMBS = sum(key.startswith("limb") for key in COLOURS)


def bone_side(skeleton: Skeleton, bone: int) -> str:
    """Side of a bone: 'left' or 'right' if an end of it is on that side, 'centre' if none or both are.

    >>> hips = Skeleton.from_names(["hip", "left_hip", "right_hip"], [("hip", "left_hip"), ("hip", "right_hip")])
    >>> [bone_side(hips, b) for b in range(2)]
    ['left', 'right']
    """
    sides = {skeleton.side(joint) for joint in skeleton.bones[bone]} - {"centre"}
    return sides.pop() if len(sides) == 1 else "centre"


def bone_keys(skeleton: Skeleton) -> list[str]:
    """Key of each bone's colour in :data:`COLOURS`: its side, or its limb where no joint has a side.

    >>> fork = Skeleton.from_edges([(0, 1), (1, 2), (0, 3), (3, 4), (0, 5)], 6)
    >>> bone_keys(fork)
    ['limb 1', 'limb 1', 'limb 2', 'limb 2', 'limb 3']
    """
    if skeleton.mirror:
        return [bone_side(skeleton, b) for b in range(skeleton.num_bones)]
    limbs = _limbs(skeleton)
    return [limbs.get(b, "centre") for b in range(skeleton.num_bones)]


def joint_keys(skeleton: Skeleton) -> list[str]:
    """Key of each joint's colour: its side, or that of the limb it is on; joints where limbs meet are centre."""
    if skeleton.mirror:
        return [skeleton.side(j) for j in range(skeleton.num_joints)]
    touching: list[set[str]] = [set() for _ in skeleton.joints]
    for (a, b), key in zip(skeleton.bones, bone_keys(skeleton), strict=True):
        touching[a].add(key)
        touching[b].add(key)
    return [keys.pop() if len(keys) == 1 else "centre" for keys in touching]


def _limbs(skeleton: Skeleton) -> dict[int, str]:
    """Bones on the way from each end to the first joint where three bones meet, limbs in the order of the bones."""
    at: list[list[int]] = [[] for _ in skeleton.joints]
    for bone, ends in enumerate(skeleton.bones):
        for joint in ends:
            at[joint].append(bone)
    chains = []
    for end in (j for j in range(skeleton.num_joints) if len(at[j]) == 1):
        joint, chain = end, [at[end][0]]
        while True:
            a, b = skeleton.bones[chain[-1]]
            joint = b if joint == a else a
            if len(at[joint]) != 2:
                break
            chain.append(next(b for b in at[joint] if b != chain[-1]))
        chains.append(chain)
    if len(chains) < 3:  # a stick has no limbs
        return {}
    chains.sort(key=min)
    return {bone: f"limb {k % LIMBS + 1}" for k, chain in enumerate(chains) for bone in chain}
