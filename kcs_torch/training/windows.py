"""Clips cut into windows, each filmed from several views: what batches are taken from."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from kcs_torch.errors import FormatError, ShapeError
from kcs_torch.skeleton import Skeleton
from kcs_torch.training.batch import Batch, from_mean_depth
from kcs_torch.training.clips import Clip
from kcs_torch.training.film import film, random_cameras
from kcs_torch.training.seeds import generator_of

__all__ = ["FilmedWindows"]


@dataclass
class FilmedWindows:
    """All windows of some clips from all views; item ``window * views + view``.

    Attributes:
        clips: what they are cut from.
        starts: (W,) first frame of each window, within all clips' frames one after another.
        clip_of: (W,) the clip of each window.
        window: frames.
        pitch: degrees by which cameras look down, least and most.
        noise: standard deviation of the tracks.
        occlusion: expected share of hidden joints.
        points: (F, N, 3) of all clips.
        known: (F, N) where they hold.
        cameras: (C, V, 3, 3) of each clip's views.
        tracks: (V, F, N, 2) that these see.
        weights: (V, F, N).
        pseudo_points: (V, F, N, 3) reconstructions without truth, or None.
        pseudo_weights: (V, F, N) how far to trust them, or None.
    """

    clips: list[Clip]
    starts: Tensor
    clip_of: Tensor
    window: int
    pitch: tuple[float, float]
    noise: float
    occlusion: float
    points: Tensor
    known: Tensor
    cameras: Tensor
    tracks: Tensor
    weights: Tensor
    pseudo_points: Tensor | None = None
    pseudo_weights: Tensor | None = None

    @classmethod
    def cut(
        cls,
        clips: Sequence[Clip],
        *,
        window: int,
        stride: int,
        to_the_end: bool,
        views: int,
        pitch: tuple[float, float],
        noise: float,
        occlusion: float,
        key: tuple[object, ...],
    ) -> FilmedWindows:
        """Cut clips into windows and film each clip from its views.

        Args:
            clips: of one skeleton.
            window: frames.
            stride: frames from one window to the next.
            to_the_end: add a window that ends with the clip where frames are left.
            views: of each clip.
            pitch: degrees by which cameras look down, least and most.
            noise: standard deviation of the tracks.
            occlusion: expected share of hidden joints.
            key: of all random numbers.

        Raises:
            ShapeError: a clip is shorter than a window.
            FormatError: a clip has no window in which all its joints are known.
        """
        starts, clip_of, first = [], [], 0
        body = clips[0].skeleton
        for i, clip in enumerate(clips):
            own = _whole_windows(clip, window, stride, to_the_end)
            starts += [first + s for s in own]
            clip_of += [i] * len(own)
            first += len(clip.points)
        generator = generator_of(*key, "cameras")
        cameras = random_cameras((len(clips), views), pitch, generator)
        generator = generator_of(*key, "tracks")
        filmed = [
            film(
                clip.points.expand(views, *clip.points.shape),
                own_cameras,
                body,
                noise=noise,
                occlusion=occlusion,
                generator=generator,
                known=clip.known,
            )
            for clip, own_cameras in zip(clips, cameras, strict=True)
        ]
        return cls(
            list(clips),
            torch.tensor(starts),
            torch.tensor(clip_of),
            window,
            pitch,
            noise,
            occlusion,
            torch.cat([clip.points for clip in clips]),
            torch.cat([clip.known for clip in clips]),
            cameras,
            torch.cat([tracks for tracks, _ in filmed], 1),
            torch.cat([weights for _, weights in filmed], 1),
        )

    @property
    def skeleton(self) -> Skeleton:
        return self.clips[0].skeleton

    @property
    def views(self) -> int:
        return self.cameras.shape[1]

    def __len__(self) -> int:
        return len(self.starts) * self.views

    def frames_of(self, clip: int) -> slice:
        """Where a clip lies among all frames."""
        first = sum(len(c.points) for c in self.clips[:clip])
        return slice(first, first + len(self.clips[clip].points))

    def revealed(self, share: float, generator: torch.Generator) -> Tensor:
        """Which windows have their truth (W,), if a share of all their frames has: those that have it in every frame.

        Windows are drawn one after another, each with its frames from all views, as long as these are no more than the
        share, but one window at least of any share: what a smaller share reveals, a greater one does too.

        Args:
            share: of the frames that are in any window.
            generator: of the order.
        """
        count, frames = len(self.starts), len(self.points)
        drawn = torch.full((frames + self.window - 1,), count)
        drawn[self.starts + self.window - 1] = torch.randperm(count, generator=generator)
        turn = drawn.unfold(0, self.window, 1).amin(-1)  # at which each frame is shown
        shown = torch.bincount(turn, minlength=count)[:count].cumsum(0)
        turns = max(int((shown <= share * shown[-1]).sum()), 1) if share > 0 else 0
        return turn.unfold(0, self.window, 1).amax(-1)[self.starts] < turns

    def batch(self, items: Tensor, labelled: Tensor, fresh: torch.Generator | None = None) -> Batch:
        """Put items together.

        Args:
            items: (B,).
            labelled: (B,) bool, which of them show their truth.
            fresh: of new cameras, noise and hidden joints for these items; those of their own view if None.
        """
        window, view = items // self.views, items % self.views
        frames = self.starts[window][:, None] + torch.arange(self.window)  # (B, T)
        points = self.points[frames]
        if fresh is not None:
            cameras = random_cameras((len(items),), self.pitch, fresh)
            tracks, weights = film(
                points, cameras, self.skeleton, noise=self.noise, occlusion=self.occlusion, generator=fresh
            )
        else:
            cameras = self.cameras[self.clip_of[window], view]
            tracks, weights = self.tracks[view[:, None], frames], self.weights[view[:, None], frames]
        points = from_mean_depth(points @ cameras[:, None].mT)
        mark = labelled.to(points.dtype)
        shown = labelled[:, None, None, None]
        pseudo = torch.zeros_like(weights)
        if self.pseudo_points is None or self.pseudo_weights is None:
            points = torch.where(shown, points, torch.zeros_like(points))
        else:
            points = torch.where(shown, points, self.pseudo_points[view[:, None], frames])
            pseudo = torch.where(shown[..., 0], pseudo, self.pseudo_weights[view[:, None], frames])
        return Batch(tracks, weights, points, mark, pseudo)


def _whole_windows(clip: Clip, window: int, stride: int, to_the_end: bool) -> list[int]:
    """First frames of a clip's windows in which all joints are known: elsewhere is no truth to learn or to score."""
    frames = len(clip.points)
    if frames < window:
        raise ShapeError(
            f"{clip.source}: expected at least a window of {window} frames, got {frames}: choose a smaller "
            "window, or leave this clip out (a file by a pattern that begins with !)"
        )
    starts = list(range(0, frames - window + 1, stride))
    if to_the_end and starts[-1] < frames - window:
        starts.append(frames - window)
    whole = clip.known.all(1).unfold(0, window, 1).all(-1)
    starts = [start for start in starts if bool(whole[start])]
    if not starts:
        gaps = [clip.skeleton.joints[n] for n in (~clip.known).any(0).nonzero().flatten().tolist()]
        raise FormatError(
            f"{clip.source}: none of its windows of {window} frames has all joints; gaps in {', '.join(gaps)}"
        )
    return starts
