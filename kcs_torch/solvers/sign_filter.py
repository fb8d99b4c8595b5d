"""Signs of depth frame by frame: the forward half of :func:`kcs_torch.solvers.signs.smooth_signs`."""

from __future__ import annotations

from torch import Tensor

from kcs_torch.solvers.signs import sign_table

__all__ = ["SignFilter"]


class SignFilter:
    """Least costs of all states of the newest frame, over every path that leads there; O(1) time and memory a frame.

    The costs are those of :func:`kcs_torch.solvers.signs.smooth_signs`, of which this is the forward recursion: at the
    last frame of a clip both name the same state.

    Args:
        cap: largest squared acceleration that counts; what exceeds it is a jump.

    >>> import torch
    >>> signs = SignFilter(cap=9.0)
    >>> for depth, cost in [(2.0, 1.0), (1.0, 0.0), (0.0, 0.0), (1.0, 0.0), (2.0, 0.0)]:
    ...     margins = signs.step(torch.tensor([[[0.0, cost]]]), torch.tensor([[depth]]))
    >>> margins.argmin(-1).item()  # 0 is +, 1 is -: the bone has passed through the image plane
    1
    """

    def __init__(self, *, cap: float) -> None:
        self.cap = cap
        self.cost: Tensor | None = None
        self.before: list[Tensor] = []

    def step(self, unary: Tensor, depths: Tensor, transition: Tensor | None = None) -> Tensor:
        """Take one frame and return the least cost (K, C, 2^M) of each state, 0 for the best of each problem.

        Args:
            unary: (K, C, 2^M), signs in the order of :func:`kcs_torch.solvers.signs.sign_table`.
            depths: (K, M), non-negative, in units of the accelerations' standard deviation.
            transition: (C, C) cost of going from one pose to another, or None where all follow each other freely.
        """
        if transition is None:
            transition = unary.new_zeros(unary.shape[1], unary.shape[1])
        signed = depths[:, None] * sign_table(depths.shape[-1], depths)  # (K, S, M)
        change = transition[None, :, None, :, None]
        if self.cost is None:
            self.cost, margins = unary, unary
        elif len(self.before) == 1:
            start = self.cost[..., None, None] + change  # (K, C, S, C', 1)
            self.cost = start.amin(1) + unary[:, None]  # (K, S, C', S')
            margins = self.cost.amin(1)
        else:
            far, near = self.before
            bend = (far[:, :, None] - 2 * near[:, None])[:, :, :, None] + signed[:, None, None]  # (K, S, S, S, M)
            bend = 0.5 * bend.square().clamp_max(self.cap).sum(-1)
            onward = (self.cost[..., None] + bend[:, :, None]).amin(1)  # (K, C, S, S')
            self.cost = (onward[..., None, :] + change).amin(1) + unary[:, None]
            margins = self.cost.amin(1)
        self.before = [*self.before[-1:], signed]
        least = margins.flatten(1).amin(-1)
        self.cost = self.cost - least.view(-1, *[1] * (self.cost.ndim - 1))
        return margins - least[:, None, None]
