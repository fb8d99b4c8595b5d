"""From the arrays of a file to :class:`Tracks`, with joints matched by name."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

from numpy.typing import NDArray

from kcs_torch.errors import ShapeError
from kcs_torch.io.contents.shares import are_shares
from kcs_torch.io.registry import Options
from kcs_torch.skeleton import Skeleton, get_skeleton
from kcs_torch.types import Tracks
from kcs_torch.types.size import short_unit

__all__ = ["OVERSHOOT", "build_tracks", "nothing_seen"]

OVERSHOOT = 1.5  # some networks' confidences pass 1 a little; above this they are on another scale


def build_tracks(
    points: NDArray[Any],
    confidence: NDArray[Any] | None,
    options: Options,
    *,
    source: str,
    names: Sequence[str] | None = None,
    edges: Any = None,
    skeleton: str | Skeleton | None = None,
    fps: float | None = None,
    units: str = "px",
    notes: Sequence[str] = (),
    detector: bool | None = None,
    size: Any = None,
) -> Tracks:
    """Wrap what a reader found in a file, as the caller's ``options`` want it.

    Args:
        points: (T, N, 2), NaN where unseen.
        confidence: (T, N), or None.
        options: of the caller; they go before what the file says.
        source: the path.
        names: the file's joint names.
        edges: the file's (B, 2) bones.
        skeleton: the file's own skeleton.
        fps: the file's frames per second.
        units: the file's units.
        notes: sentences for the user.
        detector: whether the file says that a detector made them.
        size: width and height of the image, as the file tells them.

    Raises:
        OptionError: the caller says the size of an image that the tracks, by their units, do not lie in.
        ShapeError: the numbers are no tracks.
        SkeletonError: the joints do not fit the skeleton that the caller wants.
    """
    remarks = list(notes)
    chosen = options.skeleton if options.skeleton is not None else skeleton
    if chosen is not None:
        body = get_skeleton(chosen)
        if names is None and skeleton is not None:
            own = get_skeleton(skeleton)
            names = own.joints[: own.num_observed]
        if names is not None and len(names) != points.shape[1]:
            names = None
        chosen, edges = body, None
    pixels = short_unit(units) == "px"
    tracks = Tracks.from_arrays(
        points,
        confidence,
        skeleton=chosen,
        joint_names=names,
        edges=edges,
        fps=options.fps if options.fps is not None else fps,
        units=units,
        threshold=options.least,
        image_size=None if pixels and are_shares(points) else options.size_of(size if pixels else None),
        source=source,
        notes=remarks,
    )
    notes = tuple(dict.fromkeys(tracks.notes))  # a result read again already has some
    return replace(tracks, notes=notes, detector=detector)


def nothing_seen(source: str, threshold: float, highest: float) -> ShapeError:
    """The error for tracks none of whose joints reaches the threshold; ``highest`` is 0 where none has a place."""
    if not highest > 0:
        return ShapeError(f"{source}: no joint is seen in any frame: nothing to reconstruct")
    return ShapeError(
        f"{source}: no joint has a confidence of {threshold:g} or more, only {highest:.2g}: lower the threshold"
    )
