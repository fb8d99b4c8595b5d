"""Left and right that a detector mistakes for each other: which frames to swap back."""

from __future__ import annotations

import math

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from kcs_torch.errors import ShapeError
from kcs_torch.functional.ranks import nanmedian

__all__ = ["swapped_frames"]

MEMORY = 5
"""Frames before each that it is compared with."""

USUAL = 3.0
"""Errors of interpolation that are nothing unusual, in medians of the pair."""

LEAST = 0.03
"""And in sizes of the body, at least."""

MOST = 10.0
"""Errors in such units above which all are alike: an outlier lies as far from either side."""

PAIRS = 4
"""Pairs of joints that count in full: those of one limb go wrong together."""


def swapped_frames(left: Tensor, right: Tensor, seen: Tensor, size: float, penalty: float) -> Tensor:
    r"""Find the frames in which all pairs of joints have changed places, by second differences and dynamic programming.

    With d_t = left_t - right_t of a pair and signs s_t, -1 where swapped, it minimises over all s

        3/n min(1, 4/P) sum_t sum_ab sum_pairs log(1 + min(e^2, 10^2)) + penalty * (changes of s)

    over the n = 10 spans (a, b) of 1 <= a < b <= 5 and P pairs of joints, where e is the distance of s_{t-a} d_{t-a}
    from the straight line between s_{t-b} d_{t-b} and s_t d_t, in units of three times the pair's median, at least 3
    % of the body's size. A span counts for the pairs that are seen in its three frames. What moves evenly may pass
    through zero, as legs do that cross; what jumps to the other side is swapped. As frames are compared over up to
    five others, a few in which everything lies somewhere between do no harm. Signs cost the same if all of them are
    turned over: most frames are taken to be right.

    Args:
        left: (T, P, 2) joints in the image.
        right: (T, P, 2), their twins.
        seen: (T, P), whether both are.
        size: of the body, in the same units.
        penalty: of each change, in natural logarithms.

    Returns:
        (T,), True where the sides have to change places.

    Raises:
        ShapeError: they are not of these shapes.

    >>> time = torch.linspace(0, 3, 40, dtype=torch.float64)[:, None, None]
    >>> left = torch.cat([torch.cos(time), torch.sin(time)], -1).expand(-1, 2, -1).clone()
    >>> right = -left
    >>> left[10:15], right[10:15] = right[10:15].clone(), left[10:15].clone()
    >>> swapped_frames(left, right, torch.ones(40, 2, dtype=torch.bool), 1.0, 8.0).nonzero().flatten().tolist()
    [10, 11, 12, 13, 14]
    """
    if left.ndim != 3 or left.shape[-1] != 2 or right.shape != left.shape or seen.shape != left.shape[:2]:
        got = ", ".join(str(tuple(x.shape)) for x in (left, right, seen))
        raise ShapeError(f"swapped_frames: expected left and right (T, P, 2) and seen (T, P), got {got}")
    swapped = torch.zeros(len(left), dtype=torch.bool, device=left.device)
    shown = seen.any(1).nonzero().flatten()
    memory = min(MEMORY, len(shown) - 1)
    if memory < 2 or not size > 0:
        return swapped
    cost = _costs((left - right)[shown].double(), seen[shown], shown.double(), size, memory)
    spared = (cost[:, 0] - cost.amin(1)).sum()  # at most, by any signs that are not all alike
    if not bool(spared > penalty):
        return swapped
    signs = torch.from_numpy(_cheapest(cost.cpu().numpy(), penalty)).to(left.device)
    swapped[shown] = ~signs if 2 * int(signs.sum()) > len(signs) else signs
    return swapped


def _costs(apart: Tensor, seen: Tensor, time: Tensor, size: float, memory: int) -> Tensor:
    """(T, 2^(memory + 1)) cost of each frame by signs: bit i says that frame t - i is swapped."""
    frames, pairs = seen.shape
    state = torch.arange(2 ** (memory + 1), device=apart.device)
    bit = [(state >> i) & 1 for i in range(memory + 1)]
    triples = [(a, b) for b in range(2, memory + 1) for a in range(1, b)]
    share = 3 / len(triples) * min(1.0, PAIRS / pairs)
    cost = apart.new_zeros(frames, len(state))
    for a, b in triples:
        last, middle, first = (slice(b - i, frames - i) for i in (0, a, b))
        ahead, behind = (time[last] - time[middle])[:, None], (time[middle] - time[first])[:, None]
        old = (ahead / (ahead + behind))[..., None] * apart[first]
        new = (behind / (ahead + behind))[..., None] * apart[last]
        known = seen[last] & seen[middle] & seen[first]
        longer = ahead * behind / (a * (b - a))  # than without gaps, by which the error grows
        errors = [
            (apart[middle] - x * old - y * new).norm(dim=-1) / longer for y in (1, -1) for x in (1, -1)
        ]  # by whether the last frame, then whether the first, has another sign than the middle one
        usual = nanmedian(torch.where(known, errors[0], math.nan), 0).nan_to_num(0.0)
        usual = (USUAL * usual).clamp_min(LEAST * size)
        each = [((e / usual).clamp_max(MOST).square().log1p() * known).sum(-1) for e in errors]
        cost[last] += share * torch.stack(each, -1)[:, 2 * (bit[0] ^ bit[a]) + (bit[b] ^ bit[a])]
    return cost


def _cheapest(cost: NDArray[np.float64], penalty: float) -> NDArray[np.bool_]:
    """Signs (T,) of the least sum of costs (T, 2^(m + 1)), True where swapped."""
    half = cost.shape[1] // 2
    state = np.arange(2 * half)
    cost = cost + penalty * ((state ^ (state >> 1)) & 1)
    least = np.zeros(half)  # of the last m signs, the latest in the lowest bit
    came: list[NDArray[np.intp]] = []
    for row in cost[1:]:  # a few numbers each: plain arrays are the quickest
        total = (np.repeat(least, 2) + row).reshape(2, half)  # the oldest sign first, which the next frame forgets
        came.append(total.argmin(0))
        least = total.min(0)
    now = int(least.argmin())
    signs = [now & 1]
    for oldest in reversed(came):
        now = (now + half * int(oldest[now])) >> 1
        signs.append(now & 1)
    return np.array(signs[::-1], dtype=bool)
