"""Measure speed, memory and growth on one thread, beside a naive twin of each method in the same run.

    python scripts/speed.py                      # everything; some minutes
    python scripts/speed.py --parts methods --csv speed.csv

Parts: ``memory`` (peak of a run above what importing takes, in a process of its own), ``methods`` (each method beside
its twin), ``kernels`` (the same for single steps), ``growth`` (with the number of frames), ``joints`` (with their
number), ``batch`` (many short clips together beside one by one). Times are in double precision; variants take turns,
so that a busy machine slows all of them, and the best run is told beside the median. The twins are those of
tests/naive.py.

Two parts are left out unless asked for: ``scale`` (memory and time of very long clips, minutes) and ``gpu`` (clips a
second in batches of up to 4096, single precision on the GPU beside double on the CPU, methods and SfAM's layer alone).
"""

from __future__ import annotations

import argparse
import importlib.util
import json
import platform
import resource
import statistics
import subprocess
import sys
import time
import warnings
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path
from types import ModuleType
from typing import Any

import torch
from options import at_least_one

import kcs_torch as kt
from kcs_torch.data import SyntheticClip, random_motion, walking_person
from kcs_torch.io.atomic import write_table
from kcs_torch.methods.clips.cameras import orthographic_cameras

TESTS = Path(__file__).resolve().parents[1] / "tests"
FRAMES, TURN = 300, 180.0
FAST = ("kcs", "sfam", "pkc")  # methods that are measured unless others are asked for
TWINS = ("kcs", "sfam")  # methods that tests/naive.py slows down
KERNELS = (
    ("17 joints", (200, 51)),
    ("41 joints", (370, 123)),
    ("5 windows", (5, 200, 51)),
    ("no windows", (10000, 51)),
    ("KCS", (900, 16)),
)
Row = dict[str, Any]
Variants = dict[str, Callable[[], object]]


def load_naive() -> ModuleType:
    """Import tests/naive.py by its path."""
    path = TESTS / "naive.py"
    spec = importlib.util.spec_from_file_location("naive", path)
    if spec is None or spec.loader is None or not path.is_file():
        raise SystemExit(f"{path}: expected the naive twins, found none; run from a clone of the repository")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def measure(variants: Variants, runs: int, *, per: float = 1.0, repeat: int = 1) -> Iterator[Row]:
    """Median and least milliseconds of each variant, and its ratio to the first one's median.

    Variants take turns, after one turn that does not count. ``per`` divides the times (by frames, say), and each run
    is ``repeat`` calls.
    """
    times: dict[str, list[float]] = {name: [] for name in variants}
    for turn in range(runs + 1):
        for name, run in variants.items():
            start = time.perf_counter()
            for _ in range(repeat):
                run()
            if turn:
                times[name].append(1000 * (time.perf_counter() - start) / (per * repeat))
    medians = {name: statistics.median(values) for name, values in times.items()}
    first = next(iter(medians.values()))
    for name, values in times.items():
        yield {"variant": name, "median": medians[name], "best": min(values), "ratio": medians[name] / first}


def tree(num_joints: int) -> kt.Skeleton:
    """A binary tree of joints, which random_motion brings to life."""
    return kt.Skeleton.from_edges(
        [((i - 1) // 2, i) for i in range(1, num_joints)], num_joints, name=f"tree{num_joints}"
    )


def clip_of(frames: int) -> SyntheticClip:
    """A walking person, orbited by half a turn in 300 frames, however long the clip is."""
    return walking_person(frames, turn=TURN * frames / FRAMES)


def compare_methods(names: Sequence[str], frames: int, runs: int) -> Iterator[Row]:
    """Milliseconds a frame of each method and of the twins that it has."""
    twins = load_naive()
    clip = walking_person(frames, turn=TURN)

    def within(run: Callable[[], object], frame_by_frame: bool) -> None:
        with twins.naive(frame_by_frame=frame_by_frame):
            run()

    for name in names:
        method = kt.METHODS[name]
        for cameras in (None, clip.cameras):
            run = partial(method(), clip.tracks, cameras)
            variants: Variants = {"ours": run}
            if name in TWINS:
                variants |= {
                    "naive": partial(within, run, False),
                    "naive, frame by frame": partial(within, run, True),
                }
            what = name if cameras is None else f"{name}, cameras given"
            for row in measure(variants, runs, per=frames):
                yield {"ms a frame": what} | row


def compare_kernels(frames: int, runs: int) -> Iterator[Row]:
    """Milliseconds of shrinkage and of the bone-length step, and of their twins."""
    twins = load_naive()
    generator = torch.Generator().manual_seed(0)
    for what, shape in KERNELS:
        matrix = torch.randn(shape, generator=generator, dtype=torch.float64)
        level = torch.linalg.svdvals(matrix).median()
        variants: Variants = {
            "ours": partial(kt.functional.svt, matrix, level),
            "naive": partial(twins.svt, matrix, level),
        }
        for row in measure(variants, runs, repeat=20):
            yield {"ms": f"svt {' x '.join(map(str, shape))}, {what}"} | row
    for joints in (17, 41):
        body = tree(joints)
        points = random_motion(body, frames, generator=generator).points
        bones = body.bone_index()
        lengths = kt.functional.bone_lengths(points, bones)[0]
        points = points + 0.01 * lengths.mean() * torch.randn(points.shape, generator=generator, dtype=torch.float64)
        variants = {
            "ours": partial(kt.solvers.fit_bones, points, lengths, bones, num_steps=1),
            "naive": partial(twins.fit_bones, points, lengths, bones, num_steps=1),
            "naive, frame by frame": partial(twins.fit_bones_frame_by_frame, points, lengths, bones, num_steps=1),
        }
        for row in measure(variants, runs):
            yield {"ms": f"bone-length step, {frames} frames of {joints} joints"} | row


def grow_frames(names: Sequence[str], counts: list[int], runs: int) -> Iterator[Row]:
    """Milliseconds a frame as clips get longer, and their ratio to those at 1000 frames."""
    for name in names:
        method = kt.METHODS[name]
        reference = None
        for frames in counts:
            run = partial(method(), clip_of(frames).tracks)
            (row,) = measure({"ours": run}, max(1, min(runs, runs * 1000 // frames)), per=frames)
            reference = row["median"] if frames == 1000 else reference
            ratio = row["median"] / reference if reference else None
            yield {"ms a frame": name, "frames": frames} | row | {"ratio": ratio}


def grow_joints(names: Sequence[str], counts: list[int], frames: int, runs: int) -> Iterator[Row]:
    """Milliseconds a frame, and frames a second, as bodies get more joints."""
    for name in names:
        method = kt.METHODS[name]
        for joints in counts:
            clip = random_motion(tree(joints), frames, turn=TURN, generator=torch.Generator().manual_seed(0))
            (row,) = measure({"ours": partial(method(), clip.tracks)}, runs, per=frames)
            del row["ratio"]
            yield {"ms a frame": name, "joints": joints} | row | {"frames a second": 1000 / row["median"]}


def short_clips(length: int, count: int) -> list[kt.Tracks]:
    """People before cameras that turn or stand still, in clips of up to a quarter less."""
    lengths = [length - (length // 3) * (i % 4) // 4 for i in range(count)]
    return [walking_person(n, turn=TURN * (i % 2), yaw=7.0 * i).tracks for i, n in enumerate(lengths)]


def together(names: Sequence[str], frames: list[int], clips: int, runs: int, workers: int) -> Iterator[Row]:
    """Milliseconds a clip one by one and as one batch, see :func:`short_clips`.

    Times are the processor's, in the best of some runs; ``wall`` ones the clock's, which tell what several threads of
    PyTorch (``--threads``) are worth, or several processes (``--workers``) that have started already.
    """
    for name in names:
        method = kt.METHODS[name]()
        for length in frames:
            tracks = short_clips(length, clips)
            few = tracks[: min(clips, 16)]
            method.many(tracks[:2])  # loads what is loaded late
            alone = spent(partial(one_by_one, method, few), runs)
            batch = spent(partial(method.many, tracks), runs)
            row: Row = {"ms a clip": name, "frames": length, "clips": clips}
            for what, k in (("", 0), ("wall ", 1)):
                one, many = alone[k] / len(few), batch[k] / clips
                row |= {f"{what}one by one": one, f"{what}together": many, f"{what}ratio": one / many}
            if workers > 1:
                run = partial(kt.reconstruct_all, tracks, method=name, intrinsics="parallel", workers=workers)
                run()  # starts them
                one, many = alone[1] / len(few), spent(run, runs)[1] / clips
                row |= {f"wall, {workers} workers": many, f"ratio, {workers} workers": one / many}
            yield row


def one_by_one(method: kt.Method, tracks: Sequence[kt.Tracks]) -> None:
    for one in tracks:
        method(one)


def spent(run: Callable[[], object], runs: int) -> tuple[float, float]:
    """Milliseconds of the processor and of the clock, each in the best of some runs."""
    times = []
    for _ in range(runs):
        cpu, wall = time.process_time(), time.perf_counter()
        run()
        times.append((1000 * (time.process_time() - cpu), 1000 * (time.perf_counter() - wall)))
    cpu, wall = (min(each) for each in zip(*times, strict=True))
    return cpu, wall


def on_gpu(device: str, batches: list[int], frames: int, names: Sequence[str], most: float) -> Iterator[Row]:
    """Clips and frames a second of batches on a device, in single precision, and on the CPU in double.

    ``SfAM's layer`` is cameras and shape of a stacked batch, without what a :class:`Reconstruction` tells of each clip.
    What took more than ``most`` seconds is not tried with more clips.
    """
    body = kt.SKELETONS["h36m17"]
    clips = [walking_person(frames, turn=TURN, yaw=7.0 * i).tracks for i in range(16)]
    sfam = kt.SfAM()

    def layer(points: torch.Tensor) -> None:
        rows = orthographic_cameras(points)
        sfam.shape(points, rows, torch.ones_like(points[..., 0]), body, one_body=False)

    for where, dtype in ((device, torch.float32), ("cpu", torch.float64)):
        tracks = [one.to(where).to(dtype) for one in clips]
        stack = torch.stack([one.points - one.points.mean(1, keepdim=True) for one in tracks])
        stack = stack / stack.square().mean((1, 2, 3), keepdim=True).sqrt()
        for name in ("SfAM's layer", *names):
            for batch in batches:
                if where == "cpu" and batch > 64:
                    break  # a core gains nothing from more
                run: Callable[[], object] = (
                    partial(kt.METHODS[name]().many, [tracks[i % 16] for i in range(batch)])
                    if name in kt.METHODS
                    else partial(layer, stack[torch.arange(batch, device=stack.device) % 16])
                )
                with torch.no_grad():
                    spent = [elapsed(run, where) for _ in range(2)][-1]
                rate = batch / spent
                yield {"method": name, "device": where, "batch": batch, "clips a second": rate} | {
                    "frames a second": rate * frames
                }
                if spent > most:
                    break


def elapsed(run: Callable[[], object], device: str) -> float:
    """Seconds that a run takes, what it leaves to a GPU included."""
    start = time.perf_counter()
    run()
    if device != "cpu":
        torch.cuda.synchronize()
    return time.perf_counter() - start


def peak_memory(names: Sequence[str], counts: list[int]) -> Iterator[Row]:
    """Peak memory of a run, each in a process of its own."""
    for name in names:
        for frames in counts:
            command = [sys.executable, __file__, "--peak", name, str(frames)]
            done = subprocess.run(command, capture_output=True, text=True, check=False)
            if done.returncode:
                raise SystemExit(f"{' '.join(command)}: {done.stderr.strip()}")
            yield {"peak of": name, "frames": frames} | json.loads(done.stdout)


def resident_mb() -> float:
    """The most memory that this process held so far, in MB."""
    status = Path("/proc/self/status")
    if status.is_file():  # Linux lets a child inherit its parent's ru_maxrss, but not this
        return next(float(line.split()[1]) for line in status.read_text().splitlines() if "VmHWM" in line) / 1024
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / (1024**2 if sys.platform == "darwin" else 1024)


def measure_peak(name: str, frames: int) -> Row:
    """Run a method in this process; memory in MB, and KB a frame above what a short run takes."""
    method = kt.METHODS[name]()
    method(walking_person(30, turn=TURN).tracks)  # loads what is loaded late
    tracks = clip_of(frames).tracks
    before, start = resident_mb(), time.process_time()
    method(tracks)
    seconds, above = time.process_time() - start, resident_mb() - before
    return {"import MB": before, "above MB": above, "KB a frame": 1024 * above / frames} | {
        "ms a frame": 1000 * seconds / frames
    }


def show(rows: list[Row]) -> str:
    """Rows of one part as a table."""
    names = list(dict.fromkeys(key for row in rows for key in row))
    cells = [names] + [[text(row.get(name)) for name in names] for row in rows]
    widths = [max(len(line[i]) for line in cells) for i in range(len(names))]
    left = [isinstance(rows[0].get(name), str) for name in names]
    align = lambda cell, width, by: cell.ljust(width) if by else cell.rjust(width)  # noqa: E731
    return "\n".join("  ".join(map(align, line, widths, left)).rstrip() for line in cells)


def text(value: Any) -> str:
    """A number at three digits; nothing for None."""
    if isinstance(value, float):
        return f"{value:.0f}" if abs(value) >= 100 else f"{value:.3g}"
    return "" if value is None else str(value)


def arguments(words: list[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parts = ("memory", "methods", "kernels", "growth", "joints", "batch")
    every = (*parts, "scale", "gpu")
    parser.add_argument("--parts", nargs="+", choices=every, default=parts, metavar="PART", help=", ".join(every))
    known = list(kt.METHODS)
    parser.add_argument("--which", nargs="+", choices=known, default=FAST, metavar="METHOD", help=", ".join(known))
    parser.add_argument("--clips", type=at_least_one, default=64, help="of the part batch")
    parser.add_argument("--threads", type=at_least_one, default=1, help="of PyTorch's own")
    parser.add_argument("--workers", type=at_least_one, default=1, help="of the part batch: also in so many processes")
    parser.add_argument(
        "--short", type=at_least_one, nargs="+", default=[30, 100], metavar="FRAMES", help="of its clips"
    )
    parser.add_argument("--scale", type=at_least_one, nargs="+", default=[1000, 100_000], metavar="FRAMES")
    parser.add_argument("--device", default="cuda", help="of the part gpu")
    parser.add_argument(
        "--batches", type=at_least_one, nargs="+", default=[1, 4, 16, 64, 256, 1024, 4096], metavar="CLIPS"
    )
    parser.add_argument("--most", type=float, default=10.0, help="seconds after which it tries no larger batch")
    parser.add_argument("--frames", type=at_least_one, default=FRAMES, help="of methods, kernels and joints")
    parser.add_argument(
        "--growth", type=at_least_one, nargs="+", default=[100, 300, 1000, 3000, 10000], metavar="FRAMES"
    )
    parser.add_argument("--memory", type=at_least_one, nargs="+", default=[1000, 10000], metavar="FRAMES")
    parser.add_argument("--joints", type=at_least_one, nargs="+", default=[17, 41, 133], metavar="JOINTS")
    parser.add_argument("--runs", type=at_least_one, default=5, help="of which the median is taken")
    parser.add_argument("--csv", type=Path, help="also write all rows here")
    parser.add_argument("--peak", nargs=2, metavar=("METHOD", "FRAMES"), help=argparse.SUPPRESS)
    return parser.parse_args(words)


def main(words: list[str] | None = None) -> None:
    """Measure what is asked for and print one table a part."""
    options = arguments(words)
    if options.csv:
        options.csv.parent.mkdir(parents=True, exist_ok=True)
    torch.set_num_threads(options.threads)
    warnings.simplefilter("ignore", kt.KcsWarning)  # of short clips that do not settle
    if options.peak:
        print(json.dumps(measure_peak(options.peak[0], int(options.peak[1]))))
        return
    parts: dict[str, Callable[[], Iterator[Row]]] = {
        "memory": lambda: peak_memory(options.which, options.memory),
        "methods": lambda: compare_methods(options.which, options.frames, options.runs),
        "kernels": lambda: compare_kernels(options.frames, options.runs),
        "growth": lambda: grow_frames(options.which, options.growth, options.runs),
        "joints": lambda: grow_joints(options.which, options.joints, options.frames, options.runs),
        "batch": lambda: together(options.which, options.short, options.clips, min(options.runs, 3), options.workers),
        "scale": lambda: peak_memory(options.which, options.scale),
        "gpu": lambda: on_gpu(options.device, options.batches, options.frames, options.which, options.most),
    }
    if "gpu" in options.parts and options.device == "cuda" and not torch.cuda.is_available():
        raise SystemExit(
            "--parts gpu: expected a GPU that PyTorch can use, found none; --device cpu tries the script out"
        )
    run = f"{options.threads} thread(s), float64, median of {options.runs} runs"
    print(f"torch {torch.__version__}, {platform.machine()}, {run}")
    everything: list[Row] = []
    for part in parts:
        if part in options.parts:
            rows = list(parts[part]())
            print(f"\n{part}\n{show(rows)}", flush=True)
            everything += [{"part": part} | row for row in rows]
            if options.csv:  # after each part: a later one may fail
                write_table(options.csv, everything)


if __name__ == "__main__":
    main()
