"""Thousands of clips: a folder of tracks to a folder of motion, in parts that can be stopped and taken up again."""

from __future__ import annotations

import dataclasses
import inspect
import itertools
import json
import os
import re
import secrets
import shutil
import time
import traceback
import warnings
import zlib
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch

from kcs_torch.errors import FormatError, KcsError, KcsWarning, OptionError, OutputError, unknown
from kcs_torch.io.atomic import atomic_path
from kcs_torch.io.folders import natural_key
from kcs_torch.io.load import load_people
from kcs_torch.io.write import ready_writer, save, takes_up
from kcs_torch.methods.base import Method
from kcs_torch.reconstruct import method_named, reconstruct_all, with_found_bones
from kcs_torch.types import Intrinsics, Reconstruction, Tracks
from kcs_torch.types.size import parse_size

__all__ = ["Clip", "Outcome", "clips_of", "reconstruct_folder"]

FAILED = ".failed.txt"
"""Suffix of the file that stands in for the results of a clip that failed, and says why."""

MADE_BY = ".made_by.json"
"""File of the output folder that says by which settings its results were made."""

_READING = [name for name in inspect.signature(load_people).parameters if name != "path"]

STALE = 3600.0
"""Seconds after which another part's folder was left by a process that was killed."""


@dataclass(frozen=True)
class Clip:
    """One clip's tracks, and where its results go.

    Attributes:
        source: a file, or a folder of files that make one clip.
        target: of the results, without their suffixes.
        name: of the source within the folder of all clips.
    """

    source: Path
    target: Path
    name: str

    def outputs(self, suffixes: Sequence[str]) -> list[Path]:
        """The files of its results."""
        return [self.target.with_name(self.target.name + suffix) for suffix in suffixes]

    @property
    def failure(self) -> Path:
        """The file that says why it failed."""
        return self.target.with_name(self.target.name + FAILED)

    def share_of(self, shards: int) -> int:
        """Which of so many parts of the work it belongs to: told by its name alone, the same on every machine."""
        return zlib.crc32(self.name.encode("utf-8", "surrogateescape")) % shards


@dataclass(frozen=True)
class Outcome:
    """How the clips of one part of the work ended.

    Attributes:
        clips: how many there are.
        done: made now.
        skipped: made before.
        failed: each clip that failed, now or before, and why.
        frames: of the clips made now.
        seconds: that it took.
    """

    clips: int
    done: int
    skipped: int
    failed: tuple[tuple[Path, str], ...]
    frames: int
    seconds: float


def clips_of(source: str | Path, output: str | Path, pattern: str = "*") -> list[Clip]:
    """List the clips of a folder in natural order.

    Args:
        source: the folder.
        output: of the results: a clip ``a/b.json`` becomes ``OUTPUT/a/b.json.npz``, or ``OUTPUT/a/b.npz`` where that is
            no other clip's.
        pattern: of clips within the folder; ``**/*.json`` looks into folders, ``*`` takes files, and folders as clips.

    Raises:
        OptionError: the folder is none, lies in the output, or holds nothing of the pattern.
    """
    folder, output = Path(source), Path(output)
    if not folder.is_dir():
        raise OptionError(f"{folder}: expected a folder of tracks, got {'a file' if folder.exists() else 'nothing'}")
    inside = output.resolve()
    try:
        found = [
            p for p in folder.glob(pattern) if not any(part.startswith(".") for part in p.relative_to(folder).parts)
        ]
    except (ValueError, NotImplementedError) as error:
        raise OptionError(f"pattern: expected one such as *.json or **/*.npz, got {pattern!r} ({error})") from None
    found = [p for p in found if p.resolve() != inside and inside not in p.resolve().parents]
    if not found:
        raise OptionError(f"{folder}: expected tracks that match {pattern!r}, found none")
    found.sort(key=lambda p: natural_key(str(p)))
    names = [p.relative_to(folder) for p in found]
    short = [n.with_suffix("") for n in names]
    counts = Counter(short)
    pairs = zip(found, names, short, strict=True)
    return [
        Clip(path, output / (brief if counts[brief] == 1 else name), name.as_posix()) for path, name, brief in pairs
    ]


def reconstruct_folder(
    source: str | Path,
    output: str | Path,
    *,
    method: str | Method = "auto",
    suffixes: Sequence[str] = (".npz",),
    pattern: str = "*",
    shard: int = 0,
    shards: int = 1,
    batch: int = 16,
    everybody: bool = False,
    retry: bool = False,
    scale: str | None = None,
    up: str | None = None,
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
        everybody: reconstruct all people of a clip, to NAME_0, NAME_1, ..., not the most seen one alone.
        retry: try clips again that failed, perhaps with other options of reading.
        scale: the true size of every body, ``height=1.75m`` or a bone's; else results are in the unit of the tracks.
        up: the axis that points up in those files that hold results so: y or z.
        units: as of :func:`kcs_torch.save`.
        intrinsics: of the camera that saw them all, as of :func:`kcs_torch.reconstruct`.
        progress: gets a line every few seconds.
        **reading: options of :func:`kcs_torch.load_tracks`, such as ``fps`` and ``skeleton``; ``skeleton="auto"`` finds
            every body's bones from how its joints move.

    Returns:
        What became of the clips of this part.

    Raises:
        OptionError: an option is out of range, there is nothing to do, or the folder's results were made otherwise.
        OutputError: the results cannot be written.
        FormatError: the file that says how they were made is damaged.
    """
    if not 0 <= shard < shards:
        raise OptionError(f"shard: expected a number from 0 to {shards - 1} of shards={shards}, got {shard}")
    if batch < 1:
        raise OptionError(f"batch: expected at least 1 clip, got {batch}")
    suffixes = [s if s.startswith(".") else f".{s}" for s in suffixes]
    for suffix in suffixes:
        ready_writer(Path(f"NAME{suffix}"))
    for name in reading:
        if name not in _READING:
            raise unknown("reading option", name, _READING)
    if up is not None and not any(takes_up(Path(f"x{suffix}")) for suffix in suffixes):
        raise OptionError(f"up: none of {', '.join(suffixes)} holds results with y or z up")
    size = None if scale is None else parse_size(scale)
    method = method_named(method, {})
    reconstruct_all([], method=method, intrinsics=intrinsics)  # what is wrong with these is so for every clip
    begin = time.monotonic()
    clips = [clip for clip in clips_of(source, output, pattern) if clip.share_of(shards) == shard]
    lens = intrinsics if intrinsics is None or isinstance(intrinsics, str) else Intrinsics.of(intrinsics)
    options = {"scale": scale, "up": up, "units": units, "intrinsics": lens}
    _claim(Path(output), _settings(method, options, reading) | {"everybody": str(everybody)}, retry)
    workplace = Path(output) / f".part_{shard}_of_{shards}"
    _sweep(Path(output), workplace)
    find = reading.get("skeleton") == "auto"
    if find:
        del reading["skeleton"]
    work = _Work(method, suffixes, everybody, workplace, size, up, units, intrinsics, find, reading)
    todo, skipped, failed = [], 0, []
    for clip in clips:
        if work.is_done(clip):  # perhaps but those of another call's suffixes, which failed
            skipped += 1
        elif clip.failure.exists() and not retry:
            failed.append((clip.source, clip.failure.read_text("utf-8", "replace").partition("\n")[0]))
        else:
            todo.append(clip)
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
    return Outcome(len(clips), done, skipped, tuple(failed), frames, time.monotonic() - begin)


@dataclass(frozen=True)
class _Work:
    """What is done to every clip."""

    method: Method
    suffixes: Sequence[str]
    everybody: bool
    workplace: Path
    size: dict[str, Any] | None
    up: str | None
    units: str | None
    intrinsics: Any
    find: bool
    reading: dict[str, object]

    def is_done(self, clip: Clip) -> bool:
        """Whether all results are there; of everybody's the last written says so."""
        if not self.everybody:
            return all(path.exists() for path in clip.outputs(self.suffixes))
        with suppress(OSError, ValueError):
            count = int(_people_list(clip).read_text("utf-8"))
            paths = (path for i in range(count) for path in _person(clip, i).outputs(self.suffixes))
            return all(path.exists() for path in paths)
        return False

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
            try:
                found = iter(self._lift([one for _, people in read for one in people]))
            except Exception:  # one of them is to blame: each for itself
                found = None
            for clip, people in read:
                own = None if found is None else list(itertools.islice(found, len(people)))
                with _listing(clip, failed):
                    self._write(clip, self._lift(people) if own is None else own)
                    made, frames = made + 1, frames + people[0].num_frames
        return made, frames, failed

    def _people(self, clip: Clip) -> list[Tracks]:
        people = load_people(clip.source, **self.reading)  # type: ignore[arg-type]
        people = people if self.everybody else people[:1]
        return [with_found_bones(one) for one in people] if self.find else people

    def _lift(self, people: list[Tracks]) -> list[Reconstruction]:
        return reconstruct_all(people, method=self.method, intrinsics=self.intrinsics)

    def _write(self, clip: Clip, results: list[Reconstruction]) -> None:
        """Write all results of a clip, and that they are all."""
        for number, result in enumerate(results):
            target = _person(clip, number) if self.everybody else clip
            self._save(result if self.size is None else result.scaled(**self.size), target)
        if self.everybody:
            with atomic_path(_people_list(clip)) as temporary:
                temporary.write_text(f"{len(results)}\n", encoding="utf-8")
        clip.failure.unlink(missing_ok=True)

    def _save(self, result: Reconstruction, clip: Clip) -> None:
        """Write all files of a result to this part's own folder, then move them to their place.

        What a killed process leaves lies in that folder, and the next one that does this part clears it.
        """
        clip.target.parent.mkdir(parents=True, exist_ok=True)
        for path in clip.outputs(self.suffixes):
            part = self.workplace / path.name
            save(result, part, up=self.up if takes_up(path) else None, units=self.units, notes=[])
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


def _settings(method: Method, options: Mapping[str, object], reading: Mapping[str, object]) -> dict[str, str]:
    """What results depend on, as text that is the same in every process."""
    values = {"method": method.name}
    values |= {f"method.{f.name}": _as_text(getattr(method, f.name)) for f in dataclasses.fields(method)}
    values |= {name: _as_text(value) for name, value in options.items() if value is not None}
    return values | {f"reading.{name}": _as_text(value) for name, value in reading.items() if value is not None}


def _as_text(value: object) -> str:
    if isinstance(value, torch.nn.Module):
        weights = [t.detach().cpu().contiguous().reshape(-1).view(torch.uint8) for t in value.state_dict().values()]
        return f"{type(value).__name__} {zlib.crc32(b''.join(w.numpy().tobytes() for w in weights)):08x}"
    return value if isinstance(value, str) else re.sub(r" at 0x[0-9a-f]+", "", repr(value))


def _claim(output: Path, settings: dict[str, str], retry: bool) -> None:
    """Write down how an output folder's results are made, once; all parts of the work have to agree.

    Raises:
        OptionError: others were made otherwise; what failed may be read otherwise than the rest.
        OutputError: the folder cannot be written to.
        FormatError: what is written there is damaged.
    """
    record = output / MADE_BY
    temporary = output / f".{secrets.token_hex(4)}.json"
    try:
        output.mkdir(parents=True, exist_ok=True)
        temporary.write_text(json.dumps(settings, indent=1), encoding="utf-8")
        try:
            os.link(temporary, record)  # of several processes that begin, one is the first
        except FileExistsError:
            pass
        except OSError:  # a file system without links
            if not record.exists():
                os.replace(temporary, record)
        own = dict(json.loads(record.read_bytes()))
    except OSError as error:
        raise OutputError(f"{output}: cannot be written: {error.strerror or error}") from None
    except (ValueError, TypeError) as error:
        raise FormatError(f"{record}: damaged: {error}: remove it, if the folder's results may stay") from None
    finally:
        with suppress(OSError):
            temporary.unlink(missing_ok=True)
    other = [name for name in {**own, **settings} if own.get(name) != settings.get(name)]
    if own.get("method") != settings["method"]:
        other = ["method"]
    elif retry:
        other = [name for name in other if not name.startswith("reading.")]
    if other:
        was, now = (", ".join(f"{n}={str(s.get(n))[:60]}" for n in other[:4]) for s in (own, settings))
        again = ", or retry, which tries those clips alone that failed" if other[0].startswith("reading.") else ""
        raise OptionError(
            f"{output}: holds results of {was}, got {now}: give another output folder, or remove this one{again}"
        )


def _person(clip: Clip, number: int) -> Clip:
    return replace(clip, target=clip.target.with_name(f"{clip.target.name}_{number}"))


def _people_list(clip: Clip) -> Path:
    """Written last of all people's results; holds how many there are."""
    return clip.target.with_name(f"{clip.target.name}.people.txt")


def _sweep(output: Path, workplace: Path) -> None:
    """Remove what a killed process left: of this part, and of other divisions into parts an hour ago."""
    old = [p for p in output.glob(".part_*_of_*") if time.time() - p.stat().st_mtime > STALE]
    for folder in (workplace, *old):
        shutil.rmtree(folder, ignore_errors=True)
