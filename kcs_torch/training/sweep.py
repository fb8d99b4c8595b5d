"""The folders of a sweep's runs, and what the runs came to, in one table."""

from __future__ import annotations

import copy
import itertools
import json
from contextlib import suppress
from pathlib import Path
from typing import Any

from hydra.experimental.callback import Callback
from omegaconf import DictConfig, OmegaConf, open_dict, read_write

from kcs_torch.io.atomic import write_table
from kcs_torch.training.configured import changes, for_json

__all__ = ["Table", "ended", "run_folder", "tabulate"]

RESULT = "result.json"
"""What every run leaves in its folder."""

SETTINGS = "settings.json"
"""The file of the settings that gave a run's figures: Hydra's own are of whatever was called last."""

CALLED = Path(".hydra", "config.yaml")
"""The file of the settings of the last call, which Hydra writes before anything is looked at."""


def ended(config: DictConfig, folder: Path) -> dict[str, float | None] | None:
    """The figures of a run of the same settings that ended in this folder before; None where there is none."""
    with suppress(Exception):  # whatever is wrong with its files, it did not end
        result, then = (json.loads((folder / name).read_text(encoding="utf-8")) for name in (RESULT, SETTINGS))
        if not changes(then, for_json(OmegaConf.to_container(config, resolve=True))):
            return dict(result)
    return None


def run_folder(number: int, *, _root_: DictConfig) -> str:
    """The name of a run's folder in that of its sweep: its number.

    With ``keep=true`` it is the folder in which a run of the same settings ended before, whatever its number was. If
    there is none, and another run ended in that of this number, it is NUMBER_1, NUMBER_2 or so: no other run of the
    sweep takes it, though all may start at once.
    """
    if _root_.get("keep") is not True:
        return str(number)
    config, sweep = copy.deepcopy(_root_), Path(_root_.hydra.sweep.dir)
    with read_write(config), open_dict(config):
        del config["hydra"]
    for path in sorted(sweep.glob(f"*/{RESULT}"), key=_number):
        if ended(config, path.parent) is not None:
            return path.parent.name
    names = itertools.chain([str(number)], (f"{number}_{k}" for k in itertools.count(1)))
    return next(name for name in names if not (sweep / name / RESULT).exists())


OmegaConf.register_new_resolver("kcs_torch.run_folder", run_folder, replace=True)  # of configs/train.yaml


def tabulate(folder: Path) -> list[dict[str, Any]]:
    """Write results.csv, a row for every run below a sweep's folder that has ended, and return the rows.

    Figures of a run whose folder has since been called with other settings, and that has not ended with them, are
    left out: Hydra keeps the settings of the last call only.

    Every run calls this at its end, in whatever process or machine it is, so that the table is there although a
    later run fails: who writes looks again afterwards, and so nobody's result is lost.
    """
    rows: list[dict[str, Any]] = []
    seen = 0
    while len(found := sorted(folder.glob(f"**/{RESULT}"), key=_number)) > seen:
        seen = len(found)
        rows = [_row(folder, path) for path in found if _of_last_call(path.parent)]
        write_table(folder / "results.csv", rows)
    return rows


def _of_last_call(run: Path) -> bool:
    """Whether the figures in a run's folder are of the settings that it was called with last."""
    with suppress(Exception):  # whatever one of the files lacks, nothing speaks against the figures
        then = json.loads((run / SETTINGS).read_text(encoding="utf-8"))
        return not changes(then, for_json(OmegaConf.to_container(OmegaConf.load(run / CALLED), resolve=True)))
    return True


def _number(path: Path) -> tuple[list[int], str]:
    """Runs in the order in which they were started: their folders are numbers."""
    number, _, other = path.parent.name.partition("_")
    return [int(part) if part.isdecimal() else -1 for part in (number, other)], str(path)


def _row(folder: Path, path: Path) -> dict[str, Any]:
    given = path.parent / ".hydra" / "overrides.yaml"
    overrides = [str(o).lstrip("+~").partition("=") for o in OmegaConf.load(given)] if given.is_file() else []
    row: dict[str, Any] = {"run": path.parent.relative_to(folder).as_posix()}
    row |= {name: value for name, _, value in overrides}
    return row | json.loads(path.read_text(encoding="utf-8"))


class Table(Callback):
    """Print the table when the sweep has ended."""

    def on_multirun_end(self, config: DictConfig, **kwargs: Any) -> None:
        """Print what differs between the runs, and the figures."""
        folder = Path(config.hydra.sweep.dir)
        rows = tabulate(folder)
        names = list(dict.fromkeys(name for row in rows for name in row))
        shown = [n for n in names if len(rows) == 1 or len({str(row.get(n)) for row in rows}) > 1]
        cells = [shown, *([_cell(row.get(n)) for n in shown] for row in rows)]
        widths = [max(map(len, column)) for column in zip(*cells, strict=True)]
        for line in cells:
            print("  ".join(f"{cell:>{width}}" for cell, width in zip(line, widths, strict=True)))
        print(folder / "results.csv")


def _cell(value: Any) -> str:
    return f"{value:.4g}" if isinstance(value, float) else "" if value is None else str(value)
