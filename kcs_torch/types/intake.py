"""What users pass, checked: arrays, numbers, and the skeleton that fits them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from numbers import Real
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from kcs_torch.errors import ShapeError, SkeletonError
from kcs_torch.skeleton import SKELETONS, Skeleton, get_skeleton, guess_skeleton

__all__ = ["as_floats", "as_number", "choose_skeleton", "joint_order"]


def as_floats(value: Any, what: str, ndim: int) -> Tensor:
    """An array-like as a floating tensor of ``ndim`` dimensions; tensors keep their device and single precision.

    Raises:
        ShapeError: it is no array of real numbers, or has another number of dimensions.
    """
    if not isinstance(value, Tensor):
        try:
            array = np.asarray(value)
            value = torch.as_tensor(array if np.iscomplexobj(array) else array.astype(np.float64))
        except (TypeError, ValueError):
            raise ShapeError(f"{what}: expected an array of numbers, got {type(value).__name__}") from None
    if value.is_complex():
        raise ShapeError(f"{what}: expected real numbers, got {str(value.dtype).removeprefix('torch.')}")
    if value.ndim != ndim:
        raise ShapeError(f"{what}: expected {ndim} dimensions, got shape {tuple(value.shape)}")
    if value.dtype in (torch.float16, torch.bfloat16):
        return value.float()  # no factorisation takes half precision
    return value if value.is_floating_point() else value.double()


def as_number(value: Any) -> float | None:
    """A real number as a float; None for anything else."""
    return float(value) if isinstance(value, Real) else None


def choose_skeleton(
    skeleton: str | Path | Skeleton | None,
    names: Sequence[str] | None,
    edges: Any,
    num_joints: int,
    source: str,
    notes: list[str],
) -> Skeleton:
    """The skeleton that fits what the user gave; says so in ``notes`` where it had to choose."""
    if skeleton is not None:
        body = get_skeleton(skeleton)
        if body.num_observed != num_joints:
            fits = [s.name for s in SKELETONS.values() if s.num_observed == num_joints]
            hint = f"; {num_joints} joints fit {', '.join(fits)}" if fits else ""
            raise SkeletonError(
                f"{source}: expected the {body.num_observed} joints of skeleton '{body.name}', got {num_joints}{hint}"
            )
        return body
    known = guess_skeleton(names) if names is not None else None
    if edges is None:
        if known is not None:
            return known
        return Skeleton.from_edges([], names or num_joints, name="points", tree=False)
    try:
        try:
            pairs = np.asarray(edges)
        except ValueError:
            raise ShapeError(f"{source}: edges: expected pairs of joint indices, got rows of unequal length") from None
        if pairs.size == 0:
            pairs = pairs.reshape(0, 2)
        if pairs.ndim != 2 or pairs.shape[1] != 2 or not np.issubdtype(pairs.dtype, np.number):
            raise ShapeError(
                f"{source}: edges: expected shape (bones, 2) of joint indices, got {pairs.shape} of {pairs.dtype}"
            )
        graph = Skeleton.from_edges(pairs.tolist(), names or num_joints, name=Path(source).stem, tree=False)
    except SkeletonError as error:
        raise SkeletonError(f"{source}: edges: {error}") from None
    if graph.is_tree:
        return replace(graph, tree=True)
    if known is not None:
        notes.append(
            f"the file's edges are not a tree; used the built-in skeleton '{known.name}', whose joint names it has"
        )
        return known
    reason = "close a chain" if graph.cycle() else f"fall into {len(graph.pieces())} pieces"
    notes.append(f"the edges {reason}: used as a graph of rigid links, not as a tree")
    return graph


def joint_order(names: Sequence[str], body: Skeleton, source: str, notes: list[str]) -> list[int] | None:
    """Return where each joint of ``body`` stands among ``names``; None: take the joints in their order.

    Raises:
        SkeletonError: there are more or fewer names than joints, and some joints are not among them.
    """
    wanted = body.joints[: body.num_observed]
    if tuple(names) == wanted:
        return None
    where = {n: i for i, n in enumerate(names)}
    missing = [n for n in wanted if n not in where]
    if not missing:
        notes.append(f"joints matched by name with skeleton '{body.name}'; {len(names) - len(wanted)} left out")
        return [where[n] for n in wanted]
    if len(names) == len(wanted):
        notes.append(f"joints taken in their order as those of skeleton '{body.name}': their names differ")
        return None
    raise SkeletonError(
        f"{source}: expected the {len(wanted)} joints of skeleton '{body.name}', got {len(names)} joints, none of them "
        f"named {', '.join(missing[:6])}{', ...' if len(missing) > 6 else ''}; they are {', '.join(names)}"
    )
