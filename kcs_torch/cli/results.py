"""What ``kcs-torch lift`` writes: files for each person, and some of everybody together."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

from kcs_torch.cli.cleaning import SEEN
from kcs_torch.cli.detect import numbered
from kcs_torch.cli.options import check_outputs, new_folders
from kcs_torch.cli.outputs import Written, check_units, write_files
from kcs_torch.cli.report import describe, one_line, summary, unsaid

if TYPE_CHECKING:
    from kcs_torch.types import Reconstruction, Tracks

__all__ = ["Lifted", "Results"]

FEW = 0.1
"""Share of the frames; of everybody, those in sight for less are warned of."""


@dataclass(frozen=True)
class Lifted:
    """One person: their number, tracks as read and as cleaned, and motion."""

    number: int
    tracks: Tracks
    cleaned: Tracks
    motion: Reconstruction


@dataclass(frozen=True)
class Results:
    """Where motion goes, and how.

    Attributes:
        paths: that were asked for.
        everybody: whether each person has files of their own, numbered.
        frames: as ``--frames`` has them.
        up: axis that points up, if any.
        units: of length in the files, or those of the motion.
        pitch: degrees by which the camera looked down, if any.
        scale: as of :func:`kcs_torch.cli.outputs.parse_scale`.
        quiet: whether nothing is said of what is written.
        written: of files that hold everybody, and what became of all others.
    """

    paths: list[Path]
    everybody: bool
    frames: str | None
    up: str | None
    units: str | None
    pitch: float | None
    scale: dict[str, Any] | None
    quiet: bool
    written: Written = field(default_factory=Written)

    def check(self, number: int, tracks: Tracks, source: str, found: bool, together: Sequence[Path]) -> None:
        """Make sure that what a person's tracks become can be written, before anything is made of them.

        Args:
            number: of the person.
            tracks: of theirs, cleaned.
            source: what they were read from, which no file may replace.
            found: whether the skeleton is still to be found.
            together: the files that hold everybody.

        Raises:
            OptionError: a file cannot be written, or not in such units or of such a size.
            OutputError: there is no place for a file, or it would hold everybody, too.
        """
        from kcs_torch.errors import OutputError
        from kcs_torch.types.size import check_size

        names = self._names(number)
        for path in together:
            if os.path.realpath(path) in map(os.path.realpath, names):
                raise OutputError(f"{path}: would hold both person {number} and everybody: give another name")
        check_outputs(names, source=source, skeleton=None if found else tracks.skeleton)
        check_units(self.units, tracks.units, self.scale)
        if self.scale is not None and not found:
            check_size(tracks.skeleton, next(name for name in self.scale if name != "units"), "--scale")
        share = float(tracks.seen.any(1).double().mean())
        if self.everybody and share < FEW:
            say = f"visible in only {100 * share:.0f} % of the frames: the rest is guessed"
            hint = f"--least-seen {FEW:g} leaves such people out"
            typer.echo(f"warning: {one_line(tracks.source)}: {say} ({hint})", err=True)

    def together(self, count: int) -> list[Path]:
        """The files that hold all ``count`` people, none for one; those that cannot be written are told."""
        from kcs_torch.io import writer_for

        if count < 2:
            return []
        paths = [path for path in self.paths if self.everybody and writer_for(path).write_people is not None]
        if paths and self.frames == SEEN:  # each has a first frame of their own then
            say = "with --frames seen people begin at different frames"
            typer.echo(f"note: {', '.join(map(str, paths))} not written: {say}", err=True)
            return []
        return paths

    def write(self, people: Sequence[Lifted], solution: int, together: Sequence[Path]) -> dict[str, Any]:
        """Write all files that can be written, say which, and return what is to be said of them in JSON.

        Args:
            people: in their order.
            solution: which of each person's was asked for.
            together: the files that hold everybody.
        """
        from kcs_torch.types.people import shared

        common = shared([(*one.motion.tracks.notes, *one.motion.diagnostics.notes) for one in people])
        reports = [self._write_one(one, solution, common) for one in people]
        if rest := [note for note in common if any(unsaid([note], one.tracks.source) for one in people)]:
            self._say("\n".join(["everybody:", *(f"  note: {one_line(note)}" for note in rest)]))
        self._write_together(people, together)
        return {"people": reports, **({"together": self.written.files} if together else {})}

    def _names(self, number: int) -> list[Path]:
        return [numbered(path, number) if self.everybody else path for path in self.paths]

    def _write_one(self, one: Lifted, solution: int, common: Sequence[str]) -> dict[str, Any]:
        """Write one person's files, and report on them."""
        from kcs_torch.types.tracks import unseen_notes

        names = self._names(one.number)
        made = new_folders(names)
        written = write_files(one.motion, names, self.up, self.units, self.pitch)
        made = [folder for folder in made if folder.exists()]
        self.written.errors.extend(written.errors)
        report = summary(one.motion, solution)
        report["notes"] += written.notes
        known = {*one.tracks.notes, *unseen_notes(one.cleaned.weights, one.cleaned.skeleton)}
        report["cleaning"] = [note for note in one.cleaned.notes if note not in known]
        self._say(describe(report, common))
        if written.files:
            folders = f", in new folders: {', '.join(map(str, made))}" if made else ""
            self._say(f"  wrote {', '.join(map(str, written.files))}{folders}")
        return report | {"person": one.number, "files": written.files, "new_folders": made}

    def _write_together(self, people: Sequence[Lifted], paths: Sequence[Path]) -> None:
        """Write the files that hold everybody."""
        from kcs_torch.io import save_people

        for path in paths:
            self.written.attempt(path, partial(save_people, [one.motion for one in people], path))
        for path in self.written.files:
            self._say(f"wrote {path}: everybody")

    def _say(self, text: str) -> None:
        if not self.quiet:
            typer.echo(text)
