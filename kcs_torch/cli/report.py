"""How commands speak: results and JSON to standard output; progress, warnings and errors to standard error."""

from __future__ import annotations

import json
import math
import re
import signal
import sys
import threading
from collections.abc import Callable, Container, Iterable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

import typer

from kcs_torch.errors import KcsError, counted, warnings_told

if TYPE_CHECKING:
    from kcs_torch.types import Reconstruction

__all__ = ["answer", "describe", "one_line", "print_json", "progress", "summary", "unsaid"]


OPEN = ("give ", "a guess", "uncertain")
"""Words of notes that ask something of the user or doubt the answer: these come first."""

_warned: list[str] = []
"""What the command that runs has warned of."""


def one_line(text: object) -> str:
    """A message without line breaks."""
    return " ".join(str(text).split())


@contextmanager
def answer(as_json: bool = False) -> Iterator[dict[str, Any]]:
    """Run a command's body: an error of bad input becomes one line and exit code 2, a warning one line.

    SIGTERM ends it as Ctrl-C does, but with exit code 143: files half written are removed.

    What the body puts into the dictionary that it gets is printed as JSON together with the error.
    """
    found: dict[str, Any] = {}
    _warned.clear()
    with warnings_told(_warn), _stoppable():
        try:
            yield found
        except KcsError as error:
            typer.echo(f"error: {one_line(error)}", err=True)
            if as_json:
                print_json({**found, "error": one_line(error), "type": type(error).__name__})
            raise typer.Exit(2) from None


@contextmanager
def _stoppable() -> Iterator[None]:
    """Within this context SIGTERM raises SystemExit, unless whoever started the program has it ignored or handled."""
    ours = threading.current_thread() is threading.main_thread() and signal.getsignal(signal.SIGTERM) == signal.SIG_DFL

    def stop(number: int, _: object) -> None:
        signal.signal(number, signal.SIG_DFL)  # a second one ends it at once
        raise SystemExit(128 + number)

    if ours:
        signal.signal(signal.SIGTERM, stop)
    try:
        yield
    finally:
        if ours:
            signal.signal(signal.SIGTERM, signal.SIG_DFL)


def _warn(text: str) -> None:
    _warned.append(text)
    typer.echo(f"warning: {one_line(text)}", err=True)


def unsaid(notes: Iterable[str], source: str) -> list[str]:
    """Those notes on what comes from a source, a file or one person in it, of which no warning has told."""
    whose = {f"{name}: " for name in (source, re.sub(r", person \d+$", "", source))}
    told = [text.removeprefix(name) for text in _warned for name in whose if text.startswith(name)]
    return [note for note in notes if not any(text.startswith(note) for text in told)]


@contextmanager
def progress(text: str) -> Iterator[Callable[[int, int], None]]:
    """Show that something is under way, on a terminal only; what it gives tells how much is done, and of how much."""
    if not sys.stderr.isatty():
        yield lambda done, total: None
        return
    from rich.console import Console
    from rich.progress import Progress, SpinnerColumn, TextColumn, TimeElapsedColumn

    columns = (SpinnerColumn(), TextColumn("{task.description}"), TimeElapsedColumn())
    with Progress(*columns, console=Console(stderr=True), transient=True) as bar:
        words = text.replace("[", r"\[")
        task = bar.add_task(words, total=None)
        # The total is often a guess: a count says what is known.
        yield lambda done, total: bar.update(task, description=f"{words}: {done}{f' of {total}' if total else ''}")


def print_json(value: Any) -> None:
    """Print data as JSON; numbers that JSON lacks (NaN, infinity) become null."""
    typer.echo(json.dumps(_plain(value), indent=2, ensure_ascii=False, allow_nan=False))


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {str(k): _plain(v) for k, v in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(v) for v in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    if value is None or isinstance(value, (bool, int, float, str)):
        return value
    return str(value)


def summary(result: Reconstruction, solution: int = 1) -> dict[str, Any]:
    """What there is to say of a result, as plain data; ``solution`` is its number among those of its tracks."""
    from kcs_torch.metrics import difference

    facts, tracks = result.diagnostics, result.tracks
    others = []
    for k, other in enumerate(result.alternatives, 1):
        number = k if k < solution else k + 1
        apart = difference(result, other)
        others.append(
            {
                "solution": number,
                "objective": other.objective,
                "rms_difference": apart.rms,
                "mirrored": apart.mirrored,
                "flipped": apart.flipped,
                "differs": str(apart),
            }
        )
    return {
        "source": tracks.source,
        "frames": tracks.num_frames,
        "joints": tracks.skeleton.num_observed,
        "skeleton": tracks.skeleton.name,
        "fps": tracks.fps,
        "units": result.units,
        "method": result.method,
        "unseen_share": facts.unseen_share,
        "viewpoint_turn": facts.viewpoint_turn,
        "bone_variation": facts.bone_variation,
        "largest_bone_variation": facts.largest_bone_variation,
        "loosest_bone": facts.loosest_bone,
        "reprojection_rms": facts.reprojection_rms,
        "track_units": tracks.units,
        "converged": facts.converged,
        "iterations": facts.iterations,
        "seconds": facts.seconds,
        "solution": solution,
        "objective": result.objective,
        "alternatives": others,
        "notes": list(dict.fromkeys((*tracks.notes, *facts.notes))),
    }


def describe(facts: dict[str, Any], leave_out: Container[str] = ()) -> str:
    """The same for a reader: a heading and a line a fact; without those notes that are told elsewhere, or warned of."""
    from kcs_torch.types.variation import BoneVariation

    rate = f", {facts['fps']:g} frames a second" if facts["fps"] else ""
    variation = BoneVariation(facts["bone_variation"], facts["largest_bone_variation"], facts["loosest_bone"])
    ended = "converged" if facts["converged"] else "did not converge"
    pace = 1000 * facts["seconds"] / facts["frames"]
    took = "" if math.isnan(pace) else f", {facts['seconds']:.2f} s ({pace:.1f} ms a frame)"
    rows = {
        "unseen joints": f"{100 * facts['unseen_share']:.1f} %",
        "method": f"{facts['method']}: {ended}, {facts['iterations']} iterations{took}",
        "viewpoint turn": counted(round(facts["viewpoint_turn"]), "degree"),
        "bone variation": str(variation),
        "reprojection": f"{facts['reprojection_rms']:.3g} {facts['track_units']} (root mean square)",
    }
    if facts["frames"] == 1:  # of which neither is told
        rows = {name: text for name, text in rows.items() if name not in ("viewpoint turn", "bone variation")}
    frames = counted(facts["frames"], "frame")
    head = f"{facts['source']}: {frames}, {facts['joints']} joints ({facts['skeleton']}){rate}"
    lines = [head, *(f"  {name:<15} {text}" for name, text in rows.items())]
    best = "" if math.isnan(facts["objective"]) else f" (this one: {facts['objective']:.1f})"
    for other in facts["alternatives"]:
        value = "" if math.isnan(other["objective"]) else f"objective {other['objective']:.1f}{best}, "
        apart = f"{other['rms_difference']:.3g} {facts['units']} away (root mean square)"
        lines.append(f"  solution {other['solution']:<6} {value}{apart}: {other['differs']}")
    notes = [note for note in unsaid(facts["notes"], facts["source"]) if note not in leave_out]
    notes.sort(key=lambda note: not any(words in note for words in OPEN))
    return "\n".join([*lines, *(f"  note: {one_line(note)}" for note in notes)])
