"""What tells that a solution is not the tracks' body, for the user."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from kcs_torch.errors import counted
from kcs_torch.functional.align import centre
from kcs_torch.functional.chain import bone_lengths
from kcs_torch.functional.ranks import nanmedian
from kcs_torch.functional.weights import rms
from kcs_torch.methods.clips.batches import Clips
from kcs_torch.methods.clips.template import guessed
from kcs_torch.nn.lengths import oddities
from kcs_torch.skeleton import Skeleton
from kcs_torch.types.variation import bone_shares, ever_seen

if TYPE_CHECKING:
    from kcs_torch.methods.base import Method

__all__ = ["LOOSE", "WHY_LOOSE", "loose_bones", "what_is_wrong"]

LOOSE = 5.0
"""Per cent of bone variation from which on the tracks are hardly those of a body of this skeleton."""

PART = 2.0
"""Per cent of the body's size by which a bone's length has to vary as well to be told by name: short bones vary."""

ODD, DEEP = 0.4, 1.0
"""Root mean square of the logarithms of lengths over the skeleton's, and depth over the size in the image, beyond which
a body is another: people in odd postures, seen by detectors, come to .4 and .5."""

OTHER = 0.6
"""The former, beyond which it is another whatever its depth, unless a guess at an animal is all that is known of it."""

AWAY, OFTEN = 0.25, 0.1
"""Share of the body's size by which a joint is away from its tracks in most of the frames that show it, and the share
of frames that have to show it, from which on it is another joint; or most joints in this share of the frames, which are
another body's. Noise of 40 mm comes to .1 of the size."""

UNEVEN, MUCH = 1.8, 0.15
"""How many times as long as its twin on the other side a bone is, and by what share of the body's size, from which on
one of them is another bone. KCS, which binds no twins, comes to 1.7 of motion capture."""

POINT = 1e-6
"""Size in the image, over the depth, up to which a body is a point."""

NAMED = 3
"""Joints or bones that are told by name, at most."""

WHY_LOOSE = (
    "joints may be wrong, swapped or in another order, the skeleton may be another, parts of the body may bend, or the "
    "camera may be so near that its intrinsics matter"
)


def what_is_wrong(
    method: Method,
    body: Skeleton,
    clips: Clips,
    points: Tensor,
    images: Tensor,
    settled: Sequence[bool],
    lengths: Tensor | None = None,
) -> list[list[str]]:
    """What tells that points are not their clips' bodies, and why that may be, for each of K clips.

    Lengths that vary are no news of a solution that did not settle, and none of bones whose ends the tracks never show;
    a body unlike any is why it does not settle.

    Args:
        method: that found them.
        body: the skeleton.
        clips: the tracks.
        points: (K, T, N, 3), 0 in the padding.
        images: (K, T, N, 2) of these.
        settled: whether the method's stopping rule was met.
        lengths: (K, T, B) of the bones, NaN in the padding; found from the points if None.
    """
    if lengths is None:
        lengths = clips.fill(bone_lengths(points, body.bone_index(device=points.device)), math.nan)
    none = [""] * len(settled)
    loose = _loose_bones(points, body, lengths, clips) if method.keeps_lengths and any(settled) else none
    loose = [words if sure else "" for words, sure in zip(loose, settled, strict=True)]
    odd, uneven = none, none
    if method.knows_template(body):
        odd, uneven = _odd_bodies(points, body, lengths), _uneven_bodies(points, body, lengths, clips)
    far = _far_joints(images, body, clips) if method.keeps_lengths else none
    return [[f"{words}: {WHY_LOOSE}" for words in told if words] for told in zip(loose, odd, far, uneven, strict=True)]


def _far_joints(images: Tensor, body: Skeleton, clips: Clips) -> list[str]:
    """Which joints' images (K, T, N, 2) are away from their tracks in most frames, or most joints' in which frames.

    A sentence of each clip for the user; empty where none is.
    """
    seen, told = clips.seen, [""] * len(images)
    share = seen.to(images.dtype)
    size = rms(centre(clips.points, clips.weights)[0], share, 2)[:, None, None]
    some = seen & (clips.mean(share) >= OFTEN)[:, None] & (size > 0)
    away = torch.where(some, ((images - clips.points) / size[..., None]).norm(dim=-1), torch.nan)
    for k in (away > AWAY).any(2).any(1).nonzero().flatten().tolist():
        count, off = clips.counts[k], nanmedian(away[k], 0).tolist()
        named = {f"{joint} by {100 * by:.0f} %": by for joint, by in zip(body.joints, off, strict=True) if by > AWAY}
        frames = {t: by for t, by in enumerate(nanmedian(away[k], 1).tolist()) if by > AWAY}
        if named:
            told[k] = (
                f"joints are away from their tracks in most frames that show them, {_the_worst(named)} of the body's "
                "size"
            )
        elif len(frames) >= OFTEN * count:
            told[k] = (
                f"in {len(frames)} of {counted(count, 'frame')}, from frame {min(frames)} on, most joints are away "
                f"from their tracks, by up to {100 * max(frames.values()):.0f} % of the body's size"
            )
    return told


def _the_worst(named: Mapping[str, float], kind: str = "joint") -> str:
    """The worst of what is ``named``, and how many more there are."""
    shown, more = sorted(named, key=lambda name: -named[name]), len(named) - NAMED
    return ", ".join(shown[:NAMED]) + (f" and {counted(more, f'more {kind}')}" if more > 0 else "")


def loose_bones(points: Tensor, body: Skeleton) -> str:
    """Which rigid bones of points (T, N, 3) change their length, for the user; empty where none does."""
    lengths = bone_lengths(points, body.bone_index(device=points.device))
    return _loose_bones(points[None], body, lengths[None])[0]


def _loose_bones(points: Tensor, body: Skeleton, lengths: Tensor, clips: Clips | None = None) -> list[str]:
    """:func:`loose_bones` of points (K, T, N, 3); only bones between joints that the clips show count, all if None."""
    told = [""] * len(points)
    shares = 100 * bone_shares(lengths)
    if clips is not None:
        shares = torch.where(ever_seen(clips.seen.any(1), body), shares, torch.nan)
    for k in (shares[:, list(body.rigid)] > LOOSE).any(1).nonzero().flatten().tolist():
        bones = [b for b in body.rigid if not bool(shares[k, b].isnan())]
        share, own = shares[k, bones], points[k] if clips is None else points[k, : clips.counts[k]]
        usual = float(share.median())
        if usual > LOOSE:
            told[k] = f"bone lengths vary by {usual:.1f} %"
        elif body.is_tree:  # of links between markers, say, some bend
            size = (own - own.mean(1, keepdim=True)).square().sum(-1).mean().sqrt()
            spread = lengths[k, : len(own), bones].std(0, correction=0)
            found = ((share > LOOSE) & (100 * spread > PART * size)).nonzero().flatten().tolist()
            named = {f"{body.bone_names[bones[b]]} by {float(share[b]):.0f} %": float(share[b]) for b in found}
            told[k] = f"lengths of rigid bones vary: {_the_worst(named, 'bone')}" if named else ""
    return told


def _odd_bodies(points: Tensor, body: Skeleton, lengths: Tensor) -> list[str]:
    """How points (K, T, N, 3) are unlike any body of the skeleton, for the user; empty where they are not."""
    usual, told = body.relative_lengths(dtype=points.dtype, device=points.device), [""] * len(points)
    rigid = list(body.rigid)
    if usual is None or not rigid:
        return told
    every = oddities(nanmedian(lengths, 1)[:, rigid], usual[rigid]).tolist()
    for k in (k for k, odd in enumerate(every) if odd > ODD):
        middle = points[k] - points[k].mean(1, keepdim=True)
        wide, far = float(middle[..., :2].norm()), float(middle[..., 2].norm())
        deep = far > DEEP * wide
        if not (deep or (every[k] > OTHER and not guessed(body))) or wide <= POINT * far:
            continue  # a point in the image shows no body
        also = f", and it is {far / wide:.1f} times as deep as it is large in the image" if deep else ""
        told[k] = (
            f"this is hardly a body of skeleton '{body.name}': bones are {math.exp(every[k]):.1f} times as long or as "
            f"short as usual{also}"
        )
    return told


def _uneven_bodies(points: Tensor, body: Skeleton, lengths: Tensor, clips: Clips) -> list[str]:
    """Which bones of points (K, T, N, 3) are far longer than their twins, for the user; empty where none is."""
    told, rigid = [""] * len(points), set(body.rigid)
    twins = [pair for pair in body.mirror_bones if rigid.issuperset(pair)]
    if not twins:
        return told
    shown = ever_seen(clips.seen.any(1), body)[:, twins].all(-1)  # (K, P)
    both = nanmedian(lengths, 1)[:, twins]  # (K, P, 2)
    long, short = both.amax(-1), both.amin(-1)
    size = clips.mean((points - points.mean(2, keepdim=True)).square().sum(-1).mean(-1, keepdim=True)).sqrt()
    uneven = shown & (long > UNEVEN * short) & (long - short > MUCH * size)
    for k in uneven.any(1).nonzero().flatten().tolist():
        named = {}
        for pair in uneven[k].nonzero().flatten().tolist():
            longer = int(both[k, pair].argmax())
            names, times = [body.bone_names[b] for b in twins[pair]], float(long[k, pair] / short[k, pair])
            named[f"{names[longer]} is {times:.1f} times as long as {names[1 - longer]}"] = times
        told[k] = f"{_the_worst(named, 'bone')} (where the template says so, a place there may be mistyped)"
    return told
