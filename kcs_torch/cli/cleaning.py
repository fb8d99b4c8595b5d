"""Options of ``kcs-torch lift`` that clean tracks before, and smooth motion after."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from kcs_torch.types import Reconstruction, Tracks

__all__ = ["SEEN", "Fill", "Frames", "Gate", "Resample", "Smooth", "Smooth3D", "cleaner", "finisher", "frame_range"]

SEEN = "seen"

_PANEL = "Cleaning (done only if asked for; the report lists each step)"

Frames = Annotated[
    str | None,
    typer.Option(
        "--frames",
        metavar="A:B|seen",
        help="Take frames A to B, counted from 0, without B (A: and :B extend to the ends), or seen: from the first "
        "to the last frame in which the person is visible.",
        rich_help_panel=_PANEL,
    ),
]
Unswap = Annotated[
    bool,
    typer.Option(
        "--unswap",
        help="Swap left and right back where the detector mistook them (pkc does so by itself).",
        rich_help_panel=_PANEL,
    ),
]
Gate = Annotated[
    bool,
    typer.Option("--gate", help="Drop detections that jump away from their joint's path.", rich_help_panel=_PANEL),
]
Fill = Annotated[
    int | None,
    typer.Option(
        metavar="FRAMES", help="Fill gaps of up to this many frames, with a lower weight.", rich_help_panel=_PANEL
    ),
]
Smooth = Annotated[
    str | None,
    typer.Option(
        "--smooth",
        metavar="METHOD=HZ",
        help="Smooth the tracks: butterworth=6, savgol=6 or one-euro=1, with the cut-off in Hz.",
        rich_help_panel=_PANEL,
    ),
]
Resample = Annotated[
    float | None,
    typer.Option(metavar="FPS", help="Resample the tracks to another frame rate.", rich_help_panel=_PANEL),
]
Smooth3D = Annotated[
    str | None,
    typer.Option(
        "--smooth-3d",
        metavar="METHOD=HZ",
        help="Smooth the 3D motion; bone lengths then become slightly less constant.",
        rich_help_panel=_PANEL,
    ),
]


def frame_range(text: str | None, option: str = "--frames", *, seen: bool = True) -> tuple[int, int | None]:
    """Read ``100:400``, ``100:`` or ``:400``; all frames for ``seen``, if it may be, which depends on the person.

    Raises:
        OptionError: it is something else.
    """
    from kcs_torch.errors import OptionError

    if text is None or (seen and text == SEEN):
        return 0, None
    first, colon, last = text.strip().partition(":")
    plain = all(part == "" or (part.isascii() and part.isdigit()) for part in (first, last))
    if not colon or not plain or (last and int(last) <= int(first or 0)):
        forms = "100:400, 100: or :400" + (", or seen" if seen else "")
        raise OptionError(f"{option}: expected A:B, A below B, such as {forms}, got {text!r}")
    return int(first or 0), int(last) if last else None


def cleaner(
    frames: str | None, unswap: bool, gate: bool, fill: int | None, smooth: str | None, resample: float | None
) -> Callable[[Tracks], Tracks]:
    """What the options ask for, in the order in which it makes sense: cut, unswap, gate, fill, smooth, resample.

    Raises:
        OptionError: an option cannot be read.
    """
    start, stop = frame_range(frames)
    low_pass = _filter("--smooth", smooth)

    def clean(tracks: Tracks) -> Tracks:
        from kcs_torch import clean as step
        from kcs_torch.errors import OptionError

        if frames == SEEN:
            seen = tracks.seen.any(1).nonzero().flatten()
            tracks = step.trim(tracks, int(seen[0]), int(seen[-1]) + 1)
            tracks = replace(tracks, notes=tuple(note for note in tracks.notes if "--frames seen" not in note))
        elif frames is not None:
            try:
                tracks = step.trim(tracks, start, stop)
            except OptionError as error:
                raise OptionError(f"--frames: {str(error).removeprefix('trim: ')}") from None
        if unswap:
            swapped = step.unswap(tracks)
            if swapped is tracks:
                why = "" if tracks.skeleton.mirror else f": skeleton '{tracks.skeleton.name}' has no left and right"
                swapped = replace(tracks, notes=(*tracks.notes, f"unswap: nothing swapped{why}"))
            tracks = swapped
        if gate:
            tracks = step.gate(tracks)
        if fill is not None:
            tracks = step.fill(tracks, fill)
        if low_pass is not None:
            tracks = step.smooth(tracks, *low_pass)
        if resample is not None:
            tracks = step.resample(tracks, resample)
        return tracks

    return clean


def finisher(smooth: str | None) -> Callable[[Reconstruction], Reconstruction]:
    """What ``--smooth-3d`` asks for.

    Raises:
        OptionError: it cannot be read.
    """
    low_pass = _filter("--smooth-3d", smooth)

    def finish(result: Reconstruction) -> Reconstruction:
        from kcs_torch import clean as step

        return result if low_pass is None else step.smooth(result, *low_pass)

    return finish


def _filter(option: str, text: str | None) -> tuple[str, float] | None:
    """A smoother and its cut-off."""
    if text is None:
        return None
    from kcs_torch.clean import SMOOTHERS
    from kcs_torch.errors import OptionError, unknown

    name, equals, cutoff = text.partition("=")
    name = name.strip()
    if equals and name not in SMOOTHERS:
        raise unknown(f"method for {option}", name, SMOOTHERS)
    try:
        hertz = float(cutoff)
    except ValueError:
        raise OptionError(
            f"{option}: expected a method and a cut-off in Hz, such as butterworth=6, got {text!r}; "
            f"methods are {', '.join(SMOOTHERS)}"
        ) from None
    return name, hertz
