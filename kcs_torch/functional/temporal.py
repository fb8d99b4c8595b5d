"""Time: gaps, windows and their seams."""

from __future__ import annotations

import itertools
import math

import torch
from torch import Tensor

from kcs_torch.errors import OptionError, ShapeError
from kcs_torch.functional.precision import wide
from kcs_torch.functional.shapes import broadcast_shapes, check_batches, check_core, fit_together

__all__ = ["best_path", "blend_windows", "fill_between", "interpolate", "standing", "window_starts"]


def interpolate(values: Tensor, seen: Tensor) -> Tensor:
    """Fill gaps linearly in time, and ends with the nearest seen value.

    Args:
        values: (..., T, N, D), finite.
        seen: (..., T, N), or what broadcasts to it, True where ``values`` hold.

    Returns:
        (..., T, N, D). A joint never seen takes the mean of the others in each frame, their gaps filled; 0 where there
        are none.

    Raises:
        ShapeError: the values are not (..., T, N, D), or ``seen`` is not of truth values that fit them.
    """
    check_core(values, "interpolate: values", "T", "N", "D")
    frames = values.shape[-3]
    if not isinstance(seen, Tensor) or seen.dtype != torch.bool or not fit_together(seen.shape, values.shape[:-1]):
        got = f"{tuple(seen.shape)} of {seen.dtype}" if isinstance(seen, Tensor) else type(seen).__name__
        raise ShapeError(
            f"interpolate: seen: expected (..., T, N) = {tuple(values.shape[:-1])} of torch.bool, got {got}"
        )
    seen = seen.expand(values.shape[:-1])
    time = torch.arange(frames, device=values.device)[:, None].expand(seen.shape)
    before = torch.where(seen, time, -1).cummax(-2).values
    after = torch.where(seen, time, frames).flip(-2).cummin(-2).values.flip(-2)
    before, after = torch.where(before < 0, after, before), torch.where(after >= frames, before, after)
    start, stop = before.clamp(0, frames - 1), after.clamp(0, frames - 1)  # clamped only where never seen
    gap = (stop - start).clamp_min(1).to(values.dtype)
    share = ((time - start).to(values.dtype) / gap).clamp(0, 1)[..., None]
    pick = lambda index: values.gather(-3, index[..., None].expand(*index.shape, values.shape[-1]))  # noqa: E731
    filled = pick(start) * (1 - share) + pick(stop) * share
    never = ~seen.any(-2, keepdim=True)
    known = (~never).to(values.dtype)[..., None]
    middle = (filled * known).sum(-2, keepdim=True) / known.sum(-2, keepdim=True).clamp_min(1)
    return torch.where(never[..., None], middle, filled)


def fill_between(values: Tensor, pick: Tensor, length: int) -> Tensor:
    """Fill in the frames between some, linearly, and those beyond the ends with the nearest.

    Args:
        values: (H, K, ...), of the frames that are known.
        pick: (K,) which frames these are.
        length: T.

    Returns:
        (H, T, ...).

    >>> fill_between(torch.tensor([[0.0, 4]]), torch.tensor([0, 2]), 4)
    tensor([[0., 2., 4., 4.]])
    """
    known = torch.zeros(length, 1, dtype=torch.bool, device=values.device)
    known[pick] = True
    full = values.new_zeros(len(values), length, 1, values[0, 0].numel())
    full[:, pick] = values.reshape(*values.shape[:2], 1, -1)
    return interpolate(full, known).reshape(len(values), length, *values.shape[2:])


def standing(image: Tensor, weights: Tensor) -> Tensor:
    """Tell how surely points stand still, exp(-1/2 (speed / 12 % of the top speed)^2).

    Args:
        image: (..., T, C, 2) of points that touch the ground now and then, not centred.
        weights: (..., T, C), 0 where unseen, whatever stands there; NaN counts as unseen, too.

    Returns:
        (..., T, C) in 0..1; 0 where a point or its neighbours in time are unseen, and in clips of one or two frames.
        The top speed is the 0.95 quantile over frames and points.

    Raises:
        ShapeError: they are not of these shapes.

    >>> x = torch.tensor([0.0, 0, 0, 0, 1, 2, 3])
    >>> standing(torch.stack([x, 0 * x], -1)[:, None], torch.ones(7, 1)).flatten()
    tensor([1.0000e+00, 1.0000e+00, 1.0000e+00, 1.7e-04, 8.3e-16, 8.3e-16, 8.3e-16])
    """
    check_core(image, "standing: image", "T", "C", 2)
    check_core(weights, "standing: weights", *image.shape[-3:-1])
    check_batches("standing: image and weights", image, weights, cores=(3, 2))
    seen = (weights > 0) & image.isfinite().all(-1)
    dtype = image.dtype if image.is_floating_point() else torch.float32
    if image.shape[-3] < 3 or not image.numel():
        return torch.zeros_like(seen, dtype=dtype)
    known = torch.where(seen[..., None], wide(image), 0.0)
    move = known[..., 2:, :, :] - known[..., :-2, :, :]
    move = move / move.abs().amax((-3, -2, -1), keepdim=True).clamp_min(torch.finfo(move.dtype).tiny)  # no overflow
    speed = move.norm(dim=-1) / 2
    speed = torch.cat([speed[..., :1, :], speed, speed[..., -1:, :]], -2)
    seen = (
        seen
        & torch.cat([seen[..., :1, :], seen[..., :-1, :]], -2)
        & torch.cat([seen[..., 1:, :], seen[..., -1:, :]], -2)
    )
    top = torch.nanquantile(torch.where(seen, speed, torch.nan).flatten(-2), 0.95, dim=-1)[..., None, None]
    still = torch.exp(-0.5 * (speed / (0.12 * top).clamp_min(torch.finfo(speed.dtype).tiny)).square())
    return torch.where(seen, still, torch.zeros_like(still)).to(dtype)


def window_starts(length: int, window: int, overlap: int) -> list[int]:
    """First frames of equally long windows that cover ``length`` frames and overlap by at least ``overlap``.

    Raises:
        OptionError: the overlap is not below the window.

    >>> window_starts(10, 4, 1), window_starts(3, 4, 1)
    ([0, 3, 6], [0])
    """
    if not 0 <= overlap < window:
        raise OptionError(f"windows: expected an overlap within 0..{window - 1}, got {overlap}")
    if length <= window:
        return [0]
    count = math.ceil((length - overlap) / (window - overlap))
    return [round(i * (length - window) / (count - 1)) for i in range(count)]


def blend_windows(parts: Tensor, starts: list[int], length: int) -> Tensor:
    """Join overlapping windows by a weighted mean that fades each window in and out.

    Args:
        parts: (W, T_w, ...) values of each window.
        starts: first frame of each window.
        length: T.

    Returns:
        (T, ...).

    Raises:
        ShapeError: there are no windows, or not one for each start.
        OptionError: a frame lies in no window, or a window beyond the frames.
    """
    if parts.ndim < 2 or not len(parts) or len(parts) != len(starts):
        raise ShapeError(
            f"blend_windows: expected parts (W, T_w, ...) of as many windows as starts, at least one, got "
            f"{tuple(parts.shape)} and {len(starts)} starts"
        )
    window, order = parts.shape[1], sorted(starts)
    whole = order[0] == 0 and order[-1] + window == length
    if not whole or any(b - a > window for a, b in itertools.pairwise(order)):
        expected = f"expected starts of windows of {window} frames that cover {length} frames, and no others"
        raise OptionError(f"blend_windows: starts: {expected}, got {starts}")
    ramp = torch.arange(1, window + 1, dtype=parts.dtype, device=parts.device)
    ramp = torch.minimum(ramp, ramp.flip(0))
    overlap = max([a + window - b for a, b in itertools.pairwise(starts)], default=1)
    ramp = ramp.clamp_max(max(overlap, 1))
    index = torch.tensor(starts, device=parts.device)[:, None] + torch.arange(window, device=parts.device)
    shaped = ramp.reshape(1, -1, *[1] * (parts.ndim - 2))
    total = torch.zeros(length, *parts.shape[2:], dtype=parts.dtype, device=parts.device)
    total = total.index_add(0, index.flatten(), (parts * shaped).flatten(0, 1))
    weight = torch.zeros(length, dtype=parts.dtype, device=parts.device)
    weight = weight.index_add(0, index.flatten(), ramp.repeat(len(starts)))
    return total / weight.reshape(-1, *[1] * (parts.ndim - 2))


def best_path(cost: Tensor, transition: Tensor) -> Tensor:
    """Return the states of least total cost, sum_t cost[t, s_t] + transition[t, s_t, s_t+1] (Viterbi).

    Both sweeps go together. Long paths are cut into blocks, whose min-plus products are taken side by side first: then
    every block begins from what it costs to come there, so that loops run over the root of the number of frames.

    Args:
        cost: (..., T, S).
        transition: (..., T - 1, S, S).

    Returns:
        (..., T) states. Where several paths cost the same, the result may mix them.

    Raises:
        ShapeError: they are not of these shapes.

    >>> best_path(torch.tensor([[0.0, 1], [1, 0], [0, 1]]), torch.ones(2, 2, 2) - torch.eye(2)).tolist()
    [0, 0, 0]
    """
    check_core(cost, "best_path: cost", "T", "S")
    frames, states = cost.shape[-2:]
    check_core(transition, "best_path: transition", max(frames - 1, 0), states, states)
    if frames <= 1:
        return cost.argmin(-1)
    batch = broadcast_shapes(cost.shape[:-2], transition.shape[:-3])
    problems, count = 2 * math.prod(batch), frames - 1
    length = count if count <= 16 * problems else math.ceil((count / 2) ** 0.5)
    blocks = math.ceil(count / length)
    steps = cost.new_zeros(2, *batch, blocks * length, states, states)  # one copy: these are most of the memory
    steps[0, ..., :count, :, :] = transition + cost[..., :-1, :, None]  # a frame's cost and the step out of it
    steps[1, ..., :count, :, :] = (transition + cost[..., 1:, None, :]).mT.flip(-3)
    least = _least(steps.view(problems, blocks, length, states, states))[:, :frames]
    before, after = least.reshape(2, *batch, frames, states)
    return (cost + before + after.flip(-2)).argmin(-1)  # the least cost of any path through each state


def _least(steps: Tensor) -> Tensor:
    """Least costs (P, H L + 1, S) of coming to each state, from min-plus matrices in H blocks (P, H, L, S, S)."""
    problems, blocks, length, states, _ = steps.shape
    start = steps.new_zeros(problems, 1, states)
    if blocks > 1:
        product = steps[:, :, 0]
        for k in range(1, length):
            product = (product[..., :, None] + steps[:, :, k, None]).amin(-2)
        for b in range(blocks - 1):
            start = torch.cat([start, (start[:, -1:, :, None] + product[:, b, None]).amin(-2)], 1)
    costs = [start]
    for k in range(length):
        costs.append((costs[-1][..., None] + steps[:, :, k]).amin(-2))
    inner = torch.stack(costs[:-1], 2).flatten(1, 2)
    return torch.cat([inner, costs[-1][:, -1:]], 1)
