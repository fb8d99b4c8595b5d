"""Trained networks on disk: safetensors files that say what network they are of, and hold no code."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import astuple
from importlib.metadata import version
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from kcs_torch.errors import FormatError, KcsError, OptionError, OutputError, listed, unknown
from kcs_torch.io.atomic import atomic_path
from kcs_torch.io.registry import check_fps, need, read_error
from kcs_torch.nn import MLPLifter, RefinedLifter, TemporalLifter, UnrolledFPC, UnrolledPKC, UnrolledSfAM
from kcs_torch.skeleton import Skeleton
from kcs_torch.solvers import Implicit
from kcs_torch.training.lifter import Lifter

__all__ = ["NETWORKS", "load_lifter", "save_lifter"]

NETWORKS: dict[str, type[MLPLifter] | type[TemporalLifter]] = {"MLPLifter": MLPLifter, "TemporalLifter": TemporalLifter}
"""The networks that files may name."""

SOLVERS: dict[str, type[UnrolledFPC] | type[UnrolledSfAM] | type[UnrolledPKC]] = {
    "UnrolledFPC": UnrolledFPC,
    "UnrolledSfAM": UnrolledSfAM,
    "UnrolledPKC": UnrolledPKC,
}
"""The solvers that files may name behind a network (:class:`kcs_torch.nn.RefinedLifter`)."""

KEY = "kcs_torch"
"""Under which the file's metadata says, as JSON, what it is."""

ZIP = b"PK\x03\x04"
"""How checkpoints begin."""

OF_NETWORK = "network."
"""How the names of a network's weights begin in a checkpoint of its training."""

LARGEST = 2**20
"""No option of a network is larger; a file that says so is damaged."""

LISTED = 256
"""Options have no more numbers than there are weights, and so many (bone lengths)."""


def save_lifter(
    path: str | Path, network: nn.Module, *, fps: float | None = None, notes: Mapping[str, Any] | None = None
) -> Path:
    """Write a lifting network to a safetensors file.

    Args:
        path: of the file; the suffix .safetensors is usual.
        network: one of :data:`NETWORKS`, alone or in a :class:`kcs_torch.nn.RefinedLifter` with one of
            :data:`SOLVERS`.
        fps: frames per second of the tracks that it was trained on, which results then warn by.
        notes: more to keep in the file, such as what it was trained on: whatever JSON can hold.

    Returns:
        The path.

    Raises:
        OptionError: the network is none of these, or its weights are not finite or not of one type; the notes are no
            JSON; ``fps`` is no frame rate.
        OutputError: the file cannot be written.

    >>> import tempfile
    >>> path = save_lifter(Path(tempfile.mkdtemp()) / "lifter.safetensors", MLPLifter("h36m17", width=8))
    >>> load_lifter(path).network.options
    {'width': 8, 'num_blocks': 2, 'dropout': 0.1, 'window': 1}
    """
    check_fps(fps)
    facts = {"version": version("kcs-torch"), "fps": fps, "notes": dict(notes or {})} | describe(network)
    tensors = {name: value.detach().cpu().contiguous() for name, value in network.state_dict().items()}
    if fault := _fault(tensors):
        raise OptionError(f"save_lifter: {path}: expected the weights of a trained network, got some that {fault}")
    try:
        text = json.dumps(facts, allow_nan=False)  # in this order: that of virtual joints counts
    except (TypeError, ValueError) as error:
        raise OptionError(f"save_lifter: notes and fps: expected what JSON can hold, got {error}") from None
    data = need("safetensors.torch", str(path), OutputError).save(tensors, {KEY: text})
    with atomic_path(path) as temporary:
        temporary.write_bytes(data)
    return Path(path)


def describe(network: nn.Module) -> dict[str, Any]:
    """What a file says of a network besides its weights.

    Raises:
        OptionError: it is no network that a file can name.
    """
    facts: dict[str, Any] = {}
    inner = network
    if isinstance(network, RefinedLifter):
        inner, solver = network.network, network.solver
        kind = type(solver).__name__
        if SOLVERS.get(kind) is not type(solver) or not isinstance(solver, (UnrolledFPC, UnrolledSfAM, UnrolledPKC)):
            raise unknown("solver to save", kind, SOLVERS)
        facts |= {"solver": kind, "solver_options": _solver_options(solver)}
    kind = type(inner).__name__
    if NETWORKS.get(kind) is not type(inner) or not isinstance(inner, (MLPLifter, TemporalLifter)):
        raise unknown("network to save", kind, NETWORKS)
    return facts | {"network": kind, "options": inner.options, "skeleton": inner.skeleton.to_dict()}


def load_lifter(path: str | Path, *, network: nn.Module | None = None, device: torch.device | str = "cpu") -> Lifter:
    """Read a trained network as a method: ``kt.reconstruct(tracks, method=load_lifter(path))``.

    Networks of this package are in files that :func:`save_lifter` wrote, and are made from what these say. A network of
    one's own is in the checkpoints of its training alone, and has to be given. No code of the file is run.

    Args:
        path: the file; with ``network``, a checkpoint of a :class:`kcs_torch.training.LiftingModule`.
        network: made as it was for the training; it gets the weights of the checkpoint. Behind it was a solver: a
            :class:`kcs_torch.nn.RefinedLifter` of both.
        device: where the network is to run.

    Raises:
        FormatError: the file cannot be read, is damaged, or is something else, or its weights are of another network.
        OptionError: the network has no skeleton.
    """
    path = Path(path)
    if network is not None:
        return _of_checkpoint(path, network, device)
    data = _bytes(path)
    if data.startswith(ZIP):
        raise FormatError(
            f"{path}: expected a network that save_lifter wrote, got what seems to be a checkpoint: take "
            "lifter.safetensors of the same run, or give the network that it is of: load_lifter(path, network=...)"
        )
    library = need("safetensors.torch", str(path), FormatError)
    try:
        tensors: dict[str, Tensor] = library.load(data)
        size = int.from_bytes(data[:8], "little")
        text = json.loads(data[8 : 8 + size])["__metadata__"][KEY]
        facts = json.loads(text)
    except (KeyError, TypeError):
        raise FormatError(f"{path}: expected a network that save_lifter wrote, got another safetensors file") from None
    except Exception as error:  # the package raises its own kind, which it does not derive from ValueError
        raise FormatError(f"{path}: expected a network that save_lifter wrote, got {error}") from None
    built = _build(path, facts, tensors)
    fps = facts.get("fps")
    if fps is not None and not (isinstance(fps, (int, float)) and 0 < fps < float("inf")):
        raise FormatError(f"{path}: fps: expected a positive number, got {fps!r}")
    return Lifter(built.to(device).eval(), fps=None if fps is None else float(fps))


def _of_checkpoint(path: Path, network: nn.Module, device: torch.device | str) -> Lifter:
    """A network with the weights that a checkpoint of its training holds."""
    _bytes(path, 1)  # so that a file that is not there is told as everywhere
    try:
        held = torch.load(path, map_location="cpu", weights_only=True)
        states = {name: value for name, value in held["state_dict"].items() if name.startswith(OF_NETWORK)}
        fps = held.get("fps")
    except Exception:  # whatever torch, zipfile and pickle make of a file that is something else
        raise FormatError(
            f"{path}: expected a checkpoint of a LiftingModule, got something else (a file that save_lifter wrote "
            "needs no network=...)"
        ) from None
    states = {name.removeprefix(OF_NETWORK): value for name, value in states.items()}
    own = network.state_dict()
    wrong = sorted(n for n in {*own, *states} if n not in own or n not in states or own[n].shape != states[n].shape)
    if wrong:
        raise FormatError(
            f"{path}: expected the weights of a {type(network).__name__} made as this one is, got others: "
            f"{listed(wrong, 4)}"
        )
    network.load_state_dict(states)
    return Lifter(network.to(device).eval(), fps=fps if isinstance(fps, (int, float)) else None)


def _bytes(path: Path, most: int = -1) -> bytes:
    try:
        with path.open("rb") as file:
            return file.read(most)
    except OSError as error:
        raise read_error(path, error) from None


def _build(path: Path, facts: Any, tensors: Mapping[str, Tensor]) -> nn.Module:
    """The network of a file's facts, with its weights."""
    what = f"{path}: expected a network that save_lifter wrote"
    if not isinstance(facts, dict):
        raise FormatError(f"{what}, got metadata of another kind")
    kind, options = facts.get("network"), _checked(facts.get("options"), len(tensors), what)
    if not isinstance(kind, str) or kind not in NETWORKS:
        raise unknown(f"network in {path}", kind, NETWORKS, FormatError)
    solver = facts.get("solver")
    more: dict[str, Any] = {}
    if solver is not None:
        if solver not in SOLVERS:
            raise unknown(f"solver in {path}", solver, SOLVERS, FormatError)
        more = _checked(facts.get("solver_options"), len(tensors), what)

    def make() -> nn.Module:
        network = NETWORKS[kind](skeleton, **options)
        if solver is None:
            return network
        own: dict[str, Any] = {} if solver == "UnrolledFPC" else {"skeleton": skeleton}
        # What names no corner has none: its file says so, or is older than corners.
        given = ({} if solver == "UnrolledPKC" else {"corner": math.inf}) | more
        if "gradient" in given:
            given["gradient"] = Implicit(*given["gradient"])
        return RefinedLifter(network, SOLVERS[solver](**own, **given))

    try:
        skeleton = Skeleton.from_dict(facts.get("skeleton") or {}, source=str(path))
        with torch.device("meta"):  # costs nothing, however large a damaged file says it is
            plan = make().state_dict()
    except KcsError as error:
        raise FormatError(f"{path}: {error}") from None
    except (TypeError, ValueError, RuntimeError) as error:
        raise FormatError(f"{what}, got options {str(options)[:200]} {str(more)[:200]} ({error})") from None
    # In older files the corner is an option alone, which the solver then is made with.
    needed = {name for name in plan if name in tensors or name != "solver.raw_corner"}
    wrong = [n for n in {*needed, *tensors} if n not in plan or n not in tensors or plan[n].shape != tensors[n].shape]
    if wrong:
        raise FormatError(f"{what}, got weights that do not fit its options: {min(wrong)}")
    kinds = _kinds(tensors)
    if fault := _fault(tensors):
        raise FormatError(f"{what}, got weights that {fault}")
    with torch.random.fork_rng(devices=[]):  # reading draws no random numbers of the caller's
        network = make()
    (network.network if isinstance(network, RefinedLifter) else network).to(kinds.pop())
    network.load_state_dict(dict(tensors))
    return network


def _kinds(tensors: Mapping[str, Tensor]) -> set[torch.dtype]:
    """The types of a network's weights, without those of the solver behind it."""
    return {value.dtype for name, value in tensors.items() if not name.startswith("solver.")}


def _fault(tensors: Mapping[str, Tensor]) -> str:
    """Why weights cannot be those of a network in a file; empty where they can."""
    if len(_kinds(tensors)) != 1 or not all(value.is_floating_point() for value in tensors.values()):
        return "are not of one floating-point type"
    bad = [name for name, value in tensors.items() if not bool(torch.isfinite(value).all())]
    return f"are not finite: {min(bad)}" if bad else ""


def _checked(options: Any, count: int, what: str) -> dict[str, Any]:
    """Options of a file with ``count`` weights, if they can be those of a network of its size."""
    if not isinstance(options, dict):
        raise FormatError(f"{what}, got metadata of another kind")
    flat = [v for value in options.values() for v in (value if isinstance(value, list) else [value])]
    if not all(isinstance(v, (int, float)) and abs(v) <= LARGEST for v in flat):
        raise FormatError(f"{what}, got options out of range: {str(options)[:200]}")
    if options.get("num_blocks", 0) > count or len(flat) > count + LISTED:
        raise FormatError(f"{what}, got fewer weights than its options ask for")
    return options


def _solver_options(solver: UnrolledFPC | UnrolledSfAM | UnrolledPKC) -> dict[str, Any]:
    """What its constructor takes that its weights do not tell."""
    options: dict[str, Any] = {"num_steps": solver.num_steps}
    if not isinstance(solver, UnrolledPKC):
        options["momentum"] = solver.momentum
        if math.isfinite(solver.corner):
            options["corner"] = solver.corner
    if solver.implicit is not None:  # its fixed point is what the network gives
        options["gradient"] = list(astuple(solver.implicit))
    if not isinstance(solver, UnrolledFPC):
        first = "realign_from" if isinstance(solver, UnrolledPKC) else "articulate_from"
        options[first] = solver.first / solver.num_steps
        if solver.has_lengths:
            options["lengths"] = [1.0] * solver.skeleton.num_bones
    return options
