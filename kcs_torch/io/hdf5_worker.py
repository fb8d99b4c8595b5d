"""Read real arrays of an HDF5 file (MATLAB 7.3) in a process of its own; see ``hdf5.py``.

Run by its path, so that only numpy and h5py are loaded. It writes one line of JSON to its standard output, either
``{"error": text}`` or ``{"shapes": {name: shape}, "read": [name, ...]}`` with MATLAB's order of dimensions, and then
the numbers of the variables read, as little-endian doubles, one variable after the other.
"""

from __future__ import annotations

import contextlib
import json
import math
import os
import sys
from typing import Any

import numpy as np
from numpy.typing import NDArray

ROOM = 2**30  # bytes of memory for this process besides the numbers


class Refused(Exception):
    """Says why the file is not read."""


def main(path: str, limit: int, large: int, ratio: int, wanted: list[str]) -> None:
    """Write the answer. ``large``: bytes from which on an array may not be ``ratio`` times larger than the file."""
    import h5py

    allow(room := ROOM)
    arrays: list[NDArray[np.float64]] = []
    try:
        with h5py.File(path, "r") as file:
            # Only what is stored in this very file: links could lead to other files, or round in circles.
            names = [k for k in file if isinstance(k, str) and isinstance(file.get(k, getlink=True), h5py.HardLink)]
            variables = {k: v for k in names if isinstance(v := file[k], h5py.Dataset)}
            shapes = {k: (v.shape or ())[::-1] for k, v in variables.items()}
            for name in (read := [k for k in wanted if k in variables]):
                room += 4 * check(name, variables[name], limit, max(large, ratio * os.path.getsize(path)))
                allow(room)
                arrays.append(np.asarray(variables[name]).T.astype("<f8"))
        answer: dict[str, Any] = {"shapes": shapes, "read": read}
    except Refused as error:
        answer, arrays = {"error": str(error)}, []
    except Exception as error:  # h5py raises many kinds on damaged files
        answer, arrays = {"error": f"damaged or truncated, or no MATLAB 7.3 file: {error}"}, []
    sys.stdout.buffer.write(json.dumps(answer).encode() + b"\n")
    for array in arrays:
        sys.stdout.buffer.write(np.ascontiguousarray(array).data)


def check(name: str, data: Any, limit: int, most: int) -> int:
    """Refuse what is no array of real numbers in this file, and a damaged header's claims; else tell the bytes."""
    shape = (data.shape or ())[::-1]
    size = max(8, data.dtype.itemsize) * math.prod(shape)
    if data.shape is None or data.dtype.kind not in "fiub":
        raise Refused(f"'{name}': expected real numbers, got {data.dtype}")
    if math.prod(max(d, 1) for d in shape) > limit:
        raise Refused(f"'{name}': {shape} are more numbers than a file of tracks holds")
    if data.external or data.is_virtual:
        raise Refused(f"'{name}': expected its numbers in this file, got those of another one: refused")
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
    bounds = [int(n) for n in sys.argv[2:5]]
    main(sys.argv[1], bounds[0], bounds[1], bounds[2], sys.argv[5:])
