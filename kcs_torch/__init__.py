"""Turn 2D joint tracks into 3D motion of articulated bodies, without training data.

The public names are loaded when first used: ``import kcs_torch`` and ``kcs-torch --help`` do not wait for torch.
"""

import importlib
import sys
from types import ModuleType
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from kcs_torch import functional, metrics, nn, solvers
    from kcs_torch.errors import (
        ConvergenceWarning,
        FormatError,
        KcsError,
        KcsWarning,
        OptionError,
        OutputError,
        ShapeError,
        SkeletonError,
    )
    from kcs_torch.io import load_motion, load_tracks, save
    from kcs_torch.live import LivePose, Tracker
    from kcs_torch.methods import KCS, METHODS, PKC, Method, SfAM, find_skeleton
    from kcs_torch.reconstruct import reconstruct, reconstruct_all
    from kcs_torch.skeleton import SKELETONS, Skeleton
    from kcs_torch.types import Diagnostics, Motion, Reconstruction, Tracks

    __version__: str

__all__ = [
    "KCS",
    "METHODS",
    "PKC",
    "SKELETONS",
    "ConvergenceWarning",
    "Diagnostics",
    "FormatError",
    "KcsError",
    "KcsWarning",
    "LivePose",
    "Method",
    "Motion",
    "OptionError",
    "OutputError",
    "Reconstruction",
    "SfAM",
    "ShapeError",
    "Skeleton",
    "SkeletonError",
    "Tracker",
    "Tracks",
    "find_skeleton",
    "functional",
    "load_motion",
    "load_tracks",
    "metrics",
    "nn",
    "reconstruct",
    "reconstruct_all",
    "save",
    "solvers",
]

_NAMES = {
    "errors": (
        "ConvergenceWarning",
        "FormatError",
        "KcsError",
        "KcsWarning",
        "OptionError",
        "OutputError",
        "ShapeError",
        "SkeletonError",
    ),
    "io": ("load_motion", "load_tracks", "save"),
    "live": ("LivePose", "Tracker"),
    "methods": ("KCS", "METHODS", "PKC", "Method", "SfAM", "find_skeleton"),
    "reconstruct": ("reconstruct", "reconstruct_all"),
    "skeleton": ("SKELETONS", "Skeleton"),
    "types": ("Diagnostics", "Motion", "Reconstruction", "Tracks"),
}
_HOME = {name: module for module, names in _NAMES.items() for name in names}
_MODULES = (
    "clean",
    "data",
    "detect",
    "errors",
    "functional",
    "io",
    "live",
    "many",
    "methods",
    "metrics",
    "nn",
    "skeleton",
    "solvers",
    "training",
    "types",
    "viewer",
)


class _Package(ModuleType):
    """This package; importing its submodule ``reconstruct`` must not hide the function of that name."""

    def __setattr__(self, name: str, value: Any) -> None:
        if isinstance(value, ModuleType) and _HOME.get(name) == name:
            value = getattr(value, name)
        super().__setattr__(name, value)

    def __reduce__(self) -> tuple[Any, ...]:
        """By name, as cloudpickle does with plain modules only: functions that use it go to other processes."""
        return importlib.import_module, (self.__name__,)


sys.modules[__name__].__class__ = _Package


def __getattr__(name: str) -> Any:
    if name == "__version__":
        from importlib.metadata import version

        return version("kcs-torch")
    if name in _HOME:
        value = getattr(importlib.import_module(f"{__name__}.{_HOME[name]}"), name)
        setattr(sys.modules[__name__], name, value)
        return value
    if name in _MODULES:
        return importlib.import_module(f"{__name__}.{name}")
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted({*__all__, *_MODULES, "__version__"})
