"""A camera that nobody has calibrated: whether it is near, and the focal length that explains the tracks best."""

from __future__ import annotations

import math
import time
import warnings
from dataclasses import fields, replace
from typing import Any

import torch
from torch import Tensor

from kcs_torch.clean.detector import detected
from kcs_torch.clean.timing import cuts_of
from kcs_torch.errors import KcsWarning, OptionError
from kcs_torch.methods.answer.finish import Estimate, extent
from kcs_torch.methods.base import Method, apart, check_cameras
from kcs_torch.methods.clips.lockstep import Search
from kcs_torch.methods.perspective.calibrated import WIDE, feet_on_ground, reconstruct_perspective
from kcs_torch.methods.perspective.image_lens import LikelyLens, lens_of_image
from kcs_torch.methods.perspective.parallel_image import body_unit, clean_image, image_noise
from kcs_torch.methods.perspective.pinhole import PinholeEnergy
from kcs_torch.methods.perspective.pinhole_coordinates import FIRM, USUAL
from kcs_torch.methods.perspective.scene import BLOCK, STEPS
from kcs_torch.methods.perspective.view import View, lens_note
from kcs_torch.methods.pkc import PKC
from kcs_torch.methods.pkc.limbs import outward
from kcs_torch.methods.pkc.long_gaps import time_seen
from kcs_torch.methods.pkc.near import SEEMS_FAR, SEEMS_NEAR
from kcs_torch.nn.posture import has_trunk, trunk_joints
from kcs_torch.solvers.lbfgs import lbfgs
from kcs_torch.types import Intrinsics, Reconstruction, Tracks, as_floats

__all__ = ["likely_lens", "looking", "may_be_near", "reconstruct_uncalibrated"]

NARROW = 0.15
"""Width of a trunk, over its length, from which on it is more than a line."""

FAR = 34.0
"""Distance, for a body of 1.75, of the far body that a near one is compared with."""

UNUSUAL = FIRM * math.log(FAR / USUAL) ** 2 / 2
"""What it costs to be as far away, where the focal length is not known."""

NEAR = 10.0
"""Distance up to which tracks tell that a camera is near, whose lens nothing else tells: from there on a wrong focal
length does more harm than parallel rays."""

CLOSE = 5.0
"""Distance up to which the search under parallel rays ends: what is farther away it finds signs of better."""

BETTER, SEEN = 2.5, -1.0
"""By how much the energy must be lower than of a far body for a near one to be believed; and in a detector's tracks,
which come from a real camera: these are seldom far, and to take a near one for far does the greater harm."""

SECONDS, RATE = 5.0, 30.0
"""How much of a clip tells whether a camera is near, and at how many frames a second at most."""

DEARER = 6.0
"""By how much a near body must be dearer in the end for the camera to be far: what seemed nearer than that may yet be
near, once signs are right."""

EVERY, HOPELESS, AWAY = 20, 10.0, 6.5
"""Every so many steps it may be hopeless: if a near body is dearer by so much, and has gone as far away."""


def may_be_near(tracks: Tracks) -> bool:
    """Whether perspective can be told: from a body with a template and a whole trunk, in one shot of one camera.

    Hips alone, with the legs, lie on a line: what turns about it looks like perspective.
    """
    body = tracks.skeleton
    if not has_trunk(body) or cuts_of(tracks):
        return False
    trunk = body.template_points(dtype=torch.float64)[trunk_joints(body)]
    long, wide, _ = torch.linalg.svdvals(trunk - trunk.mean(0)).tolist()
    return wide > NARROW * long


def reconstruct_uncalibrated(
    method: Method,
    tracks: Tracks,
    cameras: Tensor | None = None,
    lifted: Reconstruction | None = None,
) -> Reconstruction:
    """Reconstruct a body before a camera of which nothing is known.

    The nearer a camera is, the more the size of a limb in the image changes with its depth: bones of constant length,
    the template's posture and feet that stand still tell how much. Where the image's size is known, or can be guessed,
    the tracks are lifted through the lens that such a camera usually has (:func:`lens_of_image`). Where it is not, PKC
    solves them as if rays were parallel, but ends where it has found a body whose camera seems near all the same
    (:func:`likely_lens`), before it turns runs of signs over; the principal point is then taken to be the tracks'
    middle. Either way the focal length is found together with depths, lengths, distances and signs by
    :func:`kcs_torch.methods.perspective.reconstruct_perspective`.

    Args:
        method: any.
        tracks: of a body with a template.
        cameras: as of :func:`kcs_torch.methods.perspective.reconstruct_perspective`.
        lifted: what PKC, :func:`looking` for a near camera, found under parallel rays, if it was asked before: where
            :func:`lens_of_image` tells nothing, or another's tracks told that the camera is far away.

    Returns:
        As :func:`kcs_torch.methods.perspective.reconstruct_perspective`; a note tells the intrinsics. Where the tracks
        show no perspective, the method's own solution, for parallel rays.

    Raises:
        OptionError: the skeleton has no template with a trunk.
    """
    if not has_trunk(tracks.skeleton):
        raise OptionError(
            f"intrinsics: 'auto' needs a skeleton with a template and a trunk, '{tracks.skeleton.name}' has none: "
            "expected (fx, fy, cx, cy) or a matrix K (3, 3)"
        )
    begin = time.perf_counter()
    before = 0.0 if lifted is None else lifted.diagnostics.seconds
    likely = lens_of_image(tracks)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", KcsWarning)  # of solutions on the way
        if likely is not None and lifted is None:
            result = _by_image(method, tracks, cameras, likely)
        else:
            result = _by_tracks(method, tracks, cameras, likely, lifted)
    method.warn(result)
    notes = tuple(note for note in result.diagnostics.notes if note != SEEMS_FAR)
    spent = before + time.perf_counter() - begin
    return replace(result, diagnostics=replace(result.diagnostics, seconds=spent, notes=notes))


def _by_tracks(
    method: Method, tracks: Tracks, cameras: Tensor | None, likely: LikelyLens | None, lifted: Reconstruction | None
) -> Reconstruction:
    """A body before a camera of which the tracks tell whether it is near."""
    judge = method if isinstance(method, PKC) else PKC()
    result = looking(judge)(tracks, cameras) if lifted is None else lifted
    lens = None if SEEMS_FAR in result.diagnostics.notes else likely_lens(result, cameras)
    if lens is not None and likely is not None:
        return _by_image(method, tracks, cameras, likely)
    if lens is not None:
        near = _through(method, tracks, cameras, reconstruct_perspective(judge, tracks, lens, cameras, lifted=result))
        if bool(near.points.isfinite().all()):
            return near
    return method(tracks, cameras) if judge is not method or SEEMS_NEAR in result.diagnostics.notes else result


def _by_image(method: Method, tracks: Tracks, cameras: Tensor | None, likely: LikelyLens) -> Reconstruction:
    """A body before a camera with a likely lens, unless it comes out far away and parallel rays explain it better."""
    judge = method if isinstance(method, PKC) else PKC()
    near = reconstruct_perspective(judge, tracks, likely.lens, cameras, guessed=likely.usual)
    if not bool(near.points.isfinite().all()):
        return method(tracks, cameras)
    assert near.intrinsics is not None
    if near.intrinsics.focal > CLOSE * body_unit(near):
        lifted = judge(tracks, cameras)
        if _is_far(near, lifted):
            return lifted if judge is method else method(tracks, cameras)
    near = _through(method, tracks, cameras, near)
    notes = (*near.diagnostics.notes, likely.said) if likely.said else near.diagnostics.notes
    return replace(near, diagnostics=replace(near.diagnostics, notes=notes))


def _through(method: Method, tracks: Tracks, cameras: Tensor | None, near: Reconstruction) -> Reconstruction:
    """What a method finds through the lens that PKC found: the same if the method is PKC."""
    lens = near.intrinsics
    if isinstance(method, PKC) or lens is None:
        return near
    found = reconstruct_perspective(method, tracks, lens, cameras)
    notes = (*found.diagnostics.notes, lens_note(lens, tracks.units))
    return replace(found, diagnostics=replace(found.diagnostics, notes=notes))


def likely_lens(lifted: Reconstruction, cameras: Tensor | None = None) -> Intrinsics | None:
    """A lens through which a body looks more likely than under the parallel rays that it was solved for.

    The solution is refined twice under perspective (:class:`.PinholeEnergy`), at a distance of
    34 of its units (a person is 1.75 tall), and at any distance. Five seconds of the clip tell.

    Args:
        lifted: a body with a template, under parallel rays.
        cameras: (T, 2, 3) that were known.

    Returns:
        A lens of usual distance whose principal point is the tracks' middle, to start from; or None where rays might as
        well be parallel.
    """
    tracks = lifted.tracks
    with apart([tracks], differentiates=False):
        if cameras is not None:
            cameras = check_cameras(as_floats(cameras, "cameras", 3).to(tracks.points), tracks.num_frames)
        flat, unit = clean_image(lifted), body_unit(lifted)
        x, y = flat[time_seen(tracks)].mean((0, 1)).tolist()
        near = SEEMS_NEAR in lifted.diagnostics.notes
        if not near:
            distance = _nearness(tracks, flat, lifted.points[..., 2] / unit, unit, cameras)
            near = distance is not None and distance < NEAR
    return Intrinsics(USUAL * unit, USUAL * unit, x, y) if near else None


class _Looking(PKC):
    """PKC that looks for a near camera before it turns runs of signs over, which is then left to full perspective."""

    def _seems_near(self, tracks: Tracks, flat: Tensor, depth: Tensor, unit: float, cameras: Tensor | None) -> str:
        distance = _nearness(tracks, flat, depth, unit, cameras)
        if distance is None:
            return ""
        return SEEMS_NEAR if distance < CLOSE else SEEMS_FAR if distance == math.inf else ""

    def _steps(self, tracks: Tracks, cameras: Tensor | None) -> Search[Any, Any, Estimate]:
        # in longer clips no signs are turned over under perspective
        asked = tracks.num_frames <= BLOCK and may_be_near(tracks)
        return super()._steps(tracks, cameras) if asked else _as(PKC, self)._steps(tracks, cameras)

    def _for_hands(self) -> PKC:
        return _as(PKC, self)  # whether the camera is near the body tells


def looking(method: Method) -> Method:
    """The method for tracks of a camera that may be near; only PKC itself is another one."""
    return _as(_Looking, method) if type(method) is PKC else method


def _as(kind: type[PKC], method: Method) -> PKC:
    """PKC of a kind with a method's fields."""
    return kind(**{f.name: getattr(method, f.name) for f in fields(method)})


def _nearness(tracks: Tracks, flat: Tensor, depth: Tensor, unit: float, cameras: Tensor | None) -> float | None:
    """How far the camera is that explains a body better than a far one, for a body of 1.75.

    Infinity where the far one is better by far, None where it is not.

    Args:
        tracks: of the body.
        flat: (T, N, 2) their image without noise.
        depth: (T, N) under parallel rays, for a body of 1.75.
        unit: of such a body, in the tracks' unit.
        cameras: (T, 2, 3) that are known, or None.
    """
    middle = flat[time_seen(tracks)].mean((0, 1))
    aside = float((flat - middle).square().sum(-1).mean().sqrt())
    if not (bool(extent(tracks) > 0) and aside < WIDE * USUAL * unit):  # a point is as likely at any distance
        return math.inf
    if not (bool(depth.isfinite().all()) and bool(depth.any())):
        return math.inf
    lens, free = flat.new_tensor([1.0, USUAL / FAR]), torch.tensor([False, True], device=flat.device)
    energy = _seen_by_two(
        tracks, flat, depth.expand(2, -1, -1), unit, middle, (lens, free), feet_on_ground(tracks, cameras)
    )

    def distance(state: Tensor) -> float:
        return FAR * float(energy.unpack(state).focal[1])

    def hopeless(state: Tensor, cost: Tensor) -> bool:
        return float(cost[0] - cost[1]) < -HOPELESS and distance(state) > AWAY

    def enough(made: Tensor, state: Tensor, cost: Tensor) -> bool:
        return len(cost) > 1 and int(made.amin()) % EVERY == 0 and hopeless(state, cost)

    state = energy.start
    for _ in range(2):  # once more where a far body is not found back to
        found = lbfgs(energy, state, num_steps=STEPS, tolerance=1e-6, slopes=True, part=energy.rows, enough=enough)
        assert found.energy is not None
        state, gain = found.value, float(found.energy[0] - found.energy[1])
        if hopeless(state, found.energy):
            return math.inf
        if gain > -UNUSUAL:
            break
    found_at = distance(state)
    if gain < -DEARER:
        return math.inf
    return found_at if gain > (SEEN if detected(tracks) else BETTER) and found_at < NEAR else None


def _is_far(near: Reconstruction, lifted: Reconstruction) -> bool:
    """Whether a camera that is far away explains the tracks better than a near one, each by what was found through it.

    Each is seen along its own rays, in its own image without noise: where tracks are noisy, bones are constant there.

    Args:
        near: through a lens, at a usual distance.
        lifted: under parallel rays.
    """
    lens, flat, unit = near.intrinsics, clean_image(lifted), body_unit(lifted)
    assert lens is not None
    far, space = Intrinsics(FAR * unit, FAR * unit, lens.cx, lens.cy), near.in_space()
    aside = float(far.rays(flat)[..., :2].square().sum(-1).mean().sqrt())
    if not (bool(lifted.points.isfinite().all()) and aside < WIDE):  # a body that shrank to a point tells nothing
        return False
    tracks, some, rate = lifted.tracks, *_telling(lifted.tracks, flat)
    noise = image_noise(tracks, flat, unit)[some]
    images = [
        replace(tracks, points=image[some], weights=torch.ones_like(noise), fps=rate)
        for image in (flat, lens.project(space))
    ]
    views = [View.of(image, seen, rate) for image, seen in zip(images, (far, lens), strict=True)]
    placed = (space[some] @ views[1].look.mT)[..., 2] / body_unit(near)
    starts = (
        (views[0].first_distance(images[0], rate) / unit, lifted.points[some, :, 2] / unit),
        (placed.mean(-1), placed),
    )
    cost = []
    for view, (path, depth) in zip(views, starts, strict=True):
        depth = (depth - depth.mean(-1, keepdim=True))[None]
        energy = PinholeEnergy(outward(tracks.skeleton), view.rays, path, depth, rate, noise)
        found = lbfgs(energy, energy.start, num_steps=2 * STEPS, tolerance=1e-6, slopes=True)
        assert found.energy is not None
        cost.append(float(found.energy[0]))
    return cost[0] < cost[1]


def _telling(tracks: Tracks, flat: Tensor) -> tuple[Tensor, float]:
    """Which frames (K,) tell how far the camera is, the five seconds in which an image moves most, and their rate."""
    every, time = max(1, round(tracks.rate / RATE)), time_seen(tracks)
    return time.start + _liveliest(flat[time][::every], round(SECONDS * RATE)) * every, tracks.rate / every


def _seen_by_two(
    tracks: Tracks,
    flat: Tensor,
    depth: Tensor,
    unit: float,
    middle: Tensor,
    focal: tuple[Tensor, Tensor],
    feet: Tensor | None,
) -> PinholeEnergy:
    """The energy of a body before two cameras, by the five seconds in which it moves most.

    Args:
        tracks: of the body.
        flat: (T, N, 2) their image without noise.
        depth: (2, T, N) starts, for a body of 1.75.
        unit: of such a body, in the tracks' unit.
        middle: (2,) the principal point of both cameras.
        focal: (2,) focal lengths, over that of a camera at the distance FAR, and which are free (2,).
        feet: (T, C) how surely contact points stand still, or None.
    """
    some, rate = _telling(tracks, flat)
    noise = image_noise(tracks, flat, unit)
    depth = depth[:, some] - depth[:, some].mean(-1, keepdim=True)
    clean = replace(tracks, points=flat[some], weights=torch.ones_like(depth[0]), fps=rate)
    view = View.of(clean, Intrinsics(FAR * unit, FAR * unit, *middle.tolist()), rate)
    path = view.first_distance(clean, rate) / unit
    standing = None if feet is None else feet[some]
    return PinholeEnergy(
        outward(tracks.skeleton), view.rays, path, depth, rate, noise[some], standing=standing, focal=focal
    )


def _liveliest(image: Tensor, count: int) -> Tensor:
    """The ``count`` frames in a row that move most, of (T, N, 2); all if there are fewer."""
    begin = 0
    if len(image) > count:
        moved = (image - image.mean(1, keepdim=True)).diff(dim=0).square().sum((1, 2)).cumsum(0)
        before = torch.nn.functional.pad(moved, (1, 0))[: len(image) - count + 1]
        begin = int((moved[count - 2 :] - before).argmax())
    return torch.arange(begin, min(begin + count, len(image)), device=image.device)
