"""The search for a body that is seen from a viewpoint that turns: many starts, the best refined on all frames."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from kcs_torch.functional.align import nearest_rotation
from kcs_torch.functional.chain import bone_vectors
from kcs_torch.functional.rigidity import distance_spread, rigid_tree
from kcs_torch.functional.temporal import fill_between
from kcs_torch.methods.clips.lockstep import Search
from kcs_torch.methods.pkc.assembly import SLACK, TIGHT, WORTH, Assembly, followed
from kcs_torch.methods.pkc.descents import Descent
from kcs_torch.methods.pkc.leaps import leaps_of, without_leaps
from kcs_torch.methods.pkc.moving_solutions import MovingView
from kcs_torch.nn.unrolled import UnrolledFPC
from kcs_torch.skeleton import Skeleton
from kcs_torch.solvers.bone_paths import BonePaths, bone_paths, path_energy
from kcs_torch.solvers.corners import corners_of
from kcs_torch.solvers.lifts import random_lifts, turning_cameras
from kcs_torch.solvers.procrustean import (
    COARSE,
    FINE,
    Pose,
    Stage,
    align_rotations,
    length_energy,
    motion_energy,
    track_energy,
)

__all__ = ["FINER", "TURNS", "MovingSearch", "is_small", "soften", "too_long"]

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

ROBOT = 10
"""Up to as many joints, angles between bones may be kept, and in noise, which hides the bones' paths, twenty times the
random starts are tried: few bones leave much undecided."""


class MovingSearch:
    """The search of :func:`moving_view` for one clip, which may run beside others; arguments as there.

    Attributes:
        bones: (B, 2) tree that poses are aligned in: the skeleton's, or found from what is known so far.
        rigid: (P, 2) pairs that keep their distance.
        fixed: these, and the outer ends of bones whose angles may be kept.
        held: whether bones keep their length exactly.
        found: whether they were chosen for keeping it.
        small: whether there are so few joints that much is left undecided.
        pick: frames on which starts are compared.
    """

    def __init__(
        self,
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
    ) -> None:
        frames = len(image)
        tree = skeleton.bone_index(device=image.device)
        self.is_tree, self.found = skeleton.is_tree, skeleton.found
        self.held = self.is_tree and exact and noise == 0 and not skeleton.flexible
        self.small = is_small(image)
        if too_long(image):
            noise, weights = 0.0, None
        self.image, self.weights, self.noise = image, weights, noise
        self.first = torch.cat([image, start[..., 2:] - start[..., 2:].mean(1, keepdim=True)], -1)[None]
        self.rotations = rotations
        self.bones = tree if self.is_tree else _spread_tree(self.first)
        self.rigid = tree[list(skeleton.rigid)]
        self.corners = corners_of(self.bones if self.held and self.small else self.bones[:0])
        self.fixed = torch.cat([self.rigid, self.corners.ends])
        self.coarse, self.fine = (tuple(soften(stage, noise) for stage in stages) for stages in (COARSE, FINE))
        self.loose = 1.0 if self.is_tree else LOOSE
        self.turns, self.lifts, self.seed, self.alternatives = turns, lifts, seed, alternatives
        self.pick = torch.arange(0, frames, max(1, -(-frames // coarse_frames)), device=image.device)
        self.few, self.few_weights = image[self.pick], None if weights is None else weights[self.pick]
        long = not self.held or lifts < 1 or frames > LONG
        self.paths = None if long else bone_paths(image, self.bones)

    def solve(self) -> Search[Descent, Pose, MovingView]:
        """The solutions, ranked: starts are compared on a few frames, the best refined on all."""
        pose, own = yield from self._compared()
        lead = 0.0
        if self.paths is not None:
            pose, own = yield from self._assembled(self.paths, pose, own)
            lead = _lead(pose, self._value(pose)) if self.small else 0.0
        best = _distinct(pose, self._value(pose), self.alternatives)
        pose = yield from self._on_all_frames(pose[best], own[best])
        pose, ranks = yield from self._without_leaps(pose)
        best = _distinct(pose, ranks, self.alternatives)
        return MovingView(pose[best], ranks[best], self.bones, self.rigid, self.loose, lead, found=self.found)

    def _compared(self) -> Search[Descent, Pose, tuple[Pose, Tensor]]:
        """The best of all starts on a few frames, and which of them (H,) come from the first guess."""
        unsure = self.small and not self.held
        made = self._starts(20 * self.lifts if unsure else self.lifts)
        points = torch.cat([self.first[:, self.pick], *(p for p, _ in made)])
        turned = torch.cat([self.rotations[None, self.pick], *(r for _, r in made)])
        zero = points.new_zeros(len(points))
        pose = Pose(points, align_rotations(points, turned, self.bones), zero, zero)
        own = torch.arange(len(points), device=points.device) == 0
        for stage, kept in zip(self.coarse, KEPT, strict=True):
            pose = yield from self._descended(pose, self.loose, (stage,))
            best = pose.objective.argsort()[: 3 * kept if unsure else kept]
            pose, own = pose[best], own[best]
        pose = yield from self._descended(pose, FINER[self.loose], self.fine)
        return pose, own

    def _assembled(self, paths: BonePaths, pose: Pose, own: Tensor) -> Search[Descent, Pose, tuple[Pose, Tensor]]:
        """Solutions put together from paths that single bones can take, and which are the first guess's still."""
        mine, pose = pose.points[own], pose[self._value(pose).argsort()[:GIVEN]]
        stages = (self.coarse[-1:], self.fine[:1], self.fine[1:]) if self.small else (self.fine[-1:],)
        assembly = Assembly(
            self.few, self.bones, paths.at(self.pick), self.corners, stages, self._value,
            lambda pose, stages: self._descended(pose, TIGHT, stages),
        )  # fmt: skip
        pose = yield from (assembly.searched(pose) if self.small else assembly.near(pose))
        near = (pose.points[:, None] - mine).square().sum(-1).mean((-2, -1)) < SAME**2
        return pose, near.any(-1)

    def _on_all_frames(self, pose: Pose, own: Tensor) -> Search[Descent, Pose, Pose]:
        """Solutions of a few frames refined on all; the first guess has all frames of its own."""
        first, rotations = self.first, self.rotations
        del self.first, self.rotations  # of long clips they are large
        few = len(self.pick) < len(self.image)
        if few:
            points, turned = _spread_out(pose, self.image, self.pick)
            if self.paths is not None:
                points = followed(self.paths, points, self.bones, self.pick)
            points = torch.where(own[:, None, None, None], first, points)
            guessed = align_rotations(first, rotations[None], self.bones)
            pose = replace(pose, points=points, rotations=torch.where(own[:, None, None, None], guessed, turned))
            stages = self.coarse if bool(own.any()) else self.coarse[-1:]
            del first, rotations, points, turned, guessed
            if self.paths is None or bool(own.any()) or not self.small:
                pose = yield from self._descended(pose, self.loose, stages)
        if few or not self.is_tree:  # else the finest stages have seen all frames
            if not self.is_tree:
                self.bones = _spread_tree(pose.points)
            pose = yield from self._descended(pose, FINER[self.loose], self.fine)
        return pose

    def _without_leaps(self, pose: Pose) -> Search[Descent, Pose, tuple[Pose, Tensor]]:
        """Solutions that do not leap to their mirror image where that is hardly dearer, and how they rank, (H,)."""
        ranks = self._value(pose)
        if (even := without_leaps(pose)) is not None:
            even = yield from self._descended(even, FINER[self.loose], self.fine)
            other = self._value(even)
            left = leaps_of(pose.points[..., 2]).sum(1) - leaps_of(even.points[..., 2]).sum(1)
            better = (left > 0) & (other < ranks + LEAP * len(self.image))
            pose, ranks = pose.exchanged(even, better), torch.where(better, other, ranks)
        return pose, ranks

    def _descended(self, pose: Pose, pull: float, stages: tuple[Stage, ...]) -> Search[Descent, Pose, Pose]:
        """Solutions of a few or of all frames after some stages, whose lengths count ``pull`` each."""
        if not stages:
            return pose
        tracks, weights = self._seen(pose)
        noise = self.noise
        if stages[0].eps > max(FREEING, 0.1 * noise**2):
            noise, weights = 0.0, None
        links = self.fixed if pull == TIGHT else self.rigid
        (found,) = yield [Descent(tracks, pose.points, pose.rotations, self.bones, weights, links, pull, noise, stages)]
        return found

    def _seen(self, pose: Pose) -> tuple[Tensor, Tensor | None]:
        """The image and weights of the frames that solutions have."""
        whole = pose.points.shape[1] == len(self.image)
        return (self.image, self.weights) if whole else (self.few, self.few_weights)

    def _value(self, pose: Pose) -> Tensor:
        """How solutions are ranked, (H,)."""
        stage = soften(RANKING, self.noise)
        pull = self.image.new_full((len(self.fixed),), TIGHT if self.held else self.loose)
        total = motion_energy(pose.points, pose.rotations, self.bones, stage)
        total = total + length_energy(pose.points, self.fixed, pull, stage.slack)
        if self.noise > 0:  # who leaves the tracks moves as simply as he likes
            tracks, weights = self._seen(pose)
            sure = torch.ones_like(tracks[..., 0]) if weights is None else weights
            total = total + track_energy(pose.points, tracks, sure, self.noise)
        if self.held:
            own = bone_vectors(pose.points, self.rigid).transpose(-3, -2)  # (H, P, T, 3)
            total = total + WORTH * path_energy(own[..., 2], own[..., :2]).sum(-1)
        return total

    def _starts(self, lifts: int) -> list[tuple[Tensor, Tensor]]:
        """Points (H, T', N, 3) and rotations (H, T', 3, 3) of further starts, for the frames in ``pick``."""
        image, dtype, device = self.few, self.image.dtype, self.image.device
        starts = []
        if self.turns:
            cameras = turning_cameras(self.turns, len(self.image), dtype=dtype, device=device)[:, self.pick]
            seen = image.expand(len(cameras), -1, -1, -1)
            solver = UnrolledFPC(30, learnable=False).to(device)
            lifted = (solver(seen, cameras[:, :, :2]) @ cameras.mT)[..., 2:]
            starts.append((torch.cat([seen, lifted - lifted.mean(-2, keepdim=True)], -1), cameras))
        if lifts > 0:
            generator = torch.Generator().manual_seed(self.seed)
            flips = random_lifts(image, self.bones, lifts, generator=generator)
            degrees = 360 * torch.rand(lifts, generator=generator, dtype=torch.float64, device="cpu")
            starts.append((flips, turning_cameras(degrees, len(image), dtype=dtype, device=device)))
        return starts


def _spread_tree(points: Tensor) -> Tensor:
    """The tree (N - 1, 2) of the joints whose distances vary least in the first of some solutions (H, T, N, 3)."""
    return rigid_tree(distance_spread(points[0])[1])


def soften(stage: Stage, noise: float) -> Stage:
    """The stage, with no scale far below the noise."""
    return replace(stage, eps=max(stage.eps, 0.1 * noise**2), slack=max(stage.slack, 0.3 * noise))


def is_small(image: Tensor) -> bool:
    """Whether an image (T, N, 2) has so few joints that much is left undecided."""
    return image.shape[1] <= ROBOT


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


def _spread_out(pose: Pose, image: Tensor, pick: Tensor) -> tuple[Tensor, Tensor]:
    """Points and rotations of all frames, linear between those in ``pick``."""
    depth = fill_between(pose.points[..., 2:], pick, len(image))
    turned = nearest_rotation(fill_between(pose.rotations, pick, len(image)))
    return torch.cat([image.expand(len(depth), -1, -1, -1), depth], -1), turned
