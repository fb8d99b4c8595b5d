"""Values of ``--set name=value``, read by the types of a method's fields."""

from __future__ import annotations

import dataclasses
import types
import typing
from collections.abc import Iterable, Sequence
from typing import Any

from kcs_torch.errors import OptionError, unknown
from kcs_torch.types.hints import spoken

__all__ = ["parse_settings"]


def parse_settings(settings: Iterable[str], methods: Sequence[type]) -> dict[str, Any]:
    """Read ``name=value`` texts as values of fields of a method.

    Args:
        settings: texts such as ``"beta=1.5"``, ``"rank=none"`` or ``"links=[[left_wrist, right_wrist]]"``.
        methods: dataclasses whose fields may be set, those without ``repr`` excepted; the first that has a field gives
            its type.

    Returns:
        values by name.

    Raises:
        OptionError: a text is not of that form, no method has such a field, or the value has the wrong type.
    """
    hints: dict[str, Any] = {}
    for method in reversed(methods):
        named = typing.get_type_hints(method)
        hints |= {f.name: named[f.name] for f in dataclasses.fields(method) if f.init and f.repr}
    values: dict[str, Any] = {}
    for text in settings:
        name, equals, value = text.partition("=")
        name = name.strip()
        if not equals or not name:
            raise OptionError(f"--set: expected name=value, got {text!r}; names are {', '.join(sorted(hints))}")
        if name not in hints:
            raise unknown("field for --set", name, hints)
        try:
            values[name] = _convert(value.strip(), hints[name])
        except (KeyError, TypeError, ValueError):
            raise OptionError(f"--set {name}: expected {spoken(hints[name])}, got {value.strip()!r}") from None
    return values


def _convert(value: Any, hint: Any) -> Any:
    """A text, or an item of a list, as a value of the type ``hint``."""
    origin, inner = typing.get_origin(hint), typing.get_args(hint)
    if hint is Any:
        return value
    if origin in (typing.Union, types.UnionType):
        return _first(value, inner)
    if hint is None or hint is types.NoneType:
        if value is None or str(value).lower() in ("none", "null"):
            return None
        raise ValueError(value)
    if origin is typing.Literal:
        return {str(choice): choice for choice in inner}[str(value)]
    if hint is bool:
        words = {"true": True, "yes": True, "1": True, "false": False, "no": False, "0": False}
        if str(value).lower() not in words:
            raise ValueError(value)
        return words[str(value).lower()]
    if hint in (int, float, str):
        if isinstance(value, (list, dict)) or value is None:
            raise ValueError(value)
        return hint(str(value).lower().replace(".inf", "inf") if hint is float else value)  # .inf, as YAML writes it
    if (origin or hint) in (tuple, list) or (isinstance(origin, type) and issubclass(origin, Iterable)):
        return _sequence(value, inner, list if (origin or hint) is list else tuple)
    raise ValueError(value)


def _first(value: Any, hints: Sequence[Any]) -> Any:
    """The value as the first type that takes it; text last, since it takes everything."""
    for hint in sorted(hints, key=lambda h: (h is str, h is not types.NoneType)):
        try:
            return _convert(value, hint)
        except (KeyError, TypeError, ValueError):
            continue
    raise ValueError(value)


def _sequence(value: Any, inner: Sequence[Any], kind: type) -> Any:
    """A list written ``[a, b]`` or ``a,b``."""
    if isinstance(value, str):
        import yaml

        try:
            value = yaml.safe_load(value if value.startswith("[") else f"[{value}]")
        except yaml.YAMLError as error:
            raise ValueError(value) from error
    if not isinstance(value, list):
        raise ValueError(value)
    if kind is tuple and inner and Ellipsis not in inner and len(inner) > 1:
        if len(inner) != len(value):
            raise ValueError(value)
        return tuple(_convert(v, h) for v, h in zip(value, inner, strict=True))
    item = inner[0] if inner else Any
    return kind(_convert(v, item) for v in value)
