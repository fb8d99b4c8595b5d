"""What a reader and a writer are, and where they are found: one file of ``io/formats`` a family of formats.

A new format is one new file in ``io/formats`` that holds a ``READERS`` or a ``WRITERS`` tuple; nothing else changes.
"""

from __future__ import annotations

import importlib
import importlib.util
import pkgutil
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Any

from kcs_torch.errors import FormatError, KcsError
from kcs_torch.io.folders import natural_key, sibling_files
from kcs_torch.skeleton import Skeleton
from kcs_torch.types import Tracks

if TYPE_CHECKING:
    from kcs_torch.types import Reconstruction

__all__ = ["Options", "Probe", "Reader", "Writer", "discover", "need", "read_error"]

HEAD = 65536  # bytes of a file that a reader may look at to recognise it


@dataclass(frozen=True)
class Options:
    """What a caller may say about a file, handed to every reader.

    Attributes:
        skeleton: a :class:`Skeleton`, a built-in name, or a YAML/JSON file; None: as the file says.
        fps: frames per second; None: as the file says.
        threshold: a joint with less confidence counts as unseen.
        image_size: width and height of the video in pixels, for formats whose coordinates are shares of it.
        trust: whether a file that can only be read by unpickling may be; it can then run any code.
    """

    skeleton: str | Path | Skeleton | None = None
    fps: float | None = None
    threshold: float = 0.3
    image_size: tuple[int, int] | None = None
    trust: bool = False


class Probe:
    """A path as readers look at it to recognise its format: read once, and little of it.

    Raises:
        FormatError: nothing is there, it cannot be read, or it is empty.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        try:
            self.is_file = self.path.is_file()
            self.is_folder = self.path.is_dir()
            if not self.is_file and not self.files:
                if self.is_folder:
                    raise FormatError(f"{path}: expected a folder with tracks, got an empty one")
                if self.path.exists():
                    raise FormatError(f"{path}: expected a file or a folder, got neither")
                raise FormatError(f"{path}: there is no such file or folder")
            if self.is_file and not self.head:
                raise FormatError(f"{path}: expected tracks, got an empty file")
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
    def files(self) -> tuple[Path, ...]:
        """The files of a folder in natural order, or those whose names begin like, or match, a path that is none."""
        return () if self.is_file else tuple(sibling_files(self.path))

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
class Writer:
    """A format that results go out in.

    Attributes:
        suffix: of the file, with its dot; it chooses the writer.
        summary: one line for lists of formats.
        write: writes a result to a path; :func:`kcs_torch.save` sees to it that the file appears whole or not at all.
    """

    suffix: str
    summary: str
    write: Callable[[Reconstruction, Path], None]


def discover() -> tuple[Mapping[str, Reader], Mapping[str, Writer]]:
    """Collect the readers by name and the writers by suffix from every file of ``io/formats``."""
    from kcs_torch.io import formats

    found = [importlib.import_module(f"{formats.__name__}.{m.name}") for m in pkgutil.iter_modules(formats.__path__)]
    readers: Iterable[Reader] = (r for module in found for r in getattr(module, "READERS", ()))
    writers: Iterable[Writer] = (w for module in found for w in getattr(module, "WRITERS", ()))
    return (
        {r.name: r for r in sorted(readers, key=lambda r: natural_key(r.name))},
        {w.suffix: w for w in sorted(writers, key=lambda w: natural_key(w.suffix))},
    )


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


def read_error(path: Any, error: BaseException) -> FormatError:
    """The error for a path that the system does not let us read."""
    reason = getattr(error, "strerror", None) or error
    return FormatError(f"{path}: cannot be read: {reason}")
