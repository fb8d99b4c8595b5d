"""Inference mode, in which operations cost less: what runs in it, what cannot, and what comes out of it."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from copy import copy
from functools import wraps
from typing import Any, ParamSpec, TypeVar

import torch
from torch import Tensor

__all__ = ["differentiating", "plain", "undifferentiated"]

Parameters = ParamSpec("Parameters")
Result = TypeVar("Result")


def plain(value: Result, keep: object = None) -> Result:
    """The value with copies in place of tensors that inference mode made, which autograd refuses to keep.

    Tensors are found in tuples, lists and dataclasses. Where there are none the value comes back as it is. So does what
    is to be kept: the caller's own, which inference mode of theirs may have made.
    """
    found: Any = value
    if value is keep:
        return value
    if isinstance(value, Tensor):
        if value.is_inference():
            with torch.inference_mode(False):
                found = value.clone()
    elif isinstance(value, tuple | list):
        parts = [plain(part, keep) for part in value]
        if any(new is not old for new, old in zip(parts, value, strict=True)):
            found = type(value)(*parts) if hasattr(value, "_fields") else type(value)(parts)
    elif dataclasses.is_dataclass(value) and not isinstance(value, type):
        fields = {f.name: getattr(value, f.name) for f in dataclasses.fields(value)}
        fresh = {name: plain(part, keep) for name, part in fields.items()}
        if any(fresh[name] is not part for name, part in fields.items()):
            found = copy(value)
            for name, part in fresh.items():
                object.__setattr__(found, name, part)
    return found


def undifferentiated(function: Callable[Parameters, Result]) -> Callable[Parameters, Result]:
    """Decorate a function through which nothing is differentiated: it runs in inference mode, see :func:`plain`."""

    @wraps(function)
    def run(*args: Parameters.args, **kwargs: Parameters.kwargs) -> Result:
        if torch.is_inference_mode_enabled():
            return function(*args, **kwargs)
        with torch.inference_mode():
            found = function(*args, **kwargs)
        return plain(found)

    return run


def differentiating(function: Callable[Parameters, Result]) -> Callable[Parameters, Result]:
    """Decorate a function that differentiates within, but not in its arguments: it works in inference mode, too."""

    @wraps(function)
    def run(*args: Parameters.args, **kwargs: Parameters.kwargs) -> Result:
        if not torch.is_inference_mode_enabled():
            return function(*args, **kwargs)
        with torch.inference_mode(False), torch.no_grad():
            given: Any = plain(args)
            named: Any = {name: plain(part) for name, part in kwargs.items()}
            return function(*given, **named)

    return run
