"""BVH (Biovision hierarchy): a chain of joints with offsets, and Euler angles a frame. The animators' format.

Read without a library: any order and number of channels, wrong text answered with its line. Joints that lie on their
parent (zero offset) are left out, ends of chains (End Site) become joints of their own. BVH has no unit, and y is up.

Written in centimetres, as most programs take it (Blender takes 1 unit for 1 m: import with a scale of 0.01, or write
``units="m"``; it turns y up by itself), with the rest pose of the skeleton's template. How far the file's joints are
from ours is told.
"""

from __future__ import annotations

import math
import re
from array import array
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from kcs_torch.errors import FormatError, listed
from kcs_torch.functional import euler_angles, euler_rotation
from kcs_torch.io.contents.build_motion import build_motion, distinct, numbers, read_lines
from kcs_torch.io.contents.rig import Rig, check_tree, fit_rig
from kcs_torch.io.contents.times import plain_rate
from kcs_torch.io.registry import MotionOptions, MotionReader, Probe, Saving, Writer
from kcs_torch.types import Motion
from kcs_torch.types.arrays import as_array
from kcs_torch.types.axes import from_y_up
from kcs_torch.types.size import METRES

__all__ = ["MOTION_READERS", "WRITERS"]

_NODES = 10_000  # joints of one file
_NOISE = 1e-6  # of a body's size: what files do not resolve
_CHANNEL = re.compile(r"([xyz])(position|rotation)\Z", re.IGNORECASE)


@dataclass
class _Node:
    name: str
    parent: int
    offset: Sequence[float]
    channels: Sequence[str]  # such as "xposition", in lower case
    line: int


def recognises(probe: Probe) -> bool:
    """Tell by the first word."""
    return probe.head.removeprefix(b"\xef\xbb\xbf").lstrip()[:9].upper() == b"HIERARCHY"


def read(path: Path, options: MotionOptions) -> Motion:
    """Read the joints' positions, by forward kinematics."""
    lines = read_lines(path)
    nodes, start = _hierarchy(lines, path)
    notes: list[str] = []
    values, seconds = _frames(lines, start, sum(len(n.channels) for n in nodes), path, notes)
    points = _positions(nodes, values)
    stay = [i for i, n in enumerate(nodes) if n.parent < 0 or any(n.offset) or "xposition" in n.channels]
    stands = {i: i for i in stay}  # where a joint that is left out lies
    for i, node in enumerate(nodes):
        stands.setdefault(i, stands.get(node.parent, node.parent))
    left = [n.name for i, n in enumerate(nodes) if i not in set(stay) and n.channels]
    if left:
        notes.append(f"left out because they lie on their parent: {listed(left, 5)}")
    fps = plain_rate(1 / seconds) if seconds > 0 else None
    if fps is None:
        notes.append(f"Frame Time is {seconds:g} seconds: the frame rate is unknown")
    at = {i: k for k, i in enumerate(stay)}
    return build_motion(
        points[:, stay],
        options,
        source=str(path),
        names=distinct([nodes[i].name for i in stay]),
        edges=[(at[stands[nodes[i].parent]], at[i]) for i in stay if nodes[i].parent >= 0],
        fps=fps,
        notes=notes,
    )


def _hierarchy(lines: Sequence[str], path: Path) -> tuple[list[_Node], int]:
    """The joints and ends, parents first, and the index of the line MOTION."""
    nodes: list[_Node] = []
    open_nodes: list[int] = []
    waiting: _Node | None = None  # named, before its brace
    for number, piece in _pieces(lines):
        where = f"{path}: line {number}"
        word, _, rest = piece.partition(" ")
        key, rest = word.upper(), rest.strip()
        if key == "HIERARCHY" and not nodes:
            continue
        if key == "MOTION" and nodes and not open_nodes and waiting is None:
            for node in nodes:
                if not node.offset:
                    raise FormatError(f"{path}: line {node.line}: '{node.name}': expected an OFFSET, got none")
            return nodes, number - 1
        if key in ("ROOT", "JOINT", "END") and waiting is None and (key == "ROOT") == (not open_nodes):
            if key == "ROOT" and nodes:
                raise FormatError(f"{where}: expected one ROOT, got a second one: split the file")
            if len(nodes) >= _NODES:
                raise FormatError(f"{where}: expected up to {_NODES} joints, got more")
            parent = open_nodes[-1] if open_nodes else -1
            name = f"{nodes[parent].name}_end" if key == "END" else rest
            waiting = _Node(name, parent, (), () if key == "END" else ("",), number)
        elif key == "{" and waiting is not None:
            open_nodes.append(len(nodes))
            nodes.append(waiting)
            waiting = None
        elif key == "}" and open_nodes and waiting is None:
            open_nodes.pop()
        elif key == "OFFSET" and open_nodes and waiting is None:
            offset = numbers(rest.split(), where)
            if len(offset) != 3:
                raise FormatError(f"{where}: OFFSET: expected 3 numbers, got {len(offset)}")
            nodes[open_nodes[-1]].offset = offset
        elif key == "CHANNELS" and open_nodes and waiting is None:
            nodes[open_nodes[-1]].channels = _channels(rest.split(), where)
        else:
            raise FormatError(f"{where}: expected joints in braces with OFFSET and CHANNELS, got {piece[:40]!r}")
    raise FormatError(f"{path}: expected MOTION after the joints, got the end of the file")


def _pieces(lines: Sequence[str]) -> Iterator[tuple[int, str]]:
    """Lines with their numbers, braces apart, blanks single."""
    for number, line in enumerate(lines, 1):
        for piece in re.split(r"([{}])", line):
            if piece := " ".join(piece.split()):
                yield number, piece


def _channels(words: Sequence[str], where: str) -> tuple[str, ...]:
    channels = tuple(w.lower() for w in words[1:])
    if not words or words[0] != str(len(channels)):
        raise FormatError(f"{where}: CHANNELS: expected their count and as many names, got {' '.join(words)[:40]!r}")
    for word in channels:
        if not _CHANNEL.match(word):
            raise FormatError(f"{where}: CHANNELS: expected Xposition, Yrotation and the like, got {word[:40]!r}")
    if len(set(channels)) < len(channels):
        raise FormatError(f"{where}: CHANNELS: expected different ones, got {' '.join(words)[:60]!r}")
    return channels


def _frames(lines: Sequence[str], start: int, count: int, path: Path, notes: list[str]) -> tuple[Tensor, float]:
    """Channel values (T, C), and the seconds of a frame."""
    told = seconds = None
    at = start + 1
    while at < len(lines) and (told is None or seconds is None):
        key, colon, value = lines[at].partition(":")
        if colon and key.lower() == "frames":
            told = int(numbers([value], f"{path}: line {at + 1}: Frames")[0])
        elif colon and " ".join(key.lower().split()) == "frame time":
            seconds = numbers([value], f"{path}: line {at + 1}: Frame Time")[0]
        elif lines[at]:
            raise FormatError(f"{path}: line {at + 1}: expected Frames: and Frame Time:, got {lines[at][:40]!r}")
        at += 1
    if told is None or seconds is None:
        raise FormatError(f"{path}: expected Frames: and Frame Time: after MOTION, got the end of the file")
    rows: list[array[float]] = []
    for number, line in enumerate(lines[at:], at + 1):
        if not line:
            continue
        row = numbers(line.split(), f"{path}: line {number}")
        if len(row) != count:
            raise FormatError(f"{path}: line {number}: expected {count} numbers, one a channel, got {len(row)}")
        rows.append(array("d", row))
    if not rows:
        raise FormatError(f"{path}: expected a line a frame below Frame Time, got none")
    if told != len(rows):
        notes.append(f"the header tells {told} frames, the file has {len(rows)}")
    return torch.from_numpy(np.array(rows, np.float64)).reshape(len(rows), count), seconds


def _positions(nodes: Sequence[_Node], values: Tensor) -> Tensor:
    """World positions (T, N, 3). A node's channels apply in their order, outermost first; positions replace OFFSET."""
    frames = len(values)
    turns = torch.eye(3, dtype=values.dtype).expand(frames, 3, 3)
    points = values.new_empty(frames, len(nodes), 3)
    worlds: list[Tensor] = []
    at = 0
    for i, node in enumerate(nodes):
        own = values[:, at : at + len(node.channels)]
        at += len(node.channels)
        place = values.new_tensor(node.offset).repeat(frames, 1)
        angles, order = [], ""
        for channel, column in zip(node.channels, own.unbind(1), strict=True):
            if channel.endswith("position"):
                place[:, "xyz".index(channel[0])] = column
            else:
                angles.append(column)
                order += channel[0].upper()
        parent = turns if node.parent < 0 else worlds[node.parent]
        points[:, i] = (parent @ place[..., None])[..., 0]
        if node.parent >= 0:
            points[:, i] += points[:, node.parent]
        worlds.append(parent @ euler_rotation(order, torch.stack(angles, 1).deg2rad()) if order else parent)
    return points


def write(motion: Motion, path: Path, saving: Saving) -> None:
    """Write the joints as a chain; :func:`fit_rig` finds its rotations.

    Raises:
        OutputError: the skeleton is no tree.
    """
    points = from_y_up(motion.filled(), saving.up).double()
    if not bool(motion.seen.all()):
        saving.warnings.append(
            f"BVH has no gaps: {100 * motion.unseen_share:.1f} % of the joints are filled in between frames"
        )
        never = [n for n, seen in zip(motion.skeleton.joints, motion.seen.any(0).tolist(), strict=True) if not seen]
        if never:
            saving.warnings.append(f"never seen, so laid on the joints beside them: {', '.join(never)}")
    rig = fit_rig(points, motion.skeleton, up=saving.up)
    off = (rig.positions() - points).norm(dim=-1)
    extra = [name for node, name in enumerate(rig.names) if node not in set(rig.joints)]
    if extra:
        saving.notes.append(f"joints without length were added, which turn single bones: {', '.join(extra)}")
    units, size = motion.units or "units", float(rig.offsets.norm(dim=-1).sum())
    told = f"the file's joints are up to {float(off.max()):.3g} {units} from ours ({float(off.mean()):.3g} on average)"
    if float(off.max()) < _NOISE * size:
        told = f"the file's joints agree: less than {_NOISE * size:.1g} {units} from ours"
    limit = 0.01 / METRES[motion.units] if motion.units in METRES else 2e-3 * size
    if float(off.max()) > limit:
        saving.warnings.append(f"{told}: BVH has one length for each bone")
    else:
        saving.notes.append(told)
    names = distinct([re.sub(r"[\s{}]+", "_", name) for name in rig.names])
    saving.told_names(rig.names, names)
    _write_rig(rig, names, path, saving.rate(motion))


def _write_rig(rig: Rig, names: Sequence[str], path: Path, rate: float) -> None:
    children: dict[int, list[int]] = {i: [] for i in range(-1, len(names))}
    for node, parent in enumerate(rig.parents):
        children[parent].append(node)
    lines, order = ["HIERARCHY"], []
    size = float(rig.offsets.norm(dim=-1).sum())
    places = max(6, 8 - math.floor(math.log10(size))) if size > 0 else 6  # decimals: small bodies need more
    stack: list[tuple[int, int]] = [(0, 0)]  # node (~node closes it) and depth
    while stack:
        node, depth = stack.pop()
        tab = "\t" * depth
        if node < 0:
            lines.append(f"{tab}}}")
            continue
        order.append(node)
        x, y, z = rig.offsets[node].tolist()
        place = "" if depth else "Xposition Yposition Zposition "
        lines += [f"{tab}{'JOINT' if depth else 'ROOT'} {names[node]}", f"{tab}{{"]
        lines += [f"{tab}\tOFFSET {x:.{places}f} {y:.{places}f} {z:.{places}f}"]
        lines += [f"{tab}\tCHANNELS {3 if depth else 6} {place}Zrotation Xrotation Yrotation"]
        if not children[node]:
            lines += [f"{tab}\tEnd Site", f"{tab}\t{{", f"{tab}\t\tOFFSET 0.000000 0.000000 0.000000", f"{tab}\t}}"]
        stack.append((~node, depth))
        stack += [(child, depth + 1) for child in reversed(children[node])]
    angles = as_array(euler_angles("ZXY", rig.turns[:, order]).rad2deg())
    angles = np.unwrap(angles, axis=0, period=360).reshape(len(angles), -1)
    lines += ["MOTION", f"Frames: {len(angles)}", f"Frame Time: {1 / rate:.12f}"]
    with path.open("w", encoding="utf-8", errors="replace", newline="\n") as file:
        file.write("\n".join(lines) + "\n")
        for root, row in zip(as_array(rig.root).tolist(), angles.tolist(), strict=True):
            file.write(" ".join([*(f"{v:.{places}f}" for v in root), *(f"{v:.6f}" for v in row)]) + "\n")


MOTION_READERS = (MotionReader("bvh", "BVH: joints by forward kinematics; y up unless told", recognises, read),)
WRITERS = (
    Writer(
        ".bvh",
        "BVH: a chain of joints in centimetres, y up, for Blender and other animation",
        None,
        write,
        unit="cm",
        fits=check_tree,
    ),
)
