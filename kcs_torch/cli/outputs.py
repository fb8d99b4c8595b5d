"""How commands write: which way is up, in which unit, and of which size."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, TypeVar

import typer

from kcs_torch.cli.report import progress

if TYPE_CHECKING:
    from kcs_torch.types import Motion, Reconstruction, Tracks

_Sized = TypeVar("_Sized", "Motion", "Reconstruction")

__all__ = ["Scale", "Units", "Up", "check_units", "check_up", "parse_scale", "sized", "write_files"]

Up = Annotated[
    str | None,
    typer.Option(
        "--up",
        metavar="y|z",
        help="The axis that points up in .bvh, .c3d, .csv and .trc files; y if not given. Other files hold results in "
        "the camera's axes (y down), and so does .csv if this is not given.",
        show_default=False,
    ),
]
Units = Annotated[
    str | None,
    typer.Option(
        metavar="m|cm|mm|in|ft",
        help="Unit of length in the files; if not given, cm in .bvh, m in .trc, mm in .c3d, else that of the motion.",
        show_default=False,
    ),
]
Scale = Annotated[
    str | None,
    typer.Option(
        "--scale",
        metavar="SIZE",
        help="The true size: height=1.75m (head to foot), a bone such as left_knee-left_ankle=430mm, or factor=2mm "
        "(one unit of the motion is 2 mm).",
        show_default=False,
    ),
]


def parse_scale(text: str | None) -> dict[str, Any] | None:
    """Read ``--scale`` as arguments of ``scaled``.

    Raises:
        OptionError: it is of another form.

    >>> parse_scale("height=1.75m")
    {'units': 'm', 'height': 1.75}
    """
    from kcs_torch.types.size import parse_size

    return None if text is None else parse_size(text, "--scale")


def sized(data: _Sized, scale: dict[str, Any] | None) -> _Sized:
    """The motion in its true size."""
    return data if scale is None else data.scaled(**scale)


def check_up(up: str | None, paths: Sequence[Path]) -> None:
    """Make sure that the axis that shall point up is one, and that a file holds it.

    Raises:
        OptionError: it is none, or results do not go so to any of the files.
    """
    from kcs_torch.errors import OptionError, unknown
    from kcs_torch.io.write import UP, takes_up

    if up is None:
        return
    if up not in UP:
        raise unknown("axis for --up", up, UP)
    if not any(map(takes_up, paths)):
        raise OptionError(f"--up: expected a .bvh, .c3d, .csv or .trc file to write, got {', '.join(map(str, paths))}")


def check_units(units: str | None, own: str, scale: dict[str, Any] | None) -> None:
    """Make sure that a motion can be written in a unit of length.

    Args:
        units: as asked for.
        own: the unit of the tracks that it will be made of.
        scale: as of :func:`parse_scale`.

    Raises:
        OptionError: the unit is unknown, or the true size is.
    """
    from kcs_torch.io.write import units_ratio

    if units is not None:
        units_ratio(own if scale is None else scale["units"], units)


def write_files(
    data: Reconstruction | Motion | Tracks, paths: Sequence[Path], up: str | None = None, units: str | None = None
) -> list[str]:
    """Write all files; return what is to be said of each.

    Raises:
        OptionError: an axis is asked for, but no file is of a kind that takes it.
    """
    from kcs_torch.io import save
    from kcs_torch.io.write import takes_up
    from kcs_torch.types import Reconstruction

    if isinstance(data, Reconstruction):
        check_up(up, paths)
    told = []
    for path in paths:
        notes: list[str] = []
        fits = not isinstance(data, Reconstruction) or takes_up(path)
        with progress(f"writing {path}"):
            save(data, path, up=up if fits else None, units=units, notes=notes)
        told += [f"{path}: {note}" for note in notes]
    return told
