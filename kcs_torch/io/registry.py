"""What a reader and a writer are, and where they are found: one file of ``io/formats`` a family of formats.

A new format is one new file in ``io/formats`` that holds a ``READERS``, ``MOTION_READERS`` or ``WRITERS`` tuple;
nothing changes elsewhere.
"""

from __future__ import annotations

import importlib
import importlib.util
import os
import pkgutil
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Any

from kcs_torch.errors import FormatError, KcsError, listed
from kcs_torch.io.folders import natural_key, sibling_files
from kcs_torch.skeleton import Skeleton
from kcs_torch.types import Tracks
from kcs_torch.types.image_size import told_image_size
from kcs_torch.types.intake import check_rate

if TYPE_CHECKING:
    from kcs_torch.io.containers.hdf5 import Tree
    from kcs_torch.types import Motion, Reconstruction

__all__ = [
    "MotionOptions",
    "MotionReader",
    "Options",
    "Probe",
    "Reader",
    "Saving",
    "Writer",
    "brief",
    "check_fps",
    "discover",
    "discover_motion",
    "need",
    "only_format",
    "read_error",
]

RATE = 30.0  # frames per second of files that need a number where none is known
THRESHOLD = 0.3  # confidence from which on a joint counts as seen
HEAD = 65536  # bytes of a file that a reader may look at to recognise it


@dataclass(frozen=True)
class Options:
    """What a caller may say about a file, handed to every reader.

    Attributes:
        skeleton: a :class:`Skeleton`, a built-in name, or a YAML/JSON file; None: as the file says.
        fps: frames per second; None: as the file says.
        threshold: a joint with less confidence counts as unseen; None: as the file says.
        image_size: width and height of the video in pixels; None: as the file says.
        trust: whether a pickle (VideoPose3D's .npz) may be read; arrays, lists and numbers are taken from it, no code.
    """

    skeleton: str | Path | Skeleton | None = None
    fps: float | None = None
    threshold: float | None = None
    image_size: tuple[int, int] | None = None
    trust: bool = False

    @property
    def least(self) -> float:
        """The threshold of files that say nothing of it."""
        return THRESHOLD if self.threshold is None else self.threshold

    def size_of(self, told: Any) -> tuple[int, int] | None:
        """Width and height of the image where a file tells something of them, or nothing; None where unknown."""
        return self.image_size or told_image_size(told)


@dataclass(frozen=True)
class MotionOptions:
    """What a caller may say about a file of 3D motion, handed to every reader of such.

    Attributes:
        skeleton: a :class:`Skeleton`, a built-in name, or a YAML/JSON file (for AMC also its .asf); None: as the file
            says.
        fps: frames per second; None: as the file says.
        up: which axis of the file points up (see ``Motion.from_arrays``); None: as the file says.
        units: of the file's numbers, in short letters; None: as the file says.
        fill_in: which of ``up`` and ``units`` hold only where the file does not say; the others go before it.
    """

    skeleton: str | Path | Skeleton | None = None
    fps: float | None = None
    up: str | None = None
    units: str | None = None
    fill_in: tuple[str, ...] = ()


class Probe:
    """A path as readers look at it to recognise its format: read once, and little of it.

    Raises:
        FormatError: nothing is there, it cannot be read, or it is empty.
    """

    def __init__(self, path: str | Path) -> None:
        if not isinstance(path, (str, os.PathLike)):
            raise FormatError(f"path: expected the name of a file or folder, got {brief(repr(path))}")
        self.path = Path(path)
        try:
            self.is_file = self.path.is_file()
            self.is_folder = self.path.is_dir()
            if not self.is_file and not self.files:
                if self.is_folder:
                    raise FormatError(f"{path}: expected a folder with tracks, got {_folders(self.path)}")
                if self.path.exists():
                    raise FormatError(f"{path}: expected a file or a folder, got neither")
                raise FormatError(f"{path}: there is no such file or folder")
            if self.is_file and not self.head:
                raise FormatError(f"{path}: expected tracks or motion, got an empty file")
        except (OSError, ValueError) as error:
            if isinstance(error, KcsError):
                raise
            raise read_error(path, error) from None

    @property
    def suffix(self) -> str:
        """The suffix in lower case, with its dot."""
        return self.path.suffix.lower()

    @cached_property
    def head(self) -> bytes:
        """The first 64 KiB of a file; nothing of a folder."""
        if not self.is_file:
            return b""
        with self.path.open("rb") as file:
            return file.read(HEAD)

    @cached_property
    def text(self) -> str:
        """The head as text; what is none shows as such."""
        return self.head.decode("utf-8", "replace")

    @cached_property
    def files(self) -> tuple[Path, ...]:
        """The files of a folder in natural order, or those whose names begin like, or match, a path that is none."""
        return () if self.is_file else tuple(sibling_files(self.path))

    @cached_property
    def hdf5(self) -> Tree | None:
        """What is in an HDF5 file, but its numbers; None of other files, and of those that cannot be read."""
        if not self.head.startswith(b"\x89HDF"):
            return None
        from kcs_torch.io.containers.hdf5 import read_tree

        try:
            return read_tree(self.path, ())
        except FormatError:
            return None

    def like(self, suffix: str) -> tuple[Path, ...]:
        """The files of a folder that have a suffix."""
        return tuple(f for f in self.files if f.suffix.lower() == suffix)


@dataclass(frozen=True)
class Reader:
    """A format that tracks come in.

    Attributes:
        name: what ``format=`` calls it.
        summary: one line for lists of formats.
        recognises: tells from a :class:`Probe`, by content and cheaply, whether the path is of this format.
        read: reads the tracks of everybody in it, in any order.
    """

    name: str
    summary: str
    recognises: Callable[[Probe], bool]
    read: Callable[[Path, Options], list[Tracks]]


@dataclass(frozen=True)
class MotionReader:
    """A format that 3D motion comes in.

    Attributes:
        name: what ``format=`` calls it.
        summary: one line for lists of formats.
        recognises: tells from a :class:`Probe`, by content and cheaply, whether the path is of this format.
        read: reads the motion of one body.
        holds: tells whether a path that is said to be of this format holds motion, where its name is also one of 2D
            tracks; as it recognises if None.
    """

    name: str
    summary: str
    recognises: Callable[[Probe], bool]
    read: Callable[[Path, MotionOptions], Motion]
    holds: Callable[[Probe], bool] | None = None


@dataclass(frozen=True)
class Saving:
    """How a motion is to be written, and what is to be said of it afterwards.

    Attributes:
        up: which axis is to point up in the file: y or z.
        name: of the file, which writers see under a temporary one.
        notes: sentences for the user; writers add to them.
        warnings: what the user has to know; writers add to them.
    """

    up: str = "y"
    name: str = ""
    notes: list[str] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)

    def told_names(self, names: Sequence[str], written: Sequence[str]) -> None:
        """Note which joints have other names in the file."""
        changed = [f"'{ours}' is '{theirs}'" for ours, theirs in zip(names, written, strict=True) if ours != theirs]
        if changed:
            self.notes.append(f"joints are named otherwise in the file: {listed(changed, 5)}")

    def rate(self, motion: Motion) -> float:
        """Frames per second of a file that cannot do without."""
        if motion.fps is None:
            self.warnings.append(f"the frame rate is not known: {RATE:g} is written; say which with fps=... or --fps")
            return RATE
        return motion.fps


@dataclass(frozen=True)
class Writer:
    """A format that results, motion or tracks go out in; :func:`kcs_torch.save` makes files appear whole or not at all.

    Attributes:
        suffix: of the file, with its dot; it chooses the writer.
        summary: one line for lists of formats.
        write: writes a result, in the camera's axes; None: as motion.
        write_motion: writes motion, y up; None: it cannot be written.
        write_tracks: writes tracks; None: they cannot be written.
        write_people: writes the results of several people of one clip to one file; None: it takes one only.
        unit: of length that files of this kind are usually in; empty: motion keeps its own.
        names_unit: whether a file says in which unit it is, so that motion has to have one.
        turns: whether a result is written as motion if the user says which axis shall point up.
        fits: raises an OutputError unless motion of a skeleton can be written; None: any can.
        ready: raises an OutputError unless the package or the program is there that it needs; None: it needs none.
    """

    suffix: str
    summary: str
    write: Callable[[Reconstruction, Path], None] | None = None
    write_motion: Callable[[Motion, Path, Saving], None] | None = None
    write_tracks: Callable[[Tracks, Path], None] | None = None
    write_people: Callable[[Sequence[Reconstruction], Path], None] | None = None
    unit: str = ""
    names_unit: bool = False
    turns: bool = False
    fits: Callable[[Skeleton], object] | None = None
    ready: Callable[[], object] | None = None


def discover() -> tuple[Mapping[str, Reader], Mapping[str, Writer]]:
    """Collect the readers by name and the writers by suffix from every file of ``io/formats``."""
    found = _modules()
    readers: Iterable[Reader] = (r for module in found for r in getattr(module, "READERS", ()))
    writers: Iterable[Writer] = (w for module in found for w in getattr(module, "WRITERS", ()))
    return (
        {r.name: r for r in sorted(readers, key=lambda r: natural_key(r.name))},
        {w.suffix: w for w in sorted(writers, key=lambda w: natural_key(w.suffix))},
    )


def discover_motion() -> Mapping[str, MotionReader]:
    """Collect the readers of 3D motion by name from every file of ``io/formats``."""
    readers: Iterable[MotionReader] = (r for module in _modules() for r in getattr(module, "MOTION_READERS", ()))
    return {r.name: r for r in sorted(readers, key=lambda r: natural_key(r.name))}


def _modules() -> list[ModuleType]:
    from kcs_torch.io import formats

    return [importlib.import_module(f"{formats.__name__}.{m.name}") for m in pkgutil.iter_modules(formats.__path__)]


def only_format(readers: Mapping[str, Reader] | Mapping[str, MotionReader], probe: Probe) -> str | None:
    """The name of the reader that recognises a path; None if none does.

    Raises:
        FormatError: several do.
    """
    found = [reader.name for reader in readers.values() if reader.recognises(probe)]
    if len(found) > 1:
        raise FormatError(f"{probe.path}: may be {' or '.join(found)}: say which with format=...")
    return found[0] if found else None


def need(package: str, what: str, error: type[KcsError]) -> ModuleType:
    """Import a package that only one format needs.

    Args:
        package: what to import.
        what: the path, for the message.
        error: the class to raise.

    Raises:
        KcsError: it is not installed; the message says how to install it.
    """
    try:
        return importlib.import_module(package)
    except ImportError as reason:
        name = package.partition(".")[0]
        raise error(f"{what}: needs the package {name} ({reason}): pip install {name}") from None


def _folders(path: Path) -> str:
    """What a folder without files is, in words."""
    names = sorted((f.name for f in path.iterdir() if f.is_dir() and not f.name.startswith(".")), key=natural_key)
    if not names:
        return "an empty one"
    return f"one that holds only folders ({listed(names, 5)}): give one of them, such as {path / names[0]}"


def brief(value: Any) -> str:
    """A text from a file as a message shows it: cut where it is long, halves of characters escaped."""
    text = str(value).encode("utf-8", "backslashreplace").decode()
    return text if len(text) <= 100 else f"{text[:96]} ..."


def check_fps(fps: float | None) -> None:
    """Make sure that the rate that a caller gives is one.

    Raises:
        OptionError: it is out of range.
    """
    if fps is not None:
        check_rate(fps, "fps (--fps)", "; leave it out where it is not known")


def read_error(path: Any, error: BaseException) -> FormatError:
    """The error for a path that the system does not let us read."""
    reason = getattr(error, "strerror", None) or error
    return FormatError(f"{path}: cannot be read: {reason}")
