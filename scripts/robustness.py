"""Measure how methods bear wrong lengths, wrong templates and noise, on real motion of several people.

    python scripts/robustness.py
    python scripts/robustness.py --parts lengths noise --seeds 5 --csv robustness.csv

Parts, after figure 5 of Kovalenko et al. 2019:

``lengths``    SfAM with fixed bone lengths that are off by up to so many mm, beside re-estimated ones (5b, 5c)
``variation``  how much bones change their length over time, with and without the articulated term (5d)
``noise``      noise in the tracks (5a)
``template``   KCS with a template whose bones are too long or short, or point elsewhere; one fixed camera
``missing``    PKC where joints are hidden, beside curves through the true places of all that are seen
``short``      SfAM and PKC in clips of a few frames, of bodies without a template, before a camera that goes round

Motion, views and figures are those of the measuring protocol, which lies beside the repository in ``../shared``. A row
is the mean over sequences and seeds, and the standard deviation of seeds' means; --csv has every single run.
"""

from __future__ import annotations

import argparse
import math
import warnings
from collections.abc import Callable, Iterator
from functools import partial
from itertools import product
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import torch
from benchmark import load_input, load_protocol
from options import at_least_one
from scipy.interpolate import CubicSpline, PchipInterpolator, make_interp_spline
from torch import Tensor

import kcs_torch as kt
from kcs_torch.functional import bone_lengths, bone_vectors, chain_inverse, incidence, points_from_bones
from kcs_torch.io.atomic import write_table

SHARED = Path(__file__).resolve().parents[2] / "shared"
# Walks, a kick, dances and climbing, before a camera that orbits by half a turn; --sequences takes the first ones.
ORBIT = ("02_01", "07_01", "16_15", "35_01", "39_01", "10_04", "49_18", "charleston1", "zombie", "01_01")
# Eight people who walk before a fixed camera, each seen from four sides.
WALKS = ("02_01", "05_01", "07_01", "08_01", "12_01", "16_15", "35_01", "39_01")
# Animals, hands, robots, people and markers; a few frames of each, from two of its places on and in three views.
MOTIONS = (
    *("dog/dog_walk01", "hand/manipnet_mug1_rightHand", "cmu/cmu_35_01", "robot/franka_panda_fk"),
    *("akhter/akhter_stretch", "dog/dog_run00", "hand/manipnet_cup1_bothhands", "cmu/cmu_49_18", "robot/ur5e_fk"),
    *("akhter/akhter_yoga", "cmu_cs2s/train_jumping_1", "cmu/cmu_05_01", "cmu/cmu_16_15", "fly/df3d_fly"),
    "cmu_cs2s/train_soccer_2",
)
PLACES, ROUND = (0.2, 0.7), ((60, 0), (120, 70), (180, 30))  # share of the frames before; degrees of orbit, and yaw
FEW = (4, 6, 10, 16, 26, 40, 58)
LENGTHS = (0, 10, 30, 50, 70)  # mm
NOISE = (0, 5, 10, 15, 20)  # mm
TEMPLATE = ((0, 0), (10, 0), (20, 0), (30, 0), (0, 10), (0, 20))  # per cent of length, degrees
CURVES = {"lines": partial(make_interp_spline, k=1), "monotone cubics": PchipInterpolator, "splines": CubicSpline}
PITCH = 10
FIGURES = ("rigid", "e3d", "bone_cv")

Run = dict[str, Any]
Case = tuple[str, kt.Tracks, dict[str, Any]]


class Bench:
    """Cases of the protocol and their scores."""

    def __init__(self, shared: Path, frames: int, sequences: int, seeds: int = 1) -> None:
        self.protocol: ModuleType = load_protocol(shared)
        self.data, self.frames, self.sequences, self.seeds = shared / "data", frames, sequences, seeds

    def cases(self, names: tuple[str, ...], views: list[dict[str, float]]) -> Iterator[Case]:
        """Yield label, tracks and truth of each sequence and view."""
        for name in names[: self.sequences]:
            for view in views:
                case = {"src": f"cmu/cmu_{name}", "max_frames": self.frames, "pitch": PITCH} | view
                given, truth = self.protocol.build(self.data, case)
                label = self.protocol.case_name(case)
                yield label, load_input(given, label), truth

    def orbits(self) -> Iterator[Case]:
        """The same before a camera that goes round by half a turn."""
        return self.cases(ORBIT, [{"yaw": 45, "orbit": 180}])

    def orbit_cameras(self, frames: int) -> Tensor:
        """The true cameras (T, 2, 3) of these orbits."""
        yaw = np.linspace(45, 45 + 180, frames)
        return torch.from_numpy(self.protocol.rotation(yaw, PITCH)[:, :2])

    def few(self, name: str, frames: int, place: float, orbit: float, yaw: float) -> Case | None:
        """So many frames of a motion before a camera that goes round meanwhile; None if it has fewer."""
        source = self.protocol.load(self.data, name)
        points, edges = source["points3d"].astype(float), source["edges"] if "edges" in source.files else None
        if name.startswith("cmu/"):
            points, edges = points[:, self.protocol.CMU17], np.array(self.protocol.CMU17_EDGES)
        points = points[:: 4 if float(source["fps"]) >= 100 else 1]
        if len(points) < frames:
            return None
        first = int(place * (len(points) - frames))
        turned = self.protocol.rotation(yaw + orbit * np.linspace(0, 1, frames), PITCH)
        points = np.einsum("tij,tnj->tni", turned, points[first : first + frames])
        tracks = kt.Tracks.from_arrays(points[..., :2], edges=edges, source=name)
        return f"{name} from {place:g}, orbit {orbit:g}", tracks, {"points3d": points, "edges": edges}

    def score(self, result: kt.Reconstruction | Tensor, truth: dict[str, Any]) -> Run:
        """The protocol's figures of a result, or of points."""
        points = result if isinstance(result, Tensor) else result.observed
        figures = self.protocol.score(points.numpy(), truth["points3d"], truth["edges"])
        return {name: figures.get(name, math.nan) for name in FIGURES}  # no edges, no bones


def lengths(bench: Bench) -> Iterator[Run]:
    """SfAM with the true bone lengths, off by up to so many mm, and with those that it finds itself."""
    for label, tracks, truth in bench.orbits():
        found = bench.score(kt.SfAM()(tracks), truth)
        true = true_lengths(tracks, truth)
        for level in LENGTHS:
            for seed in range(bench.seeds if level else 1):
                off = level * (2 * torch.rand(true.shape, generator=generator(seed), dtype=true.dtype) - 1)
                given = torch.maximum(true + off, 0.1 * true)  # of short bones something is left
                figures = bench.score(kt.SfAM(lengths=given.tolist())(tracks), truth)
                yield {"setting": f"lengths given, off by up to {level} mm", "case": label, "seed": seed} | figures
        yield {"setting": "lengths found by SfAM", "case": label, "seed": 0} | found


def variation(bench: Bench) -> Iterator[Run]:
    """Standard deviation over mean of each bone's length over time, per cent, among bones that are truly rigid."""
    for label, tracks, truth in bench.orbits():
        bones = tracks.skeleton.bone_index()
        true = bone_lengths(torch.from_numpy(truth["points3d"]), bones)
        rigid = true.std(0) < 0.02 * true.mean(0)
        for setting, method in (("SfAM", kt.SfAM()), ("SfAM, beta = 0", kt.SfAM(beta=0))):
            result = method(tracks)
            size = bone_lengths(result.points, bones)
            share = 100 * size.std(0, unbiased=False) / size.mean(0)
            each = {
                name: float(v) for name, v, fixed in zip(tracks.skeleton.bone_names, share, rigid, strict=True) if fixed
            }
            yield {"setting": setting, "case": label, "seed": 0} | bench.score(result, truth) | {"bones": each}


def noise(bench: Bench) -> Iterator[Run]:
    """Gaussian noise on the tracks of an orbit; with the true cameras, too, to tell cameras from shape."""
    for label, tracks, truth in bench.orbits():
        known = bench.orbit_cameras(tracks.num_frames)
        methods: dict[str, tuple[kt.Method, Tensor | None]] = {
            "SfAM": (kt.SfAM(), None),
            "SfAM, beta = 0": (kt.SfAM(beta=0), None),
            "SfAM, true cameras": (kt.SfAM(), known),
            "KCS": (kt.KCS(), None),
        }
        for name, (method, cameras) in methods.items():
            for level in NOISE:
                for seed in range(bench.seeds if level else 1):
                    shift = torch.randn(tracks.points.shape, generator=generator(seed), dtype=tracks.points.dtype)
                    figures = bench.score(method(replace_points(tracks, tracks.points + level * shift), cameras), truth)
                    yield {"setting": f"{name}, noise {level} mm", "case": label, "seed": seed} | figures


def template(bench: Bench) -> Iterator[Run]:
    """KCS from templates that differ from the skeleton's own; the flat guess for comparison."""
    views: list[dict[str, float]] = [{"yaw": yaw} for yaw in (0, 45, 90, 135)]
    for label, tracks, truth in bench.cases(WALKS, views):
        flat = torch.nn.functional.pad(tracks.points, (0, 1))
        yield {"setting": "flat guess", "case": label, "seed": 0} | bench.score(flat, truth)
        for share, degrees in TEMPLATE:
            for seed in range(bench.seeds if share or degrees else 1):
                rest = perturbed(tracks.skeleton, share / 100, math.radians(degrees), generator(seed))
                figures = bench.score(kt.KCS(template=rest.tolist())(tracks), truth)
                setting = (
                    f"KCS, lengths off by up to {share} %" if share else f"KCS, directions off by {degrees} degrees"
                )
                setting = setting if share or degrees else "KCS, own template"
                yield {"setting": setting, "case": label, "seed": seed} | figures


def missing(bench: Bench) -> Iterator[Run]:
    """The protocol's clips with hidden joints. Curves know the true places of the body and of its seen joints."""
    cases = bench.protocol.suites()["missing"]
    for case in [c for c in cases if c["src"] in list(dict.fromkeys(c["src"] for c in cases))[: bench.sequences]]:
        for share in dict.fromkeys((0.0, case["missing"])):
            given, truth = bench.protocol.build(bench.data, case | {"missing": share, "max_frames": bench.frames})
            label, level = bench.protocol.case_name(case | {"missing": share}), f"{100 * share:.0f} % missing"
            tracks = load_input(given, label)
            run = {"case": label, "seed": 0}
            if share or case["missing"] == cases[0]["missing"]:
                yield {"setting": f"PKC, {level}"} | run | bench.score(kt.PKC()(tracks), truth)
            true, seen = truth["points3d"], tracks.seen[:, : tracks.skeleton.num_observed].numpy()
            about = true - true.mean(1, keepdims=True)
            for name, curve in CURVES.items() if share else ():
                points = torch.from_numpy(filled(about, seen, curve))
                yield {"setting": f"truth, {name}, {level}"} | run | bench.score(points, truth)


def short(bench: Bench) -> Iterator[Run]:
    """Clips of a few frames, of bodies of which nothing is known, before a camera that goes round meanwhile."""
    methods: dict[str, kt.Method] = {"SfAM": kt.SfAM(), "PKC": kt.PKC()}
    for frames in (count for count in FEW if count <= bench.frames):
        for name, place, view in product(MOTIONS[: bench.sequences], PLACES, ROUND):
            if (case := bench.few(name, frames, place, *view)) is None:
                continue
            label, tracks, truth = case
            run = {"case": label, "seed": 0}
            flat = torch.nn.functional.pad(tracks.points, (0, 1))
            yield {"setting": f"flat guess, {frames} frames"} | run | bench.score(flat, truth)
            for kind, method in methods.items():
                yield {"setting": f"{kind}, {frames} frames"} | run | bench.score(method(tracks), truth)


PARTS = {f.__name__: f for f in (lengths, variation, noise, template, missing, short)}


def filled(points: np.ndarray, seen: np.ndarray, curve: Callable[..., Any]) -> np.ndarray:
    """Points (T, N, 3) with curves in place of what is not seen (T, N); the ends are held.

    Seen in one frame a joint stays where it was, and one that is never seen at the origin.
    """
    out = points * seen[..., None]
    for joint, shown in enumerate(seen.T):
        known = np.flatnonzero(shown)
        if len(known) < 2:
            out[:, joint] = out[:, joint].sum(0)
            continue
        time = np.clip(np.flatnonzero(~shown), known[0], known[-1])
        out[~shown, joint] = curve(known, points[known, joint])(time)
    return out


def generator(seed: int) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def replace_points(tracks: kt.Tracks, points: Tensor) -> kt.Tracks:
    """The same tracks at other places; virtual joints are made anew."""
    count = tracks.skeleton.num_observed
    weights = tracks.weights[:, :count]
    return kt.Tracks.from_arrays(
        points[:, :count], weights, skeleton=tracks.skeleton, fps=tracks.fps, units=tracks.units, source=tracks.source
    )


def true_lengths(tracks: kt.Tracks, truth: dict[str, Any]) -> Tensor:
    """Mean true length of each bone of the tracks' skeleton (B,), mm."""
    return bone_lengths(torch.from_numpy(truth["points3d"]), tracks.skeleton.bone_index()).mean(0)


def perturbed(body: kt.Skeleton, share: float, angle: float, chance: torch.Generator) -> Tensor:
    """The template (N, 3) with each bone scaled by 1 - share .. 1 + share, and turned by an angle about any axis."""
    bones = bone_vectors(body.template_points(dtype=torch.float64), body.bone_index())
    scale = 1 + share * (2 * torch.rand(len(bones), 1, generator=chance, dtype=bones.dtype) - 1)
    axis = torch.randn(bones.shape, generator=chance, dtype=bones.dtype)
    across = torch.nn.functional.normalize(torch.linalg.cross(bones, axis), dim=-1) * bones.norm(dim=-1, keepdim=True)
    turned = math.cos(angle) * bones + math.sin(angle) * across
    inverse = chain_inverse(incidence(body.bone_index(), body.num_joints, dtype=bones.dtype))
    return points_from_bones(scale * turned, inverse)


def means(runs: list[Run]) -> str:
    """A line a setting: mean and spread of the figures."""
    lines = [f"{'setting':<40}{'runs':>6}" + "".join(f"{name:>20}" for name in FIGURES)]
    for setting in dict.fromkeys(run["setting"] for run in runs):  # in the order of their first run
        group = [run for run in runs if run["setting"] == setting]
        line = f"{setting:<40}{len(group):>6}"
        for name in FIGURES:
            seeds = {run["seed"] for run in group}
            each = [np.mean([run[name] for run in group if run["seed"] == seed]) for seed in seeds]
            spread = f" +- {np.std(each, ddof=1):.3f}" if len(each) > 1 else " " * 9
            line += f"{np.mean(each):>11.3f}{spread:<9}"
        lines.append(line.rstrip())
    return "\n".join(lines)


def bone_table(runs: list[Run]) -> str:
    """Variation by sequence and by bone, per cent: with the articulated term, without, and their ratio."""
    kinds = list(dict.fromkeys(run["setting"] for run in runs))
    line = lambda name, values: (  # noqa: E731
        f"{name:<40}" + "".join(f"{v:>16.3f}" for v in values) + f"{values[1] / values[0]:>10.1f}"
    )
    pick = lambda setting, case: next(r["bones"] for r in runs if (r["setting"], r["case"]) == (setting, case))  # noqa: E731
    cases = list(dict.fromkeys(run["case"] for run in runs))
    medians = [[float(np.median(list(pick(kind, case).values()))) for kind in kinds] for case in cases]
    head = "".join(f"{kind:>16}" for kind in kinds) + f"{'ratio':>10}"
    lines = [f"{'median bone of a sequence':<40}{head}"]
    lines += [line(case, values) for case, values in zip(cases, medians, strict=True)]
    lines.append(line("mean", np.mean(medians, 0)))
    lines.append(f"\n{'bone, mean over sequences':<40}{head}")
    for name in dict.fromkeys(name for run in runs for name in run["bones"]):
        known = [run for run in runs if name in run["bones"]]
        lines.append(line(name, [np.mean([r["bones"][name] for r in known if r["setting"] == kind]) for kind in kinds]))
    return "\n".join(lines)


def main(words: list[str] | None = None) -> None:
    """Run what is asked for and print a table a part."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--parts", nargs="+", choices=PARTS, default=list(PARTS), metavar="PART", help=", ".join(PARTS))
    parser.add_argument("--shared", type=Path, default=SHARED, help="folder with protocol/protocol.py and data/")
    parser.add_argument("--seeds", type=at_least_one, default=3, help="random draws of each disturbance")
    parser.add_argument("--frames", type=at_least_one, default=300, help="of each sequence, at most")
    parser.add_argument("--sequences", type=at_least_one, default=len(MOTIONS), help="of each part, at most")
    parser.add_argument("--csv", type=Path, help="also write every run here")
    options = parser.parse_args(words)
    if options.csv:
        options.csv.parent.mkdir(parents=True, exist_ok=True)
    torch.set_num_threads(1)
    warnings.simplefilter("ignore", kt.KcsWarning)
    try:
        bench = Bench(options.shared, options.frames, options.sequences, options.seeds)
    except kt.OptionError as error:
        raise SystemExit(f"error: {error}") from None
    everything: list[Run] = []
    for part in options.parts:
        runs = list(PARTS[part](bench))
        print(f"\n{part}: {PARTS[part].__doc__}\n\n{means(runs)}", flush=True)
        if part == "variation":
            print(f"\n{bone_table(runs)}", flush=True)
        for run in runs:
            bones = run.pop("bones", {})
            everything.append({"part": part} | run | {f"variation of {name}": value for name, value in bones.items()})
        if options.csv:  # after each part: a later one may fail
            write_table(options.csv, everything)


if __name__ == "__main__":
    main()
