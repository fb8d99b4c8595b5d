"""The live mode's front: keeps the window, has each frame filtered, and says when to solve the window again."""

from __future__ import annotations

import math
import warnings
from collections import deque
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any, NamedTuple, NoReturn, Self

import torch
from torch import Tensor

from kcs_torch.errors import KcsWarning, OptionError, ShapeError, users_level
from kcs_torch.live.filter import BodyFilter, ChainFilter, Told
from kcs_torch.live.follow import Follower
from kcs_torch.live.frame import Sight, take_frame
from kcs_torch.live.options import LEAST, Options, check_options
from kcs_torch.live.pose import Chain, LivePose
from kcs_torch.live.solve import Solved, solve_window
from kcs_torch.methods.perspective.near_or_far import may_be_near
from kcs_torch.methods.perspective.uncalibrated import reconstruct_uncalibrated
from kcs_torch.methods.pkc import PKC
from kcs_torch.methods.pkc.limbs import outward
from kcs_torch.nn.posture import has_trunk
from kcs_torch.skeleton import Skeleton
from kcs_torch.types import Reconstruction, Tracks
from kcs_torch.types.image_size import fitting_size
from kcs_torch.types.upright import ABOVE, how_it_stands

__all__ = ["Tracker"]

EARLY: tuple[float, ...] = (1 / 3, 1.0)
"""Shares of the window that are solved as it fills."""

DELAY = 1 / 3
"""Frames that a solve may take, a share of those solved; without a template the whole."""

REMEMBERED = 3
"""Windows that the bones' proportions are averaged over."""

REPLAYED = 15
"""Solved frames that the filter takes again when a window has been solved, and all frames since."""

AT_ONCE = 4
"""Frames that are taken again in an update that must not block."""

LOST = 0.5
"""Seconds without the body after which the filter starts anew from many headings."""


class _Next(NamedTuple):
    """Who takes a window's last frames again.

    Attributes:
        follower: who knows the body that a solve found.
        told: what that solve says of its frames.
        frame: the next one.
    """

    follower: Follower
    told: Told
    frame: int


class Tracker:
    """3D poses of one body from 2D joints, frame by frame.

    Each update is one step of a causal filter: the trunk's rotation from the frame before, the signs of the limbs'
    depths by the forward half of a second-order Viterbi recursion, and bones of constant length. Bone lengths, the
    trunk's shape and the signs so far come from the window of the newest frames, solved by :class:`kcs_torch.PKC` as
    before a fixed viewpoint: when a third of the window has come, when it is full, then every ``period`` frames. A
    window is solved in a thread of its own while frames go on; :meth:`close`, or the end of a ``with`` block, ends it.
    What a solve finds is taken over a fixed number of frames later, a third of the window's; without a template, all of
    the window's. Where frames come faster, or the machine is slow, that one update waits for the thread, unless
    ``wait`` is False.

    Bones keep their proportions until a window has been solved again. The size of a body that comes nearer or goes away
    is followed from frame to frame, by its trunk and the bones that look longest; without a template only growth is,
    until the next solve. Whoever comes back after half a second may be another: once a window shows nobody else, it is
    solved, and tells the bones alone. The camera is taken to move little. Without a template the viewpoint has to turn:
    depths are guesses and ``ready`` is False until a full window has been solved, two windows from the start. All work
    is done on the CPU in double precision; poses come back on the device and in the dtype of the input, float32 for
    half precision, float64 for whole numbers and lists. Memory does not grow beyond the window.

    Frames come evenly in time: where a camera dropped some, call :meth:`update` with a frame of NaN for each. The
    arguments are attributes that cannot change: for another rate make a new tracker.

    Args:
        skeleton: name, file or :class:`kcs_torch.Skeleton`; its bones form a tree.
        fps: frames a second.
        window: frames that are kept; three seconds if None.
        period: frames between solves; ten seconds if None.
        units: of the tracks.
        threshold: a joint with less confidence counts as unseen.
        wait: whether an update waits for a solve that should have ended. True gives the same poses for the same frames;
            False, for a camera, takes what a solve finds over when it has ended, within some updates more: each takes a
            few frames again, in up to four times the time of a usual one.
        method: whose fields :meth:`result` takes, and the solves, with fewer steps; ``PKC()`` if None.
        image_size: width and height of the image in pixels, which :meth:`tracks` have: by it :meth:`result` knows the
            camera's lens roughly, and shares of the image become pixels. Live poses are as before a far one.

    Raises:
        SkeletonError: the skeleton is unknown, or its bones are no tree.
        OptionError: a number is out of range; or an image's size is given for tracks that are not in pixels.

    >>> from kcs_torch.data import walking_person
    >>> clip = walking_person(45, skeleton="coco17").tracks
    >>> with Tracker("coco17", fps=30, units="mm") as tracker:
    ...     for xy in clip.points[:, :17]:  # (17, 2), NaN where unseen
    ...         pose = tracker.update(xy)
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
        wait: bool = True,
        method: PKC | None = None,
        image_size: tuple[int, int] | None = None,
    ) -> None:
        given = check_options(skeleton, fps, window, period, units, threshold, wait, method, image_size)
        self.skeleton, self.fps, self.window, self.period, self.units, self.threshold, *_ = given
        self.wait, self.method, self.image_size = given.wait, given.method, given.image_size
        self._pose: BodyFilter | ChainFilter
        self._body, early = outward(self.skeleton), EARLY
        if has_trunk(self.skeleton):
            self._pose, self._delay = BodyFilter(self._body, self.fps), DELAY
        else:
            self._pose, early, self._delay = ChainFilter(self._body, self.fps), EARLY[-1:], 1.0
        self._early = [min(max(LEAST, round(share * self.window)), self.window) for share in early]
        self._chain = Chain(self._body, self._pose.body, self.fps)
        self._thread = ThreadPoolExecutor(1, "kcs_torch.live")
        self._closed = self._told_up = self._told_failed = False
        self._frame = -1
        self.reset()

    def __setattr__(self, name: str, value: object) -> None:
        if name in Options._fields and name in vars(self):
            raise AttributeError(f"Tracker: {name} cannot change: make a new one, Tracker(..., {name}={value!r})")
        super().__setattr__(name, value)

    def __reduce__(self) -> NoReturn:
        raise TypeError("Tracker: cannot be copied or pickled, as it holds a thread; its tracks() and result() can be")

    def reset(self) -> None:
        """Forget the body, its bone lengths and the window; frames are counted on."""
        self._pose.reset()
        self._follower = Follower(self._body, self._pose, self.fps)
        self._next: _Next | None = None  # who follows the body from the newest frame on
        self._image: deque[Tensor] = deque(maxlen=self.window)  # complete, (N, 2)
        self._weights: deque[Tensor] = deque(maxlen=self.window)
        self._depths: deque[Tensor] = deque(maxlen=self.window)  # of the joints (N,), in the template's units
        self._stray = torch.zeros(self.skeleton.num_joints, dtype=torch.float64)  # of depths from what solves found
        self._sight = Sight(self._body, self.fps)
        self._solving: Future[Solved | None] | None = None
        self._asked = self._ready = -1  # frames at which the running solve began, and at which it is taken over
        self._solved = -1  # frame at which the last solve began
        self._known = self._frame  # frame from which on bone lengths are known
        self._told = 0  # frames that the proportions come from
        self._alone: float = math.inf  # frame from which on the window holds nobody who may have gone
        self._renews = False  # whether the running solve tells the body without what was known before
        self._begun = self._frame + 1  # frame from which the filter follows the body without a break
        self._due = deque(self._begun + frames - 1 for frames in self._early)

    def update(self, xy: Any, confidence: Any = None) -> LivePose:
        """Take the next frame and return its pose.

        Args:
            xy: (num_observed, 2) array or tensor; NaN where unseen. Without confidences, joints exactly at (0, 0)
                or (-1, -1) are unseen, too, if nine of ten others lie right of (0, 0) and below it. A frame of NaN, or
                whose joints all lie at one point, is one without the person; after a whole window of them the tracker
                starts anew. A joint that jumps too far for a body, from one frame to the next, counts as unseen there;
                if more than a third of them do, all count as unseen, for a tenth of a second at most.
            confidence: (num_observed,) in 0..1; 1 where None.

        Raises:
            ShapeError: the shape is wrong or a value infinite or out of range; the frame is then not taken.
            OptionError: the tracker is closed.

        Warns:
            KcsWarning: once, when a window shows the feet above the rest of the body, as where y points up.
            KcsWarning: once, when solving a window fails; poses go on as if it had told nothing.
        """
        if self._closed:
            raise OptionError("Tracker: closed: it takes no frames any more; make another one")
        points, weights, like = take_frame(
            self.skeleton, self._frame + 1, xy, confidence, self.threshold, self.image_size
        )
        self._frame += 1
        last = self._image[-1] if self._image else None
        if last is not None:
            shape = self._follower.body()
            unit = 1 / shape.factor
            points, weights = self._sight.trusted(points, weights, last, shape.lengths * unit, unit)
        seen = weights > 0
        if not self._image and not bool(seen.any()):
            self._due = deque(frame + 1 for frame in self._due)
            blank, unsure = (points.new_full((len(points), 3), x).to(like) for x in (torch.nan, torch.inf))
            return LivePose(self._frame, blank, unsure[:, 0], seen.to(blank.device), False, -1)
        away = float(self._sight.age.amin()) > LOST * self.fps and bool(seen.any())
        image = self._sight.complete(points, seen, last)
        if away:
            self._follower.begin_again(image, weights)
            self._begun = self._frame
            self._alone = self._frame + self.window - 1
        self._image.append(image)
        self._weights.append(weights)
        dz, shape = self._follower.take(image, weights)
        points = self._chain.place(image, weights, dz, shape)
        off = (points[:, :2] - image).norm(dim=-1)
        unsure = self._chain.deviation(dz, shape, self._follower.pose.doubt, self._sight.age, self._stray, off)
        self._depths.append(shape.factor * points[:, 2])
        ready = self._follower.shape is not None
        delay = self._frame - self._solved if ready else -1
        out = LivePose(self._frame, points.to(like), unsure.to(like), seen.to(like.device), ready, delay)
        if float(self._sight.age.amin()) >= self.window:
            self.reset()
        else:
            self._advance()
        return out

    def close(self) -> None:
        """End the thread that solves windows, after the solve under way. What the window holds stays: see result().

        Closing twice does no harm; so does not closing, but a thread then ends only with the tracker.
        """
        self._closed, self._solving = True, None
        self._thread.shutdown(wait=True, cancel_futures=True)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def tracks(self) -> Tracks:
        """The window's frames, with their gaps.

        Raises:
            ShapeError: no joint has been seen.
        """
        if not self._image:
            raise ShapeError("Tracker: no joint has been seen yet: there is nothing to reconstruct")
        weights = torch.stack(list(self._weights))
        points = torch.where(weights[..., None] > 0, torch.stack(list(self._image)), 0.0)
        source = f"live from frame {self._frame + 1 - len(self._image)}"
        notes: list[str] = []
        size = None if self.image_size is None else fitting_size(points[weights > 0], self.image_size, notes)
        return Tracks(points, weights, self.skeleton, self.fps, self.units, source, tuple(notes), image_size=size)

    def result(self) -> Reconstruction:
        """Reconstruct the frames in the window anew by the method, at leisure: more accurate than the live poses.

        Rays are taken to be parallel, unless ``image_size`` is known and a lens explains the tracks better.

        Raises:
            ShapeError: no joint has been seen.
        """
        tracks = self.tracks()
        near = tracks.image_size is not None and may_be_near(tracks)
        return reconstruct_uncalibrated(self.method, tracks) if near else self.method(tracks)

    # ------------------------------------------------------------------ the window

    def _advance(self) -> None:
        """Begin to solve the window where that is due; take over what was found."""
        if self._solving is not None and self._frame >= self._ready and (self.wait or self._solving.done()):
            solving, self._solving = self._solving, None  # whatever it has come to
            found = self._outcome(solving)
            if found is not None:
                self._learn_from(found)
        if self._next is not None:
            self._catch_up(self._next)
        if self._solving is None and self._next is None and min(self._due[0], self._alone) <= self._frame:
            if self._due[0] <= self._frame:
                self._due.popleft()
            if not self._due:
                self._due.append(self._frame + self.period)
            self._renews = self._alone <= self._frame
            self._alone = math.inf if self._renews else self._alone
            image, weights = torch.stack(list(self._image)), torch.stack(list(self._weights))
            self._tell_up(how_it_stands(image, weights > 0, self.skeleton))
            self._solving = self._thread.submit(solve_window, self.method, self._body, image, weights, self.fps)
            self._asked = self._frame
            self._ready = self._frame + max(1, round(self._delay * len(image)))

    def _outcome(self, solving: Future[Solved | None]) -> Solved | None:
        """What a solve found; None where it failed, which is told once."""
        try:
            return solving.result()
        except Exception as error:
            if not self._told_failed:
                self._told_failed = True
                text = f"Tracker: a window could not be solved, and is left out ({type(error).__name__}: {error})"
                warnings.warn(text, KcsWarning, stacklevel=users_level())
            return None

    def _tell_up(self, stands: str) -> None:
        """Warn, once, where a window shows that y may point up."""
        if stands.startswith(ABOVE) and not self._told_up:
            self._told_up = True
            warnings.warn(f"Tracker: {stands}", KcsWarning, stacklevel=users_level())

    def _learn_from(self, found: Solved) -> None:
        """Have one who knows the body that was found take the window's last frames again."""
        count = len(found.told.depths)
        if self._renews:  # deviations from another's bones teach nothing
            self._told, self._known = 0, self._frame
        self._told = min(self._told + count, REMEMBERED * self.window)
        share, before = count / self._told, self._follower.shape
        self._learn(found.told, share)
        follower = self._follower.taught(found.shape if before is None else found.shape.blended(before, share))
        self._next = _Next(follower, found.told, max(0, self._asked + 1 - REPLAYED))

    def _catch_up(self, later: _Next) -> None:
        """Go on with the frames that are taken again, all of them or a few; after the newest the other takes over."""
        first = self._frame + 1 - len(self._image)
        begin = max(first, later.frame, self._begun)
        end = self._frame + 1 if self.wait else min(self._frame + 1, begin + AT_ONCE)
        for frame in range(begin, end):
            image, weights = self._image[frame - first], self._weights[frame - first]
            if frame == self._begun > self._asked:
                later.follower.begin_again(image, weights)
            told = later.told[frame - self._asked - 1] if frame <= self._asked else None
            later.follower.take(image, weights, told)
        self._next = later._replace(frame=end)
        if end > self._frame:
            self._known = self._frame if self._renews or self._follower.shape is None else self._known
            self._follower, self._next, self._solved = later.follower, None, self._asked

    def _learn(self, told: Told, share: float) -> None:
        """Learn from frames with bone lengths how far depths are from what a solve, counting ``share``, finds later."""
        depths = list(self._depths)[: max(0, len(self._depths) - (self._frame - self._asked))]
        depths = depths[max(0, len(depths) - (self._asked - self._known)) :]
        if self._follower.shape is None or len(depths) < LEAST:
            return
        solved = told.depths[len(told.depths) - len(depths) :] @ self._chain.tree.mT
        off = (torch.stack(depths) - solved + solved.mean(-1, keepdim=True)).square().mean(0)
        before = self._stray.square()
        self._stray = torch.lerp(before, off, share if bool(before.any()) else 1.0).sqrt()
