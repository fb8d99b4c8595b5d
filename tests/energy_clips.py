"""Clips that energies are tried on, ordinary and degenerate."""

import torch
from numerics import BODY, normal

from kcs_torch.nn import (
    BoneLengthEnergy,
    ForeshorteningEnergy,
    HingeEnergy,
    JointDistance,
    KCSDistance,
    LowRankEnergy,
    PerspectiveEnergy,
    PostureEnergy,
    ProcrusteanEnergy,
    ReprojectionEnergy,
    SmoothnessEnergy,
    StanceEnergy,
    SymmetryEnergy,
)
from kcs_torch.skeleton import SKELETONS

BONES = BODY.bone_index()
RIGID = torch.tensor([0.0, 1, 1, 1, 1, 1]).double()  # the spine is flexible


def clip(kind: str = "any", *batch, dtype=torch.float64, joints: int = 7):
    """Points (..., T, N, 3), ordinary or degenerate."""
    points = {
        "any": lambda: normal(*batch, 5, joints, 3),
        "static": lambda: normal(*batch, 1, joints, 3).expand(*batch, 5, joints, 3).clone(),
        "one frame": lambda: normal(*batch, 1, joints, 3),
        "two frames": lambda: normal(*batch, 2, joints, 3),
        "zero": lambda: torch.zeros(*batch, 5, joints, 3),
        "short bones": lambda: torch.cat([normal(*batch, 5, 2, 3), torch.ones(*batch, 5, joints - 2, 3)], -2),
    }[kind]()
    return points.to(dtype)


KINDS = ["any", "static", "one frame", "two frames", "zero", "short bones"]
SMOOTH = ["any", "static", "one frame", "two frames"]  # no bone of length zero


def confidences(points, seed=3):
    """Weights (..., T, N): some joints unseen, one never, one frame empty where there are several."""
    weights = normal(*points.shape[:-1], seed=seed).abs().clamp_max(1).to(points.dtype)
    weights = weights * (normal(*points.shape[:-1], seed=seed + 1) > -1)
    weights[..., 4] = 0
    if points.shape[-3] > 1:
        weights[..., 1, :] = 0
    return weights


def scene(kind="any", *batch, dtype=torch.float64):
    points = clip(kind, *batch, dtype=dtype)
    frames = points.shape[-3]
    return points, normal(*points.shape[:-1], 2, seed=5, dtype=dtype), normal(*batch, frames, 2, 3, seed=6, dtype=dtype)


TRUNK = SKELETONS["h36m17"]
SEEN = 1000 * normal(4, 5, 17, 3)[..., :2] / (10 + normal(4, 5, 17, 3)[..., 2:])
STANCE, POSTURE = StanceEnergy(TRUNK), PostureEnergy(TRUNK)
CALLS = {
    "bone length": lambda p, w: BoneLengthEnergy(TRUNK)(p, None, w),
    "symmetry": lambda p, w: SymmetryEnergy(TRUNK)(p, w),
    "smoothness": lambda p, w: SmoothnessEnergy()(p, w),
    "low rank": lambda p, w: LowRankEnergy()(p, w),
    "reprojection": lambda p, w: ReprojectionEnergy()(p, torch.zeros(4, 5, 17, 2), None, w),
    "perspective": lambda p, w: PerspectiveEnergy()(p, SEEN, (1000, 1000, 0, 0), w),
    "joints": lambda p, w: JointDistance()(p, torch.zeros(4, 5, 17, 3), w),
    "kcs": lambda p, w: KCSDistance(TRUNK)(p, torch.zeros(4, 5, 17, 3), w),
    "foreshortening": lambda p, w: ForeshorteningEnergy(TRUNK)(p, None, w),
    "procrustean": lambda p, w: ProcrusteanEnergy(TRUNK)(p, None, w),
    "hinge": lambda p, w: HingeEnergy(TRUNK)(p, None, w),
    "stance": lambda p, w: STANCE(p, None, w),
    "posture": lambda p, w: POSTURE(p, None, w),
}
