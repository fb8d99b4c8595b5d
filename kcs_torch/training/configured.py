"""What programs that Hydra configures share: a wrong configuration is told in one line, and early."""

from __future__ import annotations

import difflib
import importlib
import inspect
import math
import os
import re
import signal
import sys
import typing
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.errors import CompactHydraException, HydraException, InstantiationException
from hydra.utils import get_object, instantiate
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import MissingMandatoryValue, OmegaConfBaseException

from kcs_torch.errors import KcsError, OptionError, unknown
from kcs_torch.methods import Method
from kcs_torch.types.hints import is_a, spoken

__all__ = [
    "PartFailed",
    "WrongConfiguration",
    "changes",
    "check_switch",
    "check_threads",
    "check_values",
    "check_whole",
    "command_line",
    "configs",
    "for_json",
    "in_one_line",
    "method_of",
]


class WrongConfiguration(CompactHydraException):
    """What is wrong with the configuration of a run; Hydra prints it without a traceback."""


class PartFailed(CompactHydraException):
    """Some of a run's work failed, and the rest is done; Hydra prints it without a traceback."""


def configs() -> Path:
    """The folder of the configurations: in a wheel it is a part of the package, in a clone it is beside it."""
    package = Path(__file__).resolve().parents[1]
    inside = package / "configs"
    return inside if inside.is_dir() else package.parent / "configs"


@contextmanager
def command_line(program: str, arguments: Sequence[str] | None = None, start: str | None = None) -> Iterator[None]:
    """Within this context Hydra finds a program's arguments, in an order that it takes; exit with 2 if one is wrong.

    Args:
        program: name of its configuration.
        arguments: by default those of this process.
        start: what is to start each further process; by default what has started this one.
    """
    before = sys.argv
    given = [_at_home(one) for one in (before[1:] if arguments is None else arguments)]
    try:
        _check_names(program, given)
        _check_folders(given)
    except OptionError as error:
        print(f"error: {error}", file=sys.stderr)
        raise SystemExit(2) from None
    # Hydra looks nowhere else, and takes flags before overrides only.
    ordered = sorted(given, key=lambda one: re.match(r"~|[^-][^=]*=", one) is not None)
    sys.argv = [start or before[0], *map(_for_hydra, ordered)]
    try:
        yield
    except SystemExit as end:  # Hydra leaves with 1 whatever it was; what it was is the context
        cause = end.__context__
        wrong = isinstance(cause, (HydraException, OmegaConfBaseException))
        told = wrong and not isinstance(cause, (InstantiationException, PartFailed))
        raise SystemExit(2 if told else end.code) from None
    except KeyboardInterrupt:
        raise SystemExit(128 + signal.SIGINT) from None
    finally:
        sys.argv = before


def _at_home(argument: str) -> str:
    """An override with the user's folder for a ~ that a value begins with: of most names shells leave it."""
    name, sign, value = argument.partition("=")
    return f"{name}{sign}{os.path.expanduser(value)}" if re.match(r"~(/|$)", value) else argument


def _for_hydra(argument: str) -> str:
    """An override as Hydra takes it.

    It may also add a field: of a name that is not shown Hydra says to add it, be it right or wrong. Values that Hydra
    cannot read are quoted, as those of scale=height=1.75m and input=Läufe.
    """
    name, sign, value = argument.partition("=")
    if sign and not name.startswith("-") and not _is_read(argument):
        argument = f"{name}={_quoted(value)}"
    return f"++{argument}" if re.match(r"(?!hydra\.)[A-Za-z_]\w*\.[^=]*=", argument) else argument


def _quoted(value: str) -> str:
    """A value with quotes about what Hydra cannot read: all of it, or those parts of a list or a sweep.

    Values with brackets or quotes of which it is not plain where the parts end stay as they are.
    """
    listed = value.startswith("[") and value.endswith("]")
    inner = value[1:-1] if listed else value
    called = re.match(r"(\w+)\(", value)
    if (
        (re.search(r"['\"()\[\]{}]", inner) and (listed or "," in value))
        or re.match(r"['\"{\[]", inner)
        or (called is not None and called[1] in OverridesParser.create().functions.functions)
    ):
        return value
    parts = ",".join(part if _is_read(f"x={part}") else _in_quotes(part.strip()) for part in inner.split(","))
    return f"[{parts}]" if listed else parts


def _in_quotes(text: str) -> str:
    """Text in quotes, in which Hydra takes a backslash for one unless a quote follows; of ~/ the user's folder."""
    text = re.sub(r"\A(!?)(~(?:/.*)?)\Z", lambda found: found[1] + os.path.expanduser(found[2]), text)
    return "'" + re.sub(r"(\\*)('|$)", lambda found: 2 * found[1] + found[2].replace("'", "\\'"), text) + "'"


def _is_read(argument: str) -> bool:
    """Whether Hydra can read an override."""
    try:
        OverridesParser.create().parse_override(argument)
    except HydraException:
        return False
    return True


def _check_folders(arguments: Sequence[str]) -> None:
    """Look at the folders of runs, which Hydra makes before it asks anybody.

    Raises:
        OptionError: one cannot be made, or cannot be written to.
    """
    for argument in arguments:
        name, _, value = argument.partition("=")
        if name not in ("hydra.run.dir", "hydra.sweep.dir") or not value or set(value) & set("$'\"\\"):
            continue  # of what Hydra has yet to resolve it tells itself
        folder = Path(value)
        try:
            there = next(path for path in (folder, *folder.absolute().parents) if path.exists())
            with TemporaryDirectory(dir=there):
                pass
        except OSError as error:
            raise OptionError(f"{argument}: cannot be written to: {error.strerror}") from None


def _check_names(program: str, arguments: Sequence[str]) -> None:
    """Look at the names of groups and settings: of one that it does not know Hydra says how to add it.

    Raises:
        OptionError: there is none of that name, and no other argument makes use of it.
    """
    if any(argument.startswith(("--config", "-cn", "-cp", "-cd")) for argument in arguments):
        return  # another configuration has other names
    own = OmegaConf.load(configs() / f"{program}.yaml")
    groups = (str(next(iter(entry))) for entry in own.defaults if isinstance(entry, Mapping))
    known = {*map(str, own), *(name for name in groups if not name.startswith("override "))} - {"defaults"}
    for argument in arguments:
        bare = argument.lstrip("-")
        if bare != argument and bare.partition("=")[0] in known:
            raise OptionError(f"{argument}: settings have no dashes: {bare}")
        named = re.match(r"(\+*)([A-Za-z_]\w*)[^=]*=", argument)
        if named is None or named[2] in known:
            continue
        if not named[1] or not any(f"${{{named[2]}" in other for other in arguments):
            raise unknown("setting", named[2], known)


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
    except PartFailed:
        raise
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
    """Make sure that fields are what the classes that are named take, numbers, words and switches too; some never look.

    Raises:
        OptionError: there is no such field, or a value is something else.
    """
    hints = _hints(config["_target_"]) if "_target_" in config else {}
    known = _fields(config["_target_"]) if "_target_" in config else None
    for name, value in config.items():
        key = f"{place}.{name}".lstrip(".")
        if known is not None and not str(name).startswith("_") and name not in known:
            raise unknown(f"field of {place or 'the configuration'} ({config['_target_']})", name, known)
        if isinstance(value, Mapping):
            check_values(value, key)
        elif not isinstance(value, list) and name in hints and not is_a(value, hints[name]):
            raise OptionError(f"{key}: expected {spoken(hints[name])}, got {value!r}")


def for_json(value: Any) -> Any:
    """A configuration whose infinite numbers are as YAML writes them, in words: JSON has none."""
    if isinstance(value, dict):
        return {name: for_json(inner) for name, inner in value.items()}
    if isinstance(value, list):
        return [for_json(inner) for inner in value]
    return str(value).replace("inf", ".inf") if isinstance(value, float) and math.isinf(value) else value


def changes(before: Any, now: Any) -> list[tuple[str, Any, Any]]:
    """The settings by which a run's figures differ, as they were and as they are."""
    then, these = _flat(before), _flat(now)
    keys = sorted({*then, *these} - {"resume", "keep"})
    return [(key, then.get(key), these.get(key)) for key in keys if then.get(key) != these.get(key)]


def _flat(config: Any, key: str = "") -> dict[str, Any]:
    """A nested configuration with dotted keys."""
    if not isinstance(config, Mapping):
        return {key: config}
    return {name: leaf for k, v in config.items() for name, leaf in _flat(v, f"{key}.{k}".lstrip(".")).items()}


def method_of(config: DictConfig) -> Method:
    """The method that the group ``method`` names, with its fields.

    Raises:
        OptionError: a field is unknown, or its value is wrong; what is named cannot be imported, or is no method.
    """
    options: dict[str, Any] = OmegaConf.to_container(config, resolve=True)  # type: ignore[assignment]
    target = options.pop("_target_")
    try:
        kind = get_object(target)
    except Exception as error:  # whatever a module of the user's comes to
        raise OptionError(_not_imported("method.", target, error)) from None
    if isinstance(kind, type) and issubclass(kind, Method):
        return kind.from_options(**options)
    found = instantiate(config, _convert_="all")
    if not isinstance(found, Method):
        raise OptionError(f"method._target_={target}: expected a kcs_torch.Method, got {type(found).__name__}")
    return found


def _hints(target: str) -> dict[str, Any]:
    """The annotations of what a class takes; none where they cannot be told, of which Hydra tells more."""
    try:
        found = get_object(target)
        return typing.get_type_hints(found.__init__ if inspect.isclass(found) else found)
    except Exception:  # whatever importing it, or reading annotations that are text, comes to
        return {}


def _fields(target: str) -> list[str] | None:
    """The names of what a class takes; None where it takes any, or where they cannot be told."""
    try:
        takes = inspect.signature(get_object(target)).parameters.values()
    except Exception:  # whatever importing it comes to
        return None
    return (
        None
        if any(p.kind is p.VAR_KEYWORD for p in takes)
        else [p.name for p in takes if p.kind is not p.VAR_POSITIONAL]
    )


def _not_imported(where: str, target: str, error: BaseException) -> str:
    """Why a target is not found, from what Hydra raises of it; ``where`` is its place in the configuration."""
    lacks = _lacking(target)
    cause = f"cannot be imported: {error.__cause__ or error}: a module of your own needs its folder in PYTHONPATH"
    return f"{where}_target_={target}: {lacks or cause}"


def _lacking(target: str) -> str:
    """What the innermost module of a dotted name lacks; empty where no module is found, or has an error of its own."""
    parts = target.split(".")
    for count in range(len(parts) - 1, 0, -1):
        name, part = ".".join(parts[:count]), parts[count]
        try:
            module = importlib.import_module(name)
        except ModuleNotFoundError as error:
            if name.startswith(error.name or ":"):  # it is this one that is not there
                continue
            return ""
        except Exception:  # whatever a module of the user's comes to
            return ""
        if hasattr(module, part):
            return ""
        close = difflib.get_close_matches(part, dir(module), 2)
        return f"module '{name}' has no '{part}'" + (f": did you mean {' or '.join(close)}?" if close else "")
    return ""


def _told(error: Exception, also: tuple[type[Exception], ...]) -> str | None:
    """What is wrong with the configuration, or None if the program is wrong."""
    told: tuple[type[Exception], ...] = (KcsError, HydraException, OmegaConfBaseException, *also)
    if isinstance(error, MissingMandatoryValue):
        return f"{error.full_key}: expected a value, got none: add {error.full_key}=..."
    if isinstance(error, InstantiationException):
        cause, place = error.__cause__, re.search(r"full_key: (\S+)", str(error))
        located = re.search(r"Error locating target '(\S+)'", str(error))
        lacks = located is None and isinstance(cause, ModuleNotFoundError)  # a package that what is configured needs
        if lacks or isinstance(cause, (TypeError, ValueError, *told)):
            return str(cause) if isinstance(cause, KcsError) or place is None else f"{place.group(1)}: {cause}"
        if cause is not None:
            where = "" if place is None else f"{place.group(1)}."
            return None if located is None else _not_imported(where, located.group(1), cause)
    return str(error) if isinstance(error, told) else None
