"""Arrays of objects, which numpy keeps as pickles: read without calling anything that a pickle asks for.

The few functions that numpy's own pickles of arrays call have stand-ins here, in plain Python, that make arrays of
numbers or texts from the bytes of the file; everything else is refused.
"""

from __future__ import annotations

import pickle
import re
from typing import Any, BinaryIO, ClassVar

import numpy as np

from kcs_torch.errors import FormatError
from kcs_torch.io.containers.jsonfile import as_text

__all__ = ["load_arrays", "opened"]

_CODE = re.compile(r"[<>=|]?([fiub][1248]|f16|[SU][0-9]{1,4})\Z")

_KEYS = (str, bytes, int, float, np.generic)  # what a mapping may have as keys


class _Type:
    """Stand-in for a numpy type: its code and its order of bytes."""

    def __init__(self, code: Any = "", *_: Any) -> None:
        self.code = code.decode("latin1") if isinstance(code, bytes) else str(code)
        self.order = "="

    def __setstate__(self, state: Any) -> None:
        order = state[1]
        self.order = order.decode("latin1") if isinstance(order, bytes) else str(order)

    @property
    def holds_objects(self) -> bool:
        return self.code.lstrip("<>=|") in ("O", "O4", "O8")

    def array(self, raw: Any) -> np.ndarray[Any, Any]:
        """The values that bytes of this type hold."""
        match = _CODE.match(self.code)
        if match is None or self.order not in ("<", ">", "=", "|"):
            raise FormatError(f"asks for an array of '{self.code[:20]}', which is none of numbers: refused")
        data = raw.encode("latin1") if isinstance(raw, str) else bytes(raw)
        return np.frombuffer(data, np.dtype(self.order + match[1]))


class _Array:
    """Stand-in for a numpy array: a real one, or the list or the single object that it holds."""

    def __init__(self, value: Any = None) -> None:
        self.value = value

    def __setstate__(self, state: Any) -> None:
        _, shape, kind, columns_first, raw = state
        if kind.holds_objects and isinstance(raw, list):
            self.value = raw[0] if tuple(shape) == () else list(raw)
        else:
            self.value = kind.array(raw).reshape(shape, order="F" if columns_first else "C")


def _frombuffer(raw: Any, kind: _Type, shape: Any, order: str) -> _Array:
    return _Array(kind.array(raw).reshape(shape, order="F" if order == "F" else "C"))


def _encode(text: str, *_: Any) -> bytes:
    return text.encode("latin1")


_STAND_INS: dict[tuple[str, str], Any] = {
    ("numpy", "ndarray"): _Array,  # only named by the others
    ("numpy", "dtype"): _Type,
    ("_codecs", "encode"): _encode,
    ("collections", "OrderedDict"): dict,
}
for _core in ("numpy.core", "numpy._core"):
    _STAND_INS[f"{_core}.multiarray", "_reconstruct"] = lambda *_: _Array()
    _STAND_INS[f"{_core}.multiarray", "scalar"] = lambda kind, raw: kind.array(raw)[0]
    _STAND_INS[f"{_core}.numeric", "_frombuffer"] = _frombuffer


class _Unpickler(pickle._Unpickler):
    """Knows the stand-ins, and refuses every other class and function.

    In plain Python: the one in C makes room for any number of a memo, and crashes on keys that are nested too deeply.
    """

    dispatch: ClassVar[dict[int, Any]] = dict(pickle._Unpickler.dispatch)

    def find_class(self, module: str, name: str) -> Any:
        if (module, name) not in _STAND_INS:
            raise FormatError(f"asks for {as_text(module)}.{as_text(name)}, which is no array: refused")
        make = _STAND_INS[module, name]
        return lambda *arguments: make(*arguments)  # a new one each time: a pickle may change what it was given

    def load_setitems(self) -> None:
        """Fill a mapping, with keys that are texts or numbers only."""
        items = self.pop_mark()  # type: ignore[attr-defined]
        self._fill(items)

    def load_setitem(self) -> None:
        """As ``load_setitems``, of one key."""
        value = self.stack.pop()  # type: ignore[attr-defined]
        self._fill([self.stack.pop(), value])  # type: ignore[attr-defined]

    def load_dict(self) -> None:
        """Make a mapping of keys and values."""
        items = self.pop_mark()  # type: ignore[attr-defined]
        self.append({})  # type: ignore[attr-defined]
        self._fill(items)

    def _fill(self, items: list[Any]) -> None:
        mapping = self.stack[-1]  # type: ignore[attr-defined]
        if not isinstance(mapping, dict) or not all(isinstance(k, _KEYS) for k in items[::2]):
            raise FormatError("keeps values under keys that are no texts: refused")
        mapping.update(zip(items[::2], items[1::2], strict=True))

    def refuse(self) -> None:
        """Sets: they hash what is in them."""
        raise FormatError("holds a set, which is no array: refused")

    dispatch[pickle.SETITEM[0]] = load_setitem
    dispatch[pickle.SETITEMS[0]] = load_setitems
    dispatch[pickle.DICT[0]] = load_dict
    dispatch[pickle.EMPTY_SET[0]] = dispatch[pickle.ADDITEMS[0]] = dispatch[pickle.FROZENSET[0]] = refuse


def load_arrays(file: BinaryIO, what: str) -> Any:
    """Unpickle a nest of arrays, lists, mappings, numbers and texts. Arrays in it are to be :func:`opened`.

    Args:
        file: where the pickle begins.
        what: the file and array, for messages.

    Raises:
        FormatError: the pickle is damaged, or asks for anything else.
    """
    try:
        return opened(_Unpickler(file, encoding="latin1").load())
    except FormatError as error:
        raise FormatError(f"{what}: {error}") from None
    except Exception as error:  # unpickling raises every kind on damaged files
        raise FormatError(f"{what}: is damaged or truncated: {type(error).__name__} {as_text(error)}") from None


def opened(value: Any) -> Any:
    """What an array of a pickle holds; other values as they are."""
    for _ in range(8):
        if not isinstance(value, _Array):
            return value
        value = value.value
    return None
