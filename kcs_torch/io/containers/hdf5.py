"""Read an HDF5 file that nobody vouches for.

Some damaged files crash the HDF5 library or make it unpack without end, whatever is checked before. So another process
reads them, with bounds on its time and memory; that costs a fraction of a second.
"""

from __future__ import annotations

import json
import math
from collections.abc import Collection
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from kcs_torch.errors import FormatError
from kcs_torch.io.containers.archive import LARGE, RATIO
from kcs_torch.io.registry import need
from kcs_torch.io.workers.ask import ask_worker

__all__ = ["LIMIT", "Tree", "read_hdf5", "read_tree"]

LIMIT = 2**28  # numbers in one dataset


class Tree(NamedTuple):
    """What an HDF5 file holds, two levels down; names are like ``tracks`` and ``group/table``.

    Attributes:
        shapes: of all datasets, and of the fields read of tables (``group/table/index``).
        attributes: of the file (under the empty name), its groups and datasets, as text; bytes are Latin-1.
        texts: the wanted datasets and fields of text.
        arrays: the wanted datasets and fields of real numbers.
    """

    shapes: dict[str, tuple[int, ...]]
    attributes: dict[str, dict[str, str]]
    texts: dict[str, list[str]]
    arrays: dict[str, NDArray[np.float64]]


def read_tree(path: Path, wanted: Collection[str]) -> Tree:
    """Read what a file holds, and the datasets that are wanted: real numbers, text, or tables of both.

    Args:
        path: the file.
        wanted: names of datasets, with ``*`` and ``?`` as in file names.

    Raises:
        FormatError: the file cannot be read or is damaged, a wanted dataset is neither numbers nor text or too large,
            or h5py is not installed.
    """
    return _ask(path, "HDF5", wanted=list(wanted), limit=LIMIT, depth=2, texts=True)


def read_hdf5(
    path: Path, wanted: Collection[str], limit: int
) -> tuple[dict[str, tuple[int, ...]], dict[str, NDArray[Any]]]:
    """Read the shapes of all variables of a MATLAB 7.3 file, and those variables that are wanted; as ``read_matlab``.

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
    tree = _ask(path, "MATLAB 7.3", wanted=list(wanted), limit=limit, depth=1, texts=False)
    return {k: v[::-1] for k, v in tree.shapes.items()}, {k: v.T for k, v in tree.arrays.items()}


def _ask(path: Path, kind: str, **request: Any) -> Tree:
    """Let the worker read."""
    need("h5py", f"{path}: {kind}", FormatError)
    request |= {"path": str(path), "kind": kind, "matlab": kind != "HDF5", "large": LARGE, "ratio": RATIO}
    answer, data = ask_worker("hdf5.py", json.dumps(request), path, "the HDF5 library")
    try:
        tree = Tree(
            {_printable(k): tuple(map(int, v)) for k, v in answer["shapes"].items()},
            answer.get("attributes", {}),
            {_printable(k): list(map(str, v)) for k, v in answer.get("texts", {}).items()},
            {},
        )
        at = 0
        for name in map(_printable, answer["read"]):
            count = math.prod(tree.shapes[name])
            tree.arrays[name] = np.frombuffer(data, "<f8", count, at).reshape(tree.shapes[name])
            at += 8 * count
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise FormatError(f"{path}: damaged: the HDF5 library failed on it: {error}") from None
    return tree


def _printable(name: str) -> str:
    return name if name.isprintable() else ascii(name)
