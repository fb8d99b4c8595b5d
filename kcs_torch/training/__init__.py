"""Training of networks that lift tracks: batches, data, checkpoints. Needs the ``train`` extra.

The names are loaded when first used: a trained network is read and run without lightning.
"""

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from kcs_torch.training.batch import Batch
    from kcs_torch.training.data import TracksDataModule

__all__ = ["Batch", "TracksDataModule"]

_HOME = {
    "Batch": "batch",
    "TracksDataModule": "data",
}


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(importlib.import_module(f"{__name__}.{_HOME[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
