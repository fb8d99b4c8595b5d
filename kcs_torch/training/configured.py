"""What programs that Hydra configures share: a wrong configuration is told in one line, and early."""

from __future__ import annotations

import inspect
import os
import re
import typing
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any

from hydra.errors import CompactHydraException, HydraException, InstantiationException
from hydra.utils import get_object, instantiate
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import MissingMandatoryValue, OmegaConfBaseException

from kcs_torch.errors import KcsError, OptionError
from kcs_torch.methods import Method
from kcs_torch.types.hints import is_a, spoken

__all__ = [
    "WrongConfiguration",
    "check_switch",
    "check_threads",
    "check_values",
    "check_whole",
    "in_one_line",
    "method_of",
]


class WrongConfiguration(CompactHydraException):
    """What is wrong with the configuration of a run; Hydra prints it without a traceback."""


@contextmanager
def in_one_line(*also: type[Exception]) -> Iterator[None]:
    """Tell in one line what is wrong with the configuration; errors of the program keep their traceback.

    Args:
        *also: errors by which another package says that the configuration is wrong.

    Raises:
        WrongConfiguration: the configuration is wrong.
    """
    try:
        yield
    except Exception as error:
        if (text := _told(error, also)) is None or os.environ.get("HYDRA_FULL_ERROR") == "1":
            raise
        raise WrongConfiguration(f"error: {text}") from None


def check_whole(name: str, value: Any, least: int, most: int) -> None:
    """Make sure that a setting is a whole number within limits.

    Raises:
        OptionError: it is not.
    """
    if type(value) is not int or not least <= value <= most:
        raise OptionError(f"{name}: expected a whole number within {least}..{most}, got {value!r}")


def check_switch(name: str, value: Any) -> None:
    """Make sure that a setting is true or false: Hydra takes ``no`` and ``off`` for words, which count as true.

    Raises:
        OptionError: it is not.
    """
    if not isinstance(value, bool):
        raise OptionError(f"{name}: expected {spoken(bool)}, got {value!r}")


def check_threads(value: Any) -> None:
    """Make sure that this is a number of threads.

    Raises:
        OptionError: it is not.
    """
    check_whole("threads", value, 1, 1024)


def check_values(config: Mapping[str, Any], place: str = "") -> None:
    """Make sure that numbers, words and switches are what the classes that are named take; some of them never look.

    Raises:
        OptionError: a value is something else.
    """
    hints = _hints(config["_target_"]) if "_target_" in config else {}
    for name, value in config.items():
        key = f"{place}.{name}".lstrip(".")
        if isinstance(value, Mapping):
            check_values(value, key)
        elif not isinstance(value, list) and name in hints and not is_a(value, hints[name]):
            raise OptionError(f"{key}: expected {spoken(hints[name])}, got {value!r}")


def method_of(config: DictConfig) -> Method:
    """The method that the group ``method`` names, with its fields.

    Raises:
        OptionError: a field is unknown, or its value is wrong.
    """
    options: dict[str, Any] = OmegaConf.to_container(config, resolve=True)  # type: ignore[assignment]
    kind = get_object(options.pop("_target_"))
    if isinstance(kind, type) and issubclass(kind, Method):
        return kind.from_options(**options)
    found: Method = instantiate(config, _convert_="all")
    return found


def _hints(target: str) -> dict[str, Any]:
    """The annotations of what a class takes; none where they cannot be told, of which Hydra tells more."""
    try:
        found = get_object(target)
        return typing.get_type_hints(found.__init__ if inspect.isclass(found) else found)
    except Exception:  # whatever importing it, or reading annotations that are text, comes to
        return {}


def _told(error: Exception, also: tuple[type[Exception], ...]) -> str | None:
    """What is wrong with the configuration, or None if the program is wrong."""
    told: tuple[type[Exception], ...] = (KcsError, HydraException, OmegaConfBaseException, *also)
    if isinstance(error, MissingMandatoryValue):
        return f"{error.full_key}: expected a value, got none: add {error.full_key}=..."
    if isinstance(error, InstantiationException):
        cause, place = error.__cause__, re.search(r"full_key: (\S+)", str(error))
        if isinstance(cause, (TypeError, ValueError, *told)):
            return str(cause) if isinstance(cause, KcsError) or place is None else f"{place.group(1)}: {cause}"
        if cause is not None and "Error locating target" not in str(error):
            return None
    return str(error) if isinstance(error, told) else None
