"""What the runs of a sweep came to, in one table."""

from __future__ import annotations

import json
from contextlib import suppress
from pathlib import Path
from typing import Any

from hydra.experimental.callback import Callback
from omegaconf import DictConfig, OmegaConf

from kcs_torch.io.atomic import write_table
from kcs_torch.training.configured import changes, for_json

__all__ = ["Table", "tabulate"]

RESULT = "result.json"
"""What every run leaves in its folder."""

SETTINGS = "settings.json"
"""The file of the settings that gave a run's figures: Hydra's own are of whatever was called last."""

CALLED = Path(".hydra", "config.yaml")
"""The file of the settings of the last call, which Hydra writes before anything is looked at."""


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


def _number(path: Path) -> tuple[int, str]:
    """Runs in the order in which they were started: their folders are numbers."""
    name = path.parent.name
    return int(name) if name.isdecimal() else -1, str(path)


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
