"""``kcs-torch angles``: how joints bend over time."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from kcs_torch.cli.options import AsJson, InFormat, Rate, check_other
from kcs_torch.cli.report import answer, one_line, print_json, progress
from kcs_torch.errors import counted

if TYPE_CHECKING:
    from kcs_torch.types import JointAngles

__all__ = ["angles"]


def angles(
    source: Annotated[
        str,
        typer.Argument(
            metavar="IN",
            help="A result of `kcs-torch lift` (.npz), or 3D motion (.trc, .c3d, .bvh, .amc, .npz).",
            show_default=False,
        ),
    ],
    output: Annotated[
        Path | None,
        typer.Option(
            "--output",
            "-o",
            metavar="FILE",
            help="Write a table (.csv): a row a frame, with each angle and its standard deviation in degrees.",
            show_default=False,
        ),
    ] = None,
    joint: Annotated[
        list[str],
        typer.Option(
            metavar="NAME|A,B,C",
            help="A hinge (left_knee), or three joints (neck,left_hip,left_knee) for the bend at the middle one; may "
            "be repeated. If not given, all hinges of the skeleton: knees, elbows, ankles, fingers.",
            show_default=False,
        ),
    ] = [],  # noqa: B006 (typer reads it and never changes it)
    format: InFormat = None,
    skeleton: Annotated[
        str | None,
        typer.Option(
            "--skeleton",
            metavar="NAME|FILE",
            help="For 3D motion: a built-in skeleton or a YAML or JSON file; joints are matched by name.",
        ),
    ] = None,
    fps: Rate = None,
    mirror: Annotated[bool, typer.Option("--mirror", help="Take the mirror image in depth of a result.")] = False,
    as_json: AsJson = False,
) -> None:
    """Tell how joints bend over time: 0 degrees is straight; a hinge bent the wrong way is negative."""
    with answer(as_json):
        from kcs_torch.errors import FormatError, OptionError
        from kcs_torch.io import load_any
        from kcs_torch.io.angles import check_table
        from kcs_torch.types import Reconstruction, Tracks

        if output is not None:
            check_table(output)
            check_other(output, source, "motion")
        with progress(f"reading {source}"):
            data = load_any(source, format=format, skeleton=skeleton, fps=fps)
        if isinstance(data, Tracks):
            raise FormatError(
                f"{source}: expected a result or 3D motion, got 2D tracks: lift them first (kcs-torch lift), "
                "or say with --format as which 3D motion to read it"
            )
        if mirror:
            if not isinstance(data, Reconstruction):
                raise OptionError(f"--mirror: expected a result of `kcs-torch lift`, got 3D motion in {source}")
            data = data.mirrored()
        found = data.angles([_named(words) for words in joint] or None)
        if output is not None:
            with progress(f"writing {output}"):
                found.save(output)
        facts = _facts(found)
        notes = list(data.diagnostics.notes if isinstance(data, Reconstruction) else data.notes)
        notes = [note for note in notes if "--from-up" not in note]  # to angles no axis matters
        if isinstance(data, Reconstruction):  # their options are not those of this command
            notes = [note.replace("(kcs-torch: --", "(kcs-torch lift: --") for note in notes]
        if as_json:
            print_json({"source": source, "fps": found.fps, "angles": facts, "notes": notes})
            return
        typer.echo(_spoken(found, facts, source))
        for note in notes:
            typer.echo(f"  note: {one_line(note)}")
        if output is not None:
            typer.echo(f"wrote {output}")


def _named(words: str) -> str | list[str]:
    """A hinge's name, or several joints'."""
    return [word.strip() for word in words.split(",")] if "," in words else words


def _facts(found: JointAngles) -> dict[str, dict[str, Any]]:
    """Of each angle how far it goes in the frames that show its joints, in degrees; NaN where none does."""
    facts = {}
    for name, values in found.degrees.items():
        seen = found.seen[name] & values.isfinite()
        known = values[seen]
        least, most = (float(known.amin()), float(known.amax())) if len(known) else (float("nan"),) * 2
        deviation = None if found.deviation is None else float(found.deviation[name][seen].mean())
        facts[name] = {
            "least": least,
            "mean": float(known.mean()),
            "most": most,
            "deviation": deviation,
            "frames": len(known),
            "signed": name in found.signed,
        }
    return facts


def _spoken(found: JointAngles, facts: dict[str, dict[str, Any]], source: str) -> str:
    rate = f" at {found.fps:g} a second" if found.fps else ""
    frames = len(next(iter(found.degrees.values())))
    wide = max(map(len, [*facts, "degrees"]))
    lines = [
        f"{source}: {counted(frames, 'frame')}{rate}; 0 is straight",
        f"{'degrees':<{wide}}{'least':>8}{'mean':>8}{'most':>8}{'deviation':>11}",
    ]
    for name, row in facts.items():
        deviation = "unknown" if row["deviation"] is None or not row["frames"] else f"{row['deviation']:.1f}"
        numbers = (
            "".join(f"{row[key]:>8.1f}" for key in ("least", "mean", "most")) if row["frames"] else f"{'unseen':>24}"
        )
        lines.append(f"{name:<{wide}}{numbers}{deviation:>11}")
    unseen = {name: frames - row["frames"] for name, row in facts.items() if row["frames"] < frames}
    if unseen:
        listed = ", ".join(f"{counted(count, 'frame')} of {name}" for name, count in unseen.items())
        lines.append(f"note: left out, as a joint is unseen: {listed}")
    return "\n".join(lines)
