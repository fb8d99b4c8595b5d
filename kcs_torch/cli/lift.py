"""``kcs-torch lift``: 2D tracks in, 3D motion out."""

from __future__ import annotations

from dataclasses import replace
from itertools import compress
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from kcs_torch.cli.cleaning import (
    SEEN,
    Fill,
    Frames,
    Gate,
    Resample,
    Smooth,
    Smooth3D,
    Unswap,
    cleaner,
    finisher,
    frame_range,
)
from kcs_torch.cli.detect import DetectorName, Models, What, people_of
from kcs_torch.cli.options import (
    AsJson,
    FormatName,
    ImageSize,
    Threshold,
    TracksPath,
    Trust,
    check_outputs,
    image_size,
    person_number,
    use_one_thread,
)
from kcs_torch.cli.outputs import Pitch, Scale, Units, Up, check_units, check_up, parse_scale, sized
from kcs_torch.cli.report import answer, one_line, print_json, progress
from kcs_torch.cli.results import Lifted, Results

if TYPE_CHECKING:
    from kcs_torch.methods import Method
    from kcs_torch.types import Intrinsics, Reconstruction, Tracks

__all__ = ["MethodName", "Settings", "lift", "method_fields"]

LEARNED = ".safetensors"
"""Suffix of trained networks, which stand for a method."""

MethodName = Annotated[
    str,
    typer.Option(
        "--method",
        "-m",
        metavar="NAME",
        help="pkc (also called auto), sfam, kcs, pnd, smsr, local_rigidity, rigid, pta, csf or bmm; lift also takes a "
        "trained network (.safetensors).",
    ),
]
Settings = Annotated[
    list[str],
    typer.Option(
        "--set",
        metavar="NAME=VALUE",
        help="Set a field of the method; may be repeated. If the name is wrong, the error lists the right ones.",
        show_default=False,
    ),
]


def lift(
    tracks: TracksPath,
    output: Annotated[
        list[Path],
        typer.Option(
            "--output",
            "-o",
            metavar="FILE",
            help="Where to write: .npz (everything); .bvh, .c3d, .trc, .csv or .json; .html (a player), .png, .gif, "
            ".mp4 or .rrd (rerun); may be repeated. A file that is there is replaced.",
            show_default=False,
        ),
    ],
    method: MethodName = "auto",
    settings: Settings = [],  # noqa: B006 (typer reads it and never changes it)
    skeleton: Annotated[
        str | None,
        typer.Option(
            "--skeleton",
            metavar="NAME|FILE|auto",
            help="A built-in skeleton (see `kcs-torch skeletons`), a YAML or JSON file, or auto: bones are found from "
            "the motion. That of TRACKS if not given.",
        ),
    ] = None,
    format: FormatName = None,
    person: Annotated[
        str | None,
        typer.Option(
            metavar="NUMBER|all",
            help="Which person, counted from 0, the most visible first; or all: each in a separate file (OUT_0, "
            "OUT_1), and pages, films and recordings also of all together (OUT). They have one lens by "
            "--intrinsics, or by --image-size, which is guessed if nobody says it: the directions in which they stand "
            "then compare, and with --scale their distances.",
        ),
    ] = None,
    least_seen: Annotated[
        float | None,
        typer.Option(
            "--least-seen",
            metavar="0..1",
            help="With --person all: leave out those who are seen in a smaller share of the frames.",
            show_default=False,
        ),
    ] = None,
    workers: Annotated[
        int,
        typer.Option(
            metavar="NUMBER", min=1, help="With --person all: solve people in up to so many processes; needs joblib."
        ),
    ] = 1,
    fps: Annotated[
        float | None, typer.Option(metavar="NUMBER", help="Frames a second; those of TRACKS if not given.")
    ] = None,
    threshold: Threshold = None,
    size: ImageSize = None,
    trust: Trust = False,
    intrinsics: Annotated[
        str | None,
        typer.Option(
            metavar="FX,FY,CX,CY|auto|parallel",
            help="Focal lengths and principal point of the camera in pixels; auto: the focal length is found from the "
            "tracks, from that of usual cameras with such an image (--image-size) on, unless parallel rays explain "
            "them better (what pkc does unless told otherwise); parallel: the camera is far away, and people are where "
            "the image has them.",
            show_default=False,
        ),
    ] = None,
    mirror: Annotated[
        bool,
        typer.Option(
            "--mirror",
            help="Write the mirror image in depth, which fits the tracks equally well; before a near camera, or with "
            "--intrinsics, its bones vary: there --solution writes another one.",
        ),
    ] = False,
    solution: Annotated[
        int,
        typer.Option(
            "--solution",
            metavar="NUMBER",
            min=1,
            help="Write this solution instead of the best, which is number 1; the report lists them, with their "
            "objective (lower is better) and how they differ.",
        ),
    ] = 1,
    frames: Frames = None,
    unswap: Unswap = False,
    gate: Gate = False,
    fill: Fill = None,
    smooth: Smooth = None,
    resample: Resample = None,
    smooth_3d: Smooth3D = None,
    up: Up = None,
    pitch: Pitch = None,
    scale: Scale = None,
    units: Units = None,
    detector: DetectorName = "auto",
    models: Models = [],  # noqa: B006
    what: What = "pose",
    as_json: AsJson = False,
) -> None:
    """Turn 2D joint tracks, or a video where a detector is installed, into 3D motion."""
    with answer(as_json) as said:
        from kcs_torch.errors import OptionError
        from kcs_torch.methods.clips.processes import check_workers

        output = check_outputs(output, source=tracks)
        learned = _learned(method, settings) if method.endswith((LEARNED, ".ckpt")) else None
        fields = {} if learned is not None else method_fields(method, settings)
        if intrinsics is not None:
            fields["intrinsics"] = _lens(intrinsics)
        person_number(person)
        if least_seen is not None and not (person == "all" and 0 <= least_seen <= 1):
            raise OptionError(f"--least-seen: expected a share from 0 to 1, with --person all, got {least_seen:g}")
        if workers > 1:
            if person != "all":
                raise OptionError("--workers: expected it with --person all: one person is solved in one process")
            check_workers(workers, [])
            fields["workers"] = workers
        finish = finisher(smooth_3d)
        size_of = parse_scale(scale)
        check_up(up, pitch, output)
        results = Results(output, person == "all", frames, up, units, pitch, size_of, quiet=as_json)
        find, skeleton = skeleton == "auto", None if skeleton == "auto" else skeleton
        if format is None and _is_video(tracks):
            clean = cleaner(SEEN if frames == SEEN else None, unswap, gate, fill, smooth, resample)
            check_units(units, "px", size_of)
            if size is not None:
                raise OptionError(f"--image-size: {tracks} is a video, which tells its own: leave it out")
            people = people_of(
                tracks,
                person,
                detector=detector,
                what=what,
                models=models,
                frames=frames,
                skeleton=skeleton,
                fps=fps,
                threshold=threshold,
            )
        else:
            if detector != "auto" or models or what != "pose":
                raise OptionError(f"--detector, --model, --what: belong to videos, got {tracks}: leave them out")
            clean = cleaner(frames, unswap, gate, fill, smooth, resample)
            with progress(f"reading {tracks}"):
                people = _people(
                    tracks,
                    person,
                    format=format,
                    skeleton=skeleton,
                    fps=fps,
                    threshold=threshold,
                    image_size=image_size(size),
                    trust=trust,
                )
            if person == "all" and frames is not None:
                people = _in_sight(people, frames)
        if least_seen is not None:
            people = _often_seen(people, least_seen, None if _is_video(tracks) else frames)
        use_one_thread()
        together = results.together(len(people))
        cleaned = [clean(one) for _, one in people]
        for (number, _), one in zip(people, cleaned, strict=True):
            results.check(number, one, tracks, find, together)
        chosen = (one.solution(solution) for one in _lifted(cleaned, learned or method, fields, find))
        found = [sized(finish(one.mirrored() if mirror else one), size_of) for one in chosen]
        everyone = zip(people, cleaned, found, strict=True)
        said |= results.write([Lifted(*one, neat, motion) for one, neat, motion in everyone], solution, together)
        results.written.check()
        if as_json:
            print_json(said)


def method_fields(method: str, settings: list[str]) -> dict[str, Any]:
    """Check the method's name and read ``--set`` by its fields.

    Raises:
        OptionError: the method, a field or a value is wrong.
    """
    from kcs_torch.cli.fields import parse_settings
    from kcs_torch.reconstruct import method_named

    return parse_settings(settings, [type(method_named(method, {}))])


def _learned(path: str, settings: list[str]) -> Method:
    """The trained network of a file, with its settings.

    Raises:
        FormatError: the file holds none.
        OptionError: a setting is wrong.
    """
    from kcs_torch.cli.fields import parse_settings
    from kcs_torch.training import Lifter, load_lifter

    return replace(load_lifter(path), **parse_settings(settings, [Lifter]))


def _lens(text: str) -> Intrinsics | str:
    """The camera that ``--intrinsics`` names, or what is to be done without."""
    from kcs_torch.errors import KcsError, OptionError
    from kcs_torch.reconstruct import WITHOUT
    from kcs_torch.types import Intrinsics

    if text in WITHOUT:
        return text
    try:
        return Intrinsics.of([float(x) for x in text.split(",")])
    except (ValueError, KcsError):
        raise OptionError(
            "--intrinsics: expected FX,FY,CX,CY in pixels, focal lengths positive, such as 1500,1500,960,540, auto or "
            f"parallel, got {text!r}"
        ) from None


def _people(tracks: str, person: str | None, **options: Any) -> list[tuple[int, Tracks]]:
    """The chosen people, each with their number."""
    from kcs_torch.io import load_people, load_tracks

    if person == "all":
        return list(enumerate(load_people(tracks, **options)))
    number = person_number(person)
    return [(number or 0, load_tracks(tracks, person=number, **options))]


def _in_sight(people: list[tuple[int, Tracks]], frames: str) -> list[tuple[int, Tracks]]:
    """Those who are seen in a part of the clip, and a word on the others; all where nobody is, as that is an error."""
    start, stop = frame_range(frames)
    there = [bool(one.seen[start:stop].any()) for _, one in people]
    if not any(there):
        return people
    for (_, one), seen in zip(people, there, strict=True):
        if not seen:
            typer.echo(f"note: {one_line(one.source)}: not seen in frames {frames}: left out", err=True)
    return list(compress(people, there))


def _often_seen(people: list[tuple[int, Tracks]], least: float, frames: str | None) -> list[tuple[int, Tracks]]:
    """Those who are seen in a share of the frames, or of a part of them, and a word on the others.

    All where nobody is seen in that part, as that is an error.

    Raises:
        OptionError: all are seen in less.
    """
    from kcs_torch.errors import OptionError

    start, stop = frame_range(frames)
    shares = [float(one.seen[start:stop].any(1).double().mean()) for _, one in people]
    if not any(share > 0 for share in shares):
        return people
    if max(shares) < least:
        raise OptionError(
            f"--least-seen: nobody is seen in {100 * least:g} % of the frames; the most visible person is in "
            f"{100 * max(shares):.3g} %"
        )
    for (_, one), share in zip(people, shares, strict=True):
        if share < least:
            typer.echo(f"note: {one_line(one.source)}: seen in {100 * share:.0f} % of the frames: left out", err=True)
    return [one for one, share in zip(people, shares, strict=True) if share >= least]


def _is_video(path: str) -> bool:
    from kcs_torch.io.video import is_video

    return is_video(path)


def _lifted(people: list[Tracks], method: str | Method, fields: dict[str, Any], find: bool) -> list[Reconstruction]:
    """Reconstruct everybody, with the skeleton that their motion shows where it is to be found."""
    import kcs_torch as kt
    from kcs_torch.reconstruct import with_found_bones

    frames = sum(one.num_frames for one in people)
    joints = people[0].num_joints
    who = f"{len(people)} people, " if len(people) > 1 else ""
    with progress(f"reconstructing {who}{frames} frames of {joints} joints"):
        if find:
            people = [with_found_bones(one) for one in people]
        return kt.reconstruct_all(people, method=method, **fields)
