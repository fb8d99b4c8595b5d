"""Measure what each ingredient of PKC is worth: switch it off, lift the same clips again, compare.

    python scripts/ablation.py
    python scripts/ablation.py --parts fixed --cases 20 --csv ablation.csv
    python scripts/ablation.py --variants "no hinges" "no posture" --suites static_walk
    python scripts/ablation.py --parts others --cases 21

Prints a Markdown table a part: ``fixed``, people before a camera that does not move, ``others``, people in motions that
are not among the measuring protocol's cases, seen from the front and from 60 degrees beside it, without and with 10 mm
of noise, and ``moving``, bodies without a template before a camera that turns. A figure is the mean over a suite's
clips: the distance to the truth after one rotation per frame, in mm (the protocol's ``rigid``), for ``moving`` that
after one rotation for the clip, over the deviation of the body (``e3d``); neither fits a scale. Beside them are CPU
milliseconds a frame. The truth is for scoring alone. Synthetic suites need no data; the others are those of the
measuring protocol, or made by it, where it lies beside the repository in ``../shared``, and --cases of each are taken,
evenly spread. PyTorch uses one thread.
"""

from __future__ import annotations

import argparse
import time
import warnings
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field, replace
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
import torch
from options import at_least_one
from torch import Tensor

import kcs_torch as kt
from kcs_torch.cli.demo import rigid_error
from kcs_torch.data import SyntheticClip, random_motion, walking_person
from kcs_torch.functional import centre
from kcs_torch.io.atomic import write_table
from kcs_torch.methods.pkc import Weights
from kcs_torch.methods.pkc.limbs import SignCosts
from kcs_torch.nn import PostureEnergy

SHARED = Path(__file__).resolve().parents[2] / "shared"
VIEWS = {
    "front": {"yaw": 0, "pitch": 10},
    "60 degrees": {"yaw": 60, "pitch": 10},
    "front, noise": {"yaw": 0, "pitch": 10, "noise": 10},
    "60 degrees, noise": {"yaw": 60, "pitch": 10, "noise": 10},
}
PARTS = {
    "fixed": ("walk", "walk, 15 mm noise", "static_walk", "static_action", "noise"),
    "others": tuple(VIEWS),
    "moving": ("tree", "arm", "akhter"),
}
OTHERS = (
    *(f"cmu/cmu_{n}" for n in ("02_01", "05_01", "07_01", "07_02", "08_01", "10_04", "12_01", "16_15", "16_31")),
    *(f"cmu/cmu_{n}" for n in ("26_01", "29_01", "35_06", "35_07", "35_08", "35_09", "35_10", "39_01")),
    *(f"cmu/cmu_35_{n}_run30" for n in (17, 18, 19)),
    "cmu_cs2s/train_soccer_2",
)
SYNTHETIC = ("walk", "walk, 15 mm noise", "tree", "arm")
YAWS = (0.0, 45.0, 90.0, 135.0)
# import_module, as the package's functions have the names of these modules
BODY, FIXED, FLIPS, METHOD, MOVING, OBJECTIVE, DESCENT, DESCENTS = (
    import_module(f"kcs_torch.methods.pkc.{name}")
    for name in ("body", "fixed_view", "flips", "method", "moving_search", "objective", "descent", "descents")
)
LENGTHS = import_module("kcs_torch.nn.lengths")
WRITTEN_OUT = {"posture": "_posture", "foreshortening": "_foreshortening", "proportions": "_sizes"}
"""Terms of the objective, and the methods of its descent that hold them once more, gradients and all."""

Clip = tuple[str, kt.Tracks, Tensor]
Run = dict[str, Any]
Change = tuple[Any, str, Callable[[Any], Any]]


@dataclass(frozen=True)
class Variant:
    """What is other than usual.

    Attributes:
        fields: of the method.
        changes: (owner, name, what makes the new value of the old one).
    """

    fields: dict[str, Any] = field(default_factory=dict)
    changes: tuple[Change, ...] = ()

    @contextmanager
    def method(self) -> Iterator[kt.PKC]:
        """The method, for as long as the context lasts; then all is as it was."""
        with ExitStack() as stack:
            for owner, name, change in self.changes:
                stack.enter_context(patch.object(owner, name, change(getattr(owner, name))))
            yield kt.PKC(**self.fields)


def without(term: str, **costs: float) -> Variant:
    """The objective without a term, and other costs where limbs' lengths and signs are searched."""

    def fewer(terms: Callable[..., dict[str, Tensor]]) -> Callable[..., dict[str, Tensor]]:
        def kept(*args: Any) -> dict[str, Tensor]:
            values = terms(*args)
            del values[term]  # fails where there is no such term
            return values

        return kept

    nothing = constant(
        DESCENT.ObjectiveGradient, WRITTEN_OUT[term], lambda self, first, *_: first.new_zeros(len(first))
    )
    signs = searched(lambda usual: replace(usual, **costs))
    return Variant(changes=((OBJECTIVE.Objective, "terms", fewer), nothing, signs))


def searched(change: Callable[[SignCosts], SignCosts]) -> Change:
    """Other costs in the search for limbs' lengths and signs, but not in that for the trunk, which shares them."""
    put = lambda value: change(value) if isinstance(value, SignCosts) else value  # noqa: E731
    return FIXED, "placing", lambda make: lambda *args, **more: make(*map(put, args), **more)


def first_alone(start: Callable[..., Any]) -> Callable[..., Any]:
    """A search for starts that finds one."""

    def search(*args: Any) -> Any:
        return (yield from start(*args))[:1]

    return search


def as_found(body: Any, found: Any, *_: Any) -> Any:
    """A polish that leaves all as it is."""
    yield from ()
    return found


def constant(owner: Any, name: str, value: Any) -> Change:
    """Another value of a module's constant or function."""
    return owner, name, lambda _: value


def weighted(**weights: float) -> tuple[Change, ...]:
    """Other weights of the objective, wherever one is made."""
    return tuple((owner, "Weights", lambda usual: partial(usual, **weights)) for owner in (BODY, FIXED))


INF = float("inf")
EVERYTHING = "everything"
FIXED_VARIANTS = {
    EVERYTHING: Variant(),
    "no cleaning of the tracks": Variant({"denoise": False}),
    "noise of the image explained in full": Variant(
        changes=tuple(constant(owner, "NOISE", 0.0) for owner in (OBJECTIVE, DESCENT))
    ),
    "directions as sure as in a clear image": Variant(changes=(constant(OBJECTIVE, "BLUR", 0.0),)),
    "images as likely as clear ones": Variant(
        changes=tuple(constant(owner, "HIDDEN", 1e-9) for owner in (LENGTHS, DESCENT))
    ),
    "hypotheses ranked without their room": Variant(changes=(constant(OBJECTIVE, "VOLUME", 0.0),)),
    "no posture": Variant(changes=(*without("posture", posture=INF).changes, *weighted(stance=0.0))),
    "mirror images of a motion not as likely": Variant(
        changes=(
            constant(
                OBJECTIVE,
                "usual_posture",
                lambda body, dtype, device: PostureEnergy(body, symmetric=False).to(device, dtype),
            ),
        )
    ),
    "feet need not be beneath the trunk": Variant(changes=weighted(stance=0.0)),
    "standing feet may slide in depth": Variant({"contacts": False}),
    "no hinges": Variant(changes=(*weighted(hinge=0.0), searched(lambda usual: replace(usual, hinge=0.0)))),
    "limbs may reach across the body": Variant(changes=weighted(adduction=0.0)),
    "no foreshortening": without("foreshortening", foreshortening=INF),
    "no proportions": without("proportions", proportions=INF),
    "left and right not alike": Variant(changes=weighted(twins=INF)),
    "smoothness a hundred times weaker": Variant(
        changes=(
            *weighted(acceleration=10 * Weights().acceleration),
            searched(lambda usual: replace(usual, acceleration=10 * usual.acceleration)),
        )
    ),
    "smoothness counts as much in noise": Variant(
        changes=(constant(OBJECTIVE, "in_noise", lambda weights, noise: weights),)
    ),
    "every frame counts alike (no pace)": Variant(
        changes=tuple(constant(owner, "pace_of", lambda image, skeleton, rate: rate / 30) for owner in (BODY, FIXED))
    ),
    "lengths tight from the start": Variant(changes=(constant(FIXED, "LOOSE", 1.0),)),
    "limbs do not vote on the trunk's sign": Variant(changes=(constant(FIXED, "TRUST", 0.0),)),
    "no runs turned over": Variant(changes=(constant(FLIPS, "TIMES", 0),)),
    "no discrete moves": Variant({"rounds": 0}),
    "no signs by aligned bones": Variant(changes=(constant(METHOD, "turned_around", as_found),)),
    "not polished": Variant(
        changes=(constant(BODY.Body, "polished", as_found), constant(METHOD, "turned_around", as_found))
    ),
    "one hypothesis, no moves": Variant({"rounds": 0}, ((FIXED._Search, "start", first_alone),)),
}
MOVING_VARIANTS = {
    EVERYTHING: Variant(),
    "no log-determinant of the changes": Variant(
        changes=(
            (MOVING, "FINE", lambda stages: tuple(replace(stage, still=1.0, moving=0.0) for stage in stages)),
            (MOVING, "RANKING", lambda stage: replace(stage, moving=0.0)),
        )
    ),
    "lengths free": Variant(
        changes=(
            (DESCENTS, "procrustean", lambda solve: lambda *args, **more: solve(*args, **more | {"stiffness": 0.0})),
            constant(MOVING, "length_energy", lambda points, *_: points.new_zeros(len(points))),
        )
    ),
    "no coarse stages": Variant(changes=(constant(MOVING, "COARSE", ()), constant(MOVING, "KEPT", ()))),
    "SfAM's guess as the only start": Variant(changes=(constant(MOVING.MovingSearch, "_starts", lambda *_: []),)),
    "no paths of single bones": Variant(changes=(constant(MOVING, "bone_paths", lambda *_: None),)),
}
VARIANTS = {"fixed": FIXED_VARIANTS, "others": FIXED_VARIANTS, "moving": MOVING_VARIANTS}


def e3d(points: Tensor, truth: Tensor) -> float:
    """Mean distance after one orthogonal matrix for the clip, over the truth's standard deviation."""
    points, truth = centre(points)[0], centre(truth)[0]
    flat, goal = points.flatten(0, 1), truth.flatten(0, 1)
    u, _, v = torch.linalg.svd(flat.mT @ goal)
    spread = truth.square().mean(1).sqrt().mean()
    return float((flat @ u @ v - goal).norm(dim=-1).mean() / spread)


FIGURES: dict[str, tuple[Callable[[Tensor, Tensor], float], str]] = {
    **dict.fromkeys(("fixed", "others"), (rigid_error, ".1f")),
    "moving": (e3d, ".4f"),
}


def synthetic(suite: str, frames: int) -> Iterator[Clip]:
    """Walks before a fixed camera, or trees and chains of bones in random motion before one that turns."""
    for seed, yaw in enumerate(YAWS):
        chance = torch.Generator().manual_seed(seed)
        clip: SyntheticClip
        if suite == "tree":
            body = kt.Skeleton.from_edges([((i - 1) // 2, i) for i in range(1, 15)], 15, name="tree")
            clip = random_motion(body, frames, swing=20, turn=180, generator=chance)
        elif suite == "arm":
            body = kt.Skeleton.from_edges([(i, i + 1) for i in range(6)], 7, name="arm")
            clip = random_motion(body, frames, turn=120, generator=chance)
        else:
            clip = walking_person(frames, yaw=yaw, turn=0, noise=15.0 * ("noise" in suite), generator=chance)
        yield f"{suite} {seed}", clip.tracks, clip.points[:, : clip.skeleton.num_observed]


def recorded(shared: Path, suite: str, cases: int, frames: int) -> Iterator[Clip]:
    """Some clips of one of the protocol's suites, or of one of the views of other motions."""
    from benchmark import load_input, load_protocol

    try:
        protocol = load_protocol(shared)
    except kt.OptionError as error:
        raise SystemExit(f"error: {error}") from None
    every = [{"src": src} | VIEWS[suite] for src in OTHERS] if suite in VIEWS else protocol.suites()[suite]
    for i in sorted(set(np.linspace(0, len(every) - 1, min(cases, len(every))).round().astype(int))):
        given, truth = protocol.build(shared / "data", {"max_frames": frames} | every[i])
        label = protocol.case_name(every[i])
        yield label, load_input(given, label), torch.from_numpy(truth["points3d"])


def lift(part: str, name: str, suite: str, clip: Clip) -> Run:
    """One clip by one variant."""
    label, tracks, truth = clip
    with VARIANTS[part][name].method() as method:
        start = time.process_time()
        points = method(tracks).observed
        used = time.process_time() - start
    what = {"part": part, "variant": name, "suite": suite, "case": label, "frames": len(points)}
    return what | {"error": FIGURES[part][0](points, truth), "ms": 1000 * used / len(points)}


def head(suites: list[str]) -> str:
    """The first two lines of a Markdown table."""
    return "\n".join([f"| | {' | '.join(suites)} | ms a frame |", "|---" * (len(suites) + 2) + "|"])


def row(name: str, runs: list[Run], suites: list[str], style: str) -> str:
    """A variant's line: the mean of each suite's clips, and the milliseconds of all frames."""
    means = [np.mean([run["error"] for run in runs if run["suite"] == suite]) for suite in suites]
    each = np.average([run["ms"] for run in runs], weights=[run["frames"] for run in runs])
    return f"| {name} | {' | '.join(format(mean, style) for mean in means)} | {each:.1f} |"


def measure(part: str, names: list[str], suites: list[str], options: argparse.Namespace) -> list[Run]:
    """Lift every clip by every variant, and print a part's table as it grows."""
    clips: list[tuple[str, Clip]] = []
    for suite in suites:
        if suite in SYNTHETIC:
            found = synthetic(suite, min(options.frames, 60))
        else:
            found = recorded(options.shared, suite, options.cases, options.frames)
        clips += [(suite, clip) for clip in found]
    lift(part, EVERYTHING, *clips[0])  # what the first run does once does not count
    print(f"\n{part}\n\n{head(suites)}", flush=True)
    runs: list[Run] = []
    for name in names:
        own = [lift(part, name, suite, clip) for suite, clip in clips]
        print(row(name, own, suites, FIGURES[part][1]), flush=True)
        runs += own
    return runs


def main(words: list[str] | None = None) -> None:
    """Measure what is asked for and print a table a part."""
    suites = [suite for part in PARTS.values() for suite in part]
    variants = list(dict.fromkeys(name for part in VARIANTS.values() for name in part))
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--parts", nargs="+", choices=PARTS, default=list(PARTS), metavar="PART", help=", ".join(PARTS))
    parser.add_argument("--suites", nargs="+", choices=suites, metavar="SUITE", help="; ".join(suites))
    parser.add_argument("--variants", nargs="+", choices=variants, metavar="VARIANT", help="; ".join(variants))
    parser.add_argument("--shared", type=Path, default=SHARED, help="folder with protocol/protocol.py and data/")
    parser.add_argument("--cases", type=at_least_one, default=5, help="of each of the protocol's suites, at most")
    parser.add_argument(
        "--frames", type=at_least_one, default=150, help="of most clips, at most; synthetic ones have up to 60"
    )
    parser.add_argument("--csv", type=Path, help="also write every run here")
    options = parser.parse_args(words)
    wanted = {suite for part in options.parts for suite in PARTS[part]}
    if options.suites and not wanted & set(options.suites):
        parser.error(f"--parts {' '.join(options.parts)}: has none of the suites {', '.join(options.suites)}")
    if options.csv:
        options.csv.parent.mkdir(parents=True, exist_ok=True)
    torch.set_num_threads(1)
    warnings.simplefilter("ignore", kt.KcsWarning)
    there = suites if (options.shared / "protocol").is_dir() else SYNTHETIC
    runs: list[Run] = []
    for part in options.parts:
        chosen = [suite for suite in PARTS[part] if suite in (options.suites or there)]
        names = [name for name in VARIANTS[part] if name in (*(options.variants or variants), EVERYTHING)]
        if chosen:
            runs += measure(part, names, chosen, options)
        if options.csv:  # after each part: a later one may fail
            write_table(options.csv, runs)


if __name__ == "__main__":
    main()
