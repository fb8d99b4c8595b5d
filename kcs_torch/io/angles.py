"""Joint angles as a table."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from kcs_torch.errors import OutputError
from kcs_torch.io.atomic import atomic_path
from kcs_torch.io.formats.text import cell, write_table
from kcs_torch.types import JointAngles
from kcs_torch.types.arrays import as_array

__all__ = ["check_table", "save_angles"]


def save_angles(angles: JointAngles, path: str | Path) -> Path:
    """Write ``frame, time [s], left_knee [deg], left_knee_deviation [deg], ...``, one row a frame.

    ``time [s]`` is empty where the frame rate is unknown, and so are cells of unseen joints. Where deviations are
    unknown, their columns are left out. Missing parent folders are created.

    Args:
        angles: of :meth:`Reconstruction.angles` or :meth:`Motion.angles`.
        path: where to, a .csv file.

    Raises:
        OutputError: the suffix is another, or the file cannot be written; nothing is left behind.
    """
    check_table(path)
    columns = {}
    for name, values in angles.degrees.items():
        columns[f"{cell(name)} [deg]"] = as_array(values)
        if angles.deviation is not None:
            columns[f"{cell(name)}_deviation [deg]"] = as_array(angles.deviation[name])
    with atomic_path(path) as temporary:
        write_table(columns, np.stack(list(columns.values()), 1), angles.fps, temporary)
    return Path(path)


def check_table(path: str | Path) -> None:
    """Make sure that a path is that of a table.

    Raises:
        OutputError: it is not.
    """
    suffix = Path(path).suffix
    if suffix.lower() != ".csv":
        raise OutputError(f"{path}: expected a file with the suffix .csv for angles, got {suffix or 'none'}")
