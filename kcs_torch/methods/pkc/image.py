"""What a descent sees of an image of bones, and where its terms leave their slopes."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

__all__ = ["Image", "Slopes", "bend_cost"]


class Image(NamedTuple):
    """What the image of bones alone decides; K is 1, or H where each hypothesis has its own.

    Attributes:
        bones: (K, 2, B, T).
        flat: (K, B, T) their squared lengths.
        seen: x and y (K, B, T) in the order of :class:`kcs_torch.methods.pkc.sides.Sides`.
        plane: (K, 2, 2, T) of the trunk's two long axes.
        edges: (K, 2, 3, hinges, T) of the bones above and below hinges, and of their axes.
        turns: (K, hinges, T) each: (u x v) . a = a_z turns_0 + v_z turns_1 - u_z turns_2.
        across: (K, hinges, T) squared lengths of the axes.
        along: (K, limbs, T) of upper arms and thighs along the axes.
        rays: (K or 1, 2, B, T) u and v of the rays (u, v, 1) of bones' outer ends; None where rays are parallel.
    """

    bones: Tensor
    flat: Tensor
    seen: tuple[Tensor, Tensor]
    plane: Tensor
    edges: Tensor
    turns: tuple[Tensor, Tensor, Tensor]
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
        (ux, uy), (vx, vy), (ax, ay) = (edge.unbind(1) for edge in edges.unbind(2))
        turns = ux * vy - uy * vx, ax * uy - ay * ux, ax * vy - ay * vx
        along = (ux * ax + uy * ay)[:, :outer]
        x, y = bones.index_select(2, order).unbind(1)
        plane = drawn[:, :, :2].transpose(1, 2)
        across = ax.square() + ay.square()
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
        """Those of a first term, and as yet none in lines such as (H, L, T)."""
        shape = (len(lines), 0 if image is None else 2, *lines.shape[1:])
        return cls(depth, growth, torch.zeros_like(lines), image, lines.new_zeros(shape), lines.new_zeros(len(lines)))


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
