"""Which joint of one body is which of another, by their names; never by their order."""

from __future__ import annotations

from collections import Counter
from collections.abc import Hashable, Sequence

from kcs_torch.anatomy import places_of_known, side_of
from kcs_torch.anatomy.names import part_of

__all__ = ["map_joints", "places_with_fingers"]

_NEARLY = {"thorax": "neck"}  # places so near each other that detectors mean the same by them


def map_joints(names: Sequence[str], wanted: Sequence[str]) -> list[int | None]:
    """Say where each wanted joint stands among names that may be spelt otherwise.

    Names match by the part of the body that they mean, beside their neighbours (``neck`` is higher up where there is a
    ``thorax``), then by their letters. What has no counterpart, or several, has none.

    Args:
        names: joints of one body.
        wanted: joints of another one.

    Returns:
        For each wanted joint its index in ``names``, or None.

    >>> map_joints(["l_wrist", "LShoulder", "MidHip", "tail"], ["pelvis", "shoulder.L", "left_wrist", "nose"])
    [2, 1, 0, None]
    """
    out: list[int | None] = [None] * len(wanted)
    taken: set[int] = set()
    places, places_wanted = places_with_fingers(names), places_with_fingers(wanted)
    for ours, theirs in (
        (list(zip(names, places, strict=True)), list(zip(wanted, places_wanted, strict=True))),
        (places, places_wanted),
        (_nearly(places), _nearly(places_wanted)),
        (list(names), list(wanted)),
        ([_plain(n) for n in names], [_plain(n) for n in wanted]),
    ):
        once, once_wanted = _where(ours), _where(theirs)
        for key, j in once_wanted.items():
            i = once.get(key)
            if i is not None and i not in taken and out[j] is None:
                out[j] = i
                taken.add(i)
    return out


def _where(keys: Sequence[Hashable]) -> dict[Hashable, int]:
    """The index of each key that is there once."""
    count = Counter(keys)
    return {key: i for i, key in enumerate(keys) if key is not None and count[key] == 1}


def _plain(name: str) -> str:
    """'Left Shoulder' and 'left_shoulder' alike."""
    return "".join(c for c in name.lower() if c.isalnum())


def places_with_fingers(names: Sequence[str]) -> list[tuple[str, str] | None]:
    """Side and place of each joint of a person or of a hand; None of others."""
    parts = [
        part_of(name, "hand") if place is None else place[1]
        for name, place in zip(names, places_of_known(names), strict=True)
    ]
    return [None if part is None else (side_of(name), part) for name, part in zip(names, parts, strict=True)]


def _nearly(places: Sequence[tuple[str, str] | None]) -> list[tuple[str, str] | None]:
    return [None if place is None else (place[0], _NEARLY.get(place[1], place[1])) for place in places]
