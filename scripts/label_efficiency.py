"""What few labels and many windows without any are worth: the table of a sweep, beside methods without training.

    python scripts/train.py -m experiment=labels,hybrid data.labelled=0.01,0.05,0.25,1 seed=0,1,2
    python scripts/train.py -m experiment=two_d_only seed=0,1,2
    python scripts/label_efficiency.py outputs/train/FIRST outputs/train/SECOND methods=[pkc,kcs,sfam]

Reads results.csv of the sweeps, and prints a Markdown table: mean and standard deviation over the seeds of the test
error, for each share of labels, a row for each experiment and whatever else was swept. The methods that need no
training lift the same test clips, of the same seeds, and are scored on the same windows; so is the flat guess, which is
the tracks with depth 0. Where the runs were tested on different data (noise, say), there is a table for each.

    metric=pa_mpjpe     the figure
    methods=[]          training-free methods beside the networks
    experiment=NAME     whose test data they lift; the first of the sweeps if not given
    shared=../shared    folder of motion files
    cache=FOLDER        where reconstructions are kept from run to run
"""

from __future__ import annotations

import csv
import math
import sys
import warnings
from collections import defaultdict
from pathlib import Path

import torch
from hydra import compose, initialize_config_dir
from hydra.utils import instantiate

import kcs_torch as kt
from kcs_torch.metrics import MPJPE
from kcs_torch.training.module import ALIGNED
from kcs_torch.training.pseudo import pseudo_labels

CONFIGS = Path(__file__).resolve().parents[1] / "configs"
SHOWN = ("run", "experiment", "data.labelled", "seed", "keep")
FILMED = "folder test up units file_units fps window views pitch noise occlusion clips"
TESTED = ("data", "skeleton", *(f"data.{name}" for name in FILMED.split()))
"""Settings that change what a network is tested on."""

OPTIONS = {"metric": "pa_mpjpe", "methods": "[]", "experiment": "", "shared": "../shared", "cache": ""}


def runs_of(folders: list[Path], metric: str) -> dict[str, dict[str, dict[int, float]]]:
    """Figures by experiment and what else was swept, share of labels and seed."""
    found: dict[str, dict[str, dict[int, float]]] = defaultdict(lambda: defaultdict(dict))
    for folder in folders:
        table = folder / "results.csv"
        if not table.is_file():
            raise SystemExit(f"{folder}: expected the folder of a sweep with results.csv, found none")
        with table.open(newline="", encoding="utf-8") as file:
            for row in csv.DictReader(file):
                figure = row.get(f"test/{metric}")
                if figure == "":
                    raise SystemExit(
                        f"{table}: run {row.get('run')} has no test/{metric}: it diverged, or was not tested; make it "
                        "anew, or remove its line"
                    )
                if figure is None:
                    names = ", ".join(name.removeprefix("test/") for name in row if name.startswith("test/"))
                    raise SystemExit(f"metric={metric}: expected one of {names}")
                experiment, seed = row.get("experiment") or "-", int(row.get("seed") or 0)
                share = row.get("data.labelled") or ("0" if experiment == "two_d_only" else "1")
                swept = [f"{n}={v}" for n, v in row.items() if v and "/" not in n.split(".")[0] and n not in SHOWN]
                one = found[" ".join([experiment, *swept])][share]
                if seed in one:
                    raise SystemExit(f"{table}: expected one run of {experiment} with seed {seed} and these settings")
                one[seed] = float(figure)
    return found


def tested_on(folders: list[Path]) -> list[tuple[str, ...]]:
    """What the runs set of their test data: one where all of them were tested on the same."""
    found = []
    for folder in folders:
        with (folder / "results.csv").open(newline="", encoding="utf-8") as file:
            found += [tuple(f"{n}={row[n]}" for n in TESTED if row.get(n)) for row in csv.DictReader(file)]
    return list(dict.fromkeys(found))


def untrained(
    method: str, seed: int, experiment: str, shared: str, cache: str, metric: str, settings: tuple[str, ...] = ()
) -> float:
    """The test error of a training-free method, or of the flat guess, on the windows that networks are tested on."""
    own = [f"++{s}" if s.startswith("data.") else s for s in settings]
    with initialize_config_dir(version_base="1.3", config_dir=str(CONFIGS)):
        config = compose("train", overrides=[f"experiment={experiment}", f"seed={seed}", f"shared={shared}", *own])
    data = instantiate(config.data, _convert_="all")
    data.setup("test")
    windows = data.sets["test"]
    if method != "flat":
        pairs = torch.cartesian_prod(torch.arange(len(windows.clips)), torch.arange(data.views))
        windows.pseudo_points, windows.pseudo_weights = pseudo_labels(
            windows, pairs, kt.METHODS[method](), fps=data.fps, units=data.units, trust=1.0, cache=cache or None
        )
    figure = MPJPE(align=ALIGNED[metric])
    for items in torch.arange(len(windows)).split(256):
        truth = windows.batch(items, torch.ones_like(items, dtype=torch.bool))
        points = torch.nn.functional.pad(truth.tracks, (0, 1))
        if method != "flat":
            points = windows.batch(items, torch.zeros_like(items, dtype=torch.bool)).points
        figure.update(points, truth.points)
    return float(figure.compute())


def cell(values: list[float]) -> str:
    """Mean and spread."""
    mean = sum(values) / len(values)
    if len(values) < 2:
        return f"{mean:.1f}"
    return f"{mean:.1f} ± {math.sqrt(sum((v - mean) ** 2 for v in values) / (len(values) - 1)):.1f}"


def main(arguments: list[str]) -> None:
    options = dict(OPTIONS)
    folders = []
    for argument in arguments:
        name, sign, value = argument.partition("=")
        if not sign:
            folders.append(Path(argument))
        elif name in OPTIONS:
            options[name] = value
        else:
            raise SystemExit(f"{name}: expected one of {', '.join(OPTIONS)}, or folders of sweeps")
    if not folders or {"-h", "--help"} & set(arguments):
        print(__doc__)
        raise SystemExit(0 if folders else 2)
    if options["metric"] not in ALIGNED:
        raise SystemExit(f"metric={options['metric']}: expected one of {', '.join(ALIGNED)}")
    methods = [name.strip() for name in options["methods"].strip("[]").split(",") if name.strip()]
    for name in methods:
        if name not in kt.METHODS:
            raise SystemExit(f"methods: expected some of {', '.join(kt.METHODS)}, got {name}")
    found = runs_of(folders, options["metric"])
    if not found:
        raise SystemExit(f"{', '.join(map(str, folders))}: expected runs in results.csv, found none")
    experiment = options["experiment"] or next(iter(found)).split()[0]
    shares = sorted({share for one in found.values() for share in one}, key=float)
    seeds = sorted({seed for one in found.values() for row in one.values() for seed in row})
    print(f"test/{options['metric']}, mm, mean ± standard deviation over seeds {', '.join(map(str, seeds))}\n")
    print(f"| share of frames with labels | {' | '.join(f'{100 * float(s):g} %' for s in shares)} |")
    print("|---|" + "---|" * len(shares))
    for name, row in found.items():
        print(f"| {name} | {' | '.join(cell(list(row[s].values())) if s in row else '' for s in shares)} |")
    torch.set_num_threads(1)
    warnings.simplefilter("ignore", kt.KcsWarning)
    given = (options["shared"], options["cache"], options["metric"])
    for settings in tested_on(folders):
        print(f"\n| {', '.join(['without training', *settings])} | |\n|---|---|")
        for name in ["flat", *methods]:
            each = [untrained(name, seed, experiment, *given, settings) for seed in seeds]
            print(f"| {name} | {cell(each)} |", flush=True)


if __name__ == "__main__":
    main(sys.argv[1:])
