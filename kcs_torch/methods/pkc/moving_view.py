"""A body seen from a viewpoint that turns: many starts, ranked by one objective, the best refined on all frames."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from kcs_torch.functional.align import nearest_rotation
from kcs_torch.functional.chain import bone_vectors
from kcs_torch.functional.rigidity import distance_spread, rigid_tree
from kcs_torch.functional.temporal import fill_between
from kcs_torch.methods.lockstep import Search, run
from kcs_torch.methods.pkc.assembly import SLACK, TIGHT, WORTH, Assembly, followed
from kcs_torch.methods.pkc.descents import Descent, descend_all
from kcs_torch.methods.pkc.leaps import leaps_of, without_leaps
from kcs_torch.nn.unrolled import UnrolledFPC
from kcs_torch.skeleton import Skeleton
from kcs_torch.solvers.bone_paths import bone_paths, path_energy
from kcs_torch.solvers.camera_path import CameraPath, choose_path, settle_path
from kcs_torch.solvers.corners import corners_of
from kcs_torch.solvers.lifts import random_lifts, turning_cameras
from kcs_torch.solvers.procrustean import (
    COARSE,
    FINE,
    Pose,
    Stage,
    align_rotations,
    depth_deviation,
    length_energy,
    motion_energy,
    track_energy,
)

__all__ = [
    "FINER",
    "ROBOT",
    "MovingView",
    "moving_view",
    "relative_weights",
    "searching",
    "settled",
    "soften",
    "too_long",
]

TURNS = (30.0, 60.0, 90.0, 120.0, 180.0, 360.0)
"""Degrees that the cameras of the starts turn, evenly, about the image's vertical."""

KEPT = (12, 6, 3)
"""Starts that go on after each of the coarse stages."""

RANKING = Stage(1e-5, 0, 1.0, 1.0, SLACK)
"""Scales at which finished starts are compared: the poses and their changes count alike."""

LOOSE, LOOSER = 0.3, 0.1
"""Weight of each length where the links are no tree (markers, say), in the coarse stages and in the fine ones."""

FINER = {1.0: TIGHT, LOOSE: LOOSER}
"""Weight of each length in the fine stages by that in the coarse ones: of a tree, and of other links."""

SAME = 0.05
"""Root mean square distance of solutions that are one, of tracks of root mean square 1."""

OTHER = 0.1
"""Root mean square difference of depths from which on solutions are different bodies."""

NEAR = 6.0
"""How much dearer than the best, for each frame compared, another solution may be to be given beside it: what leads by
more has so far been right."""

LEAP = 1.0
"""How much dearer, for each frame, a solution may be that does not leap to its mirror image: the energy knows nothing
of a camera's leap."""

LONG = 2000
"""Frames of a clip up to which paths of bones are put together: of longer ones the frames that are compared are too far
apart, and paths of all frames would take much memory."""

FREE = 30_000_000
"""Numbers of the matrices that whiten all frames up to which x and y are unknowns in noise: 10,000 frames of 17 joints.
With all that goes with them they take 70 KB a frame there; the image of longer clips is taken as it is."""

FREEING = 2e-4
"""The eps of stages from which on x and y are unknowns in noise; in coarser ones they would only take time."""

GIVEN = 3
"""Solutions whose bones are then led along paths of constant length."""

FARTHER = 1.8
"""How far depths are off, in deviations of the image, beyond what exact tracks leave open: fitted to dogs, hands and
people in noise of 1 to 4 % of their size, and with 30 % missing, before a camera that goes round by 180 degrees."""

ROBOT = 10
"""Up to as many joints, angles between bones may be kept, and in noise, which hides the bones' paths, twenty times the
random starts are tried: few bones leave much undecided. Nor does one solution fill gaps for another: where it is wrong,
so are they."""


@dataclass(frozen=True)
class MovingView:
    """Solutions of one clip, best first, none like another or its mirror image.

    Attributes:
        pose: points (H, T, N, 3) in the camera frame, and the rotations that align them.
        value: (H,) by which they are ranked.
        bones: (B, 2) tree that the poses were aligned in.
        rigid: (P, 2) pairs that keep their distance.
        stiffness: weight of each length.
        lead: by how much the next solution is dearer, for each frame compared, where paths of bones were combined; 0
            where they were not, or no solution was left to compare.
        noise: (T, N) deviations of the image, a joint's own and those of its frame, or None where it is exact.
    """

    pose: Pose
    value: Tensor
    bones: Tensor
    rigid: Tensor
    stiffness: float
    lead: float = 0.0
    noise: Tensor | None = None

    def cameras(self, index: int = 0, kind: CameraPath = "auto") -> tuple[Tensor, CameraPath]:
        """Rotations (T, 3, 3), world to camera, of one solution, and the kind of path they follow.

        What aligns poses also turns with the body; a camera moves simply. See
        :func:`kcs_torch.solvers.camera_path.choose_path`.
        """
        path, kind, _ = choose_path(self.pose.rotations[index], kind)
        if kind == "constant":
            path = settle_path(bone_vectors(self.pose.points[index], self.bones), path)
        return path, kind

    def deviation(self, cameras: Tensor, index: int = 0) -> Tensor:
        """Standard deviation (T, N) of the depths of one solution, for camera rotations (T, 3, 3)."""
        pose, views = self.pose[index : index + 1], cameras[None, :, 2]
        own = depth_deviation(
            pose.points, pose.rotations, self.bones, views=views, rigid=self.rigid, stiffness=self.stiffness
        )[0]
        return own if self.noise is None else torch.hypot(own, FARTHER * self.noise)


def moving_view(
    image: Tensor,
    skeleton: Skeleton,
    start: Tensor,
    rotations: Tensor,
    *,
    weights: Tensor | None = None,
    noise: float = 0.0,
    turns: Sequence[float] = TURNS,
    lifts: int = 6,
    coarse_frames: int = 100,
    alternatives: int = 1,
    exact: bool = True,
    seed: int = 0,
) -> MovingView:
    """Lift one clip by low-rank motion of aligned bones of constant length.

    Args:
        image: (T, N, 2), complete, centred per frame, of root mean square 1.
        skeleton: of the N joints. A tree is taken at its word: its rigid bones keep their length, and poses are
            aligned in it. Else its links are pulled weakly, and poses are aligned in a tree found from them.
        start: (T, N, 3) a first guess, from :class:`kcs_torch.methods.SfAM`.
        rotations: (T, 3, 3) world to camera, of that guess.
        weights: (T, N) confidences, for ``noise``.
        noise: standard deviation of the image, a share of its size; 0 holds x and y.
        turns: degrees of further starts with evenly turning cameras.
        lifts: number of further starts from bone lengths with random signs.
        coarse_frames: starts are compared on about as many frames, evenly spread.
        alternatives: how many solutions are refined on all frames and returned at most, the best and those that are
            hardly dearer (by NEAR).
        exact: the image shows lengths without noise: where all bones of a tree are rigid, those that vary count against
            a solution, and starts are put together from paths that single bones can take.
        seed: of the random starts.

    Returns:
        The solutions, ranked.
    """
    search = searching(
        image, skeleton, start, rotations, weights=weights, noise=noise, turns=turns, lifts=lifts,
        coarse_frames=coarse_frames, alternatives=alternatives, exact=exact, seed=seed,
    )  # fmt: skip
    return run(search, descend_all)


def searching(
    image: Tensor,
    skeleton: Skeleton,
    start: Tensor,
    rotations: Tensor,
    *,
    weights: Tensor | None = None,
    noise: float = 0.0,
    turns: Sequence[float] = TURNS,
    lifts: int = 6,
    coarse_frames: int = 100,
    alternatives: int = 1,
    exact: bool = True,
    seed: int = 0,
) -> Search[Descent, Pose, MovingView]:
    """:func:`moving_view` as a search, which may run beside others; arguments as there."""
    frames, joints, _ = image.shape
    rigid = skeleton.bone_index(device=image.device)[list(skeleton.rigid)]
    is_tree = skeleton.is_tree
    held = is_tree and exact and noise == 0 and not skeleton.flexible
    small = joints <= ROBOT
    unsure = small and not held
    if too_long(image):
        noise, weights = 0.0, None
    first = torch.cat([image, start[..., 2:] - start[..., 2:].mean(1, keepdim=True)], -1)[None]
    spread = lambda points: rigid_tree(distance_spread(points)[1])  # noqa: E731
    bones = skeleton.bone_index(device=image.device) if is_tree else spread(first[0])
    corners = corners_of(bones if held and small else bones[:0])
    fixed = torch.cat([rigid, corners.ends])
    coarse, fine = (tuple(soften(s, noise) for s in stages) for stages in (COARSE, FINE))
    loose = 1.0 if is_tree else LOOSE

    def descend(
        tracks: Tensor, pose: Pose, pull: float, stages: tuple[Stage, ...], weights: Tensor | None
    ) -> Search[Descent, Pose, Pose]:
        sigma, sure = (noise, weights) if stages[0].eps <= max(FREEING, 0.1 * noise**2) else (0.0, None)
        links = fixed if pull == TIGHT else rigid
        (found,) = yield [Descent(tracks, pose.points, pose.rotations, bones, sure, links, pull, sigma, stages)]
        return found

    def value(pose: Pose) -> Tensor:
        """How solutions are ranked, (H,)."""
        stage = soften(RANKING, noise)
        pull = image.new_full((len(fixed),), TIGHT if held else loose)
        total = motion_energy(pose.points, pose.rotations, bones, stage)
        total = total + length_energy(pose.points, fixed, pull, stage.slack)
        if noise > 0:  # who leaves the tracks moves as simply as he likes
            tracks, sure = (image, weights) if pose.points.shape[1] == frames else (few, few_weights)
            sure = torch.ones_like(tracks[..., 0]) if sure is None else sure
            total = total + track_energy(pose.points, tracks, sure, noise)
        if held:
            own = bone_vectors(pose.points, rigid).transpose(-3, -2)  # (H, P, T, 3)
            total = total + WORTH * path_energy(own[..., 2], own[..., :2]).sum(-1)
        return total

    pick = torch.arange(0, frames, max(1, -(-frames // coarse_frames)), device=image.device)
    few, few_weights = image[pick], None if weights is None else weights[pick]
    made = _starts(few, bones, turns, 20 * lifts if unsure else lifts, frames, pick, seed)
    points = torch.cat([first[:, pick], *(p for p, _ in made)])
    turned = align_rotations(points, torch.cat([rotations[None, pick], *(r for _, r in made)]), bones)
    zero = points.new_zeros(len(points))
    pose = Pose(points, turned, zero, zero)
    order = torch.arange(len(points))
    for stage, kept in zip(coarse, KEPT, strict=True):
        pose = yield from descend(few, pose, loose, (stage,), few_weights)
        best = pose.objective.argsort()[: 3 * kept if unsure else kept]
        pose, order = pose[best], order[best.cpu()]
    pose = yield from descend(few, pose, FINER[loose], fine, few_weights)
    lead, paths = 0.0, bone_paths(image, bones) if held and lifts > 0 and frames <= LONG else None
    if paths is not None:
        mine, pose = pose.points[(order == 0).to(image.device)], pose[value(pose).argsort()[:GIVEN]]
        assembly = Assembly(
            few, bones, paths.at(pick), corners, (*coarse[-1:], *fine), value,
            lambda pose, stages: descend(few, pose, TIGHT, stages, few_weights),
        )  # fmt: skip
        pose = yield from (assembly.searched(pose) if small else assembly.near(pose))
        near = (pose.points[:, None] - mine).square().sum(-1).mean((-2, -1)) < SAME**2
        order = 1 - near.any(-1).long().cpu()  # some are the first guess's still
        lead = _lead(pose, value(pose)) if small else 0.0
    best = _distinct(pose, value(pose), alternatives)
    pose, order = pose[best], order[best.cpu()]

    if len(pick) < frames:
        points, turned = _spread_out(pose, image, pick)
        if paths is not None:
            points = followed(paths, points, bones, pick)
        own = (order == 0).to(image.device)  # the first guess has all frames of its own
        points = torch.where(own[:, None, None, None], first, points)
        turned = torch.where(own[:, None, None, None], align_rotations(first, rotations[None], bones), turned)
        stages = coarse if bool(own.any()) else coarse[-1:]
        pose = replace(pose, points=points, rotations=turned)
        del first, start, points, turned  # of long clips they are large
        if paths is None or bool(own.any()) or not small:
            pose = yield from descend(image, pose, loose, stages, weights)
    if len(pick) < frames or not is_tree:  # else the finest stages have seen all frames
        if not is_tree:
            bones = spread(pose.points[0])
        pose = yield from descend(image, pose, FINER[loose], fine, weights)
    ranks = value(pose)
    if (even := without_leaps(pose)) is not None:
        even = yield from descend(image, even, FINER[loose], fine, weights)
        other = value(even)
        left = leaps_of(pose.points[..., 2]).sum(1) - leaps_of(even.points[..., 2]).sum(1)
        pick = (left > 0) & (other < ranks + LEAP * frames)
        pose, ranks = pose.exchanged(even, pick), torch.where(pick, other, ranks)
    best = _distinct(pose, ranks, alternatives)
    return MovingView(pose[best], ranks[best], bones, rigid, loose, lead)


def relative_weights(noise: Tensor, least: float) -> Tensor:
    """Weights (T, N) by which joints of noise ``least`` count as those of their own noise do, and no more than 1."""
    return (least / noise.clamp_min(least)).square()


def settled(image: Tensor, skeleton: Skeleton, start: Tensor, rotations: Tensor) -> Search[Descent, Pose, Tensor]:
    """Depths (T, N) that the coarse stages make of a first guess of a tree; arguments as of :func:`moving_view`."""
    bones = skeleton.bone_index(device=image.device)
    rigid = bones[list(skeleton.rigid)]
    first = torch.cat([image, start[..., 2:] - start[..., 2:].mean(1, keepdim=True)], -1)[None]
    turned = align_rotations(first, rotations[None], bones)
    (pose,) = yield [Descent(image, first, turned, bones, None, rigid, 1.0, 0.0, COARSE)]
    return pose.points[0, ..., 2]


def soften(stage: Stage, noise: float) -> Stage:
    """The stage, with no scale far below the noise."""
    return replace(stage, eps=max(stage.eps, 0.1 * noise**2), slack=max(stage.slack, 0.3 * noise))


def too_long(image: Tensor) -> bool:
    """Whether a clip is too long for x and y to be unknowns."""
    return image.shape[0] * (3 * image.shape[1] + 3) ** 2 > FREE


def _distinct(pose: Pose, value: Tensor, count: int) -> Tensor:
    """Indices of the best solution and those hardly dearer, none like another or its mirror image, best first."""
    kept: list[int] = []
    for k in value.argsort().tolist():
        if len(kept) == count or float(value[k] - value.amin()) > NEAR * pose.points.shape[1]:
            break
        if bool((_apart(pose, k)[kept] > OTHER).all()):
            kept.append(k)
    return torch.tensor(kept, device=value.device)


def _lead(pose: Pose, value: Tensor) -> float:
    """How much dearer than the best, for each frame, the next solution is that is not the same or its mirror image."""
    best = int(value.argmin())
    dearer = (value - value[best])[_apart(pose, best) > OTHER]
    return float(dearer.amin()) / pose.points.shape[1] if len(dearer) else 0.0


def _apart(pose: Pose, one: int) -> Tensor:
    """How far the depths of each solution are from those of one or of its mirror image, (H,), root mean square."""
    depth = pose.points[..., 2]
    return torch.stack([(depth - s * depth[one]).square().mean((1, 2)) for s in (1, -1)]).amin(0).sqrt()


def _starts(
    image: Tensor, bones: Tensor, turns: Sequence[float], lifts: int, frames: int, pick: Tensor, seed: int
) -> list[tuple[Tensor, Tensor]]:
    """Points (H, T', N, 3) and rotations (H, T', 3, 3) of further starts, for the frames in ``pick``."""
    starts = []
    if turns:
        cameras = turning_cameras(turns, frames, dtype=image.dtype, device=image.device)[:, pick]
        seen = image.expand(len(cameras), -1, -1, -1)
        solver = UnrolledFPC(30, learnable=False).to(image.device)
        lifted = (solver(seen, cameras[:, :, :2]) @ cameras.mT)[..., 2:]
        starts.append((torch.cat([seen, lifted - lifted.mean(-2, keepdim=True)], -1), cameras))
    if lifts > 0:
        generator = torch.Generator().manual_seed(seed)
        flips = random_lifts(image, bones, lifts, generator=generator)
        degrees = 360 * torch.rand(lifts, generator=generator, dtype=torch.float64, device="cpu")
        starts.append((flips, turning_cameras(degrees, len(image), dtype=image.dtype, device=image.device)))
    return starts


def _spread_out(pose: Pose, image: Tensor, pick: Tensor) -> tuple[Tensor, Tensor]:
    """Points and rotations of all frames, linear between those in ``pick``."""
    depth = fill_between(pose.points[..., 2:], pick, len(image))
    turned = nearest_rotation(fill_between(pose.rotations, pick, len(image)))
    return torch.cat([image.expand(len(depth), -1, -1, -1), depth], -1), turned
