"""What is said beside the best solution: other solutions, what the prior decided, and how sure depth is."""

from __future__ import annotations

import torch
from torch import Tensor

from kcs_torch.functional.chain import bone_vectors, chain_inverse, incidence
from kcs_torch.methods.pkc.hypotheses import Hypotheses
from kcs_torch.methods.pkc.objective import bone_noise
from kcs_torch.skeleton import Skeleton

__all__ = ["APART", "depth_deviation", "told_by_prior"]

APART = 0.04
"""Root mean square depth by which solutions must differ to be told apart, a person being about 1.75 tall."""

CLOSE = 10.0
"""Objective by which another solution may be worse and still be a rival."""

LENGTH = 0.02
"""Standard deviation of a bone's length as it is found, as a share."""

FLAT = 0.25
"""Share of its length below which a bone's depth is no better known for being small."""

NOISE = 0.7
"""Share of the image's noise that a bone's length and depth take on."""

CALIBRATION = 0.85
"""Factor by which deviations are scaled so that two thirds of all joints are within one."""


def told_by_prior(found: Hypotheses, skeleton: Skeleton) -> list[str]:
    """Bones whose depth has another sign in a rival solution, for a good part of the clip."""
    rivals = found.energy - found.energy[0] < CLOSE
    dz = bone_vectors(found.depth[..., None], skeleton.bone_index(device=found.depth.device))[..., 0]  # (H, T, B)
    size = found.lengths[:1, None]
    flipped = (dz * dz[:1] < 0) & (torch.minimum(dz.abs(), dz[:1].abs()) > 0.15 * size)
    share = flipped.double().mean(1) * rivals[:, None]
    return [skeleton.bone_names[b] for b in (share.amax(0) > 0.3).nonzero().flatten().tolist()]


def depth_deviation(found: Hypotheses, noise: Tensor, skeleton: Skeleton) -> Tensor:
    """Standard deviation of the best solution's depths, (T, N).

    A bone's depth dz = sqrt(L^2 - |xy|^2) is off by L dL / |dz|: little where it points at the camera, much where it is
    nearly parallel to the image. These add up along the chain to the body's middle; rival solutions add their distance.

    Args:
        found: solutions, best first.
        noise: (T, N) standard deviation of the joints' images.
        skeleton: of the N joints.
    """
    bones = skeleton.bone_index(device=noise.device)
    dz = bone_vectors(found.depth[0][..., None], bones)[..., 0]  # (T, B)
    length = found.lengths[0].clamp_min(1e-9)
    wrong = ((length * LENGTH).square() + (NOISE * bone_noise(noise, bones)).square()).sqrt()
    off = wrong / (dz.abs() / length).clamp_min(FLAT)
    tree = chain_inverse(incidence(bones, skeleton.num_joints, dtype=noise.dtype))  # (N, B)
    variance = off.square() @ tree.square().mT
    if len(found.energy) > 1:
        share = torch.softmax(-(found.energy - found.energy[0]) / CLOSE, 0)
        variance = variance + torch.einsum("h,htn->tn", share, (found.depth - found.depth[0]).square())
    return CALIBRATION * variance.sqrt()
