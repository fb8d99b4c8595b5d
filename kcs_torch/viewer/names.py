"""What to call the people of one picture."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from kcs_torch.errors import OptionError
from kcs_torch.types import Reconstruction
from kcs_torch.types.people import file_and_person
from kcs_torch.types.size import unit_ratio

__all__ = ["as_people", "clip_rate", "person_names", "printable"]


def as_people(results: Reconstruction | Sequence[Reconstruction], what: str) -> list[Reconstruction]:
    """One or several results as a list, all in the first one's unit.

    Raises:
        OptionError: there is none, one is something else, or its unit is not known in the first one's; ``what`` is to
            be made of them.
    """
    people = [results] if isinstance(results, Reconstruction) else list(results)
    if not people:
        raise OptionError(f"{what}: expected at least one result, got none")
    if wrong := [one for one in people if not isinstance(one, Reconstruction)]:
        raise OptionError(f"{what}: expected results of reconstruct(), got {type(wrong[0]).__name__}")
    return [_in_unit(one, people[0].units, what) for one in people]


def _in_unit(result: Reconstruction, units: str, what: str) -> Reconstruction:
    """A result in this unit."""
    if result.units == units:
        return result
    ratio = unit_ratio(result.units, units)
    if ratio is None:
        raise OptionError(
            f"{what}: expected everybody in one unit of length, got {units} and {result.units} ({result.tracks.source})"
            ": give each one's true size, with scaled(units=..., height=...) (kcs-torch view: --scale height=1.75m)"
        )
    return result.scaled(units=units, factor=ratio)


def clip_rate(results: Sequence[Reconstruction], what: str) -> float | None:
    """Frames per second of people of one clip, or None where nobody's are known.

    Args:
        results: the people.
        what: is made of them, for messages.

    Raises:
        OptionError: the frame rates differ.
    """
    rates = {r.fps for r in results} - {None}
    if len(rates) > 1:
        raise OptionError(f"{what}: expected people of one clip, got frame rates {', '.join(f'{r:g}' for r in rates)}")
    return next(iter(rates), None)


def printable(text: str) -> str:
    """Text that can be encoded: names of files may hold bytes that are no letters."""
    return text.encode("utf-8", "replace").decode()


def person_names(results: Sequence[Reconstruction]) -> list[str]:
    """Name people by what tells them apart: the source's file, its person, else the method, else their order."""
    if len({r.tracks.source for r in results}) == len(results) > 1:
        files, people = zip(*(file_and_person(r.tracks.source) for r in results), strict=True)
        if len(set(files)) == 1 and all(people):
            return list(people)
    sources = [printable(Path(r.tracks.source).name) for r in results]
    methods = [printable(r.method) for r in results]
    if len(results) == 1:
        return sources
    for names in (sources, methods):
        if len(set(names)) == len(names):
            return names
    return [f"person {k}" for k in range(len(results))]
