"""A clip as PKC solves it, with all that is known of it beforehand."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import torch
from torch import Tensor

from kcs_torch.clean.detector import detected
from kcs_torch.functional.camera import complete_rotation, viewpoint_turn
from kcs_torch.methods.clips.size import Size
from kcs_torch.types import Tracks

__all__ = ["LEAST_FRAMES", "LEAST_JOINTS", "Clip"]

TELLING = 2.0
"""Degrees of the turn of known cameras from which on they tell the sign of depth."""

LEAST_FRAMES, LEAST_JOINTS = 3, 4
"""Frames and joints from which on the viewpoint's turn may tell depth."""

MANY_FRAMES = 12
"""In clips of fewer frames it does so only if bones link all joints and all are seen, and less than in others."""


@dataclass(frozen=True)
class Clip:
    """A clip without long gaps.

    Attributes:
        tracks: as they were given.
        points: (T, N, 2) the tracks smoothed and complete.
        image: (T, N, 2) the same about their middle, perhaps of even size.
        noise: (T, N) standard deviation that is left in them.
        standing: (T, C) how surely contact points stand still, or None.
        cameras: (T, 2, 3) that are known, or None.
        size: of the body in the image over time.
        notes: on what was done with the tracks.
    """

    tracks: Tracks
    points: Tensor
    image: Tensor
    noise: Tensor
    standing: Tensor | None
    cameras: Tensor | None
    size: Size
    notes: tuple[str, ...]

    @property
    def enough(self) -> bool:
        """Whether the viewpoint's turn may tell depth: of many frames, or of a few of a whole tree that is all seen."""
        tracks = self.tracks
        whole = tracks.skeleton.is_tree and bool(tracks.seen.all())
        least = LEAST_FRAMES if whole else MANY_FRAMES
        return tracks.num_joints >= LEAST_JOINTS and tracks.num_frames >= least

    @property
    def many(self) -> bool:
        """Whether it tells it better than a template does."""
        return self.enough and self.tracks.num_frames >= MANY_FRAMES

    @property
    def detections(self) -> bool:
        """Whether joints are a detector's: errors last, would be taken for motion, and hide what a size explains."""
        return detected(self.tracks)

    @cached_property
    def telling(self) -> Tensor | None:
        """Rotations (T, 3, 3) of known cameras that turn far enough to tell the sign of depth; None if they do not."""
        if self.cameras is not None and float(viewpoint_turn(self.cameras)) >= TELLING:
            return complete_rotation(self.cameras)
        return None

    def even(self) -> Clip:
        """The same with an image in which the body's size does not change."""
        return replace(self, image=self.image / self.size.path[:, None, None])

    def complete(self) -> Tracks:
        """Tracks with all joints seen where the image has them."""
        return replace(self.tracks, points=self.image, weights=torch.ones_like(self.tracks.weights))
