"""Values that users give, and the annotations of what takes them."""

from __future__ import annotations

import math
import numbers
import types
import typing
from collections.abc import Sequence
from typing import Any

__all__ = ["is_a", "spoken"]

_WORDS = {
    int: "a whole number",
    float: "a number",
    bool: "true or false",
    str: "text",
    types.NoneType: "none",
}


def is_a(value: Any, hint: Any) -> bool:
    """Whether a value is what an annotation says; whole numbers pass for numbers, NaN does not."""
    origin, inner = typing.get_origin(hint), typing.get_args(hint)
    if origin in (typing.Union, types.UnionType):
        return any(is_a(value, h) for h in inner)
    if origin is typing.Literal:
        return any(isinstance(value, type(choice)) and value == choice for choice in inner)
    if origin in (Sequence, tuple):  # or a tensor or array that stands for one
        listed = value.tolist() if hasattr(value, "tolist") else value
        if not isinstance(listed, Sequence) or isinstance(listed, str):
            return False
        fixed = origin is tuple and Ellipsis not in inner
        if fixed and len(listed) != len(inner):
            return False
        return all(is_a(v, h) for v, h in zip(listed, inner if fixed else [inner[0]] * len(listed), strict=True))
    if hint in (int, float):
        if isinstance(value, bool) or not isinstance(value, numbers.Integral if hint is int else numbers.Real):
            return False
        try:
            return not math.isnan(value)
        except OverflowError:  # larger than any float
            return False
    return isinstance(value, hint) if isinstance(hint, type) else True


def spoken(hint: Any) -> str:
    """An annotation in words that a user knows.

    >>> spoken(int | None)
    'a whole number or none'
    """
    origin, inner = typing.get_origin(hint), typing.get_args(hint)
    if origin in (typing.Union, types.UnionType):
        return " or ".join(spoken(h) for h in inner)
    if origin is typing.Literal:
        return " or ".join(map(str, inner))
    if hint in _WORDS:
        return _WORDS[hint]
    return "a list such as [[left_wrist, right_wrist]]" if origin else getattr(hint, "__name__", str(hint))
