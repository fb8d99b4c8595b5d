"""What is kept of a run as it goes on, its best and last epoch, and what ends it."""

from __future__ import annotations

import csv
import shutil
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import lightning
import torch
from lightning.pytorch.callbacks import Callback, ModelCheckpoint
from lightning.pytorch.loggers import CSVLogger, TensorBoardLogger
from lightning.pytorch.loggers.csv_logs import ExperimentWriter
from lightning.pytorch.loggers.logger import rank_zero_experiment

from kcs_torch.errors import OptionError, unknown
from kcs_torch.io.atomic import atomic_path

__all__ = ["Best", "Board", "Diverged", "Last", "Log", "Watch"]


class Log(CSVLogger):
    """The figures of all steps and epochs, as a table. It replaces an earlier run's once it has a figure to write.

    Args:
        folder: of the run; the table is its ``csv/metrics.csv``.
        goes_on: the last epoch of an earlier run in this folder that this one goes on from, whose figures are kept up
            to there; None where it replaces them.
    """

    def __init__(self, folder: Path, goes_on: int | None = None) -> None:
        super().__init__(folder, "csv", "")
        self.goes_on = goes_on

    @property
    @rank_zero_experiment
    def experiment(self) -> Any:
        """What writes the table; Lightning asks for it before anything is trained."""
        if self._experiment is None:
            self._experiment = _Table(self.log_dir, self.goes_on)
        return self._experiment


class _Table(ExperimentWriter):
    """Lightning's writer, but that it touches no file before there is a figure."""

    def __init__(self, log_dir: str, goes_on: int | None) -> None:
        self.goes_on, self.begun = goes_on, False
        super().__init__(log_dir)

    def _check_log_dir_exists(self) -> None:
        """Nothing: Lightning removes here what it finds."""

    def log_hparams(self, params: dict[str, Any]) -> None:
        """Nothing: they are in the files of the settings."""

    def log_metrics(self, *args: Any, **kwargs: Any) -> None:
        if not self.begun:
            path, self.begun = Path(self.metrics_file_path), True
            self.metrics = [] if self.goes_on is None else _rows_until(path, self.goes_on)
            path.unlink(missing_ok=True)
        super().log_metrics(*args, **kwargs)

    def save(self) -> None:
        if self.metrics:  # else it would write a file of hyperparameters
            super().save()


class Board(TensorBoardLogger):
    """TensorBoard's log of a run, in its ``tensorboard``, which touches no file before there is a figure."""

    def __init__(self, folder: Path) -> None:
        super().__init__(folder, "tensorboard", "")

    @property
    def experiment(self) -> Any:
        """What writes the log; Lightning asks for it before anything is checked."""
        return super().experiment if self._experiment is not None else _Later(lambda: super(Board, self).experiment)

    def save(self) -> None:
        if self._experiment is not None:
            super().save()


class _Later:
    """Stands for a thing that is made as soon as something of it is used."""

    def __init__(self, make: Callable[[], Any]) -> None:
        self._make = make

    def __getattr__(self, name: str) -> Any:
        return getattr(self._make(), name)


def _rows_until(path: Path, epoch: int) -> list[dict[str, Any]]:
    """The figures of the epochs up to this one, without those of the test, which is made at the end."""
    rows: list[dict[str, str]] = []
    with suppress(OSError, UnicodeError, csv.Error), path.open(newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    out = []
    for row in rows:
        figures = {name: figure for name, figure in row.items() if name and figure}
        of_test = any(name.startswith("test/") for name in figures)
        if not of_test and figures.get("epoch", "").isdecimal() and int(figures["epoch"]) <= epoch:
            out.append(figures)
    return out


class Best(ModelCheckpoint):
    """The checkpoint of the best epoch. A resumed run takes over the best one so far into its own folder."""

    def __init__(self, folder: Path, monitor: str, mode: str, resumed: Path | None) -> None:
        super().__init__(folder, "best", monitor, mode=mode, enable_version_counter=False)
        self.resumed = resumed

    def on_validation_end(self, trainer: lightning.Trainer, pl_module: lightning.LightningModule) -> None:
        """Look for the metric, before the first epoch is spent."""
        if self.monitor not in trainer.callback_metrics:
            known = [name for name in trainer.callback_metrics if name.startswith("val/")]
            raise unknown("metric for optimise", self.monitor, known)
        super().on_validation_end(trainer, pl_module)

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Take over what was best, from where it was or from beside the checkpoint, should the folder have moved."""
        old = Path(state_dict["best_model_path"])
        if state_dict["best_model_path"]:
            moved = Path(self.resumed or "").parent / old.name
            new = Path(str(self.dirpath)) / old.name
            found = old if old.is_file() else moved
            if not found.is_file():
                raise OptionError(
                    f"resume={self.resumed}: expected its best checkpoint {old} or {moved}, found neither"
                )
            with atomic_path(new) as temporary:
                shutil.copyfile(found, temporary)
            score = state_dict["best_model_score"]
            state_dict = state_dict | {
                "best_model_path": str(new), "kth_best_model_path": str(new), "best_k_models": {str(new): score}
            }  # fmt: skip
        super().load_state_dict(state_dict | {"dirpath": self.dirpath})


class Last(ModelCheckpoint):
    """The checkpoint of the last epoch, which knows of no other."""

    def __init__(self, folder: Path) -> None:
        super().__init__(folder, "last", enable_version_counter=False, save_on_train_epoch_end=True)

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Begin anew, in another folder."""


class Diverged(Exception):
    """Weights are not numbers any more."""


class Watch(Callback):
    """Keeps the configuration in every checkpoint, and ends training that came to nothing.

    Args:
        config: the configuration.
        result: the file of the figures, which an earlier run may have left: it goes once training begins, and not
            before all that can be told beforehand was found in order.
    """

    def __init__(self, config: dict[str, Any], result: Path) -> None:
        self.config, self.result = config, result

    def on_train_start(self, trainer: Any, pl_module: Any) -> None:
        """Remove the figures of an earlier run."""
        self.result.unlink(missing_ok=True)

    def on_fit_start(self, trainer: Any, pl_module: Any) -> None:
        """Make sure, before the first epoch is spent, that there will be a validation to choose the best one by.

        Raises:
            OptionError: there will be none.
        """
        every, last = trainer.check_val_every_n_epoch, trainer.max_epochs
        reasons = {
            "trainer.limit_train_batches is 0": trainer.limit_train_batches == 0,
            "trainer.limit_val_batches is 0": trainer.limit_val_batches == 0,
            f"trainer.check_val_every_n_epoch={every}, trainer.max_epochs={last}": every and 0 <= last < every,
            "data.val is empty": trainer.datamodule.val_dataloader() == [],
        }
        if trainer.ckpt_path is None and (found := [reason for reason, holds in reasons.items() if holds]):
            raise OptionError(f"train: expected at least one epoch with validation, got none: {found[0]}")

    def on_save_checkpoint(self, trainer: Any, pl_module: Any, checkpoint: dict[str, Any]) -> None:
        """Add the configuration."""
        checkpoint["config"] = self.config

    def on_validation_start(self, trainer: Any, pl_module: lightning.LightningModule) -> None:
        """Look at the weights."""
        if not all(bool(torch.isfinite(p).all()) for p in pl_module.parameters()):
            raise Diverged
