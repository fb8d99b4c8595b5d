"""Small files of trackers of animals: what DeepLabCut and SLEAP write; and an animal whose template is guessed."""

import csv
import json
import math
import pickle
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import torch

from kcs_torch.skeleton import Skeleton
from kcs_torch.types.bodies import no_bones

ANIMAL = ("snout", "neck", "tailbase")


def four_legged() -> Skeleton:
    """An animal of 17 joints whose template is guessed from their names."""
    names = ["root", "neck", "head", "tail1", "tail2"]
    bones = [("root", "neck"), ("neck", "head"), ("root", "tail1"), ("tail1", "tail2")]
    for side in "lr":
        limbs = ("root", *(f"{side}_{p}" for p in ("hip", "knee", "hock")))
        front = ("neck", *(f"{side}_{p}" for p in ("shoulder", "elbow", "wrist")))
        bones += [*pairwise(limbs), *pairwise(front)]
        names += [*limbs[1:], *front[1:]]
    return Skeleton.from_names(names, bones, template="quadruped")


def unlike(guess: Skeleton) -> Skeleton:
    """The same animal with a template of its own: bones stray from the guessed one as far as poses do."""
    rest, draw = guess.template_points(dtype=torch.float64), torch.Generator().manual_seed(0)
    own = rest.clone()
    for (a, b), degrees in zip(guess.bones, guess.spread or (), strict=True):
        stray = math.sin(math.radians(degrees)) / 2**0.5 * torch.randn(3, generator=draw).double()
        own[b] = own[a] + rest[b] - rest[a] + (rest[b] - rest[a]).norm() * stray
    return replace(guess, template=tuple(map(tuple, own.tolist())))


def deeplabcut_columns(individuals=(), parts=ANIMAL, coords=("x", "y", "likelihood")):
    """Names of the columns: scorer, (individual,) body part, coordinate."""
    whose = [(i,) for i in individuals] or [()]
    return [("resnet", *i, part, c) for i in whose for part in parts for c in coords]


def deeplabcut_values(columns, num_frames=4):
    """Numbers that fit the columns: pixels, and likelihoods of 0.9."""
    place = np.random.default_rng(len(columns)).uniform(100, 300, len(columns))
    values = place + 2.0 * np.arange(num_frames)[:, None]
    values[:, [c[-1] == "likelihood" for c in columns]] = 0.9
    return values


def write_deeplabcut_csv(path: Path, columns, values, rows=None) -> Path:
    """A CSV as DeepLabCut writes it; ``rows``: what each is called, their numbers if None."""
    rows = [(i,) for i in range(len(values))] if rows is None else rows
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        levels = ("scorer", "bodyparts", "coords") if len(columns[0]) == 3 else DEEPLABCUT
        for level, names in zip(levels, zip(*columns, strict=True), strict=True):
            writer.writerow([level, *[""] * (len(rows[0]) - 1), *names])
        for row, line in zip(rows, values, strict=True):
            writer.writerow([*row, *("" if np.isnan(v) else v for v in line)])
    return path


DEEPLABCUT = ("scorer", "individuals", "bodyparts", "coords")


def write_deeplabcut_table(path: Path, columns, values, rows=None, pickled=None) -> Path:
    """HDF5 in pandas' "table" layout; ``pickled``: the names of the columns."""
    import h5py

    rows = np.arange(len(values)) if rows is None else np.array(rows, "S")
    table = np.zeros(len(values), [("index", rows.dtype), ("values_block_0", "f8", (len(columns),))])
    table["index"], table["values_block_0"] = rows, values
    names = pickle.dumps(columns, 0) if pickled is None else pickled
    with h5py.File(path, "w") as file:
        group = file.create_group("df_with_missing")
        group.attrs["pandas_type"] = np.bytes_("frame_table")
        group.attrs["info"] = np.bytes_(pickle.dumps({1: {"names": ["scorer", "bodyparts", "coords"]}}, 0))
        group.create_dataset("table", data=table, chunks=(2,))
        group["table"].attrs["values_block_0_kind"] = np.bytes_(names)
    return path


def write_deeplabcut_fixed(path: Path, columns, values, rows=None) -> Path:
    """HDF5 in pandas' "fixed" layout; ``rows`` with several levels, image paths say."""
    import h5py

    def levels(group, name, labels):
        for i, column in enumerate(zip(*labels, strict=True)):
            unique = sorted(set(column))
            group[f"{name}_level{i}"] = np.array([str(u).encode() for u in unique], "S")
            group[f"{name}_label{i}"] = np.array([unique.index(c) for c in column], "i1")

    with h5py.File(path, "w") as file:
        group = file.create_group("df_with_missing")
        group.attrs["pandas_type"] = np.bytes_("frame")
        levels(group, "block0_items", columns)
        group[f"block0_items_level{len(columns[0]) - 2}"].attrs["name"] = np.bytes_("bodyparts")
        group["block0_values"] = values
        if rows is None:
            group["axis1"] = np.arange(len(values))
        else:
            levels(group, "axis1", rows)
    return path


def sleap_points(tracks=1, num_frames=4) -> np.ndarray:
    """(tracks, 2, nodes, frames), as SLEAP has them."""
    start = np.random.default_rng(1).uniform(50, 250, (tracks, 2, len(ANIMAL), 1))
    return start + 2.0 * np.arange(num_frames)


def write_sleap_hdf5(path: Path, points, dims=None, **others) -> Path:
    """An analysis file; ``others``: more datasets, None leaves one out; ``dims``: names of the points' dimensions."""
    import h5py

    datasets = {
        "tracks": points,
        "node_names": np.array([n.encode() for n in ANIMAL], "S"),
        "edge_inds": np.array([[0, 1], [1, 2]], "i4"),
        **others,
    }
    with h5py.File(path, "w") as file:
        for name, value in datasets.items():
            if value is not None:
                file[name] = value
        if dims is not None:
            file["tracks"].attrs["dims"] = json.dumps(dims)
    return path


def write_sleap_csv(path: Path, lines, nodes=ANIMAL) -> Path:
    """An analysis CSV of lines (track, frame, score, x, y, score, x, ...)."""
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(
            ["track", "frame_idx", "instance.score", *(f"{n}.{c}" for n in nodes for c in ("x", "y", "score"))]
        )
        writer.writerows(lines)
    return path


def mouse_table():
    """Columns and values of one animal, as DeepLabCut labels it."""
    columns = deeplabcut_columns()
    return columns, deeplabcut_values(columns)


NO_BONES = no_bones(Skeleton.from_edges([], 3, tree=False))
LAYOUTS = {"csv": write_deeplabcut_csv, "table.h5": write_deeplabcut_table, "fixed.h5": write_deeplabcut_fixed}
CELLS = ["10", "20", ".9", "11", "21", ".8", "12", "22", ".7"]
