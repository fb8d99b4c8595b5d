"""Bodies of too few joints for a viewpoint to tell anything: depths that keep bones' lengths."""

from __future__ import annotations

import torch
from torch import Tensor

from kcs_torch.functional.chain import bone_lengths, bone_vectors, chain_inverse, incidence
from kcs_torch.functional.ranks import median
from kcs_torch.skeleton import Skeleton

__all__ = ["with_lengths_held"]


def with_lengths_held(image: Tensor, points: Tensor, skeleton: Skeleton) -> Tensor:
    """Points (T, N, 3) at the image (T, N, 2) whose depths make rigid bones constant: dz = +-sqrt(L^2 - |xy|^2).

    A bone's length is its median in ``points`` (T, N, 3), or its longest image if that is longer; signs are those of
    ``points``. Skeletons that are no tree, or have virtual joints, which lie between others in depth as well, are left
    as they are. In bodies of more joints the noise of all of them would add up in such depths.
    """
    if not skeleton.is_tree or skeleton.virtual:
        return points
    bones = skeleton.bone_index(device=points.device)
    flat, dz = bone_vectors(image, bones).norm(dim=-1), bone_vectors(points, bones)[..., 2]
    length = torch.maximum(median(bone_lengths(points, bones), 0), flat.amax(0))
    held = torch.copysign((length.square() - flat.square()).clamp_min(0).sqrt(), dz)
    tree = chain_inverse(incidence(bones, skeleton.num_joints, dtype=points.dtype))  # (N, B)
    depth = torch.where(skeleton.rigid_mask(device=points.device), held, dz) @ tree.mT
    return torch.cat([image, (depth - depth.mean(-1, keepdim=True))[..., None]], -1)
