"""Measure the KCS layer beside two others, and what each loss costs; all in one process, as Markdown tables.

    python scripts/layers.py
    python scripts/layers.py --repeats 100 --skeleton body25

The others: RepNet's way, the incidence matrix C repeated for every pose of the batch and two batched products; and
bones by indexing, then one batched product. Times are CPU time of one thread in microseconds, the least of the
repeats, in which all variants take turns; the layer's are divided by ours. ``import kcs_torch`` is timed in fresh
interpreters, as what it adds to ``import torch``.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import time
from collections.abc import Callable, Iterable
from functools import partial

import torch
from options import at_least_one
from torch import Tensor

import kcs_torch as kt

BATCHES = (64, 4096)
CLIPS, FRAMES = 8, 32
IMPORTS = "import time, torch; start = time.process_time(); {}; print(time.process_time() - start)"
Run = Callable[[], object]


def tiled(body: kt.Skeleton) -> Callable[[Tensor], Tensor]:
    """The layer as RepNet has it: bones (3, B) by a product with a copy of C for each pose."""
    incidence = kt.functional.incidence(body.bone_index(), body.num_joints)

    def layer(points: Tensor) -> Tensor:
        copies = incidence.repeat(len(points), 1, 1)
        bones = torch.bmm(points.mT, copies)
        return torch.bmm(bones.mT, bones)

    return layer


def indexed(body: kt.Skeleton) -> Callable[[Tensor], Tensor]:
    """The layer as one writes it in a line."""
    parents, children = body.bone_index().unbind(-1)

    def layer(points: Tensor) -> Tensor:
        bones = points[:, children] - points[:, parents]
        return torch.bmm(bones, bones.mT)

    return layer


def microseconds(variants: dict[str, Run], repeats: int, calls: int = 1) -> dict[str, float]:
    """Least CPU time of a call of each, which take turns; the first turn does not count."""
    best = dict.fromkeys(variants, float("inf"))
    for turn in range(repeats + 1):
        for name, run in variants.items():
            start = time.process_time()
            for _ in range(calls):
                run()
            if turn:
                best[name] = min(best[name], 1e6 * (time.process_time() - start) / calls)
    return best


def backward(loss: Callable[..., Tensor], points: Tensor, *others: object, **options: object) -> Run:
    """Forward and backward of a function of points, with a cotangent that is no constant."""
    leaf = points.clone().requires_grad_()
    cotangent = torch.rand_like(loss(points, *others, **options))
    return lambda: torch.autograd.grad(loss(leaf, *others, **options), leaf, cotangent)


def table(heads: Iterable[str], rows: Iterable[Iterable[object]]) -> None:
    heads = list(heads)
    for row in (heads, ["---", *["---:"] * (len(heads) - 1)], *rows):
        print(f"| {' | '.join(map(str, row))} |")
    print(flush=True)


def compare_layers(body: kt.Skeleton, repeats: int) -> None:
    layers: dict[str, Callable[[Tensor], Tensor]] = {
        "kcs_torch.nn.KCSMatrix": kt.nn.KCSMatrix(body),
        "C tiled": tiled(body),
        "indexing": indexed(body),
    }
    rows: dict[str, list[object]] = {name: [name] for name in layers}
    heads = ["layer"]
    for batch in BATCHES:
        points = torch.randn(batch, body.num_joints, 3, generator=torch.Generator().manual_seed(0))
        for layer in layers.values():
            torch.testing.assert_close(layer(points), layers["C tiled"](points))
        calls = max(1, 2000 // batch)
        runs: dict[str, dict[str, Run]] = {
            "forward": {name: partial(layer, points) for name, layer in layers.items()},
            "forward + backward": {name: backward(layer, points) for name, layer in layers.items()},
        }
        for what, variants in runs.items():
            heads.append(f"{batch} poses, {what}")
            times = microseconds(variants, repeats, calls)
            first = next(iter(times.values()))
            for name, value in times.items():
                rows[name].append(f"{value:.0f} ({value / first:.2f})")
    print(f"Microseconds on one thread (ratio to ours), {body.num_joints} joints:\n")
    table(heads, rows.values())


def compare_losses(body: kt.Skeleton, repeats: int) -> None:
    draw = torch.Generator().manual_seed(0)
    clip = kt.data.walking_person(FRAMES, skeleton=body, dtype=torch.float32)
    points = clip.points + 20 * torch.randn(CLIPS, *clip.points.shape, generator=draw)
    target, tracks = clip.points.expand_as(points), clip.tracks.points.expand(CLIPS, -1, -1, -1)
    weights = (torch.rand(points.shape[:-1], generator=draw) > 0.1).float()
    lengths = kt.functional.bone_lengths(clip.points, body.bone_index()).mean(0)
    nn = kt.nn
    losses: dict[str, tuple[Callable[..., Tensor], tuple[object, ...]]] = {
        "ReprojectionEnergy()": (nn.ReprojectionEnergy(), (tracks, None)),
        "PerspectiveEnergy()": (nn.PerspectiveEnergy(), (tracks, (1e3, 1e3, 0, 0))),
        "BoneLengthEnergy(body)": (nn.BoneLengthEnergy(body), (None,)),
        "SymmetryEnergy(body)": (nn.SymmetryEnergy(body), ()),
        "SmoothnessEnergy()": (nn.SmoothnessEnergy(), ()),
        "HingeEnergy(body)": (nn.HingeEnergy(body), (None,)),
        "AdductionEnergy(body)": (nn.AdductionEnergy(body), (None,)),
        "StanceEnergy(body)": (nn.StanceEnergy(body), (None,)),
        "KCSDistance(body)": (nn.KCSDistance(body), (target,)),
        "JointDistance()": (nn.JointDistance(), (target,)),
        'JointDistance("similarity")': (nn.JointDistance("similarity"), (target,)),
        'JointDistance("sequence")': (nn.JointDistance("sequence"), (target,)),
        "LowRankEnergy()": (nn.LowRankEnergy(), ()),
        'LowRankEnergy("log_det")': (nn.LowRankEnergy("log_det"), ()),
        "PostureEnergy(body)": (nn.PostureEnergy(body), (None,)),
        "ForeshorteningEnergy(body)": (nn.ForeshorteningEnergy(body), (lengths,)),
        "ProcrusteanEnergy(body)": (nn.ProcrusteanEnergy(body), (None,)),
        "KCSCritic(body)": (nn.KCSCritic(body), ()),
    }
    forward = microseconds({n: partial(f, points, *a) for n, (f, a) in losses.items()}, repeats, 5)
    both = microseconds({n: backward(f, points, *a) for n, (f, a) in losses.items()}, repeats, 5)
    masked = microseconds({n: backward(f, points, *a, weights) for n, (f, a) in losses.items()}, repeats, 5)
    print(f"Microseconds on one thread, {CLIPS} clips of {FRAMES} frames, {body.num_joints} joints:\n")
    rows = ([f"`{n}`", *(f"{t[n]:.0f}" for t in (forward, both, masked))] for n in losses)
    table(["loss", "forward", "forward + backward", "the same with weights"], rows)


def time_import(repeats: int) -> None:
    def best(what: str) -> float:
        call = [sys.executable, "-c", IMPORTS.format(what)]
        return min(
            float(subprocess.run(call, capture_output=True, text=True, check=True).stdout) for _ in range(repeats)
        )

    print("Milliseconds of CPU time in a fresh interpreter that has imported torch, least of several:\n")
    rows = {
        "`import kcs_torch`": "import kcs_torch",
        "`import kcs_torch.functional`": "import kcs_torch.functional",
        "`import kcs_torch.nn`": "import kcs_torch.nn",
    }
    table(["what", "ms"], ([name, f"{1000 * best(code):.1f}"] for name, code in rows.items()))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--skeleton", default="h36m17", choices=kt.SKELETONS, metavar="NAME")
    parser.add_argument("--repeats", type=at_least_one, default=40)
    parser.add_argument("--imports", type=int, default=5, help="fresh interpreters for each time of importing")
    options = parser.parse_args()
    torch.set_num_threads(1)
    body = kt.SKELETONS[options.skeleton]
    compare_layers(body, options.repeats)
    compare_losses(body, max(options.repeats // 4, 1))
    if options.imports:
        time_import(options.imports)


if __name__ == "__main__":
    main()
