"""Training as Hydra configures it: what ``scripts/train.py`` and ``kcs-torch train`` run."""

from __future__ import annotations

import json
import logging
import math
import re
import signal
import sys
import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import hydra
import lightning
import torch
from hydra.core.hydra_config import HydraConfig
from hydra.types import RunMode
from hydra.utils import instantiate
from lightning.pytorch.utilities.exceptions import MisconfigurationException, SIGTERMException
from omegaconf import DictConfig, OmegaConf

from kcs_torch.errors import KcsWarning, NotFiniteError, OptionError, unknown, warnings_told
from kcs_torch.io.atomic import atomic_path
from kcs_torch.training.callbacks import Best, Board, Diverged, Last, Log, Watch
from kcs_torch.training.checkpoint import describe, save_lifter
from kcs_torch.training.configured import (
    changes,
    check_switch,
    check_threads,
    check_values,
    check_whole,
    command_line,
    configs,
    for_json,
    in_one_line,
)
from kcs_torch.training.sweep import RESULT, SETTINGS, ended, tabulate

__all__ = ["Outcome", "configs", "job", "main", "train"]

LIFTER = "lifter.safetensors"
"""The file of a run's network."""

GROUPS = {"network": "model", "losses": "loss", "refine": "solver"}
"""The groups that fields of the module are, as a rule."""

QUIET = (
    r".*does not have many workers.*",  # batches are made faster than they are used
    r".*number of training batches .* is smaller than the logging interval.*",
    r".*`isinstance\(treespec, LeafSpec\)` is deprecated.*",
    r".*Checkpoint directory .* exists and is not empty.*",
    r".*could not find the monitored key.*",  # there was no validation, which is told in other words
)
"""Beginnings of warnings of packages that say nothing to whoever trains."""


@dataclass(frozen=True)
class Outcome:
    """What a training run came to.

    Attributes:
        value: what a sweep optimises: the metric named by ``optimise``, at the epoch where it was best. Infinite,
            and worse than any other, where it never was a number.
        metrics: the figures of the test clips, by the weights of that epoch.
        lifter: the file of these weights, for :func:`kcs_torch.training.load_lifter`; None where they are no good, or
            with ``fast_dev_run``, which tests and saves nothing.
        diverged: whether training ended early, as weights were not numbers any more; the best epoch may lie before.
    """

    value: float
    metrics: Mapping[str, float]
    lifter: Path | None
    diverged: bool = False


def train(config: DictConfig, folder: Path) -> Outcome:
    """Train, test and save a lifting network.

    Args:
        config: configs/train.yaml, composed.
        folder: of the logs (``csv``, ``tensorboard``), the ``checkpoints`` and ``lifter.safetensors``.

    Raises:
        KcsError: the configuration is wrong, or files are missing or unreadable.
    """
    plain: dict[str, Any] = OmegaConf.to_container(config, resolve=True)  # type: ignore[assignment]
    _check(plain)
    check_values(plain)
    torch.set_num_threads(config.threads)
    resumed, epoch = (None, None) if config.resume is None else _checkpoint(Path(config.resume), plain)
    goes_on = resumed is not None and resumed.is_relative_to(folder.resolve())
    diverged = False
    with _quiet():
        lightning.seed_everything(config.seed, verbose=False)
        data = instantiate(config.data, _convert_="all")
        module = instantiate(config.module, _convert_="all")
        savable = _savable(module.network)
        best = Best(folder / "checkpoints", config.optimise, config.mode, resumed)
        last = Last(folder / "checkpoints")
        watch = [Watch(plain, folder / RESULT), best, last]
        trainer = _trainer(config.trainer, watch, folder, epoch if goes_on else None)
        try:
            trainer.fit(module, datamodule=data, ckpt_path=resumed, weights_only=True)
        except (Diverged, NotFiniteError):  # a loss or a solver was given NaN
            diverged = True
            why = getattr(module, "trouble", None) or "the weights are not numbers any more: try a smaller module.lr"
            text = f"training diverged: {why}; what was best before that counts"
            warnings.warn(text, KcsWarning, stacklevel=2)
            if best.best_model_score is None:
                _clear(folder)
                return Outcome(math.inf if config.mode == "min" else -math.inf, {}, None, diverged)
        except (RuntimeError, ValueError) as error:  # of a module's state, of an optimiser's
            if resumed is None or not re.search("state.dict", str(error)):
                raise
            why = (
                "it is of another network, solver or skeleton" if isinstance(error, RuntimeError) else error
            )  # of many lines
            raise OptionError(
                f"resume={resumed}: does not fit this configuration: {why}: set model, solver and skeleton as they "
                "were, or leave resume out"
            ) from None
        except SystemExit as end:
            if trainer.interrupted:
                kept = last.best_model_path or goes_on
                how = f": resume={folder} goes on" if kept else " before the first checkpoint: a new run begins anew"
                print(f"stopped{how}", file=sys.stderr)
            raise SystemExit(_exit_code(end)) from None
        if trainer.fast_dev_run and config.optimise in trainer.callback_metrics:  # which keeps no checkpoints to test
            return Outcome(float(trainer.callback_metrics[config.optimise]), {}, None, diverged)
        if best.best_model_score is None:
            raise OptionError("train: expected at least one epoch with validation, got none: see the group trainer")
        try:
            tested = trainer.test(
                module, datamodule=data, ckpt_path=best.best_model_path, verbose=False, weights_only=True
            )
        except SystemExit as end:
            raise SystemExit(_exit_code(end)) from None
    metrics = {name: float(figure) for figures in tested for name, figure in figures.items()}
    notes = {"config": for_json(plain), "metrics": {name: f for name, f in metrics.items() if math.isfinite(f)}}
    lifter = folder / LIFTER
    if savable:
        save_lifter(lifter, module.network, fps=data.fps, notes=notes)
    else:
        lifter.unlink(missing_ok=True)
    return Outcome(float(best.best_model_score), metrics, lifter if savable else None, diverged)


def _trainer(config: DictConfig, callbacks: list[Any], folder: Path, epoch: int | None) -> Any:
    """Lightning's trainer, with what every run has where the configuration does not say otherwise.

    Args:
        config: of the trainer.
        callbacks: of every run; those of the configuration stand beside them.
        folder: of the run.
        epoch: after which a run goes on whose log is there; None for a new one.
    """
    made: dict[str, Any] = {"callbacks": callbacks, "default_root_dir": folder}
    if "callbacks" in config:
        more = instantiate(config.callbacks, _convert_="all") or []
        made["callbacks"] = [*callbacks, *(more if isinstance(more, list) else [more])]
        plain: dict[str, Any] = OmegaConf.to_container(config, resolve=True)  # type: ignore[assignment]
        config = OmegaConf.create({name: value for name, value in plain.items() if name != "callbacks"})
    if "logger" not in config:
        made["logger"] = [Log(folder, epoch), Board(folder)]
    if "enable_progress_bar" not in config:
        made["enable_progress_bar"] = sys.stderr.isatty()
    return instantiate(config, **made, _convert_="all")


def _exit_code(end: SystemExit) -> Any:
    """As shells tell it where a signal has made Lightning stop, which says 0 or 1 itself."""
    if isinstance(end, SIGTERMException):
        return 128 + signal.SIGTERM
    return 128 + signal.SIGINT if isinstance(end.__context__, KeyboardInterrupt) else end.code


def _clear(folder: Path) -> None:
    """Remove an earlier run's networks, which would pass for those of one that has none."""
    for name in (LIFTER, *(f"checkpoints/{kind}.ckpt" for kind in ("best", "last"))):
        (folder / name).unlink(missing_ok=True)


def _savable(network: Any) -> bool:
    """Whether a trained network can be written to a file of its own; told before it is trained."""
    try:
        describe(network)
    except OptionError as error:
        text = (
            "there will be no lifter.safetensors, but checkpoints/best.ckpt, which load_lifter(path, network=...) "
            f"takes: {error}"
        )
        warnings.warn(text, KcsWarning, stacklevel=2)
        return False
    return True


def _check(config: Mapping[str, Any]) -> None:
    """Look at the settings that no constructor looks at."""
    check_whole("seed", config["seed"], 0, 2**32 - 1)
    check_threads(config["threads"])
    if config["mode"] not in ("min", "max"):
        raise OptionError(f"mode: expected min or max, got {config['mode']!r}")
    if "default_root_dir" in config["trainer"]:
        raise OptionError("trainer: default_root_dir: expected none, as everything goes to hydra.run.dir=...")
    solver = config.get("solver")
    if solver is not None and "_target_" not in solver:
        raise OptionError(f"solver: there is none to set {', '.join(solver)} of: choose one first, as solver=sfam does")
    losses = config.get("loss")
    losses = losses if isinstance(losses, Mapping) else {}
    for name, term in losses.items():
        if isinstance(term, Mapping) and "_target_" not in term:
            raise unknown("loss", name, [other for other in losses if other != name])


def _checkpoint(path: Path, config: Mapping[str, Any]) -> tuple[Path, int]:
    """The checkpoint that ``resume`` means, and its epoch; it says where its run was configured otherwise."""
    found = path / "checkpoints" / "last.ckpt" if path.is_dir() else path
    if not found.is_file():
        raise OptionError(
            f"resume={path}: expected a run's folder, with checkpoints/last.ckpt, or a checkpoint, got none"
        )
    try:
        held = torch.load(found, map_location="cpu", weights_only=True)
        differing, epoch = changes(held["config"], config), int(held["epoch"])
    except Exception:  # whatever torch, zipfile and pickle make of a file that is something else
        raise OptionError(f"resume={found}: expected a checkpoint of a training run, got something else") from None
    told = {key for key, _, _ in differing}
    for key, before, now in differing:
        own = re.sub(r"module\.(network|losses|refine)(?=\.|$)", lambda found: GROUPS[found[1]], key)
        if own == key or own not in told:
            warnings.warn(f"resume: {key} was {before}, is {now}", KcsWarning, stacklevel=2)
    return found.resolve(), epoch


@contextmanager
def _quiet() -> Iterator[None]:
    """Keep packages from saying what nobody has to know."""
    levels = {name: logging.getLogger(name).level for name in ("lightning.pytorch", "lightning.fabric")}
    with warnings.catch_warnings():
        for pattern in QUIET:
            warnings.filterwarnings("ignore", pattern)
        for name in levels:
            logging.getLogger(name).setLevel(logging.WARNING)
        try:
            yield
        finally:
            for name, level in levels.items():
                logging.getLogger(name).setLevel(level)


def _to_stderr(warning: str) -> None:
    print(f"warning: {warning}", file=sys.stderr)


def job(config: DictConfig) -> float:
    """Train in the folder that Hydra gives a run, tell what it came to, and return what a sweep optimises."""
    settings = HydraConfig.get()
    folder = Path(settings.runtime.output_dir)
    with in_one_line():
        check_switch("keep", config.keep)
        before = ended(config, folder) if config.keep else None
        if config.keep and before is None and (folder / RESULT).is_file():
            raise OptionError(
                f"{folder}: a run of other settings had ended here, which keep=true leaves as it is: choose another "
                "folder, hydra.run.dir=... or hydra.sweep.dir=..., or keep=false, which replaces it"
            )
    if before is not None:
        print(f"{folder}: had ended, and is kept")
        if settings.mode == RunMode.MULTIRUN:
            tabulate(Path(settings.sweep.dir))
        value = before.get(config.optimise)
        if value is None and settings.mode != RunMode.MULTIRUN:
            raise SystemExit(1)  # as when it diverged
        return (math.inf if config.mode == "min" else -math.inf) if value is None else value
    with in_one_line(MisconfigurationException), warnings_told(_to_stderr):
        outcome = train(config, folder)
    figures = {config.optimise: outcome.value} | dict(outcome.metrics)
    result = {name: figure if math.isfinite(figure) else None for name, figure in figures.items()}
    plain = for_json(OmegaConf.to_container(config, resolve=True))
    for name, content in ((SETTINGS, plain), (RESULT, result)):  # who finds a result finds the settings of it
        with atomic_path(folder / name) as temporary:
            temporary.write_text(json.dumps(content, indent=2), encoding="utf-8")
    print("  ".join(f"{name} {value:.4g}" for name, value in figures.items()), outcome.lifter or folder, sep="\n")
    if settings.mode == RunMode.MULTIRUN:
        tabulate(Path(settings.sweep.dir))
    elif outcome.diverged:  # a sweep goes on
        raise SystemExit(1)
    return outcome.value


def main(arguments: Sequence[str] | None = None) -> None:
    """Train as a command line says, by default that of this process; exit with 2 where it is wrong."""
    entry = hydra.main(version_base="1.3", config_path=str(configs()), config_name="train")(job)
    # What stands first is what Lightning starts for each further device.
    with command_line("train", arguments, start=None if arguments is None else __file__):
        entry()


if __name__ == "__main__":
    main()
