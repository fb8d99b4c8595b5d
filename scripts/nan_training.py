"""Train for long with degenerate clips mixed in, and count what is not a number.

    python scripts/nan_training.py                  # 10,000 steps, some minutes of one core
    python scripts/nan_training.py --steps 500 --seed 1

A small network lifts windows of 16 frames; three steps of an unrolled solver refine them; the loss sums most energies
of kcs_torch.nn. About half of all clips are degenerate: nothing moves, one joint is seen, one frame, nothing at all, or
all joints are at one point for ever; what is unseen is NaN. After each step the loss, all gradients and all parameters
are looked at. The same run follows with the singular value shrinkage and the nuclear norm of plain torch.linalg.svd,
as far as its first NaN, after which every step is one.
"""

from __future__ import annotations

import argparse
import math
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from typing import NamedTuple
from unittest import mock

import torch
from torch import Tensor

import kcs_torch as kt
from kcs_torch.functional import centre, complete_rotation

FRAMES, CLIPS = 16, 4
KINDS = ("ordinary", "static", "one joint", "one frame", "unseen", "one point")
SHARES = torch.tensor([0.5, 0.1, 0.1, 0.1, 0.1, 0.1])


class Window(NamedTuple):
    """Tracks (C, T, N, 2), weights (C, T, N), cameras (C, T, 3, 3) and points (C, T, N, 3) in the camera frame."""

    tracks: Tensor
    weights: Tensor
    cameras: Tensor
    points: Tensor


@dataclass
class Counts:
    """How many steps had something that is no number, and the first of them."""

    steps: int = 0
    losses: int = 0
    gradients: int = 0
    parameters: int = 0
    first: int | None = None
    kinds: tuple[str, ...] = ()


def windows(body: kt.Skeleton, draw: torch.Generator) -> Iterator[tuple[Window, tuple[str, ...]]]:
    """Endless batches of windows from a few walks, half of them spoilt, and what was done to each clip."""
    walks = [
        kt.data.walking_person(
            64, skeleton=body, yaw=45.0 * k, turn=120, missing=0.1, generator=draw, dtype=torch.float32
        )
        for k in range(8)
    ]
    while True:
        parts, kinds = [], []
        for _ in range(CLIPS):
            walk = walks[int(torch.randint(len(walks), (), generator=draw))]
            start = int(torch.randint(64 - FRAMES + 1, (), generator=draw))
            at = slice(start, start + FRAMES)
            tracks = walk.tracks.points[at] / 500
            tracks = tracks + 0.01 * torch.randn(tracks.shape, generator=draw)
            one = Window(tracks, walk.tracks.weights[at], complete_rotation(walk.cameras[at]), walk.points[at] / 500)
            kinds.append(KINDS[int(torch.multinomial(SHARES, 1, generator=draw))])
            parts.append(spoil(one, kinds[-1], draw))
        yield Window(*map(torch.stack, zip(*parts, strict=True))), tuple(kinds)


def spoil(clip: Window, kind: str, draw: torch.Generator) -> Window:
    """Make a clip degenerate in the way named; unseen tracks are NaN."""
    tracks, weights, cameras, points = clip
    if kind == "static":
        tracks, weights, cameras, points = (x[:1].expand_as(x) for x in clip)
    elif kind == "one point":
        tracks, points = (x[:1, :1].expand_as(x) for x in (tracks, points))
    elif kind != "ordinary":
        frames, joints = weights.shape
        seen = torch.zeros_like(weights)
        if kind == "one joint":
            seen[:, int(torch.randint(joints, (), generator=draw))] = 1
        elif kind == "one frame":
            seen[int(torch.randint(frames, (), generator=draw))] = 1
        weights = weights * seen
    return Window(torch.where(weights[..., None] > 0, tracks, torch.nan), weights, cameras, points)


class Model(torch.nn.Module):
    """A lifter, an unrolled solver after it, and their loss."""

    def __init__(self, body: kt.Skeleton) -> None:
        super().__init__()
        nn = kt.nn
        self.network = nn.MLPLifter(body, width=32, num_blocks=1)
        self.refine = nn.UnrolledFPC(num_steps=3, mu=0.2, final=1e-3)
        self.reprojection, self.smooth = nn.ReprojectionEnergy(huber=0.5), nn.SmoothnessEnergy()
        self.bones, self.twins, self.hinges = nn.BoneLengthEnergy(body), nn.SymmetryEnergy(body), nn.HingeEnergy(body)
        self.nuclear, self.log_det = nn.LowRankEnergy(), nn.LowRankEnergy("log_det")
        self.kcs, self.free = nn.KCSDistance(body), nn.KCSDistance(body, squared=False, scale_free=True)
        self.joints, self.aligned = nn.JointDistance("root"), nn.JointDistance("similarity")

    def forward(self, batch: Window) -> Tensor:
        tracks, weights, cameras, truth = batch
        clean = torch.where(weights[..., None] > 0, tracks, torch.zeros_like(tracks))
        points = self.network(clean, weights)
        world = self.refine(tracks, cameras[..., :2, :], weights=weights, start=centre(points)[0] @ cameras)
        both = torch.stack([points, world @ cameras.mT])
        loss = self.reprojection(both, tracks, None, weights).mean() + self.bones(both, None, weights).mean()
        loss = loss + (self.twins(both, weights) + self.smooth(both, weights) + self.hinges(both, None, weights)).mean()
        loss = loss + 0.01 * (self.nuclear(world, weights) + self.log_det(world, weights)).mean()
        loss = loss + (self.kcs(both, truth, weights) + 0.1 * self.free(both, truth, weights)).mean() / 10
        both = both.flatten(0, 1)
        truth, weights = truth.repeat(2, 1, 1, 1), weights.repeat(2, 1, 1)
        return loss + (self.joints(both, truth, weights) + self.aligned(both, truth, weights)).mean()


def plain_svt(matrix: Tensor, threshold: Tensor | float, corner: Tensor | float = math.inf) -> Tensor:
    """U max(S - threshold / (1 + S / corner), 0) V^T as the formula says, its derivative left to autograd."""
    u, s, vh = torch.linalg.svd(matrix, full_matrices=False)
    level, bend = (torch.as_tensor(x, dtype=s.dtype)[..., None] for x in (threshold, corner))
    return (u * (s - level / (1 + s / bend)).clamp_min(0)[..., None, :]) @ vh


def plain_nuclear_norm(matrix: Tensor) -> Tensor:
    """Sum of the singular values by plain autograd."""
    return torch.linalg.svd(matrix, full_matrices=False)[1].sum(-1)


@contextmanager
def plain() -> Iterator[None]:
    """Within this context the library shrinks singular values as one writes it down first."""
    twins: dict[object, object] = {kt.functional.svt: plain_svt, kt.functional.nuclear_norm: plain_nuclear_norm}
    with ExitStack() as stack:
        for name, module in list(sys.modules.items()):
            for key, value in list(vars(module).items()) if name.startswith("kcs_torch.") else ():
                for ours, twin in twins.items():
                    if value is ours:
                        stack.enter_context(mock.patch.object(module, key, twin))
        yield


def train(steps: int, seed: int = 0, *, stop: bool = False) -> Counts:
    """Train and count; ``stop`` ends at the first step that is no number."""
    body = kt.SKELETONS["h36m17"]
    counts = Counts()
    with torch.random.fork_rng():
        torch.manual_seed(seed)
        model = Model(body)
        optimiser = torch.optim.Adam(model.parameters(), 1e-3)
        batches = windows(body, torch.Generator().manual_seed(seed))
        for step, (batch, kinds) in zip(range(steps), batches, strict=False):
            optimiser.zero_grad()
            loss = model(batch)
            loss.backward()
            gradients = [p.grad for p in model.parameters() if p.grad is not None]
            wrong_gradient = not all(bool(torch.isfinite(g).all()) for g in gradients)
            optimiser.step()
            wrong_parameter = not all(bool(torch.isfinite(p).all()) for p in model.parameters())
            wrong_loss = not bool(torch.isfinite(loss))
            counts.steps += 1
            counts.losses += wrong_loss
            counts.gradients += wrong_gradient
            counts.parameters += wrong_parameter
            if counts.first is None and (wrong_loss or wrong_gradient or wrong_parameter):
                counts.first, counts.kinds = step + 1, kinds
                if stop:
                    break
    return counts


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--steps", type=int, default=10_000)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    torch.set_num_threads(1)
    print("| run | steps | NaN in the loss | in a gradient | in a parameter | first at step | CPU s |")
    print("| --- | ---: | ---: | ---: | ---: | ---: | ---: |")
    for name in ("kcs_torch", "plain torch.linalg.svd"):
        begin = time.process_time()
        if name == "kcs_torch":
            counts = train(options.steps, options.seed)
        else:
            with plain():
                counts = train(options.steps, options.seed, stop=True)
        first = "never" if counts.first is None else f"{counts.first} ({', '.join(counts.kinds)})"
        print(
            f"| {name} | {counts.steps} | {counts.losses} | {counts.gradients} | {counts.parameters} | {first} "
            f"| {time.process_time() - begin:.0f} |",
            flush=True,
        )


if __name__ == "__main__":
    main()
