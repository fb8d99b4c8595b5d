"""Windows of 2D tracks from files, such as a detector's of one's own videos: what to train on without 3D."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from kcs_torch.clean import resample
from kcs_torch.errors import FormatError, KcsWarning, ShapeError
from kcs_torch.io import load_tracks
from kcs_torch.skeleton import Skeleton
from kcs_torch.training.batch import Batch
from kcs_torch.training.lifter import body_size, match_joints
from kcs_torch.types.bodies import IN_ORDER, numbered

__all__ = ["SEEN", "DetectedWindows"]

SEEN = 0.5
"""Share of the joints that are seen in every frame of a window, at least."""


@dataclass
class DetectedWindows:
    """Windows of 2D tracks, none of which has its truth.

    Attributes:
        tracks: (F, N, 2) of all clips one after another, each in its own unit, a body that comes nearer at one size; 0
            where unseen.
        weights: (F, N).
        starts: (W,) first frame of each window.
        window: frames.
    """

    tracks: Tensor
    weights: Tensor
    starts: Tensor
    window: int

    @classmethod
    def cut(
        cls,
        files: Sequence[Path],
        *,
        skeleton: Skeleton,
        fps: float | None,
        window: int,
        stride: int,
        reading: Mapping[str, Any] | None = None,
    ) -> DetectedWindows:
        """Read files and cut them into windows in which enough is seen.

        Args:
            files: in any format of :func:`kcs_torch.load_tracks`, the most seen person of each.
            skeleton: whose joints are found by name, as a :class:`kcs_torch.training.Lifter` does: a third of them at
                most may be missing, and are unseen.
            fps: frames per second that clips are brought to; those that do not say theirs are taken as they are.
            window: frames.
            stride: frames from one window to the next.
            reading: options of :func:`kcs_torch.load_tracks`.

        Raises:
            FormatError: a file cannot be read as tracks, or has no window in which enough is seen.
            SkeletonError: its joints do not fit.
            ShapeError: a clip is shorter than a window.

        Warns:
            KcsWarning: a file has as many joints as the skeleton, and no names.
        """
        points, weights, starts, first = [], [], [], 0
        for path in files:
            how = dict(reading or {})
            clip = load_tracks(path, **how)
            if numbered(clip.skeleton.joints):  # whose order is all that they tell
                clip = load_tracks(path, **how | {"skeleton": skeleton})
                for note in (note for note in clip.notes if note.startswith(IN_ORDER)):
                    warnings.warn(f"{path}: {note}", KcsWarning, stacklevel=2)
            if fps is not None and clip.fps is not None and clip.fps != fps:
                clip = resample(clip, fps)
            frames = clip.num_frames
            if frames < window:
                raise ShapeError(
                    f"{path}: expected at least a window of {window} frames, got {frames}: choose a smaller window, or "
                    "leave this clip out by a pattern that begins with !"
                )
            match = match_joints(clip.skeleton, skeleton, str(path))
            tracks, trust = match.take(clip.points / body_size(clip)[:, None, None], clip.weights, skeleton)
            enough = (trust > 0).double().mean(-1) >= SEEN
            own = [s for s in range(0, frames - window + 1, stride) if bool(enough[s : s + window].all())]
            if not own:
                raise FormatError(
                    f"{path}: none of its windows of {window} frames has half of the joints of skeleton "
                    f"'{skeleton.name}' in every frame: leave this clip out by a pattern that begins with !"
                )
            points.append(tracks.float())
            weights.append(trust.float())
            starts += [first + s for s in own]
            first += frames
        return cls(torch.cat(points), torch.cat(weights), torch.tensor(starts), window)

    def __len__(self) -> int:
        return len(self.starts)

    def batch(self, items: Tensor) -> Batch:
        """Put windows (B,) together, without labels and pseudo-labels."""
        frames = self.starts[items][:, None] + torch.arange(self.window)  # (B, T)
        tracks, weights = self.tracks[frames], self.weights[frames]
        points = tracks.new_zeros(*tracks.shape[:-1], 3)
        return Batch(tracks, weights, points, tracks.new_zeros(len(items)), torch.zeros_like(weights))
