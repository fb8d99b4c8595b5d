"""``kcs-torch convert``: from one kind of file to another."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from kcs_torch.cli.detect import numbered
from kcs_torch.cli.options import (
    ImageSize,
    InFormat,
    Rate,
    Threshold,
    Trust,
    check_outputs,
    image_size,
    person_number,
    would_replace,
)
from kcs_torch.cli.outputs import Pitch, Scale, Units, Up, Written, parse_scale, write_files
from kcs_torch.cli.report import answer, progress

if TYPE_CHECKING:
    from kcs_torch.types import Motion, Reconstruction, Tracks

__all__ = ["FromUnits", "FromUp", "convert"]

FromUp = Annotated[
    str | None,
    typer.Option(
        "--from-up",
        metavar="y|z|x|-y|-z",
        help="The axis that points up in a file of 3D motion, whatever the file says; y if neither says.",
    ),
]
FromUnits = Annotated[
    str | None,
    typer.Option(
        "--from-units", metavar="m|cm|mm|in|ft", help="The unit of a file of 3D motion, whatever the file says."
    ),
]


def convert(
    source: Annotated[
        str,
        typer.Argument(
            metavar="IN",
            help="2D tracks, a result of `kcs-torch lift` (.npz), or 3D motion (.trc, .c3d, .bvh, .amc, .npz).",
            show_default=False,
        ),
    ],
    output: Annotated[
        list[Path],
        typer.Argument(
            metavar="OUT...",
            help="Where to write: tracks to .npz; motion to .npz, .bvh, .c3d, .csv or .trc; results to all formats.",
            show_default=False,
        ),
    ],
    up: Up = None,
    pitch: Pitch = None,
    scale: Scale = None,
    units: Units = None,
    from_up: FromUp = None,
    from_units: FromUnits = None,
    format: InFormat = None,
    skeleton: Annotated[
        str | None,
        typer.Option(
            "--skeleton",
            metavar="NAME|FILE",
            help="A built-in skeleton or a YAML or JSON file; joints are matched by name. For .amc: its .asf file.",
        ),
    ] = None,
    fps: Rate = None,
    person: Annotated[
        str | None,
        typer.Option(
            metavar="NUMBER|all",
            help="Which person's 2D tracks, counted from 0, the most visible first; or all: each in a separate file "
            "(OUT_0, OUT_1, ...). The most visible if not given.",
        ),
    ] = None,
    threshold: Threshold = None,
    size: ImageSize = None,
    trust: Trust = False,
    overwrite: Annotated[
        bool, typer.Option("--overwrite", help="Replace files that are there, which may be inputs that a * has listed.")
    ] = False,
) -> None:
    """Convert tracks, results and motion from one kind of file to another."""
    with answer():
        from kcs_torch.errors import OptionError
        from kcs_torch.types import Reconstruction, Tracks

        every = person == "all"
        if not every:
            output = _free(output, source, overwrite)
        true_size = parse_scale(scale)
        with progress(f"reading {source}"):
            people = _read(
                source,
                every,
                format=format,
                skeleton=skeleton,
                fps=fps,
                up=from_up,
                units=from_units,
                person=0 if every else person_number(person),
                threshold=threshold,
                image_size=image_size(size),
                trust=trust,
            )
        if true_size is not None:
            moving = [one for one in people if not isinstance(one, Tracks)]
            if len(moving) < len(people):
                raise OptionError("--scale: 2D tracks have no true size: lift them first")
            people = [one.scaled(**true_size) for one in moving]
        outputs = [output]
        if every:
            outputs = [_free([numbered(path, k) for path in output], source, overwrite) for k in range(len(people))]
        written, known = Written(), []
        for data, paths in zip(people, outputs, strict=True):
            if not isinstance(data, Reconstruction):
                known += [f"{data.source}: {note}" if every else note for note in data.notes]
            written.add(write_files(data, paths, up, units, pitch))
        written.tell(known)


def _free(paths: Sequence[Path], source: str, overwrite: bool) -> list[Path]:
    """The files, each once, if they can be written and are not there, or may be replaced.

    Raises:
        OutputError: one cannot, or is there.
    """
    from kcs_torch.errors import OutputError

    paths = check_outputs(paths, source=source)
    for path in paths:
        if would_replace(path) and not overwrite:
            raise OutputError(
                f"{path}: is there. One file is converted at a time, into all that follow it (a * may list more): "
                "give another name, or --overwrite to replace it"
            )
    return paths


def _read(source: str, every: bool, **options: Any) -> list[Reconstruction | Motion | Tracks]:
    """What is there: of 2D tracks the one person, or everybody; errors as of :func:`kcs_torch.io.load_any`."""
    from kcs_torch.io import load_any, load_people
    from kcs_torch.io.anything import kind_of

    if every and options["up"] is options["units"] is None and kind_of(source, options["format"]) == "tracks":
        return [*load_people(source, **{k: v for k, v in options.items() if k not in ("up", "units", "person")})]
    return [load_any(source, **options)]
