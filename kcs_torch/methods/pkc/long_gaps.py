"""Frames that show nobody: long gaps are solved as short ones, and what is before and after not at all."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from kcs_torch.functional.align import nearest_rotation
from kcs_torch.functional.camera import complete_rotation
from kcs_torch.functional.temporal import fill_between
from kcs_torch.methods.base import Estimate
from kcs_torch.methods.clips.unseen import gap_deviation
from kcs_torch.methods.pkc.cleaning import HELD, nobody_at_ends
from kcs_torch.types import Tracks

__all__ = ["first_frame", "lengthened", "shortened", "time_seen"]

LONGEST = 0.25
"""Seconds that a gap may last; of longer ones only so many frames are solved. What fills a gap bends as little as it
may, and over more than a second that leads through poses that no body makes."""

SHOWN = 2
"""Joints that a frame has to show so as not to be of a gap."""


def time_seen(tracks: Tracks) -> slice:
    """The frames from when the body is first seen until it was last seen; all if it never is.

    People come and go, while their tracks have all the frames of the film.
    """
    frames = _showing(tracks).nonzero().flatten().tolist()
    return slice(frames[0], frames[-1] + 1) if frames else slice(0, tracks.num_frames)


def shortened(tracks: Tracks) -> Tensor | None:
    """Indices (T',) of the frames that are solved: of the :func:`time_seen` all but much of long gaps; None if all are.

    Of gaps that last too long a few frames are solved, evenly spread.
    """
    most, frames = _longest(tracks), _showing(tracks).nonzero().flatten()
    keep = torch.zeros(tracks.num_frames, dtype=torch.bool, device=frames.device)
    keep[time_seen(tracks)] = True
    long = frames.diff() > most + 1
    before, after = frames[:-1][long], frames[1:][long]
    edges = torch.zeros_like(keep, dtype=torch.long)
    edges[before + 1], edges[after] = 1, -1
    keep &= edges.cumsum(0) == 0
    share = torch.arange(1, most + 1, device=frames.device) / (most + 1)
    keep[before[:, None] + (share * (after - before)[:, None]).round().long()] = True
    return None if bool(keep.all()) else keep.nonzero().flatten()


def _showing(tracks: Tracks) -> Tensor:
    """Whether frames (T,) show enough of the body."""
    return tracks.seen.sum(-1) >= min(SHOWN, tracks.num_joints)


def _longest(tracks: Tracks) -> int:
    """Frames that a gap may last."""
    return max(2, round(LONGEST * tracks.rate))


def lengthened(found: Estimate, kept: Tensor, tracks: Tracks, cameras: Tensor | None) -> Estimate:
    """An estimate of some frames of the tracks as one of all, linear in time between them.

    How unsure places in a gap are goes by how long it really is. ``cameras`` (T, 2, 3) that are known stay as they are.
    """

    def all_of(values: Tensor) -> Tensor:
        return fill_between(values[None], kept, tracks.num_frames)[0]

    points, frames = all_of(found.points), tracks.num_frames
    unseen = gap_deviation(points[..., :2], tracks.seen, tracks.rate, HELD)
    deviation = None if found.deviation is None else all_of(found.deviation).maximum(unseen)
    notes, ends = found.notes, int(kept[0]) + frames - 1 - int(kept[-1])
    if ends:
        notes = (*notes, nobody_at_ends(ends))
        if deviation is not None:  # nothing tells what goes on there
            time = torch.arange(frames, device=kept.device)
            held = HELD * ((time < kept[0]) | (time > kept[-1])).to(deviation)
            deviation = deviation.hypot(held[:, None])
    return replace(
        found,
        notes=notes,
        points=points,
        cameras=nearest_rotation(all_of(complete_rotation(found.cameras)))[:, :2] if cameras is None else cameras,
        scales=all_of(found.scales),
        deviation=deviation,
        standing=None if found.standing is None else all_of(found.standing),
        alternatives=tuple(lengthened(other, kept, tracks, cameras) for other in found.alternatives),
    )


def first_frame(found: Estimate) -> Estimate:
    """An estimate of several frames as one of the first."""
    return replace(
        found,
        points=found.points[:1],
        cameras=found.cameras[:1],
        scales=found.scales[:1],
        deviation=None if found.deviation is None else found.deviation[:1],
        standing=None if found.standing is None else found.standing[:1],
        alternatives=tuple(first_frame(other) for other in found.alternatives),
    )
