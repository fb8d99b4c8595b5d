"""Read the arrays of an .npz file that nobody vouches for: no pickle, no bomb, no crash."""

from __future__ import annotations

import math
import sys
import zipfile
from pathlib import Path
from typing import Any, BinaryIO, cast

import numpy as np
from numpy.typing import NDArray

from kcs_torch.errors import FormatError
from kcs_torch.io.containers.jsonfile import as_text
from kcs_torch.io.containers.pickles import load_arrays
from kcs_torch.io.registry import read_error

__all__ = ["Archive", "array_names"]

LIMIT = 4 * 2**30  # bytes of one file's arrays, unpacked
RATIO = 200  # unpacked over packed bytes, above which a large array is no measurement
LARGE = 256 * 2**20
NONE = 512  # bytes of a pickled None, with the header that numpy writes, at most


def array_names(path: Path) -> set[str]:
    """Names of the arrays of an .npz file; nothing where it cannot be read."""
    try:
        with zipfile.ZipFile(path) as archive:
            return {name.removesuffix(".npy") for name in archive.namelist() if name.endswith(".npy")}
    except Exception:  # zipfile raises many kinds on damaged files
        return set()


class Archive:
    """The arrays of an .npz file, each read when asked for.

    Raises:
        FormatError: the file is no zip archive, is cut short, or unpacks to more than 4 GiB.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        try:
            with zipfile.ZipFile(path) as archive:
                members = archive.infolist()
        except OSError as error:
            raise read_error(path, error) from None
        except Exception as error:  # zipfile raises many kinds on damaged files
            raise FormatError(
                f"{path}: expected an .npz archive, got a damaged or truncated one: {as_text(error)}"
            ) from None
        self.members = {m.filename.removesuffix(".npy"): m for m in members if m.filename.endswith(".npy")}
        for key, member in self.members.items():
            packed = max(member.compress_size, 1)
            if member.file_size > LIMIT or (member.file_size > LARGE and member.file_size > RATIO * packed):
                raise FormatError(
                    f"{path}: '{key}' unpacks from {packed} to {member.file_size} bytes: refused as a zip bomb; "
                    "save it with np.savez if it is genuine"
                )
        if sum(m.file_size for m in self.members.values()) > LIMIT:
            raise FormatError(f"{path}: its arrays unpack to more than {LIMIT // 2**30} GiB: refused; split the file")

    def __contains__(self, key: str) -> bool:
        """Whether there is such an array: None, which numpy writes as a pickle, is none."""
        return key in self.members and not (self.members[key].file_size <= NONE and self._is_none(key))

    @property
    def keys(self) -> list[str]:
        """Names of the arrays."""
        return list(self.members)

    def array(self, key: str, kinds: str, ndim: int | None = None) -> NDArray[Any]:
        """Read one array.

        Args:
            key: its name.
            kinds: the numpy kinds to admit: "f" floats, "iu" integers, "US" text, "b" truth values.
            ndim: how many dimensions it must have; any if None.

        Raises:
            FormatError: it is missing, damaged, of another kind or shape, or holds pickled objects.
        """
        if key not in self.members:
            raise FormatError(f"{self.path}: expected an array '{key}', got {', '.join(self.keys) or 'none'}")
        try:
            array = self._read(key)
        except FormatError:
            raise
        except OSError as error:
            raise read_error(f"{self.path}: '{key}'", error) from None
        except Exception as error:  # zipfile, zlib and numpy raise many kinds on damaged files
            raise FormatError(f"{self.path}: '{key}' is damaged or truncated: {as_text(error)}") from None
        if array.dtype.kind not in kinds:
            raise FormatError(f"{self.path}: '{key}': expected {_say(kinds)}, got an array of {array.dtype}")
        if array.dtype.kind == "U" and _beyond_unicode(array):
            raise FormatError(f"{self.path}: '{key}' is damaged: it holds letters that there are none of")
        if ndim is not None and array.ndim != ndim:
            raise FormatError(f"{self.path}: '{key}': expected {ndim} dimensions, got shape {array.shape}")
        return array

    def number(self, key: str) -> float:
        """Read one number. Raises as :meth:`array`."""
        return float(self._single(key, "fiu"))

    def text(self, key: str) -> str:
        """Read one string. Raises as :meth:`array`."""
        return _decode(self._single(key, "US"))

    def texts(self, key: str) -> list[str]:
        """Read a list of strings. Raises as :meth:`array`."""
        return [_decode(v) for v in self.array(key, "US", 1)]

    def objects(self, key: str) -> Any:
        """Unpickle one array of objects, a nest of arrays, lists, mappings, numbers and texts: see ``pickles.py``.

        Raises:
            FormatError: it is missing or damaged, holds no objects, or asks for anything else.
        """
        what = f"{self.path}: '{key}'"
        if key not in self.members:
            raise FormatError(f"{self.path}: expected an array '{key}', got {', '.join(self.keys) or 'none'}")
        try:
            with zipfile.ZipFile(self.path) as archive, archive.open(self.members[key]) as stream:
                file = cast(BinaryIO, stream)
                _, dtype = _header(file)
                if not dtype.hasobject:
                    raise FormatError(f"{what}: expected pickled objects, got an array of {dtype}")
                found = load_arrays(file, what)
        except FormatError:
            raise
        except OSError as error:
            raise read_error(what, error) from None
        except Exception as error:  # zipfile, zlib and numpy raise many kinds on damaged files
            raise FormatError(f"{what} is damaged or truncated: {as_text(error)}") from None
        return found

    def _is_none(self, key: str) -> bool:
        try:
            return self.objects(key) is None
        except FormatError:  # no objects, or damaged ones
            return False

    def _single(self, key: str, kinds: str) -> Any:
        array = self.array(key, kinds)
        if array.size != 1:
            raise FormatError(f"{self.path}: '{key}': expected one value, got shape {array.shape}")
        return array.reshape(-1)[0]

    def _read(self, key: str) -> NDArray[Any]:
        member = self.members[key]
        with zipfile.ZipFile(self.path) as archive:
            with archive.open(member) as stream:
                file = cast(BinaryIO, stream)
                shape, dtype = _header(file)
                start = stream.tell()
            if dtype.hasobject:
                raise FormatError(
                    f"{self.path}: '{key}' holds pickled objects, which could run code: refused; write it as an array "
                    "of numbers, or of text, without None in it"
                )
            # Before numpy reserves what the header claims.
            if math.prod(shape) * dtype.itemsize != member.file_size - start:
                raise FormatError(f"{self.path}: '{key}': its size does not fit its shape {shape} of {dtype}")
            with archive.open(member) as stream:
                return np.lib.format.read_array(cast(BinaryIO, stream), allow_pickle=False)


def _header(file: BinaryIO) -> tuple[tuple[int, ...], np.dtype[Any]]:
    """Shape and type of an array."""
    # Versions above 2 are for arrays of records, which no file of ours holds.
    new = np.lib.format.read_magic(file) > (1, 0)
    header = np.lib.format.read_array_header_2_0 if new else np.lib.format.read_array_header_1_0
    shape, _, dtype = header(file)
    return shape, dtype


def _beyond_unicode(texts: NDArray[Any]) -> bool:
    """Whether numbers of letters are too large: Python would fail on such a text, or show what is beside it."""
    letters = np.frombuffer(texts.tobytes(), np.dtype("u4").newbyteorder(texts.dtype.byteorder))
    return bool((letters > sys.maxunicode).any())


def _decode(value: Any) -> str:
    return value.decode("utf-8", "replace") if isinstance(value, bytes) else str(value)


def _say(kinds: str) -> str:
    names = {"f": "floating-point numbers", "i": "integers", "U": "text", "b": "truth values"}
    return " or ".join(names[k] for k in kinds if k in names)
