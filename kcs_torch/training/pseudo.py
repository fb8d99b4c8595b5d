"""Labels without truth: what a training-free method makes of the tracks."""

from __future__ import annotations

import dataclasses
import hashlib
import itertools
import json
import logging
import warnings
import zipfile
import zlib
from importlib.metadata import version
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from kcs_torch.errors import KcsError, KcsWarning
from kcs_torch.io.atomic import atomic_path
from kcs_torch.methods import Method
from kcs_torch.training.batch import from_mean_depth
from kcs_torch.training.windows import FilmedWindows
from kcs_torch.types import Reconstruction, Tracks

__all__ = ["pseudo_labels"]

_LOG = logging.getLogger(__name__)

TOGETHER = 16
"""Most views of a clip that are reconstructed as one batch."""


def pseudo_labels(
    filmed: FilmedWindows,
    pairs: Tensor,
    method: Method,
    *,
    fps: float | None,
    units: str,
    trust: float,
    cache: str | Path | None,
) -> tuple[Tensor, Tensor]:
    """Reconstruct whole clips from their tracks alone.

    The wanted views of a clip are reconstructed together: what comes of them depends on them, by rounding and more, but
    on no other clip, nor on what is kept already.

    Args:
        filmed: the tracks.
        pairs: (P, 2) of (clip, view) to reconstruct, those of a clip one after another.
        method: that does it.
        fps: of the tracks.
        units: of the tracks.
        trust: standard deviation of depth, over the root mean square of the clip's tracks, that has half weight.
        cache: folder where reconstructions are kept, or None.

    Returns:
        points (V, F, N, 3), depth from the mean of each frame's joints, and weights (V, F, N) in [0, 1]: 1 where the
        method tells no uncertainty; 0 where nothing was reconstructed.

    Warns:
        KcsWarning: clips could not be reconstructed.
    """
    views, frames, joints, _ = filmed.tracks.shape
    points = torch.zeros(views, frames, joints, 3)
    weights = torch.zeros(views, frames, joints)
    folder = None if cache is None else Path(cache)
    failed: list[str] = []
    for number, (clip, part) in enumerate(parts := _parts(pairs.tolist())):
        span, source = filmed.frames_of(clip), filmed.clips[clip].source
        clips: dict[int, Tracks] = {}
        for view in part:
            image, seen = filmed.tracks[view, span].double(), filmed.weights[view, span].double()
            if bool((seen > 0).any()):
                clips[view] = Tracks(image, seen, filmed.skeleton, fps, units, f"{source}, view {view}")
            else:
                failed.append(f"{source}, view {view}: no joint is seen in any frame")
        places = _places(clips, method, folder)
        found = {view: kept for view, path in places.items() if (kept := _load(path, clips[view].weights.shape))}
        if len(found) < len(clips):
            _LOG.info("pseudo-labels: %d of %d batches reconstructed by %s", number, len(parts), method.name)
            found = _made(clips, method, places, failed)
        for view, one in found.items():
            points[view, span], weights[view, span] = _label(clips[view], *one, trust)
    if failed:
        shown = "; ".join(failed[:3]) + ("; ..." if len(failed) > 3 else "")
        warnings.warn(
            f"pseudo-labels: {len(failed)} of {len(pairs)} clips have none: {shown}", KcsWarning, stacklevel=2
        )
    return points, weights


def _parts(pairs: list[tuple[int, int]]) -> list[tuple[int, list[int]]]:
    """The views that are reconstructed together, and their clip."""
    parts = []
    for clip, group in itertools.groupby(pairs, lambda pair: pair[0]):
        views = [view for _, view in group]
        parts += [(clip, views[start : start + TOGETHER]) for start in range(0, len(views), TOGETHER)]
    return parts


def _places(clips: dict[int, Tracks], method: Method, folder: Path | None) -> dict[int, Path]:
    """The files of views by their number, named after all that are reconstructed together; none without a folder."""
    if folder is None:
        return {}
    keys = {view: _key(one, method) for view, one in clips.items()}
    together = hashlib.sha256("".join(keys.values()).encode()).hexdigest()[:16]
    return {view: folder / f"{key}_{together}.npz" for view, key in keys.items()}


def _made(
    clips: dict[int, Tracks], method: Method, places: dict[int, Path], failed: list[str]
) -> dict[int, tuple[Tensor, Tensor | None]]:
    """Points and deviations of views that are reconstructed together, by their number; none of those that fail."""
    out = {}
    for (view, _), result in zip(clips.items(), _lift([*clips.values()], method, failed), strict=True):
        if result is None:
            continue
        out[view] = result.points.float(), None if result.uncertainty is None else result.uncertainty.float()
        if view in places:
            _keep(places[view], *out[view])
    return out


def _lift(clips: list[Tracks], method: Method, failed: list[str]) -> list[Reconstruction | None]:
    """Reconstruct clips together; where that fails, one by one, and None for those to blame."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", KcsWarning)  # weak depth is what the weights are for
        try:
            return list(method.many(clips))
        except KcsError:
            out: list[Reconstruction | None] = []
            for one in clips:
                try:
                    out.append(method(one))
                except KcsError as error:
                    failed.append(str(error))
                    out.append(None)
            return out


def _label(tracks: Tracks, points: Tensor, spread: Tensor | None, trust: float) -> tuple[Tensor, Tensor]:
    """Points with their depth from the mean of each frame, and weights 1 / (1 + (spread / (trust size))^2)."""
    points = from_mean_depth(points)
    sound = torch.isfinite(points).all(-1)
    if spread is None:
        weights = torch.ones_like(points[..., 0])
    else:
        seen = tracks.seen[..., None]
        middle = (tracks.points * seen).sum(-2, keepdim=True) / seen.sum(-2, keepdim=True).clamp_min(1)
        size = (((tracks.points - middle) * seen).square().sum() / seen.sum()).sqrt().clamp_min(1e-12)
        weights = 1 / (1 + (spread / (trust * float(size))).square())
        sound = sound & torch.isfinite(weights)
    zero = torch.zeros_like(weights)
    return torch.where(sound[..., None], points, zero[..., None]), torch.where(sound, weights, zero)


def _key(tracks: Tracks, method: Method) -> str:
    """What a reconstruction depends on, as a file name."""
    fields = {field.name: getattr(method, field.name) for field in dataclasses.fields(method)}
    said = {name: repr(value) for name, value in fields.items()}
    facts = [version("kcs-torch"), type(method).__name__, said, tracks.skeleton.to_dict(), tracks.fps, tracks.units]
    digest = hashlib.sha256(json.dumps(facts).encode())
    weights = [
        v for value in fields.values() if isinstance(value, torch.nn.Module) for v in value.state_dict().values()
    ]
    for array in (tracks.points, tracks.weights, *weights):
        digest.update(array.detach().cpu().contiguous().numpy().tobytes())
    return digest.hexdigest()[:32]


def _load(path: Path, shape: torch.Size) -> tuple[Tensor, Tensor | None] | None:
    """A reconstruction that was kept; None where there is none, or the file is damaged."""
    try:
        with path.open("rb") as stream, np.load(stream, allow_pickle=False) as file:
            points = torch.from_numpy(file["points"])
            spread = torch.from_numpy(file["spread"]) if "spread" in file.files else None
    except (OSError, ValueError, KeyError, EOFError, TypeError, AttributeError, zlib.error, zipfile.BadZipFile):
        return None
    if points.shape != (*shape, 3) or (spread is not None and spread.shape != shape):
        return None
    return points.float(), None if spread is None else spread.float()


def _keep(path: Path, points: Tensor, spread: Tensor | None) -> None:
    arrays = {"points": points.numpy()} | ({} if spread is None else {"spread": spread.numpy()})
    with atomic_path(path) as temporary, temporary.open("wb") as file:
        np.savez_compressed(file, allow_pickle=False, **arrays)
