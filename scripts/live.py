"""Measure the live mode: frames a second, how long updates take, and how near the poses are to the offline method's.

    python scripts/live.py                                  # two synthetic walks of 600 frames
    python scripts/live.py --frames 1200 --skeleton body25
    python scripts/live.py --paced                          # frames come as from a camera: how long updates keep it
    python scripts/live.py --inputs DIR --truth DIR         # files of tracks beside files with points3d of equal names

Frames a second are frames over the CPU seconds of all threads, solves included. Times of an update are by the clock;
where frames come as fast as they are taken, a few updates wait for a solve: --paced (with wait=False) shows what a
camera meets.

Errors are mean distances after one rotation per frame (no scale), of the better of the two mirror images, in the unit
of the truth: of all frames, and of those for which the tracker was ready. "sure" is the share of depths within one
standard deviation, in %. PyTorch uses one thread.
"""

from __future__ import annotations

import argparse
import math
import time
import warnings
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import torch
from options import at_least_one
from torch import Tensor

import kcs_torch as kt
from kcs_torch.cli.demo import rigid_error
from kcs_torch.data import walking_person
from kcs_torch.metrics import coverage

WALKS = ((20.0, 0), (60.0, 1))


def synthetic(skeleton: str, frames: int, noise: float) -> Iterator[tuple[str, kt.Tracks, Tensor]]:
    for yaw, seed in WALKS:
        generator = torch.Generator().manual_seed(seed)
        clip = walking_person(frames, skeleton=skeleton, yaw=yaw, turn=0, noise=noise, generator=generator)
        yield f"walk yaw {yaw:g}", clip.tracks, clip.points[:, : clip.tracks.skeleton.num_observed]


def files(inputs: Path, truth: Path) -> Iterator[tuple[str, kt.Tracks, Tensor]]:
    for path in sorted(inputs.glob("*.npz")):
        yield path.stem, kt.load_tracks(path), torch.as_tensor(np.load(truth / path.name)["points3d"]).double()


def measure(name: str, tracks: kt.Tracks, truth: Tensor, paced: bool) -> str:
    count, fps = tracks.skeleton.num_observed, tracks.rate
    frames = torch.where(tracks.seen[..., None], tracks.points, torch.nan)[:, :count]
    tracker = kt.Tracker(tracks.skeleton, fps=fps, units=tracks.units, wait=not paced, image_size=tracks.image_size)
    poses, waits = [], []
    begin, clock = time.process_time(), time.perf_counter()
    for i, (xy, weights) in enumerate(zip(frames, tracks.weights[:, :count], strict=True)):
        if paced:
            time.sleep(max(0.0, clock + i / fps - time.perf_counter()))
        start = time.perf_counter()
        poses.append(tracker.update(xy, weights))
        waits.append(time.perf_counter() - start)
    used = time.process_time() - begin  # of all threads: the solves count
    live = torch.stack([p.points for p in poses])[:, :count]
    spread = torch.stack([p.uncertainty for p in poses])[:, :count]
    ready = torch.tensor([p.ready for p in poses])
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        begin = time.process_time()
        offline = kt.PKC(viewpoint="fixed")(tracks).observed
        whole = time.process_time() - begin
    later = "".join(f"{rigid_error(x[ready], truth[ready]) if ready.any() else math.nan:9.1f}" for x in (live, offline))
    median, most, worst = 1e3 * np.percentile(waits, [50, 99, 100])
    return (
        f"{name:<32}{len(poses):>7}{len(poses) / used:>7.0f}{len(poses) / whole:>8.0f}"
        f"{median:>8.1f}{most:>7.0f}{worst:>7.0f}{rigid_error(live, truth):>8.1f}{later}"
        f"{100 * float(coverage(live[ready], spread[ready], truth[ready])):>9.0f}"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--skeleton", default="coco17", choices=kt.SKELETONS, metavar="NAME")
    parser.add_argument("--frames", type=at_least_one, default=600)
    parser.add_argument("--noise", type=float, default=3.0, help="standard deviation, mm")
    parser.add_argument("--inputs", type=Path)
    parser.add_argument("--truth", type=Path)
    parser.add_argument("--paced", action="store_true", help="frames come at the clip's rate")
    options = parser.parse_args()
    if (options.inputs is None) != (options.truth is None):
        parser.error("--inputs and --truth go together")
    if options.inputs is not None and not any(options.inputs.glob("*.npz")):
        parser.error(f"--inputs {options.inputs}: expected a folder with .npz files of tracks, found none")
    for path in [] if options.inputs is None else sorted(options.inputs.glob("*.npz")):
        if not (options.truth / path.name).is_file():
            parser.error(f"--truth {options.truth}: expected a file {path.name} as in --inputs, found none")
    torch.set_num_threads(1)
    head = f"{'clip':<32}{'frames':>7}{'fps':>7}{'offline':>8}{'ms: med':>8}{'99 %':>7}{'worst':>7}"
    print(f"{head}{'mm: all':>8}{'ready':>9}{'offline':>9}{'sure':>9}")
    if options.inputs is not None:
        clips = files(options.inputs, options.truth)
    else:
        clips = synthetic(options.skeleton, options.frames, options.noise)
    for clip in clips:
        print(measure(*clip, options.paced), flush=True)


if __name__ == "__main__":
    main()
