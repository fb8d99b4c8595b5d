"""Motion that several tests of the training train on."""

from pathlib import Path

import torch

import kcs_torch as kt
from kcs_torch.data import random_motion


def motion(frames=60, seed=0, fps=30.0, skeleton="h36m17"):
    clip = random_motion(skeleton, frames, fps=fps, generator=torch.Generator().manual_seed(seed), size=4000.0)
    return kt.Motion.from_arrays(clip.points, up="-y", skeleton=skeleton, fps=fps, units="mm")


def write_motions(folder: Path) -> Path:
    """Eight clips of 60 frames, as subjects s1 to s4 with takes a and b."""
    for i in range(8):
        motion(60, seed=i).save(folder / f"s{i // 2 + 1}_{'ab'[i % 2]}.npz")
    return folder
