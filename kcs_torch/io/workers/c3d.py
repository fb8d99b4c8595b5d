"""Read the points of a C3D file with ezc3d in a process of its own; see ``formats/c3d.py``.

Run by its path, so that only numpy and ezc3d are loaded. It writes one line of JSON to its standard output, ``{"error":
text}`` or ``{"shape": (T, N), "labels", "units", "rate", "x_screen", "y_screen", "analogs"}``, and then the points
(T, N, 3) as little-endian doubles, NaN where a point is unseen.
"""

from __future__ import annotations

import contextlib
import json
import os
import sys
from typing import Any

import numpy as np

ROOM = 2**30  # bytes of memory for this process, and for each byte of the file:
SHARE = 40


def main(path: str) -> None:
    """Write the answer."""
    allow(ROOM + SHARE * os.path.getsize(path))
    points = np.zeros((0, 0, 3))
    try:
        import ezc3d

        file = ezc3d.c3d(path)
        facts = file["parameters"]["POINT"]
        points = np.array(file["data"]["points"][:3], "<f8").transpose(2, 1, 0)
        residuals = np.asarray(file["data"]["meta_points"]["residuals"])[0].T
        points[residuals < 0] = np.nan
        labels = [str(name) for key in ("LABELS", "LABELS2", "LABELS3") for name in value(facts, key)]
        answer: dict[str, Any] = {
            "shape": points.shape[:2],
            "labels": labels,
            "units": "".join(map(str, value(facts, "UNITS")[:1])),
            "rate": float(next(iter(value(facts, "RATE")), 0)),
            "x_screen": "".join(map(str, value(facts, "X_SCREEN")[:1])),
            "y_screen": "".join(map(str, value(facts, "Y_SCREEN")[:1])),
            "analogs": int(np.shape(file["data"]["analogs"])[1]),
        }
    except Exception as error:  # ezc3d raises many kinds on damaged files
        answer = {"error": f"damaged or truncated, or no C3D file: {error}"}
    sys.stdout.buffer.write(json.dumps(answer).encode("utf-8", "replace") + b"\n")
    if "error" not in answer:
        sys.stdout.buffer.write(np.ascontiguousarray(points).data)


def value(facts: Any, key: str) -> list[Any]:
    """A parameter as a list."""
    return list(facts[key]["value"]) if key in facts else []


def allow(memory: int) -> None:
    """Bound the memory of this process where the system can: damaged files claim any size."""
    with contextlib.suppress(ImportError, ValueError, OSError):
        import resource

        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))  # crashes are expected here
        hard = resource.getrlimit(resource.RLIMIT_AS)[1]
        resource.setrlimit(resource.RLIMIT_AS, (memory, hard))


if __name__ == "__main__":
    main(sys.argv[1])
