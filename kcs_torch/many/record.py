"""A folder holds results of one method and of one kind of reading: which, a hidden file in it tells."""

from __future__ import annotations

import dataclasses
import json
import os
import re
import secrets
import zlib
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path

import numpy as np
import torch

from kcs_torch.errors import FormatError, OptionError, OutputError
from kcs_torch.methods.base import Method
from kcs_torch.skeleton.builtin import SUFFIXES

__all__ = ["MADE_BY", "claim", "settings_of"]

MADE_BY = ".made_by.json"
"""File of the output folder that says by which settings its results were made."""


def settings_of(method: Method, options: Mapping[str, object], reading: Mapping[str, object]) -> dict[str, str]:
    """What results depend on, as text that is the same in every process."""
    values = {"method": method.name}
    values |= {f"method.{f.name}": as_text(getattr(method, f.name)) for f in dataclasses.fields(method)}
    values |= {name: as_text(value) for name, value in options.items() if value is not None}
    told = {name: _skeleton(value) if name == "skeleton" else as_text(value) for name, value in reading.items()}
    return values | {f"reading.{name}": told[name] for name, value in reading.items() if value is not None}


def as_text(value: object) -> str:
    """A setting as text; of a network its weights count."""
    if isinstance(value, torch.nn.Module):
        weights = [t.detach().cpu().contiguous().reshape(-1).view(torch.uint8) for t in value.state_dict().values()]
        return f"{type(value).__name__} {zlib.crc32(b''.join(w.numpy().tobytes() for w in weights)):08x}"
    if isinstance(value, np.generic):
        value = value.item()
    return value if isinstance(value, str) else re.sub(r" at 0x[0-9a-f]+", "", repr(value))


def _skeleton(value: object) -> str:
    """A skeleton as text; of a file, what is in it counts."""
    if isinstance(value, Path) or (isinstance(value, str) and Path(value).suffix.lower() in SUFFIXES):
        with suppress(OSError):
            return f"{Path(value).name} {zlib.crc32(Path(value).read_bytes()):08x}"
    return as_text(value)


def _alike(one: str | None, other: str | None) -> bool:
    """Whether two settings are the same text, or the same number: 30 and 30.0."""
    if one is None or other is None:
        return one is other
    with suppress(ValueError):
        return one == other or float(one) == float(other)
    return False


def claim(output: Path, settings: dict[str, str], retry: bool) -> None:
    """Write down how an output folder's results are made, once; all parts of the work have to agree.

    Raises:
        OptionError: others were made otherwise; what failed may be read otherwise than the rest.
        OutputError: the folder cannot be written to.
        FormatError: what is written there is damaged.
    """
    record = output / MADE_BY
    temporary = output / f".{secrets.token_hex(4)}.json"
    try:
        output.mkdir(parents=True, exist_ok=True)
        temporary.write_text(json.dumps(settings, indent=1), encoding="utf-8")
        try:
            os.link(temporary, record)  # of several processes that begin, one is the first
        except FileExistsError:
            pass
        except OSError:  # a file system without links
            if not record.exists():
                os.replace(temporary, record)
        own = dict(json.loads(record.read_bytes()))
    except OSError as error:
        raise OutputError(f"{output}: cannot be written: {error.strerror or error}") from None
    except (ValueError, TypeError) as error:
        raise FormatError(f"{record}: damaged: {error}: remove it, if the folder's results may stay") from None
    finally:
        with suppress(OSError):
            temporary.unlink(missing_ok=True)
    other = [name for name in {**own, **settings} if not _alike(own.get(name), settings.get(name))]
    if own.get("method") != settings["method"]:
        other = ["method"]
    elif retry:
        other = [name for name in other if not name.startswith("reading.")]
    if other:
        was, now = (", ".join(f"{n}={str(s.get(n))[:60]}" for n in other[:4]) for s in (own, settings))
        again = ", or retry, which tries those clips alone that failed" if other[0].startswith("reading.") else ""
        raise OptionError(
            f"{output}: holds results of {was}, got {now}: give another output folder, or remove this one{again}"
        )
