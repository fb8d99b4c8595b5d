"""Joints that are not seen: how far off filled gaps may be, how far bones reach, and where to put those never seen."""

from __future__ import annotations

import torch
from torch import Tensor

from kcs_torch.functional.align import centre, procrustes
from kcs_torch.functional.chain import bone_lengths, bone_vectors
from kcs_torch.functional.ranks import kth_smallest
from kcs_torch.skeleton import Skeleton

__all__ = ["gap_deviation", "place_unseen", "within_reach"]

LEAST = 0.001
"""Least standard deviation of a place that was filled in, a share of the body's size, and that of others at rest."""

LONGEST = 0.8
"""Share of the frames in which a bone looks no longer than what is taken for its length."""

BEND = 0.3
"""Share of its usual acceleration, over a second, by which a joint strays from the path that fills a gap."""

ROUNDS = 50
"""How often all bones of unseen joints are shortened: enough for a limb of which only the root is seen."""


def within_reach(points: Tensor, seen: Tensor, skeleton: Skeleton) -> Tensor:
    """Pull joints that were filled in back to where their bones reach.

    A path through a gap knows nothing of bones, and at the end of a clip it may run anywhere. No bone looks longer than
    it is: what it is comes from its longest image in frames that show both ends, and from the skeleton's usual lengths
    at the scale that the others have. Joints move along their bones, both ends where both are unseen.

    Args:
        points: (T, N, 2), complete.
        seen: (T, N) bool; what is seen stays where it is.
        skeleton: of the N joints; virtual ones follow their sources.

    Returns:
        (T, N, 2), in the unit of the points.

    >>> from kcs_torch import Skeleton
    >>> arm = Skeleton(["shoulder", "elbow"], [(0, 1)])
    >>> points = torch.tensor([[[0.0, 0], [0, 3]], [[0.0, 0], [4, 0]], [[0.0, 0], [0, 9]]])
    >>> within_reach(points, torch.tensor([[True, True], [True, True], [True, False]]), arm)[:, 1]
    tensor([[0., 3.],
            [4., 0.],
            [0., 4.]])
    """
    count = skeleton.num_observed
    rigid = skeleton.bone_index(device=points.device)[list(skeleton.rigid)]
    some = (rigid < count).all(-1)
    bones = rigid[some]
    if bool(seen.all()) or not len(bones):
        return points
    there = seen[:, :count]
    both = there[:, bones].all(-1)  # (T, B)
    images = bone_lengths(points, bones)
    longest = torch.where(both, images, 0).amax(0)
    usual = skeleton.relative_lengths(dtype=points.dtype, device=points.device)
    if usual is not None:
        usual = usual[list(skeleton.rigid)][some]
        told = (longest > 0) & (usual > 0)
        if bool(told.any()):
            longest = torch.maximum(longest, usual * (longest / usual)[told].median())
    reach = torch.where(longest > 0, longest, torch.inf)
    wrong = ((images > reach) & ~both).any(-1)  # (T,) frames
    if not bool(wrong.any()):
        return points
    own, free = points[wrong, :count], (~there[wrong]).to(points)
    shares = [free[:, bones[:, end]] / free[:, bones].sum(-1).clamp_min(1) for end in (0, 1)]
    for _ in range(ROUNDS):
        vectors = bone_vectors(own, bones)
        over = (1 - reach / vectors.norm(dim=-1).clamp_min(torch.finfo(points.dtype).tiny)).clamp_min(0)
        pull, parts = torch.zeros_like(own), torch.zeros_like(free)
        for end, share, sign in zip((0, 1), shares, (1, -1), strict=True):
            pull = pull.index_add(1, bones[:, end], sign * (share * over)[..., None] * vectors)
            parts = parts.index_add(1, bones[:, end], ((share * over) > 0).to(points))
        own = own + pull / parts.clamp_min(1)[..., None]
    out = points.clone()
    out[wrong] = skeleton.complete(own)[0]
    return out


def gap_deviation(points: Tensor, seen: Tensor, rate: float, most: float = 0.1) -> Tensor:
    """Standard deviation (T, N) of joints where gaps were filled, 0 where they are seen.

    A joint of acceleration a strays by a d^2 / 2 from a straight path in d frames, and from a smooth one by less: a
    frame between two that show it is known well, the middle of a swing that nobody saw is not. The acceleration is the
    root mean square over the second about a frame.

    Args:
        points: (T, N, 2), complete, of root mean square 1.
        seen: (T, N) bool.
        rate: frames a second.
        most: the largest, and that of joints never seen.

    >>> path = torch.arange(9.0)[:, None, None].square().expand(9, 1, 2) / 900
    >>> seen = torch.tensor([[1, 1, 1, 1, 0, 0, 0, 1, 1]]).bool().mT
    >>> (1000 * gap_deviation(path, seen, 30.0).flatten()).round().int().tolist()
    [0, 0, 0, 0, 2, 5, 2, 0, 0]
    """
    frames = len(points)
    time = torch.arange(frames, device=points.device)[:, None]
    never = 2 * frames
    before = torch.where(seen, time, -never).cummax(0).values
    after = torch.where(seen, time, never).flip(0).cummin(0).values.flip(0)
    away = torch.minimum(time - before, after - time)
    if frames < 3:
        return torch.where(seen, 0, points.new_tensor(most))
    bend = torch.nn.functional.pad(points.diff(n=2, dim=0).square().sum(-1).mT, (1, 1), mode="replicate")
    half = min(max(1, round(rate / 2)), frames - 1)
    total = torch.nn.functional.pad(bend.cumsum(-1), (1, 0))
    start, stop = (time[:, 0] - half).clamp_min(0), (time[:, 0] + half + 1).clamp_max(frames)
    usual = ((total[:, stop] - total[:, start]).clamp_min(0) / (stop - start)).sqrt().mT
    strays = torch.where(away < frames, LEAST + BEND * usual * away.to(points.dtype).square(), most)
    return torch.where(seen, torch.zeros_like(usual), strays.clamp_max(most))


def place_unseen(points: Tensor, known: Tensor, skeleton: Skeleton) -> Tensor:
    """Place joints that are never seen where the template has them, seen from their nearest seen neighbours.

    The template is turned onto each frame's seen joints, at one scale for the clip, and mirrored in depth where that
    fits the clip better. The scale is that at which most seen bones are as long as they look at their longest: a pose
    unlike the template's would shrink what is fitted to it. A joint between several takes the mean of what they tell.
    Without a template it takes its neighbours' place, without a neighbour the middle.

    Args:
        points: (T, N, 3).
        known: (N,), True for joints that some frame shows.
        skeleton: of the N joints.

    Returns:
        (T, N, 3); seen joints are unchanged.
    """
    if bool(known.all()) or not bool(known.any()):
        return points
    weights = known.to(points.dtype)
    local, middle = centre(points, weights)
    offsets = torch.zeros_like(points)
    if skeleton.template is not None:
        rest, _ = centre(skeleton.template_points(dtype=points.dtype, device=points.device), weights)
        size = _size(points, known, rest, skeleton)
        fits = []
        for depth in (1.0, -1.0):
            body = (rest * torch.tensor([1.0, 1.0, depth]).to(points)).expand_as(local)
            rotation, fitted = procrustes(body, local, weights)
            scale = fitted.median() if size is None else size
            placed = scale * body @ rotation
            fits.append((((placed - local).square().sum(-1) * weights).sum(), placed))
        offsets = min(fits, key=lambda f: float(f[0]))[1]
    placed = torch.where(known[:, None], local, torch.zeros_like(local))
    done = known.to(points.dtype)  # (N,)
    bones = skeleton.bone_index(device=points.device)
    near = points.new_zeros(2 * [len(known)]).index_put((bones[:, 0], bones[:, 1]), points.new_ones(()))
    near = near + near.mT
    for _ in range(skeleton.num_joints):
        count = near @ done
        fresh = (done == 0) & (count > 0)
        if not bool(fresh.any()):
            break
        guess = offsets + near @ (done[:, None] * (placed - offsets)) / count.clamp_min(1)[:, None]
        placed = torch.where(fresh[:, None], guess, placed)
        done = torch.where(fresh, 1, done)
    return torch.where(known[:, None], points, placed + middle)


def _size(points: Tensor, known: Tensor, rest: Tensor, skeleton: Skeleton) -> Tensor | None:
    """Size of the body beside the template's, by the longest that seen bones look; None where no bone is seen."""
    bones = skeleton.bone_index(device=points.device)
    bones = bones[known[bones].all(-1)]
    usual, longest = bone_lengths(rest, bones), bone_lengths(points, bones)
    longest = kth_smallest(longest, round(LONGEST * (len(points) - 1)) + 1, 0) if len(bones) else usual
    use = (usual > 0) & (longest > 0)
    return (longest[use] / usual[use]).median() if bool(use.any()) else None
