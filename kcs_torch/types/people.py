"""Several bodies of one file: their sources say which is which, and together they tell how large their image is."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path

import torch

from kcs_torch.types.image_size import usual_size
from kcs_torch.types.tracks import Tracks

__all__ = [
    "file_and_person",
    "file_of",
    "files_named",
    "guess_images",
    "of_one_image",
    "shared",
    "tell_apart",
]


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


def of_one_image(people: Sequence[Tracks]) -> list[list[int]]:
    """The numbers of those who are in one image: people of one file, which tells them apart; others by themselves.

    Who is there twice is there in several shots, each of which may have a camera of its own.
    """
    times = Counter(one.source for one in people)
    shots = {file_of(one) for one in people if times[one.source] > 1}
    groups: dict[tuple[object, ...], list[int]] = {}
    for i, one in enumerate(people):
        file, person = file_of(one), file_and_person(one.source)[1]
        image = (file, one.units, one.image_size) if person and file not in shots else (i,)
        groups.setdefault(image, []).append(i)
    return list(groups.values())


def guess_images(people: Iterable[Tracks]) -> list[Tracks]:
    """Let those who are in one image, whose size nobody says, all have the guess that they make together.

    Args:
        people: of any files. Who has a guess keeps it; of who is alone it is left to the tracks.
    """
    people = list(people)
    for group in of_one_image(people):
        first = people[group[0]]
        lacking = [i for i in group if people[i].image_guess is None and first.image_size is None]
        if lacking and len(group) > 1:
            shown = [people[i].points[people[i].seen].detach().to(first.points) for i in group]
            guess = usual_size(torch.cat(shown))
            for i in lacking:
                people[i] = replace(people[i], image_guess=guess)
    return people


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
