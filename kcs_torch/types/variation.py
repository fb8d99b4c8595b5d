"""How far rigid bones are from keeping their length."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from kcs_torch.functional.guarded import largest
from kcs_torch.functional.ranks import nanmedian
from kcs_torch.skeleton import Skeleton

__all__ = ["BoneVariation", "bone_shares", "bone_variation", "bone_variations", "ever_seen"]

POINT = 1e-6
"""Length of a bone, over that of the longest, up to which its ends are one point."""


class BoneVariation(NamedTuple):
    """Standard deviations of rigid bones' lengths over their means, per cent; NaN and "" where there are none.

    >>> str(BoneVariation(0.05, 3.95, "Neck-UpperNeck"))
    '0.05 % (median), at most 3.95 % (Neck-UpperNeck)'
    """

    median: float = math.nan
    largest: float = math.nan
    bone: str = ""

    def __str__(self) -> str:
        if math.isnan(self.median):
            return "unknown: no bones that are rigid and seen"
        most = f", at most {self.largest:.2f} % ({self.bone})" if self.bone else ""  # older files lack it
        return f"{self.median:.2f} % (median){most}"


def bone_variation(lengths: Tensor, body: Skeleton, seen: Tensor | None = None) -> BoneVariation:
    """Say how much the rigid bones of a body change their length: the median bone, and the one that does most.

    Args:
        lengths: (T, B) of all its bones, NaN where unseen.
        body: the skeleton.
        seen: (N,) joints that some frame shows, all if None: the places of others are made up, and so are their bones.

    >>> arm = Skeleton.from_names(list("abc"), [("a", "b"), ("b", "c")])
    >>> str(bone_variation(torch.tensor([[1.0, 9.0], [1.0, 11.0]]), arm))
    '0.00 % (median), at most 10.00 % (b-c)'
    """
    return bone_variations(lengths[None], body, None if seen is None else seen[None])[0]


def bone_variations(lengths: Tensor, body: Skeleton, seen: Tensor | None = None) -> list[BoneVariation]:
    """:func:`bone_variation` of each of K clips: of lengths (K, T, B), and of joints (K, N) that are seen."""
    rigid, names = list(body.rigid), body.bone_names
    if not rigid:
        return [BoneVariation()] * len(lengths)
    shares = 100 * bone_shares(lengths)
    if seen is not None:
        shares = torch.where(ever_seen(seen, body), shares, torch.nan)
    shares = shares[:, rigid]
    worst = shares.nan_to_num(-1.0).argmax(-1)
    return [
        BoneVariation() if math.isnan(usual) else BoneVariation(usual, each[bone], names[rigid[bone]])
        for usual, each, bone in zip(nanmedian(shares, -1).tolist(), shares.tolist(), worst.tolist(), strict=True)
    ]


def bone_shares(lengths: Tensor) -> Tensor:
    """The standard deviation of lengths (..., T, B) over their mean, (..., B): 0 of bones of length 0, NaN of unseen.

    A joint that nobody saw may lie on its neighbour: the length of the bone between them is then 0 but for rounding.
    """
    mean = lengths.nanmean(-2, keepdim=True)
    some = ~(mean <= POINT * largest(mean.nan_to_num(0.0), 2))
    ratio = torch.where(some, lengths / torch.where(some, mean, 1), 1)
    return (ratio - 1).square().nanmean(-2).sqrt()


def ever_seen(seen: Tensor, body: Skeleton) -> Tensor:
    """Which bones (K, B) are between joints (K, N) that are seen."""
    return seen[:, body.bone_index(device=seen.device)].all(-1)
