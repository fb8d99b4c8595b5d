"""A trained network as a method: :class:`Lifter`."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any, ClassVar, NamedTuple

import torch
from torch import Tensor, nn

from kcs_torch.errors import OptionError, ShapeError, SkeletonError, listed
from kcs_torch.functional.temporal import interpolate
from kcs_torch.methods import Method
from kcs_torch.methods.base import Estimate
from kcs_torch.methods.clips.size import weak_perspective
from kcs_torch.methods.clips.unseen import place_unseen
from kcs_torch.nn.networks import MLPLifter, TemporalLifter
from kcs_torch.nn.normalise import normalise_tracks
from kcs_torch.skeleton import Skeleton, map_joints
from kcs_torch.training.batch import from_mean_depth
from kcs_torch.types import Tracks
from kcs_torch.types.bodies import MOST_LACKING

__all__ = ["Lifter"]

OTHER_RATE = 1.25
"""Ratio of frame rates from which on a network that looks at several frames was trained on another tempo."""


@dataclass(frozen=True)
class Lifter(Method):
    """A trained network; what :func:`kcs_torch.training.load_lifter` gives.

    Tracks of another skeleton are matched by the joints' names. The network's joints that they lack, a third at most,
    are unseen to it; joints that it does not know keep their place in the image, and the skeleton's template gives
    their depth. A body that comes nearer or goes away is brought to one size before it is lifted.

    Args:
        network: (tracks (..., T, N, 2), weights (..., T, N)) to points (..., T, N, 3) in the camera frame.
        skeleton: of its N joints; the network's own attribute if None.
        fps: frames per second that it was trained on, or None where unknown.
        chunk: frames that are lifted at once, for the sake of memory; of the networks of this package the answer is the
            same for any.
        still: whether the camera may be taken to stand still, so that feet that stand tell the depth of the body.

    Raises:
        OptionError: the network has no skeleton, or a number is out of range.

    >>> from kcs_torch.data import walking_person
    >>> lifter = Lifter(TemporalLifter("h36m17"))  # untrained: all depths are about 0
    >>> lifter(walking_person(60).tracks).points.shape
    torch.Size([60, 17, 3])
    """

    name: ClassVar[str] = "lifter"
    keeps_lengths: ClassVar[bool] = False
    learned: ClassVar[bool] = True
    network: nn.Module = field(repr=False)
    skeleton: Skeleton | None = field(default=None, repr=False)
    fps: float | None = None
    chunk: int = 4096
    still: bool = True

    def __post_init__(self) -> None:
        super().__post_init__()
        if not isinstance(self.skeleton or getattr(self.network, "skeleton", None), Skeleton):
            raise OptionError(
                f"lifter: skeleton: expected that of {type(self.network).__name__}, which has none itself"
            )
        self._expect(self.fps is None or 0 < self.fps < float("inf"), "fps", "a positive number or None")
        self._expect(self.chunk >= 1, "chunk", "at least 1 frame")

    @property
    def body(self) -> Skeleton:
        """The skeleton of the network's joints."""
        body = self.skeleton or self.network.skeleton
        assert isinstance(body, Skeleton)
        return body

    def solve(self, tracks: Tracks, cameras: Tensor | None) -> Estimate:
        """Lift one clip."""
        return self._estimate([tracks], cameras)[0]

    def solve_all(self, tracks: Sequence[Tracks]) -> list[Estimate]:
        """Lift clips of one skeleton and equally many frames as one batch."""
        groups: dict[object, list[int]] = {}
        for i, one in enumerate(tracks):
            kind = (one.skeleton, one.num_frames, one.points.dtype, one.points.device)
            groups.setdefault(kind, []).append(i)
        out: dict[int, Estimate] = {}
        for group in groups.values():
            most = max(1, self.chunk // tracks[group[0]].num_frames)
            for start in range(0, len(group), most):
                part = group[start : start + most]
                out |= zip(part, self._estimate([tracks[i] for i in part], None), strict=True)
        return [out[i] for i in range(len(tracks))]

    def _estimate(self, clips: Sequence[Tracks], cameras: Tensor | None) -> list[Estimate]:
        """Lift clips of one skeleton and equally many frames."""
        first = clips[0]
        match = match_joints(first.skeleton, self.body, first.source)
        sizes = [body_size(one) for one in clips]
        points = torch.stack([one.points / size[:, None, None] for one, size in zip(clips, sizes, strict=True)])
        lifted = self._lift(*match.take(points, torch.stack([one.weights for one in clips]), self.body))
        out = []
        eye = torch.eye(3, dtype=points.dtype, device=points.device)[:2].expand(first.num_frames, 2, 3)
        for one, answer, image, size in zip(clips, lifted, points, sizes, strict=True):
            notes = [*match.notes, *self._tempo(one)]
            share = float(size.amax() / size.amin())
            if share > 1:
                notes.append(f"weak perspective: the body's size in the image varies by a factor of {share:.2f}")
            body = from_mean_depth(match.give(answer, image, one))
            out.append(
                Estimate(body, eye if cameras is None else cameras, size, True, 1, tuple(notes), still=self.still)
            )
        return out

    def _lift(self, points: Tensor, weights: Tensor) -> Tensor:
        """Run the network on (C, T, N, 2), some frames at a time, on its device and in its dtype."""
        own = next(self.network.parameters(), points)
        image, seen = points.to(own), weights.to(own)
        frames = image.shape[1]
        options: dict[str, Any] = {}
        reach = frames  # a network that we do not know may look at all of them
        if isinstance(self.network, (MLPLifter, TemporalLifter)):
            options["scale"] = normalise_tracks(image, seen).scale  # of the clip, not of each chunk
            reach = self.network.receptive_field // 2
        step = max(1, self.chunk // len(image)) if reach < frames else frames
        parts = []
        with _evaluating(self.network):
            for start in range(0, frames, step):
                low, high = max(0, start - reach), min(frames, start + step + reach)
                part = self.network(image[:, low:high], seen[:, low:high], **options)
                _check_answer(self.network, part, (len(image), high - low, image.shape[2], 3))
                parts.append(part[:, start - low : start - low + step])
        return torch.cat(parts, 1).to(points)

    def _tempo(self, tracks: Tracks) -> list[str]:
        """A note where the network looks at several frames and knows them at another rate."""
        several = getattr(self.network, "receptive_field", 2) > 1
        if self.fps is None or tracks.fps is None or not several:
            return []
        if 1 / OTHER_RATE < tracks.fps / self.fps < OTHER_RATE:
            return []
        return [
            f"the network was trained on {self.fps:g} frames a second, and sees {tracks.fps:g} here: "
            "kcs_torch.clean.resample brings tracks to another rate"
        ]


class Match(NamedTuple):
    """Which joint of tracks is which of a network.

    Attributes:
        same: whether these are the network's joints, in its order.
        column: for each observed joint of the network its place in the tracks, -1 for none.
        back: for each joint of the tracks its place in the network's answer, -1 for none.
        notes: what to tell the user.
    """

    same: bool
    column: list[int]
    back: list[int]
    notes: tuple[str, ...]

    def take(self, points: Tensor, weights: Tensor, body: Skeleton) -> tuple[Tensor, Tensor]:
        """Tracks (..., T, N, 2) as the network takes them, virtual joints included."""
        if self.same:
            return points, weights
        points = nn.functional.pad(points, (0, 0, 0, 1))[..., self.column, :]
        return body.complete(points, nn.functional.pad(weights, (0, 1))[..., self.column])

    def give(self, answer: Tensor, image: Tensor, tracks: Tracks) -> Tensor:
        """The network's points (T, N, 3) as points of the joints of ``tracks``, which lie at ``image`` (T, N, 2)."""
        if self.same:
            return answer
        known = torch.tensor([i >= 0 for i in self.back], device=answer.device)
        points = answer[..., [max(i, 0) for i in self.back], :]
        if bool(known.all()):
            return points
        placed = place_unseen(points, known, tracks.skeleton)
        # Of a joint that the network does not know the tracks still show where it is in the image.
        middle = (points[..., :2] - image) * (known & tracks.seen)[..., None]
        count = (known & tracks.seen).sum(-1)[..., None, None].clamp_min(1)
        image = image + middle.sum(-2, keepdim=True) / count
        shown = (~known & tracks.seen)[..., None]
        return torch.cat([torch.where(shown, image, placed[..., :2]), placed[..., 2:]], -1)


def body_size(tracks: Tracks) -> Tensor:
    """Size (T,) of the body in the image, of mean 1, where it clearly changes: networks know bodies of one size."""
    image = interpolate(tracks.points, tracks.seen)
    size = weak_perspective(image, tracks.seen, tracks.skeleton, tracks.rate)
    return size.path if size.sure else torch.ones_like(image[:, 0, 0])


def match_joints(own: Skeleton, body: Skeleton, source: str) -> Match:
    """Match the joints of tracks with those of a network, by name.

    Raises:
        SkeletonError: too many of the network's joints are not among them.
    """
    everyone = list(range(len(body.joints)))
    if own.joints == body.joints and own.virtual == body.virtual:
        return Match(True, everyone, everyone, ())
    wanted = body.joints[: body.num_observed]
    found = map_joints(own.joints, wanted)
    missing = [name for name, i in zip(wanted, found, strict=True) if i is None]
    if MOST_LACKING * len(missing) > len(wanted):
        raise SkeletonError(
            f"{source}: expected the {len(wanted)} joints that the network was trained on ({', '.join(wanted)}), got "
            f"skeleton '{own.name}', none of whose joints is {listed(missing, 6)}"
        )
    back = [-1 if i is None else i for i in map_joints(body.joints, own.joints)]
    for place, i in enumerate(found):
        if i is not None:
            back[i] = place
    unknown = [name for name, i in zip(own.joints, back, strict=True) if i < 0]
    notes = [f"joints matched by name with those of the network (skeleton '{body.name}')"]
    if missing:
        notes.append(f"not among the tracks, so unseen by the network: {', '.join(missing)}")
    if unknown:
        notes.append(f"not among the network's joints, so their depth is the template's: {', '.join(unknown)}")
    return Match(False, [-1 if i is None else i for i in found], back, tuple(notes))


def _check_answer(network: nn.Module, answer: Any, expected: tuple[int, ...]) -> None:
    """Raise a ShapeError unless a network of the user's own answers with points of this shape."""
    if not isinstance(answer, Tensor) or answer.shape != expected:
        got = tuple(answer.shape) if isinstance(answer, Tensor) else f"a {type(answer).__name__}"
        raise ShapeError(
            f"lifter: {type(network).__name__}: expected an answer of points (C, T, N, 3) = {expected}, got {got}"
        )


@contextmanager
def _evaluating(network: nn.Module) -> Iterator[None]:
    """Leave out dropout, whatever the network is in the middle of."""
    modes = [(module, module.training) for module in network.modules()]
    network.eval()
    try:
        yield
    finally:
        for module, mode in modes:
            module.training = mode
