"""How commands write: which way is up, in which unit, of which size; and each file whatever becomes of the others."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, TypeVar

import typer

from kcs_torch.cli.report import one_line, progress

if TYPE_CHECKING:
    from kcs_torch.types import Motion, Reconstruction, Tracks

_Sized = TypeVar("_Sized", "Motion", "Reconstruction")

__all__ = ["Pitch", "Scale", "Units", "Up", "Written", "check_units", "check_up", "parse_scale", "sized", "write_files"]

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
Pitch = Annotated[
    float | None,
    typer.Option(
        "--pitch",
        metavar="DEGREES",
        help="How far the camera looked down (below 0: up): levels results in .bvh, .c3d, .csv and .trc files, whose "
        "up is the camera's if this is not given.",
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


def check_up(up: str | None, pitch: float | None, paths: Sequence[Path]) -> None:
    """Make sure that the axis that shall point up is one, the camera's pitch is possible, and that a file holds them.

    Raises:
        OptionError: it is none, or results do not go so to any of the files.
    """
    from kcs_torch.errors import OptionError, unknown
    from kcs_torch.io.write import UP, takes_up

    if up is not None and up not in UP:
        raise unknown("axis for --up", up, UP)
    if pitch is not None and not abs(pitch) <= 90:
        raise OptionError(f"--pitch: expected -90 to 90 degrees, got {pitch:g}")
    asked = [name for name, value in (("--up", up), ("--pitch", pitch)) if value is not None]
    if asked and not any(map(takes_up, paths)):
        raise OptionError(
            f"{asked[0]}: expected a .bvh, .c3d, .csv or .trc file to write, got {', '.join(map(str, paths))}"
        )


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


@dataclass(frozen=True)
class Written:
    """What became of files that do not depend on each other.

    Attributes:
        files: that were written.
        notes: what is to be said of them.
        errors: why others were not.
    """

    files: list[Path] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    errors: list[Exception] = field(default_factory=list)

    def attempt(self, path: Path, write: Callable[[], object]) -> None:
        """Write one file, and keep the error if it cannot be."""
        with progress(f"writing {path}"):
            try:
                write()
                self.files.append(path)
            except Exception as error:
                self.errors.append(error)

    def add(self, other: Written) -> None:
        """Count in what became of more files."""
        self.files.extend(other.files)
        self.notes.extend(other.notes)
        self.errors.extend(other.errors)

    def tell(self, known: Sequence[str] = ()) -> None:
        """Say what was written, after notes that are known; raise what went wrong, alone where nothing was written.

        Raises:
            OutputError: as of :meth:`check`.
        """
        if not self.files:
            self.check()
        for note in (*known, *self.notes):
            typer.echo(f"note: {one_line(note)}", err=True)
        for path in self.files:
            typer.echo(f"wrote {path}")
        self.check()

    def check(self) -> None:
        """Raise what went wrong, once all that can be written is.

        Raises:
            OutputError: several files could not be written; the error itself where it was one.
        """
        from kcs_torch.errors import KcsError, OutputError

        told = {str(error): error for error in self.errors}
        grave = [error for error in self.errors if not isinstance(error, KcsError)]
        if grave or len(told) == 1:
            raise [*grave, *told.values()][0]
        if told:
            raise OutputError("; ".join(told))


def write_files(
    data: Reconstruction | Motion | Tracks,
    paths: Sequence[Path],
    up: str | None = None,
    units: str | None = None,
    pitch: float | None = None,
) -> Written:
    """Write all files that can be written.

    Raises:
        OptionError: an axis or a level is asked for, but no file is of a kind that takes it.
    """
    from kcs_torch.io import save
    from kcs_torch.io.write import takes_up
    from kcs_torch.types import Reconstruction

    if isinstance(data, Reconstruction):
        check_up(up, pitch, paths)
    written = Written()
    for path in paths:
        notes: list[str] = []
        turns = not isinstance(data, Reconstruction) or takes_up(path)
        where = (up, pitch) if turns else (None, None)
        written.attempt(path, partial(save, data, path, up=where[0], pitch=where[1], units=units, notes=notes))
        written.notes.extend(f"{path}: {note}" for note in notes)
    return written
