"""Solvers of one clip that now and then ask for work that several clips can share, run many clips at once.

A search is a generator: it yields requests and is sent their answers. :func:`run` serves one search, :func:`together`
makes one of several that go in lockstep, so that the requests of all clips are answered as one batch.
"""

from __future__ import annotations

from collections.abc import Callable, Generator, Sequence
from typing import TypeVar

__all__ = ["Search", "run", "together"]

Request = TypeVar("Request")
Answer = TypeVar("Answer")
Result = TypeVar("Result")
Search = Generator[list[Request], list[Answer], Result]


def run(search: Search[Request, Answer, Result], serve: Callable[[list[Request]], list[Answer]]) -> Result:
    """Run a search, whose requests are answered by ``serve``, and return what it finds."""
    answers: list[Answer] | None = None
    while True:
        try:
            requests = next(search) if answers is None else search.send(answers)
        except StopIteration as end:
            return end.value
        answers = None  # of long clips they are large, and it is for the search to keep them
        answers = serve(requests)
        del requests


def together(
    searches: Sequence[Search[Request, Answer, Result]], late: Callable[[Request], bool] = lambda _: False
) -> Search[Request, Answer, list[Result]]:
    """One search that runs several in lockstep and returns what each finds.

    Those that ask for something ``late`` wait until none asks for anything else: what they come to by ways of different
    lengths is then one batch.
    """
    found: dict[int, Result] = {}
    asked: dict[int, list[Request]] = {}

    def advance(i: int, answers: list[Answer] | None) -> None:
        try:
            asked[i] = next(searches[i]) if answers is None else searches[i].send(answers)
        except StopIteration as end:
            found[i] = end.value

    for i in range(len(searches)):
        advance(i, None)
    while asked:
        waits = {i: any(map(late, asked[i])) for i in sorted(asked)}
        order = [(i, asked.pop(i)) for i, wait in waits.items() if not wait or all(waits.values())]
        answers = iter((yield [request for _, requests in order for request in requests]))
        for i, requests in order:
            advance(i, [next(answers) for _ in requests])
    return [found[i] for i in range(len(searches))]
