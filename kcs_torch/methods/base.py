"""What every method shares: the call, the checks, the diagnostics."""

from __future__ import annotations

import contextlib
import dataclasses
import time
import typing
import warnings
from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import torch
from torch import Tensor

from kcs_torch.errors import (
    ConvergenceWarning,
    KcsError,
    KcsWarning,
    NotFiniteError,
    OptionError,
    ShapeError,
    counted,
    unknown,
    users_level,
)
from kcs_torch.functional.guarded import or_one
from kcs_torch.functional.inference import plain
from kcs_torch.functional.temporal import interpolate
from kcs_torch.functional.weights import rms
from kcs_torch.methods.answer.finish import BY_SHOTS, NO_POSE, Estimate, finish
from kcs_torch.methods.answer.wrong import WHY_LOOSE
from kcs_torch.methods.clips.batches import FRAMES, batches
from kcs_torch.skeleton import Skeleton
from kcs_torch.types import Reconstruction, Tracks, as_floats
from kcs_torch.types.hints import is_a, spoken
from kcs_torch.types.tracks import never_seen
from kcs_torch.types.upright import ABOVE

__all__ = ["Estimate", "Method", "apart"]


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
    knows_bones: ClassVar[bool] = True
    """Whether the result depends on the skeleton's bones; then a user who gives none should know."""
    learned: ClassVar[bool] = False
    """Whether depth comes from examples; then it does not rest on the viewpoint's turn."""
    turns_over: ClassVar[bool] = False
    """Whether it looks for runs of depths with the wrong sign, so that they are looked for under perspective, too."""
    reckons_in_seconds: ClassVar[bool] = False
    """Whether the frame rate matters; 30 frames a second are assumed where it is unknown."""
    differentiates: ClassVar[bool] = True
    """Whether :meth:`solve` uses autograd; else it runs in inference mode, where every operation costs less."""

    def __post_init__(self) -> None:
        hints = typing.get_type_hints(type(self))
        for field in dataclasses.fields(self):
            hint = hints[field.name]
            self._expect(is_a(getattr(self, field.name), hint), field.name, spoken(hint))

    @abstractmethod
    def solve(self, tracks: Tracks, cameras: Tensor | None) -> Estimate:
        """Reconstruct normalised tracks; ``cameras`` (T, 2, 3) are given or to be found."""

    def knows_template(self, skeleton: Skeleton) -> bool:
        """Whether a template tells depth that the viewpoint's turn does not."""
        return False

    def prepared(self, tracks: Tracks) -> Tracks:
        """The tracks that are solved, and that the result names as its own: those given, or mended ones."""
        return tracks

    def without_ends(self, tracks: Tracks) -> Tracks:
        """The tracks of those joints that are solved, where others, that no frame shows, are placed afterwards."""
        return tracks

    def with_ends(self, result: Reconstruction, tracks: Tracks) -> Reconstruction:
        """What was found :meth:`without_ends` with all joints of the tracks."""
        return result

    def following(self, searched: bool = True) -> Method:
        """The method for tracks of a camera that turns after the body, by which nothing stands still in the image.

        Args:
            searched: whether runs of signs in what it finds are turned over afterwards, under perspective.
        """
        return self

    def __call__(self, tracks: Tracks, cameras: Tensor | None = None) -> Reconstruction:
        """Reconstruct one body.

        Args:
            tracks: what to reconstruct.
            cameras: (T, 2, 3) known camera rows, world to camera; found from the tracks if None.

        Returns:
            The reconstruction, on the device and in the dtype of the tracks.

        Raises:
            OptionError: something else than tracks is given.
            ShapeError: the cameras do not fit the tracks; these have no frames, or half precision.

        Warns:
            KcsWarning: depth is weakly determined, joints were never seen, or all of them lie at one point.
            ConvergenceWarning: the iteration stopped at its limit.
        """
        begin = time.perf_counter()
        check_tracks(tracks, self.name)
        if cameras is not None:
            cameras = check_cameras(as_floats(cameras, "cameras", 3).to(tracks.points), tracks.num_frames)
        with apart([tracks], self.differentiates):
            tracks = self._mended(tracks)
        return self.of_prepared(tracks, cameras, begin)

    def of_prepared(self, tracks: Tracks, cameras: Tensor | None, begin: float) -> Reconstruction:
        """Reconstruct tracks that are :meth:`prepared`, as a call does that began at ``begin`` (``perf_counter``)."""
        with apart([tracks], self.differentiates):
            inner, size = self._normalised(tracks)
            found = self.solve(inner, None if cameras is None else cameras.clone())
        return self._finished([tracks], [found], [size], time.perf_counter() - begin)[0]

    def many(self, tracks: Sequence[Tracks]) -> list[Reconstruction]:
        """Reconstruct several clips, of one length or many: together where the method can, else one by one.

        Args:
            tracks: of any number of bodies.

        Returns:
            What a call for each gives, up to rounding (which may choose the other of two solutions that are as good);
            ``diagnostics.seconds`` is each one's share.

        Warns:
            KcsWarning: as a call does.
            ConvergenceWarning: as a call does.
        """
        begin = time.perf_counter()
        for i, one in enumerate(tracks):
            check_tracks(one, f"{self.name}: item {i}")
        with apart(tracks, self.differentiates):
            tracks = [self._mended(one) for one in tracks]
            parts = [self._normalised(one) for one in tracks]
            found = self.solve_all([inner for inner, _ in parts])
        if len(found) != len(tracks):
            raise ShapeError(f"{self.name}: solve_all: expected {counted(len(tracks), 'estimate')}, got {len(found)}")
        each = (time.perf_counter() - begin) / max(len(tracks), 1)
        return self._finished(tracks, found, [size for _, size in parts], each)

    def solve_all(self, tracks: Sequence[Tracks]) -> list[Estimate]:
        """Reconstruct normalised tracks of several clips; one by one unless a method knows better."""
        return [self.solve(one, None) for one in tracks]

    def _finished(
        self, tracks: Sequence[Tracks], found: Sequence[Estimate], sizes: Sequence[Tensor], seconds: float
    ) -> list[Reconstruction]:
        """What :func:`finish` makes of estimates, on the processor: its many small steps would hold up a GPU."""
        results: dict[int, Reconstruction] = {}
        for batch in batches(tracks, most=FRAMES):
            some = [tracks[i] for i in batch]
            sound = checked_estimates([found[i] for i in batch], some, self.name or type(self).__name__)
            with apart(some, self.differentiates, "cpu"):
                told = finish(self, some, sound, [sizes[i] for i in batch], seconds)
            results |= zip(batch, (plain(one, keep=one.tracks) for one in told), strict=True)
        for i in range(len(tracks)):
            self.warn(results[i])
        return [results[i] for i in range(len(tracks))]

    def _mended(self, tracks: Tracks) -> Tracks:
        """:meth:`prepared`, plain if they are other tracks than those given."""
        return plain(self.prepared(tracks), keep=tracks)

    def _normalised(self, tracks: Tracks) -> tuple[Tracks, Tensor]:
        """Tracks about their middle, of root mean square 1; and that size."""
        # Means over the joints that happen to be seen would jump with every joint that comes and goes.
        seen, filled = tracks.seen, tracks.points
        if not bool(seen.all()):
            filled = interpolate(filled, seen)[:, seen.any(0)]
        middle = filled.mean(1, keepdim=True) if filled.numel() else tracks.points[:, :1] * 0
        size = rms((tracks.points - middle) * tracks.seen[..., None], tracks.weights)
        size = or_one(size)
        if not self.centred:
            middle = middle.mean(0)
        centred = (tracks.points - middle) * tracks.seen[..., None]
        inner = dataclasses.replace(tracks, points=centred / size, weights=tracks.weights.clone())
        return inner, size

    def warn(self, result: Reconstruction) -> None:
        """Tell what the user should not miss; for those who call :meth:`solve` and more by themselves."""
        tracks, found = result.tracks, result.diagnostics
        if found.doubt:
            warnings.warn(f"{tracks.source}: {found.doubt}", KcsWarning, stacklevel=users_level())
        if not found.converged:
            message = f"{tracks.source}: {self.unsettled(found.iterations)}"
            warnings.warn(message, ConvergenceWarning, stacklevel=users_level())
        for gone in never_seen(tracks.weights, tracks.skeleton):
            warnings.warn(f"{tracks.source}: {gone}", KcsWarning, stacklevel=users_level())
        for note in found.notes:
            if note.startswith(ABOVE) or note.endswith((WHY_LOOSE, BY_SHOTS, NO_POSE)):
                warnings.warn(f"{tracks.source}: {note}", KcsWarning, stacklevel=users_level())

    def unsettled(self, steps: int) -> str:
        """A sentence for those whose iteration stopped at its limit."""
        return f"{self.name} did not settle within {steps} steps"

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


@contextlib.contextmanager
def apart(tracks: Sequence[Tracks], differentiates: bool = True, device: str | None = None) -> Iterator[None]:
    """Leave the caller's autograd, inference mode and autocast alone; make on a device, or the tracks', what is new.

    What is not differentiated in between runs in inference mode, see :func:`kcs_torch.functional.inference.plain`.
    """
    devices = {one.points.device for one in tracks} if device is None else {torch.device(device)}
    with torch.inference_mode(not differentiates), torch.no_grad(), contextlib.ExitStack() as precision:
        for kind in {device.type for device in devices}:
            precision.enter_context(torch.autocast(kind, enabled=False))
        if len(devices) != 1 or devices == {torch.get_default_device()}:
            yield  # a device's context costs each operation, so there is none without need
        else:
            with devices.pop():
                yield


def check_tracks(tracks: Any, what: str) -> None:
    """Raise unless these are tracks of at least one frame, in a precision that has factorisations."""
    if not isinstance(tracks, Tracks):
        raise OptionError(f"{what}: expected Tracks (see Tracks.from_arrays), got {type(tracks)}")
    if not tracks.num_frames:
        raise ShapeError(f"{what}: expected at least 1 frame, got none in {tracks.source}")
    if tracks.points.dtype not in (torch.float32, torch.float64):
        kind = str(tracks.points.dtype).removeprefix("torch.")
        raise ShapeError(
            f"{what}: expected tracks in single or double precision, got {kind} in {tracks.source}: use "
            "tracks.to(torch.float32)"
        )


def checked_estimates(found: Sequence[Any], tracks: Sequence[Tracks], name: str) -> list[Estimate]:
    """What a method found, which may be the user's own, as the tracks are: on their device and in their dtype.

    The numbers of all are looked at together; only where some are wrong one by one, as frames are counted by clip.

    Raises:
        OptionError: one is no :class:`Estimate`.
        ShapeError: a part of it has another shape, or values that it cannot have.
        NotFiniteError: a part of it holds NaN or infinity.
    """
    every = [_with_parts(one, clip, name) for one, clip in zip(found, tracks, strict=True)]
    with contextlib.suppress(KcsError):
        _check_numbers(every, name)
        return every
    for one in every:
        _check_numbers([one], name)
    return every


def _with_parts(found: Any, tracks: Tracks, name: str) -> Estimate:
    """The estimate in the tracks' dtype and on their device, if its parts have the right shapes."""
    if not isinstance(found, Estimate):
        raise OptionError(f"{name}: solve: expected an Estimate, got {type(found).__name__}")
    frames, joints = tracks.num_frames, tracks.num_joints
    shapes = {"points": (frames, joints, 3), "cameras": (frames, 2, 3), "scales": (frames,)}
    if found.deviation is not None:
        shapes["deviation"] = (frames, joints)
    for part, shape in shapes.items():
        value = getattr(found, part)
        if not isinstance(value, Tensor) or value.shape != shape:
            got = tuple(value.shape) if isinstance(value, Tensor) else type(value).__name__
            raise ShapeError(f"{name}: solve: {part}: expected a tensor {shape}, got {got}")
    return found.to(tracks.points)


def _check_numbers(found: Sequence[Estimate], name: str) -> None:
    """Raise unless all numbers of estimates of one skeleton can be what they are; frames are counted through."""
    for part in ("points", "cameras", "scales", "deviation"):
        values = [value for one in found if (value := getattr(one, part)) is not None]
        if values and not bool((finite := torch.cat(values).isfinite()).all()):
            frame = int((~finite).nonzero()[0, 0])
            raise NotFiniteError(
                f"{name}: solve: {part}: expected finite numbers, got NaN or infinity in frame {frame}"
            )
    cameras, scales = (torch.cat([getattr(one, part) for one in found]) for part in ("cameras", "scales"))
    check_cameras(cameras, len(cameras), f"{name}: solve: cameras")
    if bool((scales < 0).any()):  # a body that is a point in a frame has none
        frame = int(scales.argmin())
        raise ShapeError(f"{name}: solve: scales: expected numbers >= 0, got {scales[frame]:g} in frame {frame}")


def check_cameras(cameras: Tensor, frames: int, what: str = "cameras") -> Tensor:
    """The cameras themselves, if they are (T, 2, 3) with orthonormal rows."""
    if cameras.shape != (frames, 2, 3):
        raise ShapeError(f"{what}: expected finite ({frames}, 2, 3), got {tuple(cameras.shape)}")
    lost = (~cameras.isfinite()).any(-1).any(-1).nonzero().flatten()
    if len(lost):
        where = f"{counted(len(lost), 'frame')}, the first of which is {int(lost[0])}"
        raise ShapeError(f"{what}: expected finite numbers, got NaN or infinity in {where}")
    off = (cameras @ cameras.mT - torch.eye(2, dtype=cameras.dtype, device=cameras.device)).abs().amax((-2, -1))
    wrong = (off > 0.01).nonzero().flatten()
    if len(wrong):
        raise ShapeError(
            f"{what}: expected the first two rows of rotations, got rows that are not orthonormal in "
            f"{counted(len(wrong), 'frame')}, the first of which is {int(wrong[0])}; a scale belongs to the tracks"
        )
    return cameras
