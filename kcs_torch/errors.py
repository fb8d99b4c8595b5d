"""What can go wrong, said in the user's words.

Every error that bad input causes is a :class:`KcsError`, which is a ``ValueError``. Messages read
*what: expected ..., got ...* and end with the fix.
"""

from __future__ import annotations

import difflib
import sys
import warnings
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from itertools import islice
from typing import Any

__all__ = [
    "ConvergenceWarning",
    "FormatError",
    "KcsError",
    "KcsWarning",
    "NotFiniteError",
    "OptionError",
    "OutputError",
    "ShapeError",
    "SkeletonError",
    "counted",
    "listed",
    "unknown",
    "users_level",
    "warnings_told",
]


class KcsError(ValueError):
    """Base of every error that this library raises for bad input."""


class ShapeError(KcsError):
    """An array has the wrong shape, type or values."""


class NotFiniteError(ShapeError):
    """A matrix to factorise, or what a network lifted, holds NaN or infinite numbers."""


class SkeletonError(KcsError):
    """A skeleton is inconsistent, unknown, or does not fit the tracks."""


class FormatError(KcsError):
    """A file cannot be read as the format it claims or seems to be."""


class OptionError(KcsError):
    """An option, method or field name is unknown, or its value is out of range."""


class OutputError(KcsError):
    """A result cannot be written to where it was asked to go."""


class KcsWarning(UserWarning):
    """Base of the warnings of this library."""


class ConvergenceWarning(KcsWarning):
    """An iteration stopped at its limit before it converged; the result says ``converged=False``."""


def counted(number: int, what: str) -> str:
    """A number of things, in the singular or the plural.

    >>> counted(1, "frame"), counted(2, "frame")
    ('1 frame', '2 frames')
    """
    return f"{number} {what}" if number == 1 else f"{number} {what}s"


def listed(things: Iterable[object], most: int) -> str:
    """Things in a row, no more than ``most``.

    >>> listed("abc", 3), listed(range(9), 2)
    ('a, b, c', '0, 1, ...')
    """
    words = list(map(str, islice(things, most + 1)))
    return ", ".join([*words[:most], *(["..."] if len(words) > most else [])])


def unknown(what: str, name: object, choices: Iterable[str], error: type[KcsError] = OptionError) -> KcsError:
    """Build the error for a name that is not among ``choices``; it suggests the nearest ones.

    >>> str(unknown("method", "sfma", ["kcs", "sfam"]))
    "unknown method 'sfma': did you mean 'sfam'? (choices: kcs, sfam)"
    """
    choices = sorted(choices)
    shown = repr(name) if len(repr(name)) <= 100 else f"{repr(name)[:96]} ..."  # it may come from a file
    close = difflib.get_close_matches(str(name)[:100], choices, n=2)
    if not close:  # COCO17, say
        small = {choice.lower(): choice for choice in choices}
        close = [small[found] for found in difflib.get_close_matches(str(name)[:100].lower(), small, n=2)]
    hint = f": did you mean {' or '.join(repr(c) for c in close)}?" if close else ":"
    listing = ", ".join(choice or "''" for choice in choices)
    listing = f"(choices: {listing})" if close else f"choices are {listing}"
    return error(f"unknown {what} {shown}{hint} {listing}")


def users_level() -> int:
    """The stack level at which a warning names the user's own line, however deep in this package it is given."""
    level, frame = 1, sys._getframe(1)
    while frame.f_back is not None and frame.f_globals.get("__name__", "").partition(".")[0] == "kcs_torch":
        level, frame = level + 1, frame.f_back
    return level


@contextmanager
def warnings_told(tell: Callable[[str], object]) -> Iterator[None]:
    """Hand all warnings of this library to ``tell``, repeated ones too; others go where they usually do."""
    usual = warnings.showwarning

    def show(message: Warning | str, category: type[Warning], *rest: Any) -> None:
        if issubclass(category, KcsWarning):
            tell(str(message))
        else:
            usual(message, category, *rest)

    with warnings.catch_warnings():
        warnings.simplefilter("always", KcsWarning)
        warnings.showwarning = show  # type: ignore[assignment]
        yield
