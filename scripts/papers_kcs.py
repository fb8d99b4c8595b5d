"""Table 1 (walk35) and figures 5 and 6 of KCS (Wandt et al., ECCV workshops 2018); see ``papers.py``."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from papers import Part, Row, Settings
from robustness import generator

import kcs_torch as kt
from kcs_torch.functional import procrustes
from kcs_torch.methods import METHODS

WALKS = tuple(f"35_{i:02d}" for i in range(1, 11))
OTHERS = ("02_01", "05_01", "07_01", "08_01", "12_01", "16_15", "39_01")  # walks of other people
PRINTED = {"published: KCS": 18.94, "published: learned": 11.22}
SWAY = 10.0  # degrees to each side: little motion
JOINTS = {
    14: [1, 2, 3, 5, 6, 7, 13, 14, 15, 16, 17, 18, 19, 20],  # limbs, neck and head: what detectors give
    21: list(range(21)),
}
TRUNK = ("pelvis", "hip", "spine", "thorax", "neck", "shoulder")  # joints that tell where a body faces
EDGES14 = [(0, 1), (1, 2), (3, 4), (4, 5), (6, 7), (6, 8), (8, 9), (9, 10), (6, 11), (11, 12), (12, 13), (6, 0), (6, 3)]
FEW = 2  # paths a walk where many variants are compared
LENGTHS = (100, 200, 400, 800, 1600, 3200)
DEAREST = {"pkc": 800}  # frames of the longest clip that a slow method is timed with


@dataclass(frozen=True)
class Walk:
    """A walk as the camera sees it: points (T, N, 3) with y up, the names of joints, bones, frames a second."""

    points: np.ndarray
    names: np.ndarray
    edges: np.ndarray
    fps: float

    def seen(self, protocol: Any, yaw: np.ndarray, pitch: float) -> tuple[kt.Tracks, np.ndarray]:
        """Tracks and truth (T, N, 3) from a camera path."""
        truth = np.einsum("tij,tnj->tni", protocol.rotation(yaw, pitch), self.points)
        truth = truth - truth[:1].mean((0, 1))
        body = kt.Skeleton.from_edges(self.edges.tolist(), self.names.tolist(), name="walk")  # these bones, whatever
        tracks = kt.Tracks.from_arrays(truth[..., :2], skeleton=body, fps=self.fps, units="mm", source="walk")
        return tracks, truth


def load_walk(settings: Settings, name: str, joints: int = 17) -> Walk:
    """A walk at 30 frames a second, with the protocol's 17 joints, or other ones."""
    protocol = settings.bench.protocol
    data = protocol.load(settings.bench.data, f"cmu/cmu_{name}")
    use = protocol.CMU17 if joints == 17 else JOINTS[joints]
    edges = {14: EDGES14, 17: protocol.CMU17_EDGES, 21: data["edges"]}[joints]
    step = 4 if float(data["fps"]) >= 100 else 1
    points = data["points3d"].astype(float)[::step, use]
    return Walk(points, data["joint_names"][use], np.array(edges, dtype=int), float(data["fps"]) / step)


def camera_path(frames: int, seed: int, sway: float = SWAY) -> tuple[np.ndarray, float]:
    """Yaw (T,) and pitch in degrees: from anywhere around, 0 to 20 degrees above, swaying slowly by ``sway``."""
    yaw, pitch, turns, phase = np.random.default_rng(seed).random(4)
    time = np.linspace(0, 1, frames)
    return 360 * yaw + sway * np.sin(2 * np.pi * ((0.25 + 0.75 * turns) * time + phase)), 20 * pitch


def views(settings: Settings, walk: Walk, index: int, paths: int, sway: float = SWAY) -> list[tuple[Any, Any]]:
    """Tracks and truth of a walk before its own random camera paths."""
    seeds = range(1000 * index, 1000 * index + paths)
    return [walk.seen(settings.bench.protocol, *camera_path(len(walk.points), seed, sway)) for seed in seeds]


def scored(settings: Settings, walk: Walk, results: Sequence[Any], truths: Sequence[np.ndarray]) -> list[Row]:
    """The protocol's figures, distances only."""
    points = [x.observed.numpy() if isinstance(x, kt.Reconstruction) else x for x in results]
    every = [settings.bench.protocol.score(p, t, walk.edges) for p, t in zip(points, truths, strict=True)]
    return [{name: row[name] for name in ("rigid", "pa", "bone_cv")} for row in every]


def walk35(settings: Settings) -> Iterator[Row]:
    """All walks of subject 35 before random camera paths with little motion."""
    for setting, value in PRINTED.items():
        yield {"setting": setting, "at": None, "rigid": value}
    chosen = {name: METHODS[name]() for name in ("kcs", "pkc", "sfam") if name in settings.methods}
    for i, name in enumerate(WALKS[: settings.walks]):
        walk = load_walk(settings, name)
        tracks, truths = zip(*views(settings, walk, i, settings.paths), strict=True)
        flat = [np.pad(one[..., :2], [(0, 0), (0, 0), (0, 1)]) for one in truths]
        answers: dict[str, Sequence[Any]] = {"flat guess": flat}
        seconds = {"flat guess": 0.0}
        for method, recipe in chosen.items():
            begin = time.process_time()
            answers[method] = recipe.many(tracks)
            seconds[method] = time.process_time() - begin
        for setting, results in answers.items():
            frames = sum(len(truth) for truth in truths)
            for seed, row in enumerate(scored(settings, walk, results, truths)):
                cost = {"ms_per_frame": 1000 * seconds[setting] / frames}
                yield {"setting": setting, "at": name, "seed": 1000 * i + seed} | row | cost


def sides(settings: Settings) -> Iterator[Row]:
    """KCS from fixed cameras around the walker: 0 degrees is from the front or from behind, 90 from the side."""
    for name in WALKS[: settings.walks]:
        walk = load_walk(settings, name)
        ahead = np.degrees(math.atan2(*(walk.points[-1, 0] - walk.points[0, 0])[[0, 2]]))  # the way it walks
        angles = (0, 15, 30, 45, 60, 75, 90)
        cameras = [np.full(len(walk.points), angle - ahead) for angle in angles]
        tracks, truths = zip(*(walk.seen(settings.bench.protocol, yaw, 10.0) for yaw in cameras), strict=True)
        rest = mean_pose([load_walk(settings, other) for other in WALKS if other != name])
        methods = {"library's template": kt.KCS(), "mean of the subject's other walks": kt.KCS(template=rest)}
        for setting, method in methods.items():
            for angle, row in zip(angles, scored(settings, walk, method.many(tracks), truths), strict=True):
                yield {"setting": setting, "at": angle, "case": name} | row


def mean_pose(walks: Sequence[Walk]) -> list[list[float]]:
    """The mean of all their frames, trunks turned onto each other: (N, 3), x right, y down, z away."""
    trunk = [any(part in name for part in TRUNK) for name in walks[0].names.tolist()]
    poses = torch.cat([torch.from_numpy(walk.points) for walk in walks]) * torch.tensor([1.0, -1.0, -1.0])
    poses = poses - poses[:, trunk].mean(1, keepdim=True)
    mean = poses[0]
    for _ in range(5):
        rotation, _ = procrustes(poses[:, trunk], mean[trunk].expand(len(poses), -1, 3))
        mean = (poses @ rotation).mean(0)
    return mean.tolist()


def why(settings: Settings) -> Iterator[Row]:
    """What would bring KCS to the published figure: camera motion, template, arrangement, the printed camera step."""
    walks = {name: load_walk(settings, name) for name in WALKS}
    strangers = mean_pose([load_walk(settings, name) for name in OTHERS])
    printed: dict[str, Any] = {"scale_range": math.inf, "robust": None, "continuity": 0.0}
    for i, name in enumerate(WALKS[: settings.walks]):
        walk = walks[name]
        others = mean_pose([other for key, other in walks.items() if key != name])
        methods = {
            "library's template": kt.KCS(),
            "library's template, cameras as printed": kt.KCS(**printed),
            "library's template, T x 3B": kt.KCS(arrangement="frames"),
            "mean of other people's walks": kt.KCS(template=strangers),
            "mean of the subject's other walks": kt.KCS(template=others),
            "mean of the subject's other walks, cameras as printed": kt.KCS(template=others, **printed),
            "mean of the subject's other walks, T x 3B": kt.KCS(template=others, arrangement="frames"),
            "mean of the subject's other walks, T x 3B, cameras as printed": kt.KCS(
                template=others, arrangement="frames", **printed
            ),
            "mean of the very walk": kt.KCS(template=mean_pose([walk])),
        }
        for sway in (0, 10, 30, 90, 180):
            tracks, truths = zip(*views(settings, walk, i, min(FEW, settings.paths), sway), strict=True)
            still = [np.broadcast_to(mean_pose([walk]), truth.shape) for truth in truths]
            rows = {"the mean of the very walk, not moving": scored(settings, walk, still, truths)}
            rows |= {key: scored(settings, walk, method.many(tracks), truths) for key, method in methods.items()}
            for setting, each in rows.items():
                for seed, row in enumerate(each):
                    yield {"setting": setting, "at": sway, "case": name, "seed": seed} | row


def joints(settings: Settings) -> Iterator[Row]:
    """The same clips with fewer and more joints."""
    for count in (14, 17, 21):
        for i, name in enumerate(WALKS[: settings.walks]):
            walk = load_walk(settings, name, count)
            others = mean_pose([load_walk(settings, other, count) for other in WALKS if other != name])
            tracks, truths = zip(*views(settings, walk, i, min(FEW, settings.paths)), strict=True)
            methods = {"library's template": kt.KCS(), "mean of the subject's other walks": kt.KCS(template=others)}
            for setting, method in methods.items():
                for seed, row in enumerate(scored(settings, walk, method.many(tracks), truths)):
                    yield {"setting": setting, "at": count, "case": name, "seed": seed} | row


def rounds(settings: Settings) -> Iterator[Row]:
    """Error after so many alternations of cameras and shape."""
    kinds: dict[str, dict[str, Any]] = {
        "3T x B, as printed": {},
        "3T x B, cameras as printed": {"scale_range": math.inf, "robust": None, "continuity": 0.0},
        "T x 3B": {"arrangement": "frames"},
    }
    for i, name in enumerate(WALKS[: settings.walks]):
        walk = load_walk(settings, name)
        tracks, truths = zip(*views(settings, walk, i, 1), strict=True)
        for setting, fields in kinds.items():
            for count in range(1, 6):
                method = kt.KCS(rounds=count, tolerance=0.0, **fields)
                (row,) = scored(settings, walk, method.many(tracks), truths)
                yield {"setting": setting, "at": count, "case": name} | row


def growth(settings: Settings) -> Iterator[Row]:
    """CPU seconds over the number of frames, 17 joints, one thread; the median of three runs, of PKC one run."""
    chosen = [name for name in ("kcs", "sfam", "pkc") if name in settings.methods]
    for frames in [count for count in LENGTHS if count <= settings.frames]:
        clip = kt.data.walking_person(frames, skeleton="h36m17", yaw=30, turn=20, noise=2, generator=generator(0))
        for name in chosen:
            if frames > DEAREST.get(name, frames):
                continue
            taken = []
            for _ in range(3 if name != "pkc" else 1):
                begin = time.process_time()
                METHODS[name]()(clip.tracks)
                taken.append(time.process_time() - begin)
            yield {"setting": name, "at": frames, "cpu_seconds": float(np.median(taken))}


PARTS = {
    "walk35": Part("KCS, table 1: walk35, camera paths with little motion", "walk", ("rigid", "pa"), walk35),
    "views": Part("KCS on walk35 by the side it is seen from", "degrees from the front", ("rigid",), sides),
    "why": Part("KCS on walk35 by camera motion and template", "degrees of sway to each side", ("rigid", "pa"), why),
    "joints": Part("KCS on walk35 by the number of joints", "joints", ("rigid",), joints),
    "rounds": Part("KCS, figure 5: error after each round", "rounds", ("rigid",), rounds),
    "growth": Part("KCS, figure 6: CPU seconds over frames", "frames", ("cpu_seconds",), growth, log=True),
}
