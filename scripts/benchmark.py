"""Measure a method on suites of the measuring protocol, which lies beside the repository in ``../shared``.

    python scripts/benchmark.py method=sfam suite=akhter
    python scripts/benchmark.py -m method=kcs,sfam suite=static_walk,orbit
    python scripts/benchmark.py method=sfam suite=akhter cameras=true +method.beta=0
    python scripts/benchmark.py suite=[real_openpose,real_mediapipe] intrinsics=true
    python scripts/benchmark.py paper.parts=all    # the tables of the two seed papers instead, see papers.py

Writes SUITE/CASE.npz (the prediction) and results.csv (a row a case) to the run's folder under ``outputs/``, and
prints the means of each suite. Inputs, truth and figures are the protocol's own. A case that fails is a row with its
error, and makes the exit code 1.
"""

from __future__ import annotations

import csv
import importlib.util
import sys
import tempfile
import time
import warnings
from collections.abc import Iterator
from fnmatch import fnmatch
from pathlib import Path
from types import ModuleType
from typing import Any

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
from kcs_torch.io.atomic import atomic_path
from kcs_torch.methods import METHODS
from kcs_torch.training.configured import check_switch, check_threads, in_one_line, method_of

MEASURED = ("suite", "case", "method", "options", "cameras", "intrinsics")
FACTS = (
    *(*MEASURED, "frames", "joints"),
    *("seconds", "cpu_seconds", "ms_per_frame", "converged"),
)
failed = 0  # cases of all jobs; Hydra hands no exit code through


def load_protocol(shared: Path) -> ModuleType:
    """Import protocol.py by its path."""
    path = shared / "protocol" / "protocol.py"
    if not path.is_file():
        raise SystemExit(
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
    names = list(known) if suites == "all" else [suites] if isinstance(suites, str) else list(suites)
    for name in names:
        if name not in known:
            raise SystemExit(f"suite={name}: expected all or some of {', '.join(known)}")
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
    cameras: bool,
    intrinsics: bool | str | None = None,
) -> dict[str, Any]:
    """Reconstruct one case, write the prediction, and return its figures and facts."""
    given, truth = protocol.build(data, case)
    tracks = load_input(given, protocol.case_name(case))
    known = true_cameras(protocol, data, case) if cameras else None
    lens = lens_of(protocol, data, case, intrinsics)
    start, begin = time.perf_counter(), time.process_time()
    result = kt.reconstruct(tracks, method=method, cameras=known, intrinsics=lens)
    seconds, cpu = time.perf_counter() - start, time.process_time() - begin
    prediction = {"points3d": result.observed.numpy(), "cameras": result.cameras.numpy()}
    target.parent.mkdir(parents=True, exist_ok=True)
    np.savez_compressed(target, **prediction)
    figures = protocol.score(
        prediction["points3d"], truth["points3d"], truth["edges"], prediction["cameras"], truth["world"]
    )
    return figures | {
        "cameras": "estimated" if known is None else "true",
        "intrinsics": "none" if lens is None else lens if isinstance(lens, str) else "true",
        "frames": tracks.num_frames,
        "joints": tracks.skeleton.num_observed,
        "seconds": round(seconds, 4),
        "cpu_seconds": round(cpu, 4),
        "ms_per_frame": round(1000 * seconds / tracks.num_frames, 4),
        "converged": result.diagnostics.converged,
    }


def table(rows: list[dict[str, Any]], figures: tuple[str, ...]) -> str:
    """The means of each suite, over the cases that did not fail."""
    names = [f for f in (*figures, "ms_per_frame") if any(f in row for row in rows)]
    lines = [f"{'suite':<16}{'method':<12}{'cases':>9}" + "".join(f"{n:>14}" for n in names)]
    for suite, method in dict.fromkeys((row["suite"], row["method"]) for row in rows):
        group = [row for row in rows if (row["suite"], row["method"]) == (suite, method)]
        good = [row for row in group if "error" not in row]
        line = f"{suite:<16}{method:<12}{len(good):>5}/{len(group):<3}"
        for name in names:
            values = [row[name] for row in good if name in row]
            line += f"{np.mean(values):>14.4f}" if values else f"{'-':>14}"
        lines.append(line)
    return "\n".join(lines)


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
        what = tuple(str(row[name]) for name in MEASURED)
        latest.pop(what, None)
        latest[what] = row
    with atomic_path(path) as temporary, temporary.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, columns)
        writer.writeheader()
        writer.writerows(latest.values())


def tabulate(folder: Path, columns: tuple[str, ...]) -> None:
    """Write the rows of all runs below a sweep's folder to one file.

    Every run does so at its end, and who writes looks again afterwards, so that nobody's rows are lost.
    """
    read: list[Path] = []
    while len(found := sorted(folder.glob("*/**/results.csv"), key=lambda path: path.stat().st_mtime_ns)) > len(read):
        read = found
        write_rows(folder / "results.csv", [row for path in read for row in read_rows(path)], columns)


def make_papers(paper: DictConfig, shared: Path, folder: Path) -> None:
    """Make the tables of the seed papers, and write them to a folder."""
    from papers import Settings, make
    from robustness import Bench

    options = OmegaConf.to_container(paper)
    assert isinstance(options, dict)
    names, frames, sequences = options.pop("parts"), options.pop("clip"), options.pop("sequences")
    methods = options.pop("methods")
    chosen = tuple(METHODS) if methods == "all" else tuple([methods] if isinstance(methods, str) else methods)
    if wrong := [name for name in chosen if name not in METHODS]:
        raise SystemExit(f"paper.methods={','.join(wrong)}: expected all or some of {', '.join(METHODS)}")
    make(names, Settings(Bench(shared, frames, sequences), chosen, **options), folder)


@hydra.main(version_base="1.3", config_path="../configs", config_name="benchmark")
def main(config: DictConfig) -> None:
    """Run every chosen case and write results.csv."""
    global failed
    with in_one_line():
        check_threads(config.threads)
        check_switch("cameras", config.cameras)
    torch.set_num_threads(config.threads)
    warnings.simplefilter("ignore", kt.KcsWarning)  # the column "converged" says it
    job = HydraConfig.get()
    folder = Path(job.runtime.output_dir)
    shared = Path(config.shared)
    if config.paper.parts:
        make_papers(config.paper, shared, folder)
        return
    protocol = load_protocol(shared)
    if config.intrinsics not in (None, False, True, "auto", "parallel"):
        raise SystemExit(f"intrinsics={config.intrinsics}: expected null, true, auto or parallel")
    with in_one_line():
        method = method_of(config.method)
    options = {k: v for k, v in OmegaConf.to_container(config.method).items() if k != "_target_"}
    name = job.runtime.choices.method
    text = " ".join(f"{k}={v}" for k, v in options.items())
    asked = {
        "cameras": "true" if config.cameras else "estimated",
        "intrinsics": {None: "none", False: "none", True: "true"}.get(config.intrinsics, config.intrinsics),
    }
    rows: list[dict[str, Any]] = []
    stopped = False
    suites = config.suite if isinstance(config.suite, str) else list(config.suite)
    for suite, case in chosen(protocol, suites, str(config.case)):
        label = protocol.case_name(case)
        row: dict[str, Any] = {"suite": suite, "case": label, "method": name, "options": text} | asked
        try:
            given = protocol, shared / "data", case, method, folder / suite / f"{label}.npz"
            row |= run_case(*given, config.cameras, config.intrinsics)
            shown = "  ".join(f"{f} {row[f]:.4f}" for f in protocol.FIGURES if f in row)
            print(f"{suite}/{label}  {shown}  {row['ms_per_frame']:.2f} ms a frame", flush=True)
        except KeyboardInterrupt:
            stopped = True
            break
        except (Exception, SystemExit) as error:  # the protocol leaves by SystemExit where a prediction is no good
            row["error"] = f"{type(error).__name__}: {error}"
            failed += 1
            print(f"{suite}/{label}  {row['error']}", flush=True)
        rows.append(row)
    if not rows and not stopped:
        raise SystemExit(f"case={config.case}: matches no case of suite={config.suite}")
    columns = (*FACTS, *protocol.FIGURES, "error")
    folder.mkdir(parents=True, exist_ok=True)
    own = folder / "results.csv"
    write_rows(own, read_rows(own) + rows, columns)
    if job.mode == RunMode.MULTIRUN:
        tabulate(Path(job.sweep.dir), columns)
    print(f"\n{table(rows, protocol.FIGURES)}\n{folder / 'results.csv'}")
    if stopped:
        raise SystemExit("stopped: these are the cases that were done")


if __name__ == "__main__":
    main()
    sys.exit(1 if failed else 0)
