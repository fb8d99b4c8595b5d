"""MATLAB .mat files of the NRSfM benchmarks: the measurement matrix ``W`` (2T, N), or ``points2d`` (T, N, 2)."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kcs_torch.errors import FormatError
from kcs_torch.io.containers.hdf5 import LIMIT, read_hdf5
from kcs_torch.io.containers.matlab import read_matlab
from kcs_torch.io.contents.build_tracks import build_tracks
from kcs_torch.io.contents.shares import are_shares, in_pixels
from kcs_torch.io.registry import Options, Probe, Reader
from kcs_torch.types import Tracks

__all__ = ["READERS"]

_SHAPES = "W (2 x frames, joints), rows x1, y1, x2, y2, ..., or points2d (frames, joints, 2)"
_WANTED = ("W", "points2d", "confidence", "confidences", "edges", "fps")


def recognises(probe: Probe) -> bool:
    """Tell by the header; what is called .mat has none in version 4 and is left to the library to refuse."""
    return probe.head.startswith(b"MATLAB") or (probe.is_file and probe.suffix == ".mat")


def read(path: Path, options: Options) -> list[Tracks]:
    """Read the one body's tracks."""
    notes: list[str] = []
    hdf5 = b"\x89HDF" in Probe(path).head[:520]  # version 7.3, after its own header of 512 bytes
    shapes, values = (read_hdf5 if hdf5 else read_matlab)(path, _WANTED, LIMIT)
    found = ", ".join(f"{k} {v}" for k, v in sorted(shapes.items())) or "nothing"
    if "W" in values:
        points = _unfold(_real(values["W"], "W", path), path, found, notes)
    elif "points2d" in values:
        points = _real(values["points2d"], "points2d", path)
        if points.ndim != 3 or points.shape[2] != 2:
            raise FormatError(f"{path}: expected {_SHAPES}; got {found}")
    else:
        raise FormatError(f"{path}: expected {_SHAPES}; got {found}")
    if options.image_size is not None and are_shares(points):
        points = in_pixels(points, options.image_size, notes)
    confidence = next((_real(values[k], k, path) for k in ("confidence", "confidences") if k in values), None)
    fps = values.get("fps")
    return [
        build_tracks(
            np.where(np.isfinite(points), points, np.nan),
            confidence,
            options,
            source=str(path),
            edges=_edges(values["edges"], points.shape[1], path, notes) if "edges" in values else None,
            fps=float(_real(fps, "fps", path).reshape(-1)[0]) if fps is not None and np.size(fps) == 1 else None,
            notes=notes,
        )
    ]


def _unfold(w: NDArray[np.float64], path: Path, found: str, notes: list[str]) -> NDArray[np.float64]:
    """W (2T, N) -> points (T, N, 2), whichever way its rows run."""
    if w.ndim != 2 or w.shape[0] % 2 or w.shape[0] < 2 or w.shape[1] < 2:
        raise FormatError(f"{path}: expected {_SHAPES}; got {found}")
    in_turn = w.reshape(-1, 2, w.shape[1]).transpose(0, 2, 1)  # x1, y1, x2, y2, ...: the benchmarks' way
    stacked = w.reshape(2, -1, w.shape[1]).transpose(1, 2, 0)  # x1, x2, ..., y1, y2, ...
    # Bodies move little from frame to frame: the right reading is the smoother one by far.
    if len(in_turn) > 2 and _roughness(stacked) < 0.5 * _roughness(in_turn):
        notes.append("the rows of W are read as all x, then all y: so the motion is smoother than with x, y in turn")
        return stacked
    return in_turn


def _roughness(points: NDArray[np.float64]) -> float:
    steps = np.diff(np.where(np.isfinite(points), points, np.nan), axis=0)
    known = np.abs(steps[np.isfinite(steps)])
    largest = float(known.max(initial=0))
    return largest * float(np.sqrt(np.mean((known / largest) ** 2))) if largest > 0 else 0.0


def _edges(value: Any, joints: int, path: Path, notes: list[str]) -> NDArray[np.int64]:
    """Bones as indices from 0; MATLAB counts from 1."""
    edges = _real(value, "edges", path)
    paired = edges.ndim == 2 and edges.shape[1] == 2
    wrong = edges[~np.isin(edges, np.arange(joints + 1))]
    if not paired or wrong.size:
        got = f"{wrong[0]:g}" if paired else f"shape {edges.shape}"
        raise FormatError(f"{path}: 'edges': expected (bones, 2) joint numbers 1..{joints}, got {got}")
    first = 1 if edges.size and edges.min() >= 1 else 0
    notes.append(f"edges are counted from {first}")
    return edges.astype(np.int64) - first


def _real(value: Any, name: str, path: Path) -> NDArray[np.float64]:
    array = np.asarray(value)
    if array.dtype.kind not in "fiub":
        raise FormatError(f"{path}: '{name}': expected real numbers, got {array.dtype}")
    return array.astype(np.float64)


READERS = (Reader("mat", "MATLAB .mat of the NRSfM benchmarks: W (2T, N), or points2d (T, N, 2)", recognises, read),)
