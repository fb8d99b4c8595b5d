"""Whether a camera that nobody has calibrated is near or far: which of the two explains the tracks better."""

from __future__ import annotations

import math
from dataclasses import replace

import torch
from torch import Tensor

from kcs_torch.clean.detector import detected
from kcs_torch.clean.timing import cuts_of
from kcs_torch.methods.answer.finish import extent
from kcs_torch.methods.perspective.calibrated import WIDE, feet_on_ground
from kcs_torch.methods.perspective.image_lens import lens_of_image
from kcs_torch.methods.perspective.parallel_image import body_unit, clean_image, image_noise
from kcs_torch.methods.perspective.pinhole import PinholeEnergy
from kcs_torch.methods.perspective.pinhole_coordinates import FIRM, USUAL
from kcs_torch.methods.perspective.scene import STEPS
from kcs_torch.methods.perspective.view import View
from kcs_torch.methods.pkc.limbs import outward
from kcs_torch.methods.pkc.long_gaps import time_seen
from kcs_torch.nn.posture import has_trunk, trunk_joints
from kcs_torch.solvers.lbfgs import lbfgs
from kcs_torch.types import Intrinsics, Reconstruction, Tracks

__all__ = ["NEAR", "is_far", "may_be_near", "nearness"]

NARROW = 0.15
"""Width of a trunk, over its length, from which on it is more than a line."""

FAR = 34.0
"""Distance, for a body of 1.75, of the far body that a near one is compared with."""

FARTHER = 340.0
"""Distance of another one, whose rays are parallel but for what no tracks tell."""

UNUSUAL = FIRM * math.log(FAR / USUAL) ** 2 / 2
"""What it costs to be as far away, where nothing tells of the focal length."""

NEAR = 10.0
"""Distance up to which tracks tell that a camera is near, whose lens nothing else tells: from there on a wrong focal
length does more harm than parallel rays."""

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
    """Whether perspective can be told: from a body with a template and a whole trunk.

    Of several shots only where the image tells a lens: the tracks alone are believed to in a single shot.

    Hips alone, with the legs, lie on a line: what turns about it looks like perspective.
    """
    body = tracks.skeleton
    if not has_trunk(body) or (cuts_of(tracks) and lens_of_image(tracks) is None):
        return False
    trunk = body.template_points(dtype=torch.float64)[trunk_joints(body)]
    long, wide, _ = torch.linalg.svdvals(trunk - trunk.mean(0)).tolist()
    return wide > NARROW * long


def nearness(tracks: Tracks, flat: Tensor, depth: Tensor, unit: float, cameras: Tensor | None) -> float | None:
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


def is_far(near: Reconstruction, lifted: Reconstruction) -> bool:
    """Whether a camera that is far away explains the tracks better than a near one, each by what was found through it.

    Each is seen along its own rays, in its own image without noise: where tracks are noisy, bones are constant there.
    What is exact under parallel rays is not so before a camera that is merely far: one that is farther is tried, too.

    Args:
        near: through a lens, at a usual distance.
        lifted: under parallel rays.
    """
    lens, flat, unit = near.intrinsics, clean_image(lifted), body_unit(lifted)
    assert lens is not None
    space, depth = near.in_space(), lifted.points[..., 2] / unit
    aside = float((flat - flat.new_tensor([lens.cx, lens.cy])).square().sum(-1).mean().sqrt())
    # a body that shrank to a point tells nothing
    if not (bool(lifted.points.isfinite().all()) and aside < WIDE * FAR * unit):
        return False
    tracks, some, rate = lifted.tracks, *_telling(lifted.tracks, flat)
    noise = image_noise(tracks, flat, unit)[some]

    def along(image: Tensor, through: Intrinsics) -> tuple[Tracks, View]:
        clean = replace(tracks, points=image[some], weights=torch.ones_like(noise), fps=rate)
        return clean, View.of(clean, through, rate)

    def cost(view: View, path: Tensor, depth: Tensor) -> float:
        depth = (depth - depth.mean(-1, keepdim=True))[None]
        energy = PinholeEnergy(outward(tracks.skeleton), view.rays, path, depth, rate, noise, cuts=view.cuts)
        found = lbfgs(energy, energy.start, num_steps=2 * STEPS, tolerance=1e-6, slopes=True)
        assert found.energy is not None
        return float(found.energy[0])

    def far(distance: float) -> float:
        clean, view = along(flat, Intrinsics(distance * unit, distance * unit, lens.cx, lens.cy))
        return cost(view, view.first_distance(clean, rate) / unit, depth[some])

    _, view = along(lens.project(space), lens)
    placed = (space[some] @ view.look.mT)[..., 2] / body_unit(near)
    least = cost(view, placed.mean(-1), placed)
    return any(far(distance) < least for distance in (FAR, FARTHER))


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
        outward(tracks.skeleton), view.rays, path, depth, rate, noise[some], standing=standing, focal=focal,
        cuts=view.cuts,
    )  # fmt: skip


def _liveliest(image: Tensor, count: int) -> Tensor:
    """The ``count`` frames in a row that move most, of (T, N, 2); all if there are fewer."""
    begin = 0
    if len(image) > count:
        moved = (image - image.mean(1, keepdim=True)).diff(dim=0).square().sum((1, 2)).cumsum(0)
        before = torch.nn.functional.pad(moved, (1, 0))[: len(image) - count + 1]
        begin = int((moved[count - 2 :] - before).argmax())
    return torch.arange(begin, min(begin + count, len(image)), device=image.device)
