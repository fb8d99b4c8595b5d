"""Results as text: .csv for spreadsheets and pandas, .json for other programs. All joints, virtual ones last."""

from __future__ import annotations

import csv
import dataclasses
import json
import math
from collections import Counter
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from kcs_torch.errors import OutputError
from kcs_torch.io.registry import Saving, Writer
from kcs_torch.types import Motion, Reconstruction
from kcs_torch.types.arrays import as_array
from kcs_torch.types.axes import from_y_up

__all__ = ["WRITERS", "cell", "write_table"]


def write_csv(result: Reconstruction, path: Path) -> None:
    """Write one row a frame: ``frame, time [s], nose_x [px], nose_y [px], nose_z [px], ...``.

    ``time [s]`` is empty where the frame rate is unknown; ``distance [px]`` comes last where it is known. Numbers have
    9 significant digits.
    """
    more = {} if result.distance is None else {"distance": as_array(result.distance)}
    _write_rows(as_array(result.points), result, more, path)


def write_motion_csv(motion: Motion, path: Path, saving: Saving) -> None:
    """Write the same of motion, with y or z up; the cells of joints that are unseen are empty."""
    points = as_array(from_y_up(motion.points, saving.up))
    _write_rows(np.where(as_array(motion.seen)[..., None] > 0, points, np.nan), motion, {}, path)


def _write_rows(
    points: NDArray[Any], moved: Reconstruction | Motion, more: dict[str, NDArray[Any]], path: Path
) -> None:
    names = [joint.strip() for joint in moved.skeleton.joints]  # who reads the table leaves blanks out
    if "" in names:
        raise OutputError(
            f"{path}: a table's columns need joint names, and that of joint {names.index('')} is blank: name it"
        )
    if twice := [joint for joint, count in Counter(names).items() if count > 1]:
        raise OutputError(
            f"{path}: a table's columns need different names, and two joints are '{twice[0]}': rename one"
        )
    unit = f" [{moved.units}]" if moved.units else ""
    header = [f"{cell(joint)}_{axis}{unit}" for joint in moved.skeleton.joints for axis in "xyz"]
    header += [f"{name}{unit}" for name in more]
    rows = np.concatenate([points.reshape(len(points), -1), *(v[:, None] for v in more.values())], 1)
    write_table(header, rows, moved.fps, path)


def write_table(header: Iterable[str], rows: NDArray[Any], fps: float | None, path: Path) -> None:
    """Write rows (T, K) of numbers after the columns ``frame`` and ``time [s]``; cells of NaN are empty."""
    with path.open("w", newline="", encoding="utf-8", errors="replace") as file:
        writer = csv.writer(file)
        writer.writerow(["frame", "time [s]", *header])
        for frame, row in enumerate(rows.tolist()):
            time = f"{frame / fps:.9g}" if fps else ""
            writer.writerow([frame, time, *("" if math.isnan(v) else f"{v:.9g}" for v in row)])


def write_json(result: Reconstruction, path: Path) -> None:
    """Write the motion as one object; the tracks, the lens and other solutions are in the native .npz alone.

    ``points3d``, ``joint_names`` and ``edges`` are those of all joints, of which the first ``num_observed`` are not
    virtual; ``units`` are those of ``points3d``. Numbers have 9 significant digits; what is not a number is null.
    """
    body = result.skeleton
    data = {
        "method": result.method,
        "units": result.units,
        "fps": result.fps,
        "joint_names": list(body.joints),
        "num_observed": body.num_observed,
        "edges": [list(b) for b in body.bones],
        "points3d": _listed(result.points),
        "lengths": _listed(result.lengths),
        "cameras": _listed(result.cameras),
        "scales": _listed(result.scales),
        "uncertainty": None if result.uncertainty is None else _listed(result.uncertainty),
        "root_depth": None if result.root_depth is None else _listed(result.root_depth),
        "distance": None if result.distance is None else _listed(result.distance),
        "skeleton": body.to_dict(),
        "diagnostics": _finite(dataclasses.asdict(result.diagnostics)),
        "notes": list(result.tracks.notes),
        "source": result.tracks.source,
    }
    path.write_text(json.dumps(data, allow_nan=False), encoding="utf-8")


def cell(name: str) -> str:
    """A name that no spreadsheet takes for a formula: names come from files that others wrote."""
    return f"'{name}" if name.startswith(("=", "+", "-", "@", "\t", "\r")) else name


def _listed(tensor: Tensor) -> Any:
    """Nested lists of a tensor's numbers, to 9 significant digits."""
    array = as_array(tensor)
    short = np.array([float(f"{v:.9g}") for v in array.ravel().tolist()], object).reshape(array.shape)
    return _finite(short.tolist())


def _finite(value: Any) -> Any:
    """The same nest with None for what is not finite, which JSON cannot say."""
    if isinstance(value, dict):
        return {k: _finite(v) for k, v in value.items()}
    if isinstance(value, (list, tuple)):
        return [_finite(v) for v in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


WRITERS = (
    Writer(".csv", "one row a frame: frame, time, and x, y, z of each joint", write_csv, write_motion_csv, turns=True),
    Writer(".json", "joints, bones, 3D points, cameras, lengths and diagnostics", write_json),
)
