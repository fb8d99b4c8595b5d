"""What numbers given to training may be."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

from kcs_torch.errors import OptionError
from kcs_torch.types.hints import is_a

__all__ = ["AMOUNT", "COUNT", "COUNT_OR_NONE", "POSITIVE", "SHARE", "WHOLE", "Rule", "check_options"]

Rule = tuple[Any, Callable[[Any], bool], str]
"""The type of an option, what holds of values of that type, and both in words."""

WHOLE: Rule = int, lambda _: True, "a whole number"
COUNT: Rule = int, lambda x: x >= 1, "a whole number, at least 1"
COUNT_OR_NONE: Rule = int | None, lambda x: x is None or x >= 1, f"{COUNT[-1]}, or None"
AMOUNT: Rule = float, lambda x: 0 <= x < math.inf, "a number not below 0"
POSITIVE: Rule = float, lambda x: x > 0, "a positive number"
SHARE: Rule = float, lambda x: 0 <= x <= 1, "a share within 0..1"


def check_options(owner: str, **options: tuple[Any, Rule]) -> None:
    """Check options, each given as its value and its rule.

    Raises:
        OptionError: one is of another type, or its rule does not hold.
    """
    for name, (value, (kind, holds, expected)) in options.items():
        if not is_a(value, kind) or not holds(value):
            raise OptionError(f"{owner}: {name}: expected {expected}, got {value!r}")
