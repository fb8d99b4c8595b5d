"""The plain values of a pickle that nobody vouches for: no class is looked up, no function called, so no code runs."""

from __future__ import annotations

import pickletools
from typing import Any

__all__ = ["read_literals"]

_VALUES = {
    *("NONE", "NEWTRUE", "NEWFALSE", "INT", "LONG", "BININT", "BININT1", "BININT2", "LONG1", "FLOAT", "BINFLOAT"),
    *("UNICODE", "SHORT_BINUNICODE", "BINUNICODE", "BINUNICODE8", "STRING", "BINSTRING", "SHORT_BINSTRING"),
}
_FIXED = {"NONE": None, "NEWTRUE": True, "NEWFALSE": False}
_KEEP = {"PUT", "BINPUT", "LONG_BINPUT", "MEMOIZE"}
_RECALL = {"GET", "BINGET", "LONG_BINGET"}
_TUPLES = {"EMPTY_TUPLE": 0, "TUPLE1": 1, "TUPLE2": 2, "TUPLE3": 3}


def read_literals(data: bytes) -> Any:
    """Read a pickle of None, truth values, numbers, text, and lists and tuples of them.

    The result may hold itself, and may be nested as deeply as the pickle says: look no deeper than is needed.

    Raises:
        ValueError: it is damaged, or holds anything else.

    >>> import pickle
    >>> read_literals(pickle.dumps([("nose", "x"), 1.5]))
    [('nose', 'x'), 1.5]
    >>> read_literals(pickle.dumps(print))
    Traceback (most recent call last):
    ...
    ValueError: expected plain values, got a pickle with STACK_GLOBAL: refused
    """
    stack: list[Any] = []
    marks: list[int] = []
    memo: dict[int, Any] = {}

    def pop_to_mark() -> list[Any]:
        start = marks.pop()
        values = stack[start:]
        del stack[start:]
        return values

    try:
        argument: Any
        for opcode, argument, _ in pickletools.genops(data):
            name = opcode.name
            if name in _VALUES:
                stack.append(_FIXED.get(name, argument))
            elif name in _KEEP:
                memo[len(memo) if name == "MEMOIZE" else argument] = stack[-1]
            elif name in _RECALL:
                stack.append(memo[argument])
            elif name == "MARK":
                marks.append(len(stack))
            elif name == "EMPTY_LIST":
                stack.append([])
            elif name in _TUPLES:
                count = len(stack) - _TUPLES[name]
                stack[count:] = [tuple(stack[count:])]
            elif name in ("LIST", "TUPLE"):
                values = pop_to_mark()
                stack.append(values if name == "LIST" else tuple(values))
            elif name in ("APPEND", "APPENDS"):
                added = pop_to_mark() if name == "APPENDS" else [stack.pop()]
                if not isinstance(stack[-1], list):
                    raise ValueError("it appends to what is no list")
                stack[-1].extend(added)
            elif name not in ("PROTO", "FRAME", "STOP"):
                raise ValueError(f"expected plain values, got a pickle with {name}: refused")
        return stack.pop()
    except (LookupError, TypeError, OverflowError, UnicodeError) as error:
        raise ValueError(f"a damaged pickle: {error}") from None
