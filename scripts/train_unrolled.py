"""Train a solver of few steps, and compare it with many steps of the untrained one, on people it has not seen.

    python scripts/train_unrolled.py
    python scripts/train_unrolled.py --solver pkc --turn 20 90 --rounds 100 --save solver.pt
    python scripts/train_unrolled.py --data synthetic

Windows of motion are filmed by cameras that stand anywhere and walk around the body, with noise and hidden joints; the
cameras are known to the solver. Training sees windows of some people, the figures are of others. Beside the untrained
solver as it is, one whose last threshold is the best of a grid on the training windows (fpc, sfam and kcs). Prints a
Markdown table: the mean distance of joints from the truth about the joints' mean, without any fit, and CPU time of
one thread. Data are 3D motion files whose names tell the subject (cmu_SUBJECT_TRIAL.npz); "synthetic" needs none.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import torch
from options import at_least_one
from torch import Tensor

import kcs_torch as kt
from kcs_torch.functional import centre, orbit, project
from kcs_torch.functional.guarded import safe_norm
from kcs_torch.io.atomic import atomic_path
from kcs_torch.nn.unrolled import Unrolled

SHARED = Path(__file__).resolve().parents[2] / "shared" / "data" / "cmu"
TESTED = ("02", "07", "12", "35", "49")
"""Subjects that are only tested on."""

Solve = Callable[[Tensor, Tensor, Tensor], Tensor]


def motions(data: str, tested: bool) -> tuple[kt.Skeleton, list[Tensor]]:
    """The skeleton, and motion of subjects (T, N, 3) in mm, y down, at about 30 frames a second."""
    if data == "synthetic":
        seeds = range(100, 104) if tested else range(8)
        draw = lambda seed: torch.Generator().manual_seed(seed)  # noqa: E731
        clips = [kt.data.random_motion("h36m17", 240, turn=0.0, generator=draw(seed)) for seed in seeds]
        return kt.SKELETONS["h36m17"], [clip.points for clip in clips]
    found = []
    for path in sorted(Path(data).glob("cmu_[0-9]*.npz")):
        if (path.stem.split("_")[1] in TESTED) == tested:
            one = kt.load_motion(path)
            every = max(1, round((one.fps or 30.0) / 30))
            found.append((one.skeleton, one.points[::every] * torch.tensor([1.0, -1.0, -1.0]).to(one.points)))
    if not found:
        raise SystemExit(
            f"{data}: no motion files cmu_SUBJECT_TRIAL.npz of {'test' if tested else 'training'} subjects"
        )
    return found[0][0], [points for _, points in found]


class Film:
    """Batches of windows: tracks (B, T, N, 2), camera rows (B, T, 2, 3), weights (B, T, N), and truth (B, T, N, 3)."""

    def __init__(self, clips: list[Tensor], options: argparse.Namespace) -> None:
        self.frames, self.options = options.frames, options
        self.clips = [clip.to(torch.float64) for clip in clips if len(clip) >= options.frames]

    def batch(self, size: int, generator: torch.Generator) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        draw = lambda *shape: torch.rand(*shape, generator=generator, dtype=torch.float64)  # noqa: E731
        windows = []
        for clip in torch.randint(len(self.clips), (size,), generator=generator).tolist():
            first = int(draw(()) * (len(self.clips[clip]) - self.frames + 1))
            windows.append(self.clips[clip][first : first + self.frames])
        truth = torch.stack(windows)
        low, high = self.options.turn
        turn = (low + (high - low) * draw(size, 1)) * torch.where(draw(size, 1) < 0.5, -1, 1)
        yaw = 360 * draw(size, 1) + turn * torch.linspace(0, 1, self.frames, dtype=torch.float64)
        cameras = orbit(yaw, 10.0)[..., :2, :]
        tracks = project(truth, cameras)
        tracks = tracks + self.options.noise * torch.randn(tracks.shape, generator=generator, dtype=torch.float64)
        weights = (draw(*tracks.shape[:-1]) >= self.options.missing).to(torch.float64)
        return tracks, cameras, weights, centre(truth)[0]


def error(found: Tensor, truth: Tensor) -> Tensor:
    """Mean distance of joints (B,), about the joints' mean in each frame."""
    return safe_norm(centre(found)[0] - truth).mean((-2, -1))


def build(kind: str, skeleton: kt.Skeleton, steps: int, *, trained: bool = False, **options: Any) -> Unrolled:
    """An untrained solver; ``trained``: one whose bone lengths are learned, too, where it has any."""
    if kind == "fpc":
        return kt.nn.UnrolledFPC(steps, **options)
    kinds = {"sfam": kt.nn.UnrolledSfAM, "pkc": kt.nn.UnrolledPKC, "kcs": kt.nn.UnrolledKCS}
    return kinds[kind](skeleton, steps, learnable_lengths=trained, **options)


def solver(layer: Unrolled) -> Solve:
    return lambda tracks, cameras, weights: layer(tracks, cameras, weights=weights)


def learned(layer: Unrolled) -> list[str]:
    """Names of what a layer learns."""
    return [name.removeprefix("raw_") for name, value in layer.named_parameters() if value.requires_grad]


def train(layer: Unrolled, film: Film, options: argparse.Namespace) -> float:
    """Adam on the mean distance from the truth; return the CPU seconds it took."""
    generator, begin = torch.Generator().manual_seed(options.seed), time.process_time()
    optimiser = torch.optim.Adam(layer.parameters(), options.lr)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, options.rounds)
    for number in range(options.rounds):
        tracks, cameras, weights, truth = film.batch(options.batch, generator)
        loss = error(solver(layer)(tracks, cameras, weights), truth).mean()
        optimiser.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(layer.parameters(), 100.0)
        optimiser.step()
        schedule.step()
        if options.verbose and number % 10 == 0:
            print(f"  round {number}: {loss.item():.1f} mm", flush=True)
    return time.process_time() - begin


def score(layer: Unrolled, clips: list[tuple[Tensor, Tensor, Tensor, Tensor]]) -> tuple[Tensor, float]:
    """Errors (clips,), and CPU milliseconds a frame."""
    with torch.no_grad():
        begin = time.process_time()
        found = [solver(layer)(*clip[:3]) for clip in clips]
        spent = time.process_time() - begin
    frames = sum(clip[0].shape[0] * clip[0].shape[1] for clip in clips)
    return torch.cat([error(x, clip[3]) for x, clip in zip(found, clips, strict=True)]), 1e3 * spent / frames


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--solver", choices=("fpc", "sfam", "kcs", "pkc"), default="sfam")
    parser.add_argument("--steps", type=at_least_one, default=10, help="of the trained solver")
    parser.add_argument("--many", type=at_least_one, default=300, help="steps of the untrained one")
    parser.add_argument("--data", default=str(SHARED), help="folder of motion files, or 'synthetic'")
    parser.add_argument("--frames", type=at_least_one, default=60)
    parser.add_argument(
        "--turn", type=float, nargs=2, default=(30.0, 180.0), help="degrees that cameras turn in a window"
    )
    parser.add_argument("--noise", type=float, default=5.0, help="mm")
    parser.add_argument("--missing", type=float, default=0.05, help="share of hidden joints")
    parser.add_argument("--rounds", type=at_least_one, default=400)
    parser.add_argument("--batch", type=at_least_one, default=8)
    parser.add_argument("--test", type=at_least_one, default=64, help="windows tested")
    parser.add_argument("--lr", type=float, default=0.05)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--fix", nargs="*", default=(), help="what is not learned, such as: corner length")
    parser.add_argument("--save", type=Path, help="write the trained parameters to this file")
    parser.add_argument("--verbose", action="store_true")
    options = parser.parse_args()
    torch.set_num_threads(1)
    skeleton, clips = motions(options.data, tested=False)
    others = motions(options.data, tested=True)[1]
    longest = min(max(map(len, some)) for some in (clips, others))
    if options.frames > longest:
        parser.error(f"--frames: expected at most {longest}, as the clips have, got {options.frames}")
    film, unseen = Film(clips, options), Film(others, options)
    generator = torch.Generator().manual_seed(options.seed + 1)
    sizes = [min(options.batch, options.test - first) for first in range(0, options.test, options.batch)]
    held_out = [unseen.batch(size, generator) for size in sizes]
    kind: dict[str, Any] = {"arrangement": "frames"} if options.solver == "kcs" else {}
    make = partial(build, options.solver, skeleton, **kind)
    layer = make(options.steps, trained=True)
    for name in options.fix:
        if not hasattr(layer, f"raw_{name}"):
            raise SystemExit(f"--fix {name}: {options.solver} learns {', '.join(learned(layer))}")
        getattr(layer, f"raw_{name}").requires_grad_(False)
    rows: list[tuple[str, Unrolled]] = [
        ("untrained", make(options.steps)),
        ("untrained", make(options.many)),
    ]
    if options.solver != "pkc":
        known = [film.batch(options.batch, generator) for _ in range(2)]
        grid = [make(options.many, final=10.0**k) for k in (-4, -3, -2, -1.5, -1)]
        best = min(grid, key=lambda one: float(score(one, known)[0].mean()))
        rows.append(("untrained, last threshold by grid", best))
    seconds = train(layer, film, options)
    rows.append(("trained", layer))
    count = sum(p.numel() for p in layer.parameters() if p.requires_grad)
    told = f"{count} parameters ({', '.join(learned(layer))})"
    print(f"\n{options.solver}: trained in {seconds:.0f} s of CPU, {told}; figures are of")
    print(f"{options.test} windows of {options.frames} frames of other people, the same for all rows\n")
    print("| solver | steps | error mm | worst clip | ms/frame | time |\n|---|---|---|---|---|---|")
    figures = [(name, one.num_steps, *score(one, held_out)) for name, one in rows]
    whole = figures[1][3]
    for name, steps, errors, spent in figures:
        shown = f"{errors.mean():.2f} | {errors.max():.1f} | {spent:.3f} | {100 * spent / whole:.1f} %"
        print(f"| {name} | {steps} | {shown} |")
    if options.save:
        with atomic_path(options.save) as temporary:
            torch.save(layer.state_dict(), temporary)


if __name__ == "__main__":
    main()
