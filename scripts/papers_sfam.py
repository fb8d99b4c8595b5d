"""Table 2 and figure 5 of SfAM (Kovalenko et al., Sensors 2019); see ``papers.py``."""

from __future__ import annotations

import math
import tempfile
from collections.abc import Iterator
from pathlib import Path

import torch
from benchmark import run_case
from papers import Part, Row, Settings
from robustness import generator, replace_points, true_lengths

import kcs_torch as kt
from kcs_torch.methods import METHODS

SEQUENCES = ("drink", "pickup", "stretch", "yoga")
PRINTED = {
    "published: SfAM": {"e3d_world": (0.0226, 0.1921, 0.0673, 0.1242)},
    "published: SMSR": {"e3d_world": (0.0287, 0.2020, 0.0783, 0.1493)},
    "authors' code: PTA": {
        "e3d": (0.0232, 0.0684, 0.0832, 0.0527),
        "e3d_world": (0.0250, 0.2374, 0.1034, 0.1554),
    },
    "authors' code: CSF": {
        "e3d": (0.0200, 0.0462, 0.0393, 0.0351),
        "e3d_world": (0.0224, 0.2300, 0.0712, 0.1473),
    },
    "authors' code: BMM": {
        "e3d": (0.0224, 0.0503, 0.0400, 0.0346),
        "e3d_world": (0.0266, 0.1692, 0.1034, 0.1377),
    },
    "authors' code: PND2": {
        "e3d": (0.0048, 0.0193, 0.0222, 0.0169),
        "e3d_world": (math.nan, 0.1142, math.nan, 0.1046),
    },
}
"""What the papers print, and what their authors' public code gives by the same measure."""

NOISE = (0, 5, 10, 20, 40)  # mm
SHARES = (0, 10, 20, 30, 50)  # per cent of a bone's length


def table2(settings: Settings) -> Iterator[Row]:
    """Every method on the four sequences: one protocol, own cameras, defaults for all."""
    bench = settings.bench
    for setting, figures in PRINTED.items():
        for i, name in enumerate(SEQUENCES):
            yield {"setting": setting, "at": name} | {figure: values[i] for figure, values in figures.items()}
    cases = {str(case["src"]).rpartition("_")[2]: case for case in bench.protocol.suites()["akhter"]}
    with tempfile.TemporaryDirectory() as folder:
        for name in settings.methods:
            for label, case in cases.items():
                target = Path(folder) / "prediction.npz"
                figures = run_case(bench.protocol, bench.data, case, METHODS[name](), target)
                yield {"setting": name, "at": label} | figures


def rivals(settings: Settings) -> dict[str, kt.Method]:
    """SfAM, what it is without bones, and the methods that its paper compares with."""
    both = {"sfam": kt.SfAM(), "sfam, beta = 0": kt.SfAM(beta=0)}
    return both | {name: METHODS[name]() for name in ("smsr", "bmm") if name in settings.methods}


def noise(settings: Settings) -> Iterator[Row]:
    """Gaussian noise of so many mm on the tracks."""
    for label, tracks, truth in settings.bench.orbits():
        for level in NOISE:
            for seed in range(settings.seeds if level else 1):
                shift = torch.randn(tracks.points.shape, generator=generator(seed), dtype=tracks.points.dtype)
                noisy = replace_points(tracks, tracks.points + level * shift)
                for name, method in rivals(settings).items():
                    figures = settings.bench.score(method(noisy), truth)
                    yield {"setting": name, "at": level, "case": label, "seed": seed} | figures


def lengths(settings: Settings) -> Iterator[Row]:
    """SfAM with the true bone lengths held, wrong by up to so many per cent; and with those that it finds."""
    for label, tracks, truth in settings.bench.orbits():
        true = true_lengths(tracks, truth)
        found = settings.bench.score(kt.SfAM()(tracks), truth)
        for share in SHARES:
            yield {"setting": "found by SfAM (default)", "at": share, "case": label, "seed": 0} | found
            for seed in range(settings.seeds if share else 1):
                draw = 2 * torch.rand(true.shape, generator=generator(seed), dtype=true.dtype) - 1
                wrong = (true * (1 + share / 100 * draw)).tolist()
                row = {"at": share, "case": label, "seed": seed}
                printed = kt.SfAM(lengths=wrong, articulate_from=0.0)
                yield {"setting": "held"} | row | settings.bench.score(kt.SfAM(lengths=wrong)(tracks), truth)
                yield {"setting": "held from the first step"} | row | settings.bench.score(printed(tracks), truth)


def variation(settings: Settings) -> Iterator[Row]:
    """How much the lengths of truly rigid bones vary over time; with the true cameras, too, to tell them apart."""
    for label, tracks, truth in settings.bench.orbits():
        name = label.removeprefix("cmu_").removesuffix("_yaw45_orbit180")
        cameras = {"": None, ", true cameras": settings.bench.orbit_cameras(tracks.num_frames)}
        for kind, known in cameras.items():
            for method, recipe in rivals(settings).items():
                figures = settings.bench.score(recipe(tracks, known), truth)
                yield {"setting": method + kind, "at": name, "case": label} | figures


PARTS = {
    "table2": Part(
        "SfAM, table 2: drink, pickup, stretch and yoga", "sequence", ("e3d_world", "e3d", "cpu_seconds"), table2
    ),
    "noise": Part("SfAM, figure 5a: noise in the tracks", "noise in mm", ("rigid", "e3d"), noise),
    "lengths": Part(
        "SfAM, figures 5b and 5c: bone lengths off by up to so many per cent", "per cent", ("rigid", "e3d"), lengths
    ),
    "variation": Part(
        "SfAM, figure 5d: bones' variation over time in per cent", "sequence", ("bone_cv", "rigid"), variation
    ),
}
