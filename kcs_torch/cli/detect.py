"""``kcs-torch detect``: a video in, 2D joint tracks out."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from kcs_torch.cli.cleaning import Frames, frame_range
from kcs_torch.cli.options import AsJson, Threshold, UseSkeleton, check_outputs
from kcs_torch.cli.report import answer, one_line, print_json, progress

if TYPE_CHECKING:
    from kcs_torch.types import Tracks

__all__ = ["DetectorName", "Models", "What", "detect", "numbered", "people_of"]

_PANEL = "Video"

DetectorName = Annotated[
    str,
    typer.Option(
        "--detector",
        metavar="NAME",
        help="mediapipe (ships its models; one person at a time) or rtmlib (your ONNX files); auto means rtmlib if "
        "--model is given, else mediapipe.",
        rich_help_panel=_PANEL,
    ),
]
Models = Annotated[
    list[Path],
    typer.Option(
        "--model",
        metavar="FILE.onnx",
        help="A model for rtmlib: RTMPose, or RTMO; given twice, also a person detector (YOLOX or RTMDet).",
        show_default=False,
        rich_help_panel=_PANEL,
    ),
]
What = Annotated[
    str, typer.Option("--what", metavar="pose|hands", help="What to look for in a video.", rich_help_panel=_PANEL)
]


def detect(
    video: Annotated[str, typer.Argument(metavar="VIDEO", help="A video file.", show_default=False)],
    output: Annotated[
        Path,
        typer.Option("--output", "-o", metavar="FILE.npz", help="Where to write the tracks.", show_default=False),
    ],
    detector: DetectorName = "auto",
    models: Models = [],  # noqa: B006 (typer reads it and never changes it)
    what: What = "pose",
    person: Annotated[
        str | None,
        typer.Option(
            metavar="NUMBER|all",
            help="Which person, counted from 0, the most visible first; or all, each in a separate file.",
        ),
    ] = None,
    frames: Frames = None,
    skeleton: UseSkeleton = None,
    fps: Annotated[
        float | None, typer.Option(metavar="NUMBER", help="Frames a second; those of VIDEO if not given.")
    ] = None,
    threshold: Threshold = None,
    as_json: AsJson = False,
) -> None:
    """Find the joints of people in a video; this needs a detector (see `kcs-torch doctor`)."""
    with answer(as_json):
        from kcs_torch.errors import OutputError
        from kcs_torch.io import save

        if output.suffix.lower() != ".npz":
            raise OutputError(f"{output}: expected a file with the suffix .npz, which holds tracks")
        check_outputs([output], source=video)
        people = people_of(
            video,
            person,
            detector=detector,
            what=what,
            models=models,
            frames=frames,
            skeleton=skeleton,
            fps=fps,
            threshold=threshold,
        )
        facts = []
        for number, tracks in people:
            path = numbered(output, number) if person == "all" else output
            check_outputs([path], source=video)
            save(tracks, path)
            facts.append(_facts(number, tracks, path))
        if as_json:
            print_json({"people": facts})
            return
        for one in facts:
            typer.echo(_spoken(one))


def people_of(
    video: str,
    person: str | None,
    *,
    detector: str,
    what: str,
    models: list[Path],
    frames: str | None,
    skeleton: str | None,
    fps: float | None,
    threshold: float | None,
) -> list[tuple[int, Tracks]]:
    """The chosen people of a video, each with their number.

    Raises:
        OptionError: the detector is not installed, or an option is wrong.
        FormatError: the video cannot be read, or has fewer people.
    """
    from dataclasses import replace

    from kcs_torch.cli.options import person_number
    from kcs_torch.detect import detect_video
    from kcs_torch.io.load import check_person

    number = person_number(person)
    start, stop = frame_range(frames)
    for name in ("GLOG_minloglevel", "OPENCV_FFMPEG_LOGLEVEL"):  # they would talk over the report
        os.environ.setdefault(name, "2" if name.startswith("GLOG") else "-8")
    with progress(f"detecting in {video}") as advance:
        people = detect_video(
            video,
            detector=detector,
            what=what,
            models=models,
            start=start,
            stop=stop,
            skeleton=skeleton,
            fps=fps,
            threshold=threshold,
            progress=advance,
        )
    if person == "all":
        return list(enumerate(people))
    one = people[check_person(video, number or 0, len(people))]
    if number is None and len(people) > 1:
        note = f"{len(people)} people found: this is the most seen one, number 0; --person chooses others"
        one = replace(one, notes=(*one.notes, note))
    return [(number or 0, one)]


def numbered(path: Path, number: int) -> Path:
    """The path with a person's number."""
    return path.with_name(f"{path.stem}_{number}{path.suffix}")


def _facts(number: int, tracks: Tracks, path: Path) -> dict[str, Any]:
    return {
        "person": number,
        "source": tracks.source,
        "frames": tracks.num_frames,
        "frames_seen": int(tracks.seen.any(1).sum()),
        "joints": tracks.skeleton.num_observed,
        "skeleton": tracks.skeleton.name,
        "fps": tracks.fps,
        "unseen_share": tracks.unseen_share,
        "notes": list(tracks.notes),
        "file": path,
    }


def _spoken(facts: dict[str, Any]) -> str:
    rate = f"{facts['fps']:g} frames a second" if facts["fps"] else "frames a second unknown"
    video = facts["source"].removesuffix(f", person {facts['person']}")
    return "\n".join(
        [
            f"{video}: person {facts['person']} seen in {facts['frames_seen']} of {facts['frames']} frames, "
            f"{facts['joints']} joints ({facts['skeleton']}), {rate}",
            f"  unseen joints   {100 * facts['unseen_share']:.1f} %",
            *(f"  note: {one_line(note)}" for note in facts["notes"]),
            f"  wrote {facts['file']}",
        ]
    )
