"""Options that several commands share, and checks made before long work begins."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from kcs_torch.skeleton import Skeleton

__all__ = [
    "AsJson",
    "FormatName",
    "ImageSize",
    "InFormat",
    "Rate",
    "Threshold",
    "TracksPath",
    "Trust",
    "UseSkeleton",
    "check_other",
    "check_outputs",
    "image_size",
    "new_folders",
    "person_number",
    "use_one_thread",
    "would_replace",
]

TracksPath = Annotated[
    str,
    typer.Argument(
        metavar="TRACKS",
        help="2D joint tracks: a file, a folder of files (OpenPose), or the start of the names of a folder's files.",
        show_default=False,
    ),
]
Rate = Annotated[float | None, typer.Option(metavar="NUMBER", help="Frames a second; those of the file if not given.")]
AsJson = Annotated[bool, typer.Option("--json", help="Print JSON to standard output.")]
FormatName = Annotated[
    str | None,
    typer.Option("--format", metavar="NAME", help="Format of TRACKS; recognised by its content if not given."),
]
InFormat = Annotated[
    str | None, typer.Option("--format", metavar="NAME", help="Format of IN; recognised by its content if not given.")
]
UseSkeleton = Annotated[
    str | None,
    typer.Option(
        "--skeleton",
        metavar="NAME|FILE",
        help="A built-in skeleton (see `kcs-torch skeletons`) or a YAML or JSON file; that of the file or of the "
        "detector if not given.",
    ),
]
Threshold = Annotated[
    float | None,
    typer.Option(
        "--threshold",
        metavar="0..1",
        help="A joint with less confidence counts as unseen: .3 if not given, or 0 for tracks that kcs-torch wrote.",
        show_default=False,
    ),
]
ImageSize = Annotated[
    str | None,
    typer.Option(
        "--image-size",
        metavar="WIDTHxHEIGHT",
        help="Size of the video in pixels: turns coordinates that are relative to it (as MediaPipe's are) into pixels, "
        "and tells the camera's lens roughly. That of TRACKS if not given.",
    ),
]
Trust = Annotated[
    bool,
    typer.Option("--trust", help="Read a file even if it is a pickle (VideoPose3D's .npz); none of its code is run."),
]


class _NothingWritten(Exception):
    pass


def check_outputs(outputs: Sequence[Path], source: str | None = None, skeleton: Skeleton | None = None) -> list[Path]:
    """Make sure that results can be written, of a skeleton where it is known, before time is spent on them.

    Returns:
        the outputs, each once.

    Raises:
        OutputError: a suffix is unknown, a package is missing that it needs, a file does not take the skeleton, a place
            cannot be written to, or an output would replace the input.
    """
    from kcs_torch.io.atomic import atomic_path
    from kcs_torch.io.write import check_skeleton, ready_writer

    once: dict[str, Path] = {}
    for path in outputs:
        ready_writer(path)
        if skeleton is not None:
            check_skeleton(path, skeleton)
        once.setdefault(os.path.realpath(path), path)
        if source is not None:
            check_other(path, source, "tracks")
        try:
            with atomic_path(path):
                raise _NothingWritten
        except _NothingWritten:
            pass
    return list(once.values())


def check_other(path: Path, source: str, what: str) -> None:
    """Make sure that a file is not the one that ``what`` is read from.

    Raises:
        OutputError: it is.
    """
    from kcs_torch.errors import OutputError

    if would_replace(path) and os.path.realpath(path) == os.path.realpath(source):
        raise OutputError(f"{path}: expected another file than the {what}, which it would replace")


def would_replace(path: Path) -> bool:
    """Whether a file is where this one will be written: x/../a.npz is written to a.npz even where there is no x."""
    return os.path.exists(os.path.realpath(path))


def new_folders(outputs: Sequence[Path]) -> list[Path]:
    """The folders that writing these files would make: a slip of the pen in a path makes one as well."""
    return [folder for folder in dict.fromkeys(path.parent for path in outputs) if not folder.exists()]


def use_one_thread() -> None:
    """Let torch use one thread: for matrices as small as a skeleton's, more threads only wait for each other."""
    import torch

    torch.set_num_threads(1)


def person_number(text: str | None) -> int | None:
    """Read ``--person``: a number from 0; None where nobody or ``all`` is named.

    Raises:
        OptionError: it is something else.
    """
    from kcs_torch.errors import OptionError

    if text is None or text == "all":
        return None
    if not (text.isascii() and text.isdigit()):
        raise OptionError(f"--person: expected a number from 0, or all, got {text!r}")
    return int(text)


def image_size(text: str | None) -> tuple[int, int] | None:
    """Read ``1920x1080``.

    Raises:
        OptionError: it is something else.
    """
    from kcs_torch.errors import OptionError

    if text is None:
        return None
    width, _, height = text.lower().partition("x")
    if not (width.isascii() and width.isdigit() and height.isascii() and height.isdigit()):
        raise OptionError(f"--image-size: expected WIDTHxHEIGHT in pixels, such as 1920x1080, got {text!r}")
    return int(width), int(height)
