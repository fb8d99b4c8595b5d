"""Training of networks that lift tracks: batches, data, checkpoints. Needs the ``train`` extra.

The names are loaded when first used: a trained network is read and run without lightning.
"""

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from kcs_torch.training.batch import Batch
    from kcs_torch.training.checkpoint import load_lifter, save_lifter
    from kcs_torch.training.data import TracksDataModule
    from kcs_torch.training.lifter import Lifter
    from kcs_torch.training.losses import CycleConsistency, LossTerm
    from kcs_torch.training.module import LiftingModule

__all__ = [
    "Batch",
    "CycleConsistency",
    "Lifter",
    "LiftingModule",
    "LossTerm",
    "TracksDataModule",
    "load_lifter",
    "save_lifter",
]

_HOME = {
    "Batch": "batch",
    "CycleConsistency": "losses",
    "Lifter": "lifter",
    "LiftingModule": "module",
    "LossTerm": "losses",
    "TracksDataModule": "data",
    "load_lifter": "checkpoint",
    "save_lifter": "checkpoint",
}


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(importlib.import_module(f"{__name__}.{_HOME[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted(__all__)
