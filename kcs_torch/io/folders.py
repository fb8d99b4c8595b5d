"""Files of a folder in the order that people mean: ``f2`` before ``f10``, and their frame numbers."""

from __future__ import annotations

import itertools
import math
import re
from collections.abc import Sequence
from pathlib import Path

from kcs_torch.errors import FormatError, listed

__all__ = ["frame_numbers", "frames_of_files", "natural_key", "sibling_files"]

_NAME = re.compile(r"(?P<prefix>.*?)(?P<number>[0-9]+)?(?:_keypoints)?\Z", re.DOTALL)
_SPARSE = 20  # frames per file, above which numbers in file names are no frame numbers (time stamps, say)


def natural_key(name: str) -> list[tuple[int, int, str]]:
    """Sort key that compares runs of digits as numbers, however long they are.

    >>> sorted(["f10", "f2", "f1"], key=natural_key)
    ['f1', 'f2', 'f10']
    """
    parts = re.split(r"([0-9]+)", name)
    digits = [p.lstrip("0") for p in parts]
    return [(1, len(d), d) if i % 2 else (0, 0, p) for i, (p, d) in enumerate(zip(parts, digits, strict=True))]


def sibling_files(path: Path) -> list[Path]:
    """The files of a folder in natural order; of a path that does not exist, those whose names begin like it.

    ``shots/cam01`` and ``shots/cam01*`` both mean the files of the folder ``shots`` whose names begin with ``cam01``.
    Hidden files are left out.
    """
    if path.is_dir():
        found = list(path.iterdir())
    elif path.exists() or not path.name or not path.parent.is_dir():
        found = []
    else:
        pattern = path.name if "*" in path.name else f"{path.name}*"
        rule = re.compile(".*".join(map(re.escape, pattern.split("*"))) + r"\Z", re.DOTALL)
        found = [f for f in path.parent.iterdir() if rule.match(f.name)]
    files = [f for f in found if not f.name.startswith(".") and f.is_file()]
    return sorted(files, key=lambda f: natural_key(f.name))


def frames_of_files(files: Sequence[Path], given: Path, notes: list[str]) -> list[int]:
    """The frame of each file of one recording, in natural order, by the number at the end of its name.

    Args:
        files: such as ``cam1_0012.json`` or ``cam1_0012_keypoints.json``.
        given: the path that names them, for messages.
        notes: sentences for the user; added to.

    Raises:
        FormatError: what stands before the numbers differs, as of several recordings, or a number is there twice.
    """
    matches = [_NAME.match(file.stem) for file in files]
    numbers = [int(match["number"]) if match and match["number"] else None for match in matches]
    prefixes = sorted({match["prefix"] for match in matches if match and match["number"]})
    if len(prefixes) > 1:
        ways = " or ".join(repr(str(files[0].parent / f"{prefix}*")) for prefix in prefixes[:4])
        raise FormatError(
            f"{given}: expected the files of one recording, got {len(prefixes)} kinds of file names: give {ways}"
        )
    for (one, number), (other, again) in itertools.pairwise(zip(files, numbers, strict=True)):
        if number is not None and number == again:
            raise FormatError(f"{given}: expected one file a frame, got {one.name} and {other.name}")
    called = [file.name.encode("utf-8", "replace").decode() for file in files]
    return frame_numbers(numbers, notes, called=called)[0]


def frame_numbers(
    numbers: Sequence[int | None],
    notes: list[str],
    *,
    names: str = "file names",
    one: str = "file",
    whole: str = "file",
    called: Sequence[str] = (),
) -> tuple[list[int], int]:
    """Turn the numbers of a folder's files, ascending, into frame indices that begin at 0.

    Files numbered 7, 8, 10 are frames 0, 1, 3. A common step (0, 5, 10) is taken for a frame's width. What was
    assumed is added to ``notes``.

    Args:
        numbers: the number of each file, None where its name holds none.
        notes: sentences for the user; added to.
        names: what holds the numbers, for the notes.
        one: what a single one of these is, for the notes.
        whole: what a frame without a number lacks, for the notes.
        called: what holds each number, for the notes.

    Returns:
        The frames, and the step in which the numbers count them, by which frames a second are fewer than the
        numbers'; 1 where the numbers are taken for none of frames.

    >>> notes = []
    >>> frame_numbers([0, 5, 15], notes)
    ([0, 1, 3], 5)
    >>> notes[1]
    '1 of 4 frames has no file (number 10): unseen'
    """
    known = [n for n in numbers if n is not None]
    in_order = list(range(len(numbers))), 1
    if numbers and numbers[0] not in (None, 0, 1):
        notes.append(f"frame 0 is {one} {called[0] if called else numbers[0]}")
    if len(numbers) < 2:
        return in_order
    steps = [b - a for a, b in itertools.pairwise(known)]
    if len(known) < len(numbers) or min(steps) < 0:
        odd = [f"'{name}'" for name, number in zip(called, numbers, strict=False) if number is None]
        some = f"{listed(odd, 3)} {'holds' if len(odd) == 1 else 'hold'} no frame number, unlike the other {names}"
        none = f"the {names} hold no frame numbers"
        said = f"the numbers of the {names} do not ascend" if len(known) == len(numbers) else none
        notes.append(f"{some if odd and known else said}: frames are taken in the order of the {names}")
        return in_order
    if 0 in steps:
        again = sorted({n for n, step in zip(known, steps, strict=False) if not step})
        verb, plural = ("stands", "") if len(again) == 1 else ("stand", "s")
        notes.append(
            f"number{plural} {listed(again, 5)} {verb} for several of the {names}: each of these is taken as a frame "
            "of its own"
        )
        return in_order
    step = math.gcd(*steps)
    frames = [(n - known[0]) // step for n in known]
    if frames[-1] + 1 > _SPARSE * len(frames):
        notes.append(
            f"the numbers of the {len(frames)} {names} run from {known[0]} to {known[-1]}, too far apart for "
            f"frame numbers: frames are taken in the order of the {names}"
        )
        return in_order
    if step > 1:
        notes.append(
            f"the {names} count in steps of {step}: each step is taken as one frame, at 1/{step} of the video's fps"
        )
    gaps = sorted(set(range(frames[-1] + 1)) - set(frames))
    if gaps:
        shown = listed((known[0] + g * step for g in gaps), 5)
        verb, plural = ("has", "") if len(gaps) == 1 else ("have", "s")
        notes.append(f"{len(gaps)} of {frames[-1] + 1} frames {verb} no {whole} (number{plural} {shown}): unseen")
    return frames, step
