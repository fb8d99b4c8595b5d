"""Signs of depth: which of the two mirror images a bone of known length shows in each frame."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from kcs_torch.errors import ShapeError

__all__ = ["SignPath", "sign_costs", "sign_table", "smooth_signs"]


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
        ShapeError: the shapes do not fit, or there are no frames.

    >>> d = torch.tensor([[2.0, 1.0, 0.0, 1.0, 2.0]])[..., None]
    >>> unary = torch.zeros(1, 5, 1, 2)
    >>> unary[0, 0, 0, 1] = 1  # the first frame prefers +
    >>> (smooth_signs(unary, d, cap=9.0).signs * d + 0).flatten().tolist()
    [2.0, 1.0, 0.0, -1.0, -2.0]
    """
    costs = _Costs(unary, depths, cap, transition)
    frames, _, states, _ = costs.shape
    table = sign_table(depths.shape[-1], depths)
    if frames == 1:
        cost, state = costs.unary[0].flatten(0, 1).min(0)
        spread = (unary - cost[:, None, None, None]) if margins else None
        return SignPath(cost, (state // states)[:, None], table[state % states][:, None], spread)
    ahead = costs.ahead()
    cost, last = ahead[-1].flatten(0, 2).min(0)
    path = [last]
    for pointers in reversed(costs.pointers(ahead)):
        path.append(pointers.gather(0, path[-1][None])[0])
    state = torch.stack(path[::-1])  # (T - 1, K): pose, turn and sign in one; sign xor turn is the sign before
    sign, turn, pose = state % states, state // states % states, state // states**2
    sign, pose = torch.cat([(sign ^ turn)[:1], sign]), torch.cat([costs.first_pose(state[0]), pose])
    spread = costs.margins(ahead).permute(3, 0, 1, 2) - cost[:, None, None, None] if margins else None
    return SignPath(cost, pose.mT.contiguous(), table[sign.mT], spread)


def sign_costs(unary: Tensor, depths: Tensor, *, cap: float, transition: Tensor | None = None) -> Tensor:
    """Return the costs (K,) of :func:`smooth_signs`' cheapest paths, without the paths; arguments as there."""
    costs = _Costs(unary, depths, cap, transition)
    return costs.unary[0].amin((0, 1)) if costs.shape[0] == 1 else costs.ahead(False)[-1].amin((0, 1, 2))


class _Costs:
    """One problem in the order in which it is fast: frames first, problems last.

    u[c, x, s], the least cost of all frames so far, is by the pose c and sign s of the frame and by the turn
    x = s_t-1 xor s_t: as depths that are mirrored as a whole bend alike, what three frames' signs cost depends on their
    two turns alone.
    """

    def __init__(self, unary: Tensor, depths: Tensor, cap: float, transition: Tensor | None) -> None:
        fits = unary.ndim == 4 and depths.ndim == 3 and unary.shape[:2] == depths.shape[:2]
        if not fits or unary.shape[3] != 2 ** depths.shape[2] or not depths.shape[1]:
            raise ShapeError(
                "smooth_signs: expected unary (K, T, C, 2^M) and depths (K, T, M) of a frame or more, got "
                f"{tuple(unary.shape)} and {tuple(depths.shape)}"
            )
        batch, frames, poses, states = unary.shape
        moves = frames - 1, poses, poses
        if transition is not None and transition.shape not in (moves, (batch, *moves)):
            expected = f"expected shape {moves}, or {(batch, *moves)}, got {tuple(transition.shape)}"
            raise ShapeError(f"smooth_signs: transition: {expected}")
        self.shape = frames, poses, states, batch
        if poses == 1 and transition is not None:  # nothing to choose
            unary = unary + torch.nn.functional.pad(transition[..., 0], (0, 0, 1, 0))[..., None]
        self.unary = unary.permute(1, 2, 3, 0).contiguous()  # (T, C, S, K)
        self.bend = list(_bending(depths.permute(1, 2, 0), cap)[:, None, :, None])  # (1, S, 1, S, K) each: turns x, y
        self.rows = list(self.unary[:, :, None])  # (C, 1, S, K) each
        self.moves: list[Tensor] | None = None
        if poses > 1:
            if transition is None:
                transition = unary.new_zeros(max(frames - 1, 0), poses, poses)
            many = transition[..., None] if transition.ndim == 3 else transition.permute(1, 2, 3, 0).contiguous()
            self.moves = list(many[:, :, :, None, None])  # (C, C, 1, 1, K) each
        sign = torch.arange(states, device=unary.device)
        # from [sign before, turn] to [turn, sign] and back
        self.onto = ((sign ^ sign[:, None]) * states + sign[:, None]).flatten()
        self.back = (sign * states + (sign ^ sign[:, None])).flatten()

    def ahead(self, keep: bool = True) -> list[Tensor]:
        """The u of the second frame and of those that follow, or of the last alone."""
        frames, _, states, _ = self.shape
        start = self.unary[0][:, :, None].expand(-1, -1, states, -1)  # (C, s_0, turn, K)
        u = self._turned(self._onward(start, 0)) + self.rows[1]
        out = [u]
        for t in range(2, frames):
            g = (u[:, :, :, None] + self.bend[t - 2]).amin(1)  # (C, s_t-1, turn, K)
            u = self._turned(self._onward(g, t - 1)).add_(self.rows[t])
            if not keep:
                out.clear()
            out.append(u)
        return out

    def _onward(self, g: Tensor, t: int) -> Tensor:
        """The least over the poses of frame t, for each pose of the next."""
        return g if self.moves is None else (g[:, None] + self.moves[t]).amin(0)

    def _turned(self, g: Tensor) -> Tensor:
        """[c, sign before, turn] as [c, turn, sign]."""
        return g.flatten(1, 2).index_select(1, self.onto).view(g.shape)

    def pointers(self, ahead: list[Tensor]) -> Tensor:
        """Of each state (C S S) of the third frame and on the state before, (T - 2, C S S, K)."""
        frames, count, states, batch = self.shape
        if frames == 2:
            return self.onto.new_zeros(0, count * states**2, batch)
        both = torch.stack(ahead[:-1])[:, :, :, :, None] + torch.stack(self.bend)  # (T - 2, C, x, s_t-1, y, K)
        least, turn = _least(both.unbind(2))
        sign = torch.arange(states, device=turn.device)[:, None, None]
        state = turn * states + sign  # [c_t-1, s_t-1, y]
        if self.moves is not None:
            _, pose = _least((least[:, :, None] + torch.stack(self.moves[1:])).unbind(1))  # [c_t, s_t-1, y]
            state = state.gather(1, pose) + pose * states**2
        return state.flatten(2, 3).index_select(2, self.onto).flatten(1, 2)

    def first_pose(self, state: Tensor) -> Tensor:
        """The first frame's pose (1, K), of the second frame's state (K,)."""
        _, count, states, _ = self.shape
        if self.moves is None:
            return torch.zeros_like(state)[None]
        sign, turn, pose = state % states, state // states % states, state // states**2
        start = self.unary[0].gather(1, (sign ^ turn).expand(count, 1, -1))[:, 0]  # (C, K)
        move = self.moves[0][:, :, 0, 0].expand(-1, -1, len(state)).gather(1, pose.expand(count, 1, -1))[:, 0]
        return (start + move).argmin(0, keepdim=True)

    def margins(self, ahead: list[Tensor]) -> Tensor:
        """Least cost of any path through each state, (T, C, S, K)."""
        frames = self.shape[0]
        behind = torch.zeros_like(ahead[-1])  # [c_t, turn, s_t]: least cost of frames t + 1..
        after = [behind]
        for t in range(frames - 1, 0, -1):
            onward = (behind + self.rows[t]).flatten(1, 2).index_select(1, self.back).view_as(behind)  # [c_t, s_t-1, y]
            if self.moves is not None:
                onward = (onward[None] + self.moves[t - 1]).amin(1)  # [c_t-1, s_t-1, y]
            if t == 1:
                break
            behind = (onward[:, None] + self.bend[t - 2]).amin(3)  # [c_t-1, x, s_t-1]
            after.append(behind)
        later = (torch.stack(ahead) + torch.stack(after[::-1])).amin(2)  # (T - 1, C, S, K)
        return torch.cat([(self.unary[0] + onward.amin(2))[None], later])


def _least(values: Sequence[Tensor]) -> tuple[Tensor, Tensor]:
    """The least of several tensors, elementwise, and which it is: much faster than argmin, which takes one by one."""
    best, index = values[0], torch.zeros_like(values[0], dtype=torch.long)
    for i, value in enumerate(values[1:], 1):
        index.masked_fill_(value < best, i)
        best = torch.minimum(best, value)
    return best, index


def _bending(depths: Tensor, cap: float) -> Tensor:
    """Cost of three frames' turns, (T - 2, S, S, K), of depths (T, M, K)."""
    frames, count, batch = depths.shape
    sign = torch.tensor([1.0, -1.0], dtype=depths.dtype, device=depths.device)[:, None]
    total: Tensor | int = 0
    for m in range(count):
        signed = depths[:, m, None] * sign  # (T, 2, K)
        bend = (signed[:-2] - 2 * depths[1:-1, m, None])[:, :, None] + signed[2:, None]  # (T - 2, 2, 2, K)
        block = [2 if i == m else 1 for i in range(count)]
        total = total + bend.square_().clamp_max_(cap).mul_(0.5).reshape(-1, *block, *block, batch)
    assert isinstance(total, Tensor)
    total = total.expand(-1, *[2] * (2 * count), -1)
    return total.reshape(max(frames - 2, 0), 2**count, 2**count, batch)
