"""JSON that nobody vouches for: recognised by its head, read within bounds, its numbers checked one by one."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Iterator
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kcs_torch.errors import FormatError
from kcs_torch.io.registry import read_error

__all__ = ["as_frame_number", "as_joints", "as_text", "entries", "kind", "outline", "read_json", "short"]

LIMIT = 2**30  # bytes of one file; Python needs several times as much
MOST_PIXELS = 1e9  # from an image's corner; beyond it is no place in one
MOST_JOINTS = 2000
SCORE = 1.2  # up to which third numbers may be networks' scores
LIKE = 0.9  # correlation of third numbers and scores from which on they are the same in other words
_BLANK = b"\xef\xbb\xbf \t\r\n"  # what may stand before the JSON, a byte order mark included
_TOKEN = re.compile(rb'"(?:[^"\\]|\\.)*"|[{}\[\],:]|"|[^\s{}\[\],:"]+', re.DOTALL)
_DEEPEST = 16  # levels that an outline goes down

Route = tuple[str, ...]


@lru_cache(maxsize=4)
def outline(head: bytes) -> frozenset[Route]:
    """Tell which keys hold what in the beginning of a JSON text, which may be cut off anywhere.

    Args:
        head: the first bytes of a file, of whatever kind.

    Returns:
        Routes from the root to each value: keys, ``"[]"`` for an entry of a list, and last the kind of the value:
        "dict", "list", "text", "number", "null" or "bool". Nothing where the text does not begin as JSON does.

    >>> sorted(outline(b'[{"image_id": 3, "box": [0.5, '))
    [('[]', 'box', '[]', 'number'), ('[]', 'box', 'list'), ('[]', 'dict'), ('[]', 'image_id', 'number'), ('list',)]
    """
    if not head.lstrip(_BLANK).startswith((b"{", b"[")):
        return frozenset()
    found: set[Route] = set()
    route: list[str] = []
    objects: list[bool] = []  # whether each level is an object, not a list
    wants_key = False
    for match in _TOKEN.finditer(head.lstrip(_BLANK)):
        token = match.group()
        if token in (b"{", b"["):
            wants_key = token == b"{"
            found.add((*route, "dict" if wants_key else "list"))
            route.append("" if wants_key else "[]")
            objects.append(wants_key)
            if len(route) > _DEEPEST:
                break
        elif token in (b"}", b"]"):
            route.pop()
            objects.pop()
            if not route:
                break
        elif token == b",":
            wants_key = objects[-1]
        elif token == b":":
            wants_key = False
        elif token == b'"':  # a text that is cut off
            break
        elif token.startswith(b'"') and wants_key:
            route[-1] = token[1:-1].decode("utf-8", "replace")
        elif token.startswith(b'"'):
            found.add((*route, "text"))
        else:
            words = {b"null": "null", b"true": "bool", b"false": "bool"}
            found.add((*route, words.get(token, "number")))
    return frozenset(found)


def read_json(path: Path, *, lines: bool = False) -> Any:
    """Read a JSON file.

    Args:
        path: the file.
        lines: whether one with a value on each line is read, too, as their list.

    Raises:
        FormatError: it cannot be read, is larger than 1 GiB, or is no JSON.
    """
    try:
        size = path.stat().st_size
        if size > LIMIT:
            raise FormatError(f"{path}: expected 1 GiB of JSON at most, got {size} bytes: split the file")
        text = path.read_bytes()
        if lines and len(first := text.split(b"\n", 1)) > 1 and first[1].strip() and _is_json(first[0]):
            return [_value(line, i) for i, line in enumerate(text.split(b"\n"), 1) if line.strip()]
        return json.loads(text)
    except OSError as error:
        raise read_error(path, error) from None
    except FormatError:
        raise
    except RecursionError:
        raise FormatError(f"{path}: expected JSON, got text that is nested too deeply") from None
    except MemoryError:
        raise FormatError(f"{path}: does not fit into memory: split the file") from None
    except ValueError as error:  # also of bytes that are no text
        raise FormatError(f"{path}: expected JSON, got text that does not parse: {error}") from None


def _is_json(line: bytes) -> bool:
    """Whether a line is a JSON value by itself."""
    try:
        json.loads(line)
    except ValueError:
        return False
    return True


def _value(line: bytes, number: int) -> Any:
    """The value of a line; an error that names the line if it is none."""
    try:
        return json.loads(line)
    except ValueError as error:
        raise ValueError(f"line {number}: {error}") from None


def entries(value: Any, where: str) -> Iterator[tuple[str, dict[str, Any]]]:
    """The objects of a list, each with words that say where it stands.

    Raises:
        FormatError: it is no list, or holds something else.
    """
    if not isinstance(value, list):
        raise FormatError(f"{where}: expected a list, got {kind(value)}")
    for i, entry in enumerate(value):
        if not isinstance(entry, dict):
            raise FormatError(f"{where}: entry {i}: expected an object with keys, got {kind(entry)}")
        yield f"{where}: entry {i}", entry


def as_joints(values: Any, where: str, scores: Any = None) -> NDArray[np.float64]:
    """Return the joints of one person (N, 3): x, y, confidence; NaN where the file says null or NaN.

    Args:
        values: a flat list ``[x, y, score, ...]``, or a list of ``[x, y]``, ``[x, y, score]`` or longer rows.
        where: for messages.
        scores: N numbers, where they stand on their own; they go before those among ``values``. Without any, 1.

    Raises:
        FormatError: these are no joints, or have x, y and z beside the scores.
    """
    if not isinstance(values, list) or not values:
        raise FormatError(f"{where}: expected a list of numbers x, y, score, got {kind(values)}")
    if isinstance(values[0], list):
        width = len(values[0])
        if not all(isinstance(row, list) and len(row) == width for row in values):
            raise FormatError(f"{where}: expected as many numbers of each joint, got rows of several lengths")
        flat = [v for row in values for v in row]
    else:
        width, flat = 3, values
        if scores is not None and len(values) == 2 * _length(scores):
            width = 2
    if width < 2 or len(flat) % width:
        raise FormatError(f"{where}: expected 3 numbers a joint, got {len(flat)} numbers")
    if len(flat) > width * MOST_JOINTS:
        raise FormatError(f"{where}: expected at most {MOST_JOINTS} joints, got {len(flat) // width}")
    rows = np.array(_numbers(flat, where)).reshape(-1, width)
    joints = np.ones((len(rows), 3))
    joints[:, : min(width, 3)] = rows[:, :3]
    if scores is not None:
        if _length(scores) != len(rows):
            raise FormatError(f"{where}: expected {len(rows)} scores, one a joint, got {kind(scores)}")
        joints[:, 2] = _numbers(scores, where)
        if width == 3 and _is_depth(rows[:, 2], joints[:, 2]):
            raise FormatError(
                f"{where}: expected 2D joints, got 3D motion (x, y, z, with the scores apart): give the file of 2D "
                "joints from which it was made"
            )
    return joints


def _is_depth(third: NDArray[np.float64], scores: NDArray[np.float64]) -> bool:
    """Whether third numbers are z: neither like the scores, nor shares, nor flags as COCO's 0, 1 and 2."""
    both = np.isfinite(third) & np.isfinite(scores)
    third, scores = third[both], scores[both]
    shares = (((third >= 0) & (third <= SCORE)) | (third == -1)).all() or np.isin(third, (-1, 0, 1, 2, 3)).all()
    if shares or np.allclose(third, scores, atol=0.05):
        return False
    a, b = third - third.mean(), scores - scores.mean()
    return bool((third < 0).any() or (a * b).sum() < LIKE * np.sqrt((a * a).sum() * (b * b).sum()))


def _length(value: Any) -> int:
    return len(value) if isinstance(value, list) else -1


def _numbers(values: list[Any], where: str) -> list[float]:
    """Numbers, checked one by one: JSON may hold anything in their place."""
    out = []
    for i, v in enumerate(values):
        if v is None:
            v = math.nan
        elif type(v) not in (int, float):
            raise FormatError(f"{where}: number {i}: expected a number, got {kind(v)}")
        elif abs(v) > MOST_PIXELS:
            raise FormatError(f"{where}: number {i} is {short(v)}: expected pixels and confidences")
        out.append(float(v))
    return out


def as_text(value: Any) -> str:
    """Text of a file as it can be printed: short, and without halves of characters."""
    try:
        text = str(value)
    except ValueError:  # Python writes no integers of more than 4300 digits
        text = "a number of very many digits"
    text = text if len(text) <= 200 else f"{text[:197]}..."
    return text.encode("utf-8", "replace").decode("utf-8")


def as_frame_number(value: Any) -> int | None:
    """A whole number that may count frames; None for anything else."""
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        return None
    if not abs(value) < 2**53 or value != int(value):
        return None
    return int(value)


def kind(value: Any) -> str:
    """What a JSON value is, in a few words."""
    if isinstance(value, list):
        return f"a list of {len(value)}"
    names = {dict: "an object with keys", str: "text", bool: "true or false", type(None): "null or nothing"}
    return names.get(type(value), "a number")


def short(value: float) -> str:
    """A number for a message; Python writes no integers of more than 4300 digits, nor as floats of more than 308."""
    return f"{value:.3g}" if isinstance(value, float) else f"a number of {len(hex(abs(value))) - 2} hexadecimal digits"
