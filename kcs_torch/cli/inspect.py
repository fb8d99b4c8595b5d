"""``kcs-torch info`` and ``kcs-torch view``: look at tracks and at results."""

from __future__ import annotations

import shlex
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from kcs_torch.cli.convert import FromUp
from kcs_torch.cli.options import (
    AsJson,
    FormatName,
    ImageSize,
    Rate,
    Threshold,
    TracksPath,
    Trust,
    UseSkeleton,
    check_outputs,
    image_size,
)
from kcs_torch.cli.outputs import Pitch, Scale, Units, Up, Written, check_up, parse_scale, write_files
from kcs_torch.cli.pictures import check_picture, write_picture
from kcs_torch.cli.report import answer, one_line, print_json, progress, unsaid
from kcs_torch.errors import counted

if TYPE_CHECKING:
    from kcs_torch.types import Motion, Reconstruction, Tracks

__all__ = ["info", "view"]


def info(
    tracks: TracksPath,
    format: FormatName = None,
    skeleton: UseSkeleton = None,
    threshold: Threshold = None,
    size: ImageSize = None,
    trust: Trust = False,
    output: Annotated[
        Path | None,
        typer.Option(
            "--output",
            "-o",
            metavar="FILE",
            help="Draw a frame with the names of the joints: .png, .svg or .pdf.",
            show_default=False,
        ),
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Show what a file of tracks holds: frames, people, skeleton, joints, and how much is unseen."""
    with answer(as_json):
        from kcs_torch.io import detect_format, load_people

        if output is not None:
            check_picture(output, source=tracks)
        with progress(f"reading {tracks}"):
            people = load_people(
                tracks,
                format=format,
                skeleton=skeleton,
                threshold=threshold,
                image_size=image_size(size),
                trust=trust,
            )
            facts = _facts(tracks, format or detect_format(tracks), people)
        if output is not None:
            from kcs_torch.viewer import draw_tracks

            with progress(f"drawing {output}"):
                write_picture(lambda: draw_tracks(people), output)
        if as_json:
            print_json(facts)
            return
        typer.echo(_spoken(facts))
        if output is not None:
            typer.echo(f"wrote {output}")
        else:
            typer.echo(f"to see which joint is which: kcs-torch info {shlex.quote(tracks)} -o picture.png")


def _facts(path: str, format: str, people: list[Tracks]) -> dict[str, Any]:
    from kcs_torch.types.people import shared

    first = people[0]
    body = first.skeleton
    common = shared([one.notes for one in people]) if people[1:] else list(first.notes)
    rows = []
    for number, one in enumerate(people):
        weights = one.weights[:, : one.skeleton.num_observed]
        seen = weights > 0
        rows.append(
            {
                "person": number,
                "frames_seen": int(seen.any(1).sum()),
                "mean_confidence": float(weights[seen].double().mean()),
                "unseen_share": one.unseen_share,
                "notes": [note for note in one.notes if note not in common],
            }
        )
    return {
        "path": path,
        "format": format,
        "frames": first.num_frames,
        "fps": first.fps,
        "units": first.units,
        "image_size": first.image_size,
        "skeleton": body.name,
        "joints": list(body.joints[: body.num_observed]),
        "virtual_joints": list(body.joints[body.num_observed :]),
        "bones": [list(pair) for pair in body.bones],
        "tree": body.is_tree,
        "people": rows,
        "notes": common,
    }


def _spoken(facts: dict[str, Any]) -> str:
    rate = f"{facts['fps']:g} frames a second" if facts["fps"] else "frames a second unknown"
    shape = "a tree" if facts["tree"] else "not a tree"
    image = f" of an image of {' x '.join(map(str, facts['image_size']))}" if facts["image_size"] else ""
    virtual = f" and virtual {', '.join(facts['virtual_joints'])}" if facts["virtual_joints"] else ""
    lines = [
        f"{facts['path']}: format {facts['format']}, {counted(facts['frames'], 'frame')}, {rate}, "
        f"in {facts['units']}{image}",
        f"skeleton {facts['skeleton']}: {len(facts['joints'])} joints, {len(facts['bones'])} bones, {shape}",
        f"joints: {', '.join(f'{k} {joint}' for k, joint in enumerate(facts['joints']))}{virtual}",
        "person  frames seen  mean confidence  joints unseen",
    ]
    rows = facts["people"]
    lines += [
        f"{p['person']:>6}  {p['frames_seen']:>11}  {p['mean_confidence']:>15.2f}  {100 * p['unseen_share']:>11.1f} %"
        for p in rows
    ]
    lines += [f"note: {one_line(note)}" for note in unsaid(facts["notes"], facts["path"])]
    return "\n".join([*lines, *(f"person {p['person']}: {one_line(note)}" for p in rows for note in p["notes"])])


def view(
    results: Annotated[
        list[Path],
        typer.Argument(
            metavar="RESULT...",
            help="A result of `kcs-torch lift` (.npz), 3D motion (.trc, .c3d, .bvh, .amc, .npz), or several of "
            "the same clip, shown together.",
            show_default=False,
        ),
    ],
    output: Annotated[
        list[Path],
        typer.Option(
            "--output",
            "-o",
            metavar="FILE",
            help="Where to write: .html (a player), .png (key frames), .gif, .mp4, .rrd, .csv or .json; may be "
            "repeated. If not given, the first RESULT with the suffix .html. A file that is there is replaced.",
            show_default=False,
        ),
    ] = [],  # noqa: B006 (typer reads it and never changes it)
    mirror: Annotated[bool, typer.Option("--mirror", help="Show the mirror image in depth.")] = False,
    up: Up = None,
    pitch: Pitch = None,
    scale: Scale = None,
    units: Units = None,
    from_up: FromUp = None,
    fps: Rate = None,
) -> None:
    """Show results, and 3D motion: write a page with a 3D player, a sheet of key frames, a film."""
    with answer():
        from kcs_torch.errors import OptionError
        from kcs_torch.io import save_people
        from kcs_torch.io.formats.pages import as_result
        from kcs_torch.io.write import people_writer
        from kcs_torch.types import Motion

        outputs = output or [results[0].with_suffix(".html")]
        size = parse_scale(scale)
        check_up(up, pitch, outputs)
        if len(results) > 1 and units is not None:
            raise OptionError(
                "--units: expected one RESULT; several are shown in their own unit, or in that of --scale"
            )
        for result in results:
            outputs = check_outputs(outputs, source=str(result))
        for path in outputs if len(results) > 1 else ():
            people_writer(path)
        people, notes = [], []
        for result in results:
            with progress(f"reading {result}"):
                motion = _moving(result, mirror, from_up, fps)
            if isinstance(motion, Motion):
                notes += [f"{result}: {note}" for note in motion.notes]
            people.append(motion if size is None else motion.scaled(**size))
        if len(people) == 1:
            written = write_files(people[0], outputs, up, units, pitch)
        else:
            written = Written()
            for path in outputs:
                together = [as_result(one) if isinstance(one, Motion) else one for one in people]
                written.attempt(path, partial(save_people, together, path))
        written.tell(notes)


def _moving(path: Path, mirror: bool, up: str | None, fps: float | None) -> Reconstruction | Motion:
    """A result, or its mirror image; or motion, which has none."""
    from kcs_torch.errors import FormatError, OptionError
    from kcs_torch.io import load_any
    from kcs_torch.types import Reconstruction, Tracks

    data = load_any(path, up=up, fps=fps)
    if isinstance(data, Tracks):
        raise FormatError(f"{path}: expected a result or 3D motion, got 2D tracks: lift them first (kcs-torch lift)")
    if not mirror:
        return data
    if not isinstance(data, Reconstruction):
        raise OptionError(f"--mirror: expected a result of `kcs-torch lift`, got 3D motion in {path}")
    return data.mirrored()
