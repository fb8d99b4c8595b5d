"""A folder of tracks to a folder of motion: :func:`reconstruct_folder`."""

from __future__ import annotations

import itertools
import os
import shutil
import time
import traceback
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from kcs_torch.errors import KcsError, KcsWarning, OptionError, unknown
from kcs_torch.io.atomic import atomic_path
from kcs_torch.io.load import check_reading, load_people, most_seen
from kcs_torch.io.write import UP, ready_writer, save, takes_up
from kcs_torch.many.clips import Clip, clips_of
from kcs_torch.many.record import claim, settings_of
from kcs_torch.methods.base import Method
from kcs_torch.methods.clips.processes import check_workers
from kcs_torch.reconstruct import method_named, reconstruct_all, with_found_bones
from kcs_torch.types import Intrinsics, Reconstruction, Tracks
from kcs_torch.types.axes import check_pitch
from kcs_torch.types.hints import is_a, spoken
from kcs_torch.types.size import METRES, check_size, parse_size

__all__ = ["Outcome", "reconstruct_folder"]

STALE = 3600.0
"""Seconds after which another part's folder was left by a process that was killed."""


@dataclass(frozen=True)
class Outcome:
    """How the clips of one part of the work ended.

    Attributes:
        clips: how many there are.
        done: made now.
        skipped: made before.
        outdated: of these, clips whose file was changed since: remove their results to have them made anew.
        doubted: clips made now of whose depth a result warns (:class:`kcs_torch.types.Diagnostics`), and why.
        failed: each clip that failed, now or before, and why.
        frames: of the clips made now.
        seconds: that it took.
    """

    clips: int
    done: int
    skipped: int
    outdated: tuple[Path, ...]
    doubted: tuple[tuple[Path, str], ...]
    failed: tuple[tuple[Path, str], ...]
    frames: int
    seconds: float


def reconstruct_folder(
    source: str | Path,
    output: str | Path,
    *,
    method: str | Method = "auto",
    suffixes: str | Sequence[str] = (".npz",),
    pattern: str = "*",
    shard: int = 0,
    shards: int = 1,
    batch: int = 16,
    workers: int = 1,
    everybody: bool = False,
    retry: bool = False,
    scale: str | None = None,
    up: str | None = None,
    pitch: float | None = None,
    units: str | None = None,
    intrinsics: Any = None,
    progress: Callable[[str], None] | None = None,
    **reading: object,
) -> Outcome:
    """Reconstruct every clip of a folder; what is done already is left alone.

    A clip is done when all its results are there, and each appears whole or not at all: however often the work is
    killed and begun again, nothing is lost or made twice. A clip that fails leaves ``NAME.failed.txt`` with the
    reason and is not tried again, unless ``retry`` says so. A folder holds results of one method and of one kind of
    reading; which, a hidden file in it tells.

    Args:
        source: folder of tracks in any format that is read; a folder in it is a clip of many files.
        output: folder of the results.
        method: as of :func:`kcs_torch.reconstruct`.
        suffixes: of the results, such as .npz and .bvh.
        pattern: as of :func:`clips_of`.
        shard: which part of the work to do, from 0: a process, or a machine, each.
        shards: how many parts there are.
        batch: clips that are reconstructed together (:func:`kcs_torch.reconstruct_all`).
        workers: processes that reconstruct them, at most; more than 1 needs joblib. Results are written by one.
        everybody: reconstruct all people of a clip, to NAME_0, NAME_1, ..., not the most seen one alone.
        retry: try clips again that failed, perhaps with other options of reading.
        scale: the true size of every body, ``height=1.75m`` or a bone's; else results are in the unit of the tracks.
        up: the axis that points up in those files that hold results so: y or z.
        pitch: degrees by which the camera looked down (below 0: up), to level results in these files.
        units: as of :func:`kcs_torch.save`.
        intrinsics: of the camera that saw them all, as of :func:`kcs_torch.reconstruct`.
        progress: gets a line every few seconds.
        **reading: options of :func:`kcs_torch.load_tracks`, such as ``fps`` and ``skeleton``; ``skeleton="auto"`` finds
            every body's bones from how its joints move.

    Returns:
        What became of the clips of this part.

    Raises:
        OptionError: an option is out of range, there is nothing to do, or the folder's results were made otherwise.
        SkeletonError: there is no skeleton of that name.
        OutputError: the results cannot be written.
        FormatError: the file that says how they were made is damaged, or that of the skeleton.
    """
    _check_share(shard, shards, batch, {"everybody": everybody, "retry": retry})
    check_workers(workers, [])
    suffixes = _checked_suffixes(suffixes, up, pitch)
    if units not in (None, "px", *METRES):
        raise unknown("unit of length", units, METRES)
    size = None if scale is None else parse_size(scale)
    method = method_named(method, {})
    find = reading.get("skeleton") == "auto"
    how = {name: value for name, value in reading.items() if not (find and name == "skeleton")}
    check_reading(**how)  # type: ignore[arg-type]
    reconstruct_all([], method=method, intrinsics=intrinsics)  # what is wrong with these is so for every clip
    begin = time.monotonic()
    clips = [clip for clip in clips_of(source, output, pattern) if clip.share_of(shards) == shard]
    lens = intrinsics if intrinsics is None or isinstance(intrinsics, str) else Intrinsics.of(intrinsics)
    options = {"scale": scale, "up": up, "pitch": pitch, "units": units, "intrinsics": lens}
    claim(Path(output), settings_of(method, options, reading) | {"everybody": str(everybody)}, retry)
    workplace = Path(output) / f".part_{shard}_of_{shards}"
    _sweep(Path(output), workplace)
    work = _Work(method, suffixes, everybody, workplace, size, up, pitch, units, intrinsics, workers, find, how)
    todo, outdated, failed = _still_to_do(work, clips, retry)
    skipped = len(clips) - len(todo) - len(failed)
    done = frames = 0
    told = begin
    for start in range(0, len(todo), batch):
        made, count, wrong = work.reconstruct(todo[start : start + batch])
        done, frames, failed = done + made, frames + count, failed + wrong
        now, tried = time.monotonic(), min(start + batch, len(todo))
        if progress is not None and (now - told > 5 or tried == len(todo)):
            told, rate = now, tried / max(now - begin, 1e-9)
            progress(
                f"{skipped + done + len(failed)} of {len(clips)} clips, {len(failed)} failed, "
                f"{rate:.1f} clips a second, {(len(todo) - tried) / rate / 60:.1f} minutes left"
            )
    _sweep(Path(output), workplace)
    told_of = tuple(outdated), tuple(work.doubted), tuple(failed)
    return Outcome(len(clips), done, skipped, *told_of, frames, time.monotonic() - begin)


def _check_share(shard: int, shards: int, batch: int, switches: Mapping[str, bool]) -> None:
    """Make sure that the numbers say a part of the work, and that switches are switches."""
    numbers = {"shard": shard, "shards": shards, "batch": batch}
    for kind, given in ((int, numbers), (bool, switches)):
        for name, value in given.items():
            if not is_a(value, kind):
                raise OptionError(f"{name}: expected {spoken(kind)}, got {value!r}")
    if not 0 <= shard < shards:
        raise OptionError(f"shard: expected a number from 0 to {shards - 1} of shards={shards}, got {shard}")
    if batch < 1:
        raise OptionError(f"batch: expected at least 1 clip, got {batch}")


def _checked_suffixes(suffixes: str | Sequence[str], up: str | None, pitch: float | None) -> list[str]:
    """With their dots; all can be written, and one with an axis up, and level, if that is asked for."""
    if up not in (None, *UP):
        raise unknown("axis for up", up, UP)
    if pitch is not None:
        check_pitch(pitch)
    given = [suffixes] if isinstance(suffixes, str) else suffixes
    if not is_a(given, Sequence[str]):
        raise OptionError(f"suffixes: expected a list of some, such as .npz, got {suffixes!r}")
    dotted = [s if s.startswith(".") else f".{s}" for s in given]
    if not dotted:
        raise OptionError("suffixes: expected at least one, such as .npz, got none")
    for suffix in dotted:
        ready_writer(Path(f"NAME{suffix}"))
    asked = [name for name, value in (("up", up), ("pitch", pitch)) if value is not None]
    if asked and not any(takes_up(f"x{suffix}") for suffix in dotted):
        raise OptionError(f"{asked[0]}: none of {', '.join(dotted)} holds results with y or z up")
    return dotted


def _still_to_do(
    work: _Work, clips: Sequence[Clip], retry: bool
) -> tuple[list[Clip], list[Path], list[tuple[Path, str]]]:
    """Clips without results; the sources that are newer than theirs; and those that failed before, and why."""
    todo: list[Clip] = []
    outdated: list[Path] = []
    failed: list[tuple[Path, str]] = []
    for clip in clips:
        results = work.results(clip)
        if results:  # perhaps but those of another call's suffixes, which failed
            outdated += [clip.source] if clip.is_newer_than(results) else []
        elif clip.failure.exists() and not retry:
            failed.append((clip.source, clip.failure.read_text("utf-8", "replace").partition("\n")[0]))
        else:
            todo.append(clip)
    return todo, outdated, failed


@dataclass(frozen=True)
class _Work:
    """What is done to every clip."""

    method: Method
    suffixes: Sequence[str]
    everybody: bool
    workplace: Path
    size: dict[str, Any] | None
    up: str | None
    pitch: float | None
    units: str | None
    intrinsics: Any
    workers: int
    find: bool
    reading: dict[str, object]
    doubted: list[tuple[Path, str]] = field(default_factory=list)

    def results(self, clip: Clip) -> list[Path]:
        """The clip's results if all are there, else none; of everybody's the last written says so."""
        paths: list[Path] = []
        if not self.everybody:
            paths = clip.outputs(self.suffixes)
        else:
            with suppress(OSError, ValueError):
                count = int(clip.people_list.read_text("utf-8"))
                paths = [path for i in range(count) for path in clip.person(i).outputs(self.suffixes)]
        return paths if all(path.exists() for path in paths) else []

    def reconstruct(self, clips: Sequence[Clip]) -> tuple[int, int, list[tuple[Path, str]]]:
        """Reconstruct a batch: clips and frames that were made, and what failed."""
        failed: list[tuple[Path, str]] = []
        read: list[tuple[Clip, list[Tracks]]] = []
        made = frames = 0
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", KcsWarning)  # the results' notes tell them
            for clip in clips:
                with _listing(clip, failed):
                    read.append((clip, self._people(clip)))
            for (clip, people), found in zip(read, self._lift([people for _, people in read]), strict=True):
                with _listing(clip, failed):
                    if isinstance(found, Exception):
                        raise found
                    self._write(clip, found)
                    doubts = [one.diagnostics.brief_doubt for one in found if one.diagnostics.doubt]
                    self.doubted.extend((clip.source, doubt) for doubt in doubts[:1])
                    made, frames = made + 1, frames + people[0].num_frames
        return made, frames, failed

    def _people(self, clip: Clip) -> list[Tracks]:
        people = load_people(clip.source, **self.reading)  # type: ignore[arg-type]
        people = people if self.everybody else [most_seen(people)]
        people = [with_found_bones(one) for one in people] if self.find else people
        if self.size is not None:  # before they are solved in vain
            for one, name in itertools.product(people, set(self.size) - {"units"}):
                check_size(one.skeleton, name, "scale")
        return people

    def _lift(self, clips: Sequence[list[Tracks]]) -> list[list[Reconstruction] | Exception]:
        """Results of each clip's people, or why it fails; if one does, halves of the clips are tried, and so on."""
        people = itertools.chain.from_iterable(clips)
        try:
            found = iter(reconstruct_all(people, method=self.method, intrinsics=self.intrinsics, workers=self.workers))
            return [list(itertools.islice(found, len(one))) for one in clips]
        except Exception as error:
            failed = error
        half = len(clips) // 2  # beside the handler: what fails there is not told of here
        return [*self._lift(clips[:half]), *self._lift(clips[half:])] if half else [failed]

    def _write(self, clip: Clip, results: list[Reconstruction]) -> None:
        """Write all results of a clip, and that they are all."""
        for number, result in enumerate(results):
            target = clip.person(number) if self.everybody else clip
            self._save(result if self.size is None else result.scaled(**self.size), target)
        if self.everybody:
            with atomic_path(clip.people_list) as temporary:
                temporary.write_text(f"{len(results)}\n", encoding="utf-8")
        clip.failure.unlink(missing_ok=True)

    def _save(self, result: Reconstruction, clip: Clip) -> None:
        """Write all files of a result to this part's own folder, then move them to their place.

        What a killed process leaves lies in that folder, and the next one that does this part clears it.
        """
        clip.target.parent.mkdir(parents=True, exist_ok=True)
        for path in clip.outputs(self.suffixes):
            part = self.workplace / path.name
            up, pitch = (self.up, self.pitch) if takes_up(path) else (None, None)
            save(result, part, up=up, pitch=pitch, units=self.units, notes=[])
            os.replace(part, path)


@contextmanager
def _listing(clip: Clip, failed: list[tuple[Path, str]]) -> Iterator[None]:
    """Write down what fails of one clip among thousands; the others go on."""
    try:
        yield
    except Exception as error:
        reason = f"{type(error).__name__}: {error}"
        text = reason if isinstance(error, KcsError) else f"{reason}\n{traceback.format_exc()}"
        with atomic_path(clip.failure) as temporary:
            temporary.write_text(f"{text}\n", encoding="utf-8", errors="replace")
        failed.append((clip.source, reason.partition("\n")[0]))


def _sweep(output: Path, workplace: Path) -> None:
    """Remove what a killed process left: of this part, and of other divisions into parts an hour ago."""
    shutil.rmtree(workplace, ignore_errors=True)
    for folder in output.glob(".part_*_of_*"):
        with suppress(OSError):  # another part, which ends, has removed it
            if time.time() - folder.stat().st_mtime > STALE:
                shutil.rmtree(folder, ignore_errors=True)
