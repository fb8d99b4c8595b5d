"""Detections that no body of usual proportions could make."""

from __future__ import annotations

import torch
from torch import Tensor

from kcs_torch.functional.chain import bone_vectors
from kcs_torch.skeleton import Skeleton

__all__ = ["plausible"]

LONG = 2.0
"""An image longer than so many usual lengths is no bone's."""

SELDOM = 3
"""Joints that are seen in fewer frames tell nothing of their bones' lengths."""


def plausible(points: Tensor, seen: Tensor, skeleton: Skeleton) -> Tensor:
    """Which detections to keep, (T, N): a joint is dropped where all its bones look far too long.

    What is too long is told by the skeleton's usual lengths, at the scale at which most bones look as long as they are.
    Joints that are then left in hardly any frame are dropped altogether, as long as others are seen often.

    Args:
        points: (T, N, 2).
        seen: (T, N) bool.
        skeleton: of the N joints.

    Returns:
        (T, N), False where unseen.
    """
    often = seen.sum(0) >= SELDOM
    if bool(often.any()):
        seen = seen & often
    usual = skeleton.relative_lengths(dtype=points.dtype, device=points.device)
    if usual is None:
        return seen
    bones = skeleton.bone_index(device=points.device)
    both = seen[:, bones[:, 0]] & seen[:, bones[:, 1]]  # (T, B)
    rigid = torch.zeros(len(bones), dtype=torch.bool, device=points.device)
    rigid[list(skeleton.rigid)] = True
    use = rigid & both.any(0) & (usual > 0)
    if not bool(use.any()):
        return seen
    flat = bone_vectors(points, bones)
    flat = torch.where(both[..., None], flat, torch.zeros_like(flat))
    longest = torch.where(both, flat.norm(dim=-1), torch.nan)[:, use].nanquantile(0.985, 0)
    scale = torch.quantile(longest / usual[use], 0.5)
    far = both & use & (flat.norm(dim=-1) > LONG * scale * usual)
    count = torch.zeros_like(points[..., 0])
    wrong = count.clone()
    for end in (0, 1):
        count = count.index_add(1, bones[:, end], both.to(count))
        wrong = wrong.index_add(1, bones[:, end], far.to(count))
    kept = seen & ~((wrong > 0) & (wrong == count))
    often = kept.sum(0) >= SELDOM
    return kept & often if bool(often.any()) else kept
