"""Read the points of a C3D file with ezc3d in a process of its own; see ``formats/c3d.py``.

Run by its path, so that only numpy and ezc3d are loaded. It writes one line of JSON to its standard output, ``{"error":
text}`` or ``{"shape": (T, N), "told", "labels", "units", "rate", "x_screen", "y_screen", "analogs"}``, and then the
points (T, N, 3) as little-endian doubles, NaN where a point is unseen. The header counts frames in 16 bits, so of a
longer file "told" is how many there are by its parameters, 0 where none says so.
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
FULL = 0xFFFF  # frames, of which a header counts no more


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
        told = 0
        if len(points) >= FULL:
            told = frames_told(file["parameters"])
            points = whole(path, points, told, file["parameters"])
        labels = [str(name) for key in ("LABELS", "LABELS2", "LABELS3") for name in value(facts, key)]
        answer: dict[str, Any] = {
            "shape": points.shape[:2],
            "told": told,
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


def frames_told(groups: Any) -> int:
    """How many frames the parameters tell for files whose header cannot; 0 where none does."""
    told = int(next(iter(value(groups["POINT"], "LONG_FRAMES")), 0))
    if not told and "TRIAL" in groups:
        words = [value(groups["TRIAL"], f"ACTUAL_{edge}_FIELD") for edge in ("START", "END")]
        first, last = (sum((int(word) & 0xFFFF) << 16 * i for i, word in enumerate(pair)) for pair in words)
        told = last - first + 1 if all(words) else 0
    return told if told >= FULL else 0


def whole(path: str, points: np.ndarray[Any, Any], told: int, groups: Any) -> np.ndarray[Any, Any]:
    """The points of all frames, of which ezc3d gives 65535, or more than there are where blanks follow them.

    Only of Intel's floats, which programs of today write; others as they are.
    """
    with open(path, "rb") as file:
        head = file.read(512)
        file.seek(512 * (head[0] - 1) + 3)
        intel = file.read(1) == b"\x54"
    markers, analogs, start = (int.from_bytes(head[at : at + 2], "little") for at in (2, 4, 16))
    if not intel or markers != points.shape[1] or np.frombuffer(head, "<f4", 1, 12)[0] >= 0:
        return points[: told or None]
    ends = [os.path.getsize(path)]
    if "ROTATION" in groups and sum(value(groups["ROTATION"], "USED")):  # these follow
        ends += [512 * (int(block) - 1) for block in value(groups["ROTATION"], "DATA_START")]
    numbers = 4 * markers + analogs
    count = (min(ends) - 512 * (start - 1)) // (4 * numbers)
    frames = np.memmap(path, "<f4", "r", 512 * (start - 1), (max(count, 0), numbers))
    if not told:  # without what fills the last block
        told = count
        while told > max(FULL, count - 128) and not frames[told - 1].any():
            told -= 1
    rest = frames[FULL:told, : 4 * markers].reshape(-1, markers, 4)
    points = np.concatenate([points[: min(FULL, told)], rest[..., :3]])
    points[FULL:][rest[..., 3] < 0] = np.nan
    return points


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
