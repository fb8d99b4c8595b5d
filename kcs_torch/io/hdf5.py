"""Read real arrays of an HDF5 file (MATLAB 7.3) that nobody vouches for.

Some damaged files crash the HDF5 library or make it unpack without end, whatever is checked before. So another process
reads them, with bounds on its time and memory; that costs a fraction of a second.
"""

from __future__ import annotations

import json
import math
import os
import subprocess
import sys
from collections.abc import Collection
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kcs_torch.errors import FormatError
from kcs_torch.io.archive import LARGE, RATIO
from kcs_torch.io.registry import need, read_error

__all__ = ["read_hdf5"]

PATIENCE = 60.0  # seconds, and one more for each 16 MiB


def read_hdf5(
    path: Path, wanted: Collection[str], limit: int
) -> tuple[dict[str, tuple[int, ...]], dict[str, NDArray[Any]]]:
    """Read the shapes of all variables, and those variables that are wanted; as ``read_matlab`` of older versions.

    Args:
        path: the file.
        wanted: names of variables, which have to be arrays of real numbers.
        limit: how many numbers each of them may have.

    Returns:
        Shapes and arrays by name, with MATLAB's order of dimensions, which HDF5 reverses.

    Raises:
        FormatError: the file cannot be read or is damaged, a wanted variable is not real or too large, or h5py is not
            installed.
    """
    need("h5py", f"{path}: MATLAB 7.3", FormatError)
    worker = Path(__file__).with_name("hdf5_worker.py")
    places = os.pathsep.join(p for p in sys.path if p)  # where this process would find h5py
    try:
        done = subprocess.run(
            [sys.executable or "python3", "-P", str(worker), str(path), *map(str, (limit, LARGE, RATIO)), *wanted],
            env=os.environ | {"PYTHONPATH": places, "OPENBLAS_NUM_THREADS": "1"},
            timeout=PATIENCE + path.stat().st_size / 2**24,
            stdin=subprocess.DEVNULL,
            capture_output=True,
        )
    except subprocess.TimeoutExpired as error:
        raise FormatError(f"{path}: damaged: the HDF5 library gave no answer in {error.timeout:.0f} seconds") from None
    except OSError as error:
        raise read_error(path, error) from None
    try:
        if done.returncode:
            raise ValueError(f"it ended with status {done.returncode}")
        line = done.stdout.index(b"\n") + 1
        answer = json.loads(done.stdout[:line])
        if "error" in answer:
            raise FormatError(f"{path}: {answer['error']}")
        shapes = {k if k.isprintable() else ascii(k): tuple(map(int, v)) for k, v in answer["shapes"].items()}
        values, at = {}, line
        for name in answer["read"]:
            count = math.prod(shapes[name])
            values[name] = np.frombuffer(done.stdout, "<f8", count, at).reshape(shapes[name])
            at += 8 * count
    except FormatError:
        raise
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise FormatError(f"{path}: damaged: the HDF5 library failed on it: {error}") from None
    return shapes, values
