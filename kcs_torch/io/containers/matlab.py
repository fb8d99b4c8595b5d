"""Read real arrays of a MATLAB file, versions 4 to 7, that nobody vouches for: no crash, no bomb.

Each tag is checked before anything follows it. Libraries that follow the tags of a damaged file in C crash on some.
Of variables that are not wanted only the name and the shape are read.
"""

from __future__ import annotations

import math
import os
import struct
import zlib
from collections.abc import Callable, Collection, Iterator
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import numpy as np
from numpy.typing import NDArray

from kcs_torch.errors import FormatError
from kcs_torch.io.containers.archive import LARGE, RATIO
from kcs_torch.io.registry import read_error

__all__ = ["read_matlab"]

_HEADER = 128  # bytes before the first variable in version 5
_START = 4096  # unpacked bytes of a variable that hold what comes before its numbers
_MATRIX, _COMPRESSED, _INT8, _INT32, _UINT32, _UTF8 = 14, 15, 1, 5, 6, 16
_NUMBERS = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 9: "f8", 12: "i8", 13: "u8"}
_NUMBERS_4 = ("f8", "f4", "i4", "i2", "u2", "u1")
_OTHERS = {1: "a cell", 2: "a struct", 3: "an object", 4: "text", 5: "sparse ones", 16: "a function", 17: "an object"}
_OPAQUE = 17
_FLOATS = (6, 7)
_INTEGERS = {8: 1, 9: 1, 10: 2, 11: 2, 12: 4, 13: 4, 14: 8, 15: 8}  # class: bytes of a number


class _Damaged(Exception):
    """Says what was expected, and what was found."""


class _Variable(NamedTuple):
    """A variable: its name and shape, what it is unless an array of real numbers, and how to read these."""

    name: str
    shape: tuple[int, ...]
    other: str
    numbers: Callable[[], NDArray[Any]]


def read_matlab(
    path: Path, wanted: Collection[str], limit: int
) -> tuple[dict[str, tuple[int, ...]], dict[str, NDArray[Any]]]:
    """Read the shapes of all variables, and those variables that are wanted.

    Args:
        path: the file.
        wanted: names of variables, which have to be arrays of real numbers.
        limit: how many numbers each of them may have.

    Returns:
        Shapes and arrays by name.

    Raises:
        FormatError: the file cannot be read or is damaged, or a wanted variable is not real or too large.
    """
    shapes: dict[str, tuple[int, ...]] = {}
    values: dict[str, NDArray[Any]] = {}
    try:
        with path.open("rb") as file:
            for name, shape, other, numbers in _variables(file):
                if name in wanted and name in shapes:
                    raise _Damaged(f"one '{name}', got two")
                shapes[name] = shape
                if name in wanted and other:
                    raise FormatError(f"{path}: '{name}': expected real numbers, got {other}")
                if name in wanted and math.prod(max(d, 1) for d in shape) > limit:
                    raise FormatError(f"{path}: '{name}': {shape} are more numbers than a file of tracks holds")
                if name in wanted:
                    values[name] = numbers()
    except _Damaged as error:
        raise FormatError(f"{path}: damaged or truncated, or no MATLAB .mat file: expected {error}") from None
    except OSError as error:
        raise read_error(path, error) from None
    return shapes, values


def _variables(file: BinaryIO) -> Iterator[_Variable]:
    """The variables one after the other; the numbers of each can be read until the next is asked for."""
    head, end = file.read(_HEADER), file.seek(0, os.SEEK_END)
    new = len(head) == _HEADER and head[126:] in (b"IM", b"MI") and 0 not in head[:4]
    order = "<" if head[126:] == b"IM" else ">"
    if new and struct.unpack(order + "H", head[124:126]) != (0x0100,):
        raise _Damaged(f"version 1.0, or HDF5, got {head[124:126]!r} in the header")
    at = _HEADER if new else 0
    while at < end:
        file.seek(at)
        try:
            variable, at = _variable_5(file, at, end, order) if new else _variable_4(file, at, end)
        except _Damaged as error:
            raise _Damaged(f"{error} in the variable at byte {at}") from None
        yield variable


def _variable_5(file: BinaryIO, at: int, end: int, order: str) -> tuple[_Variable, int]:
    """The variable of versions 5 to 7 at a byte, and where the next begins."""
    kind, size = struct.unpack(order + "II", _exactly(file, 8))
    if kind not in (_MATRIX, _COMPRESSED) or not 0 < size <= end - at - 8:
        raise _Damaged(f"an array of 1 to {end - at - 8} bytes, got type {kind} of {size} bytes")
    packed = size if kind == _COMPRESSED else 0
    file.seek(at + 8 if packed else at)
    start = _unpacked(file, packed, _START)
    inner, inside = struct.unpack_from(order + "II", start) if len(start) >= 8 else (0, 0)
    if inner != _MATRIX:
        raise _Damaged(f"an array, got type {inner}")
    start = start[: 8 + inside]
    kind, flags, place = _element(start, 8, order)
    if kind != _UINT32 or len(flags) != 8:
        raise _Damaged(f"8 bytes of array flags, got {len(flags)} of type {kind}")
    (flag,) = struct.unpack_from(order + "I", flags)
    form = flag & 0xFF
    shape: tuple[int, ...] = ()
    if form not in _OTHERS and form not in _FLOATS and form not in _INTEGERS:
        raise _Damaged(f"an array class from 1 to 17, got {form}")
    if form != _OPAQUE:  # which has no dimensions
        kind, dims, place = _element(start, place, order)
        if kind not in (_INT32, _UINT32) or not 4 <= len(dims) <= 4 * 32 or len(dims) % 4:
            raise _Damaged(f"1 to 32 dimensions, got {len(dims)} bytes of type {kind}")
        shape = struct.unpack(f"{order}{len(dims) // 4}i", dims)
    if min(shape, default=0) < 0:
        raise _Damaged(f"dimensions from 0, got {shape}")
    kind, name, place = _element(start, place, order)
    if kind not in (_INT8, _UTF8):
        raise _Damaged(f"a name, got type {kind}")
    other = _OTHERS.get(form, "complex ones" if flag & 0x800 else "")

    def numbers() -> NDArray[Any]:
        whole, count = 8 + inside, math.prod(shape)
        if whole > place + 8 * count + 16 or (whole > LARGE and packed and whole > RATIO * packed):
            raise _Damaged(f"'{_said(name)}' of {shape}, got {whole} bytes{f' packed in {packed}' if packed else ''}")
        file.seek(at + 8 if packed else at)
        return _array(_unpacked(file, packed, whole), place, form, shape, order)

    return _Variable(_said(name), shape, other, numbers), at + 8 + size


def _array(whole: bytes, place: int, form: int, shape: tuple[int, ...], order: str) -> NDArray[Any]:
    """The numbers of a variable of version 5 in its element at a byte, once they are known to fit class and shape."""
    kind, data, end = _element(whole, place, order)
    dtype = np.dtype(order + _NUMBERS.get(kind, "V"))
    # Numbers are stored as small as their values allow, integers never as floats.
    if dtype.itemsize > _INTEGERS.get(form, 8) or dtype.kind not in ("iu" if form in _INTEGERS else "iuf"):
        raise _Damaged(f"numbers of class {form}, got type {kind}")
    if len(data) != math.prod(shape) * dtype.itemsize or end < len(whole):
        raise _Damaged(f"{shape} numbers of {dtype.itemsize} bytes, got {len(data)} of {len(whole) - place} bytes")
    return np.frombuffer(data, dtype).reshape(shape, order="F")


def _unpacked(file: BinaryIO, packed: int, count: int) -> bytes:
    """From here on ``count`` bytes (up to so many if _START), unpacked from ``packed`` bytes unless these are 0."""
    if not packed:
        return file.read(count) if count == _START else _exactly(file, count)
    stream = zlib.decompressobj()
    try:
        if count == _START:
            return stream.decompress(file.read(min(packed, 16 * _START)), count)
        data = stream.decompress(file.read(packed), count + 1)  # one more, so that the checksum is looked at
    except zlib.error as error:
        raise _Damaged(f"packed bytes, got {error}") from None
    if len(data) != count or not stream.eof:
        raise _Damaged(f"{count} unpacked bytes, got {'more' if len(data) > count else 'fewer'}")
    return data


def _element(data: bytes, at: int, order: str) -> tuple[int, memoryview, int]:
    """The type and content of the element whose tag stands at a byte, and where the next one begins."""
    if at + 8 > len(data):
        raise _Damaged(f"8 bytes of a tag, got {max(len(data) - at, 0)}")
    kind, size = struct.unpack_from(order + "II", data, at)
    start, most = at + 8, len(data) - at - 8
    end = start + size + -size % 8
    if kind >> 16:  # a short element: up to 4 bytes share the tag's 8
        kind, size, start, most, end = kind & 0xFFFF, kind >> 16, at + 4, 4, at + 8
    if size > most:
        raise _Damaged(f"an element of up to {most} bytes, got {size} of type {kind}")
    return kind, memoryview(data)[start : start + size], end


def _variable_4(file: BinaryIO, at: int, end: int) -> tuple[_Variable, int]:
    """The variable of version 4 at a byte, and where the next begins."""
    tag = _exactly(file, 20)
    order = "<" if 0 <= struct.unpack("<i", tag[:4])[0] < 100 else ">"
    form, rows, columns, imaginary, length = struct.unpack(order + "5i", tag)
    kind, what = divmod(form - (1000 if order == ">" else 0), 10)
    if not 0 <= kind < len(_NUMBERS_4) or what not in (0, 1, 2) or imaginary not in (0, 1):
        raise _Damaged(f"a header, got {tag!r}")
    dtype = np.dtype(order + _NUMBERS_4[kind])
    after = at + 20 + length
    size = rows * columns * dtype.itemsize * (1 + (imaginary if what != 2 else 0))
    if min(rows, columns) < 0 or not 0 < length <= end - at - 20 or size > end - after:
        raise _Damaged(f"up to {end - at - 20} bytes, got {rows} x {columns} numbers and a name of {length} bytes")
    other = ("complex ones" if imaginary else "", "text", "sparse ones")[what]

    def numbers() -> NDArray[Any]:
        file.seek(after)
        return np.frombuffer(_exactly(file, size), dtype).reshape((rows, columns), order="F")

    return _Variable(_said(file.read(min(length, _START))), (rows, columns), other, numbers), after + size


def _exactly(file: BinaryIO, count: int) -> bytes:
    data = file.read(count)
    if len(data) < count:
        raise _Damaged(f"{count} bytes, got {len(data)}")
    return data


def _said(name: bytes | memoryview) -> str:
    """A name as messages can show it."""
    text = bytes(name).rstrip(b"\0").decode("latin-1")
    return text if text.isprintable() else ascii(text)
