"""Searches that refine hypotheses now and then, written one clip at a time and run many clips at once.

A search is a generator: it yields the tasks that it wants refined and is sent their solutions. :func:`run` serves one
search, :func:`together` several in lockstep, so that the tasks of all clips are refined as one batch.
"""

from __future__ import annotations

from collections.abc import Generator, Sequence
from typing import TypeVar

from kcs_torch.methods.pkc.objective import Refined, Task, minimise_all

__all__ = ["Search", "run", "together"]

Result = TypeVar("Result")
Search = Generator[list[Task], list[Refined], Result]


def run(search: Search[Result]) -> Result:
    """Run a search and return what it finds."""
    answers: list[Refined] | None = None
    while True:
        try:
            tasks = next(search) if answers is None else search.send(answers)
        except StopIteration as end:
            return end.value
        answers = minimise_all(tasks)


def together(searches: Sequence[Search[Result]]) -> Search[list[Result]]:
    """One search that runs several in lockstep and returns what each finds."""
    found: dict[int, Result] = {}
    asked: dict[int, list[Task]] = {}

    def advance(i: int, answers: list[Refined] | None) -> None:
        try:
            asked[i] = next(searches[i]) if answers is None else searches[i].send(answers)
        except StopIteration as end:
            found[i] = end.value

    for i in range(len(searches)):
        advance(i, None)
    while asked:
        order = list(asked.items())
        asked.clear()
        answers = iter((yield [task for _, tasks in order for task in tasks]))
        for i, tasks in order:
            advance(i, [next(answers) for _ in tasks])
    return [found[i] for i in range(len(searches))]
