"""Several bodies of one file: their sources say which is which."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path

from kcs_torch.types.tracks import Tracks

__all__ = ["file_and_person", "file_of", "files_named", "shared", "tell_apart"]


def tell_apart(people: Iterable[Tracks]) -> list[Tracks]:
    """Let sources name the person, counted from 0, where several have the same one: messages are about one of them.

    Args:
        people: of one file, in the order of their numbers.
    """
    people = list(people)
    if len({one.source for one in people}) == len(people):
        return people
    return [replace(one, source=f"{one.source}, person {number}") for number, one in enumerate(people)]


def file_and_person(source: str) -> tuple[str, str]:
    """The file of a source without its folder, and the person; empty where the source names none.

    >>> file_and_person("shots/walk.json, person 1"), file_and_person("shots/walk.json")
    (('walk.json', 'person 1'), ('walk.json', ''))
    """
    file, comma, person = source.rpartition(", ")
    if comma and re.fullmatch(r"person \d+", person):
        return Path(file).name, person
    return Path(source).name, ""


def file_of(tracks: Tracks) -> str:
    """The source without the person, whom it may name."""
    return tracks.source.removesuffix(f", {file_and_person(tracks.source)[1]}")


def files_named(people: Iterable[Tracks]) -> str:
    """The files of one or several bodies, each once; of a single one also which person it is."""
    people = list(people)
    if len(people) == 1:
        return Path(people[0].source).name
    return ", ".join(dict.fromkeys(file_and_person(one.source)[0] for one in people))


def shared(notes: Sequence[Sequence[str]]) -> list[str]:
    """The notes that are true of everybody, in their order; of none where there is one body only.

    Args:
        notes: of each body.
    """
    if len(notes) < 2:
        return []
    return [note for note in dict.fromkeys(notes[0]) if all(note in others for others in notes[1:])]
