"""C3D of motion capture laboratories: markers, in binary. Read and written by ezc3d.

The library follows the pointers of a damaged file in C++ and crashes on some. So another process reads, with bounds on
its time and memory; that costs a fraction of a second.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch

from kcs_torch.errors import FormatError, OutputError, listed
from kcs_torch.io.contents.build_motion import build_motion, distinct
from kcs_torch.io.registry import MotionOptions, MotionReader, Probe, Saving, Writer, need
from kcs_torch.io.workers.ask import ask_worker
from kcs_torch.skeleton import Skeleton
from kcs_torch.types import Motion
from kcs_torch.types.arrays import as_array
from kcs_torch.types.axes import from_y_up
from kcs_torch.types.size import short_unit

__all__ = ["MOTION_READERS", "WRITERS"]

_SCREEN = {"y": ("+X", "+Y"), "z": ("+X", "+Z")}  # which axes point right and up on a screen

_FULL = 0xFFFF  # frames, of which a header counts no more


def recognises(probe: Probe) -> bool:
    """Tell by the second byte and the parameters' own header, to which the first one points."""
    head = probe.head
    if len(head) < 512 or head[1] != 0x50 or not head[0]:
        return False
    at = 512 * (head[0] - 1)
    if at + 4 > len(head):  # cut short, or no C3D: its data begin in some block
        return head[16:18] != b"\0\0"
    return head[at + 3] in (83, 84, 85, 86)  # the processor's type


def read(path: Path, options: MotionOptions) -> Motion:
    """Read the markers."""
    answer, points = _ask(path)
    notes = []
    names = [str(name).strip() for name in answer["labels"]][: points.shape[1]]
    names = distinct(names + [""] * (points.shape[1] - len(names)))
    there = np.isfinite(points).all(-1).any(0)
    if not there.any():
        raise FormatError(f"{path}: expected markers, got none that is seen in any frame")
    if not there.all():
        gone = [name for name, seen in zip(names, there, strict=True) if not seen]
        notes.append(f"never seen, left out: {listed(gone, 8)}")
    rate = float(f"{float(answer['rate']):.7g}")  # of single precision
    first, last = (int.from_bytes(Probe(path).head[at : at + 2], "little") for at in (6, 8))
    told = int(answer["told"]) or last - first + 1
    if len(points) < told and (told < _FULL or answer["told"]):
        where = "parameters tell" if answer["told"] else "header tells"
        notes.append(f"the {where} {told} frames, the file has {len(points)}: it is cut short")
    if first > 1:
        notes.append(f"the first frame is the recording's number {first}; it becomes frame 0")
    if answer["analogs"]:
        notes.append(f"{answer['analogs']} analog channels (of force plates, muscles, ...) are left out")
    return build_motion(
        torch.from_numpy(points[:, there].copy()),
        options,
        source=str(path),
        names=[name for name, seen in zip(names, there, strict=True) if seen],
        fps=rate if 0 < rate < 1e6 else None,
        units=short_unit(str(answer["units"])),
        up=next((axis for axis in ("y", "z") if answer["y_screen"].strip() == f"+{axis.upper()}"), None),
        notes=notes,
    )


def _ask(path: Path) -> tuple[dict[str, Any], np.ndarray[Any, np.dtype[np.float64]]]:
    """Let the worker read."""
    need("ezc3d", f"{path}: C3D", FormatError)
    if not path.is_file():
        raise FormatError(f"{path}: expected a C3D file, got a folder or the beginning of a name")
    answer, data = ask_worker("c3d.py", str(path), path, "ezc3d")
    try:
        frames, markers = map(int, answer["shape"])
        return answer, np.frombuffer(data, "<f8", frames * markers * 3).reshape(frames, markers, 3)
    except (ValueError, KeyError, TypeError) as error:
        raise FormatError(f"{path}: damaged: ezc3d failed on it: {error}") from None


def _check_count(body: Skeleton) -> None:
    """Make sure that there are no more joints than a byte counts.

    Raises:
        OutputError: there are.
    """
    if body.num_joints > 255:
        raise OutputError(f"expected up to 255 joints, got {body.num_joints}: C3D holds no more")


def write(motion: Motion, path: Path, saving: Saving) -> None:
    """Write the joints as markers; the file holds single precision."""
    ezc3d = need("ezc3d", str(path), OutputError)
    points, seen = as_array(from_y_up(motion.points, saving.up)), as_array(motion.seen) > 0
    frames, count = seen.shape
    file = ezc3d.c3d()
    whole = np.ones((4, count, frames))
    whole[:3] = np.where(seen[..., None], points, np.nan).transpose(2, 1, 0)
    names = [joint.encode("utf-8", "replace").decode()[:120] for joint in motion.skeleton.joints]
    facts = file["parameters"]["POINT"]
    facts["RATE"]["value"] = [saving.rate(motion)]
    facts["LABELS"]["value"] = names
    facts["UNITS"]["value"] = [motion.units]
    right, up = _SCREEN[saving.up]
    file.add_parameter("POINT", "X_SCREEN", [right])
    file.add_parameter("POINT", "Y_SCREEN", [up])
    if frames > _FULL:  # which these parameters count, of words of 16 bits, the lower one first
        file.add_parameter("POINT", "LONG_FRAMES", [float(frames)])
        for edge, number in (("START", 1), ("END", frames)):
            file.add_parameter("TRIAL", f"ACTUAL_{edge}_FIELD", [number % 2**16, number // 2**16])
            file["parameters"]["TRIAL"][f"ACTUAL_{edge}_FIELD"]["type"] = ezc3d.ezc3d.INT
    file["data"]["points"] = whole
    file["data"]["meta_points"]["residuals"] = np.where(seen, 0.0, -1.0).T[None]
    file["data"]["meta_points"]["camera_masks"] = np.zeros((7, count, frames), bool)
    file.write(str(path))
    if path.stat().st_size < 16 * frames * count:  # ezc3d does not say so
        raise OutputError(f"{path}: cannot be written: it came out shorter than the motion (is the disk full?)")


MOTION_READERS = (MotionReader("c3d", "C3D of motion capture: markers (needs ezc3d)", recognises, read),)
WRITERS = (
    Writer(
        ".c3d",
        "C3D: markers in millimetres, y up, for biomechanics (needs ezc3d)",
        None,
        write,
        unit="mm",
        names_unit=True,
        fits=_check_count,
        ready=partial(need, "ezc3d", "C3D", OutputError),
    ),
)
