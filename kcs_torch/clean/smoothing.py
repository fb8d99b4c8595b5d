"""Tracks and motion without what is faster than a cut-off."""

from __future__ import annotations

import math
import warnings
from dataclasses import replace
from typing import overload

import numpy as np
import torch
from numpy.typing import NDArray

from kcs_torch.clean.common import Array, check_seen, check_tracks, frame_rate, number, rebuilt, runs, share
from kcs_torch.clean.detector import found_by_detector
from kcs_torch.clean.filters import FILTERS, Filter
from kcs_torch.clean.sides import unswap
from kcs_torch.clean.timing import shots_of
from kcs_torch.errors import KcsWarning, unknown, users_level
from kcs_torch.solvers.stray import body_size
from kcs_torch.types import Reconstruction, Tracks
from kcs_torch.types.arrays import as_doubles

__all__ = ["SMOOTHERS", "smooth"]

SMOOTHERS = tuple(FILTERS)
"""Names that :func:`smooth` takes."""


@overload
def smooth(motion: Tracks, method: str = ..., cutoff: float = ..., *, fps: float | None = ...) -> Tracks: ...
@overload
def smooth(
    motion: Reconstruction, method: str = ..., cutoff: float = ..., *, fps: float | None = ...
) -> Reconstruction: ...
def smooth(
    motion: Tracks | Reconstruction, method: str = "butterworth", cutoff: float = 6.0, *, fps: float | None = None
) -> Tracks | Reconstruction:
    """Take out of a motion what is faster than a cut-off, within runs of seen frames.

    Gaps stay gaps: each run of frames in which a joint is seen is filtered by itself, and runs that are too short are
    left as they are. Runs end where a film has cuts (:func:`~kcs_torch.clean.split`), and in a result where a number is
    NaN. Frames count by their weights relative to the best of their run; even weights give the plain filter. A note
    says by how much the joints moved.

    Args:
        motion: tracks, or a result: then its 3D points and the depth of its root, not its tracks. Bones of a smoothed
            result keep their length less exactly; its lengths and ``bone_variation`` are told anew.
        method: "butterworth" (order 4, no lag, -3 dB at the cut-off), "savgol" (Savitzky-Golay, cubic, no lag) or
            "one-euro" (causal, but for the body's size, the whole shot's; follows fast motion).
        cutoff: in Hz.
        fps: frames a second; as the motion says if None.

    Returns:
        The same kind of thing.

    Raises:
        OptionError: the method is unknown, the rate is unknown, or the cut-off is not below half of it, or so low that
            savgol's window has more than 12 000 frames.
        ShapeError: the tracks show no joint in any frame.

    Warns:
        KcsWarning: the tracks' left and right are swapped in some frames, which :func:`unswap` should mend first.

    >>> from kcs_torch.data.synthetic import walking_person
    >>> tracks = walking_person(60, noise=3.0, generator=torch.Generator().manual_seed(0)).tracks
    >>> smooth(tracks, cutoff=4.0).notes[-1]
    'smooth (Butterworth of order 4 without lag, 4 Hz): joints moved by 3.5 mm (root mean square)'
    """
    if method not in FILTERS:
        raise unknown("method of smooth", method, FILTERS)
    check_tracks(motion, "smooth", (Tracks, Reconstruction))
    tracks = motion if isinstance(motion, Tracks) else motion.tracks
    rate = frame_rate(motion.fps, fps, "smooth", tracks.source)
    expected = f"above 0 and below half of the {rate:g} frames a second, {rate / 2:g} Hz"
    number(cutoff, "smooth: cutoff", expected, below=rate / 2)
    if isinstance(motion, Reconstruction):
        return _smooth_result(motion, method, cutoff, rate)
    check_seen(tracks, "smooth")
    count = tracks.skeleton.num_observed
    points = as_doubles(tracks.points[:, :count])
    weights = as_doubles(tracks.weights[:, :count])
    seen = weights > 0
    filters = _filters(points, seen, shots_of(tracks), method, cutoff, rate)
    moved, short = _smooth_runs(points, weights, filters)
    chosen = filters[0][1]
    change = math.sqrt(float(np.square(moved - points).sum(-1)[seen].mean()))
    note = f"smooth ({chosen.words}): joints moved by {change:.2g} {tracks.units} (root mean square)"
    note += _left(short, int(seen.sum()), "detections", chosen)
    mended = unswap(tracks)
    if mended is not tracks:
        message = (
            f"{tracks.source}: smooth mixes up left and right where a detector swapped them: unswap first (--unswap). "
        )
        warnings.warn(message + f"It would say: {mended.notes[-1]}", KcsWarning, stacklevel=users_level())
    if tracks.detector is None and found_by_detector(tracks):  # nothing but what is filtered out may tell it
        tracks = replace(tracks, detector=True)
    return rebuilt(tracks, torch.from_numpy(moved), tracks.weights[:, :count], note)


def _filters(
    points: Array, seen: NDArray[np.bool_], shots: list[slice], method: str, cutoff: float, rate: float
) -> list[tuple[slice, Filter]]:
    """Each shot with its filter, of finite points (T, N, D), seen (T, N); one-euro measures speeds in body sizes."""
    given, shown = torch.from_numpy(points)[None], torch.from_numpy(seen)[None]
    sizes = [float(body_size(given[:, shot], shown[:, shot])) or 1.0 for shot in shots]
    return [(shot, FILTERS[method](cutoff, rate, size)) for shot, size in zip(shots, sizes, strict=True)]


def _smooth_runs(points: Array, weights: Array, filters: list[tuple[slice, Filter]]) -> tuple[Array, int]:
    """Points (T, N, D) smoothed run by run in each shot, and how many detections are in runs that are too short."""
    out, short = points.copy(), 0
    for shot, chosen in filters:
        for joint in range(points.shape[1]):
            values, trust, made = points[shot, joint], weights[shot, joint], out[shot, joint]
            for start, stop in runs(trust > 0):
                if stop - start < chosen.least:
                    short += stop - start
                    continue
                part = trust[start:stop]
                made[start:stop] = chosen.apply(values[start:stop], part / part.max())
    return out, short


def _left(short: int, whole: int, what: str, chosen: Filter) -> str:
    """What a note adds where some are in runs that are too short for a filter."""
    if not short:
        return ""
    return f"; {share(short, whole)} {what}, in runs of fewer than {chosen.least} frames, were left as they are"


def _smooth_result(result: Reconstruction, method: str, cutoff: float, rate: float) -> Reconstruction:
    """A result with smoothed points and root; the other solutions are smoothed like it."""
    points = as_doubles(result.points)
    known = np.asarray(np.isfinite(points).all(-1))
    filters = _filters(np.where(known[..., None], points, 0), known, shots_of(result.tracks), method, cutoff, rate)
    chosen = filters[0][1]
    words = chosen.words
    if len(points) < chosen.least:
        note = f"smooth 3D ({words}): left as it is: {len(points)} frames are fewer than {chosen.least}"
        return replace(result, diagnostics=replace(result.diagnostics, notes=(*result.diagnostics.notes, note)))
    moved, short = _smooth_runs(points, known.astype(float), filters)
    change = math.sqrt(float(np.square(moved - points).sum(-1)[known].sum()) / max(int(known.sum()), 1))
    told = f"joints moved by {change:.2g} {result.units} (root mean square)"
    told += _left(short, int(known.sum()), "points", chosen)
    note = f"smooth 3D ({words}): {told}; the reprojection is that before"

    def path(values: torch.Tensor | None) -> torch.Tensor | None:
        if values is None:
            return None
        one = as_doubles(values)[:, None, None]
        smoothed, _ = _smooth_runs(one, np.isfinite(one[..., 0]).astype(float), filters)
        return torch.from_numpy(smoothed[:, 0, 0]).to(values)

    distance, scales = path(result.distance), result.scales
    if result.distance is not None and distance is not None:
        scales = scales * result.distance / distance  # which are the focal length over the distance
    return replace(
        result,
        points=torch.from_numpy(moved).to(result.points),
        diagnostics=replace(result.diagnostics, notes=(*result.diagnostics.notes, note)),
        scales=scales,
        root_depth=path(result.root_depth),
        distance=distance,
        alternatives=tuple(_smooth_result(other, method, cutoff, rate) for other in result.alternatives),
    ).remeasured()
