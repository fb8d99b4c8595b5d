"""The live mode's front: takes frames, keeps the window, says when to solve it again."""

from __future__ import annotations

from collections import deque
from collections.abc import Generator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from kcs_torch.errors import OptionError, ShapeError, SkeletonError
from kcs_torch.functional.chain import bone_vectors, chain_inverse, incidence
from kcs_torch.live.filter import BodyFilter, ChainFilter, Known, Shape, place
from kcs_torch.live.solve import Solution, solve_chain, solve_window
from kcs_torch.methods.pkc import PKC
from kcs_torch.methods.pkc.trunk import mirror
from kcs_torch.methods.unseen import place_unseen
from kcs_torch.nn.posture import trunk_joints
from kcs_torch.skeleton import Skeleton, get_skeleton
from kcs_torch.types import Reconstruction, Tracks, as_floats
from kcs_torch.types.intake import as_number

__all__ = ["LivePose", "Tracker"]

SOLVED_FRAMES = 30
"""Frames of a window that are solved, evenly spread: more tell little more, and take longer."""

EARLY = (1 / 3, 1.0)
"""Shares of the window that are solved as it fills."""

LENGTH = 3.0
"""Seconds of a window."""

STEPS = 12
"""L-BFGS steps of a solve, at most."""

AGAIN = 10.0
"""Seconds after which the window is solved again."""

REMEMBERED = 3
"""Windows that the bones' proportions are averaged over."""

REPLAYED = 15
"""Solved frames that the filter takes again when a window has been solved, and all frames since."""

FOUND, USUAL = 0.02, 0.1
"""Standard deviation of a bone's length as a share: as it is found, and before."""

SCALE = 0.6
"""Quantile over bones of longest image over usual length that is taken for the scale, before the first solve."""

FLAT = 0.25
"""Share of its length below which a bone's depth is no better known for being small."""

DRIFT, FARTHEST = 1.0, 0.3
"""Speed at which an unseen joint's deviation grows, a second, and how far; a person being 1.75 tall."""


@dataclass(frozen=True)
class LivePose:
    """The pose of one frame.

    Attributes:
        frame: its number, from 0.
        points: (N, 3) in the camera frame, in the units of the tracks: x and y in the image, depth relative to the
            body's middle. NaN until a joint has been seen.
        uncertainty: (N,) standard deviation of the depths, in the same units; infinite until a joint has been seen.
        seen: (N,) bool, False where a joint is placed by prediction.
        ready: whether the body's bone lengths have been found; before, they are the template's.
        delay: frames since the window ended from which the bone lengths come; -1 before there is one.
    """

    frame: int
    points: Tensor
    uncertainty: Tensor
    seen: Tensor
    ready: bool
    delay: int


class Tracker:
    """3D poses of one body from 2D joints, frame by frame.

    Each update costs one step of a causal filter: the trunk's rotation from the frame before, the signs of the limbs'
    depths by the forward half of a second-order Viterbi recursion, and bones of constant length. Bone lengths, the
    trunk's shape and the signs so far come from solving the window as :class:`kcs_torch.PKC` does before a fixed
    viewpoint: when a third of the window has come, when it is full, and then every ``period`` frames. A solve is spread
    over the updates that follow, a slice each. On one thread of a CPU a step takes 1 to 2 ms (17 joints), a slice 20 to
    100 ms, the longest one 0.3 to 0.5 s: a camera's frames wait that long, three times in the first 20 seconds.

    Bone lengths in the tracks' units change when a solve ends, not between: so does the size of a body that comes
    nearer.

    The camera is taken not to move. Without a template the viewpoint has to turn: depths are 0 and ``ready`` is False
    until the first full window has been solved, in one piece, which may take seconds. All work is done on the CPU in
    double precision, whatever the input is; poses come back on the device and in the dtype of the input. The same
    frames give the same poses. Memory does not grow beyond the window.

    Args:
        skeleton: name, file or :class:`kcs_torch.Skeleton`; its bones form a tree.
        fps: frames a second.
        window: frames that are kept; three seconds if None.
        period: frames between solves; ten seconds if None.
        units: of the tracks.
        threshold: a joint with less confidence counts as unseen.
        method: whose fields :meth:`result` takes, and the solves, with fewer ``steps``; ``PKC()`` if None.

    Raises:
        SkeletonError: the skeleton is unknown, or its bones are no tree.
        OptionError: a number is out of range.

    >>> from kcs_torch.data import walking_person
    >>> clip = walking_person(45, skeleton="coco17").tracks
    >>> tracker = Tracker("coco17", fps=30, units="mm")
    >>> for xy in clip.points[:, :17]:  # (17, 2), NaN where unseen
    ...     pose = tracker.update(xy)
    >>> pose.frame, pose.points.shape, pose.ready
    (44, torch.Size([19, 3]), True)
    """

    def __init__(
        self,
        skeleton: str | Path | Skeleton,
        *,
        fps: float = 30.0,
        window: int | None = None,
        period: int | None = None,
        units: str = "px",
        threshold: float = 0.3,
        method: PKC | None = None,
    ) -> None:
        body = get_skeleton(skeleton)
        if not body.is_tree:
            raise SkeletonError(
                f"Tracker: expected a skeleton whose bones form one tree, got '{body.name}'; "
                "kcs_torch.methods.found.find_skeleton finds one from a clip"
            )
        rate, least = as_number(fps), as_number(threshold)
        if rate is None or not 0 < rate < float("inf"):
            raise OptionError(f"Tracker: fps: expected a positive number, got {fps!r}")
        if least is None or not 0 <= least <= 1:
            raise OptionError(f"Tracker: threshold: expected a confidence within 0..1, got {threshold!r}")
        window = max(SOLVED_FRAMES, round(LENGTH * rate)) if window is None else window
        period = max(window, round(AGAIN * rate)) if period is None else period
        for name, value in (("window", window), ("period", period)):
            if not isinstance(value, int) or isinstance(value, bool) or value < 12:
                raise OptionError(f"Tracker: {name}: expected at least 12 frames, got {value!r}")
        self.skeleton, self.fps, self.window, self.period = body, rate, window, period
        self.units, self.threshold = units, least
        self.method = PKC() if method is None else method
        self._due = [min(max(12, round(share * window)), window) for share in EARLY]
        self._templated = len(trunk_joints(body)) >= 3
        self._filter: BodyFilter | ChainFilter
        self._filter = BodyFilter(body, rate) if self._templated else ChainFilter(body, rate)
        self._bones = body.bone_index()
        self._tree = chain_inverse(incidence(self._bones, body.num_joints, dtype=torch.float64)).square()
        self._frame = -1
        self.reset()

    def reset(self) -> None:
        """Forget the body, its bone lengths and the window; frames are counted on."""
        self._filter.reset()
        self._image: deque[Tensor] = deque(maxlen=self.window)  # complete, (N, 2)
        self._weights: deque[Tensor] = deque(maxlen=self.window)
        self._points: deque[Tensor] = deque(maxlen=self.window)
        self._path: deque[Tensor] = deque(maxlen=self.window)
        self._shape: Shape | None = None
        self._age: Tensor = torch.zeros(self.skeleton.num_joints, dtype=torch.float64)
        self._met: Tensor = torch.zeros(self.skeleton.num_joints, dtype=torch.bool)
        self._solving: Generator[None, None, Solution] | None = None
        self._since = self._frame + 1  # the frame that the window began with
        self._asked = self._solved = -1
        self._told = 0
        self._next = self._since + (self._due[0] if self._templated else self.window) - 1

    def update(self, xy: Any, confidence: Any = None) -> LivePose:
        """Take the next frame and return its pose.

        Args:
            xy: (num_observed, 2) array or tensor; NaN where unseen. A frame of NaN is one without the person; after a
                whole window of them the tracker starts anew.
            confidence: (num_observed,) in 0..1; 1 where None.

        Raises:
            ShapeError: the shape is wrong or a value infinite or out of range; the frame is then not taken.
        """
        points, weights, like = self._take(xy, confidence)
        self._frame += 1
        seen = weights > 0
        if not self._image and not bool(seen.any()):
            self._since, self._next = self._since + 1, self._next + 1
            blank, unsure = (points.new_full((len(points), 3), x).to(like) for x in (torch.nan, torch.inf))
            return LivePose(self._frame, blank, unsure[:, 0], seen.to(blank.device), False, -1)
        image = self._complete(points, seen)
        self._image.append(image)
        self._weights.append(weights)
        shape = self._shape or self._guess()
        dz = self._filter.run(image[None], weights[None], shape)[-1]
        self._path.append(self._filter.path[-1])
        pose = self._pose(image, dz, seen, shape).to(like)
        out = LivePose(
            self._frame,
            pose[:, :3],
            pose[:, 3],
            seen.to(pose.device),
            self._shape is not None,
            self._frame - self._solved if self._shape is not None else -1,
        )
        if float(self._age.amin()) >= self.window:
            self.reset()
        else:
            self._advance()
        return out

    def tracks(self) -> Tracks:
        """The window's frames, with their gaps.

        Raises:
            ShapeError: no joint has been seen.
        """
        if not self._image:
            raise ShapeError("Tracker: no joint has been seen yet: there is nothing to reconstruct")
        weights = torch.stack(list(self._weights))
        points = torch.where(weights[..., None] > 0, torch.stack(list(self._image)), 0.0)
        return Tracks(points, weights, self.skeleton, self.fps, self.units, f"live from frame {self._first_kept}")

    def result(self) -> Reconstruction:
        """Reconstruct the frames in the window anew by the method, at leisure: more accurate than the live poses.

        Raises:
            ShapeError: no joint has been seen.
        """
        return self.method(self.tracks())

    # ------------------------------------------------------------------ one frame

    @property
    def _first_kept(self) -> int:
        return self._frame + 1 - len(self._image)

    def _take(self, xy: Any, confidence: Any) -> tuple[Tensor, Tensor, Tensor]:
        """Points (N, 2), 0 where unseen, weights (N,), and a tensor like the input."""
        where = f"frame {self._frame + 1}"
        given = as_floats(xy, f"{where}: xy", 2)
        count = self.skeleton.num_observed
        name = lambda bad: f"joint '{self.skeleton.joints[int(bad.nonzero()[0, 0])]}'"  # noqa: E731
        if given.shape != (count, 2):
            expected = f"({count}, 2) for skeleton '{self.skeleton.name}'"
            raise ShapeError(f"{where}: xy: expected shape {expected}, got {tuple(given.shape)}")
        points = given.detach().to("cpu", torch.float64)
        infinite = torch.isinf(points).any(-1)
        if bool(infinite.any()):
            raise ShapeError(f"{where}: xy: {name(infinite)} is infinite; write NaN where a joint is unseen")
        seen = torch.isfinite(points).all(-1)
        if confidence is None:
            weights = seen.double()
        else:
            weights = as_floats(confidence, f"{where}: confidence", 1).detach().to("cpu", torch.float64)
            if weights.shape != (count,):
                raise ShapeError(f"{where}: confidence: expected shape ({count},), got {tuple(weights.shape)}")
            weights = torch.nan_to_num(weights, nan=0.0, posinf=torch.inf, neginf=-torch.inf)
            wrong = (weights < 0) | (weights > 1)
            if bool(wrong.any()):
                raise ShapeError(f"{where}: confidence: {name(wrong)} has {float(weights[wrong][0]):g}; expected 0..1")
            weights = torch.where(seen & (weights >= self.threshold), weights, 0.0)
        points = torch.where(weights[:, None] > 0, points, 0.0)
        return *self.skeleton.complete(points, weights), given

    def _complete(self, points: Tensor, seen: Tensor) -> Tensor:
        """The frame with unseen joints where they were, moved as the seen ones moved."""
        self._age = torch.where(seen, 0.0, self._age + 1)
        self._met = self._met | seen
        if bool(seen.all()):
            return points
        if self._image:
            last = self._image[-1]
            shift = (points - last)[seen].mean(0) if bool(seen.any()) else points.new_zeros(2)
            points = torch.where(seen[:, None], points, last + shift)
        if not bool(self._met.all()) and bool(self._met.any()):
            flat = torch.nn.functional.pad(points, (0, 1))[None]
            points = place_unseen(flat, self._met, self.skeleton)[0, :, :2]
        return points

    def _guess(self) -> Shape:
        """The body as far as the frames so far tell: the template, at the scale of its longest images."""
        image = torch.stack(list(self._image))
        if isinstance(self._filter, BodyFilter):
            usual = self._filter.usual
            ratio = (bone_vectors(image, self._bones).norm(dim=-1).amax(0) / usual.lengths)[list(self.skeleton.rigid)]
            scale = float(torch.quantile(ratio, SCALE)) if len(ratio) else 1.0
            return Shape(1 / scale if scale > 0 else 1.0, usual.lengths, usual.trunk)
        size = float((image - image.mean(1, keepdim=True)).square().sum(-1).mean().sqrt())
        factor = 0.5 / size if size > 0 else 1.0
        return Shape(factor, bone_vectors(image, self._bones).norm(dim=-1).amax(0) * factor, image.new_zeros(0, 3))

    def _pose(self, image: Tensor, dz: Tensor, seen: Tensor, shape: Shape) -> Tensor:
        """Joints and the deviation of their depths, (N, 4), in the tracks' units."""
        points, dz = place(self.skeleton, image * shape.factor, dz, shape.lengths, self._filter.body)
        points[:, 2] -= points[:, 2].mean()
        length = shape.lengths.clamp_min(1e-9)
        off = length * (USUAL if self._shape is None else FOUND) / (dz.abs() / length).clamp_min(FLAT)
        variance = self._tree @ (off.square() + self._filter.doubt * (2 * dz).square())
        variance = variance + (self._age * (DRIFT / self.fps)).clamp_max(FARTHEST).square()
        pose = torch.cat([points, variance.sqrt()[:, None]], -1) / shape.factor
        self._points.append(pose[:, :3])
        return pose

    # ------------------------------------------------------------------ the window

    def _advance(self) -> None:
        """One slice of a window solve, where one is due."""
        if self._solving is None and self._frame >= self._next:
            image, weights = torch.stack(list(self._image)), torch.stack(list(self._weights))
            stride, steps = max(1, -(-len(image) // SOLVED_FRAMES)), min(self.method.steps, STEPS)
            if self._templated:
                warm = torch.stack(list(self._points))[..., 2]
                self._solving = solve_window(
                    self.skeleton, image, weights, self.fps, stride=stride, steps=steps, warm=warm
                )
            else:
                self._solving = solve_chain(self.skeleton, image, weights, self.fps, stride=stride, method=self.method)
            self._asked = self._frame
            age = self._frame + 1 - self._since
            later = [f for f in self._due if f > age]
            self._next = self._since + later[0] - 1 if later else self._frame + self.period
        elif self._solving is not None:
            try:
                next(self._solving)
            except StopIteration as end:
                self._solving, self._solved = None, self._asked
                self._adopt(end.value)

    def _adopt(self, found: Solution) -> None:
        """Take over the body that was found, and let the filter take the frames since then again."""
        shape, known = found.shape, found.known
        self._told = min(self._told + found.frames, REMEMBERED * self.window)
        if self._shape is not None:
            shape = shape.blended(self._shape, found.frames / self._told)
        self._shape = shape
        since = self._frame - self._asked
        image, weights = torch.stack(list(self._image)), torch.stack(list(self._weights))
        path = torch.stack(list(self._path))
        told = len(image) - since  # frames of the window up to the solved window's end
        begin = max(0, told - REPLAYED)
        count = told - begin
        if count > 0:
            last = Known(known.depths[-count:], known.rotations[-count:])
            self._filter.run(image[begin:told], weights[begin:told], self._shape, last)
            own, goal = path[told - 1], last.rotations[-1]
            if float((mirror(own) * goal).sum()) > float((own * goal).sum()):
                path = mirror(path)
        if since and count > 0:
            self._filter.run(image[told:], weights[told:], self._shape, start=path[told:])
