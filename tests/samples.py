"""Small results and files that several test files need."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from kcs_torch.data import walking_person
from kcs_torch.functional import bone_lengths
from kcs_torch.nn import PostureEnergy
from kcs_torch.types import Diagnostics, Reconstruction


def walk_result(num_frames=12, *, skeleton="coco17", dtype=torch.float64, fps=25.0, uncertain=True, name="walk.npz"):
    """The true motion of a walking person as if a method had found it; a skeleton with virtual joints."""
    generator = torch.Generator().manual_seed(7)
    clip = walking_person(num_frames, skeleton=skeleton, missing=0.1, dtype=dtype, generator=generator)
    tracks = replace(clip.tracks, fps=fps, source=name, notes=("made for a test",))
    body = tracks.skeleton
    index = body.bone_index()
    return Reconstruction(
        points=clip.points,
        cameras=clip.cameras,
        scales=torch.linspace(0.9, 1.1, num_frames, dtype=dtype),
        lengths=(clip.points[:, index[:, 1]] - clip.points[:, index[:, 0]]).norm(dim=-1).mean(0),
        tracks=tracks,
        method="SfAM",
        diagnostics=Diagnostics(12.5, tracks.unseen_share, float("nan"), 0.1 + 0.2, False, 80, notes=("é <b>",)),
        uncertainty=clip.points[..., 2].abs() + 1 if uncertain else None,
        units="m",
    )


def walk_in_template_units(num_frames=40, *, skeleton="h36m17", dtype=torch.float64, **options):
    """A walk before a fixed camera, centred per frame, as large as the skeleton's template: (T, N, 3)."""
    points = walking_person(num_frames, skeleton=skeleton, **{"turn": 0.0, "yaw": 40.0, **options}).points
    posture = PostureEnergy(skeleton)
    ratio = posture.rest_lengths / bone_lengths(points, posture.bones).mean(0)
    return ((points - points.mean(1, keepdim=True)) * ratio.median()).to(dtype)


def write_openpose(folder: Path, detections, *, name="clip_{:012d}_keypoints.json", frames=None) -> Path:
    """Write (P, N, 3) detections of each frame as OpenPose does."""
    folder.mkdir(parents=True, exist_ok=True)
    for frame, people in zip(frames or range(len(detections)), detections, strict=True):
        text = {"version": 1.3, "people": [{"pose_keypoints_2d": np.ravel(p).tolist()} for p in people]}
        (folder / name.format(frame)).write_text(json.dumps(text), encoding="utf-8")
    return folder


def person(num_frames: int = 4, joints: int = 25, *, at=(200.0, 300.0), confidence=0.8) -> np.ndarray:
    """(T, N, 3) somebody who drifts to the right."""
    rng = np.random.default_rng(joints)
    shape = rng.uniform(-50, 50, (joints, 2)) + at
    drift = np.arange(num_frames)[:, None, None] * np.array([2.0, 0.0])
    return np.concatenate([shape + drift, np.full((num_frames, joints, 1), confidence)], -1)
