"""What every method shares: the call, the checks, the diagnostics."""

from __future__ import annotations

import contextlib
import dataclasses
import math
import numbers
import sys
import time
import types
import typing
import warnings
from abc import ABC, abstractmethod
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any, ClassVar

import torch
from torch import Tensor

from kcs_torch.errors import ConvergenceWarning, KcsWarning, OptionError, ShapeError, unknown
from kcs_torch.functional.align import centre
from kcs_torch.functional.camera import viewpoint_turn
from kcs_torch.functional.chain import bone_lengths
from kcs_torch.functional.temporal import interpolate
from kcs_torch.methods.root import root_depth
from kcs_torch.types import Diagnostics, Reconstruction, Tracks, as_floats

__all__ = ["Estimate", "Method"]

WEAK_TURN = 30.0
"""Degrees of viewpoint turn below which depth is weakly determined."""

LOOSE = 5.0
"""Per cent of bone variation from which on the tracks are hardly those of a body of this skeleton."""

FAR_STEPS = 2
"""How often joints are weighed anew by their distance, when the body is put in its place."""

_WHY_LOOSE = (
    "joints may be wrong, swapped or in another order, the skeleton may be another, parts of the body may bend, or the "
    "camera may be so near that its intrinsics matter"
)


@dataclass(frozen=True)
class Estimate:
    """What a method finds, in normalised units: centred per frame, root mean square of the tracks 1.

    Attributes:
        points: (T, N, 3) in the camera frame.
        cameras: (T, 2, 3) orthonormal rows.
        scales: (T,) relative weak-perspective scale, mean 1.
        converged: whether the stopping rule was met.
        iterations: steps made.
        notes: sentences for the user.
        deviation: (T, N) standard deviation of depth, or None.
        objective: value that ranks the solutions of one method on one clip, lower is better; NaN where it has none.
        alternatives: further solutions, best first.
        still: whether the camera may be taken to stand still, so that feet tell the root's depth.
        doubt: why depth is little more than a guess, a sentence; empty where it is more. The user is warned.
    """

    points: Tensor
    cameras: Tensor
    scales: Tensor
    converged: bool
    iterations: int
    notes: tuple[str, ...] = ()
    deviation: Tensor | None = None
    objective: float = math.nan
    alternatives: tuple[Estimate, ...] = ()
    still: bool = False
    doubt: str = ""


@dataclass(frozen=True)
class Method(ABC):
    """A recipe from 2D tracks to 3D motion; its fields are its hyper-parameters.

    Subclasses write :meth:`solve`; calling a method adds units, bone lengths and diagnostics.
    """

    name: ClassVar[str] = ""
    centred: ClassVar[bool] = True
    """Whether :meth:`solve` takes tracks about the body's middle in each frame; else about its mean over time."""
    keeps_lengths: ClassVar[bool] = True
    """Whether bones keep their length as far as the tracks admit; else lengths that vary say nothing of the tracks."""
    learned: ClassVar[bool] = False
    """Whether depth comes from examples: then it does not rest on the viewpoint's turn."""
    reckons_in_seconds: ClassVar[bool] = False
    """Whether the frame rate matters; 30 frames a second are assumed where it is unknown."""

    def __post_init__(self) -> None:
        hints = typing.get_type_hints(type(self))
        for field in dataclasses.fields(self):
            self._expect(_is_a(getattr(self, field.name), hints[field.name]), field.name, str(field.type))

    @abstractmethod
    def solve(self, tracks: Tracks, cameras: Tensor | None) -> Estimate:
        """Reconstruct normalised tracks; ``cameras`` (T, 2, 3) are given or to be found."""

    def __call__(self, tracks: Tracks, cameras: Tensor | None = None) -> Reconstruction:
        """Reconstruct one body.

        Args:
            tracks: what to reconstruct.
            cameras: (T, 2, 3) known camera rows, world to camera; found from the tracks if None.

        Returns:
            The reconstruction, on the device and in the dtype of the tracks.

        Raises:
            ShapeError: the cameras do not fit the tracks.

        Warns:
            KcsWarning: depth is weakly determined, or joints were never seen.
            ConvergenceWarning: the iteration stopped at its limit.
        """
        begin = time.perf_counter()
        if cameras is not None:
            cameras = check_cameras(as_floats(cameras, "cameras", 3).to(tracks.points), tracks.num_frames)
        # Solvers differentiate, which inference mode forbids.
        with torch.inference_mode(False), torch.no_grad(), _home([tracks]):
            inner, size, known = self._normalised(tracks)
            found = self.solve(inner, None if cameras is None else cameras.clone())
            result = self._finish(tracks, found, size, known, time.perf_counter() - begin)
        self._warn(result, found.doubt)
        return result

    def many(self, tracks: Sequence[Tracks], *, workers: int = 1) -> list[Reconstruction]:
        """Reconstruct several clips, of one length or many: together where the method can, else one by one.

        Args:
            tracks: of any number of bodies.
            workers: threads that share the clips, each with a batch of its own; more than one go best with one thread
                of PyTorch's own (``torch.set_num_threads(1)``).

        Returns:
            What a call for each gives, up to rounding (which may choose the other of two solutions that are as good);
            ``diagnostics.seconds`` is each one's share.

        Warns:
            KcsWarning: as a call does.
            ConvergenceWarning: as a call does.

        Raises:
            OptionError: ``workers`` is no positive number.
        """
        if isinstance(workers, bool) or not isinstance(workers, int) or workers < 1:
            raise OptionError(f"{self.name}: workers: expected a number of threads, 1 or more, got {workers!r}")
        # Dealt out by length, so that all have as much to do, and batches of nearly one length.
        order = sorted(range(len(tracks)), key=lambda i: tracks[i].num_frames)
        shares = [order[k::workers] for k in range(min(workers, len(order)))]
        found: dict[int, tuple[Reconstruction, str]] = {}
        with ThreadPoolExecutor(workers) as pool:
            run = pool.map if len(shares) > 1 else map
            batches = run(self._batch, [[tracks[i] for i in share] for share in shares])
            for share, results in zip(shares, batches, strict=True):
                found |= zip(share, results, strict=True)
        for i in range(len(tracks)):
            self._warn(*found[i])
        return [found[i][0] for i in range(len(tracks))]

    def _batch(self, tracks: Sequence[Tracks]) -> list[tuple[Reconstruction, str]]:
        """What is found of several clips, and what is doubtful about it; modes of PyTorch are each thread's own."""
        begin = time.perf_counter()
        with torch.inference_mode(False), torch.no_grad(), _home(tracks):
            parts = [self._normalised(one) for one in tracks]
            found = self.solve_all([inner for inner, _, _ in parts])
            each = (time.perf_counter() - begin) / len(tracks)
            rows = zip(tracks, found, parts, strict=True)
            return [(self._finish(one, x, size, known, each), x.doubt) for one, x, (_, size, known) in rows]

    def solve_all(self, tracks: Sequence[Tracks]) -> list[Estimate]:
        """Reconstruct normalised tracks of several clips; one by one unless a method knows better."""
        return [self.solve(one, None) for one in tracks]

    def _normalised(self, tracks: Tracks) -> tuple[Tracks, Tensor, Tensor]:
        """Tracks about their middle, of root mean square 1; that size; and the frames (T,) that show something."""
        # Means over the joints that happen to be seen would jump with every joint that comes and goes.
        filled = interpolate(tracks.points, tracks.seen)[:, tracks.seen.any(0)]
        middle = filled.mean(1, keepdim=True) if filled.numel() else tracks.points[:, :1] * 0
        size = _rms((tracks.points - middle) * tracks.seen[..., None], tracks.weights)
        size = torch.where(size > 0, size, torch.ones_like(size))
        if not self.centred:
            middle = middle.mean(0)
        centred = (tracks.points - middle) * tracks.seen[..., None]
        inner = dataclasses.replace(tracks, points=centred / size, weights=tracks.weights.clone())
        return inner, size, tracks.seen.any(-1)

    def _warn(self, result: Reconstruction, doubt: str) -> None:
        """Tell what the user should not miss."""
        tracks, found = result.tracks, result.diagnostics
        if doubt:
            warnings.warn(f"{tracks.source}: {doubt}", KcsWarning, stacklevel=users_level())
        if not found.converged:
            message = f"{tracks.source}: {self._unsettled(found.iterations)}"
            warnings.warn(message, ConvergenceWarning, stacklevel=users_level())
        never = [tracks.skeleton.joints[n] for n in (tracks.weights == 0).all(0).nonzero().flatten().tolist()]
        if never:
            warnings.warn(
                f"{tracks.source}: never seen, so placed by the skeleton alone: {', '.join(never)}",
                KcsWarning,
                stacklevel=users_level(),
            )

        if found.bone_variation > LOOSE and self.keeps_lengths and found.converged:
            message = f"{tracks.source}: bone lengths vary by {found.bone_variation:.1f} %: {_WHY_LOOSE}"
            warnings.warn(message, KcsWarning, stacklevel=users_level())

    def _unsettled(self, steps: int) -> str:
        return f"{self.name} did not settle within {steps} steps"

    def _finish(self, tracks: Tracks, found: Estimate, size: Tensor, known: Tensor, seconds: float) -> Reconstruction:
        """An estimate in the tracks' units and place, with what there is to say about it."""
        points = found.points * size
        seen = points[..., :2] * found.scales[:, None, None]
        shift = interpolate(_shift(tracks.points - seen, tracks.weights), known[:, None])
        points, seen = points + torch.nn.functional.pad(shift, (0, 1)), seen + shift
        body = tracks.skeleton
        bones = bone_lengths(points, body.bone_index(device=points.device))
        rigid = list(body.rigid)
        mean = bones.mean(0)
        one = torch.ones_like(bones)
        ratio = torch.where(mean > 0, bones / torch.where(mean > 0, mean, one), one)
        variation = (ratio - 1).square().mean(0).sqrt()
        turn = float(viewpoint_turn(found.cameras))
        notes = list(found.notes)
        if turn < WEAK_TURN and not self.learned:
            rest = "the skeleton's template and lengths" if body.template is not None else "constant lengths alone"
            notes.append(f"the viewpoint turned by {turn:.0f} degrees only: depth rests on {rest}")
        if found.doubt:
            notes.append(found.doubt)
        if not found.converged:
            notes.append(self._unsettled(found.iterations))
        percent = float(100 * variation[rigid].median()) if rigid else math.nan
        if percent > LOOSE and self.keeps_lengths:
            notes.append(f"bone lengths vary by more than {LOOSE:g} %: {_WHY_LOOSE}")
        if not rigid:
            kind = "no bones" if not body.num_bones else "no rigid bones"
            notes.append(
                f"the skeleton has {kind}: no lengths hold the joints together, and their variation is unknown"
            )
        if tracks.fps is None and self.reckons_in_seconds:
            notes.append("30 frames a second assumed: set the tracks' fps if it is another rate")
        pointlike = not bool(_extent(tracks) > 0)
        if pointlike:
            notes.append("all joints lie at one point in every frame: there is no pose to find")
        root = None
        if found.still and not pointlike:
            root, remark = root_depth(points, tracks)
            notes.append(remark)
        diagnostics = Diagnostics(
            viewpoint_turn=turn,
            unseen_share=tracks.unseen_share,
            bone_variation=percent,
            reprojection_rms=float(_rms(seen - tracks.points, tracks.seen.to(points.dtype))),
            converged=found.converged,
            iterations=found.iterations,
            seconds=seconds,
            notes=tuple(notes),
        )
        return Reconstruction(
            points,
            found.cameras,
            found.scales,
            bones.median(0).values,
            tracks,
            self.name,
            diagnostics,
            uncertainty=None if found.deviation is None else found.deviation * size,
            objective=found.objective,
            root_depth=root,
            alternatives=tuple(self._finish(tracks, other, size, known, seconds) for other in found.alternatives),
        )

    @classmethod
    def from_options(cls, **options: object) -> Method:
        """Build the method from field values; wrong names are answered with the right ones.

        Raises:
            OptionError: a field is unknown.
        """
        names = [f.name for f in dataclasses.fields(cls)]
        for option in options:
            if option not in names:
                raise unknown(f"option of method '{cls.name}'", option, names)
        return cls(**options)

    def _expect(self, rule: bool, field: str, expected: str) -> None:
        """Raise an OptionError for ``field`` unless the rule holds."""
        if not rule:
            raise OptionError(f"{self.name}: {field}: expected {expected}, got {getattr(self, field)!r}")


def _home(tracks: Sequence[Tracks]) -> contextlib.AbstractContextManager[object]:
    """Make on the tracks' device what is made anew; a context costs each operation, so there is none without need."""
    devices = {one.points.device for one in tracks}
    if len(devices) != 1 or devices == {torch.get_default_device()}:
        return contextlib.nullcontext()
    return devices.pop()


def users_level() -> int:
    """The stack level at which a warning names the user's own line, however deep in this package it is given."""
    level, frame = 1, sys._getframe(1)
    while frame.f_back is not None and frame.f_globals.get("__name__", "").partition(".")[0] == "kcs_torch":
        level, frame = level + 1, frame.f_back
    return level


def check_cameras(cameras: Tensor, frames: int) -> Tensor:
    """The cameras themselves, if they are (T, 2, 3) with orthonormal rows."""
    if cameras.shape != (frames, 2, 3) or not torch.isfinite(cameras).all():
        raise ShapeError(f"cameras: expected finite ({frames}, 2, 3), got {tuple(cameras.shape)}")
    off = (cameras @ cameras.mT - torch.eye(2).to(cameras)).abs().amax((-2, -1))
    if bool((off > 0.01).any()):
        raise ShapeError(
            f"cameras: expected the first two rows of rotations, got rows that are not orthonormal in frame "
            f"{int(off.argmax())}; a scale belongs to the tracks"
        )
    return cameras


def _is_a(value: Any, hint: Any) -> bool:
    """Whether a value is what a field's annotation says; whole numbers pass for numbers, NaN does not."""
    origin, inner = typing.get_origin(hint), typing.get_args(hint)
    if origin in (typing.Union, types.UnionType):
        return any(_is_a(value, h) for h in inner)
    if origin is typing.Literal:
        return isinstance(value, str) and value in inner
    if origin in (Sequence, tuple):  # or a tensor or array that stands for one
        listed = value.tolist() if hasattr(value, "tolist") else value
        if not isinstance(listed, Sequence) or isinstance(listed, str):
            return False
        fixed = origin is tuple and Ellipsis not in inner
        if fixed and len(listed) != len(inner):
            return False
        return all(_is_a(v, h) for v, h in zip(listed, inner if fixed else [inner[0]] * len(listed), strict=True))
    if hint in (int, float):
        if isinstance(value, bool) or not isinstance(value, numbers.Integral if hint is int else numbers.Real):
            return False
        return not math.isnan(value)
    return isinstance(value, hint) if isinstance(hint, type) else True


def _shift(residuals: Tensor, weights: Tensor) -> Tensor:
    """Weighted mean over joints, (T, 1, D), joints that are far from it counting less; 0 where no joint is seen."""
    middle = centre(residuals, weights)[1]
    for _ in range(FAR_STEPS):
        off = (residuals - middle).abs()
        far = (off / off.amax().clamp_min(torch.finfo(off.dtype).tiny)).norm(dim=-1)  # no square overflows
        usual = far[weights > 0].median() if bool((weights > 0).any()) else far.sum()
        if not bool(usual > 0):
            break
        middle = centre(residuals, weights / (1 + (far / (3 * usual)).square()))[1]
    return middle


def _extent(tracks: Tracks) -> Tensor:
    """How far seen joints lie apart, at most, in a frame; 0 where it is rounding."""
    seen = tracks.seen[..., None]
    far = torch.full_like(tracks.points, math.inf)
    low = torch.where(seen, tracks.points, far).amin(1)
    apart = torch.where(seen, tracks.points, -far).amax(1) - low
    apart = torch.where(apart > 8 * torch.finfo(apart.dtype).eps * low.abs(), apart, torch.zeros_like(apart))
    return apart.amax() if apart.numel() else apart.sum()


def _rms(vectors: Tensor, weights: Tensor) -> Tensor:
    """Weighted root mean square length of (..., D) vectors, scaled first, so that no square overflows."""
    vectors = torch.where(weights[..., None] > 0, vectors, torch.zeros_like(vectors))
    top = vectors.abs().amax()
    top = torch.where(top > 0, top, torch.ones_like(top))
    square = (vectors / top).square().sum(-1) * weights
    return top * (square.sum() / weights.sum()).sqrt()
