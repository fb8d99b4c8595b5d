"""What each choice of signs costs a limb in each frame, but for what depends on the frames about it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from kcs_torch.nn.lengths import foreshortening

if TYPE_CHECKING:
    from kcs_torch.methods.pkc.placing import Placing

__all__ = ["limb_costs"]


def limb_costs(task: Placing, lengths: Tensor) -> tuple[Tensor, Tensor]:
    """Costs (T, C, 2^M, J, K) of each frame's signs, and the depths |dz| (T, M, J, K), of lengths (J, K, M)."""
    cost = {name: weight[:, None, None, None] for name, weight in task.cost().items()}
    size = lengths.mT[:, None]  # (J, 1, M, K)
    square = size.square() - task.image.square().sum(-1)[..., None]  # (J, T, M, K)
    depth = square.clamp_min(0).sqrt()
    over = (-square).clamp_min_(0) / (2 * size)
    each = (over.square_() / (cost["over"].square() + task.noise.square()[..., None])).clamp_max_(20) / 2
    density = foreshortening(depth, size, 0.1) - 2 * task.usual.log()[:, None, :, None]
    base = (each + task.free[:, None, :, None] / cost["foreshortening"] * density).sum(2)  # (J, T, K)
    over_size = 1 / size
    deep = depth * over_size
    # Seen from the trunk a direction is a/L + s b z/L, with the image's part a = R_xy^T (x, y) and b = R_z. Its squared
    # distance from the mean, in deviations, takes sums over the three coordinates that no length changes.
    turned = task.rotations.movedim(1, 2)  # (J, T, C, 3, 3)
    across = task.image[:, :, None] @ turned[..., :2, :]  # (J, T, C, M, 3)
    along = turned[..., 2:, :]  # (J, T, C, 1, 3)
    mean, weight = task.mean[:, None, None], task.weight[:, None, None]
    pull = across * weight
    still = (pull * across).sum(-1) @ over_size.square() - 2 * ((pull * mean).sum(-1) @ over_size)  # (J, T, C, K)
    still = still + (mean.square() * weight).sum((-2, -1))[..., None]
    still = still + (along.square() * weight).sum(-1) @ deep.square()
    swing = (pull * along).sum(-1)[..., None] * over_size[:, None] - (mean * along * weight).sum(-1)[..., None]
    fit = _signed((2 * swing * deep[:, :, None]).unbind(3))
    unary = base[:, :, None, None] + (still[..., None, :] + fit) / (2 * cost["posture"][..., None])
    if task.inner is not None:
        lateral = _lateral(turned, task.inner)
        level, tip, root = _triple_parts(task.image[:, :, None, 0], task.image[:, :, None, 1], lateral)
        one, two = over_size[:, :, None].unbind(3)  # (J, 1, 1, K) each
        first, second = deep[:, :, None].unbind(3)  # (J, T, 1, K)
        sines = _signed((tip * (first * two), root * (second * one))) + (level * (one * two))[..., None, :]
        unary = unary + _hinge_cost(sines, task.inner, cost)
    if bool((task.entry[:, -1] > 0).any()):
        lateral = _lateral(turned, task.entry)
        level, tip, root = _triple_parts(task.before[:, :, None, :2], task.image[:, :, None, 0], lateral)
        level = (level + task.before[:, :, None, 2:] * tip) * over_size[:, :, None, 0]
        none = [torch.zeros_like(level)] * (lengths.shape[2] - 1)
        sines = _signed((root * deep[:, :, None, 0], *none)) + level[..., None, :]
        unary = unary + _hinge_cost(sines, task.entry, cost)
    return unary.movedim(0, -2), depth.movedim(0, -2)


def _signed(parts: Sequence[Tensor]) -> Tensor:
    """Sums of s_1 p_1 + .. + s_M p_M of p (..., K) over all signs, (..., 2^M, K), in the order of sign_table."""
    total = torch.stack([parts[0], -parts[0]], -2)
    for part in parts[1:]:
        total = (total[..., None, :] + torch.stack([part, -part], -2)[..., None, :, :]).flatten(-3, -2)
    return total


def _lateral(turned: Tensor, hinges: Tensor) -> Tensor:
    """The hinges' axes (J, T, C, 3), which turn with the trunk."""
    return (turned @ hinges[:, None, None, :3, None])[..., 0]


def _triple_parts(first: Tensor, second: Tensor, axis: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """k, p, q of (u x v) . a = k + u_z p + v_z q, (..., 1) each, of images u, v (..., 2) and axes a (..., 3)."""
    (ux, uy), (vx, vy), (ax, ay, az) = (v.split(1, -1) for v in (first, second, axis))
    return az * (ux * vy - uy * vx), vx * ay - vy * ax, uy * ax - ux * ay


def _hinge_cost(sines: Tensor, hinges: Tensor, cost: dict[str, Tensor]) -> Tensor:
    """Cost of the sines (J, T, C, S, K) of hinges' bends, elementwise."""
    sign, firm = hinges[:, 3:, None, None, None, None].unbind(1)
    wrong = (-sign * sines).clamp_min(0)
    return cost["hinge"][..., None] * firm / 2 * (wrong / cost["sine"][..., None]).square()
