"""A body seen from a viewpoint that turns: aligned bones of constant length that move in few ways."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from kcs_torch.methods.clips.lockstep import Search, run
from kcs_torch.methods.pkc.descents import Descent, descend_all
from kcs_torch.methods.pkc.moving_search import TURNS, MovingSearch
from kcs_torch.methods.pkc.moving_solutions import MovingView
from kcs_torch.skeleton import Skeleton
from kcs_torch.solvers.procrustean import COARSE, Pose, align_rotations

__all__ = ["moving_view", "relative_weights", "settled"]


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
    search = MovingSearch(
        image, skeleton, start, rotations, weights=weights, noise=noise, turns=turns, lifts=lifts,
        coarse_frames=coarse_frames, alternatives=alternatives, exact=exact, seed=seed,
    )  # fmt: skip
    return run(search.solve(), descend_all)


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
