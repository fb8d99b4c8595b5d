"""Signs of depth: which of the two mirror images a bone of known length shows in each frame."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from kcs_torch.errors import ShapeError

__all__ = ["SignPath", "sign_table", "smooth_signs"]


class SignPath(NamedTuple):
    """The cheapest path of signs.

    Attributes:
        cost: (K,).
        poses: (K, T) which of the C poses each frame takes.
        signs: (K, T, M) +1 or -1.
        margins: (K, T, C, 2^M) least cost of any path through a state, less ``cost``; None unless asked for.
    """

    cost: Tensor
    poses: Tensor
    signs: Tensor
    margins: Tensor | None


def sign_table(count: int, like: Tensor) -> Tensor:
    """All combinations of signs, (2^M, M): the first row is all +1, the last bone turns fastest."""
    index = torch.arange(2**count, device=like.device)[:, None] >> torch.arange(count - 1, -1, -1, device=like.device)
    return 1 - 2 * (index & 1).to(like.dtype)


def smooth_signs(
    unary: Tensor, depths: Tensor, *, cap: float, transition: Tensor | None = None, margins: bool = False
) -> SignPath:
    """Choose the signs s_t of M bones and one of C poses c_t in each frame by second-order Viterbi.

    Minimises sum_t unary[t, c_t, s_t] + sum_t transition[t, c_t, c_t+1]
    + 1/2 sum_tm min((s_t-1 d_t-1 - 2 s_t d_t + s_t+1 d_t+1)_m^2, cap): a bone's depth s d moves smoothly, so that it
    changes its sign only where it passes through the image plane.

    Args:
        unary: (K, T, C, 2^M), signs in the order of :func:`sign_table`.
        depths: d (K, T, M), non-negative, in units of the accelerations' standard deviation.
        cap: largest squared acceleration that counts; what exceeds it is a jump.
        transition: (T - 1, C, C), or (K, T - 1, C, C), or None where all poses follow each other freely.
        margins: True also returns the min-marginals.

    Raises:
        ShapeError: the shapes do not fit.

    >>> d = torch.tensor([[2.0, 1.0, 0.0, 1.0, 2.0]])[..., None]
    >>> unary = torch.zeros(1, 5, 1, 2)
    >>> unary[0, 0, 0, 1] = 1  # the first frame prefers +
    >>> smooth_signs(unary, d, cap=9.0).signs.flatten().tolist()
    [1.0, 1.0, 1.0, -1.0, -1.0]
    """
    batch, frames, poses, states = unary.shape
    count = depths.shape[-1]
    if depths.shape[:2] != (batch, frames) or states != 2**count:
        raise ShapeError(
            f"smooth_signs: expected unary (K, T, C, 2^M) and depths (K, T, M), got {tuple(unary.shape)} and "
            f"{tuple(depths.shape)}"
        )
    table = sign_table(count, depths)
    if transition is None:
        transition = unary.new_zeros(max(frames - 1, 0), poses, poses)
    if transition.ndim == 3:
        transition = transition[None]
    if frames == 1:
        cost, state = unary[:, 0].flatten(1).min(-1)
        spread = (unary - cost[:, None, None, None]) if margins else None
        return SignPath(cost, (state // states)[:, None], table[state % states][:, None], spread)
    bend = _bending(depths, cap)  # (T - 2, K, S, S, S)
    # u[s_t-1, c_t, s_t]: least cost of frames 0..t
    start = unary[:, 0, :, :, None, None] + transition[:, 0, :, None, :, None] + unary[:, 1, None, None]
    u, first = start.min(1)  # over c_0: (K, S, C, S)
    ahead, from_sign, from_pose = [u], [], [first]
    for t in range(2, frames):
        g, a = (u[..., None] + bend[t - 2][:, :, None]).min(1)  # over s_t-2: (K, C, S, S)
        u, b = (g[..., None, :] + transition[:, t - 1, :, None, :, None]).min(1)  # over c_t-1: (K, S, C, S)
        u = u + unary[:, t, None]
        ahead.append(u)
        from_sign.append(a)
        from_pose.append(b)
    cost, flat = u.flatten(1).min(-1)
    k = torch.arange(batch, device=unary.device)
    before, pose, now = flat // (poses * states), flat // states % poses, flat % states
    signs, path = [now, before], [pose]
    for t in range(frames - 1, 0, -1):
        pose_before = from_pose[t - 1][k, before, pose, now]
        path.append(pose_before)
        if t > 1:
            earlier = from_sign[t - 2][k, pose_before, before, now]
            signs.append(earlier)
            before, now = earlier, before
        pose = pose_before
    spread = None
    if margins:
        spread = _margins(unary, bend, transition, ahead) - cost[:, None, None, None]
    return SignPath(cost, torch.stack(path[::-1], 1), table[torch.stack(signs[::-1], 1)], spread)


def _bending(depths: Tensor, cap: float) -> Tensor:
    """Cost of three frames' signs, (T - 2, K, S, S, S)."""
    batch, frames, count = depths.shape
    sign = torch.tensor([1.0, -1.0], dtype=depths.dtype, device=depths.device)
    signed = (depths[..., None] * sign).transpose(0, 1)  # (T, K, M, 2)
    total: Tensor | int = 0
    for m in range(count):
        d = signed[:, :, m]
        bend = d[:-2, :, :, None, None] - 2 * d[1:-1, :, None, :, None] + d[2:, :, None, None, :]
        cost = 0.5 * bend.square().clamp_max(cap)  # (T - 2, K, 2, 2, 2)
        block = [2 if i == m else 1 for i in range(count)]
        total = total + cost.reshape(-1, batch, *block, *block, *block)
    assert isinstance(total, Tensor)
    total = total.expand(-1, -1, *[2] * (3 * count))
    return total.reshape(frames - 2, batch, 2**count, 2**count, 2**count)


def _margins(unary: Tensor, bend: Tensor, transition: Tensor, ahead: list[Tensor]) -> Tensor:
    """Least cost of any path through each state, (K, T, C, S)."""
    frames = unary.shape[1]
    behind = torch.zeros_like(ahead[-1])  # [s_t-1, c_t, s_t]: least cost of frames t + 1..
    out = [ahead[-1].amin(1)]
    for t in range(frames - 1, 0, -1):
        if t == 1:
            out.append(_first(unary, transition, behind))
            break
        onward = transition[:, t - 1, :, :, None] + unary[:, t, None]  # (K, c_t-1, c_t, s_t)
        onward = (onward[:, :, None] + behind[:, None]).amin(3)  # over c_t: (K, c_t-1, s_t-1, s_t)
        behind = (onward[:, None] + bend[t - 2][:, :, None]).amin(-1)  # (K, S, C, S)
        out.append((ahead[t - 2] + behind).amin(1))
    return torch.stack(out[::-1], 1)


def _first(unary: Tensor, transition: Tensor, behind: Tensor) -> Tensor:
    """The first frame's least costs, (K, C, S)."""
    later = unary[:, 1, None] + behind  # (K, s_0, c_1, s_1)
    later = later.amin(-1)  # (K, s_0, c_1)
    joined = later[:, None] + transition[:, 0, :, None, :]  # (K, c_0, s_0, c_1)
    return unary[:, 0] + joined.amin(-1)
