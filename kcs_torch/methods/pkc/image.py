"""What a descent sees of an image of bones, and where its terms leave their slopes."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

__all__ = ["Image", "Slopes", "bend_cost", "turned"]


class Image(NamedTuple):
    """What the image of bones alone decides; K is 1, or H where each hypothesis has its own.

    Attributes:
        bones: (K, 2, B, T).
        flat: (K, B, T) their squared lengths.
        seen: x and y (K, B, T) in the order of :class:`kcs_torch.methods.pkc.sides.Sides`.
        plane: (K, 2, 2, T) of the trunk's two long axes.
        edges: (K, 2, 3, hinges, T) of the bones above and below hinges, and of their axes.
        turns: (K, 3, hinges, T), the slopes of -(u x v) . a in the depths of u, v and a.
        across: (K, hinges, T) squared lengths of the axes.
        along: (K, limbs, T) of upper arms and thighs along the axes.
        rays: (K or 1, 2, B, T) u and v of the rays (u, v, 1) of bones' outer ends; None where rays are parallel.
    """

    bones: Tensor
    flat: Tensor
    seen: tuple[Tensor, Tensor]
    plane: Tensor
    edges: Tensor
    turns: Tensor
    across: Tensor
    along: Tensor
    rays: Tensor | None

    @classmethod
    def of(cls, bones: Tensor, lines: Tensor, order: Tensor, outer: int, rays: Tensor | None = None) -> Image:
        """That of bones (K, 2, B, T).

        Args:
            bones: in the skeleton's order.
            lines: (2 + 3 hinges, B) that make of bones the trunk's axes, and the bones and axes of hinges.
            order: (B,) of the bones.
            outer: how many hinges are below upper arms and thighs; they come first.
            rays: as of the image.
        """
        drawn = lines @ bones  # (K, 2, 2 + 3 hinges, T)
        edges = drawn[:, :, 2:].unflatten(2, (3, -1))
        (x, y), (u, a) = edges.unbind(1), edges[:, :, ::2].unbind(2)
        turns = x.roll(-2, 1).mul_(y.roll(-1, 1)).sub_(y.roll(-2, 1).mul_(x.roll(-1, 1)))
        along = (u[:, :, :outer] * a[:, :, :outer]).sum(1)
        x, y = bones.index_select(2, order).unbind(1)
        plane = drawn[:, :, :2].transpose(1, 2)
        across = a.square().sum(1)
        return cls(bones, bones.square().sum(1), (x, y), plane, edges, turns, across, along, rays)


class Slopes(NamedTuple):
    """Derivatives to which each term adds its own.

    Attributes:
        depth: (H, B, T) in the depths of bones.
        growth: (H, B) in the logarithms of lengths.
        lines: (H, L, T) in the depths of lines, which are sums of bones.
        image: (H, 2, B, T) in the image of bones; None where it is given.
        flat_lines: (H, 2, L, T) in the image of lines; empty where it is given.
        rays: (H,) in the logarithm of the rays' size.
    """

    depth: Tensor
    growth: Tensor
    lines: Tensor
    image: Tensor | None
    flat_lines: Tensor
    rays: Tensor

    @classmethod
    def of(cls, depth: Tensor, growth: Tensor, lines: Tensor, image: Tensor | None) -> Slopes:
        """Those of a first term; those in lines such as (H, L, T) are yet to be written."""
        flat = lines.new_empty(len(lines), 0 if image is None else 2, *lines.shape[1:])
        return cls(depth, growth, torch.empty_like(lines), image, flat, lines.new_zeros(len(lines)))


def turned(edges: Tensor) -> Tensor:
    """The slopes of -(u x v) . a in u, v and a, of vectors (H, 3 coordinates, 3 vectors, ...)."""
    return torch.linalg.cross(edges.roll(-2, 2), edges.roll(-1, 2), dim=1)


def bend_cost(values: Tensor, weight: Tensor | float, slope: Tensor, time: Tensor | None = None) -> Tensor:
    """Half the weighted squares of second differences, (H,), of values (H, C, T); adds its derivative to ``slope``.

    Args:
        values: (H, C, T).
        weight: a number, or (H, 1, 1).
        slope: (H, C, T).
        time: (H, 1, T) which frames are real.
    """
    if values.shape[-1] < 3:
        return values.new_zeros(len(values))
    bend = (values[..., 2:] + values[..., :-2]).sub_(values[..., 1:-1], alpha=2)
    if time is not None:
        bend = bend * time[..., 2:]
    pull = bend * weight
    slope[..., 2:] += pull
    slope[..., :-2] += pull
    slope[..., 1:-1].sub_(pull, alpha=2)
    return (bend * pull).sum((1, 2)) / 2
