"""Frames of a file that names its images: ``12.jpg``, ``clip/frame_000012.png``, 785."""

from __future__ import annotations

import re
from collections.abc import Hashable, Mapping, Sequence

from kcs_torch.io.containers.jsonfile import as_text
from kcs_torch.io.contents.people import Sighting
from kcs_torch.io.folders import frame_numbers, natural_key

__all__ = ["as_track_id", "by_image", "by_number"]

_WHOLE = re.compile(r"(0|-?[1-9][0-9]{0,17})(?:\.0*)?")
_NAME = re.compile(r"(?P<prefix>.*?)(?P<number>[0-9]{1,15})?(?P<suffix>\.[A-Za-z]\w*)?\Z", re.DOTALL)


def by_image(images: Mapping[str, Sequence[Sighting]], notes: list[str]) -> list[list[Sighting]]:
    """Put the people of each image into frames by the numbers in the images' names, or in the order of the names.

    Args:
        images: the people of each image by its name.
        notes: sentences for the user on what was assumed; added to.

    Returns:
        The people of each frame; the first image is frame 0.
    """
    names = sorted(images, key=natural_key)
    if not names:
        return []
    matches = [_NAME.match(name) for name in names]
    numbers = [int(m["number"]) if m and m["number"] else None for m in matches]
    prefixes = {m["prefix"] for m in matches if m}
    if len(prefixes) > 1:
        notes.append(f"the images' names begin in {len(prefixes)} ways: frames are taken in the order of the names")
        return [list(images[name]) for name in names]
    order = sorted(range(len(names)), key=lambda i: (numbers[i] is None, numbers[i] or 0))
    called = [as_text(names[i]) for i in order]
    return _spread([images[names[i]] for i in order], [numbers[i] for i in order], notes, called)


def by_number(numbered: Mapping[int, Sequence[Sighting]], notes: list[str]) -> list[list[Sighting]]:
    """Put the people of each numbered frame in order, frames without any between them. As :func:`by_image`.

    Args:
        numbered: the people of each frame by its number.
        notes: sentences for the user on what was assumed; added to.
    """
    numbers = sorted(numbered)
    return _spread([numbered[n] for n in numbers], numbers, notes, [str(n) for n in numbers[:1]])


def _spread(
    people: Sequence[Sequence[Sighting]], numbers: Sequence[int | None], notes: list[str], called: Sequence[str]
) -> list[list[Sighting]]:
    frames, _ = frame_numbers(numbers, notes, names="images", one="image", whole="person", called=called)
    out: list[list[Sighting]] = [[] for _ in range(frames[-1] + 1)] if frames else []
    for frame, found in zip(frames, people, strict=True):
        out[frame] = list(found)
    return out


def as_track_id(value: object) -> Hashable:
    """A track id as detectors write it, a number or text, sometimes in a list of one; None for anything else.

    However it is spelt: text that is a whole number is this number.

    >>> as_track_id(" 3.0"), as_track_id(3), as_track_id("03"), as_track_id("")
    (3, 3, '03', None)
    """
    while isinstance(value, list) and len(value) == 1:
        value = value[0]
    if isinstance(value, str):
        value = value.strip()
        value = int(whole[1]) if (whole := _WHOLE.fullmatch(value)) else value
    elif isinstance(value, float) and value.is_integer():
        value = int(value)
    if isinstance(value, bool) or not isinstance(value, (int, float, str)) or value in (-1, "") or value != value:
        return None
    return value
