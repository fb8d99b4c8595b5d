"""Short gaps filled, where somebody asks for it."""

from __future__ import annotations

import numpy as np
import torch

from kcs_torch.clean.common import check_tracks, number, rebuilt, runs, share
from kcs_torch.clean.timing import shots_of
from kcs_torch.errors import OptionError, unknown
from kcs_torch.types import Tracks
from kcs_torch.types.arrays import as_doubles
from kcs_torch.types.hints import is_a

__all__ = ["fill"]

_KINDS = ("cubic", "linear")


def fill(tracks: Tracks, longest: int, *, kind: str = "cubic", weight: float = 0.3) -> Tracks:
    """Fill gaps between two seen frames of a joint, up to a length; a note says how much was filled.

    Methods take gaps as they are; fill only what another program could not read otherwise.

    Args:
        tracks: what to fill.
        longest: frames of the longest gap to fill. Longer ones, and those at the ends of the clip, or of a shot where a
            film has cuts (:func:`~kcs_torch.clean.split`), stay.
        kind: "cubic" (monotone cubic, PCHIP, which never overshoots) or "linear".
        weight: what a filled joint counts, as a share of the lesser of its gap's two ends.

    Returns:
        Tracks in which filled joints are seen, with a lower weight.

    Raises:
        OptionError: an option is out of range.

    >>> from kcs_torch.data.synthetic import walking_person
    >>> tracks = walking_person(60).tracks
    >>> tracks.weights[20:23, 9] = 0
    >>> fill(tracks, 5).notes[-1]
    'fill: 3 of 3 (100 %) unseen detections filled (cubic): gaps of up to 5 frames, 1 of them'
    """
    check_tracks(tracks, "fill")
    if not is_a(longest, int) or longest < 1:
        raise OptionError(f"fill: longest: expected a whole number of frames from 1, got {longest!r}")
    if kind not in _KINDS:
        raise unknown("kind of fill", kind, _KINDS)
    number(weight, "fill: weight", "a share above 0, at most 1", below=1 + 1e-9)
    from scipy.interpolate import PchipInterpolator

    count = tracks.skeleton.num_observed
    points = as_doubles(tracks.points[:, :count]).copy()
    weights = as_doubles(tracks.weights[:, :count]).copy()
    unseen, filled, gaps = int((weights == 0).sum()), 0, 0
    for shot in shots_of(tracks):
        for joint in range(count):
            place, trust = points[shot, joint], weights[shot, joint]  # views
            time, known = np.arange(len(trust)), trust > 0
            short = [(a, b) for a, b in runs(~known) if a > 0 and b < len(time) and b - a <= longest]
            if not short:
                continue
            if kind == "cubic":
                curve = PchipInterpolator(time[known], place[known])
            for start, stop in short:
                inside, ends = time[start:stop], [start - 1, stop]
                if kind == "cubic":
                    place[inside] = curve(inside)
                else:
                    part = ((inside - ends[0]) / (ends[1] - ends[0]))[:, None]
                    place[inside] = (1 - part) * place[ends[0]] + part * place[ends[1]]
                trust[inside] = weight * trust[ends].min()
                filled, gaps = filled + len(inside), gaps + 1
    what = f"{share(filled, unseen)} unseen detections filled"
    note = f"fill: {what} ({kind}): gaps of up to {longest} frames, {gaps} of them"
    return rebuilt(tracks, torch.from_numpy(points), torch.from_numpy(weights), note)
