"""Measure the live mode: frames a second, how long updates take, and how near the poses are to the offline method's.

    python scripts/live.py                                  # two synthetic walks of 600 frames
    python scripts/live.py --frames 1200 --skeleton body25
    python scripts/live.py --inputs DIR --truth DIR         # files of tracks beside files with points3d of equal names

Errors are mean distances after one rotation per frame (no scale), of the better of the two mirror images, in the unit
of the truth: of all frames, and of those for which the tracker was ready. One thread.
"""

from __future__ import annotations

import argparse
import time
import warnings
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

import kcs_torch as kt
from kcs_torch.data import walking_person
from kcs_torch.functional.align import similarity

WALKS = ((20.0, 0), (60.0, 1))


def error(points: Tensor, truth: Tensor) -> float:
    """Mean distance after one rotation per frame."""
    flips = (points, points * torch.tensor([1.0, 1.0, -1.0]).to(points))
    return min(float((similarity(p, truth, scale=False) - truth).norm(dim=-1).nanmean()) for p in flips)


def synthetic(skeleton: str, frames: int, noise: float) -> Iterator[tuple[str, kt.Tracks, Tensor]]:
    for yaw, seed in WALKS:
        generator = torch.Generator().manual_seed(seed)
        clip = walking_person(frames, skeleton=skeleton, yaw=yaw, turn=0, noise=noise, generator=generator)
        yield f"walk yaw {yaw:g}", clip.tracks, clip.points[:, : clip.tracks.skeleton.num_observed]


def files(inputs: Path, truth: Path) -> Iterator[tuple[str, kt.Tracks, Tensor]]:
    for path in sorted(inputs.glob("*.npz")):
        yield path.stem, kt.load_tracks(path), torch.as_tensor(np.load(truth / path.name)["points3d"]).double()


def measure(name: str, tracks: kt.Tracks, truth: Tensor) -> str:
    count = tracks.skeleton.num_observed
    frames = torch.where(tracks.seen[..., None], tracks.points, torch.nan)[:, :count]
    tracker = kt.Tracker(tracks.skeleton, fps=tracks.fps or 30.0, units=tracks.units)
    poses, seconds = [], []
    for xy, weights in zip(frames, tracks.weights[:, :count], strict=True):
        begin = time.perf_counter()
        poses.append(tracker.update(xy, weights))
        seconds.append(time.perf_counter() - begin)
    live = torch.stack([p.points for p in poses])[:, :count]
    ready = torch.tensor([p.ready for p in poses])
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        offline = kt.reconstruct(tracks, method="pkc", viewpoint="fixed").observed
    later = f"{error(live[ready], truth[ready]):8.1f}{error(offline[ready], truth[ready]):9.1f}" if ready.any() else ""
    median, most, worst = 1e3 * np.percentile(seconds, [50, 99, 100])
    return (
        f"{name:<32}{len(poses):>7}{len(poses) / sum(seconds):>7.0f}{median:>8.1f}{most:>8.0f}{worst:>8.0f}"
        f"{error(live, truth):>9.1f}{error(offline, truth):>9.1f}{later}"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--skeleton", default="coco17")
    parser.add_argument("--frames", type=int, default=600)
    parser.add_argument("--noise", type=float, default=3.0, help="standard deviation, mm")
    parser.add_argument("--inputs", type=Path)
    parser.add_argument("--truth", type=Path)
    options = parser.parse_args()
    if (options.inputs is None) != (options.truth is None):
        parser.error("--inputs and --truth go together")
    torch.set_num_threads(1)
    head = f"{'clip':<32}{'frames':>7}{'fps':>7}{'median':>8}{'99 %':>8}{'worst':>8}{'live':>9}{'offline':>9}"
    print(f"{head}   ready: live  offline   (ms an update; mm)")
    if options.inputs is not None:
        clips = files(options.inputs, options.truth)
    else:
        clips = synthetic(options.skeleton, options.frames, options.noise)
    for clip in clips:
        print(measure(*clip), flush=True)


if __name__ == "__main__":
    main()
