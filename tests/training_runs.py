"""Short runs of the training, and what they leave."""

import csv
from pathlib import Path

import hydra
import torch

from kcs_torch.training.run import configs, main

SMALL = ("experiment=smoke", "+model.channels=8")


def composed(*overrides: str):
    with hydra.initialize_config_dir(version_base="1.3", config_dir=str(configs())):
        return hydra.compose("train", overrides=[*SMALL, *overrides])


def rows(path: Path) -> list[dict[str, str]]:
    with path.open(newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


def logged(folder: Path, name: str) -> list[float]:
    return [float(row[name]) for row in rows(folder / "csv" / "metrics.csv") if row.get(name)]


def weights(path: Path) -> dict[str, torch.Tensor]:
    return torch.load(path / "checkpoints" / "last.ckpt", weights_only=True)["state_dict"]


def same(one: dict[str, torch.Tensor], other: dict[str, torch.Tensor]) -> bool:
    return one.keys() == other.keys() and all(torch.equal(one[name], other[name]) for name in one)


def called(capsys, *arguments: str) -> tuple[int, str, str]:
    """Exit code, output and errors of a command line, in this process."""
    code = 0
    try:
        main(arguments)
    except SystemExit as end:
        code = end.code
    out, err = capsys.readouterr()
    return code, out, err
