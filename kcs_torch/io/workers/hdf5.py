"""Read an HDF5 file in a process of its own; see ``containers/hdf5.py``.

Run by its path, so that only numpy and h5py are loaded. Its argument is a request in JSON, with the path. It writes one
line of JSON to its standard output, either ``{"error": text}`` or

- ``shapes``: of all datasets by name (``tracks``, ``group/table``), and of the fields read of a table,
- ``attributes``: of the file (under the empty name), its groups and its datasets, as text; bytes are Latin-1,
- ``texts``: what the wanted datasets of text hold,
- ``read``: the names of the wanted datasets of real numbers,

and then the numbers of the latter, as little-endian doubles, one dataset after the other.
"""

from __future__ import annotations

import contextlib
import json
import math
import os
import sys
from collections.abc import Iterator
from fnmatch import fnmatchcase
from itertools import islice
from typing import Any

import numpy as np
from numpy.typing import NDArray

ROOM = 2**30  # bytes of memory for this process besides the numbers
MOST = 16384  # objects, and attributes of one object, that are looked at
LONG = 2**22  # letters of all attributes, and of the texts of all datasets


class Refused(Exception):
    """Says why the file is not read."""


def main(request: dict[str, Any]) -> None:
    """Write the answer; ``_ask`` of ``containers/hdf5.py`` says what may be asked."""
    import h5py

    allow(room := ROOM)
    arrays: list[NDArray[np.float64]] = []
    kind, path = request["kind"], request["path"]
    try:
        with h5py.File(path, "r") as file:
            objects = dict(islice(members(file, request["depth"]), MOST))
            data = {k: v for k, v in objects.items() if isinstance(v, h5py.Dataset)}
            answer: dict[str, Any] = {
                "shapes": {k: v.shape or () for k, v in data.items()},
                "attributes": attributes(objects) if request["texts"] else {},
                "texts": {},
                "read": [],
            }
            # For all that is read together: one dataset may stand under many names.
            most, letters = max(request["large"], request["ratio"] * os.path.getsize(path)), LONG
            for name in (k for k in data if any(fnmatchcase(k, w) for w in request["wanted"])):
                size = check(name, data[name], request, most)
                most -= size
                allow(room := room + 4 * size)
                if request["texts"] and (text := texts(data[name])) is not None:
                    answer["texts"][name] = text
                    letters -= sum(map(len, text)) + len(text)
                    if letters < 0:
                        raise Refused(f"'{name}': expected names, got more than {LONG} letters")
                    continue
                for part, values in fields(name, data[name]):
                    if values.dtype.kind == "S":
                        answer["texts"][part] = [v.decode("utf-8", "replace") for v in values.ravel().tolist()]
                    else:
                        arrays.append(np.asarray(values, "<f8"))
                        answer["read"].append(part)
                        answer["shapes"][part] = values.shape
    except Refused as error:
        answer, arrays = {"error": str(error)}, []
    except Exception as error:  # h5py raises many kinds on damaged files
        answer, arrays = {"error": f"damaged or truncated, or no {kind} file: {error}"}, []
    sys.stdout.buffer.write(json.dumps(answer).encode() + b"\n")
    for array in arrays:
        sys.stdout.buffer.write(np.ascontiguousarray(array).data)


def members(group: Any, depth: int, name: str = "") -> Iterator[tuple[str, Any]]:
    """Yield a group and what is in it, ``depth`` levels down.

    Only what is stored in this very file: links could lead to other files, or round in circles.
    """
    import h5py

    yield name, group
    for key in group:
        if not isinstance(key, str) or not isinstance(group.get(key, getlink=True), h5py.HardLink):
            continue
        value, label = group[key], f"{name}/{key}" if name else key
        if isinstance(value, h5py.Dataset):
            yield label, value
        elif isinstance(value, h5py.Group) and depth > 1:
            yield from members(value, depth - 1, label)


def attributes(objects: dict[str, Any]) -> dict[str, dict[str, str]]:
    """The attributes that are text, bytes (as Latin-1) or one whole number; those that cannot be read are left out."""
    found: dict[str, dict[str, str]] = {}
    left = LONG
    for name, item in objects.items():
        found[name] = {}
        for key in islice(item.attrs, MOST):
            with contextlib.suppress(Exception):
                stored = item.attrs.get_id(key)
                if math.prod(stored.shape or (1,)) * stored.dtype.itemsize > left:
                    continue
                value = item.attrs[key]
                if isinstance(value, bytes):
                    value = value.decode("latin-1")
                if isinstance(value, (str, np.integer)) and len(str(value)) <= left:
                    found[name][str(key)] = str(value)
                    left -= len(str(value))
    return found


def texts(data: Any) -> list[str] | None:
    """What a dataset of text holds; None of other datasets."""
    import h5py

    if h5py.check_string_dtype(data.dtype) is None:
        return None
    return [v.decode("utf-8", "replace") if isinstance(v, bytes) else str(v) for v in np.ravel(data[()]).tolist()]


def fields(name: str, data: Any) -> Iterator[tuple[str, NDArray[Any]]]:
    """The numbers of a dataset, or its columns if it is a table."""
    values = np.asarray(data)
    if values.dtype.names is None:
        yield name, values
    for column in values.dtype.names or ():
        if values[column].dtype.kind in "fiubS":
            yield f"{name}/{column}", values[column]


def check(name: str, data: Any, request: dict[str, Any], most: int) -> int:
    """Refuse what is no array of real numbers (or text) in this file, and a damaged header's claims; else its bytes."""
    shape = data.shape or ()
    wide = max(math.prod(data.dtype[c].shape or (1,)) for c in data.dtype.names) if data.dtype.names else 1
    size = max(8, data.dtype.itemsize) * math.prod(shape)
    if data.shape is None or data.dtype.kind not in ("fiubSOV" if request["texts"] else "fiub"):
        raise Refused(f"'{name}': expected real numbers, got {data.dtype}")
    if math.prod(max(d, 1) for d in shape) * wide > request["limit"]:
        shown = tuple(shape[::-1]) if request["matlab"] else tuple(shape)
        raise Refused(f"'{name}': {shown} are more numbers than a file of tracks holds")
    if data.external or data.is_virtual:
        raise Refused(f"'{name}': expected its numbers in this file, got those of another one: refused")
    import h5py

    packing = data.id.get_create_plist()
    for code, *_, label in (packing.get_filter(i) for i in range(packing.get_nfilters())):
        if not h5py.h5z.filter_avail(code):
            raise Refused(f"'{name}': packed by {label.decode('latin-1')}, which h5py lacks: write it with zlib")
    if size > most:
        raise Refused(f"'{name}': expected up to {most} bytes in a file of this size, got {size}: refused as a bomb")
    return size


def allow(memory: int) -> None:
    """Bound the memory of this process where the system can: damaged packed data may unpack without end."""
    with contextlib.suppress(ImportError, ValueError, OSError):
        import resource

        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))  # crashes are expected here
        hard = resource.getrlimit(resource.RLIMIT_AS)[1]
        resource.setrlimit(resource.RLIMIT_AS, (memory, hard))


if __name__ == "__main__":
    main(json.loads(sys.argv[1]))
