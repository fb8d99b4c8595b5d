"""ASF/AMC of Acclaim: a skeleton file (.asf) and the angles of its bones a frame (.amc), as mocap.cs.cmu.edu has them.

Lengths and places are in the unit that ``:units length`` names: 0.45 means 1/0.45 inches. The joints are the root and
the far end of each bone; y is up. The files do not tell the frame rate.
"""

from __future__ import annotations

from array import array
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from kcs_torch.errors import FormatError
from kcs_torch.functional import euler_rotation
from kcs_torch.io.contents.build_motion import build_motion, numbers, read_lines
from kcs_torch.io.folders import frame_numbers
from kcs_torch.io.registry import MotionOptions, MotionReader, Probe
from kcs_torch.types import Motion

__all__ = ["MOTION_READERS"]

_INCH = 25.4  # mm
_BONES = 10_000  # of one file
_DIGITS = 16  # from which on a number is none of a frame


@dataclass
class _Bone:
    name: str
    line: int
    direction: Sequence[float] = (0.0, 0.0, 0.0)
    length: float = 0.0
    axis: Sequence[float] = (0.0, 0.0, 0.0)  # degrees
    order: str = "XYZ"  # in which the turns are made, so the last stands first in the product
    channels: Sequence[str] = ()
    parent: str = ""


@dataclass
class _Body:
    bones: dict[str, _Bone] = field(default_factory=dict)
    root: _Bone = field(default_factory=lambda: _Bone("root", 0))
    position: Sequence[float] = (0.0, 0.0, 0.0)
    unit: float = 1.0
    degrees: bool = True


def recognises(probe: Probe) -> bool:
    """Tell by the first words that are no comment."""
    text = probe.head.removeprefix(b"\xef\xbb\xbf").decode("latin-1")
    words = [line.strip().lower() for line in text.split("\n")]
    first = next((w for w in words if w and not w.startswith("#")), "")
    if first.startswith((":fully-specified", ":degrees", ":radians")):
        return True
    return first.startswith(":") and ":bonedata" in words


def read(path: Path, options: MotionOptions) -> Motion:
    """Read an AMC file with the ASF file that the caller names, or that lies beside it."""
    lines = read_lines(path)
    if any(line.lower().startswith(":bonedata") for line in lines[:2000]):
        raise FormatError(f"{path}: expected motion (.amc), got a skeleton (.asf): give the .amc file beside it")
    named = options.skeleton if str(options.skeleton).lower().endswith(".asf") else None
    asf = Path(str(named)) if named else _beside(path)
    body = _skeleton(asf)
    order = _parents_first(body, asf)
    notes = [f"skeleton of {asf.name}"]
    angles, numbered = _angles(lines, body, path)
    frames, _ = frame_numbers(numbered, notes, names="frames", one="the file's frame", whole="pose")
    points = torch.full((max(frames) + 1, len(order) + 1, 3), torch.nan, dtype=torch.float64)
    points[frames] = _positions(body, order, angles)
    places = {"root": 0} | {bone.name: i for i, bone in enumerate(order, 1)}
    rest = replace(options, skeleton=None) if named else options
    if options.fps is None:
        notes.append("the file does not tell the frame rate (CMU's are mostly 120): give fps=... (kcs-torch: --fps)")
    return build_motion(
        points * (_INCH / body.unit if body.unit != 1 else 1),
        rest,
        source=str(path),
        names=list(places),
        edges=[(places[bone.parent], places[bone.name]) for bone in order],
        units="mm" if body.unit != 1 else "",
        notes=notes,
    )


def _beside(path: Path) -> Path:
    """The ASF file of an AMC file: of the same name, of the name before its last underscore, or the only one there."""
    try:
        there = sorted(f for f in path.parent.iterdir() if f.suffix.lower() == ".asf" and f.is_file())
    except OSError:
        there = []
    for stem in (path.stem, path.stem.rpartition("_")[0]):
        found = [f for f in there if f.stem == stem]
        if found:
            return found[0]
    if len(there) == 1:
        return there[0]
    got = ", ".join(f.name for f in there[:5]) or "none"
    raise FormatError(
        f"{path}: expected its skeleton beside it, such as {path.stem}.asf, got {got}: name it by skeleton="
    )


def _skeleton(path: Path) -> _Body:
    """Read an ASF file."""
    body = _Body()
    section, bone, linked = "", None, False
    for number, line in enumerate(read_lines(path), 1):
        where = f"{path}: line {number}"
        words = line.partition("#")[0].split()
        if not words:
            continue
        if words[0].startswith(":"):
            section, bone = words[0].lower(), None
            continue
        key, rest = words[0].lower(), words[1:]
        if section == ":units" and key == "length":
            body.unit = _several(rest, 1, where)[0]
        elif section == ":units" and key == "angle":
            body.degrees = rest[:1] != ["rad"]
        elif section == ":root":
            _root(body, key, rest, where)
        elif section == ":bonedata" and key == "begin":
            bone = _Bone("", number)
        elif section == ":bonedata" and key == "end" and bone is not None:
            if not bone.name or bone.name in body.bones or bone.name == "root" or len(body.bones) >= _BONES:
                raise FormatError(f"{where}: expected bones of different names, got {bone.name!r} again, or without")
            body.bones[bone.name], bone = bone, None
        elif section == ":bonedata" and bone is not None:
            _fact(bone, key, rest, where)
        elif section == ":hierarchy" and key not in ("begin", "end"):
            linked = True
            for child in rest:
                if child not in body.bones or (words[0] != "root" and words[0] not in body.bones):
                    raise FormatError(f"{where}: expected names of bones, got {' '.join(words)[:60]!r}")
                if body.bones[child].parent:
                    raise FormatError(f"{where}: bone '{child}' hangs on two others")
                body.bones[child].parent = words[0]
    if not body.bones or not linked or not body.unit > 0:
        raise FormatError(f"{path}: expected a skeleton with :bonedata and :hierarchy, got something else")
    return body


def _root(body: _Body, key: str, rest: Sequence[str], where: str) -> None:
    if key == "order":
        body.root.channels = _kinds(rest, where)
    elif key == "axis":
        body.root.order = _order(rest, where)
    elif key == "position":
        body.position = _several(rest, 3, where)
    elif key == "orientation":
        body.root.axis = _several(rest, 3, where)


def _fact(bone: _Bone, key: str, rest: Sequence[str], where: str) -> None:
    if key == "name":
        bone.name = "".join(rest[:1])
    elif key == "direction":
        bone.direction = _several(rest, 3, where)
    elif key == "length":
        bone.length = _several(rest, 1, where)[0]
    elif key == "axis":
        bone.axis, bone.order = _several(rest, 3, where), _order(rest[3:], where)
    elif key == "dof":
        bone.channels = _kinds(rest, where)
        if not set(bone.channels) <= {"rx", "ry", "rz"}:
            raise FormatError(f"{where}: dof: expected rx, ry and rz, got {' '.join(rest)[:40]!r}")


def _several(words: Sequence[str], count: int, where: str) -> list[float]:
    if len(words) < count:
        raise FormatError(f"{where}: expected {count} numbers, got {len(words)}")
    return numbers(words[:count], where)


def _order(words: Sequence[str], where: str) -> str:
    order = "".join(words[:1]).upper()
    if sorted(order) != ["X", "Y", "Z"]:
        raise FormatError(f"{where}: axis: expected an order such as XYZ, got {order[:20]!r}")
    return order


def _kinds(words: Sequence[str], where: str) -> tuple[str, ...]:
    kinds = tuple(w.lower() for w in words)
    if len(set(kinds)) < len(kinds) or not set(kinds) <= {"tx", "ty", "tz", "rx", "ry", "rz"}:
        raise FormatError(f"{where}: expected TX, RZ and the like, got {' '.join(words)[:40]!r}")
    return kinds


def _parents_first(body: _Body, path: Path) -> list[_Bone]:
    """The bones from the root outwards, those of one parent in their file's order."""
    children: dict[str, list[_Bone]] = {}
    for bone in body.bones.values():
        children.setdefault(bone.parent, []).append(bone)
    out: list[_Bone] = []
    stack = list(reversed(children.get("root", [])))
    while stack:
        out.append(stack.pop())
        stack += reversed(children.get(out[-1].name, []))
    if len(out) < len(body.bones):
        reached = {bone.name for bone in out}
        loose = next(bone for bone in body.bones.values() if bone.name not in reached)
        raise FormatError(f"{path}: line {loose.line}: bone '{loose.name}' hangs on nothing in :hierarchy")
    return out


def _angles(lines: Sequence[str], body: _Body, path: Path) -> tuple[dict[str, Tensor], list[int | None]]:
    """The channel values (T, C) of the root and each bone that moves, and what numbers the T frames."""
    kinds = {"root": body.root.channels} | {b.name: b.channels for b in body.bones.values() if b.channels}
    values: dict[str, list[array[float]]] = {name: [] for name in kinds}
    numbered: list[int | None] = []
    for number, words in _words(lines, body):
        where = f"{path}: line {number}"
        frames = len(numbered)
        if len(words) == 1 and words[0].isdecimal():
            _complete(values, frames, where)
            numbered.append(int(words[0]) if len(words[0]) < _DIGITS else None)
            continue
        name = words[0]
        if name not in kinds or not frames:
            what = "a frame's number" if not frames else f"one of {', '.join(list(kinds)[:4])}, ..."
            raise FormatError(f"{where}: expected {what}, got {name[:40]!r}")
        if len(values[name]) == frames:
            raise FormatError(f"{where}: frame {frames}: '{name}' comes twice")
        row = numbers(words[1:], where)
        if len(row) != len(kinds[name]):
            raise FormatError(f"{where}: '{name}': expected {len(kinds[name])} numbers, got {len(row)}")
        values[name].append(array("d", row))
    frames = len(numbered)
    if not frames:
        raise FormatError(f"{path}: expected frames, each below a line with its number, got none")
    _complete(values, frames, f"{path}: line {len(lines)}")
    rows = {n: torch.from_numpy(np.array(v, np.float64)).reshape(frames, len(kinds[n])) for n, v in values.items()}
    return rows, numbered


def _words(lines: Sequence[str], body: _Body) -> Iterator[tuple[int, list[str]]]:
    for number, line in enumerate(lines, 1):
        words = line.partition("#")[0].split()
        if words and words[0].startswith(":"):
            body.degrees = body.degrees if words[0].lower() not in (":degrees", ":radians") else words[0][1] in "dD"
        elif words:
            yield number, words


def _complete(values: dict[str, list[array[float]]], frames: int, where: str) -> None:
    missing = [name for name, rows in values.items() if len(rows) < frames]
    if missing:
        raise FormatError(f"{where}: frame {frames}: expected all bones, got none for {', '.join(missing[:5])}")


def _positions(body: _Body, order: Sequence[_Bone], angles: dict[str, Tensor]) -> Tensor:
    """The root and the far end of each bone: (T, N, 3) in the file's unit."""

    def turn(values: Tensor, kinds: Sequence[str], order: str) -> Tensor:
        columns = {k[1].upper(): values[:, i] for i, k in enumerate(kinds) if k[0] == "r"}
        zero = values.new_zeros(len(values))
        stacked = torch.stack([columns.get(axis, zero) for axis in order[::-1]], -1)
        return euler_rotation(order[::-1], stacked.deg2rad() if body.degrees else stacked)

    def fixed(bone: _Bone) -> Tensor:
        return turn(angles["root"].new_tensor(bone.axis)[None], ("rx", "ry", "rz"), bone.order)

    moved = angles["root"]
    shift = torch.zeros(len(moved), 3, dtype=moved.dtype)
    for i, kind in enumerate(body.root.channels):
        if kind[0] == "t":
            shift[:, "xyz".index(kind[1])] = moved[:, i]
    base = fixed(body.root)
    worlds = {"root": base @ turn(moved, body.root.channels, body.root.order)}
    points = {"root": moved.new_tensor(body.position) + shift}
    for bone in order:
        axis = fixed(bone)
        own = turn(angles[bone.name], bone.channels, bone.order) if bone.channels else torch.eye(3, dtype=moved.dtype)
        worlds[bone.name] = worlds[bone.parent] @ axis @ own @ axis.mT
        arm = moved.new_tensor(bone.direction) * bone.length
        points[bone.name] = points[bone.parent] + worlds[bone.name] @ arm
    return torch.stack(list(points.values()), 1)


MOTION_READERS = (MotionReader("amc", "ASF/AMC (CMU): the .amc file, its .asf beside it; in mm", recognises, read),)
