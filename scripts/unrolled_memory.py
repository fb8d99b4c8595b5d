"""Measure what each way of differentiating an unrolled solver keeps in memory, and its time.

    python scripts/unrolled_memory.py
    python scripts/unrolled_memory.py --solvers sfam pkc --steps 10 100 --compile

Prints a Markdown table: MiB that autograd keeps for the backward pass (each storage once, counted by hooks on saved
tensors, parameters and inputs included), and CPU milliseconds of one forward and backward pass, one thread.
``--compile`` adds the forward pass of 10 steps by torch.compile's default backend, and how long compiling took.
"""

from __future__ import annotations

import argparse
import time
import warnings
from collections.abc import Callable
from typing import Any

import torch
from options import at_least_one
from torch import Tensor
from train_unrolled import build

import kcs_torch as kt
from kcs_torch.nn.unrolled import Unrolled
from kcs_torch.solvers import Implicit

MODES: dict[str, Callable[[int], dict[str, Any]]] = {
    "unrolled": lambda steps: {},
    "grad_steps=5": lambda steps: {"grad_steps": 5},
    "implicit": lambda steps: {"gradient": Implicit(settle=0)},
}


def measure(layer: Unrolled, tracks: Tensor, cameras: Tensor) -> tuple[float, float]:
    """MiB kept, and milliseconds of both passes."""
    kept: dict[int, int] = {}

    def pack(x: Tensor) -> Tensor:
        kept[x.untyped_storage().data_ptr()] = x.untyped_storage().nbytes()
        return x

    leaf = tracks.clone().requires_grad_()
    begin = time.process_time()
    with torch.autograd.graph.saved_tensors_hooks(pack, lambda x: x):
        value = layer(leaf, cameras)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", kt.errors.ConvergenceWarning)  # no step settles within so few
        value.square().mean().backward()
    return sum(kept.values()) / 2**20, 1e3 * (time.process_time() - begin)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    solvers = ["fpc", "sfam", "kcs", "pkc"]
    parser.add_argument("--solvers", nargs="*", choices=solvers, default=solvers)
    parser.add_argument("--steps", type=at_least_one, nargs="*", default=[10, 100, 300])
    parser.add_argument("--frames", type=at_least_one, default=100)
    parser.add_argument("--compile", action="store_true")
    options = parser.parse_args()
    torch.set_num_threads(1)
    clip = kt.data.walking_person(options.frames, skeleton="h36m17", turn=120.0)
    tracks, cameras, skeleton = clip.tracks.points, clip.cameras, clip.tracks.skeleton
    print(f"{options.frames} frames of {tracks.shape[1]} joints, float64: MiB kept / ms forward and backward\n")
    print("| solver | gradient | " + " | ".join(f"{n} steps" for n in options.steps) + " |")
    print("|---" * (2 + len(options.steps)) + "|")
    for kind in options.solvers:
        for mode, more in MODES.items():
            cells = [measure(build(kind, skeleton, n, **more(n)), tracks, cameras) for n in options.steps]
            print(f"| {kind} | {mode} | " + " | ".join(f"{m:.1f} / {t:.0f}" for m, t in cells) + " |", flush=True)
    for kind in options.solvers if options.compile else []:
        layer, spent = build(kind, skeleton, 10), []
        run = torch.compile(layer)
        with torch.no_grad():
            for function in (run, run, layer, layer):
                begin = time.perf_counter()
                function(tracks, cameras)
                spent.append(time.perf_counter() - begin)
        print(f"{kind}: compiled in {spent[0]:.0f} s, then {1e3 * spent[1]:.1f} ms; plain {1e3 * spent[3]:.1f} ms")


if __name__ == "__main__":
    main()
