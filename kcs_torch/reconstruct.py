"""The entry calls: :func:`reconstruct`, and :func:`reconstruct_all` of several bodies."""

from __future__ import annotations

import warnings
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from kcs_torch.errors import KcsWarning, OptionError, ShapeError, unknown, users_level
from kcs_torch.methods import METHODS
from kcs_torch.methods.base import Method, check_tracks
from kcs_torch.methods.clips.processes import check_workers, spread, spread_batch
from kcs_torch.methods.found_skeleton import find_skeleton
from kcs_torch.methods.perspective.calibrated import WIDE, reconstruct_perspective
from kcs_torch.methods.perspective.near_or_far import may_be_near
from kcs_torch.methods.perspective.one_lens import by_one_lens
from kcs_torch.methods.perspective.uncalibrated import looking, reconstruct_uncalibrated
from kcs_torch.skeleton import Skeleton
from kcs_torch.types import Intrinsics, Reconstruction, Tracks
from kcs_torch.types.bodies import no_bones
from kcs_torch.types.image_size import may_be_shares
from kcs_torch.types.people import file_and_person, file_of, guess_images
from kcs_torch.types.tracks import unseen_notes

__all__ = ["method_named", "reconstruct", "reconstruct_all", "with_found_bones"]

DEFAULT = "pkc"
"""What "auto" stands for."""

WITHOUT = ("auto", "parallel")
"""What may be asked for in place of intrinsics."""

MAY_BE_SHARES = (
    "coordinates lie within 0 and 1 and are taken as they are: if they are shares of the image, give "
    "image_size=(width, height), or the body is as distorted as the image is not square; else say units=..."
)
"""What is told of arrays that may be shares of an image."""

SAY_SIZE = (
    "the image's size, by which all get one lens, to what reads or makes their tracks: image_size=(width, height) "
    "(kcs-torch: --image-size 1920x1080); or "
)
"""What is asked for first where nobody said it, and people of one file got lenses of their own."""

OF_TRACKS = ("joint_names", "edges", "threshold")
"""What tracks are made with, no field of any method."""


BESIDE = 1e8
"""Focal lengths off the optical axis from which on a joint's number is that of no image."""


def reconstruct(
    tracks: Any,
    *,
    method: str | Method = "auto",
    skeleton: str | Path | Skeleton | None = None,
    confidence: Any = None,
    fps: float | None = None,
    units: str | None = None,
    image_size: tuple[int, int] | None = None,
    cameras: Any = None,
    intrinsics: Any = None,
    **fields: Any,
) -> Reconstruction:
    """Turn 2D joint tracks of one body into 3D motion with bones of constant length; no training data.

    Args:
        tracks: a :class:`Tracks`, or an array (T, N, 2) with NaN where unseen.
        method: "auto" (which is "pkc"), a name in :data:`kcs_torch.METHODS`, or a :class:`Method`.
        skeleton: for arrays: a :class:`Skeleton`, a built-in name, or a YAML/JSON file. "auto", which goes with tracks
            too, finds the bones from how the joints move (:func:`kcs_torch.find_skeleton`).
        confidence: for arrays: (T, N) in 0..1.
        fps: for arrays: frames per second.
        units: for arrays; px if None.
        image_size: for arrays: width and height of the image in pixels, by which the camera's lens is known roughly.
        cameras: (T, 2, 3) camera rows, world to camera, where they are known.
        intrinsics: (fx, fy, cx, cy) or a matrix K (3, 3) in the unit of the tracks, where it is known. Perspective is
            then taken into account, and ``result.in_space()`` lies before the camera and projects onto the tracks.
            "auto" finds the focal length from the tracks of a body with a template, unless parallel rays explain them
            better, from that of usual cameras with such an image on; an image whose size nobody says is taken to be
            the smallest of usual size that holds the tracks of its file. "parallel" takes rays to be parallel. None is
            "auto" for "pkc", bodies with a template and unknown cameras, else "parallel".
        **fields: of the method, such as ``beta=2.0``.

    Returns:
        A :class:`Reconstruction`: points (T, N, 3) in the camera frame, cameras, lengths, diagnostics.

    Raises:
        OptionError: the method or a field is unknown, or its value is out of range; or array options come with Tracks,
            or some that :meth:`Tracks.from_arrays` alone takes; or a camera of these intrinsics would see nothing like
            the tracks, or they are in another unit.
        ShapeError: an array, or the intrinsics, has the wrong shape or values.
        SkeletonError: the skeleton is unknown or does not fit.

    Warns:
        KcsWarning: no bones are given, and the method knows of bones; or an array without units seems to hold shares of
            an image; or many joints lie beside the image of which the principal point is the middle; or as
            :meth:`Method.__call__`.

    >>> from kcs_torch.data.synthetic import walking_person
    >>> result = reconstruct(walking_person(60).tracks, method="sfam", beta=2.0)
    >>> result.points.shape, result.method
    (torch.Size([60, 17, 3]), 'sfam')
    """
    if misplaced := [name for name in OF_TRACKS if name in fields]:
        raise OptionError(
            f"reconstruct: {misplaced[0]} belongs to the tracks: reconstruct(Tracks.from_arrays(points, skeleton=..., "
            f"{misplaced[0]}=...))"
        )
    lens = _lens(intrinsics)
    find = isinstance(skeleton, str) and skeleton == "auto"
    if find:
        skeleton = None
    if isinstance(tracks, Tracks):
        if any(option is not None for option in (skeleton, confidence, fps, units, image_size)):
            raise OptionError(
                "reconstruct: skeleton, confidence, fps, units and image_size belong to arrays; these tracks already "
                "have them: give them where tracks are made (load_tracks, Tracks.from_arrays)"
            )
    else:
        tracks = Tracks.from_arrays(
            tracks, confidence, skeleton=skeleton, fps=fps, units=units or "px", image_size=image_size
        )
        if units is None and not isinstance(lens, Intrinsics) and may_be_shares(tracks.points[tracks.seen]):
            warnings.warn(f"{tracks.source}: {MAY_BE_SHARES}", KcsWarning, stacklevel=users_level())
    if find:
        tracks = with_found_bones(tracks)
    chosen = method_named(method, fields)
    _warn_of_lacking_bones(chosen, tracks)
    shown = chosen.without_ends(tracks)
    return chosen.with_ends(_before(lens, chosen, shown, cameras), tracks)


def reconstruct_all(
    people: Iterable[Tracks],
    *,
    method: str | Method = "auto",
    intrinsics: Any = None,
    workers: int = 1,
    **fields: Any,
) -> list[Reconstruction]:
    """Turn the tracks of several bodies, or of many clips, into 3D motion, as one batch where the method can.

    Args:
        people: tracks of any lengths, such as :func:`kcs_torch.io.load_people` gives.
        method: as of :func:`reconstruct`.
        intrinsics: of the camera that saw them all, as of :func:`reconstruct`.
        workers: processes that solve them, at most; more than 1 needs joblib. They start within seconds, go on for the
            next call, and use one thread each: of one body alone nothing is gained.
        **fields: of the method.

    Returns:
        A :class:`Reconstruction` of each, in their order. People of one file before a camera that nobody has calibrated
        get one lens where the image's size is known or can be guessed. Else they get one of their own each, and x and y
        from its principal point. Through one lens, given or found, the directions in which people stand compare
        (``result.in_space()``). Their distances compare once each has a size (``result.scaled(units="m",
        height=1.75)``): until then a person's unit is one pixel at their own mean distance, so that all seem equally
        far. "parallel" leaves everybody where the image has them, at no depth that compares.

    Raises:
        OptionError: as :func:`reconstruct`; or something is not :class:`Tracks`; or workers are no number of processes,
            joblib is missing, tracks are on a GPU, or a process died, as where memory is short.
        ShapeError: the intrinsics have the wrong shape or values.

    Warns:
        KcsWarning: as :func:`reconstruct`; or people of one file got lenses of their own.

    >>> from kcs_torch.data.synthetic import walking_person
    >>> both = reconstruct_all([walking_person(40).tracks, walking_person(30, yaw=60).tracks], method="kcs")
    >>> [len(one.points) for one in both]
    [40, 30]
    """
    if isinstance(people, Tracks):
        raise OptionError("reconstruct_all: expected a list of Tracks, got one: reconstruct takes it")
    people = list(people)
    for i, one in enumerate(people):
        check_tracks(one, f"reconstruct_all: item {i}")
    check_workers(workers, people)
    chosen = method_named(method, fields)
    for one in people:
        _warn_of_lacking_bones(chosen, one)
    lens = _lens(intrinsics)
    every, people = people, [chosen.without_ends(one) for one in people]
    found = _of_all(lens, chosen, people, workers)
    return [chosen.with_ends(one, tracks) for one, tracks in zip(found, every, strict=True)]


def _of_all(lens: Intrinsics | str | None, chosen: Method, people: list[Tracks], workers: int) -> list[Reconstruction]:
    """Several bodies reconstructed, as one batch where the method can."""
    if isinstance(lens, Intrinsics):
        return list(spread(partial(_before, lens, chosen), people, workers=workers))
    if lens == "parallel" or (lens is None and not chosen.turns_over):
        return spread_batch(chosen.many, people, workers)
    people = guess_images(people)
    found = by_one_lens(chosen, people, workers)
    rest = [i for i in range(len(people)) if i not in found]
    others = [people[i] for i in rest]
    if lens == "auto":
        found |= zip(rest, spread(partial(_before, lens, chosen), others, workers=workers), strict=True)
    else:
        found |= zip(rest, _unless_near(chosen, others, workers), strict=True)
    return _told_of_lenses([found[i] for i in range(len(people))])


def _warn_of_lacking_bones(method: Method, tracks: Tracks) -> None:
    """Tell where no bones are given to a method that knows of bones."""
    if method.knows_bones and not tracks.skeleton.bones and (lacking := no_bones(tracks.skeleton)) in tracks.notes:
        warnings.warn(f"{tracks.source}: {lacking}", KcsWarning, stacklevel=users_level())


def _unless_near(chosen: Method, people: Sequence[Tracks], workers: int) -> Iterator[Reconstruction]:
    """Bodies reconstructed as one batch under parallel rays, and one by one where the camera seems near."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", KcsWarning)  # of solutions on the way
        lifted = spread_batch(looking(chosen).many, people, workers)
    return spread(partial(_once_lifted, chosen), people, lifted, workers=workers)


def _once_lifted(chosen: Method, one: Tracks, lifted: Reconstruction) -> Reconstruction:
    """A body that was reconstructed under parallel rays."""
    if may_be_near(one):
        return reconstruct_uncalibrated(chosen, one, lifted=lifted)
    chosen.warn(lifted)
    return lifted


def _told_of_lenses(found: list[Reconstruction]) -> list[Reconstruction]:
    """The same; the user is told where people of one file got lenses of their own, unless it shows several shots."""
    clips: dict[str, list[Reconstruction]] = {}
    for one in found:
        if file_and_person(one.tracks.source)[1]:
            clips.setdefault(file_of(one.tracks), []).append(one)
    for file, people in clips.items():
        if len({one.tracks.source for one in people}) < len(people):
            continue  # who is there twice is there in several shots, as of_one_image has it
        near = sum(one.distance is not None for one in people)
        if len({one.intrinsics for one in people}) > 1:
            each = "got lenses and origins that not all have" if near > 1 else "got a lens and an origin of its own"
            unsized = all(one.tracks.image_size is None and one.tracks.units == "px" for one in people)
            message = (
                f"{file}: {near} of {len(people)} people {each}, as the camera seems near: their places and sizes do "
                f"not compare. Give {SAY_SIZE if unsized else ''}the camera's intrinsics (kcs-torch: --intrinsics "
                "FX,FY,CX,CY), or 'parallel', which leaves everybody where the image has them"
            )
            warnings.warn(message, KcsWarning, stacklevel=users_level())
    return found


def with_found_bones(tracks: Tracks) -> Tracks:
    """The tracks with the skeleton that their motion shows, and notes on what these bones lack alone.

    Args:
        tracks: of a body that moves.
    """
    stale = no_bones(tracks.skeleton), *unseen_notes(tracks.weights, tracks.skeleton)
    body = find_skeleton(tracks)
    kept = [note for note in tracks.notes if note not in stale]
    return replace(tracks, skeleton=body, notes=(*kept, *unseen_notes(tracks.weights, body)))


def _lens(value: Any) -> Intrinsics | str | None:
    """Intrinsics, or what is to be done without."""
    if isinstance(value, str) and value not in WITHOUT:
        raise ShapeError(
            f"intrinsics: expected (fx, fy, cx, cy), a matrix K (3, 3), 'auto' or 'parallel', got {value!r}"
        )
    return value if value is None or isinstance(value, str) else Intrinsics.of(value)


def _before(lens: Intrinsics | str | None, method: Method, tracks: Tracks, cameras: Any = None) -> Reconstruction:
    """Reconstruct one body before a camera."""
    check_tracks(tracks, "reconstruct")
    if lens is None:
        lens = "auto" if method.turns_over and cameras is None and may_be_near(tracks) else "parallel"
    if isinstance(lens, Intrinsics):
        seen = tracks.points[tracks.seen].detach()
        lens.check_unit(seen)
        off = (lens.rays(tracks.points)[..., :2].norm(dim=-1) * tracks.seen).amax(1)
        if said := lens.beside(seen):
            warnings.warn(f"{tracks.source}: {said}", KcsWarning, stacklevel=users_level())
        inside = bool((off < BESIDE).all())
        found = reconstruct_perspective(method, tracks, lens, cameras) if inside else None
        if found is None or not bool(found.points.isfinite().all()):
            frame = int(off.argmax())
            if float(off[frame]) < WIDE:
                raise OptionError(
                    f"{tracks.source}: intrinsics: no finite motion is found before such a camera: correct them, leave "
                    "out frames that show hardly anything of the body, or take rays to be parallel "
                    "(intrinsics='parallel')"
                )
            raise OptionError(
                f"{tracks.source}: intrinsics: expected tracks that such a camera sees: in frame {frame} a joint lies "
                f"{float(off[frame]):.3g} focal lengths off the optical axis, so that no finite motion is found. Leave "
                "out what is wrong there, or correct the intrinsics"
            )
        return found
    return method(tracks, cameras) if lens == "parallel" else reconstruct_uncalibrated(method, tracks, cameras)


def method_named(method: str | Method, fields: dict[str, Any]) -> Method:
    """The method that a name and its fields, or a :class:`Method`, stand for.

    Raises:
        OptionError: the name or a field is unknown, a field is out of range, or fields come with a :class:`Method`.
    """
    if isinstance(method, Method):
        if fields:
            raise OptionError(
                f"reconstruct: fields ({', '.join(fields)}) go with a method's name; set them on the method itself"
            )
        return method
    if method == "auto":
        method = DEFAULT
    if isinstance(method, str) and method.endswith((".safetensors", ".ckpt")):
        raise OptionError(
            f"method: expected a name or a Method, got the file {method!r}: use kcs_torch.training.load_lifter(file)"
        )
    given: object = method
    if isinstance(given, type) and issubclass(given, Method):
        name = given.__name__
        raise OptionError(f"method: expected a name or a Method, got the class {name}: make one, {name}()")
    if not isinstance(method, str) or method not in METHODS:
        raise unknown("method", method, ["auto", *METHODS])
    return METHODS[method].from_options(**fields)
