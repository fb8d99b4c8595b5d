"""Tables that pandas wrote to HDF5, with columns of several levels, read without pandas."""

from __future__ import annotations

import io
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from kcs_torch.errors import FormatError
from kcs_torch.io.containers.hdf5 import Tree, read_tree
from kcs_torch.io.containers.pickles import load_arrays

__all__ = ["Table", "has_column", "pandas_group", "read_pandas"]

_WANTED = ("*/table", "*/axis1", "*/axis1_*", "*/block*_items_*", "*/block*_values")


class Table(NamedTuple):
    """A table with columns that have several names each, and rows that have one or several.

    Attributes:
        columns: the names of each column, outermost level first.
        values: (rows, columns).
        rows: what each row is called; a number where rows are numbered.
    """

    columns: list[tuple[str, ...]]
    values: NDArray[np.float64]
    rows: Sequence[tuple[str | float, ...]]


def pandas_group(tree: Tree) -> str | None:
    """The group that holds a pandas table whose columns have a level "bodyparts"; None where there is none."""
    groups = [k for k, v in tree.attributes.items() if k and "/" not in k and v.get("pandas_type", "")[:5] == "frame"]
    for group in sorted(groups, key=lambda g: g != "df_with_missing"):
        inside = (v for k, v in tree.attributes.items() if k == group or k.startswith(f"{group}/"))
        if any("bodyparts" in text for attributes in inside for text in attributes.values()):
            return group
    return None


def has_column(path: Path, coord: str) -> bool:
    """Whether a table has a column of this innermost name; False of files that cannot be read."""
    try:
        tree = read_tree(path, ("*/block0_items_*",))
        group = pandas_group(tree)
        if group is None:
            return False
        if f"{group}/table" in tree.shapes:
            names = _names(tree, group, "values_block_0")
        else:
            names = _columns(_levels(tree, f"{group}/block0_items"))
        return any(name[-1] == coord for name in names)
    except (FormatError, ValueError, LookupError, TypeError):
        return False


def read_pandas(path: Path) -> Table:
    """Read the one table of a file.

    Raises:
        FormatError: the file cannot be read, is damaged, or holds no such table.
    """
    tree = read_tree(path, _WANTED)
    group = pandas_group(tree)
    if group is None:
        held = ", ".join(sorted(tree.shapes)[:8]) or "nothing"
        raise FormatError(f"{path}: expected a pandas table with body parts as columns, got {held}")
    try:
        blocks, rows = (_table if f"{group}/table" in tree.shapes else _fixed)(tree, group)
        if not blocks:
            raise ValueError("it has no columns")
        for columns, values in blocks:
            if values.shape != (len(rows), len(columns)):
                raise ValueError(f"{len(rows)} rows and {len(columns)} columns do not fit numbers {values.shape}")
        return Table([c for b in blocks for c in b[0]], np.concatenate([b[1] for b in blocks], 1), rows)
    except (ValueError, LookupError, TypeError) as error:
        reason = f"it has no {error}" if isinstance(error, KeyError) else error
        raise FormatError(f"{path}: the pandas table '{group}' is damaged or of an unknown layout: {reason}") from None


Blocks = list[tuple[list[tuple[str, ...]], NDArray[np.float64]]]


def _table(tree: Tree, group: str) -> tuple[Blocks, list[tuple[str | float, ...]]]:
    """The "table" layout: one dataset of rows; an attribute of each block of columns names them, by a pickle."""
    prefix = f"{group}/table/"
    blocks: Blocks = []
    for name, values in tree.arrays.items():
        block = name.removeprefix(prefix)
        if name.startswith(prefix) and re.fullmatch(r"values_block_[0-9]+", block):
            blocks.append((_names(tree, group, block), values.reshape(len(values), -1)))
    return blocks, _listed(tree, f"{prefix}index")


def _names(tree: Tree, group: str, block: str) -> list[tuple[str, ...]]:
    """The names of the columns of a block of the "table" layout."""
    pickled = tree.attributes[f"{group}/table"][f"{block}_kind"].encode("latin-1")
    return _columns(load_arrays(io.BytesIO(pickled), "names of columns"))


def _fixed(tree: Tree, group: str) -> tuple[Blocks, list[tuple[str | float, ...]]]:
    """The "fixed" layout: a dataset for each block of columns, and the levels and codes of their names."""
    blocks: Blocks = []
    for name, values in tree.arrays.items():
        if match := re.fullmatch(re.escape(group) + r"/block([0-9]+)_values", name):
            names = _levels(tree, f"{group}/block{match[1]}_items")
            blocks.append((_columns(names), values.reshape(len(values), -1)))
    axis = f"{group}/axis1"
    return blocks, _levels(tree, axis) if f"{axis}_level0" in tree.shapes else _listed(tree, axis)


def _levels(tree: Tree, name: str) -> list[tuple[str | float, ...]]:
    """Names of several levels, each given as its different values and a code into them for every row or column."""
    levels: list[list[str | float]] = []
    while f"{name}_level{len(levels)}" in tree.shapes:
        values = [v for (v,) in _listed(tree, f"{name}_level{len(levels)}")]
        codes = tree.arrays[f"{name}_label{len(levels)}"].ravel().tolist()
        if not all(c.is_integer() and -1 <= c < len(values) for c in codes):
            raise ValueError(f"'{name}' has codes that are none")
        levels.append([values[int(c)] if c >= 0 else "" for c in codes])
    return list(zip(*levels, strict=True))


def _listed(tree: Tree, name: str) -> list[tuple[str | float, ...]]:
    """A list of text or of numbers."""
    if name in tree.texts:
        return [(v,) for v in tree.texts[name]]
    return [(v,) for v in tree.arrays[name].ravel().tolist()]


def _columns(names: Any) -> list[tuple[str, ...]]:
    if not isinstance(names, list) or not all(
        isinstance(n, tuple) and 3 <= len(n) <= 4 and all(isinstance(v, str) for v in n) for n in names
    ):
        raise ValueError("its columns are not named by scorer, bodyparts and coords")
    return names
