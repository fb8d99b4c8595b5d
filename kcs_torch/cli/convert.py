"""``kcs-torch convert``: from one kind of file to another."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

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
from kcs_torch.cli.outputs import Pitch, Scale, Units, Up, parse_scale, write_files
from kcs_torch.cli.report import answer, progress

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
        typer.Option(metavar="NUMBER", help="Which person's 2D tracks, counted from 0; the most visible if not given."),
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
        from kcs_torch.errors import OptionError, OutputError
        from kcs_torch.io import load_any
        from kcs_torch.types import Reconstruction, Tracks

        output = check_outputs(output, source=source)
        for path in output:
            if would_replace(path) and not overwrite:
                raise OutputError(
                    f"{path}: is there. One file is converted at a time, into all that follow it (a * may list more): "
                    "give another name, or --overwrite to replace it"
                )
        true_size = parse_scale(scale)
        with progress(f"reading {source}"):
            data = load_any(
                source,
                format=format,
                skeleton=skeleton,
                fps=fps,
                up=from_up,
                units=from_units,
                person=person_number(person),
                threshold=threshold,
                image_size=image_size(size),
                trust=trust,
            )
        known = () if isinstance(data, Reconstruction) else data.notes
        if true_size is not None:
            if isinstance(data, Tracks):
                raise OptionError("--scale: 2D tracks have no true size: lift them first")
            data = data.scaled(**true_size)
        written = write_files(data, output, up, units, pitch)
        written.tell(known)
