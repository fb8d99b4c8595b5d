"""A body before a camera that hardly turns: bones of constant length, their signs of depth, several hypotheses."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import torch
from torch import Tensor

from kcs_torch.functional.chain import bone_vectors
from kcs_torch.functional.temporal import best_path
from kcs_torch.methods.clips.lockstep import Search, run, together
from kcs_torch.methods.pkc.batch import serve
from kcs_torch.methods.pkc.flips import flipped, parts_of, turned_over
from kcs_torch.methods.pkc.hypotheses import Hypotheses, distinct, refined
from kcs_torch.methods.pkc.limbs import Limb, SignCosts, limbs_of, waves
from kcs_torch.methods.pkc.objective import Objective
from kcs_torch.methods.pkc.placing import placing
from kcs_torch.methods.pkc.trunk import TURN, Trunk, longest_image, mirror, trunk_misfit, trunk_path, trunk_turns
from kcs_torch.methods.pkc.weights import Weights, at_pace, pace_of
from kcs_torch.nn.lengths import free_bones
from kcs_torch.skeleton import Skeleton

__all__ = ["fixed_view", "searching"]

COARSE = (1.0, 1.01, 1.03, 1.07, 1.14, 1.25)
FINE = (1.0, 1.008, 1.02, 1.04, 1.07, 1.12, 1.2)
"""Lengths tried for a bone, over its longest image (or 0.8 of its usual length, where that is more)."""

TRUST = 0.1
"""Weight of the limbs' votes for the trunk's sign: each frame's vote already speaks for its neighbours."""

LOOSE = 7.0
"""By how much lengths are less certain at first."""

BETTER, BEST = 6, 4
"""Hypotheses that are refined at all, and well."""

FLIPS = 4
"""Flips of runs of signs beside other moves."""

GAIN = 0.5
"""By how much a round of moves must make the best hypothesis cheaper for another round to be made."""

ALIKE = 0.02
"""Root mean square depth below which hypotheses are one, a person being about 1.75 tall."""

SWITCH = 8.0
"""Largest cost of the trunk's change of sign from one frame to the next."""


def fixed_view(
    skeleton: Skeleton,
    image: Tensor,
    *,
    rate: float = 30.0,
    noise: Tensor | None = None,
    rounds: int = 2,
    steps: int = 30,
    weights: Weights | None = None,
    anchor: Tensor | None = None,
    standing: Tensor | None = None,
) -> Hypotheses:
    """Lift one clip by lengths, signs and posture, without any turn of the viewpoint.

    1. The trunk, as a rigid template, gives a path of rotations and its mirror image; once with the template's lengths
       and once with central bones no longer than their longest image.
    2. Each limb's lengths and signs follow by second-order Viterbi for both paths at once; how much dearer a frame is
       with one path than with the other is the limb's vote on the trunk's sign.
    3. With the trunk's signs settled, limbs are placed again on a finer grid of lengths; the mirror image and other
       sign paths stay as further hypotheses.
    4. All are refined together on :class:`Objective`. Rounds of discrete moves from the best follow: limbs placed
       again about the refined trunk, each limb's bones flipped.

    Args:
        skeleton: with a template, spreads and a trunk.
        image: (T, N, 2), complete, in units of the template (a standing person being about 1.75).
        rate: frames a second.
        noise: (T, N) standard deviation of the joints' images, in template units; none if None.
        rounds: of discrete moves.
        steps: L-BFGS steps of each refinement.
        weights: of the objective.
        anchor: (B,) lengths known from elsewhere, or None.
        standing: (T, C) how surely the skeleton's contact points stand still, or None where nothing tells.

    Returns:
        The hypotheses, best first.
    """
    noise = torch.zeros_like(image[..., 0]) if noise is None else noise
    search = searching(skeleton, image, rate, noise, rounds, steps, anchor, weights, standing)
    return run(search, serve)


def searching(
    skeleton: Skeleton,
    image: Tensor,
    rate: float,
    noise: Tensor,
    rounds: int,
    steps: int,
    anchor: Tensor | None = None,
    weights: Weights | None = None,
    standing: Tensor | None = None,
    confirmed: Callable[[Hypotheses], Search[Any, Any, bool]] | None = None,
) -> Search[Any, Any, Hypotheses]:
    """:func:`fixed_view` as a search, which may run beside others; arguments as there.

    It ends early with hypotheses that are ``confirmed`` from elsewhere.
    """
    slow = 30.0 / rate
    pace = pace_of(image, skeleton, rate)
    weights = at_pace(weights or Weights(), rate, pace)
    costs = SignCosts()
    costs = replace(
        costs,
        acceleration=costs.acceleration * slow**2,
        posture=costs.posture * pace,
        foreshortening=costs.foreshortening * pace,
        hinge=costs.hinge / pace,
    )
    image = image - image.mean(-2, keepdim=True)
    objective = Objective(skeleton, image, weights, noise, anchor, standing)
    search = _Search(skeleton, image, objective, costs, TURN * slow)
    first = yield from search.start(anchor)
    found = yield from search.refine(first, steps, LOOSE)
    if confirmed is not None and (yield from confirmed(found)):
        return found
    for _ in range(rounds):
        best = found.energy[0]
        moved = yield from search.moves(found)
        found = yield from search.refine(moved, steps)
        if not bool(found.energy[0] < best - GAIN):
            break
    return (yield from turned_over(search.objective, search.parts, found, steps)) if rounds else found


@dataclass(frozen=True)
class _Search:
    """The search for one clip.

    Attributes:
        skeleton: with a template, its bones directed outwards.
        image: (T, N, 2), centred, in units of the template.
        objective: that refines and ranks hypotheses.
        costs: by which limbs are placed.
        turn: usual turn of the trunk from a frame to the next, in radians.
    """

    skeleton: Skeleton
    image: Tensor
    objective: Objective
    costs: SignCosts
    turn: float

    @cached_property
    def parts(self) -> list[tuple[int, ...]]:
        """Bones whose signs are turned over together."""
        return parts_of(self.skeleton, self.limbs)

    @cached_property
    def limbs(self) -> list[Limb]:
        return limbs_of(self.skeleton, self.objective.posture.trunk.tolist())

    def start(self, anchor: Tensor | None) -> Search[Any, Any, Hypotheses]:
        """Hypotheses from both templates of the trunk."""
        made = yield from together([self._about(trunk, anchor) for trunk in self._trunks(anchor)])
        z, length = (torch.stack(part) for part in zip(*(body for part in made for body in part), strict=True))
        return Hypotheses(z, length, z.new_full((len(z),), torch.inf))

    def _about(self, trunk: Trunk, anchor: Tensor | None) -> Search[Any, Any, list[tuple[Tensor, Tensor]]]:
        """Depths (T, N) and lengths (B,) of bodies about one template of the trunk."""
        first = yield from trunk_path(self.image, trunk, self.objective.posture, self.costs.posture, self.turn)
        tried: list[Tensor] = []
        settled = yield from self._settled(first, trunk, anchor)
        for path in (*settled, first):
            if not any(bool((path - other).abs().amax() < 1e-6) for other in tried):
                tried.append(path)
        made = yield from self._places(tried[:1], trunk, anchor)
        if tried[1:]:  # the first path's lengths serve all
            made += yield from self._places(tried[1:], trunk, made[-1][1])
        return made

    def refine(self, found: Hypotheses, steps: int, loose: float = 1.0) -> Search[Any, Any, Hypotheses]:
        """All refined a little, with loose lengths first where the start is rough, then the best few that differ."""
        few = max(steps // 3, 1)
        if loose > 1:
            found = yield from refined(self.objective, found, few, loose)
            found = distinct(found, BETTER, ALIKE)
        found = yield from refined(self.objective, found, few)
        return (yield from refined(self.objective, distinct(found, BEST, ALIKE), steps))

    def moves(self, found: Hypotheses) -> Search[Any, Any, Hypotheses]:
        """The best, the next ones, and what discrete moves make of the best."""
        z, length = found.depth[0], found.lengths[0]
        points = torch.cat([self.image, z[..., None]], -1)
        trunk = Trunk(self.objective.posture.rest, length)
        path, *others = yield from self._settled(self.objective.posture.frame(points), trunk, length)
        near, *turned = yield from self._places([path, *others], trunk, length, [z, *[None] * len(others)])
        again = yield from self._places([path], trunk, None, [z])
        new = [near, *again, *turned]
        flips = flipped(self.objective, self.parts, found[:1])[:FLIPS]
        made = len(new)
        return Hypotheses(
            torch.cat([found.depth[:2], torch.stack([n[0] for n in new]), flips.depth]),
            torch.cat([found.lengths[:2], torch.stack([n[1] for n in new]), flips.lengths]),
            torch.cat([found.energy[:2], found.energy.new_full((made + len(flips.energy),), torch.inf)]),
            found.steps,
        )

    def _trunks(self, anchor: Tensor | None) -> list[Trunk]:
        """The template, and one whose central bones are as long as their longest image."""
        posture = self.objective.posture
        usual = posture.rest_lengths if anchor is None else anchor
        seen = longest_image(bone_vectors(self.image, posture.bones), self.objective.noise)
        twins = {b for pair in self.skeleton.mirror_bones for b in pair}
        central = torch.tensor([i not in twins for i in range(self.skeleton.num_bones)], device=seen.device)
        short = torch.where(central, torch.minimum(torch.maximum(seen, 0.3 * usual), 1.3 * usual), usual)
        out = []
        for length in (usual, short) if anchor is None else (usual,):
            scale = length / posture.rest_lengths.clamp_min(1e-9)
            rest = self._chain(bone_vectors(posture.rest, posture.bones) * scale[:, None])
            out.append(Trunk(rest, length))
        return out

    def _settled(self, path: Tensor, trunk: Trunk, lengths: Tensor | None) -> Search[Any, Any, Tensor]:
        """The path (T, 3, 3), mirrored where the limbs vote for it, and the mirror image of that: (2, T, 3, 3)."""
        paths = torch.stack([path, mirror(path)])
        choice = yield from self._settle(paths, trunk, lengths)
        settled = paths[choice, torch.arange(len(path), device=path.device)]
        return torch.stack([settled, mirror(settled)])

    def _settle(self, paths: Tensor, trunk: Trunk, lengths: Tensor | None) -> Search[Any, Any, Tensor]:
        """Which of several trunk paths each frame takes by the limbs' votes, (T,)."""
        posture, free = self.objective.posture, free_bones(self.skeleton)
        flat = bone_vectors(self.image, posture.bones)
        moves = trunk_turns(paths, self.turn, SWITCH)
        limbs = [limb for limb in self.limbs if limb.inner is not None]
        if not limbs:
            return torch.zeros(len(self.image), dtype=torch.long, device=self.image.device)
        candidates = self._candidates(flat, limbs, COARSE if lengths is None else lengths)
        task = placing(
            flat, limbs, paths, posture, free, self.costs, self.objective.noise,
            candidates=candidates, transition=moves, margins=True,
        )  # fmt: skip
        (found,) = yield [task]
        assert found.margins is not None
        votes = (found.margins - found.margins.amin(-1, keepdim=True)).clamp_max(20).sum(0)
        off = trunk_misfit(self.image, trunk, posture.trunk, paths).mT / self.costs.posture
        return best_path(TRUST * votes + off, trunk_turns(paths, self.turn))

    def _places(
        self, paths: Sequence[Tensor], trunk: Trunk, lengths: Tensor | None, keep: Sequence[Tensor | None] = ()
    ) -> Search[Any, Any, list[tuple[Tensor, Tensor]]]:
        """Depths (T, N), lengths (B,) of bodies whose trunks follow paths, or keep the depths that ``keep`` has."""
        posture, free = self.objective.posture, free_bones(self.skeleton)
        flat, rest = bone_vectors(self.image, posture.bones), bone_vectors(trunk.rest, posture.bones)
        kept = keep or [None] * len(paths)
        depths = [
            (rest @ path.mT)[..., 2].clone() if z is None else bone_vectors(z[..., None], posture.bones)[..., 0].clone()
            for path, z in zip(paths, kept, strict=True)
        ]  # (T, B) each
        sizes = [trunk.lengths.clone() for _ in paths]
        for wave in waves(self.limbs):
            candidates = self._candidates(flat, wave, FINE if lengths is None else lengths)
            near = [
                self._direction(flat, dz, length, limb.before) if limb.entry else None
                for dz, length in zip(depths, sizes, strict=True)
                for limb in wave
            ]
            turned = torch.stack([path for path in paths for _ in wave])[:, None]
            task = placing(
                flat, wave * len(paths), turned, posture, free, self.costs, self.objective.noise,
                candidates=candidates.repeat(len(paths), 1, 1), before=near,
            )  # fmt: skip
            (found,) = yield [task]
            parts = iter(zip(found.depths, found.lengths, strict=True))
            for dz, length in zip(depths, sizes, strict=True):
                for limb in wave:
                    chain = list(limb.bones)
                    dz[:, chain], length[chain] = next(parts)
        joints = [self._chain(dz.mT).mT for dz in depths]
        return [(z - z.mean(-1, keepdim=True), length) for z, length in zip(joints, sizes, strict=True)]

    def _candidates(self, flat: Tensor, limbs: Sequence[Limb], grid: tuple[float, ...] | Tensor) -> Tensor:
        """Combinations of limbs' lengths (J, K, M): of a grid over their longest images, or the one that is known."""
        if isinstance(grid, Tensor):
            return torch.stack([grid[None, list(limb.bones)] for limb in limbs])
        steps = torch.tensor(grid, dtype=flat.dtype, device=flat.device)
        longest = longest_image(flat, self.objective.noise)
        least = torch.maximum(longest, 0.8 * self.objective.posture.rest_lengths)
        count = len(limbs[0].bones)
        return torch.stack(
            [torch.cartesian_prod(*(least[b] * steps for b in limb.bones)).view(-1, count) for limb in limbs]
        )

    @staticmethod
    def _direction(flat: Tensor, dz: Tensor, length: Tensor, bone: int) -> Tensor:
        """Direction (T, 3) of a bone that is already placed."""
        return torch.cat([flat[:, bone], dz[:, bone, None]], -1) / length[bone].clamp_min(1e-9)

    def _chain(self, vectors: Tensor) -> Tensor:
        """Joints (N, ...) from bone vectors (B, ...), the root at 0."""
        return torch.tensordot(self.objective.tree.to(vectors), vectors, dims=1)
