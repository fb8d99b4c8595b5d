"""Measure a method on suites of the measuring protocol, which lies beside the repository in ``../shared``.

    python scripts/benchmark.py method=sfam suite=akhter
    python scripts/benchmark.py -m method=kcs,sfam suite=static_walk,orbit
    python scripts/benchmark.py method=sfam suite=akhter cameras=true method.beta=0
    python scripts/benchmark.py suite=[real_openpose,real_mediapipe] intrinsics=true
    python scripts/benchmark.py paper.parts=all    # the tables of the two seed papers instead, see papers.py

Writes SUITE/CASE.npz (the prediction) and results.csv (a row a case) to the run's folder under ``outputs/``, and
prints the means of each suite; "covered" is the share of depths that are off by no more than the standard deviation
that the method gives, after one scale for a clip. A sweep has one results.csv more, of all its runs. Each row is
written when its case is done: with keep=true a sweep that was stopped, or is extended, goes on in its folder. Inputs,
truth and figures are the protocol's own. A case that fails is a row with its error, and makes the exit code 1; it is 2
where the call is wrong.
"""

from __future__ import annotations

import csv
import importlib.util
import itertools
import re
import sys
import tempfile
import time
import warnings
from collections.abc import Iterator, Sequence
from fnmatch import fnmatch
from pathlib import Path
from types import ModuleType
from typing import Any, Literal

try:
    import hydra
    from hydra.core.hydra_config import HydraConfig
    from hydra.types import RunMode
    from omegaconf import DictConfig, OmegaConf
except ModuleNotFoundError as error:
    raise SystemExit(f"error: {error.name} is missing: pip install hydra-core") from None
import numpy as np
import torch

import kcs_torch as kt
from kcs_torch.errors import OptionError, counted, unknown
from kcs_torch.io.atomic import atomic_path, write_table
from kcs_torch.methods import METHODS
from kcs_torch.metrics import coverage
from kcs_torch.training.configured import (
    PartFailed,
    check_switch,
    check_threads,
    check_whole,
    command_line,
    in_one_line,
    method_of,
)
from kcs_torch.types.hints import is_a

MEASURED = ("suite", "case", "method", "options", "cameras", "intrinsics")
FACTS = (
    *(*MEASURED, "frames", "joints"),
    *("seconds", "cpu_seconds", "ms_per_frame", "converged", "covered"),
)
CASES = ("method", "suite", "case", "cameras", "intrinsics", "keep")
"""What the papers' tables do not read."""

COUNTS = {"clip": 10, "sequences": 1, "paths": 1, "seeds": 1, "walks": 1, "frames": 100}
"""Numbers among the settings of the papers' tables, and the least that each may be."""

failed = 0  # cases of all jobs run in this process; Hydra hands no exit code through


def load_protocol(shared: Path) -> ModuleType:
    """Import protocol.py by its path."""
    path = shared / "protocol" / "protocol.py"
    if not path.is_file():
        raise OptionError(
            f"shared={shared}: expected a folder with protocol/protocol.py and data/, found none: "
            "the sequences are not part of the project"
        )
    spec = importlib.util.spec_from_file_location("protocol", path)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def chosen(protocol: ModuleType, suites: str | list[str], pattern: str) -> Iterator[tuple[str, dict[str, Any]]]:
    """Yield the (suite, case) pairs to run."""
    known = protocol.suites()
    names = list(known) if suites == "all" else [suites] if isinstance(suites, str) else list(dict.fromkeys(suites))
    for name in names:
        if name not in known:
            raise OptionError(f"suite={name}: expected all or some of {', '.join(known)}")
    for name in names:
        for case in known[name]:
            if fnmatch(protocol.case_name(case), pattern):
                yield name, case


def load_input(given: dict[str, Any], name: str) -> kt.Tracks:
    """Read a case's input as a user's file is read."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"{name}.npz"
        np.savez(path, **given)
        return kt.load_tracks(path)


def true_cameras(protocol: ModuleType, data: Path, case: dict[str, Any]) -> torch.Tensor | None:
    """The first two rows of each frame's rotation (T, 2, 3), where the data has them."""
    source = protocol.load(data, case["src"])
    return torch.from_numpy(source["R"].astype(float)) if "R" in source.files else None


def lens_of(protocol: ModuleType, data: Path, case: dict[str, Any], wanted: bool | str | None) -> Any:
    """What is given as intrinsics: None, a word, or K (3, 3) of the case's camera, where the data has it."""
    if not wanted or isinstance(wanted, str):
        return wanted or None
    source = protocol.load(data, case["src"])
    return source["cam_K"][case["camera"]] if "camera" in case and "cam_K" in source.files else None


def run_case(
    protocol: ModuleType,
    data: Path,
    case: dict[str, Any],
    method: kt.Method,
    target: Path,
    cameras: torch.Tensor | None = None,
    intrinsics: Any = None,
) -> dict[str, Any]:
    """Reconstruct one case, write the prediction, and return its figures and facts."""
    given, truth = protocol.build(data, case)
    tracks = load_input(given, protocol.case_name(case))
    start, begin = time.perf_counter(), time.process_time()
    result = kt.reconstruct(tracks, method=method, cameras=cameras, intrinsics=intrinsics)
    seconds, cpu = time.perf_counter() - start, time.process_time() - begin
    prediction = {"points3d": result.observed.numpy(), "cameras": result.cameras.numpy()}
    with atomic_path(target) as temporary:
        np.savez_compressed(temporary, **prediction)
    facts = {
        "frames": tracks.num_frames,
        "joints": tracks.skeleton.num_observed,
        "seconds": round(seconds, 4),
        "cpu_seconds": round(cpu, 4),
        "ms_per_frame": round(1000 * seconds / tracks.num_frames, 4),
        "converged": result.diagnostics.converged,
    }
    if result.uncertainty is not None:
        facts["covered"] = covered(result, torch.as_tensor(truth["points3d"]))
    figures = protocol.score(
        prediction["points3d"], truth["points3d"], truth["edges"], prediction["cameras"], truth["world"]
    )
    return figures | facts


def covered(result: kt.Reconstruction, truth: torch.Tensor) -> float:
    """Share of depths within one standard deviation, after one scale: the size of a detector's tracks is not known."""
    known = truth.isfinite().all(-1)
    deviation = result.uncertainty[:, : result.skeleton.num_observed]
    return round(float(coverage(result.observed, deviation, truth, scale=True, weights=known.to(truth))), 4)


def table(rows: list[dict[str, Any]], figures: tuple[str, ...]) -> str:
    """The means of each suite and recipe, over the cases that did not fail."""
    names = [f for f in (*figures, "covered", "ms_per_frame") if any(has(row, f) for row in rows)]
    kinds = dict.fromkeys((row["suite"], recipe(row)) for row in rows)
    width = max(12, *(len(kind) + 2 for _, kind in kinds))
    lines = [f"{'suite':<16}{'method':<{width}}{'cases':>9}" + "".join(f"{n:>14}" for n in names)]
    for suite, kind in kinds:
        group = [row for row in rows if (row["suite"], recipe(row)) == (suite, kind)]
        good = [row for row in group if not row.get("error")]
        line = f"{suite:<16}{kind:<{width}}{len(good):>5}/{len(group):<3}"
        for name in names:
            values = [float(row[name]) for row in good if has(row, name)]
            line += f"{np.mean(values):>14.4f}" if values else f"{'-':>14}"
        lines.append(line)
    return "\n".join(lines)


def has(row: dict[str, Any], name: str) -> bool:
    """Whether a row has a figure: 0 is one, but an empty cell is none."""
    return row.get(name) not in (None, "")


def recipe(row: dict[str, Any]) -> str:
    """The method of a row, its fields, and what it was given."""
    given = [f"{name}={row[name]}" for name in ("cameras", "intrinsics") if row[name] not in ("estimated", "none")]
    return " ".join(filter(None, [row["method"], row["options"], *given]))


def read_rows(path: Path) -> list[dict[str, Any]]:
    """The rows of a CSV file; none where there is no file."""
    if not path.is_file():
        return []
    with path.open(newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


def write_rows(path: Path, rows: list[dict[str, Any]], columns: tuple[str, ...]) -> None:
    """Write rows to a CSV file, whole or not at all; of those that measured the same only the last."""
    latest: dict[tuple[str, ...], dict[str, Any]] = {}
    for row in rows:
        latest.pop(measured(row), None)
        latest[measured(row)] = row
    write_table(path, latest.values(), columns)


def measured(row: dict[str, Any]) -> tuple[str, ...]:
    """What a row is of, as text, as it is in a file."""
    return tuple(str(row[name]) for name in MEASURED)


def predicted(folder: Path) -> dict[tuple[str, str], dict[str, Any]]:
    """The row of each (suite, case) of which there is a prediction beside a results.csv: what was measured last."""
    rows = [row for row in read_rows(folder / "results.csv") if {*MEASURED, "error"} <= row.keys()]  # not another's
    last = {(row["suite"], row["case"]): row for row in rows if not row["error"]}
    return {(suite, case): row for (suite, case), row in last.items() if (folder / suite / f"{case}.npz").is_file()}


def done_rows(folder: Path) -> dict[tuple[str, ...], dict[str, Any]]:
    """The rows below the folder of a sweep, or a run, that need not be measured again, whatever their run's number."""
    found = (predicted(path.parent) for path in sorted(folder.glob("**/results.csv")))
    return {measured(row): row for rows in found for row in rows.values()}


def free_place(folder: Path, row: dict[str, Any]) -> Path:
    """Where a row and its prediction replace none of other settings: a run's folder, or FOLDER/1, FOLDER/2, ..."""
    case = (row["suite"], row["case"])
    places = itertools.chain([folder], (folder / str(k) for k in itertools.count(1)))
    return next(place for place in places if measured(predicted(place).get(case, row)) == measured(row))


def tabulate(folder: Path, columns: tuple[str, ...]) -> list[dict[str, Any]]:
    """Write the rows of all runs below a sweep's folder to one file, and return what is in it.

    Every run does so at its end, and who writes looks again afterwards, so that nobody's rows are lost.
    """
    read: list[Path] = []
    while len(found := sorted(folder.glob("*/**/results.csv"), key=lambda path: path.stat().st_mtime_ns)) > len(read):
        read = found
        write_rows(folder / "results.csv", [row for path in read for row in read_rows(path)], columns)
    return read_rows(folder / "results.csv")


def make_papers(paper: DictConfig, shared: Path, folder: Path) -> None:
    """Make the tables of the seed papers, and write them to a folder."""
    from papers import Settings, make
    from robustness import Bench

    options = OmegaConf.to_container(paper)
    assert isinstance(options, dict)
    for name, value in options.items():
        if name not in (*COUNTS, "parts", "methods"):
            raise unknown("setting of paper", name, (*COUNTS, "parts", "methods"))
        if name in COUNTS:
            check_whole(f"paper.{name}", value, COUNTS[name], 1_000_000)
        elif not is_a(value, str | Sequence[str]):
            raise OptionError(f"paper.{name}: expected all, a name or a list of names, got {value!r}")
    names, frames, sequences = options.pop("parts"), options.pop("clip"), options.pop("sequences")
    methods = options.pop("methods")
    chosen = tuple(METHODS) if methods == "all" else tuple([methods] if isinstance(methods, str) else methods)
    if wrong := [name for name in chosen if name not in METHODS]:
        raise OptionError(f"paper.methods={','.join(wrong)}: expected all or some of {', '.join(METHODS)}")
    try:
        make(names, Settings(Bench(shared, frames, sequences), chosen, **options), folder)
    except KeyboardInterrupt:
        raise SystemExit(f"stopped: tables of the parts that were done are in {folder}") from None


@hydra.main(version_base="1.3", config_path="../configs", config_name="benchmark")
def main(config: DictConfig) -> None:
    """Run every chosen case and write results.csv."""
    warnings.simplefilter("ignore", kt.KcsWarning)  # the column "converged" says it
    job = HydraConfig.get()
    folder = Path(job.runtime.output_dir)
    with in_one_line():
        check_threads(config.threads)
        check_switch("cameras", config.cameras)
        check_switch("keep", config.keep)
        suites = OmegaConf.to_container(config, resolve=True)["suite"]
        if not is_a(suites, str | Sequence[str]) or not suites:
            raise OptionError(f"suite: expected all, a suite or a list of suites, got {suites!r}")
        if not is_a(config.intrinsics, bool | Literal["auto", "parallel"] | None):
            raise OptionError(f"intrinsics={config.intrinsics}: expected null, true, auto or parallel")
        torch.set_num_threads(config.threads)
        if not isinstance(config.paper, DictConfig):
            raise OptionError(f"paper: expected its settings, such as paper.parts=all, got {config.paper!r}")
        if config.paper.parts:
            given = [re.sub(r"[+~]*(\w*).*", r"\1", one) for one in job.overrides.task]
            if unread := [name for name in CASES if name in given]:
                raise OptionError(f"{unread[0]}: the papers' tables do not read it: leave it out, or paper.parts")
            make_papers(config.paper, Path(str(config.shared)), folder)
        else:
            measure(config, suites, method_of(config.method), folder)


def measure(config: DictConfig, suites: str | list[str], method: kt.Method, folder: Path) -> None:
    """Run cases, write each row when it is there, and print the means; of a sweep, those of all its runs so far."""
    global failed
    job, shared = HydraConfig.get(), Path(str(config.shared))
    protocol = load_protocol(shared)
    data, columns = shared / "data", (*FACTS, *protocol.FIGURES, "error")
    options = OmegaConf.to_container(config.method, resolve=True)
    text = " ".join(f"{name}={value}" for name, value in options.items() if name != "_target_")
    name = job.runtime.choices.method
    if name in METHODS and type(method) is not METHODS[name]:  # another one was put in its place
        name = method.name or type(method).__name__
    multirun = job.mode == RunMode.MULTIRUN
    kept = done_rows(Path(job.sweep.dir) if multirun else folder) if config.keep else {}
    rows: list[dict[str, Any]] = []
    stopped = False
    wrong = 0
    try:
        for suite, case in chosen(protocol, suites, str(config.case)):
            label, place = protocol.case_name(case), folder
            row: dict[str, Any] = {"suite": suite, "case": label, "method": name, "options": text}
            row |= {"cameras": "estimated", "intrinsics": "none"}
            try:
                cameras = true_cameras(protocol, data, case) if config.cameras else None
                lens = lens_of(protocol, data, case, config.intrinsics)
                row["cameras"] = "estimated" if cameras is None else "true"
                row["intrinsics"] = "none" if lens is None else lens if isinstance(lens, str) else "true"
                if measured(row) in kept:
                    rows.append(kept[measured(row)])
                    print(f"{suite}/{label}  was done, and is kept", flush=True)
                    continue
                place = free_place(folder, row) if config.keep else folder
                row |= run_case(protocol, data, case, method, place / suite / f"{label}.npz", cameras, lens)
                shown = "  ".join(f"{f} {row[f]:.4f}" for f in (*protocol.FIGURES, "covered") if f in row)
                print(f"{suite}/{label}  {shown}  {row['ms_per_frame']:.2f} ms a frame", flush=True)
            except (Exception, SystemExit) as error:  # the protocol leaves by SystemExit where a prediction is no good
                row["error"] = f"{type(error).__name__}: {error}"
                wrong += 1
                print(f"{suite}/{label}  {row['error']}", flush=True)
            rows.append(row)
            write_rows(place / "results.csv", [*read_rows(place / "results.csv"), row], columns)
    except KeyboardInterrupt:
        stopped = True
    if not rows and not stopped:
        raise OptionError(f"case={config.case}: matches no case of suite={config.suite}")
    failed += wrong
    shown = tabulate(Path(job.sweep.dir), columns) if multirun else rows
    if shown:
        print(f"\n{table(shown, protocol.FIGURES)}\n{(Path(job.sweep.dir) if multirun else place) / 'results.csv'}")
    if stopped:
        raise SystemExit("stopped: these are the cases that were done; keep=true goes on in the same folder")
    if wrong and multirun:
        raise PartFailed(f"{counted(wrong, 'case')} failed")  # of another process only an error is heard


if __name__ == "__main__":
    with command_line("benchmark"):
        try:
            main()
        except KeyboardInterrupt:  # while others work
            print("stopped: what was done is in the runs' folders; keep=true goes on with suites", file=sys.stderr)
            raise
    sys.exit(1 if failed else 0)
